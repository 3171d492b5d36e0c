"""Scenes opened for figures: level poses, films, and what is refused."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.ranges import RANGE
from nerg_mi.workflows.draw_scenes import SceneOptions, SphereOptions, film, open_scene, upright_pose
from tests.cli.test_render import SCENE
from tests.workflows.recorder import Recorder


def camera(mi, origin, target, up):
    return mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().look_at(origin, target, up)})


@pytest.mark.parametrize(
    "target, up, level, heading",
    [
        ((4, 6, 0.5), (0, 0, 1), (0, 0, 1), (0.6, 0.8, 0)),  # looks down a little, z up
        ((1, 2.5, -9), (0, 1, 0), (0, 1, 0), (0, 0, -1)),  # y up
        ((1, 9, 3), (0, 0, -1), (0, 0, -1), (0, 1, 0)),  # upside down
    ],
)
def test_a_level_pose(rgb, target, up, level, heading):
    matrix = np.array(upright_pose(camera(rgb, (1, 2, 3), target, up)).matrix, float)
    np.testing.assert_allclose(matrix[:3, 3], (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 1], level, atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 2], heading, atol=1e-6)


def test_straight_down_there_is_some_heading(rgb):
    matrix = np.array(upright_pose(camera(rgb, (0, 0, 3), (0, 0, 0), (0, 1, 0))).matrix, float)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)


def test_a_film_that_is_too_large():
    assert film(30, 20)["rfilter"] == {"type": "box"}
    with pytest.raises(NergError, match="4,096.*4,096"):
        film(4096, 4096)
    # What the widest sphere needs, a gigabyte to draw, is allowed.
    (width,) = (f.metadata[RANGE].high for f in fields(SphereOptions) if f.name == "width")
    assert film(width, width // 2)["width"] == width


def test_another_integrator_is_refused(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    options = SceneOptions(mode="llvm_ad_rgb")
    with (
        pytest.raises(NergError, match='needs the integrator "nerg"'),
        open_scene(tmp_path / "scene.xml", options, Recorder()),
    ):
        pass
