"""Direction encoding against the formulas of the spherical harmonics."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import encode_direction
from tests.reference import fields_numpy as reference


def directions(n=200):
    d = np.random.default_rng(0).normal(size=(n, 3))
    d = np.concatenate([d, np.eye(3), -np.eye(3), [[1, 1, 0], [0, -1, 1]]])
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test01_values(degree):
    d = directions()
    out = encode_direction(ns.Array3f(d.T), degree)
    assert len(out) == degree**2
    for i, (o, e) in enumerate(zip(out, reference.harmonics(d).T)):
        got = np.broadcast_to(o.numpy() if hasattr(o, "numpy") else o, e.shape)
        assert np.allclose(got, e, atol=1e-6), i


def test02_orthonormal_on_the_sphere():
    # Reference of the reference: ∫ Y_i Y_j dω = δ_ij, by Gauss-Legendre in z and the trapezoid rule in φ.
    z, w = np.polynomial.legendre.leggauss(16)
    φ = 2 * np.pi * np.arange(16) / 16
    z, φ = (a.ravel() for a in np.meshgrid(z, φ))
    s = np.sqrt(1 - z**2)
    y = reference.harmonics(np.stack([s * np.cos(φ), s * np.sin(φ), z], -1))
    gram = (y * np.tile(w, 16)[:, None] * 2 * np.pi / 16).T @ y
    assert np.allclose(gram, np.eye(16), atol=1e-12)


@pytest.mark.parametrize("degree", [0, -1, 11])
def test03_degree_out_of_range(degree):
    with pytest.raises(ValueError, match="1..10"):
        encode_direction(ns.Array3f(0, 0, 1), degree)
