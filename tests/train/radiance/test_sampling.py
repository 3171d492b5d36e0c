"""Marching: each candidate has its ray and step, and no step of a training takes on more than it may."""

from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Box
from nerg_mi.train.radiance_sampling import StepTable, occupied_steps, rays_in_box, visible_samples

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
    return rays_in_box(o, d, BOX, 0.01), ns.Float(rng.random(count).astype(np.float32))


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
def test_the_pass_stays_within_its_bound_in_fog(stride):
    """Fog that fills the box: at every stride the network is asked at no more points, and whole rays remain."""
    table, most = StepTable(ns, 0.01, 4, stride / 200, 0), 5000
    r, offset = rays(300)
    asked = []

    def density(p, active):
        asked.append(dr.width(p))
        return dr.full(ns.Float, 0.1, dr.width(p))

    samples, covered = visible_samples(r, table, offset, lambda p, a: a, density, 1e-9, most=most)
    whole, everything = visible_samples(r, table, offset, lambda p, a: a, density, 1e-9)
    assert everything == 300 and asked[0] <= most and asked[1] == whole.count
    counts = np.bincount(whole.ray.numpy(), minlength=300)
    assert covered == min(300, int(np.searchsorted(np.cumsum(counts), most, side="right")))
    assert (covered < 300) == (asked[1] > most) and asked[0] == counts[:covered].sum()
    # The rays that remain are complete, and the same as without a bound.
    for name in ("ray", "t", "length"):
        got, expected = getattr(samples, name).numpy(), getattr(whole, name).numpy()
        assert np.array_equal(got, expected[: counts[:covered].sum()])
    assert samples.looked == pytest.approx(asked[0] / covered)


def test_the_batch_and_the_pass_may_both_be_full():
    table = StepTable(ns, 0.01, 4, 0.02, 0)
    r, offset = rays(300)
    fog = lambda p, a: dr.full(ns.Float, 0.1, dr.width(p))
    samples, covered = visible_samples(r, table, offset, lambda p, a: a, fog, 1e-9, pad=2000, most=5000)
    assert dr.width(samples.ray) == 2000 and 0 < covered < 40
    counts = np.bincount(samples.ray.numpy()[samples.segments.active.numpy()], minlength=300)
    assert (counts[:covered] > 50).all() and not counts[covered:].any()
    # Of all that the pass looked at, not only of what the batch took.
    assert samples.looked == pytest.approx(100, rel=0.1)


def test_a_ray_that_alone_is_too_long_is_refused():
    r, offset = rays(3)
    with pytest.raises(ValueError, match="a single ray has more than 50 steps"):
        occupied_steps(r, StepTable(ns, 0.01, 4, 0.01, 0), offset, lambda p, a: a, most=50)


@pytest.mark.parametrize("growth", [0, 1 / 16])
def test_edges_rise_by_the_rule_and_one_step_beyond_the_end(growth):
    """Jitter shifts every edge by up to a step: a ray that is shifted by a whole one still ends beyond ``far``."""
    table = StepTable(ns, 0.1, 4.03, 0.05, growth)
    edges = table.edges.numpy()[: table.steps + 1].astype(float)
    np.testing.assert_allclose(np.diff(edges), np.maximum(0.05, growth * edges[:-1]), rtol=1e-4)
    assert edges[0] == pytest.approx(0.1) and edges[-3] < 4.03 <= edges[-2]


def test_more_candidates_than_indices_are_refused():
    """They are counted in 32 bits: one more would be the first again."""
    table = SimpleNamespace(steps=2, split=lambda index: pytest.fail("candidates are made"))
    with pytest.raises(ValueError, match="2147483648.*2"):
        occupied_steps(SimpleNamespace(count=2**31), table, ns.Float(0), lambda p, a: a)
