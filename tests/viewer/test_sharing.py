"""Shares of attention in steps: those of the library, whichever are counted together."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.formats.areas import Region
from nerg_mi.rendering.nested_scene import with_gaze
from nerg_mi.viewer import session

AT = np.array([0.2, 0.1, 0.6])


@pytest.fixture
def scene(room, gaze_fields, tmp_path):
    path = tmp_path / "with.xml"
    path.write_text(with_gaze(room, gaze_fields[0]))
    return nerg.Scene.load(path)


def test01_areas_in_one_step_and_meshes_in_groups(scene, monkeypatch):
    faces = {"floor": 2, "box": 12}
    regions = [Region.of("left", (0, 0.5, -0.1), (2, 2, 0.4)), Region.of("right", (0, -2, -0.1), (2, -0.5, 0.4))]
    shapes = [name for name in faces if name in {s.id() for s in scene.mitsuba.shapes() if s.is_mesh()}]
    steps = list(session.shares_in_steps(scene, AT, regions, shapes))
    assert [sorted(step) for step in steps] == [["left", "right"], sorted(shapes)]
    one = nerg.attention(scene, regions[0].corners, observers=AT[None]).share[0]
    assert steps[0]["left"] == pytest.approx(float(one), rel=0.03) and steps[0]["left"] > 0
    monkeypatch.setattr(session, "FACES", 1)
    assert list(session.shape_groups(scene, shapes)) == [[name] for name in shapes]


def test02_without_areas_and_shapes_there_is_nothing(scene):
    assert list(session.shares_in_steps(scene, AT, [], [])) == []
