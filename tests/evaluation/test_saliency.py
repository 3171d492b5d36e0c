"""One map per metric from one density: closed forms, optimality, and the numbers of pysaliency."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from nerg_mi.errors import NergError
from nerg_mi.evaluation import metrics
from nerg_mi.evaluation.saliency import make_metric_maps, score_saliency

H, W, SIGMA = 24, 32, 2.0
Y, X = np.mgrid[:H, :W]
DENSITY = np.exp(-((X - 20) ** 2 + (Y - 8) ** 2) / 20) + 0.4 * np.exp(-((X - 8) ** 2 + (Y - 16) ** 2) / 12) + 0.01
PRIOR = np.exp(-((X - 16) ** 2 + (Y - 12) ** 2) / 120)
RNG = np.random.default_rng(0)
FIXATIONS = RNG.choice(H * W, 400, p=(DENSITY / DENSITY.sum()).ravel())
OTHERS = RNG.choice(H * W, 1000, p=(PRIOR / PRIOR.sum()).ravel())


def smooth(density):
    """A Gaussian as in pysaliency's fixation maps."""
    images = np.reshape(density, (-1, H, W))
    return np.stack([gaussian_filter(i, SIGMA, mode="nearest") for i in images]).reshape(np.shape(density))


def maps(density=DENSITY, **options):
    return make_metric_maps(density.ravel(), PRIOR.ravel(), smooth, **options)


def scores(density):
    return score_saliency(maps(density), PRIOR.ravel(), FIXATIONS, OTHERS, smooth)


def test_the_scores_are_those_of_pysaliency():
    spec = importlib.util.find_spec("pysaliency")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("pysaliency is not installed")
    # Its package imports setuptools' former pkg_resources; the metrics need NumPy only.
    file = Path(spec.submodule_search_locations[0], "metrics.py")
    module = importlib.util.spec_from_file_location("pysaliency_metrics", file)
    theirs = importlib.util.module_from_spec(module)
    module.loader.exec_module(theirs)
    ys, xs = np.divmod(FIXATIONS, W)
    ours, m = scores(DENSITY), maps()
    image = lambda values: values.reshape(H, W)
    empirical = image(smooth(np.bincount(FIXATIONS, minlength=H * W).astype(float)))
    assert np.isclose(ours.nss, theirs.NSS(image(m.density), xs, ys).mean(), rtol=1e-12)
    assert np.isclose(ours.cc, theirs.CC(image(m.smooth), empirical), rtol=1e-12)
    assert np.isclose(ours.kld, theirs.image_based_kl_divergence(image(m.smooth), empirical), rtol=1e-9)
    assert np.isclose(ours.sim, theirs.SIM(image(m.sim), empirical), rtol=1e-12)
    p, q = (theirs.convert_saliency_map_to_density(v) for v in (DENSITY, PRIOR))
    assert np.isclose(ours.information_gain, np.log2(p[ys, xs] / q[ys, xs]).mean(), rtol=1e-12)


def brute_auc(positives, negatives):
    """Area under the ROC curve by comparing all pairs, as general_roc of pysaliency integrates it."""
    a, b = np.asarray(positives)[:, None], np.asarray(negatives)
    return ((a > b) + 0.5 * (a == b)).mean()


def test_areas_under_the_curve_count_all_pairs():
    m, ours = maps(), scores(DENSITY)
    assert np.isclose(ours.auc, brute_auc(m.density[FIXATIONS], m.density), rtol=1e-12)
    ratio = (DENSITY / PRIOR).ravel()
    assert np.isclose(ours.sauc, brute_auc(ratio[FIXATIONS], ratio[OTHERS]), rtol=1e-12)
    # With solid angles each direction counts by its share.
    values, weights = RNG.integers(0, 9, 50).astype(float), RNG.integers(1, 4, 50)
    repeated = np.repeat(values, weights)
    at = np.array([0.0, 4, 4.5, 9])
    assert np.allclose(metrics.auc(at, values, weights), metrics.auc(at, repeated))


def test_the_prior_gains_nothing():
    ours = scores(PRIOR)
    assert np.isclose(ours.information_gain, 0, atol=1e-12) and np.isclose(ours.sauc, 0.5)
    assert next(iter(ours.to_dict())) == "information_gain"


@pytest.mark.parametrize("name, better", [("cc", 1), ("kld", -1), ("sim", 1), ("sauc", 1)])
def test_each_metric_prefers_its_own_map(name, better):
    """Scores of many data sets drawn from the density are best with the map of the metric."""
    m, p = maps(), (DENSITY / DENSITY.sum()).ravel()
    candidates = {"density": m.density, "smooth": m.smooth, "sim": m.sim, "ratio": m.ratio}
    expected = {"cc": "smooth", "kld": "smooth", "sim": "sim", "sauc": "ratio"}[name]
    rng, means = np.random.default_rng(1), dict.fromkeys(candidates, 0.0)
    for _ in range(60):
        counts = rng.multinomial(100, p)
        empirical = smooth(counts.astype(float))
        for key, candidate in candidates.items():
            if name == "sauc":
                value = metrics.auc(np.repeat(candidate, counts), candidate[OTHERS]).mean()
            else:
                value = float(getattr(metrics, name)(empirical, candidate))
            means[key] += better * value / 60
    # The smoothed density is the mean of the empirical ones; CC averages them after dividing by their deviations.
    assert means[expected] >= max(means.values()) - (2e-3 if name == "cc" else 0)
    assert means[expected] > means["density"] + 1e-3


def test_the_map_of_sim_is_the_optimum_of_its_samples():
    """No density near it has a larger expected SIM, with solid angles that differ."""
    weights = 0.5 + RNG.random(40)
    p = RNG.random(40) ** 3
    m = make_metric_maps(p, np.ones(40), lambda d: d, weights, count=20, samples=50, seed=3)
    w = weights / weights.sum()
    drawn = np.random.default_rng(3).multinomial(20, w * p / (w * p).sum(), 50) / (20 * w)
    expected = lambda q: metrics.sim(drawn, np.broadcast_to(q, drawn.shape), weights).mean()
    best = expected(m.sim)
    assert np.isclose(w @ m.sim, 1)
    for _ in range(300):
        i, j = RNG.choice(40, 2, replace=False)
        step = min(0.3 * m.sim[i] * w[i], 0.02)
        q = m.sim.copy()
        q[i] -= step / w[i]
        q[j] += step / w[j]
        assert expected(q) <= best + 1e-9


def test_unusable_densities_and_fixations_are_refused():
    for density in (-DENSITY, 0 * DENSITY, np.where(X > 3, DENSITY, np.nan)):
        with pytest.raises(NergError, match="density"):
            maps(density)
    with pytest.raises(NergError, match="0 and 1000"):
        score_saliency(maps(), PRIOR.ravel(), [], OTHERS, smooth)


@pytest.mark.parametrize("bad", [np.inf, np.nan, -1.0])
@pytest.mark.parametrize("name", ["density", "prior", "weights"])
def test_invalid_densities_and_weights_are_named(bad, name):
    arguments = {"density": [1, 2, 3], "prior": [1, 1, 1], "weights": [1, 1, 2]} | {name: [1, bad, 1]}
    with pytest.raises(NergError, match=name):
        make_metric_maps(**arguments, smooth=lambda density: density)
