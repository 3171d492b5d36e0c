"""Cones: the rule on the sphere against Legendre polynomials, and bundles against Rayleigh's law."""

import drjit as dr
import numpy as np
import pytest
from scipy.special import eval_legendre

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.surfaces.sources import blurred, bundle


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test01_a_harmonic_is_multiplied_by_a_number(rgb, degree):
    sigma = 0.2
    d = rgb.Vector3f(fibonacci_directions(500).T.astype(np.float32))
    # Zonal harmonics about an axis of no symmetry; written out, since Dr.Jit has none.
    zonal = {
        0: lambda x: x * 0 + 1,
        1: lambda x: x,
        2: lambda x: 1.5 * x * x - 0.5,
        3: lambda x: 2.5 * x * x * x - 1.5 * x,
    }
    axis = dr.normalize(rgb.Vector3f(0.3, -0.5, 0.8))

    def density(u):
        # Fields gather single precision only.
        assert isinstance(u, rgb.Vector3f)
        return zonal[degree](dr.dot(u, axis))

    found = np.array(blurred(density, d, sigma))
    expected = 0.5 * (1 + eval_legendre(degree, np.cos(2 * sigma))) * np.array(zonal[degree](dr.dot(d, axis)))
    assert np.allclose(found, expected, atol=1e-5)


def test02_it_is_heat_on_the_sphere_to_the_fourth_order():
    for sigma in (0.02, 0.04):
        for degree in (1, 5, 12):
            rule = 0.5 * (1 + eval_legendre(degree, np.cos(2 * sigma)))
            # In the tangent plane the harmonic of degree l is a wave of the number l + 1/2, about.
            assert abs(rule - np.exp(-degree * (degree + 1) * sigma**2 / 2)) < 2 * (degree + 1) ** 4 * sigma**4 / 24


def test03_bundles_are_gaussian_unit_and_the_same_for_a_seed():
    d = fibonacci_directions(400)
    out = bundle(d, 0.05, 64, np.random.default_rng(3))
    assert out.shape == (400, 64, 3) and np.allclose(np.linalg.norm(out, axis=2), 1)
    angle = np.arccos(np.clip(np.einsum("nik,nk->ni", out, d), -1, 1)).ravel()
    for share in (0.1, 0.5, 0.9):
        assert abs(np.quantile(angle, share) / (0.05 * np.sqrt(-2 * np.log1p(-share))) - 1) < 0.01
    assert np.linalg.norm(out.mean(axis=1) - d, axis=1).mean() < 0.01
    assert np.array_equal(out, bundle(d, 0.05, 64, np.random.default_rng(3)))
    assert np.array_equal(bundle(d, 0, 2, np.random.default_rng(0)), np.repeat(d[:, None], 2, axis=1))
