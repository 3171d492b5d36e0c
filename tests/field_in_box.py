"""Fixtures: small fields in files, and a scene with them."""

import pytest

from tests.plugins import fields


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with `field.safetensors` and `gaze.safetensors` in a box of ±1."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("fields")
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    return folder


@pytest.fixture
def camera():
    import nerg_mi as nerg

    return nerg.Camera(origin=(0.3, -3, 0.4), target=(0, 0, 0), fov=50, width=12, height=8)


@pytest.fixture
def scene(files, camera):
    """A field and a ball, which occludes it as seen from the right; the camera is the observer."""
    import nerg_mi as nerg

    ball = {"type": "sphere", "center": [1.4, -1.0, 0.3], "radius": 0.4}
    return nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", shapes=ball, camera=camera)
