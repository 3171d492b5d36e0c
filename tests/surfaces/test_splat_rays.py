"""Tracked rays on Gaussians: what is left where, to whom it adds up, and per area."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.splats import joined
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.surfaces.laplacian import merge
from nerg_mi.surfaces.sources import RaySettings, TrackedRays, lookers_of_law
from nerg_mi.surfaces.splats import gaze_and_escaped, shortest_axes, splat_areas, splat_ray_sums
from nerg_mi.transport.splat_medium import SplatArrays
from tests.surfaces.meshes import vmf
from tests.surfaces.test_splat_hits import shares, some
from tests.surfaces.walls import TURN_X, wall

LINE = RaySettings()
CONE = RaySettings(cone=np.radians(1.5), bundle=8, seed=5)


def falling(n, side=1.2, z=-1.0, seed=0):
    """Rays along z that are spread evenly over a square."""
    at = np.random.default_rng(seed).uniform(-side / 2, side / 2, (n, 2))
    o = np.concatenate([at, np.full((n, 1), z)], axis=1)
    return TrackedRays(o, np.tile([0.0, 0, 1], (n, 1)), np.full(n, 1 / n))


def sums(splats, rays, settings=LINE):
    return splat_ray_sums(SplatArrays(splats, ns), shortest_axes(splats), rays, settings)


def test01_all_is_found_again_and_each_has_its_share_of_the_ray(rgb):
    splats, rays = some(), falling(500, 3.0)
    found = sums(splats, rays)
    taken, left, _ = shares(splats, rays.origins, rays.directions)
    assert np.allclose(found.face.reshape(2, -1).sum(axis=0), taken.mean(axis=0))
    axes = shortest_axes(splats)
    assert not found.face.reshape(2, -1)[np.where(axes[:, 2] > 0, 1, 0), np.arange(len(splats))].any()
    # What a march leaves behind where it ends is a ten-thousandth of a ray at most.
    assert abs(found.unaccounted) < 1e-4 and 0.2 < found.escaped < 0.8 and np.isclose(found.total, 1)
    assert np.isclose(found.escaped + found.unaccounted, left.mean())
    cone = sums(splats, rays, CONE)
    assert abs(cone.on_surface + cone.escaped - 1) < 1e-3 and cone.count == 500


def test02_per_area_it_is_what_falls_on_a_square_metre(rgb):
    """On a wall of overlapping Gaussians in two layers, whichever of them a ray ends at."""
    splats = joined([wall(0.0, 0.6, 0.03, 0.0005), wall(0.004, 0.6, 0.05, turned=TURN_X, seed=1)])
    rays = falling(20_000, 1.2)
    found = sums(splats, rays).face.reshape(2, -1)
    areas = splat_areas(splats, SplatArrays(splats, ns), 0.006)
    inner = (np.abs(splats.centers[:, :2]) < 0.25).all(axis=1)
    side = (shortest_axes(splats)[:, 2] <= 0).astype(int)
    of, own = found[side, np.arange(len(splats))], areas[side, np.arange(len(splats))]
    assert np.isclose(of[inner].sum() / own[inner].sum() * 1.2**2, 1, rtol=0.03)
    front = inner & (splats.centers[:, 2] < 0.003)
    assert abs(np.median(of[front] / own[front]) * 1.2**2 - 1) < 0.05


def test03_parts_give_the_same_as_often_as_they_are_made(rgb):
    splats, every = wall(1.0, 1.0, 0.05), falling(900)
    parts = [every.part(a, a + 400) for a in range(0, 900, 400)]
    first, again = (merge(sums(splats, part, CONE) for part in parts) for _ in range(2))
    assert np.array_equal(first.face, again.face) and first.count == 900 and first.escaped == again.escaped
    assert not np.array_equal(sums(splats, parts[0], RaySettings(cone=CONE.cone, bundle=8, seed=6)).face, first.face)


@pytest.mark.parametrize("cone", [0.0, 0.03])
def test04_of_gaze_meets_none_what_comes_through(rgb, cone):
    """A density along z, most of which a wall stops, and the light of every ray by all Gaussians in float64."""
    splats, eye, kappa = some(), np.array([0.1, -0.2, -1.5]), 8.0
    looker = lookers_of_law(vmf(rgb, (0, 0, 1), kappa))(eye)
    total, escaped = gaze_and_escaped(SplatArrays(splats, ns), looker, eye, cone)
    d = fibonacci_directions(20_000)
    share = np.exp(kappa * (d[:, 2] - 1))
    left = shares(splats, np.broadcast_to(eye, d.shape), d)[1]
    assert abs(total - 1) < 2e-3 and 0.1 < escaped < 0.95
    assert np.isclose(escaped, (share * left).sum() / share.sum(), atol=0.01 if cone == 0 else 0.02)
