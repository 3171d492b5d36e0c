"""Pictures as tasks: what a worker checks before it renders."""

import shutil

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import find_overlay
from nerg_mi.jobs.film_tasks import OF_PICTURES, draw_layers, make_layers, make_picture
from nerg_mi.jobs.options.pictures import PictureOptions
from nerg_mi.jobs.pictures import render_file
from tests.jobs.test_film import BALL

OPTIONS = PictureOptions(mode="llvm_ad_rgb", seed=2)


def chosen(options):
    return {name: getattr(options, name) for name in OF_PICTURES}


@pytest.fixture
def scene(tmp_path, rgb):
    (tmp_path / "scene.xml").write_text(BALL)
    return tmp_path / "scene.xml"


def test_a_picture_is_that_of_render_file(scene, tmp_path):
    parameters = {"scene": "scene.xml", "options": chosen(OPTIONS), "defaults": {"level": "0.5"}}
    notes = make_picture(parameters, {"scene.xml": scene}, tmp_path / "a.png")
    result = render_file(scene, tmp_path / "b.png", PictureOptions(**chosen(OPTIONS), defaults={"level": "0.5"}))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert notes == {"size": (16, 16), "channels": result.channels, "whole": None, "top": None}


def test_layers_are_drawn_as_they_would_be_at_once(scene, tmp_path):
    options = PictureOptions(mode="llvm_ad_rgb", seed=2, overlay="depth")
    parameters = {"scene": "scene.xml", "options": chosen(options), "defaults": {}}
    notes = make_layers(parameters, {"scene.xml": scene}, tmp_path / "layers.npy")
    values = np.load(tmp_path / "layers.npy")
    assert values.shape == (16, 16, 5) and notes["size"] == (16, 16) and notes["supported"] is True
    met = values[values[..., 4] > 0.5, 3]
    assert 3.6 < np.median(met) < 3.9 and find_overlay("depth").scaled
    drawn = {"ends": notes["limits"], "marker": notes["marker"], "supported": True, "about": {}, "basis": ""}
    draw_layers({**drawn, "options": chosen(options)}, {"layers.npy": tmp_path / "layers.npy"}, tmp_path / "a.png")
    render_file(scene, tmp_path / "b.png", options)
    import mitsuba as mi

    assert np.array_equal(*(np.array(mi.Bitmap(str(tmp_path / f"{name}.png"))) for name in "ab"))


def test_a_scene_that_reads_another_file_than_was_planned_with_is_refused(scene, tmp_path):
    """As on a worker where a whole path leads to somebody else's file."""
    (tmp_path / "worker").mkdir()
    shutil.copy(scene, tmp_path / "more.xml")
    scene.write_text(f'<scene version="3.0.0"><include filename="{tmp_path / "more.xml"}"/></scene>')
    shutil.copy(scene, tmp_path / "worker" / "scene.xml")
    shutil.copy(tmp_path / "more.xml", tmp_path / "worker" / "more.xml")
    inputs = {name: tmp_path / "worker" / name for name in ("scene.xml", "more.xml")}
    parameters = {"scene": "scene.xml", "options": chosen(OPTIONS), "defaults": {}}
    with pytest.raises(NergError, match="file that the job"):
        make_picture(parameters, inputs, tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
