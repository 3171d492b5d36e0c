"""Tests of `nerg_mi.maths.geometry`."""

from dataclasses import replace
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.alignment.constraints import read_surface
from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import read_splats
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.maths.geometry import Box, ContractedBox, Similarity, box_from_dict, intersect_box, intersect_box_numpy
from nerg_mi.photos.posed import PosedFrame, sort_frames
from nerg_mi.tracking.readers.base import UNITY, RaysBuilder
from tests.formats.splats.writers import random_splats, write_antimatter, write_inria, write_khronos
from tests.reference import march_numpy as reference

# ---- The box of a field and its map to the unit cube ----

BOX = Box((-1, 0, 2), (3, 2, 3))


def test01_box_measures():
    assert BOX.side == 4 and BOX.center == (1, 1, 2.5) and np.isclose(BOX.diagonal, 21**0.5)
    assert BOX.to_dict() == {"lower": [-1, 0, 2], "upper": [3, 2, 3]} and Box(**BOX.to_dict()) == BOX


def test02_unit_cube_map_uses_one_scale():
    p = np.array([[-1, 0, 2], [3, 2, 3], [1, 1, 2.5]], float)
    expected = [[0, 0.25, 0.375], [1, 0.75, 0.625], [0.5, 0.5, 0.5]]
    assert np.allclose(BOX.to_unit(p), expected)
    assert np.allclose(np.array(BOX.to_unit(ns.Array3f(p.T))).T, expected, atol=1e-7)


@pytest.mark.parametrize("factor", [1e-3, 1, 1e6])
def test03_corners_map_into_the_cube(factor):
    # A corner that rounding moves out of the cube would lose its features.
    rng = np.random.default_rng(0)
    for _ in range(30):
        lower = rng.normal(size=3) * factor
        box = Box(lower, lower + rng.random(3) * factor)
        longest = int(np.argmax(np.subtract(box.upper, box.lower)))
        u = np.array(box.to_unit(ns.Array3f(np.array([box.lower, box.upper]).T))).T
        assert np.allclose(u[:, longest], [0, 1], atol=1e-5)


def test04_contains():
    p = np.array([[-1, 0, 2], [3, 2, 3], [1, 1, 2.5], [1, 1, 3.001], [-1.001, 1, 2.5], [np.nan, 1, 2.5]])
    assert BOX.contains(ns.Array3f(p.T)).numpy().tolist() == [True, True, True, False, False, False]


@pytest.mark.parametrize(
    "lower, upper, words",
    [
        ((0, 0, 0), (1, 1, 0), "must exceed"),
        ((0, 0), (1, 1), "3 numbers"),
        ((0, 0, 0), (1, 1, np.inf), "finite"),
        ((0, 0, np.nan), (1, 1, 1), "finite"),
        ((2, 0, 0), (1, 1, 1), "must exceed"),
    ],
)
def test05_invalid_corners_are_refused(lower, upper, words):
    with pytest.raises(ValueError, match=words):
        Box(lower, upper)


# ---- The contraction against its formula in float64, and its inverse ----

CORE = Box((-1.0, 2.0, -0.5), (3.0, 5.0, 1.5))


def points(rgb, p):
    return rgb.Array3f(np.asarray(p, np.float32).T)


@pytest.fixture
def rgb_contraction():
    import drjit.llvm.ad as ns

    return ns


def expected(p, box):
    x = (np.asarray(p, float) - box.center) * 2 / box.side
    m = np.abs(x).max(axis=1, keepdims=True)
    return np.where(m <= 1, x, (2 - 1 / np.maximum(m, 1)) * x / np.maximum(m, 1)) / 4 + 0.5


def test_contraction_matches_formula_and_inverts(rgb_contraction):
    box, rng = ContractedBox(CORE, 64), np.random.default_rng(0)
    away = rng.normal(size=(2000, 3))
    p = box.center + away / np.abs(away).max(axis=1, keepdims=True) * np.geomspace(1e-3, 120, 2000)[:, None]
    u = box.to_unit(points(rgb_contraction, p))
    np.testing.assert_allclose(u.numpy().T, expected(p, box), atol=3e-7)
    back = box.from_unit(u).numpy().T
    # Near the far end, a floating-point spacing of u is m² / 2 spacings of the position.
    m = np.maximum(np.abs((p - box.center) * 2 / box.side).max(axis=1), 1)
    assert np.all(np.abs(back - p).max(axis=1) <= 4e-6 * m**2)


def test_contraction_is_linear_inside_the_inner_cube(rgb_contraction):
    box = ContractedBox(CORE, 8)
    p = np.random.default_rng(1).uniform(CORE.lower, CORE.upper, (500, 3))
    u = box.to_unit(points(rgb_contraction, p)).numpy().T
    np.testing.assert_allclose((u - 0.5) * 2 * box.side + box.center, p, atol=2e-6)
    assert np.all(box.distance_scale(points(rgb_contraction, p)).numpy() == 1)


def test_contracted_box_bounds_and_linear_cube(rgb_contraction):
    box = ContractedBox(CORE, 8)
    assert box.side == 4 and box.cube_side == 32 and box.diagonal == pytest.approx(32 * 3**0.5)
    assert box.lower == (-15, -12.5, -15.5) and box.upper == (17, 19.5, 16.5)
    inside = box.contains(points(rgb_contraction, [box.center, [16.9, 19.4, 16.4], [17.1, 0, 0]]))
    assert inside.numpy().tolist() == [True, True, False]
    corners = box.to_cube(points(rgb_contraction, [box.lower, box.upper])).numpy().T
    np.testing.assert_allclose(corners, [[0, 0, 0], [1, 1, 1]], atol=1e-6)
    # Encoded positions beyond the outer cube map to its face.
    assert box.contains(box.from_unit(rgb_contraction.Array3f(0.99999, 0.5, 0.5))).numpy().all()


def test_contracted_box_dict_round_trip():
    for box in (ContractedBox(CORE, 16), CORE, Box((-1, -1, -1), (1, 1, 1), 2.0)):
        assert box_from_dict(box.to_dict()) == box


@pytest.mark.parametrize("reach", [1, 3, 0.5, float("nan"), float("inf"), 2**13])
def test_outer_scale_must_be_a_power_of_two(reach):
    with pytest.raises(ValueError, match="power of two"):
        ContractedBox(CORE, reach)


def test_core_with_bound_is_refused():
    with pytest.raises(ValueError, match="bound of its own"):
        ContractedBox(Box((-1, -1, -1), (1, 1, 1), 2.0))


# ---- The slab tests against float64, on ordinary and degenerate rays ----

LOWER, UPPER = (-1, 0, 2), (3, 2, 4)


def intersect(o, d, lower=LOWER, upper=UPPER):
    """The result of both slab tests, which must agree."""
    o, d = np.atleast_2d(np.asarray(o, np.float32)), np.atleast_2d(np.asarray(d, np.float32))
    near, far = intersect_box(ns.Array3f(o.T), ns.Array3f(d.T), lower, upper)
    near, far = np.broadcast_to(near.numpy(), len(o)), np.broadcast_to(far.numpy(), len(o))
    first, last = intersect_box_numpy(o.astype(float), d.astype(float), lower, upper)
    scale, hit = np.abs(upper).max(), near < far
    with np.errstate(invalid="ignore"):
        clear = np.abs(far - near) > 1e-4 * scale
    assert np.array_equal((first < last)[clear], hit[clear])
    for float64, float32 in ((first, near), (last, far)):
        assert np.allclose(float64[hit], float32[hit], rtol=1e-4, atol=1e-5 * scale)
    return near, far


@pytest.mark.parametrize("scale", [1e-3, 1, 1e6])
def test01_random_rays(scale):
    rng = np.random.default_rng(0)
    o = (rng.uniform((-3, -1, 0), (5, 3, 6), (500, 3)) * scale).astype(np.float32)
    d = rng.normal(size=(500, 3))
    d = (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)
    d[:100, 0] = 0
    d[50:120, 2] = 0
    lower, upper = np.multiply(LOWER, scale), np.multiply(UPPER, scale)
    near, far = intersect(o, d, lower, upper)
    hits = 0
    for i in range(500):
        expected = reference.box(o[i].astype(float), d[i].astype(float), lower, upper)
        if expected is None:
            assert near[i] >= far[i]
        else:
            hits += 1
            assert np.allclose([near[i], far[i]], expected, rtol=1e-5, atol=1e-5 * scale)
    assert 100 < hits < 400
    assert not np.any(np.isnan(near) | np.isnan(far))


@pytest.mark.parametrize(
    "o, d, expected",
    [
        ((1, 1, 0), (0, 0, 1), (2, 4)),  # along an axis
        ((1, 1, 3), (0, 0, 1), (-1, 1)),  # from inside
        ((1, 1, 6), (0, 0, -1), (2, 4)),  # backwards
        ((1, 1, 2), (0, 0, 1), (0, 2)),  # from on a face
        ((-1, 0, 2), (0, 0, 1), (0, 2)),  # along an edge, which belongs to the box
        ((-1, 1, 0), (0, 0, 1), (2, 4)),  # in the plane of a face
        ((1, 1, 0), (-0.0, -0.0, 1), (2, 4)),  # negative zeros
    ],
)
def test02_parallel_rays(o, d, expected):
    near, far = intersect(o, d)
    assert (near[0], far[0]) == expected


@pytest.mark.parametrize(
    "o, d",
    [((5, 1, 0), (0, 0, 1)), ((1, -1e-6, 3), (1, 0, 0)), ((-1.0001, 1, 0), (0, 0, 1)), ((1, 1, 5), (0.6, 0.8, 0))],
)
def test03_misses(o, d):
    near, far = intersect(o, d)
    assert near[0] >= far[0] and not np.isnan(near[0]) and not np.isnan(far[0])


def test06_tiny_components_do_not_overflow_into_nan():
    near, far = intersect([(1, 1, 0)] * 3, [(1e-30, 0, 1), (1e-38, 1e-38, 1), (-1e-38, 1e-42, 1)])
    assert np.allclose(near, 2) and np.allclose(far, 4)


# ---- Placement of a field in a scene: similarities are accepted, other transforms refused ----


def turn(scale=1.0, angle=40, move=(1, -2, 3)):
    axis = np.array([0.6, 0.0, 0.8])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    a = np.radians(angle)
    m = np.eye(4)
    m[:3, :3] = scale * (np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k)
    m[:3, 3] = np.multiply(move, scale)
    return m


@pytest.mark.parametrize("scale", [1e-3, 1, 1e3])
def test01_similarity(rgb, scale):
    m = turn(scale)
    s = Similarity(m)
    p = np.array([0.3, -0.2, 0.9])
    world = m @ [*p, 1]
    assert np.isclose(s.scale, scale) and not s.is_identity
    assert np.allclose(np.array(s.point_to_local(rgb.Point3f(world[:3].tolist()))).ravel(), p, atol=2e-6)
    w = m[:3, :3] @ p
    assert np.allclose(np.array(s.vector_to_local(rgb.Vector3f(w.tolist()))).ravel(), p, rtol=1e-5, atol=1e-6)
    unit = w / np.linalg.norm(w)
    assert np.allclose(
        np.array(s.direction_to_local(rgb.Vector3f(unit.tolist()))).ravel(), p / np.linalg.norm(p), atol=1e-6
    )


def test02_bounds_contain_the_corners():
    m = turn(2.0)
    lower, upper = Similarity(m).bounds((0, 0, 0), (1, 1, 2))
    corners = np.array([m[:3] @ [x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 2)])
    assert np.allclose(lower, corners.min(0)) and np.allclose(upper, corners.max(0))


@pytest.mark.parametrize(
    "row, column, value",
    [
        (0, 1, 0.3),  # a shear
        (2, 2, 1.5),  # non-uniform
        (0, 0, -1),  # a reflection
        (1, 1, 0),  # singular
        (0, 0, np.nan),
        (3, 0, 0.5),  # projective
        (0, 3, np.nan),
        (1, 3, -1.1e7),
    ],
)
def test03_non_similarities_are_refused(row, column, value):
    matrix = np.eye(4)
    matrix[row, column] = value
    with pytest.raises(ValueError, match='"to_world"'):
        Similarity(matrix)


def test03_rounding_errors_are_removed():
    """Files have matrices with few decimals; those of double precision are not changed."""
    exact = turn(2.0)
    assert np.array_equal(Similarity(exact).matrix, exact)
    rounded = Similarity(np.round(exact, 2))
    np.testing.assert_allclose(rounded.matrix, exact, atol=0.01)
    linear = rounded.matrix[:3, :3] / rounded.scale
    np.testing.assert_allclose(linear @ linear.T, np.eye(3), atol=1e-9)
    with pytest.raises(ValueError, match="transposed"):
        Similarity(np.eye(4) + np.eye(4, k=-3))
    with pytest.raises(ValueError, match="shape"):
        Similarity(np.eye(3))


def test04_identity_returns_its_argument(rgb):
    p = rgb.Point3f(1, 2, 3)
    s = Similarity()
    assert s.is_identity and s.scale == 1 and s.point_to_local(p) is p and s.direction_to_local(p) is p


# ---- Survey coordinates are refused by all readers, with the offset to subtract ----

ROOM = np.random.default_rng(0).uniform((0, 0, 0), (6, 4, 3), (200, 3))
UTM = (500_000.0, 5_600_000.0, 0.0)


def read_points(path: Path, points: np.ndarray) -> None:
    np.save(path / "a.npy", points)
    read_surface(path / "a.npy")


def read_cloud(path: Path, points: np.ndarray) -> None:
    write_columns(path / "a.ply", dict(zip("xyz", points.T)))
    read_surface(path / "a.ply")


def read_rays(path: Path, points: np.ndarray) -> None:
    builder = RaysBuilder(UNITY)
    builder.begin_source(Path(__file__))
    # Unity: y up, left-handed; the offset is given in the file's own coordinates.
    builder.add(
        np.arange(len(points)), "ann", points, np.tile([1.0, 0, 0], (len(points), 1)), rows=np.arange(len(points))
    )
    builder.build()


def read_cameras(path: Path, points: np.ndarray) -> None:
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, 3] = points
    sort_frames(path / "a.json", [PosedFrame(f"{k}", path / f"{k}", pose, {}) for k, pose in enumerate(poses)], [])


def splats_by(name, write):
    def read(path: Path, points: np.ndarray) -> None:
        write(path / name, replace(random_splats(200, 0), centers=points))
        read_splats(path / name)

    return read


READERS = {
    "points": read_points,
    "cloud": read_cloud,
    "rays": read_rays,
    "cameras": read_cameras,
    "splats .ply": splats_by("a.ply", write_inria),
    "splats .splat": splats_by("a.splat", write_antimatter),
    "splats .glb": splats_by("a.glb", write_khronos),
}


@pytest.mark.parametrize("kind", READERS)
def test_readers_refuse_distant_coordinates(tmp_path, kind):
    READERS[kind](tmp_path, ROOM)
    with pytest.raises(NergError, match="subtract 500000,5600000,0 from it"):
        READERS[kind](tmp_path, ROOM + UTM)


@pytest.mark.parametrize(
    "points, refused",
    [
        (ROOM + (19_000, 0, 0), False),
        (ROOM + (0, -21_000, 0), True),
        (1000 * ROOM + 30_000, False),
        (1e6 * ROOM, False),
        (1e-4 * ROOM, False),
        (ROOM[:1] + (4_027_000, 307_000, 4_919_000), True),
        (np.vstack([ROOM, np.full((1, 3), np.nan), np.full((1, 3), 1e9)]), False),
        (np.zeros((0, 3)), False),
    ],
)
def test_small_data_far_from_origin_is_refused(points, refused):
    if not refused:
        check_near_origin(points, "it")
        return
    with pytest.raises(NergError, match="single precision"):
        check_near_origin(points, "it")
