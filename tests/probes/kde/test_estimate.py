import drjit as dr
import numpy as np
import pytest

from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions, uniform_directions
from nerg_mi.probes.kde import SphericalKde
from tests.reference.kde import kde as reference


def ragged(seed=0, counts=(1, 7, 300, 64)):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    return uniform_directions(offsets[-1], rng), offsets, rng.uniform(0.5, 90, len(counts)), rng


def test_agrees_with_float64():
    rays, offsets, kappa, rng = ragged()
    x = fibonacci_directions(333)
    got = SphericalKde(rays, offsets, kappa, backend="llvm").evaluate(x)
    assert np.allclose(got, reference(x, rays, offsets, kappa), rtol=2e-4, atol=1e-6)

    weights = rng.random(len(rays))
    got = SphericalKde(rays, offsets, kappa, weights, "llvm").evaluate(x)
    assert np.allclose(got, reference(x, rays, offsets, kappa, weights), rtol=2e-4, atol=1e-6)


def test_own_directions_for_each_probe():
    rays, offsets, kappa, rng = ragged()
    kde = SphericalKde(rays, offsets, kappa, backend="llvm")
    x = uniform_directions(4 * 50, rng).reshape(4, 50, 3)
    got = kde.evaluate(x)
    for p in range(4):
        assert np.allclose(got[p], kde.evaluate(x[p])[p], rtol=1e-6)


@pytest.mark.parametrize("kappa", [1e-8, 1e-3, 1.0, 100.0])
def test_integrates_to_one(kappa):
    rays, offsets, _, _ = ragged()
    density = SphericalKde(rays, offsets, kappa, backend="llvm").evaluate(fibonacci_directions(8192))
    assert np.allclose(density.mean(axis=1, dtype=np.float64) * 4 * np.pi, 1, atol=1e-3)


def test_extreme_concentration_is_finite_and_right():
    mu = np.array([[0.0, 0.6, 0.8]])
    kde = SphericalKde(mu, [0, 1], 1e8, backend="llvm")
    assert np.isclose(kde.evaluate(mu)[0, 0], np.exp(vmf.log_normaliser(1e8)), rtol=1e-5)
    assert kde.evaluate(-mu)[0, 0] == 0


def test_gradient_to_the_direction():
    import drjit.llvm.ad as ns

    rays, offsets, kappa, _ = ragged()
    kde = SphericalKde(rays, offsets, kappa, backend=ns)
    x0 = np.array([0.36, 0.48, 0.8])
    x = ns.Array3f(x0.tolist())
    dr.enable_grad(x)
    dr.set_grad(x, ns.Array3f(1, 0, 0))
    slope = dr.forward_to(kde.density(ns.UInt32(2), x))
    h = 1e-5
    # Off the sphere the kernel is exp(-κ|x - μ|²/2): differentiate that.
    a, b = offsets[2:4]
    f = lambda y: np.exp(vmf.log_density(y, rays[a:b], kappa[2])).mean()
    want = (f(x0 + [h, 0, 0]) - f(x0 - [h, 0, 0])) / (2 * h)
    assert np.isclose(slope[0], want, rtol=1e-3)


def test_refusals():
    rays, offsets, kappa, _ = ragged()
    with pytest.raises(ValueError, match="probe 1 has no ray"):
        SphericalKde(rays, [0, 5, 5, len(rays)], 1.0, backend="llvm")
    with pytest.raises(ValueError, match="do not fit"):
        SphericalKde(rays, [0, 5], 1.0, backend="llvm")
    with pytest.raises(ValueError, match="all zero"):
        SphericalKde(rays, [0, len(rays)], 1.0, np.zeros(len(rays)), "llvm")
    with pytest.raises(ValueError, match="expected"):
        SphericalKde(rays, offsets, kappa, backend="llvm").evaluate(np.zeros((2, 5, 3)))


@pytest.mark.parametrize("weighted", [False, True])
def test_a_part_is_the_same_densities(weighted):
    rays, offsets, kappa, rng = ragged()
    # Some rays of each probe weigh much more than others: equal weights would be off by a large share of the peak.
    weights = rng.random(len(rays)) ** 4 if weighted else None
    kde, x = SphericalKde(rays, offsets, kappa, weights, "llvm"), fibonacci_directions(200)
    whole = kde.evaluate(x)
    for first, last in [(0, 2), (1, 3), (2, 4), (3, 4), (0, 4)]:
        part = kde.part(first, last)
        assert part.count == last - first
        assert np.allclose(part.evaluate(x), whole[first:last], rtol=1e-5, atol=1e-7)
