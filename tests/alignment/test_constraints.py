"""Tests of `nerg_mi.alignment.constraints`."""

import gzip

import numpy as np
import pytest
import trimesh
from scipy.interpolate import RegularGridInterpolator

from nerg_mi.alignment.constraints import (
    AlignmentTarget,
    DistanceGrid,
    SceneTraces,
    angles_between,
    downsample,
    pair_covariance,
    read_surface,
    surface_from_points,
    surface_from_traces,
    trace_scene,
)
from nerg_mi.alignment.similarity import LocalSimilarity, fit_similarity, turn_between
from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.maths.transforms import similarity_scale
from tests.refusals import mentions

from . import rooms
from .rooms import carried, similarity

# ---- Evidence ----


def test_angles_from_a_viewpoint():
    at, to = np.array([[1.0, 0, 0], [0, 2, 0]]), np.array([[1.0, 1, 0], [0, 2, 2e-7]])
    np.testing.assert_allclose(angles_between(np.zeros(3), at, to), [45, np.degrees(1e-7)], rtol=1e-6)


def test_covariance_matches_many_fits():
    rng = np.random.default_rng(0)
    truth, x, noise = similarity(rng, scale=2.0), rng.normal(size=(12, 3)), 0.02
    exact = carried(truth, x)
    draws = [fit_similarity(x, exact + rng.normal(0, noise, x.shape)) for _ in range(2000)]
    scales = np.log([similarity_scale(m) for m in draws])
    middle = np.array([carried(m, x.mean(axis=0)[None])[0] for m in draws])
    y = exact + rng.normal(0, noise, x.shape)
    matrix = fit_similarity(x, y)
    center = carried(matrix, x.mean(axis=0)[None])[0]
    stated = [
        pair_covariance(x, exact + rng.normal(0, noise, x.shape), LocalSimilarity(matrix, center)) for _ in range(50)
    ]
    mean = np.mean(stated, axis=0)
    assert np.sqrt(mean[6, 6]) == pytest.approx(scales.std(), rel=0.25)
    np.testing.assert_allclose(np.sqrt(np.diag(mean)[3:6]), middle.std(axis=0), rtol=0.3)
    assert pair_covariance(x[:2], y[:2], LocalSimilarity(truth, center)) is None


def test_constraints_hold_near_a_constrained_similarity():
    rng = np.random.default_rng(1)
    base, x = similarity(rng, upright=True), rng.normal(size=(5, 3))
    on_floor = np.array([1.0, 2.0, base[2, 3]])
    m = AlignmentTarget().parametrize(base, on_floor, True)
    m = m.matrix(rng.normal(size=m.size))
    np.testing.assert_allclose(m[:3, 2] / similarity_scale(m), [0, 0, 1], atol=1e-12)
    assert m[2, 3] == pytest.approx(base[2, 3])
    shift = np.array([3.0, -1, 2])
    for constraints in ({"turn": 0.4}, {"scale": 1.5, "shift": shift}, {"turn": -0.4, "shift": shift}):
        target = AlignmentTarget(**constraints)
        start = target.constrain(base, x)
        chart = target.parametrize(start, np.ones(3))
        for m in (start, chart.matrix(rng.normal(0, 0.5, chart.size))):
            assert target.scale in (None, pytest.approx(similarity_scale(m)))
            assert target.turn in (None, pytest.approx(turn_between(np.eye(4), m)))
            assert target.shift is None or np.allclose(m[:3, 3], shift)
    assert np.allclose(
        carried(AlignmentTarget(turn=0.4).constrain(base, x), x).mean(axis=0), carried(base, x).mean(axis=0)
    )
    assert np.allclose(AlignmentTarget().constrain(base, x), base)


def test_missing_geometry_is_refused():
    with pytest.raises(NergError, check=mentions("environment")):
        _ = AlignmentTarget().surface


# ---- Grid ----

GRID = DistanceGrid(np.random.default_rng(0).random((6, 7, 5)), np.array([-1.0, 0, 2]), 0.5)


def test_interpolation_is_trilinear():
    axes = [GRID.lower[a] + GRID.step * np.arange(n) for a, n in enumerate(GRID.values.shape)]
    p = np.random.default_rng(1).uniform(GRID.lower, GRID.upper, (300, 3))
    np.testing.assert_allclose(GRID.interpolate(p), RegularGridInterpolator(axes, GRID.values)(p), atol=1e-12)
    # Beyond it the distance to it is added, and a lattice of one layer has no slope across.
    p = GRID.upper + np.array([[3.0, 4, 0], [0, 0, 2]])
    np.testing.assert_allclose(GRID.interpolate(p), GRID.values[-1, -1, -1] + np.array([5, 2]))
    value, slope = DistanceGrid(np.arange(4.0).reshape(4, 1, 1), np.zeros(3), 1.0).interpolate_with_gradient(
        np.array([[1.5, 0, 0]])
    )
    assert value[0] == pytest.approx(1.5) and slope[0].tolist() == [1, 0, 0]


def test_gradients_match_central_differences():
    p = np.random.default_rng(2).uniform(GRID.lower - 1, GRID.upper + 1, (500, 3))
    slope = GRID.interpolate_with_gradient(p)[1]
    for a, e in enumerate(1e-7 * np.eye(3)):
        np.testing.assert_allclose(slope[:, a], (GRID.interpolate(p + e) - GRID.interpolate(p - e)) / 2e-7, atol=1e-6)


# ---- Point file ----


def test_points_are_uniform_on_triangles(tmp_path):
    v = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [10, 0, 0], [10.0, 1, 0], [10, 0, 1]])
    write_columns(tmp_path / "a.ply", dict(zip("xyz", v.T)), np.array([[0, 1, 2], [3, 4, 5]]))
    trimesh.Trimesh(v, [[0, 1, 2], [3, 4, 5]], process=False).export(tmp_path / "a.obj")
    for name in ("a.ply", "a.obj"):
        p = read_surface(tmp_path / name, 5000)
        small = p[:, 0] > 5
        assert len(p) == 5000 and small.mean() == pytest.approx(0.1, abs=0.02)
        assert np.abs(p[~small, 2]).max() == 0 and (p[~small, :2].sum(axis=1) <= 3 + 1e-9).all()
        np.testing.assert_array_equal(p, read_surface(tmp_path / name, 5000))


def test_point_files_are_read(tmp_path):
    p = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    write_columns(tmp_path / "a.ply", dict(zip("xyz", p.T)))
    np.save(tmp_path / "a.npy", p)
    (tmp_path / "a.csv").write_text("x,y,z\n" + "".join(f"{a},{b},{c}\n" for a, b, c in p.tolist()) + "nan,1,2\n")
    head = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std\n"
    rows = "".join(f"{k},g,{x},{y},{z},0.001,0.01\n" for k, (x, y, z) in enumerate(p.tolist()))
    (tmp_path / "s.csv.gz").write_bytes(gzip.compress((head + rows).encode()))
    for name in ("a.ply", "a.npy", "a.csv", "s.csv.gz"):
        np.testing.assert_allclose(read_surface(tmp_path / name), p, atol=1e-6)
    assert len(read_surface(tmp_path / "a.npy", 10)) == 10


@pytest.mark.parametrize(
    "name, data, why",
    [
        ("a.txt", b"", "not a supported surface file"),
        ("a.ply", b"ply\nno", "no PLY header"),
        ("a.obj", b"", "no vertices"),
        ("a.csv", b"x,y,z\n", "no points"),
        ("a.csv", b"a,b\n1,2\n", "x"),
        ("a.csv", b"x,y,z\n1,2,3\n1,2,3,4,5\n", "line 3: 5 cells, the header has 3"),
        ("a.csv", b"x,y,z\n0,0,0\n1,1.1e7,0\n", "the points of .*a.csv.* must have coordinates from"),
        ("a.csv", b"x,y,z\n0,0,0\n1,1e308,0\n", "the points of .*a.csv.* must have coordinates from"),
        ("a.npy", None, r"shape \(3, 2\)"),
        ("a/no.ply", None, "does not exist"),
    ],
)
def test_invalid_files_are_refused(tmp_path, name, data, why):
    if data is None:
        np.save(tmp_path / "a.npy", np.zeros((3, 2)))
    else:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(NergError, match=why):
        read_surface(tmp_path / name)


# ---- Surface ----


@pytest.fixture(scope="module")
def surface():
    return surface_from_traces(rooms.traces(), 1 << 17)


def exact(points):
    """Distance to the nearest wall or face of a block."""
    out = np.minimum(points, rooms.SIZE - points).min(axis=1)
    for low, high in rooms.BOXES:
        out = np.minimum(out, np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1))
    return out


def test_distances_to_surfaces(surface):
    p = np.random.default_rng(0).uniform(0, rooms.SIZE, (4000, 3))
    p = p[rooms.free(p)]
    off = np.abs(surface.distance.interpolate(p) - exact(p))
    assert np.median(off) < 0.5 * surface.step and np.percentile(off, 95) < 1.5 * surface.step


def test_free_space_distance(surface):
    p = np.random.default_rng(1).uniform(0, rooms.SIZE, (4000, 3))
    blocked = surface.free_space_distance.interpolate(p)
    deep = ~rooms.free(p, -2 * surface.step)
    assert surface.has_free_space and (blocked[deep] > 0).mean() > 0.97
    assert (blocked[rooms.free(p, 1.5 * surface.step)] == 0).mean() > 0.99


def test_pockets_are_not_free_space():
    room, block = rooms.traces(80_000), rooms.BOXES[0]
    rng = np.random.default_rng(2)
    begin = rng.uniform(*block, (4000, 3))
    along = rooms.directions(4000, rng)
    to_wall = np.where(along > 0, (block[1] - begin) / along, (block[0] - begin) / along).min(axis=1)
    both = SceneTraces(
        np.concatenate([room.start, begin]),
        np.concatenate([room.end, begin + along * to_wall[:, None]]),
        np.ones(len(room.is_hit) + 4000, bool),
    )
    result = surface_from_traces(both, 1 << 16)
    middle = block.mean(axis=0)[None]
    assert result.free_space_distance.interpolate(middle)[0] > 0.2


def test_floor_height_is_estimated(surface):
    assert surface.find_floor() == pytest.approx(0, abs=0.5 * surface.step)


def test_bare_points_have_no_free_space():
    points = rooms.traces().end
    result = surface_from_points(points, 1 << 15)
    assert not result.has_free_space and result.distance.interpolate(points[:500]).max() < 2 * result.step
    with pytest.raises(NergError, match="99 points"):
        surface_from_points(np.zeros((99, 3)))
    with pytest.raises(NergError, match="coincide"):
        surface_from_points(np.zeros((200, 3)))


def test_downsampled_points_are_voxel_means():
    p = np.array([[0.0, 0, 0], [0.2, 0, 0], [1.1, 0, 0]])
    np.testing.assert_allclose(downsample(p, 1.0), [[0.1, 0, 0], [1.1, 0, 0]])


class _EmptyGeometry:
    pass


def test_scene_without_surfaces_is_refused(monkeypatch):
    monkeypatch.setattr(
        "nerg_mi.alignment.constraints.trace_depth", lambda s, o, d: (np.zeros(len(o)), np.zeros(len(o)))
    )
    with pytest.raises(NergError, match="meet no surface"):
        trace_scene(_EmptyGeometry(), np.zeros(3), np.ones(3), 1000)  # pyright: ignore[reportArgumentType] # traced by nothing
