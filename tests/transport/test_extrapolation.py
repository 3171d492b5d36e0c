"""Observers outside of the environment, in solids, and far from recorded positions."""

from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.transport.extrapolation import describe_extrapolation, find_extrapolation
from nerg_mi.transport.geometry import SceneGeometry
from tests.pictures import box_dict

TABLE = np.array([(2.0, 1, 0), (3, 2, 0.8)])


@pytest.fixture
def room(rgb):
    """A room of 6 x 4 x 3 with a table that touches the floor, and a lamp."""
    corners = {"room": [(0, 0, 0), (6, 4, 3)], "table": TABLE, "lamp": [(5, 3, 2), (5.2, 3.2, 3)]}
    shapes = {name: box_dict(*np.array(c, float)) for name, c in corners.items()}
    return SceneGeometry(None, rgb.load_dict({"type": "scene", **shapes}))


def gaze(origins, scale=1.0):
    to_world = Similarity(np.diag([scale, scale, scale, 1.0]))
    support = None if origins is None else RaySupport.from_origins(np.array(origins, float), 0.2)
    return SimpleNamespace(field=SimpleNamespace(support=support, box=Box((-1, -1, -1), (1, 1, 1))), to_world=to_world)


@pytest.mark.parametrize(
    ("at", "reason"),
    [
        ((3, 3, 1.6), ""),
        ((0.01, 0.01, 0.01), ""),
        ((99, 99, 1.6), "outside"),
        ((6.5, 2, 1.6), "outside"),
        ((3, 2, -0.3), "outside"),
        ((2.5, 1.5, 0.4), "solid"),
        ((2.5, 1.5, 0.9), ""),
        ((5.1, 3.1, 2.5), "solid"),
    ],
    ids=str,
)
@pytest.mark.parametrize("field", [None, gaze(None)], ids=["no gaze", "gaze"])
def test_a_room(room, at, reason, field):
    (match,) = find_extrapolation(room, field, at)
    assert reason in match and bool(match) == bool(reason)


def test_a_merged_mesh_has_solid_parts(room, rgb):
    from nerg_mi.transport.mitsuba_mesh import make_mesh, read_triangles

    parts = [read_triangles(shape) for shape in room.scene.shapes()]
    starts = np.cumsum([0, *(len(v) for v, _ in parts)])
    vertices, faces = np.concatenate([v for v, _ in parts]), np.concatenate([f + a for (_, f), a in zip(parts, starts)])
    merged = SceneGeometry(None, rgb.load_dict({"type": "scene", "all": make_mesh(vertices, faces, "all")}))
    assert ["solid" in r for r in find_extrapolation(merged, None, [(2.5, 1.5, 0.4), (1, 1, 1.6)])] == [True, False]


def test_recorded_positions_decide_if_they_are_known(room):
    """An observer near recorded positions may be outside of the environment, as around an object."""
    field = gaze([(7.0, 2, 1.6), (1, 1, 1.6)])
    outside, inside, far = find_extrapolation(room, field, [(7.2, 2, 1.6), (1.1, 1, 1.6), (4, 2, 1.6)])
    assert outside == inside == "" and "recorded position" in far
    assert "3" in far.split()
    # In scene units, of a field with other units.
    (scaled,) = find_extrapolation(room, gaze([(1.0, 1, 0.5)], scale=2.0), [(5.5, 2, 1)])
    assert "3.5" in scaled.split()


def test_an_open_floor_has_space_above(rgb):
    floor = SceneGeometry(
        None, rgb.load_dict({"type": "scene", "floor": box_dict(*np.array([(0, 0, -0.1), (6, 4, 0)]))})
    )
    assert find_extrapolation(floor, None, [(3, 2, 1.4)]) == [""] and find_extrapolation(floor, None, [(3, 2, 5)]) != [
        ""
    ]


def test_without_surfaces_the_box_of_the_field_counts():
    assert [bool(r) for r in find_extrapolation(None, gaze(None, 2.0), [(1.9, 0, 0), (2.5, 0, 0)])] == [False, True]
    assert find_extrapolation(None, None, [(9, 9, 9)]) == [""]


def test_the_sentence_names_number_and_first(room):
    text = describe_extrapolation(room, None, [(1, 1, 1.6), (99, 98, 1.6), (2.5, 1.5, 0.4)])
    assert "2 of 3" in text and "99, 98, 1.6" in text and describe_extrapolation(room, None, [(1, 1, 1.6)]) == ""
