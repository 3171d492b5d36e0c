import numpy as np

from nerg_mi.rays.filters import find_sessions
from nerg_mi.rays.rays import Rays


def rays(t, person):
    n = len(t)
    return Rays(t, person, ("ann", "bo"), np.zeros((n, 3)), np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def test_recordings_end_where_clocks_go_back_or_pause():
    t = [*range(5), *range(10, 100, 50), *range(300, 310), *np.arange(0, 40), *range(7)]
    person = [0] * 57 + [1] * 7
    found = find_sessions(rays(t, person))
    assert found.order is None and found.starts.tolist() == [0, 7, 17, 57, 64]
    assert found.person.tolist() == [0, 0, 0, 1] and found.back.tolist() == [False, False, True, False]
    assert found.label().tolist() == [0] * 7 + [1] * 10 + [2] * 40 + [3] * 7


def test_people_among_each_other_and_rays_that_were_mixed():
    t, person = np.repeat(np.arange(300) * 0.02, 2), np.tile([0, 1], 300)
    found = find_sessions(rays(t, person))
    assert found.order.tolist() == [*range(0, 600, 2), *range(1, 600, 2)] and found.starts.tolist() == [0, 300, 600]
    assert found.rows(slice(1, 3)).tolist() == [2, 4]
    # Rows in the wrong place by less than a second are no other recording.
    swapped = t.copy()
    swapped[[10, 20]] = t[[20, 10]]
    assert find_sessions(rays(swapped, person)).starts.tolist() == [0, 300, 600]
    mixed = rays(10 * t, person)
    mixed = mixed.select(np.random.default_rng(0).permutation(600))
    found = find_sessions(mixed)
    assert found.starts.tolist() == [0, 300, 600] and not found.back.any()
    assert (np.diff(mixed.t[found.order[:300]]) > 0).all()


def test_nobody_is_two():
    one = rays([0.0], [1])
    assert find_sessions(one).starts.tolist() == [0, 1] and find_sessions(one).person.tolist() == [1]
