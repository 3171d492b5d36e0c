import drjit as dr
import numpy as np
import pytest

from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions, uniform_directions
from nerg_mi.probes.kde import SphericalKde, SphericalKdeTable
from tests.reference.kde import kde as reference


@pytest.mark.parametrize("kappa", [1e-3, 5.0, 50.0, 900.0])
@pytest.mark.parametrize("count", [1, 40])
def test_close_to_exact_everywhere(kappa, count):
    rng = np.random.default_rng(0)
    mu = uniform_directions(count, rng)
    kde = SphericalKde(mu, [0, count], kappa, backend="llvm")
    # All over, near the peaks, and on the cube's edges and corners.
    edges = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
    edges = np.concatenate([edges, edges + 1e-6, edges - 1e-6])
    x = np.concatenate(
        [
            uniform_directions(5000, rng),
            mu,
            vmf.sample(np.repeat(mu, 9, 0), kappa, rng),
            edges / np.linalg.norm(edges, axis=1, keepdims=True),
        ]
    )
    peak = np.exp(vmf.log_normaliser(kappa))
    table = SphericalKdeTable(kde)
    assert np.abs(table.evaluate(x) - kde.evaluate(x)[0]).max() < 1e-4 * peak
    if kappa < 300:
        assert np.abs(table.evaluate(x) - reference(x, mu, [0, count], [kappa])[0]).max() < 1e-4 * peak
    assert table.evaluate(fibonacci_directions(8192)).min() >= 0


def test_only_what_is_used_is_evaluated():
    rng = np.random.default_rng(1)
    kde = SphericalKde(uniform_directions(30, rng), [0, 30], 60.0, backend="llvm")
    x = vmf.sample(np.tile([0.6, 0.0, 0.8], (2000, 1)), 100.0, rng)
    part, whole = SphericalKdeTable(kde, used=x), SphericalKdeTable(kde)
    assert np.array_equal(part.evaluate(x), whole.evaluate(x)) and part.evaluated < 0.2 * whole.evaluated


def test_one_probe_of_several_and_its_slope():
    import drjit.llvm.ad as ns

    rng = np.random.default_rng(2)
    kde = SphericalKde(uniform_directions(50, rng), [0, 20, 50], [5.0, 30.0], backend=ns)
    table = SphericalKdeTable(kde, probe=1)
    x0 = np.array([0.36, 0.48, 0.8])
    assert np.isclose(table.evaluate(x0[None])[0], kde.evaluate(x0[None])[1, 0], rtol=1e-3)
    x = ns.Array3f(x0.tolist())
    dr.enable_grad(x)
    side = np.array([0.8, -0.6, 0.0])  # along the sphere, where both are the same function
    dr.set_grad(x, ns.Array3f(side.tolist()))
    slope = dr.forward_to(table.density(x))[0]
    ends = np.array([x0 + h * side for h in (1e-3, -1e-3)])
    a, b = reference(
        ends / np.linalg.norm(ends, axis=1, keepdims=True),
        np.array(kde.part(1, 2)._rays).reshape(-1, 4)[:, :3],
        [0, 30],
        [30.0],
    )[0]
    assert np.isclose(slope, (a - b) / 2e-3, rtol=2e-2)


def test_too_sharp_for_a_table():
    kde = SphericalKde(np.array([[0.0, 0, 1]]), [0, 1], 1e8, backend="llvm")
    with pytest.raises(ValueError, match="evaluate the density directly"):
        SphericalKdeTable(kde)
    assert not SphericalKdeTable.fits(kde, 10**6)
