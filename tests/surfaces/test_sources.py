"""Tests of `nerg_mi.surfaces.sources`."""

import dataclasses

import drjit as dr
import numpy as np
import pytest
from scipy.special import eval_legendre
from scipy.stats import norm

from nerg_mi.errors import NergError
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.surfaces.laplacian import merge_sums
from nerg_mi.surfaces.mesh import SurfaceTarget, refine
from nerg_mi.surfaces.sources import (
    GazeSumSettings,
    RaySettings,
    TrackedRays,
    blur_density,
    cluster_observers,
    iter_visible_pieces,
    ray_durations,
    ray_weights,
    sample_cone,
    solid_angles,
    sphere_quadrature,
    subdivide_faces,
    sum_gaze,
    sum_rays,
)
from nerg_mi.tracking.rays import Rays
from tests.surfaces.meshes import box, joined, observers_from_law, plate, vmf

# ---- Cones, against Legendre polynomials and the Rayleigh distribution ----


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_cone_scales_spherical_harmonics(rgb, degree):
    sigma = 0.2
    d = rgb.Vector3f(fibonacci_directions(500).T.astype(np.float32))
    # Zonal harmonics about an arbitrary axis, written out because Dr.Jit lacks them.
    zonal = {
        0: lambda x: x * 0 + 1,
        1: lambda x: x,
        2: lambda x: 1.5 * x * x - 0.5,
        3: lambda x: 2.5 * x * x * x - 1.5 * x,
    }
    axis = dr.normalize(rgb.Vector3f(0.3, -0.5, 0.8))

    def density(u):
        # Fields use single precision only.
        assert isinstance(u, rgb.Vector3f)
        return zonal[degree](dr.dot(u, axis))

    result = np.array(blur_density(density, d, sigma))
    expected = 0.5 * (1 + eval_legendre(degree, np.cos(2 * sigma))) * np.array(zonal[degree](dr.dot(d, axis)))
    assert np.allclose(result, expected, atol=1e-5)


def test_cone_matches_heat_to_fourth_order():
    for sigma in (0.02, 0.04):
        for degree in (1, 5, 12):
            rule = 0.5 * (1 + eval_legendre(degree, np.cos(2 * sigma)))
            # In the tangent plane the harmonic of degree l is approximately a wave with the wave number l + 1/2.
            assert abs(rule - np.exp(-degree * (degree + 1) * sigma**2 / 2)) < 2 * (degree + 1) ** 4 * sigma**4 / 24


def test_cone_samples_are_gaussian_and_reproducible():
    d = fibonacci_directions(400)
    out = sample_cone(d, 0.05, 64, np.random.default_rng(3))
    assert out.shape == (400, 64, 3) and np.allclose(np.linalg.norm(out, axis=2), 1)
    angle = np.arccos(np.clip(np.einsum("nik,nk->ni", out, d), -1, 1)).ravel()
    for share in (0.1, 0.5, 0.9):
        assert abs(np.quantile(angle, share) / (0.05 * np.sqrt(-2 * np.log1p(-share))) - 1) < 0.01
    assert np.linalg.norm(out.mean(axis=1) - d, axis=1).mean() < 0.01
    assert np.array_equal(out, sample_cone(d, 0.05, 64, np.random.default_rng(3)))
    assert np.array_equal(sample_cone(d, 0, 2, np.random.default_rng(0)), np.repeat(d[:, None], 2, axis=1))


# ---- Gaze on surfaces: conservation, and agreement with `nerg.attention` ----

ROOM = box((0, 0, 0), (4, 3, 2.5))
SHELF = box((1.5, 2, 0), (3, 2.4, 1.8))
SETTINGS = GazeSumSettings()
MEAN = np.array([0.84, 0.5, -0.2]) / np.linalg.norm([0.84, 0.5, -0.2])


@pytest.mark.parametrize(("kappa", "eye"), [(1.0, (1.0, 0.7, 1.5)), (500.0, (0.001, 1.3, 1.2))])
def test_closed_room_receives_all_gaze(rgb, kappa, eye):
    """Also for an observer one millimetre from a wall."""
    target = SurfaceTarget(refine(joined(ROOM, SHELF), 0.4).mesh)
    sums = sum_gaze(target, observers_from_law(vmf(rgb, MEAN, kappa)), np.array([eye]), [1.0], SETTINGS)
    assert abs(sums.total - 1) < 3e-4 and sums.escaped == 0 and sums.elsewhere == 0
    assert abs(sums.unaccounted) < 1e-3
    assert np.isclose(sums.vertex_sums.sum(), sums.face_sums.sum(), rtol=1e-12)


@pytest.mark.parametrize(("y", "kappa"), [(0.7, 500.0), (0.69, 5000.0)])
def test_surface_occluder_and_escaped_shares(rgb, y, kappa):
    """Compared with an independent sum in double precision, also for narrow densities on an outline along the
    cuts of a wall included."""
    for without in (None, 1):
        room = joined(box((0, 0, 0), (4, 3, 2.5), without))
        sums = sum_gaze(
            SurfaceTarget(room, [SHELF]),
            observers_from_law(vmf(rgb, MEAN, kappa)),
            np.array([(1.0, y, 1.5)]),
            [2.0],
            SETTINGS,
        )
        exact = _shares(kappa, np.array([1.0, y, 1.5]), without is not None)
        result = np.array([sums.on_surface, sums.elsewhere, sums.escaped]) / 2
        assert np.abs(result - exact).max() < 1.2e-3 and abs(sums.unaccounted) < 1e-3 * sums.total and sums.weight == 2


def _shares(kappa: float, eye: np.ndarray, window: bool, count: int = 1 << 17) -> np.ndarray:
    """The share of the density on room, shelf and window: slab tests along directions of equal probability."""
    i, side = np.arange(count), np.cross(MEAN, [0, 0, 1]) / np.linalg.norm(np.cross(MEAN, [0, 0, 1]))
    cos = 1 + np.log1p((i + 0.5) / count * np.expm1(-2 * kappa)) / kappa
    turn, sin = 2 * np.pi * (i * (np.sqrt(5) - 1) / 2 % 1), np.sqrt(1 - cos**2)
    d = (
        cos[:, None] * MEAN
        + (sin * np.cos(turn))[:, None] * side
        + (sin * np.sin(turn))[:, None] * np.cross(MEAN, side)
    )
    ends = (np.array([(1.5, 2, 0), (3, 2.4, 1.8)])[:, None] - eye) / d
    shelf = (ends.min(axis=0).max(axis=1) < ends.max(axis=0).min(axis=1)) & (ends.min(axis=0).max(axis=1) > 0)
    wall = ((np.array([(0, 0, 0), (4, 3, 2.5)])[:, None] - eye) / d).max(axis=0).argmin(axis=1)
    out = ~shelf & (wall == 0) & (d[:, 0] > 0) & window
    return np.array([1 - shelf.mean() - out.mean(), shelf.mean(), out.mean()])


def test_uniform_gaze_gives_solid_angles(rgb):
    uniform = lambda d: dr.full(rgb.Float, 1 / (4 * np.pi), dr.width(d))
    target, eye = SurfaceTarget(joined(ROOM)), np.array([(1.0, 0.7, 1.5)])
    for cone in (0.0, 0.03):
        sums = sum_gaze(
            target, observers_from_law(uniform), eye, [1.0], GazeSumSettings(max_angle=0.1, cone_sigma=cone)
        )
        floor = sums.face_sums[(target.mesh.corners[:, :, 2] == 0).all(axis=1)].sum()
        # Solid angle of a rectangle, by the four rectangles between the foot point and its corners.
        x, y, h = np.array([1.0, 3.0]), np.array([0.7, 2.3]), 1.5
        exact = sum(np.arctan2(a * b, h * np.sqrt(a * a + b * b + h * h)) for a in x for b in y)
        assert np.isclose(floor, exact / (4 * np.pi), rtol=1e-4)


def test_cone_widens_gaze_and_keeps_its_total(rgb):
    target, eye = SurfaceTarget(refine(joined(ROOM), 0.2).mesh), np.array([(2.0, 1.5, 1.2)])
    law, cone = observers_from_law(vmf(rgb, (1, 0.1, 0), 400.0)), 0.026
    plain = sum_gaze(target, law, eye, [1.0], SETTINGS)
    wide = sum_gaze(target, law, eye, [1.0], dataclasses.replace(SETTINGS, cone_sigma=cone))
    # A vMF density convolved with a Gaussian is nearly a vMF density with the sum of the variances.
    expected = sum_gaze(
        target, observers_from_law(vmf(rgb, (1, 0.1, 0), 1 / (1 / 400 + cone**2))), eye, [1.0], SETTINGS
    )
    assert abs(wide.face_sums.sum() - 1) < 1e-3
    assert np.abs(wide.face_sums - expected.face_sums).sum() < 0.03 < np.abs(plain.face_sums - expected.face_sums).sum()


def test_sums_match_surface_attention(rgb, tmp_path):
    from importlib.resources import files

    from nerg_mi.scenes import store

    import nerg_mi as nerg
    from tests.pictures import box_dict

    actual = files(store)
    eye = (4.4, 2.8, 1.6)
    scene = nerg.make_scene(gaze=actual / "shoppers.safetensors", shapes=actual / "twin.ply", falloff=0.0)
    field = scene.integrator.gaze.field
    field.set_prior(0.0)
    field.hits = None
    aoi = box((4.4, 4.65, 0.0), (4.9, 5.0, 1.45))
    expected = nerg.attention(scene, box_dict(*np.array([(4.4, 4.65, 0.0), (4.9, 5.0, 1.45)])), [eye], divisions=24)
    from nerg_mi.formats.meshes import read_mesh_file
    from nerg_mi.surfaces.sources import observers_from_field

    read = read_mesh_file(actual / "twin.ply")
    twin = read.vertices, read.faces
    target = SurfaceTarget(joined(aoi), [twin])
    # The box is evaluated as if it were in the scene: the goods in it occlude it, as in `attention`.
    make = observers_from_field(scene.integrator.gaze, target.geometry, target.settings)
    sums = sum_gaze(target, make, np.array([eye]), [1.0], SETTINGS)
    assert expected.share[0] > 0.001
    # The networks are normalised over the visible surfaces, which for both include the box.
    gaze, at = scene.integrator.gaze, rgb.Point3f(eye)
    reference, without = (
        float(gaze.for_observers([at], place, target.settings).integrals(at)[0][0])
        for place in (target.geometry, SurfaceTarget(joined(twin)).geometry)
    )
    assert abs(reference / without - 1) > 0.03
    assert np.isclose(sums.face_sums.sum(), expected.share[0], rtol=0.01)


def test_parts_add_up_exactly(rgb):
    target, law, coarse = (
        SurfaceTarget(joined(ROOM)),
        observers_from_law(vmf(rgb, (0, 1, 0), 5.0)),
        GazeSumSettings(max_angle=0.2),
    )
    observers, weights = np.random.default_rng(0).uniform(0.5, 2, (3, 3)), np.array([0.2, 0.3, 0.5])
    each = [sum_gaze(target, law, observers[k : k + 1], weights[k : k + 1], coarse) for k in range(3)]
    whole_result = sum_gaze(target, law, observers, weights, coarse)
    assert np.array_equal(merge_sums(each).vertex_sums, whole_result.vertex_sums) and whole_result.count == 3


# ---- Occlusion boundaries ----

FLOOR = (np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]), np.array([(0, 1, 2), (0, 2, 3)]))


def test_shadow_boundary_along_subdivisions(rgb):
    """A plate above the floor occludes the part beyond x, for any position relative to the subdivision."""
    eye = np.array([0.0, 0.0, 2.0])
    for x in (0.07, 0.13, 0.51):
        plate = FLOOR[0] * [0.5, 1, 1] + [0.5 + x / 2, 0, 1]
        target = SurfaceTarget(joined(FLOOR), [(plate, FLOOR[1])])
        pieces = subdivide_faces(target.mesh, eye, 0.3)
        parts = list(iter_visible_pieces(target, pieces, lambda some: np.ones(len(some)), 2 * np.pi, 1 << 12))
        result = sum(received.sum() for _, received in parts)
        # Solid angle of the strip from -1 to x, by the corners of the halves of its two parts.
        exact = sum(2 * np.arctan2(a, 2 * np.sqrt(a * a + 5)) for a in (1.0, x))
        assert abs(result - exact) < 1e-3
        uncut = pieces.solid_angle[target.is_visible(eye, pieces.centroids, pieces.face)].sum()
        assert abs(uncut - exact) > 1e-3


def test_narrow_density_is_integrated(rgb):
    """Pieces are subdivided for a density narrower than a piece."""
    target, eye = SurfaceTarget(joined(FLOOR)), np.array([0.13, 0.06, 0.5])
    pieces = subdivide_faces(target.mesh, eye, 0.4)

    def law(some):
        d = some.relative.mean(axis=1)
        cos = -d[:, 2] / np.linalg.norm(d, axis=1)
        return 60 / (2 * np.pi) * np.exp(60 * (cos - 1))

    result = sum(received.sum() for _, received in iter_visible_pieces(target, pieces, law, 1.0, 1 << 12))
    assert abs(result - 1) < 1e-3 and abs((pieces.solid_angle * law(pieces)).sum() - 1) > 1e-2


# ---- Solid angles of pieces ----

PIECES_ROOM = joined(box((0, 0, 0), (1.0, 1.0, 1.0)))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("eye", [(0.5, 0.5, 0.5), (0.999, 0.3, 0.2), (1 - 1e-9, 0.9999, 0.5)])
def test_room_subtends_the_whole_sphere(eye, scale):
    room = joined(box((0, 0, 0), (scale, scale, scale)))
    result = subdivide_faces(room, scale * np.array(eye), 0.2)
    assert np.isclose(result.solid_angle.sum(), 4 * np.pi, rtol=1e-9)
    center = np.einsum("pi,pik->pk", result.centroid_barycentric, room.corners[result.face])
    assert np.allclose(center, result.centroids, atol=1e-9 * scale)
    # The number of pieces is limited by the solid angle of the sphere.
    assert len(result.face) < 50_000
    away = np.linalg.norm(result.centroids - scale * np.array(eye), axis=1)
    assert np.all(np.sqrt(result.solid_angle) < 0.2) and away.min() > 0


def test_solid_angles_of_octant_and_distant_triangles():
    assert np.isclose(solid_angles(np.eye(3)[None])[0], np.pi / 2, rtol=1e-14)
    # A square metre that faces the observer a kilometre away, and one edge on.
    near = np.array([(1e3, 0, 0), (1e3, 1, 0), (1e3, 0, 1)])
    assert np.isclose(solid_angles(near[None])[0], 0.5e-6, rtol=1e-5)
    assert solid_angles(np.array([[(1.0, 0, 0), (2, 0, 0), (1, 1, 0)]]))[0] == 0


@pytest.mark.parametrize("angle", [0.2, 1.0])
def test_edges_subtend_the_angle_from_the_nearest_point(angle):
    """Of the bounding sphere of their piece, which is nearer than its centre."""
    eye = np.array([0.5, 0.4, 0.1])
    corners = subdivide_faces(PIECES_ROOM, eye, angle).relative
    middle = corners.mean(axis=1, keepdims=True)
    nearest = np.linalg.norm(middle[:, 0], axis=1) - np.linalg.norm(corners - middle, axis=2).max(axis=1)
    edge = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
    assert np.all(edge <= angle * nearest * (1 + 1e-9))


def test_subdivision_ends_for_observer_on_a_face():
    sheet = joined((np.array([(-1.0, -1, 0), (2, -1, 0), (-1, 2, 0)]), np.array([(0, 1, 2)])))
    result = subdivide_faces(sheet, np.zeros(3), 0.5)
    assert result.solid_angle.sum() == 0 and len(result.face) < 20_000


@pytest.mark.parametrize("far", [1e155, 1e200, 1e308, np.inf, np.nan])
def test_subdivision_ends_for_overflowing_distances(far):
    with np.errstate(all="ignore"):
        assert len(subdivide_faces(PIECES_ROOM, np.array([far, 0, 0]), 0.03).face) == len(PIECES_ROOM.faces)


def test_too_many_pieces_are_refused(monkeypatch):
    monkeypatch.setattr("nerg_mi.surfaces.sources.MAX_PIECES", 1000)
    with pytest.raises(NergError, match="1,000.*max_angle"):
        subdivide_faces(PIECES_ROOM, np.full(3, 0.5), 0.02)


# ---- Represented time and clustered observers ----


def rays(t, person):
    n = len(t)
    return Rays(t, person, ("a", "b"), np.zeros((n, 3)), np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def test_ray_durations():
    index = rays([0, 0.1, 0.3, 9.0, 9.1, 0.0, 0.2], [0, 0, 0, 0, 0, 1, 1])
    # Pauses count as at most half a second; the last sample of a recording as the median step.
    assert np.allclose(ray_durations(index), [0.1, 0.2, 0.5, 0.1, 0.15, 0.2, 0.2])
    assert np.allclose(ray_durations(index, max_gap=0.05), 0.05)
    assert np.allclose(ray_durations(rays([5.0], [0])), 0.5)


@pytest.mark.parametrize("by, share", [("time", 1.05 / 1.45), ("person", 0.5), ("equal", 5 / 7)])
def test_weights_sum_to_one(by, share):
    index = rays([0, 0.1, 0.3, 9.0, 9.1, 0.0, 0.2], [0, 0, 0, 0, 0, 1, 1])
    w = ray_weights(index, by)
    assert np.isclose(w.sum(), 1) and np.isclose(w[:5].sum(), share)


def test_clustered_observers_are_recorded_positions():
    rng = np.random.default_rng(0)
    places = np.array([(0, 0, 1.6), (4, 0, 1.6), (0, 5, 1.6)])
    which = rng.choice(3, 3000, p=(0.5, 0.3, 0.2))
    positions = places[which] + rng.normal(0, 0.05, (3000, 3))
    weights = rng.random(3000)
    result = cluster_observers(positions, weights, 3, seed=1)
    expected = np.bincount(which, weights) / weights.sum()
    order = np.argsort(-result.weights)
    assert np.allclose(result.weights[order], expected[np.argsort(-expected)])
    assert all((positions == p).all(axis=1).any() for p in result.positions)
    # The reported distance is that of the positions to the nearest observer.
    near = np.linalg.norm(positions[:, None] - result.positions, axis=2).min(axis=1)
    assert np.isclose(result.rms_distance, np.sqrt((weights * near**2).sum() / weights.sum()))
    assert abs(np.mean(near <= result.p95_distance) - 0.95) < 0.02
    again = cluster_observers(positions, weights, 3, seed=1)
    assert np.array_equal(again.positions, result.positions)


def test_more_observers_are_closer():
    positions = np.random.default_rng(2).uniform(0, 5, (2000, 3))
    errors = [cluster_observers(positions, np.ones(2000), n).rms_distance for n in (4, 32, 256)]
    assert errors[0] > 1.5 * errors[1] > 2 * errors[2]
    few = cluster_observers(np.tile([[1.0, 2, 3], [4, 5, 6]], (50, 1)), np.ones(100), 10)
    assert len(few.weights) == 2 and few.rms_distance == few.p95_distance == 0 and np.allclose(few.weights, 0.5)


# ---- Gaze samples as cones ----

SIGMA = np.radians(1.5)


def rays_ray_source(n, spread=0.0, seed=0):
    rng = np.random.default_rng(seed)
    d = np.concatenate([rng.normal(0, spread, (n, 2)), np.ones((n, 1))], axis=1)
    return TrackedRays(np.zeros((n, 3)), d / np.linalg.norm(d, axis=1, keepdims=True), np.full(n, 1 / n))


def test_line_and_cone_through_a_gap(rgb):
    """Two plates with a slit of 5 cm between them at two metres, and a wall behind."""
    slit = 0.025
    left = (np.array([(-3.0, -3, 2), (-slit, -3, 2), (-slit, 3, 2), (-3, 3, 2)]), np.array([(0, 1, 2), (0, 2, 3)]))
    right = (-left[0] * [1, 1, -1], left[1])
    wall = box((-5, -5, 4), (5, 5, 4.1))
    mesh = joined(left, right, wall)
    target, behind = SurfaceTarget(mesh), mesh.corners[:, :, 2].min(axis=1) > 3
    line = sum_rays(target, rays_ray_source(1000), RaySettings())
    assert np.isclose(line.face_sums[behind].sum(), 1)
    cone = sum_rays(target, rays_ray_source(4000), RaySettings(cone_sigma=SIGMA, rays_per_cone=16))
    # One of the two angles of the Gaussian must be within the slit.
    passes = 2 * norm.cdf(np.arctan(slit / 2) / SIGMA) - 1
    assert abs(cone.face_sums[behind].sum() - passes) < 0.01 and 0.3 < passes < 0.4
    left_of = mesh.corners[:, :, 0].max(axis=1) < 0
    assert abs(cone.face_sums[left_of & ~behind].sum() - (1 - passes) / 2) < 0.01
    assert np.isclose(cone.face_sums.sum() + cone.escaped + cone.elsewhere, cone.total)


def test_thin_edge_receives_its_share(rgb):
    """A rod of 1 cm, which single rays with an error of one degree mostly miss."""
    rod = joined(box((-0.005, -3, 2), (0.005, 3, 2.01)))
    sums = sum_rays(SurfaceTarget(rod), rays_ray_source(20_000), RaySettings(cone_sigma=SIGMA))
    expected = 2 * norm.cdf(np.arctan(0.005 / 2) / SIGMA) - 1
    assert np.isclose(sums.face_sums.sum(), expected, rtol=0.05)
    assert np.isclose(sums.escaped, 1 - sums.face_sums.sum())


def test_ray_parts_are_reproducible(rgb):
    target, settings = (
        SurfaceTarget(joined(plate(9, side=4.0, z=2.0))),
        RaySettings(cone_sigma=SIGMA, rays_per_cone=8, seed=5),
    )
    every = rays_ray_source(1000, spread=0.2, seed=1)
    parts = [every.select(a, a + 300) for a in range(0, 1000, 300)]
    assert [p.first_index for p in parts] == [0, 300, 600, 900] and len(parts[-1]) == 100
    first, again = (merge_sums(sum_rays(target, p, settings) for p in parts) for _ in range(2))
    assert np.array_equal(first.vertex_sums, again.vertex_sums) and first.count == 1000
    assert np.isclose(first.total, 1) and abs(first.unaccounted) < 1e-12
    other = sum_rays(target, parts[0], RaySettings(cone_sigma=SIGMA, rays_per_cone=8, seed=6))
    assert not np.array_equal(other.vertex_sums, sum_rays(target, parts[0], settings).vertex_sums)


@pytest.mark.parametrize("cone", [0.0, SIGMA])
def test_ray_shares_add_up(rgb, cone):
    """A plate across x < 0 at z = 2; a shape at z = 1 occludes y < 0 and extends beyond it; the rest escapes."""
    plate_left = (np.array([(-9.0, -9, 2), (0, -9, 2), (0, 9, 2), (-9, 9, 2)]), np.array([(0, 1, 2), (0, 2, 3)]))
    hiding = (np.array([(-9.0, -9, 1), (9, -9, 1), (9, 0, 1), (-9, 0, 1)]), np.array([(0, 1, 2), (0, 2, 3)]))
    some = rays_ray_source(4000, spread=0.3, seed=2)
    some = TrackedRays(some.origins, some.directions, np.linspace(0.5, 1.5, 4000))
    sums = sum_rays(SurfaceTarget(joined(plate_left), [hiding]), some, RaySettings(cone_sigma=cone, rays_per_cone=8))
    hidden, left = some.directions[:, 1] < 0, some.directions[:, 0] < 0
    expected = [some.weights[rows].sum() for rows in (~hidden & left, hidden, ~hidden & ~left)]
    result = [sums.on_surface, sums.elsewhere, sums.escaped]
    assert np.allclose(result, expected, rtol=1e-9 if cone == 0 else 0.03)
    assert sum(result) == pytest.approx(sums.weight, rel=1e-12) and sums.total == sums.weight == some.weights.sum()


# ---- Quadrature over the sphere ----

SPHERE_RULE_MEAN = np.array([0.3, -0.5, 0.81]) / np.linalg.norm([0.3, -0.5, 0.81])


def law(kappa):
    return lambda d: kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(kappa * (d @ SPHERE_RULE_MEAN - 1))


@pytest.mark.parametrize("kappa", [0.1, 40.0, 3000.0])
def test_quadrature_totals(kappa):
    directions, angles = sphere_quadrature(law(kappa), 1 << 15)
    assert np.isclose(angles.sum(), 4 * np.pi, rtol=1e-12)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-14)
    share = angles * law(kappa)(directions)
    assert abs(share.sum() - 1) < 1e-3
    # A vertical plane through the middle of the law leaves half of it on either side.
    side = directions @ np.cross(SPHERE_RULE_MEAN, [0, 0, 1]) > 0
    assert abs(share[side].sum() - 0.5) < 1e-3
    assert np.allclose(sphere_quadrature(lambda d: np.zeros(len(d)), 1)[1].sum(), 4 * np.pi)


def test_quadrature_of_vertical_half_spaces():
    directions, angles = sphere_quadrature(lambda d: np.ones(len(d)), 1 << 14)
    turn = np.arctan2(directions[:, 1], directions[:, 0])
    for edge in (0.1, 0.7, np.pi / 2):
        assert np.isclose(angles[(turn > 0) & (turn < edge)].sum(), 2 * edge, atol=0.004)
    with pytest.raises(ValueError, match="one direction"):
        sphere_quadrature(lambda d: np.ones(len(d)), 0)
