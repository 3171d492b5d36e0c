"""Tests of `nerg_mi.surfaces.splats`."""

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.splats import Splats, concatenate_splats, quaternions_to_matrices
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.surfaces import splats
from nerg_mi.surfaces.laplacian import merge_sums
from nerg_mi.surfaces.sources import RaySettings, TrackedRays
from nerg_mi.surfaces.splats import (
    MIN_VISIBLE_FRACTION,
    SplatSmoother,
    compute_splat_areas,
    integrate_gaze,
    iter_hit_groups,
    shortest_axes,
    splat_densities,
    sum_rays_on_splats,
    unoccluded_areas,
    visible_sides,
)
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.splat_medium import SplatArrays
from tests.reference import splats as reference
from tests.reference.splats import peaks
from tests.surfaces.meshes import TURN_X, observers_from_law, vmf, wall
from tests.transport.test_splat_medium import medium_of, rays, stack

# ---- Splat areas ----


def areas(splats, tolerance=0.002):
    return compute_splat_areas(splats, SplatArrays(splats, ns), tolerance)


def test_area_of_a_single_gaussian(rgb):
    turn = [np.cos(0.4), np.sin(0.4), 0.1, 0]
    one = Splats([[1, 2, 3]], [[0.2, 0.01, 0.1]], [turn], [0.5], np.zeros((1, 1, 3)))
    expected = 2 * np.pi * 0.2 * 0.1 * 0.5 * (1 - np.exp(-4.5))
    assert np.allclose(areas(one), expected, rtol=1e-6) and np.allclose(unoccluded_areas(one, 3.0), expected)
    axis = shortest_axes(one)
    assert np.allclose(axis[0], one.axes()[0, :, 1]) and list(visible_sides(np.r_[axis, -axis], np.r_[axis, axis])) == [
        0,
        1,
    ]


def test_overlapping_gaussians_share_area(rgb):
    """An opaque wall has its geometric area for any number of Gaussians."""
    plain = wall(jitter=0.0005)
    result = areas(plain)
    edge = 4 * 0.014  # the outer disks extend beyond the edge
    assert unoccluded_areas(plain, 3.0).sum() > 2.5
    assert (result.sum(axis=1) > 0.99).all() and (result.sum(axis=1) < (1 + edge) ** 2).all()


def test_occluded_side_has_no_area(rgb):
    both = concatenate_splats([wall(0.0, 0.2), wall(0.003, 0.2, turned=TURN_X)])
    result, n = areas(both, 0.004), len(both) // 2
    # Rays along +z hit side 0 of the first wall, whose axis is +z, and side 1 of the other.
    assert (result[0, :n] > 4 * result[1, n:]).mean() > 0.8 and result[1, n:].sum() < 0.3 * result[0, :n].sum()
    far = concatenate_splats([wall(0.0, 0.2), wall(0.05, 0.2)])
    assert np.allclose(areas(far, 0.004)[:, :n], areas(wall(0.0, 0.2), 0.004)) and 0 < MIN_VISIBLE_FRACTION < 1


# ---- Splat hits ----
#
# All hits of rays as arrays, in order, compared with a loop over all Gaussians in double precision.


def some(n=80, seed=3):
    rng = np.random.default_rng(seed)
    centers, scales = rng.uniform(-1, 1, (n, 3)), rng.uniform(0.05, 0.4, (n, 3))
    return Splats(centers, scales, rng.normal(size=(n, 4)), rng.uniform(0.05, 0.6, n), np.zeros((n, 1, 3)))


def shares(splats, o, d, **options):
    """Return the contribution of each Gaussian (R, N), the remaining transmittance (R,), and the number of groups."""
    taken, left, count = np.zeros((len(o), len(splats))), np.ones(len(o)), 0
    for group in iter_hit_groups(SplatArrays(splats, ns), o, d, **options):
        ray, hit = np.nonzero(group.index >= 0)
        taken[group.rows[ray], group.index[ray, hit]] += (group.transmittance * group.alpha)[ray, hit]
        left[group.rows] = group.remaining
        count += 1
    return taken, left, count


def test_hits_match_a_loop(rgb):
    splats, (o, d) = some(), rays(300)
    taken, left, count = shares(splats, o, d, min_transmittance=1e-6)
    t, absorbed = peaks(splats, o, d)
    absorbed = np.where(t >= 0, absorbed, 0)
    order = np.argsort(t, axis=1)
    sorted_ = np.take_along_axis(absorbed, order, 1)
    through = np.cumprod(1 - sorted_, axis=1)
    expected = np.zeros_like(taken)
    np.put_along_axis(expected, order, np.concatenate([np.ones((300, 1)), through[:, :-1]], 1) * sorted_, 1)
    assert count >= 3 and np.abs(taken - expected).max() < 2e-5
    # All hits are found, or the ray continues.
    assert np.abs(taken.sum(axis=1) + left - 1).max() < 1e-12


def test_hits_end_at_the_maximum_distance(rgb):
    splats = stack(np.arange(30.0), np.full(30, 0.1))
    o, d = np.array([[0, 0, -1.0], [0, 0, -1.0]]), np.array([[0, 0, 1.0], [0, 0, 1.0]])
    taken, left, _ = shares(splats, o, d, max_distance=np.array([5.5, np.inf]))
    assert np.allclose(taken.sum(axis=1), 1 - 0.9 ** np.array([5, 30]), atol=1e-6) and np.allclose(
        1 - left, taken.sum(1)
    )
    groups = iter_hit_groups(SplatArrays(splats, ns), o, d)
    first = next(groups)
    assert list(first.rows) == [0, 1] and not first.has_escaped.any()
    assert list(groups.send(np.array([1])).rows) == [1]


# ---- Gaze samples on splats ----

LINE = RaySettings()
CONE = RaySettings(cone_sigma=np.radians(1.5), rays_per_cone=8, seed=5)


def falling(n, side=1.2, z=-1.0, seed=0):
    """Rays along z, uniform over a square."""
    at = np.random.default_rng(seed).uniform(-side / 2, side / 2, (n, 2))
    o = np.concatenate([at, np.full((n, 1), z)], axis=1)
    return TrackedRays(o, np.tile([0.0, 0, 1], (n, 1)), np.full(n, 1 / n))


def sums(splats, rays, settings=LINE):
    return sum_rays_on_splats(SplatArrays(splats, ns), shortest_axes(splats), rays, settings)


def test_ray_contributions_sum_to_one(rgb):
    splats, rays = some(), falling(500, 3.0)
    result = sums(splats, rays)
    taken, left, _ = shares(splats, rays.origins, rays.directions)
    assert np.allclose(result.face_sums.reshape(2, -1).sum(axis=0), taken.mean(axis=0))
    axes = shortest_axes(splats)
    assert not result.face_sums.reshape(2, -1)[np.where(axes[:, 2] > 0, 1, 0), np.arange(len(splats))].any()
    # The transmittance at the end of a march is at most 1e-4.
    assert abs(result.unaccounted) < 1e-4 and 0.2 < result.escaped < 0.8 and np.isclose(result.total, 1)
    assert np.isclose(result.escaped + result.unaccounted, left.mean())
    cone = sums(splats, rays, CONE)
    assert abs(cone.on_surface + cone.escaped - 1) < 1e-3 and cone.count == 500


def test_attention_per_area_matches_ray_density(rgb):
    """On a wall of two layers of overlapping Gaussians."""
    splats = concatenate_splats([wall(0.0, 0.6, 0.03, 0.0005), wall(0.004, 0.6, 0.05, turned=TURN_X, seed=1)])
    rays = falling(20_000, 1.2)
    result = sums(splats, rays).face_sums.reshape(2, -1)
    areas = compute_splat_areas(splats, SplatArrays(splats, ns), 0.006)
    inner = (np.abs(splats.centers[:, :2]) < 0.25).all(axis=1)
    side = (shortest_axes(splats)[:, 2] <= 0).astype(int)
    index, subset = result[side, np.arange(len(splats))], areas[side, np.arange(len(splats))]
    assert np.isclose(index[inner].sum() / subset[inner].sum() * 1.2**2, 1, rtol=0.03)
    front = inner & (splats.centers[:, 2] < 0.003)
    assert abs(np.median(index[front] / subset[front]) * 1.2**2 - 1) < 0.05


def test_splat_parts_are_reproducible(rgb):
    splats, every = wall(1.0, 1.0, 0.05), falling(900)
    parts = [every.select(a, a + 400) for a in range(0, 900, 400)]
    first, again = (merge_sums(sums(splats, part, CONE) for part in parts) for _ in range(2))
    assert np.array_equal(first.face_sums, again.face_sums) and first.count == 900 and first.escaped == again.escaped
    assert not np.array_equal(
        sums(splats, parts[0], replace(CONE, seed=6)).face_sums, sums(splats, parts[0], CONE).face_sums
    )


@pytest.mark.parametrize("cone", [0.0, 0.03])
def test_escaped_gaze(rgb, cone):
    """Gaze along z that is mostly blocked by a wall; reference by all Gaussians in float64."""
    splats, eye, kappa = some(), np.array([0.1, -0.2, -1.5]), 8.0
    observer = observers_from_law(vmf(rgb, (0, 0, 1), kappa))(eye)
    total, escaped = integrate_gaze(SplatArrays(splats, ns), observer, eye, cone)
    d = fibonacci_directions(20_000)
    share = np.exp(kappa * (d[:, 2] - 1))
    left = shares(splats, np.broadcast_to(eye, d.shape), d)[1]
    assert abs(total - 1) < 2e-3 and 0.1 < escaped < 0.95
    assert np.isclose(escaped, (share * left).sum() / share.sum(), atol=0.01 if cone == 0 else 0.02)


# ---- Splat smoothing ----
#
# Smoothing over Gaussians: its width, conservation, and no transfer through air, around an edge or a board.

TOLERANCE = 0.002


def smoother(splats, length, areas=None):
    each = np.full((2, len(splats)), 0.02**2) if areas is None else areas
    return SplatSmoother(
        splats.centers, shortest_axes(splats), each, np.full(len(splats), 1e-6), length, TOLERANCE
    ), each


def spike(splats, at, side=0):
    start = np.zeros((2, len(splats)))
    start[side, np.argmin(np.linalg.norm(splats.centers - np.asarray(at), axis=1))] = 1
    return start


@pytest.mark.parametrize("length", [0.03, 0.05, 0.1])
def test_point_is_smoothed_to_a_gaussian(length):
    rng = np.random.default_rng(0)
    plain = wall(side=1.2)
    plain.centers[:, :2] += rng.uniform(-0.004, 0.004, (len(plain), 2))
    flow, areas = smoother(plain, length)
    start = spike(plain, (0, 0, 0))
    result = flow(start)
    assert np.isclose(result.sum(), 1, rtol=1e-12) and (result >= 0).all() and not result[1].any()
    offset = plain.centers - plain.centers[start[0].argmax()]
    for axis in (0, 1):
        width = np.sqrt((result[0] * offset[:, axis] ** 2).sum())
        assert abs(width / length - 1) < 0.08
    square = (offset**2).sum(axis=1)
    exact = np.exp(-square / (2 * length**2)) / (2 * np.pi * length**2) * areas[0]
    assert np.abs(result[0] - exact).sum() < 0.25
    # A uniform density stays uniform for any areas.
    flow, areas = smoother(plain, length, rng.uniform(0.5, 1.5, (2, len(plain))) * areas)
    assert np.allclose(flow(areas), areas, rtol=1e-9)


@pytest.mark.parametrize("turned", [(1.0, 0.0, 0.0, 0.0), TURN_X])
@pytest.mark.parametrize("length", [0.05, 0.2])
def test_smoothing_does_not_cross_gaps(turned, length):
    """Parallel Gaussians and Gaussians that face each other, for either side."""
    both = concatenate_splats([wall(0.0, 0.8), wall(0.05, 0.8, turned=turned)])
    flow, _ = smoother(both, length)
    n = len(both) // 2
    for side in (0, 1):
        result = flow(spike(both, (0, 0, 0), side))
        assert (
            np.isclose(result[side, :n].sum(), 1, rtol=1e-12) and not result[1 - side].any() and not result[:, n:].any()
        )


def test_smoothing_does_not_cross_boards_or_edges():
    board = concatenate_splats([wall(0.0, 0.4), wall(0.001, 0.4, turned=TURN_X)])
    n = len(board) // 2
    front = spike(board, (0.1, 0.1, 0))
    result = smoother(board, 0.05)[0](front)
    # Rays along +z hit side 0 of the first and side 1 of the other.
    assert not result[1, :n].any() and not result[0, n:].any() and result[1, n:].sum() > 0.1
    hidden = np.full((2, len(board)), 0.02**2)
    hidden[1, n:] = hidden[1, :n] = 1e-7
    result = smoother(board, 0.05, hidden)[0](front)
    assert np.isclose(result[0, :n].sum(), 1)
    upright = Splats(
        wall(0.0, 0.4).centers[:, [2, 1, 0]] + [0.2, 0, 0.2],
        np.tile([1e-3, 0.014, 0.014], (n, 1)),
        [[1, 0, 0, 0]] * n,
        [0.9] * n,
        np.zeros((n, 1, 3)),
    )
    corner = concatenate_splats([wall(0.0, 0.4), upright])
    assert not smoother(corner, 0.1)[0](spike(corner, (0.19, 0, 0)))[:, n:].any()


def test_neighbours_lie_in_the_planes_of_each_other():
    tilted = [np.sin(np.radians(25)), 0, np.cos(np.radians(25))]
    positions, offset = np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.array([0.1 * np.cos(0.2), 0, -0.1 * np.sin(0.2)])
    for first, second, step, count in (
        ([0, 0, 1], [0, 0, 1], positions[1], 4),
        ([0, 0, 1], tilted, positions[1], 2),
        (tilted, [0, 0, 1], positions[1], 2),
        ([0, 0, 1], tilted, offset, 4),
    ):
        at = np.array([positions[0], step])
        assert len(splats._find_neighbours(at, np.array([first, second], float), 0.2, 0.0)[0]) == count


def test_cells_share_one_density():
    many = wall(0.0, 0.1, offset=0.001)
    areas = np.full((2, len(many)), 0.001**2)
    flow, _ = smoother(many, 0.02, areas)
    start = spike(many, (0, 0, 0))
    start[1] = 0.3
    result = flow(start)
    assert np.isclose(result.sum(), start.sum(), rtol=1e-12) and len(np.unique((result / areas)[0])) < len(many) / 2
    with pytest.raises(ValueError, match="positive length"):
        smoother(many, 0.0, areas)
    none = SplatSmoother(many.centers, shortest_axes(many), areas, np.full(len(many), 1.0), 0.02, TOLERANCE)
    assert np.array_equal(none(start), start)


# ---- Gaze of observers on splats ----

EYE = np.array([[0.0, 0, -2]])
ALONG = np.array([0.0, 0, 1])


def result(splats, law, observers=EYE, weights=(1.0,), **options):
    place = SceneGeometry(medium_of(splats))
    settings = ObserverSettings(march=default_march_settings(place))
    make, observers, weights = observers_from_law(law), np.asarray(observers), np.asarray(weights)
    return splat_densities(splats, place, make, observers, weights, settings, **options).sum(axis=0)


def uniform(rgb):
    return lambda d: dr.full(rgb.Float, 1 / (4 * np.pi), dr.width(d))


def test_occluded_ball_receives_no_gaze(rgb):
    """Kappa / 2 pi at the centre of a narrow density, divided by the squared distance; zero in the shadow."""
    balls = stack([0.0, 1.0], [0.95, 0.95])
    kappa = 300.0
    expected = result(balls, vmf(rgb, ALONG, kappa))
    assert np.allclose(expected, [kappa / (2 * np.pi) / 4, 0], rtol=1e-5)
    # From the other side the other Gaussian is hit, and three of four observers are there.
    both = result(balls, uniform(rgb), [EYE[0], (0, 0, 4.0)], [0.25, 0.75])
    assert np.allclose(both, [0.25 / (4 * np.pi * 4), 0.75 / (4 * np.pi * 9)], rtol=1e-5)
    # Light that a ball transmits reaches the next one, where half of the ray's opacity is reached.
    assert result(stack([0.0, 1.0], [0.2, 0.95]), uniform(rgb))[1] > 0


def test_gaze_scales_with_projected_area(rgb):
    angles = np.radians([0, 30, 60, 80])
    turned = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=1)
    far = np.stack([40.0 * np.arange(4), 0 * angles, 0 * angles], axis=1)
    make = lambda scales: Splats(far, [scales] * 4, turned, [0.9] * 4, np.zeros((4, 1, 3)))
    observers = lambda k: far[k] - [0, 0, 2]
    seen = [result(make((0.1, 0.1, 1e-4)), uniform(rgb), [observers(k)])[k] for k in range(4)]
    assert np.allclose(np.array(seen) * 16 * np.pi, np.cos(angles), rtol=1e-4)
    # The outline of an ellipsoid has the area pi det(S) |S^-1 w| (of semi-axes S), and the largest one pi s0 s1.
    scales = np.array([0.1, 0.05, 0.02])
    for k in range(4):
        w = quaternions_to_matrices(turned[k : k + 1])[0].T @ [0, 0, 1]
        area = np.prod(scales) * np.linalg.norm(w / scales) / (scales[0] * scales[1])
        assert np.isclose(result(make(scales), uniform(rgb), [observers(k)])[k] * 16 * np.pi, area, rtol=1e-4)


def test_gaze_matches_a_loop(rgb):
    """Visibility by the median depth of the ray to a point before the centre, by the thickness and the tolerance."""
    rng = np.random.default_rng(3)
    n = 60
    centers, scales = rng.uniform(-1, 1, (n, 3)), rng.uniform(0.02, 0.3, (n, 3))
    splats = Splats(centers, scales, rng.normal(size=(n, 4)), rng.uniform(0.3, 1, n), rng.normal(size=(n, 4, 3)))
    law, eye = vmf(rgb, ALONG, 4.0), EYE[0]
    c = splats.centers.astype(np.float64)
    covariance = np.einsum("nij,nj,nkj->nik", splats.axes(), splats.scales.astype(float) ** 2, splats.axes())
    inverse = np.linalg.inv(covariance)
    to, distance = c - eye, np.linalg.norm(c - eye, axis=1)
    w = to / distance[:, None]
    normal = np.einsum("nij,nj->ni", inverse, w)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    depth = np.sqrt(np.einsum("ni,nij,nj->n", normal, covariance, normal))
    tolerance = 2 * np.median(splats.scales.min(axis=1))
    before = c - (depth + tolerance)[:, None] * normal - eye
    span = np.linalg.norm(before, axis=1)
    d = before / span[:, None]
    opacity, _, _, median = reference.trace(splats, np.tile(eye, (n, 1)), d)
    hidden = (opacity >= 0.5) & (median < span - tolerance)
    density = 4 / (2 * np.pi * (1 - np.exp(-8))) * np.exp(4 * (w @ ALONG - 1))
    area = np.sqrt(np.einsum("ni,nij,nj->n", w, inverse, w)) * splats.scales.min(axis=1)
    expected = np.where(hidden, 0, density * area / distance**2)
    actual = result(splats, law)
    assert 10 < hidden.sum() < 50
    assert np.allclose(actual, expected, rtol=1e-4)


def test_cone_and_observer_inside_a_gaussian(rgb):
    ball, cone, kappa = stack([0.0], [0.9]), 0.03, 400.0
    wide = 1 / (1 / kappa + cone**2)
    assert np.isclose(result(ball, vmf(rgb, ALONG, kappa), cone_sigma=cone)[0] * 8 * np.pi, wide, rtol=0.02)
    inside = result(ball, uniform(rgb), [(0, 0, -0.01), (0, 0, -0.1)], [1.0, 0.0])
    assert np.isclose(inside[0], 1 / (4 * np.pi * 0.1**2), rtol=1e-5)
