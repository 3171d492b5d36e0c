"""Tests of `nerg_mi.aoi.areas`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.aoi.areas import Areas, MeshPart, SceneShape
from nerg_mi.aoi.placed import (
    BoxAoi,
    aoi_from_shape,
    assign_hits,
    concatenate_hits,
    find_shape,
    make_aois,
    merge_directions,
    merge_members,
    open_placed_areas,
    read_meshes,
    sample_cone,
    scene_from_shapes,
)
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.formats.boxes import Region
from nerg_mi.transport.mitsuba_mesh import make_mesh

from .place import SIGN, STAND, first_box, people, write_place

# ---- Environments and gaze fields ----


def open(environment=None, gaze=None, areas=(), align=None):
    return open_placed_areas(environment, gaze, Areas(areas), align)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("place")
    write_place(made)
    (made / "bare").mkdir()
    write_place(made / "bare", gaze=False)
    return made


def test_depths_match_the_shapes(folder):
    placed = open(folder / "bare" / "scene.xml")
    rays = people()
    expected = [first_box(o, d)[1] for o, d in zip(rays.origin, rays.direction)]
    assert np.allclose(placed.trace_depth(rays.origin, rays.direction), expected, rtol=1e-4) and placed.sampler is None


def test_gaze_field_of_the_scene_or_of_a_file(folder):
    d = np.array([[1.0, 0, 0], [0, 1, 0]])
    subset, beside = open(folder / "scene.xml"), open(folder / "bare" / "scene.xml", folder / "gaze.safetensors")
    eye = np.array([1.0, 1.0, 1.5])
    result, other = subset.sampler.query_from(eye)(d), beside.sampler.query_from(eye)(d)
    assert result[0].shape == (1, 2) and np.allclose(result[0], other[0], rtol=1e-4)
    assert np.allclose(result[1], subset.trace_depth(np.broadcast_to(eye, d.shape), d)) and np.allclose(
        result[1], other[1]
    )
    assert np.isnan(subset.sampler.support_at(eye))


def test_alignments(folder):
    matrix = np.diag([2.0, 2, 2, 1])
    matrix[:3, 3] = 1, 0, 0
    placed = open(folder / "scene.xml", align=matrix)
    assert placed.scale == pytest.approx(2) and placed.margin == pytest.approx(0.06)
    assert np.allclose(placed.environment.points_to_field(np.ones(3)), [3, 2, 2])
    assert np.allclose(placed.environment.directions_to_field(np.array([0, 0, 1.0])), [0, 0, 1])


def test_aois_occlude_each_other_without_geometry(rgb):
    placed = open(areas=(Region.create("sign", *SIGN), Region.create("stand", *STAND)))
    depth = placed.trace_depth(np.array([[0.0, 1.6, 1.5], [0, 2.4, 1.5]]), np.array([[1.0, 0, 0]] * 2))
    assert np.allclose(depth, (2.5, 4.0))


def test_scenes_without_surfaces_are_refused(folder):
    (folder / "empty.xml").write_text('<scene version="3.0.0"><integrator type="path"/></scene>')
    with pytest.raises(NergError, match="no shapes and no field"):
        open(folder / "empty.xml")


# ---- AOI geometry ----


def aois(areas, shapes):
    return make_aois(areas, shapes, read_meshes(Areas(tuple(areas)).meshes))


TWO = "v 1 0 0\nv 1 1 0\nv 1 0 1\nv 3 0 0\nv 3 1 0\nv 3 0 1\nf 1 2 3\nf 4 5 6\n"


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    path = write_place(tmp_path_factory.mktemp("place"), gaze=False)
    return Environment.open(path, keep_shapes=True).shapes


def test_aois_of_each_kind(shapes, tmp_path):
    (tmp_path / "two.obj").write_text(TWO)
    areas = [
        Region.create("box", *SIGN),
        MeshPart("both", tmp_path / "two.obj"),
        MeshPart("far", tmp_path / "two.obj", ((1, 1),)),
        SceneShape("stand", "stand"),
    ]
    made = aois(areas, shapes)
    assert [t.name for t in made] == ["box", "both", "far", "stand"] and [t.is_surface for t in made] == [
        False,
        True,
        True,
        True,
    ]
    o, d = np.array([[0.0, 0.2, 0.2], [0, 1.5, 1.5]]), np.tile([1.0, 0, 0], (2, 1))
    near = np.array([t.intersect(o, d)[0] for t in made])
    assert np.allclose(near[1:], [[1.0, np.inf], [3.0, np.inf], [np.inf, 2.5]])
    # The shapes of the scene keep their names.
    assert {shape.id() for shape in shapes.values()} == {"room", "sign", "stand"}


def test_sample_points_lie_on_the_surface(shapes, tmp_path):
    (tmp_path / "two.obj").write_text(TWO)
    both, stand = aois([MeshPart("m", tmp_path / "two.obj"), SceneShape("stand", "stand")], shapes)
    points, normals = both.sample_points(64)
    assert points.shape == (64, 3) and not normals.any()
    assert (np.isclose(points[:, 0], 1) | np.isclose(points[:, 0], 3)).all() and 20 < np.isclose(
        points[:, 0], 1
    ).sum() < 44
    points, _ = stand.sample_points(64)
    on = np.isclose(points, STAND[0], atol=1e-5) | np.isclose(points, STAND[1], atol=1e-5)
    assert on.any(axis=1).all() and (points > STAND[0] - 1e-5).all() and (points < STAND[1] + 1e-5).all()


def test_sphere_aoi():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    ball = aoi_from_shape("ball", mi.load_dict({"type": "sphere", "radius": 0.5, "center": [2, 0, 0]}))
    near, far = ball.intersect(np.zeros((1, 3)), np.array([[1.0, 0, 0]]))
    assert near == pytest.approx(1.5) and far == near
    points, _ = ball.sample_points(50)
    assert np.allclose(np.linalg.norm(points - (2, 0, 0), axis=1), 0.5, atol=1e-5)


def test_missing_shapes_and_faces_are_refused(shapes, tmp_path):
    with pytest.raises(NergError, match='"x"'):
        find_shape(shapes, "x")
    with pytest.raises(NergError, match="use a scene"):
        find_shape({}, "x")
    with pytest.raises(NergError, match="there is no mesh"):
        aois([MeshPart("m", tmp_path / "none.ply")], {})
    (tmp_path / "two.obj").write_text(TWO)
    with pytest.raises(NergError, match="face 2"):
        aois([MeshPart("m", tmp_path / "two.obj", ((0, 2),))], {})


def test_meshes_keep_their_names_in_a_scene():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mesh = make_mesh(np.eye(3), np.array([[0, 1, 2]]), "tri")
    before = mesh.id()
    assert len(scene_from_shapes({"tri": mesh}).shapes()) == 1 and mesh.id() == before


# ---- Hits, against loops over rays and planes ----


def box(name, lower, upper, turn=None):
    return BoxAoi(Region.create(name, lower, upper, turn))


def brute(region, o, d):
    """Interval of a ray in a box, by clipping at six planes in the frame of the box."""
    turn = region.rotation_matrix.T
    o, d = turn @ (np.array(o, float) - region.center), turn @ np.array(d, float)
    half = (region.corners[1] - region.corners[0]) / 2
    near, far = -np.inf, np.inf
    for axis in range(3):
        if d[axis] == 0:
            if abs(o[axis]) > half[axis]:
                return None
            continue
        a, b = (-half[axis] - o[axis]) / d[axis], (half[axis] - o[axis]) / d[axis]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return (near, far) if near < far and far > 0 else None


def some_rays(n=2000, seed=0):
    rng = np.random.default_rng(seed)
    o = rng.uniform(-3, 3, (n, 3))
    d = rng.normal(size=(n, 3))
    return o, d / np.linalg.norm(d, axis=1, keepdims=True), rng.uniform(0.2, 6, n)


def find_hits(*args):
    """Whether each sample hits each AOI (N, K)."""
    hits = assign_hits(*args)
    return np.stack([np.isin(np.arange(hits.count), rows) for rows in hits.rows], axis=1)


def test_hits_of_boxes():
    aois = [box("a", [-1, -1, -1], [1, 0.5, 1]), box("b", [0, 0, 0], [2, 1, 1], 35), box("c", [1.5, -2, -1], [2, 2, 0])]
    o, d, depth = some_rays()
    result = find_hits(aois, o, d, depth, 0.03)
    expected = np.zeros_like(result)
    for i in range(len(o)):
        for k, aoi in enumerate(aois):
            span = brute(aoi.region, o[i], d[i])
            if span is None:
                continue
            near, far = span
            expected[i, k] = near - 0.03 <= depth[i] < far + 0.03
    assert np.array_equal(result, expected) and 20 < expected.sum() and not expected.all(axis=1).all()
    inside = np.array([aoi.region.contains(o) for aoi in aois]).T
    assert (inside & expected).any() and (inside & ~expected).any()


def test_hit_distances():
    aois = [box("a", [1, -1, -1], [2, 1, 1]), box("around", [-1, -1, -1], [3, 1, 1])]
    o, d = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    landed = assign_hits(aois, o, d, np.array([1.7]))
    assert [v.tolist() for v in landed.distance] == [[1.0], [1.7]]
    # Rays that end behind a box or nowhere, from outside and from inside.
    assert [len(v) for v in assign_hits(aois, o, d, np.array([2.5])).rows] == [0, 1]
    assert [len(v) for v in assign_hits(aois, o, d, np.array([3.5])).rows] == [0, 0]
    assert [len(v) for v in assign_hits(aois, o, d, np.array([np.inf])).rows] == [0, 0]


def test_aois_are_solid_without_surfaces():
    front, behind, in_front = (
        box("f", [1, -1, -1], [2, 1, 1]),
        box("b", [3, -1, -1], [4, 1, 1]),
        box("i", [1.5, 0, 0], [2.5, 1, 1]),
    )
    o, d = np.array([[0, 0.5, 0.5], [0, -0.5, -0.5], [0, 5.0, 0]]), np.tile([1.0, 0, 0], (3, 1))
    result = find_hits([front, behind, in_front], o, d, None)
    # Overlapping AOIs are both hit; an AOI that starts behind the end of another is occluded.
    assert result.tolist() == [[True, False, True], [True, False, False], [False, False, False]]


def test_grazed_and_rear_boxes_are_missed():
    aoi = box("a", [1, 0, 0], [2, 1, 1])
    o = np.array([[0.0, 1, 0.5], [3, 0.5, 0.5], [0, 0.5, 0.5]])
    d = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    assert find_hits([aoi], o, d, np.array([1.5, 0.5, 1.5]))[1:, 0].tolist() == [False, True]


def test_areas_merge_their_members():
    aois = [box("a", [1, -1, -1], [2, 1, 1]), box("b", [1.5, 0, -1], [4, 1, 1])]
    o, d = np.array([[0, 0.5, 0.0], [0, -0.5, 0], [3, 0.5, -5]]), np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    landed = merge_members(assign_hits(aois, o, d, np.array([1.6, 1.0, 5.0])), [(0,), (1,), (0, 1)])
    assert [rows.tolist() for rows in landed.rows] == [[0, 1], [0, 2], [0, 1, 2]]
    assert landed.distance[2].tolist() == [1.0, 1.0, 4.0]


def test_hits_are_concatenated_and_merged():
    aois = [box("a", [1, -1, -1], [2, 1, 1])]
    o, d = np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]])
    one, two = assign_hits(aois, o, d, None), assign_hits(aois, o, d[::-1], None)
    assert concatenate_hits([one, two]).rows[0].tolist() == [0, 3]
    assert merge_directions([one, two]).rows[0].tolist() == [0, 1]


@pytest.mark.parametrize("degrees", [0.5, 2.0, 10.0])
def test_cone_has_no_wide_gaps(degrees):
    d = np.array([[0, 0, 1.0], [0, 0, -1], [0.6, 0, 0.8], [0.36, -0.48, -0.8]])
    directions = np.stack(sample_cone(d, degrees))
    assert len(directions) == 19 and np.allclose(np.linalg.norm(directions, axis=2), 1)
    angle = np.degrees(np.arccos(np.clip((directions * d).sum(axis=2), -1, 1)))
    assert np.allclose(angle[0], 0, atol=1e-5) and np.allclose(angle[1:7], degrees / 2, rtol=1e-3)
    assert np.allclose(angle[7:], degrees, rtol=1e-3)
    rng = np.random.default_rng(0)
    for k in range(len(d)):
        u = np.cross(d[k], [1, 0.3, 0.2])
        u /= np.linalg.norm(u)
        v = np.cross(d[k], u)
        r, turn = np.radians(degrees) * np.sqrt(rng.random(500)), 2 * np.pi * rng.random(500)
        within = np.cos(r)[:, None] * d[k] + np.sin(r)[:, None] * (
            np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v
        )
        nearest = np.degrees(np.arccos(np.clip(within @ directions[:, k].T, -1, 1)).min(axis=1))
        assert nearest.max() < 0.5 * degrees


def test_sample_points_cover_a_box():
    aoi = box("a", [0, 0, 0], [2, 1, 0.5], 20)
    points, normals = aoi.sample_points(70)
    subset = aoi.region.to_local(points)
    lower, upper = aoi.region.corners
    on_face = np.isclose(subset, lower) | np.isclose(subset, upper)
    assert (on_face.sum(axis=1) == 1).all() and ((subset > lower - 1e-9) & (subset < upper + 1e-9)).all()
    assert np.allclose(((points - aoi.region.center) * normals).sum(axis=1) > 0, True)
    assert 40 < len(points) < 110
