"""Targets: what escapes, features for those who need them, two sets in one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.train.gaze_data import TargetNeeds, Targets, concatenate, observe

from .looks import LOG, NOWHERE, SMALL


def made(count, seed=0, **more):
    """Targets of ``count`` observers in five directions."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 5, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    truth, distance = rng.random((2, count, 5)).astype(np.float32)
    return Targets(
        rng.normal(size=(count, 3)).astype(np.float32),
        directions,
        truth,
        distance,
        rng.random((count, 5)) < 0.4,
        **more,
    )


@pytest.mark.parametrize(
    "config, needs",
    [
        (SMALL, TargetNeeds()),
        (replace(SMALL, semantic="snapshot"), TargetNeeds(semantic="snapshot")),
        (LOG, TargetNeeds(blind_rows=16)),
        (replace(LOG, escaped="nearest"), TargetNeeds(fill=True, blind_rows=16)),
    ],
)
def test_a_field_says_what_it_needs(config, needs):
    assert TargetNeeds.of(config) == needs


def test_what_escapes_is_counted_by_directions_and_by_gaze():
    targets = made(3)
    assert targets.escape_share == pytest.approx(targets.escaped.sum() / 15)
    assert targets.escaped_gaze == pytest.approx(targets.truth[targets.escaped].sum() / targets.truth.sum(), rel=1e-6)
    extent = np.array([1.0, 2.0, 3.0], np.float32)
    gaze = targets.truth * extent[:, None]
    narrow = made(3, extent=extent)
    assert narrow.escaped_gaze == pytest.approx(gaze[targets.escaped].sum() / gaze.sum(), rel=1e-6)


def test_two_sets_are_one_after_the_other():
    views = made(2, 1, extent=np.array([0.5, 0.7], np.float32), renew=lambda epoch: made(2, 1 + epoch))
    rays = made(3, 2, blind=np.ones((2, 4)), renew=lambda epoch: made(3, 2 + epoch))
    both = concatenate(rays, views)
    for name in ("positions", "directions", "truth", "distance", "escaped"):
        np.testing.assert_array_equal(getattr(both, name)[:3], getattr(rays, name))
        np.testing.assert_array_equal(getattr(both, name)[3:], getattr(views, name))
    np.testing.assert_allclose(both.extent, [4 * np.pi] * 3 + [0.5, 0.7], rtol=1e-6)
    assert both.blind is rays.blind and both.semantic is None
    np.testing.assert_array_equal(both.renew(4).truth[3:], made(2, 5).truth)
    assert concatenate(made(1), made(1)).renew is None


def test_features_are_those_of_a_radiance_field():
    positions, directions = np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1.0, 0]]])
    targets = observe(positions, directions, np.ones((1, 2)), NOWHERE)
    assert targets.semantic is None and (targets.distance == 2).all() and not targets.escaped.any()
    assert targets.positions.dtype == targets.directions.dtype == targets.truth.dtype == np.float32
    with pytest.raises(NergError, match="give one with --field"):
        observe(positions, directions, np.ones((1, 2)), NOWHERE, needs=TargetNeeds(semantic="snapshot"))
