"""Lists of Gaussians by direction: rays from one point, against sums in float64 and against the tree."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.splats import Splats, quaternions_to_matrices
from nerg_mi.maths.geometry import Similarity
from nerg_mi.transport import splat_lists
from nerg_mi.transport.geometry import SceneGeometry, SceneRay, default_march_settings
from nerg_mi.transport.medium import ColorShader
from nerg_mi.transport.ray_cells import CubeCells, RayCells
from nerg_mi.transport.splat_medium import MAX_ALPHA, SplatArrays, SplatMedium

SH_C0 = 0.28209479177387814

pytestmark = pytest.mark.usefixtures("any_number")


def cloud(count, seed=0, around=(0.0, 0.0, 0.0), size=2.0, width=0.08, unit=1.0):
    """Gaussians of one colour each, in a ball of radius ``size`` around a point."""
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(count, 3))
    p *= size * rng.uniform(0.1, 1, (count, 1)) / np.linalg.norm(p, axis=1, keepdims=True)
    scales = width * np.exp(rng.normal(0, 0.7, (count, 3)))
    return Splats(
        (p + around) * unit,
        scales * unit,
        rng.normal(size=(count, 4)),
        rng.uniform(0.02, 1, count),
        rng.normal(0, 1, (count, 1, 3)),
    )


def make_medium(rgb, splats, **options):
    return SplatMedium(SplatArrays(splats, namespace(rgb.Float)), **options)


def directions(count, seed=1):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def trace(rgb, medium, center, d, start=0.0, cells=None):
    """Colour, opacity and mean depth (N, 5) of rays in the unit directions ``d`` from ``start`` in front of
    ``center``; ``cells``: with lists."""
    geometry = SceneGeometry(medium)
    if cells is not None:
        geometry = geometry.seen_from(rgb.Point3f(*map(float, center)), len(d), cells)
        assert isinstance(geometry.medium.hits, splat_lists.SplatLists)
    d = rgb.Vector3f(np.asarray(d, np.float32).T)
    ray = SceneRay(rgb.Point3f(*map(float, center)) + start * d, d, rgb.Float(dr.inf))
    settings = default_march_settings(geometry)
    hit = geometry.trace(ray, dr.full(rgb.Bool, True, dr.width(d)), settings, color=ColorShader(rgb.Color3f))
    values = [*hit.march.color, hit.opacity, hit.depth("expected", hit.opacity > 0)]
    return np.stack([np.array(v, np.float64) + np.zeros(dr.width(d)) for v in values], axis=1)


def sum_exactly(splats, center, d, start=0.0, stop=1e-4):
    """The same in float64, with Gaussians sorted by their peaks."""
    turn = quaternions_to_matrices(splats.rotations.astype(np.float64))
    to_axes = turn.transpose(0, 2, 1) / splats.scales[:, :, None].astype(np.float64)
    offset = to_axes @ (center - splats.centers.astype(np.float64))[:, :, None]
    out = []
    for direction in np.asarray(d, np.float32).astype(np.float64):
        along = (to_axes @ direction)[:, :, None]
        t = -(offset * along).sum((1, 2)) / (along**2).sum((1, 2))
        square = ((offset + t[:, None, None] * along) ** 2).sum((1, 2))
        alpha = np.minimum(splats.opacities * np.exp(-square / 2), MAX_ALPHA)
        (hit,) = np.nonzero((t >= start) & (alpha >= 1 / 255) & (square < 9))
        light, sums = 1.0, np.zeros(4)
        for k in hit[np.argsort(t[hit])]:
            color = np.maximum(0.5 + SH_C0 * splats.harmonics[k, 0], 0)
            sums += light * alpha[k] * np.array([*color, t[k] - start])
            light *= 1 - alpha[k]
            if light <= stop:
                break
        out.append([*sums[:3], 1 - light, sums[3] / (1 - light) if light < 1 else 0])
    return np.array(out)


@pytest.mark.parametrize("count", [1, 2, 100])
@pytest.mark.parametrize("cells", [CubeCells(), CubeCells(5)])
def test_sums_equal_those_in_double_precision(rgb, sorted_hits, count, cells):
    splats, d = cloud(count, width=0.2), directions(300)
    d[: count % 50] = splats.centers[: count % 50] / np.linalg.norm(splats.centers[: count % 50], axis=1, keepdims=True)
    ours = trace(rgb, make_medium(rgb, splats), (0, 0, 0), d, cells=cells)
    exact = sum_exactly(splats, np.zeros(3), d)
    assert (exact[:, 3] > 0).sum() > (100 if count == 100 else 0)
    np.testing.assert_allclose(ours, exact, rtol=2e-4, atol=2e-4)


def test_gaussians_around_the_viewpoint_and_behind_the_start_of_rays(rgb, sorted_hits):
    # Near ones are wider than the view and reach behind the viewpoint; some contain it.
    splats, d = cloud(18, size=0.5, width=0.3), directions(400)
    for start in (0.0, 0.2):
        ours = trace(rgb, make_medium(rgb, splats), (0, 0, 0), d, start, CubeCells(8))
        np.testing.assert_allclose(ours, sum_exactly(splats, np.zeros(3), d, start), rtol=5e-4, atol=5e-4)


@pytest.mark.parametrize(("unit", "around"), [(2e6, 0.0), (1e-5, 0.0), (1.0, 1e4)])
def test_units_and_places_far_from_the_origin(rgb, sorted_hits, unit, around):
    center = np.array([around, -around, around])
    splats, d = cloud(80, width=0.2, around=center, unit=unit), directions(300)
    ours = trace(rgb, make_medium(rgb, splats), center * unit, d, cells=CubeCells(16))
    exact = sum_exactly(splats, (center * unit).astype(np.float32).astype(np.float64), d)
    # Centres have seven digits.
    tolerance = 2e-4 + 5e-7 * abs(around)
    np.testing.assert_allclose(ours[:, :4], exact[:, :4], atol=tolerance)
    np.testing.assert_allclose(ours[:, 4] / unit, exact[:, 4] / unit, atol=tolerance)


def test_thin_and_faint_gaussians_are_listed_where_they_are_seen(rgb, sorted_hits):
    rng = np.random.default_rng(4)
    splats = cloud(300, seed=4)
    scales = np.stack([np.full(300, 1e-5), np.full(300, 1e-4), np.full(300, 0.5)], axis=1)
    splats = Splats(splats.centers, scales, splats.rotations, rng.uniform(0.001, 0.01, 300), splats.harmonics)
    d = splats.centers / np.linalg.norm(splats.centers, axis=1, keepdims=True)
    ours = trace(rgb, make_medium(rgb, splats), (0, 0, 0), d, cells=CubeCells(40))
    exact = sum_exactly(splats, np.zeros(3), d)
    assert 50 < (exact[:, 3] > 0).sum() < 300  # some absorb less than a grey level
    np.testing.assert_allclose(ours, exact, atol=1e-3)


def test_a_plane_shows_what_the_cube_shows(rgb, sorted_hits):
    turned = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 3 * turned * np.sign(np.linalg.det(turned)), (0.3, -0.2, 0.5)
    medium = make_medium(rgb, cloud(500), to_world=Similarity(matrix))
    center = (0.5, -0.4, 0.2)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    plane = np.random.default_rng(3).uniform([-0.8, -0.5], [0.8, 0.5], (500, 2))
    d = np.column_stack([plane, np.ones(500)]) @ turn
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    plane_cells = RayCells(turn, (-0.8, -0.5), (0.8, 0.5), (31, 17))
    seen = trace(rgb, medium, center, d, cells=plane_cells)
    np.testing.assert_allclose(seen, trace(rgb, medium, center, d, cells=CubeCells()), atol=1e-5)
    np.testing.assert_allclose(seen, trace(rgb, medium, center, d), atol=1e-2)


def test_the_order_on_surfaces_is_nearly_that_of_the_tree(rgb):
    splats, d = cloud(6000, width=0.03), directions(2000)
    unit = splats.centers / np.linalg.norm(splats.centers, axis=1, keepdims=True)
    radius = np.where(np.arange(6000) % 2, 1.5, 2)[:, None]  # a shell in front of another
    splats = Splats(radius * unit, splats.scales, splats.rotations, splats.opacities, splats.harmonics)
    medium = make_medium(rgb, splats)
    difference = trace(rgb, medium, (0, 0, 0), d, cells=CubeCells()) - trace(rgb, medium, (0, 0, 0), d)
    assert np.sqrt((difference[:, :4] ** 2).mean()) < 0.005


def test_moved_gaussians_are_listed_anew(rgb, sorted_hits):
    medium, d = make_medium(rgb, cloud(100, width=0.3)), directions(200)
    first = trace(rgb, medium, (0, 0, 0), d, cells=CubeCells())
    medium.arrays.opacities = medium.arrays.opacities * 0.5
    medium.arrays.pack()
    second = trace(rgb, medium, (0, 0, 0), d, cells=CubeCells())
    assert np.abs(second - first).max() > 0.1
    np.testing.assert_allclose(second, trace(rgb, medium, (0, 0, 0), d), atol=6e-3)


def test_lists_can_be_switched_off(rgb):
    medium = make_medium(rgb, cloud(100), may_list=False)
    seen = SceneGeometry(medium).seen_from(rgb.Point3f(0), 1000)
    assert not isinstance(seen.medium.hits, splat_lists.SplatLists)
