"""Images against stored references, by a z-test per pixel: significant changes of any pixel's expectation are detected.
See `scenes.py` for the references."""

import shutil

import numpy as np
import pytest

from nerg_mi.files.images import ensure_two_threads

from .scenes import REFERENCES, SCENES, scene, test_of


@pytest.fixture
def references(tmp_path):
    # A failing test writes images next to its references. Mitsuba's test reads and writes EXR files itself.
    with ensure_two_threads():
        yield shutil.copytree(REFERENCES, tmp_path / "references")


@pytest.mark.parametrize("name", SCENES)
def test01_renders_match_their_references(rgb, name, tmp_path, references):
    assert test_of(rgb, name, tmp_path, references).run()


@pytest.mark.parametrize("name", SCENES)
def test02_small_change_is_detected(rgb, name, tmp_path, references):
    assert not test_of(rgb, name, tmp_path, references, change=1 + SCENES[name][1]).run()


def test03_variance_image_is_passed_to_the_test_class(rgb, tmp_path):
    image = np.array(rgb.render(scene(rgb, "both", tmp_path), spp=32))
    first, second = image[..., :3], image[..., 3:6]
    assert (second - first**2 > -1e-4).all() and np.percentile(second - first**2, 95) > 0.01
    one = np.array(rgb.render(scene(rgb, "both", tmp_path), spp=1))
    assert np.allclose(one[..., 3:6], one[..., :3] ** 2, rtol=1e-5)


def test04_references_are_complete_and_small():
    files = {f.name: f.stat().st_size for f in REFERENCES.iterdir()}
    assert set(files) == {f"{name}_{kind}.exr" for name in SCENES for kind in ("img", "var")}
    assert max(files.values()) < 12_000
