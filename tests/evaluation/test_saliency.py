"""Metrics against the constants of pysaliency's tests and a closed form on the sphere."""

import numpy as np
import pytest
from scipy.integrate import trapezoid

from nerg_mi.evaluation import metrics
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions, latlong_grid

y, x = np.mgrid[0:40, 0:40]
MODEL = np.exp(-0.5 * ((x - 20.0) ** 2 + (y - 20.0) ** 2) / np.sqrt(40**2 + 40**2)).ravel()
GOLD = np.exp(-0.5 * ((x - 10.0) ** 2 + (y - 25.0) ** 2) / 30).ravel()
FIXATIONS = [(0, 10), (1, 11), (2, 12), (2, 12), (2, 12), (1, 21), (5, 25), (3, 33)]  # x, y
AT_GAZE = np.array([MODEL[fy * 40 + fx] for fx, fy in FIXATIONS])


def test_pysaliency_constants():
    constant = np.ones(1600)
    assert np.isclose(metrics.kld(constant, MODEL), 0.8396272788909165, rtol=1e-12)
    assert np.isclose(metrics.sim(MODEL, constant), 0.5439198346677914, rtol=1e-12)
    assert np.isclose(metrics.kld(GOLD, MODEL), 1.2534306556652481, rtol=1e-12)
    assert np.isclose(metrics.sim(GOLD, MODEL), 0.3700539657911494, rtol=1e-12)
    assert np.isclose(metrics.cc(GOLD, MODEL), 0.23097615739142985, rtol=1e-12)
    nss = metrics.nss(MODEL, AT_GAZE)
    want = [
        -0.821596006113,
        -0.789526121554,
        -0.740616174533,
        -0.740616174533,
        -0.740616174533,
        -0.707322347863,
        -0.433094498355,
        -0.800070419267,
    ]
    assert np.allclose(nss, want, atol=1e-11)
    assert np.isclose(nss.mean(), -0.721682239594, atol=1e-11)
    assert np.isclose(0.5 * (nss[:5].mean() + nss[5:].mean()), -0.706711609374, atol=1e-11)


def sphere_pair(width, height):
    """κ = 30 at colatitude 20 degrees, κ = 10 at 40, on a panorama."""
    directions, weights = latlong_grid(width, height)
    mean = lambda degrees: np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees)), 0.0])
    p = np.exp(vmf.log_density(directions, mean(20), 30.0))
    q = np.exp(vmf.log_density(directions, mean(40), 10.0))
    return p, q, weights


def test_sphere_needs_solid_angles():
    truth = 1.0149169523431745  # closed form of KL(vMF || vMF)
    p, q, w = sphere_pair(128, 64)
    assert np.isclose(metrics.kld(p, q, w), 1.0148220, atol=5e-7)
    assert np.isclose(metrics.kld(p, q), 0.6884715, atol=5e-7)  # unweighted: wrong by a third
    assert np.isclose(metrics.cc(p, q, w), 0.53400, atol=1e-5)
    assert np.isclose(metrics.cc(p, q), 0.58427, atol=1e-5)
    p, q, w = sphere_pair(1024, 512)
    assert np.isclose(metrics.kld(p, q, w), truth, atol=3e-6)
    A = vmf.mean_resultant_length
    closed = (
        vmf.log_normaliser(30.0)
        - vmf.log_normaliser(10.0)
        + 30 * (A(30.0) - 1)
        - 10 * (A(30.0) * np.cos(np.radians(20)) - 1)
    )
    assert np.isclose(closed, truth, rtol=1e-12)


def test_identity_scale_and_batches():
    rng = np.random.default_rng(0)
    p, q, w = rng.gamma(0.5, size=(4, 3, 50)), rng.gamma(0.5, size=(4, 3, 50)), rng.random(50)
    assert np.allclose(metrics.kld(p, 7 * p, w), 0, atol=1e-12) and np.allclose(metrics.cc(p, 3 * p + 2, w), 1)
    assert np.allclose(metrics.sim(p, 5 * p, w), 1) and np.allclose(metrics.mae(p, p, w), 0)
    for score in (metrics.kld, metrics.cc, metrics.sim, metrics.mae):
        batch = score(p, q, w)
        assert batch.shape == (4, 3) and np.isclose(batch[2, 1], score(p[2, 1], q[2, 1], w))
        assert np.allclose(score(p, q, w), score(p, q, 9 * w))  # any unit of solid angle
        each = rng.random(p.shape)  # weights of each map's own
        assert np.isclose(score(p, q, each)[2, 1], score(p[2, 1], q[2, 1], each[2, 1]))
    assert (metrics.kld(p, q, w) > 0).all()
    assert np.isclose(metrics.mae(np.array([1.0, 3]), np.array([2.0, 5]), np.array([1.0, 3])), 1.75)


@pytest.mark.parametrize("a", ["zeros", "ones", "peak", "tiny", "negative"])
@pytest.mark.parametrize("b", ["zeros", "ones", "peak", "tiny", "negative"])
def test_defined_everywhere(a, b):
    maps = {
        "zeros": np.zeros(64),
        "ones": np.full(64, 0.1),
        "peak": np.eye(64)[5],
        "tiny": np.eye(64)[9] * 1e-300,
        "negative": np.linspace(-1, 1, 64),
    }
    p, q = maps[a], maps[b]
    for score in (metrics.kld, metrics.cc, metrics.sim, metrics.mae):
        assert np.isfinite(score(p, q))
    assert np.isfinite(metrics.nss(p, p[:4])).all()
    if a == "ones":
        assert metrics.cc(p, q) == 0 and metrics.cc(q, p) == 0 and (metrics.nss(p, p[:4]) == 0).all()
        assert np.isclose(metrics.kld(p, maps["zeros"]), 0)  # zeros know nothing: uniform


@pytest.mark.parametrize("scale", [1e-307, 1e-200, 1e-150, 1e150, 1e300])
def test_correlation_of_maps_of_any_scale(scale):
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 500)) - 0.3
    assert np.isclose(metrics.cc(a * scale, b), metrics.cc(a, b), rtol=1e-12)
    assert np.isclose(metrics.cc(a, b * scale), np.corrcoef(a, b)[0, 1], rtol=1e-12)
    assert np.isclose(metrics.nss(a * scale, a[:1] * scale), metrics.nss(a, a[:1]), rtol=1e-12)
    assert metrics.cc(np.full(500, scale), b) == 0


def test_log_score_and_information():
    density = np.array([[0.2, 0.4], [0.1, 0.1]])
    assert np.allclose(metrics.log_score(density), np.log(density).mean(axis=1))
    assert np.isclose(metrics.information_gain(np.full(5, 0.4), np.full(5, 0.1)), 2.0)
    assert np.isfinite(metrics.log_score(np.array([0.0, -1.0])))


def test_epsilon_bounds_the_cost_of_a_zero():
    truth, guess = np.eye(100)[3], np.eye(100)[4]
    assert metrics.kld(truth, guess) > 40 > 8 > metrics.kld(truth, guess, eps=0.1) > 1


def test_refusals():
    with pytest.raises(ValueError, match="same directions"):
        metrics.cc(np.zeros(4), np.zeros(5))
    with pytest.raises(ValueError, match="solid angles"):
        metrics.cc(np.zeros(4), np.zeros(4), -np.ones(4))


def test_auc_of_each_fixation_against_all_pixels():
    """pysaliency's constants; its AUC takes all pixels for what was not looked at."""
    expected = [0.099375, 0.158125, 0.241875, 0.241875, 0.241875, 0.291875, 0.509375, 0.138125]
    np.testing.assert_allclose(metrics.sauc(AT_GAZE[:, None], MODEL), expected, atol=1e-12)
    np.testing.assert_allclose(metrics.sauc(AT_GAZE, MODEL), 0.2403125, atol=1e-12)


def test_auc_judd_of_a_picture():
    """Threshold by threshold, as the original counts pixels."""
    fixated = np.zeros(1600, bool)
    fixated[[fy * 40 + fx for fx, fy in FIXATIONS]] = True
    at = np.sort(MODEL[fixated])[::-1]
    hits, false = [0.0], [0.0]
    for k, threshold in enumerate(at):
        hits.append((k + 1) / len(at))
        false.append(((MODEL >= threshold).sum() - k - 1) / (1600 - len(at)))
    expected = trapezoid([*hits, 1.0], [*false, 1.0])
    assert metrics.auc_judd(MODEL, at, fixated=fixated) == pytest.approx(expected)


def test_auc_of_densities_on_the_sphere():
    """A map that knows the cap that everybody looks at: the area of the cap is what is left to be wrong about."""
    d = fibonacci_directions(4000)
    cap = (d[:, 2] > 0.5).astype(float)
    assert metrics.auc_judd(cap, np.ones(7)) == pytest.approx(1 - 0.25 / 2, abs=1e-3)
    assert metrics.auc_judd(np.ones(4000), np.ones(7)) == pytest.approx(0.5)
    rng = np.random.default_rng(0)
    values = np.exp(3 * d[:, 2])
    gaze = rng.choice(values, 500, p=values / values.sum())
    assert metrics.auc_judd(values, gaze) == pytest.approx(float(metrics.sauc(gaze, values)), abs=5e-3)
    assert metrics.sauc(gaze, gaze) == pytest.approx(0.5)
    np.testing.assert_allclose(metrics.sauc([[1.0], [3.0]], [2.0, 2.0]), [0, 1])
