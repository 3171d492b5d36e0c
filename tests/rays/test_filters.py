import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerg_mi.rays.filters import label_stays, select_mask, thin_mask
from nerg_mi.rays.rays import Rays


def walk(origin, t=None, person=None, **more):
    n = len(origin)
    return Rays(
        np.arange(n) * 0.1 if t is None else t,
        np.zeros(n) if person is None else person,
        ("ann", "bo"),
        origin,
        np.tile([1.0, 0, 0], (n, 1)),
        np.ones(n),
        **more,
    )


def line(x):
    return np.stack([x, 0 * x, 0 * x + 1.6], axis=1)


def test_conditions():
    hit = np.full((6, 3), np.nan)
    hit[1] = 0
    rays = walk(
        line(np.arange(6.0)),
        person=np.array([0, 1, 0, 1, 0, 1]),
        hit=hit,
        cohort=np.array([0, 0, 0, 1, 1, 1]),
        cohorts=("old", "new"),
    )
    where = lambda **c: np.flatnonzero(select_mask(rays, **c)).tolist()
    assert where() == [0, 1, 2, 3, 4, 5]
    assert (
        where(time=(0.1, 0.3)) == [1, 2] and where(time=(None, 0.15)) == [0, 1] and where(time=(0.35, None)) == [4, 5]
    )
    assert (
        where(persons=["bo"]) == [1, 3, 5]
        and where(without_persons=["bo"]) == [0, 2, 4]
        and where(cohorts=["new"]) == [3, 4, 5]
    )
    assert (
        where(box=[1, 3, -1, 1, 0, 2]) == [1, 2, 3]
        and where(with_hit=True) == [1]
        and where(min_confidence=1.0) == [0, 1, 2, 3, 4, 5]
    )
    assert where(persons=["bo"], cohorts=["old"]) == [1]
    # Bounds that rays lie on: times from the first up to the second, boxes and confidences with both.
    exact = walk(line(np.arange(6.0)), t=np.arange(6) * 0.25)
    at = lambda **c: np.flatnonzero(select_mask(exact, **c)).tolist()
    assert at(time=(0.25, 0.75)) == [1, 2] and at(time=(None, 0.25)) == [0] and at(time=(1.25, None)) == [5]
    assert at(time=(0.5, 0.5)) == [] and at(box=[2, 3, 0, 1, 0, 1.6]) == [2, 3]
    for wrong, message in [
        ({"persons": ["cy"]}, "no person is called 'cy'"),
        ({"box": [0, 1, 0, 1]}, "a box is"),
        ({"box": [1, 0, 0, 1, 0, 1]}, "a box is"),
    ]:
        with pytest.raises(ValueError, match=message):
            select_mask(rays, **wrong)
    with pytest.raises(ValueError, match="no cohorts"):
        select_mask(walk(line(np.arange(3.0))), cohorts=["new"])


def test_stays_of_a_walk_with_a_stop():
    x = np.r_[np.arange(0, 1, 0.05), np.full(200, 1.0), np.arange(1, 2, 0.05)]
    label = label_stays(walk(line(x)), 0.12)
    # Steps of 5 cm: three rays within 12 cm of the first; the stop is one stay, with what is near it.
    assert list(label[:6]) == [0, 0, 0, 1, 1, 1]
    longest = np.bincount(label).max()
    assert 200 <= longest <= 205 and len(np.unique(label[25:215])) == 1


def test_stays_end_at_pauses_and_people():
    rays = walk(line(np.zeros(6)), t=np.array([0, 0.1, 5, 5.1, 0, 0.1]), person=np.array([0, 0, 0, 0, 1, 1]))
    assert list(label_stays(rays)) == [0, 0, 1, 1, 2, 2]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.5))
def test_stays_by_definition(seed, distance):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    origin = np.cumsum(rng.normal(0, 0.03, (n, 3)), axis=0)
    rays = walk(origin, t=np.cumsum(rng.choice([0.1, 2.0], n, p=[0.95, 0.05])), person=np.sort(rng.integers(0, 2, n)))
    order = rng.permutation(n)
    label = np.empty(n, int)
    label[order] = label_stays(rays.select(order), distance)
    want, number, first = [], -1, 0
    for i in range(n):
        if (
            i == 0
            or rays.person[i] != rays.person[i - 1]
            or rays.t[i] - rays.t[i - 1] > 1
            or np.linalg.norm(origin[i] - origin[first]) > distance
        ):
            first, number = i, number + 1
        want.append(number)
    assert label.tolist() == want


def test_thinning_counts_a_stop_as_long_as_asked():
    x = np.r_[np.arange(0, 5, 0.5), np.full(1001, 5.0), np.arange(5.5, 10, 0.5)]
    kept = thin_mask(walk(line(x)), seconds=2.0)
    stop = slice(10, 1011)
    assert kept[:10].all() and kept[1011:].all() and 20 <= kept[stop].sum() <= 22
    where = np.flatnonzero(kept[stop])
    assert where[0] == 0 and np.ptp(np.diff(where)) <= 1  # even
    assert thin_mask(walk(line(x)), seconds=1000).all()
    with pytest.raises(ValueError, match="positive"):
        thin_mask(walk(line(x)), seconds=0)
    with pytest.raises(ValueError, match="positive"):
        thin_mask(walk(line(x)), distance=0)


def test_stays_as_long_and_as_far_as_they_may_be():
    t = np.array([0, 1, 2, 3.25])
    assert label_stays(walk(line(np.zeros(4)), t=t), gap=1.0).tolist() == [0, 0, 0, 1]
    assert label_stays(walk(line(np.array([0, 0.5, -0.5, 0.75])), t=t * 0), distance=0.5).tolist() == [0, 0, 0, 1]
