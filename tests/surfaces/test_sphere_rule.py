"""Directions over the sphere: all of it, and as exact for narrow densities as for wide ones."""

import numpy as np
import pytest

from nerg_mi.surfaces.sources import sphere_rule

MEAN = np.array([0.3, -0.5, 0.81]) / np.linalg.norm([0.3, -0.5, 0.81])


def law(kappa):
    return lambda d: kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(kappa * (d @ MEAN - 1))


@pytest.mark.parametrize("kappa", [0.1, 40.0, 3000.0])
def test01_totals_and_halves_of_laws(kappa):
    directions, angles = sphere_rule(law(kappa), 1 << 15)
    assert np.isclose(angles.sum(), 4 * np.pi, rtol=1e-12)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-14)
    share = angles * law(kappa)(directions)
    assert abs(share.sum() - 1) < 1e-3
    # A vertical plane through the middle of the law leaves half of it on either side.
    side = directions @ np.cross(MEAN, [0, 0, 1]) > 0
    assert abs(share[side].sum() - 0.5) < 1e-3
    assert np.allclose(sphere_rule(lambda d: np.zeros(len(d)), 1)[1].sum(), 4 * np.pi)


def test02_upright_planes_cut_a_uniform_density_by_their_angle():
    directions, angles = sphere_rule(lambda d: np.ones(len(d)), 1 << 14)
    turn = np.arctan2(directions[:, 1], directions[:, 0])
    for edge in (0.1, 0.7, np.pi / 2):
        assert np.isclose(angles[(turn > 0) & (turn < edge)].sum(), 2 * edge, atol=0.004)
    with pytest.raises(ValueError, match="a direction"):
        sphere_rule(lambda d: np.ones(len(d)), 0)
