import drjit as dr
import numpy as np

from nerg_mi.transport.medium import LastHit
from nerg_mi.transport.splat_medium import AT_ONCE
from tests.formats.splats.writers import random_splats
from tests.reference.splats import peaks
from tests.transport.media.splats.scenes import medium_of, rays, stack


def test_groups_are_the_next_of_all_in_their_order(rgb):
    splats = random_splats(80, degree=0, size=0.3)
    medium, (o, d) = medium_of(splats), rays(300)
    ray = medium.local(rgb.Point3f(o.T), rgb.Vector3f(d.T))
    all_t, share = peaks(splats, o, d)
    wanted = np.sort(np.where((share > 0) & (all_t > 0), all_t, np.inf), axis=1)
    after, everywhere = LastHit(rgb.Float(0), rgb.UInt32(0)), dr.full(rgb.Bool, True, 300)
    # No light is ever used up: three groups hold the first of them, and nothing twice.
    for group in range(3):
        found = medium.hits.nearest(ray, after, ray.t_far, rgb.Float(1), rgb.Float(0), everywhere)
        dr.eval(found.t, found.absorbed, found.index)
        t = np.stack([np.array(v) for v in found.t], axis=1)
        part = wanted[:, group * AT_ONCE : (group + 1) * AT_ONCE]
        met = np.isfinite(part)
        assert np.array_equal(np.isfinite(t), met) and np.allclose(t[met], part[met], atol=1e-5)
        after = LastHit(found.t[-1], found.index[-1])
        everywhere = everywhere & dr.isfinite(found.t[-1])
    again = medium.hits.again(ray, found.index[0], dr.isfinite(found.t[0]))
    first = np.isfinite(t[:, 0])
    assert np.array_equal(np.array(again[0])[first], t[first, 0])
    assert np.array_equal(np.array(again[1])[first], np.array(found.absorbed[0])[first])


def test_peaks_at_one_place_are_all_met(rgb):
    count = 2 * AT_ONCE + 3
    medium = medium_of(stack([1.0] * count, np.full(count, 0.1)))
    ray = medium.local(rgb.Point3f(0, 0, 0), rgb.Vector3f(0, 0, 1))
    after, seen = LastHit(rgb.Float(0), rgb.UInt32(0)), []
    for _ in range(3):
        found = medium.hits.nearest(ray, after, ray.t_far, rgb.Float(1), rgb.Float(0), rgb.Bool(True))
        dr.eval(found.t, found.absorbed, found.index)
        seen += [i[0] for i, t in zip(found.index, found.t) if np.isfinite(t[0])]
        after = LastHit(found.t[-1], found.index[-1])
    assert sorted(seen) == list(range(count))


def test_behind_what_takes_all_light_nothing_is_looked_at(rgb):
    medium = medium_of(stack(np.arange(1, 65), [0.9999] * 64))
    ray = medium.local(rgb.Point3f(0, 0, 0), rgb.Vector3f(0, 0, 1))
    look = lambda stop: medium.hits.nearest(
        ray, LastHit(rgb.Float(0), rgb.UInt32(0)), ray.t_far, rgb.Float(1), rgb.Float(stop), rgb.Bool(True)
    )
    assert look(1e-3).evals[0] <= 2 < look(0).evals[0]
    assert look(1e-3).t[0][0] == 1
