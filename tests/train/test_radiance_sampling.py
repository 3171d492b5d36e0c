"""Tests of `nerg_mi.train.radiance_sampling`."""

from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Box
from nerg_mi.train.radiance_sampling import (
    Segments,
    StepTable,
    ThinnedSamples,
    clip_rays,
    compute_weights,
    find_occupied_steps,
    select_visible_samples,
    sum_along_rays,
)

# ---- Compositing of packed samples against a float64 reference and against finite differences ----


def weights_numpy(tau: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Weights (N,) of samples of optical depth ``tau`` (N,); ``ray`` (N,): index of each sample's ray."""
    out = np.zeros(len(tau))
    for r in np.unique(ray):
        mine = np.flatnonzero(ray == r)
        light = 1.0
        for i in mine:
            out[i] = light * (1 - np.exp(-tau[i]))
            light *= np.exp(-tau[i])
    return out


def ray_sum_numpy(x: np.ndarray, ray: np.ndarray, rays: int) -> np.ndarray:
    """Sum of ``x`` along each ray, (rays,)."""
    return np.bincount(ray, x, rays)


RAYS = 9


@pytest.fixture
def packed():
    """Rays of 0 to 40 samples, with rays 0, 4 and the last empty, followed by padding."""
    rng = np.random.default_rng(1)
    counts = [0, 3, 40, 1, 0, 7, 12, 2, 0]
    ray = np.repeat(np.arange(RAYS), counts)
    tau = rng.exponential(0.3, len(ray))
    padding = 5
    active = np.r_[np.ones(len(ray), bool), np.zeros(padding, bool)]
    padded_ray = np.r_[ray, np.full(padding, ray[-1])]
    padded_tau = np.r_[tau, rng.exponential(1, padding)]
    segments = Segments.find(ns.UInt32(padded_ray), ns.Bool(active), RAYS)
    return ray, tau, padded_tau, segments


def test_weights_and_sums_equal_the_reference(packed):
    ray, tau, padded_tau, segments = packed
    w = compute_weights(ns.Float(padded_tau), segments)
    expected = weights_numpy(tau, ray)
    assert np.allclose(w.numpy()[: len(ray)], expected, atol=2e-7)
    assert np.all(w.numpy()[len(ray) :] == 0)
    x = np.r_[tau, np.full(len(padded_tau) - len(tau), 100.0)]
    assert np.allclose(sum_along_rays(ns.Float(x), segments).numpy(), ray_sum_numpy(tau, ray, RAYS), atol=1e-6)


def test_the_ends_of_a_ray_are_written_once(packed, monkeypatch):
    """If several samples wrote to one address, the thread order would decide."""
    written, scatter = [], dr.scatter
    monkeypatch.setattr(dr, "scatter", lambda *a: (written.append(np.array(a[2])[np.array(a[3])]), scatter(*a)))
    ray, _, _, segments = packed
    Segments.find(segments.ray, segments.active, RAYS)
    assert [w.tolist() for w in written] == [np.unique(ray).tolist()] * 2


def test_opaque_samples_do_not_affect_other_rays():
    """An extremely dense sample must not reduce the precision of later rays."""
    tau = np.array([1e12, 1e12, 0.1, 0.2])
    segments = Segments.find(ns.UInt32([0, 0, 1, 1]), ns.Bool([True] * 4), 2)
    w = compute_weights(ns.Float(tau), segments).numpy()
    assert np.allclose(w, [1, 0, -np.expm1(-0.1), np.exp(-0.1) * -np.expm1(-0.2)], atol=1e-7)


def test_gradient_agrees_with_finite_differences(packed):
    ray, tau, padded_tau, segments = packed
    rng = np.random.default_rng(2)
    value, per_ray = rng.normal(size=len(padded_tau)), rng.normal(size=RAYS)

    def loss(t):
        w = weights_numpy(t, ray)
        return np.sum(per_ray * ray_sum_numpy(w * value[: len(ray)], ray, RAYS) ** 2)

    x = ns.Float(padded_tau)
    dr.enable_grad(x)
    sums = sum_along_rays(compute_weights(x, segments) * ns.Float(value), segments)
    dr.backward(dr.sum(sums * sums * ns.Float(per_ray)))
    g = dr.grad(x).numpy()
    h = 1e-5
    numeric = [(loss(tau + h * e) - loss(tau - h * e)) / (2 * h) for e in np.eye(len(tau))]
    assert np.allclose(g[: len(tau)], numeric, atol=2e-6)
    assert np.all(g[len(tau) :] == 0)


def test_forward_mode_agrees_with_reverse_mode(packed):
    ray, tau, padded_tau, segments = packed
    rng = np.random.default_rng(3)
    direction, out = rng.normal(size=len(padded_tau)), rng.normal(size=RAYS)

    def sums(x):
        return dr.sum(sum_along_rays(compute_weights(x, segments), segments) * ns.Float(out))

    x = ns.Float(padded_tau)
    dr.enable_grad(x)
    dr.backward(sums(x))
    x2 = ns.Float(padded_tau)
    dr.enable_grad(x2)
    dr.set_grad(x2, ns.Float(direction))
    y = sums(x2)
    forward = dr.forward_to(y)
    assert np.allclose(forward.numpy()[0], np.sum(dr.grad(x).numpy() * direction), atol=1e-5)


def test_forward_mode_agrees_with_reverse_mode_with_roulette(packed):
    ray, tau, padded_tau, segments = packed
    rng = np.random.default_rng(4)
    n = len(padded_tau)
    copies, before, out = ns.Float(rng.uniform(1, 9, n)), ns.Float(rng.uniform(0, 2, n)), ns.Float(rng.normal(size=n))
    thinned = ThinnedSamples(copies, before, ns.Float(rng.random(RAYS)))
    x = ns.Float(padded_tau)
    dr.enable_grad(x)
    w = compute_weights(x, segments, thinned)
    want = copies.numpy() * np.exp(-before.numpy()) * -np.expm1(-padded_tau) * (np.arange(n) < len(ray))
    assert np.allclose(dr.detach(w).numpy(), want, rtol=1e-5)
    dr.backward(dr.sum(w * out))
    back, x = dr.grad(x).numpy(), ns.Float(padded_tau)
    for direction in np.eye(n)[[0, 3, 20, len(ray) - 1, n - 1]]:
        dr.enable_grad(x)
        dr.set_grad(x, ns.Float(direction))
        forward = dr.forward_to(dr.sum(compute_weights(x, segments, thinned) * out))
        assert np.allclose(forward.numpy()[0], back @ direction, rtol=1e-4, atol=1e-5)


def test_distortion_equals_its_double_sum_and_its_derivative_finite_differences():
    """Barron et al. 2022, eq. 15, over all pairs in float64; rays of 0, 1 and many samples, and padding."""
    from nerg_mi.train.radiance_losses import distortion_loss
    from nerg_mi.train.radiance_sampling import RaySamples

    rng = np.random.default_rng(3)
    counts = [5, 0, 1, 17]
    ray = np.concatenate([np.repeat(np.arange(4), counts), [3, 3]]).astype(np.uint32)
    active = np.arange(25) < 23
    length = rng.uniform(0.02, 0.1, 25).astype(np.float32)
    t = np.concatenate([np.cumsum(length[ray == r]) for r in range(4)]).astype(np.float32)
    w = (rng.random(25) * active).astype(np.float32)
    segments = Segments.find(ns.UInt32(ray), ns.Bool(active), 4)
    samples = RaySamples(ns.UInt32(ray), ns.Float(t), ns.Float(length), None, segments, 23)

    def reference(w):
        out = np.zeros(4)
        for r in range(4):
            k = (ray == r) & active
            m, delta, x = (t[k] + 0.5 * length[k].astype(float)) / 2, length[k].astype(float) / 2, w[k]
            out[r] = np.sum(x[:, None] * x * np.abs(m[:, None] - m)) + np.sum(x * x * delta) / 3
        return out

    weight = ns.Float(w)
    dr.enable_grad(weight)
    loss = distortion_loss(weight, samples, 2.0)
    assert np.allclose(loss.numpy(), reference(w.astype(float)), rtol=1e-5, atol=1e-7)
    upstream = rng.random(4).astype(np.float32)
    dr.backward(dr.sum(loss * ns.Float(upstream)))
    numeric = np.zeros(25)
    for i in np.flatnonzero(active):
        step = np.zeros(25)
        step[i] = 1e-6
        numeric[i] = upstream @ (reference(w + step) - reference(w - step)) / 2e-6
    assert np.allclose(dr.grad(weight).numpy(), numeric, rtol=1e-4, atol=1e-5)
    tangent = rng.random(25).astype(np.float32)
    weight = ns.Float(w)
    dr.enable_grad(weight)
    dr.set_grad(weight, ns.Float(tangent))
    slope = dr.forward_to(distortion_loss(weight, samples, 2.0)).numpy()
    numeric = (reference(w + 1e-6 * tangent.astype(float)) - reference(w - 1e-6 * tangent.astype(float))) / 2e-6
    assert np.allclose(slope, numeric, rtol=1e-4, atol=1e-5)


# ---- Marching: each candidate has its ray and step, and no step of a training takes on more than it may ----

BOX = Box((-1, -1, -1), (1, 1, 1))


def rays(count, seed=0):
    """From around (0, 0, -2) upwards, all through the box."""
    rng = np.random.default_rng(seed)
    o = ns.Array3f(
        *[ns.Float(x.astype(np.float32)) for x in (*rng.uniform(-0.5, 0.5, (2, count)), np.full(count, -2.0))]
    )
    d = dr.normalize(
        ns.Array3f(*[ns.Float(x.astype(np.float32)) for x in (*rng.normal(0, 0.1, (2, count)), np.ones(count))])
    )
    return clip_rays(o, d, BOX, 0.01), ns.Float(rng.random(count).astype(np.float32))


@pytest.mark.parametrize("step", [0.2, 0.01, 0.0007])
def test_candidates_split_into_ray_and_step_like_integers(step):
    table = StepTable(ns, 0.01, 4, step, 0)
    n = table.steps
    index = np.unique(
        np.concatenate(
            [
                np.arange(3 * n),
                np.arange(1, 2**32 // n, 991) * n,
                np.arange(1, 2**32 // n, 991) * n - 1,
                [2**32 - 1, 2**31, 2**24 + 1],
            ]
        )
    ).astype(np.uint32)
    ray, k = table.split(ns.UInt32(index))
    assert np.array_equal(ray.numpy(), index // n) and np.array_equal(k.numpy(), index % n)


@pytest.mark.parametrize("stride", [16, 8, 4, 2, 1])
def test_density_pass_stays_within_its_limit_in_fog(stride):
    """Fog that fills the box: at every stride the limit on evaluations holds, and complete rays remain."""
    table, limit = StepTable(ns, 0.01, 4, stride / 200, 0), 5000
    r, offset = rays(300)
    calls = []

    def density(p, active):
        calls.append(dr.width(p))
        return dr.full(ns.Float, 0.1, dr.width(p))

    samples, covered = select_visible_samples(
        r, table, offset, lambda p, a: a, density, 1e-9, max_prepass_samples=limit
    )
    full, everything = select_visible_samples(r, table, offset, lambda p, a: a, density, 1e-9)
    assert everything == 300 and calls[0] <= limit and calls[1] == full.count
    counts = np.bincount(full.ray.numpy(), minlength=300)
    assert covered == min(300, int(np.searchsorted(np.cumsum(counts), limit, side="right")))
    assert (covered < 300) == (calls[1] > limit) and calls[0] == counts[:covered].sum()
    # The remaining rays are complete, and the same as without a limit.
    for name in ("ray", "t", "length"):
        got, expected = getattr(samples, name).numpy(), getattr(full, name).numpy()
        assert np.array_equal(got, expected[: counts[:covered].sum()])
    assert samples.prepass_samples_per_ray == pytest.approx(calls[0] / covered)


def test_batch_and_density_pass_may_both_be_full():
    table = StepTable(ns, 0.01, 4, 0.02, 0)
    r, offset = rays(300)
    fog = lambda p, a: dr.full(ns.Float, 0.1, dr.width(p))
    samples, covered = select_visible_samples(
        r, table, offset, lambda p, a: a, fog, 1e-9, pad=2000, max_prepass_samples=5000
    )
    assert dr.width(samples.ray) == 2000 and 0 < covered < 40
    counts = np.bincount(samples.ray.numpy()[samples.segments.active.numpy()], minlength=300)
    assert (counts[:covered] > 50).all() and not counts[covered:].any()
    # Of all samples of the density pass, not only those in the batch.
    assert samples.prepass_samples_per_ray == pytest.approx(100, rel=0.1)


def test_a_single_ray_that_is_too_long_is_refused():
    r, offset = rays(3)
    with pytest.raises(ValueError, match="a single ray has more than 50 steps"):
        find_occupied_steps(r, StepTable(ns, 0.01, 4, 0.01, 0), offset, lambda p, a: a, max_steps=50)


@pytest.mark.parametrize("growth", [0, 1 / 16])
def test_edges_rise_by_the_rule_and_one_step_beyond_the_end(growth):
    """Jitter shifts every edge by up to a step: a ray shifted by a whole step still ends beyond ``far``."""
    table = StepTable(ns, 0.1, 4.03, 0.05, growth)
    edges = table.edges.numpy()[: table.steps + 1].astype(float)
    np.testing.assert_allclose(np.diff(edges), np.maximum(0.05, growth * edges[:-1]), rtol=1e-4)
    assert edges[0] == pytest.approx(0.1) and edges[-3] < 4.03 <= edges[-2]


def test_more_candidates_than_indices_are_refused():
    """Indices have 32 bits: one more would wrap around."""
    table = SimpleNamespace(steps=2, split=lambda index: pytest.fail("candidates are made"))
    with pytest.raises(ValueError, match="2147483648.*2"):
        find_occupied_steps(SimpleNamespace(count=2**31), table, ns.Float(0), lambda p, a: a)
