"""From rays to probes to targets: rotations, frames, fresh directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Similarity
from nerg_mi.probes.probes import place_probes
from nerg_mi.train.gaze_data import TargetNeeds, probes_of_rays, rotated_sets, targets_of_probes, targets_of_rays

from .looks import PROBES


def test_sets_of_directions_are_turned_each_its_own_way():
    sets = rotated_sets(64, 3, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(sets, axis=-1), 1)
    np.testing.assert_allclose(
        sets @ sets.transpose(0, 2, 1), np.broadcast_to((sets @ sets.transpose(0, 2, 1))[0], (3, 64, 64)), atol=1e-12
    )
    assert np.abs(sets[0] - sets[1]).max() > 0.1


def test_rays_are_aligned_with_the_field(rays, wall):
    """Half the size, turned and moved: the same supervision, in the field's frame."""
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, (0.3, -0.4, 0.5)
    inverse = np.linalg.inv(matrix)
    moved = replace(
        rays, origin=rays.origin @ inverse[:3, :3].T + inverse[:3, 3], direction=rays.direction @ turn, hit=None
    )
    probes = lambda r, radius: place_probes(r, radius, count=8, min_rays=8, kappa_rule="fixed", seed=1)
    a = targets_of_probes(probes(rays, 0.5), wall, 32)
    b = targets_of_probes(probes(moved, 0.25), replace(wall, align=Similarity(matrix)), 32)
    np.testing.assert_allclose(b.positions, a.positions, atol=1e-5)
    back = b.directions @ turn
    np.testing.assert_allclose(back, a.directions, atol=1e-6)
    # The distances are those from the field's frame: traced again along the same rays.
    np.testing.assert_allclose(np.linalg.norm(b.directions, axis=-1), 1, atol=1e-6)
    inside = ~b.escaped
    p = b.positions[:, None] + b.directions * b.distance[..., None]
    assert inside.any() and np.abs(p[inside][:, 0] - 1.5).max() < 0.02


def test_kernels_that_vanish_between_all_directions_are_refused(rays, wall):
    probes = place_probes(rays, 0.5, count=2, min_rays=8, kappa_rule="fixed", kappa=1e8, seed=1)
    with pytest.raises(NergError, match="16.*--kappa"):
        targets_of_probes(probes, wall, 16)


def test_probes_are_placed_as_the_settings_say(rays):
    probes = probes_of_rays(rays, PROBES, seed=3)
    assert 1 <= len(probes) <= PROBES.count and (probes.kappa == PROBES.kappa).all()
    assert (
        probes.radius == PROBES.radius and PROBES.min_rays <= probes.counts.min() <= probes.counts.max() <= PROBES.cap
    )
    at = np.array([[-0.6, 0, 1.6]])
    np.testing.assert_array_equal(probes_of_rays(rays, PROBES, at).queries, at)
    lattice = probes_of_rays(rays, replace(PROBES, placement="grid", spacing=0.3))
    assert np.diff(np.unique(lattice.queries[:, 1].round(9))) == pytest.approx(0.3)


def test_directions_are_turned_anew_where_they_are_to_be(rays, wall):
    """Of the same probes; the same ones for the same epoch."""
    targets = targets_of_rays(rays, wall, replace(PROBES, fresh=True), seed=5)
    first, again, second = targets.renew(1), targets.renew(1), targets.renew(2)
    np.testing.assert_array_equal(first.directions, again.directions)
    np.testing.assert_array_equal(first.positions, targets.positions)
    for a, b in ((first, targets), (first, second)):
        assert np.abs(a.directions - b.directions).max() > 0.1
    assert targets_of_rays(rays, wall, PROBES).renew is None


def test_the_blind_density_is_made_for_whoever_needs_it(rays, wall):
    assert targets_of_rays(rays, wall, PROBES).blind is None
    wide, narrow = (
        targets_of_rays(rays, wall, replace(PROBES, mix_kappa=kappa), TargetNeeds(blind_rows=12)).blind
        for kappa in (10.0, 40.0)
    )
    assert wide.shape == narrow.shape == (12, 24)
    # The log of a density: narrower kernels reach higher.
    assert narrow.max() > wide.max() + 0.5
