import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerg_mi.probes.probes import place_probes
from nerg_mi.rays.filters import combine, position_of_split, purge, split_by_person, split_by_position, split_by_time
from nerg_mi.rays.rays import Rays

R = 0.25


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(2)
    n = 20_000
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    origin = rng.uniform([0, 0, 1.5], [6, 4, 1.7], (n, 3))
    return Rays(np.arange(n) * 0.02, np.arange(n) % 5, tuple("abcde"), origin, d, np.ones(n))


def rows(mask, probes):
    """Rays held by probes made on a part, as rows of the whole."""
    return set(np.flatnonzero(mask)[probes.indices].tolist())


def test_train_and_test_probes_share_no_ray(rays):
    split = split_by_position(rays, R, test_probes=30, seed=1)
    train = place_probes(rays.select(split.train), R, count=400, min_rays=8)
    test = place_probes(rays.select(split.test), R, queries=split.test_centres, min_rays=8)
    everywhere = place_probes(rays, R, queries=split.test_centres, min_rays=8)
    assert len(test) == 30 and len(train) > 300
    a, b, c = rows(split.train, train), rows(split.test, test), rows(np.ones(len(rays), bool), everywhere)
    assert a and b and not a & b and not a & c
    assert b == c  # a test probe loses nothing to the split
    # And training probes keep their distance: no training ray within 2R.
    apart = np.linalg.norm(rays.origin[split.train][:, None] - split.test_centres[None], axis=2)
    assert apart.min() > 2 * R
    within = np.linalg.norm(rays.origin[:, None] - split.test_centres[None], axis=2).min(axis=1)
    assert np.array_equal(split.test, within <= R) and np.array_equal(split.purged, (within > R) & (within <= 2 * R))
    assert not (split.train & split.test).any() and (split.train | split.test | split.purged).all()


def test_zones_are_apart_and_repeatable(rays):
    a, b = (split_by_position(rays, R, zones=4, zone_radius=0.3, seed=7) for _ in range(2))
    assert np.array_equal(a.train, b.train) and np.array_equal(a.test_centres, b.test_centres)
    gaps = np.linalg.norm(a.zone_centres[:, None, :2] - a.zone_centres[None, :, :2], axis=2)
    assert gaps[~np.eye(4, dtype=bool)].min() > 1.0
    for z in range(4):
        assert np.linalg.norm(a.test_centres[a.zone == z][:, :2] - a.zone_centres[z, :2], axis=1).max() <= 0.3


def test_people_and_both(rays):
    train, test = split_by_person(rays, test_share=0.4, seed=0)
    assert not set(rays.person[train]) & set(rays.person[test]) and len(set(rays.person[test])) == 2
    assert (train ^ test).all()
    train, test = split_by_person(rays, test_persons=["b"])
    assert set(rays.person[test]) == {1}
    split = split_by_position(rays, R, test_probes=20)
    a = place_probes(rays.select(split.train & train), R, count=100, min_rays=4)
    b = place_probes(rays.select(split.test & test), R, queries=split.test_centres, min_rays=4)
    assert not rows(split.train & train, a) & rows(split.test & test, b)


def test_purge(rays):
    mask = purge(rays, np.array([[3, 2, 1.6]]), 1.0)
    assert np.array_equal(mask, np.linalg.norm(rays.origin - [3, 2, 1.6], axis=1) > 1.0)


def test_refusals(rays):
    with pytest.raises(ValueError, match="no person is called 'zoe'"):
        split_by_person(rays, test_persons=["zoe"])
    with pytest.raises(ValueError, match="cannot be split"):
        split_by_person(rays.select(rays.person == 0))
    with pytest.raises(ValueError, match="enlarge the radius"):
        split_by_position(rays, 0.01)
    with pytest.raises(ValueError, match="left to train on"):
        split_by_position(rays, 3.0)


def test_by_time_with_a_gap(rays):
    train, test = split_by_time(rays, test_share=0.25, gap=10)
    span = rays.t.max() - rays.t.min()
    assert np.isclose(rays.t[test].min(), 0.75 * span, atol=0.02) and rays.t[test].min() - rays.t[train].max() >= 10
    # Clocks of their own: everybody's last quarter.
    own = Rays(rays.t + 5000 * rays.person, rays.person, rays.persons, rays.origin, rays.direction, rays.confidence)
    train, test = split_by_time(own, test_share=0.25, gap=10, of="person")
    for p in range(5):
        mine = own.person == p
        assert own.t[test & mine].min() - own.t[train & mine].max() >= 10 and 0.24 < test[mine].mean() < 0.26
    with pytest.raises(ValueError, match="smaller gap"):
        split_by_time(rays, gap=1e6)
    with pytest.raises(ValueError, match='"all" or "person"'):
        split_by_time(rays, of="day")


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 2**16),
    st.sampled_from(["position", "person", "time", "position person", "person time", "position person time"]),
)
def test_no_combination_shares_a_ray(rays, seed, kinds):
    by_position = split_by_position(rays, R, test_probes=20, seed=seed) if "position" in kinds else None
    made = {
        "position": lambda: by_position.sides,
        "person": lambda: split_by_person(rays, test_share=0.4, seed=seed),
        "time": lambda: split_by_time(rays, test_share=0.4, gap=2.0),
    }
    train, test = combine(*(made[k]() for k in kinds.split()))
    assert train.any() and test.any() and not (train & test).any()
    if "person" in kinds:
        assert not set(rays.person[train]) & set(rays.person[test])
    if "time" in kinds:
        assert rays.t[test].min() - rays.t[train].max() >= 2
    if "position" in kinds:
        a = place_probes(rays.select(train), R, placement="blue", count=300, min_rays=4)
        b = place_probes(rays.select(test), R, queries=by_position.test_centres, min_rays=1)
        assert not rows(train, a) & rows(test, b)
        apart = np.linalg.norm(rays.origin[train][:, None] - by_position.test_centres[None], axis=2)
        assert apart.min() > 2 * R


def test_both_refuses_what_leaves_nothing(rays):
    nobody = np.zeros(len(rays), bool)
    with pytest.raises(ValueError, match="0 rays to train on"):
        combine((nobody, ~nobody))
    with pytest.raises(ValueError, match="how to split"):
        combine()


@pytest.mark.parametrize("count, each", [(10, [4, 3, 3]), (11, [4, 4, 3]), (12, [4, 4, 4]), (2, [1, 1, 0])])
def test_every_test_position_that_was_asked_for(rays, count, each):
    """What does not divide by the zones goes to the first of them."""
    split = split_by_position(rays, R, zones=3, zone_radius=0.4, test_probes=count, min_rays=8)
    assert len(split.test_centres) == count and np.bincount(split.zone, minlength=3).tolist() == each


def test_the_metadata_tell_how_rays_were_split(rays):
    """What the layout draws; nothing where there was none."""
    assert position_of_split(rays) == {}
    by = {"position": {"radius": R, "test_centres": [[0.0, 0.0, 1.5]]}, "person": {"test": ["a"]}}
    split = rays.with_step(step="filter", kept=9, of=9).with_step(step="split", side="test", kept=9, of=9, by=by)
    assert position_of_split(split) == by["position"]
    assert position_of_split(rays.with_step(step="split", kept=9, of=9, by={"time": {"share": 0.2}})) == {}


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_of_two_people_one_is_on_each_side(rays, share):
    train, test = split_by_person(rays.select(rays.person < 2), test_share=share)
    assert train.any() and test.any()


def test_distances_and_times_on_the_bounds():
    """Rays at R from a test centre are of the test, those at 2R of neither side."""
    near = [[0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, -0.5, 0]]
    twice, far = [[1.0, 0, 0]], [[5.0 + 3 * k, 0, 0] for k in range(9)]
    origin = np.array([[0.0, 0, 0]] * 70 + near + twice + far)
    n = len(origin)
    rays = Rays(np.arange(n) * 1.0, np.zeros(n), ("ann",), origin, np.tile([1.0, 0, 0], (n, 1)), np.ones(n))
    # Of all places the first alone has so many rays within R.
    split = split_by_position(rays, 0.5, zones=1, test_probes=1, min_rays=73, min_train=9)
    with pytest.raises(ValueError, match="9 rays are left to train on"):
        split_by_position(rays, 0.5, zones=1, test_probes=1, min_rays=73, min_train=10)
    assert split.test.tolist() == [True] * 74 + [False] * 10 and split.train.tolist() == [False] * 75 + [True] * 9
    assert purge(rays, np.zeros((1, 3)), 1.0).tolist() == split.train.tolist()
    some = rays.select(np.arange(11))
    train, test = split_by_time(some, test_share=0.5, gap=2.0)
    assert some.t[train].tolist() == [0, 1, 2] and some.t[test].tolist() == [5, 6, 7, 8, 9, 10]


@pytest.mark.parametrize("missing", [0, 1])
def test_both_sides_of_several_splits_have_rays(missing):
    a, b = np.array([True, False, False]), np.array([False, True, False])
    sides = (a, b), ((b, b) if missing == 0 else (a, a))
    with pytest.raises(ValueError, match="together the splits leave"):
        combine(*sides)
