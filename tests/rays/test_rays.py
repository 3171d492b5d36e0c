import numpy as np
import pytest

from nerg_mi.rays.rays import Rays


def some(n=6, **change):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(n, 3))
    values = dict(
        t=np.arange(n) * 0.1,
        person=np.arange(n) % 2,
        persons=("ann", "bo"),
        origin=rng.random((n, 3)),
        direction=d / np.linalg.norm(d, axis=1, keepdims=True),
        confidence=np.ones(n),
    )
    return Rays(**{**values, **change})


def broken(name, row, value):
    array = getattr(some(), name).copy()
    array[row] = value
    return {name: array}


@pytest.mark.parametrize(
    "change, message",
    [
        (broken("direction", 2, np.nan), r"1 of 6 rays have a direction that is not finite \(rays 2\)"),
        (broken("direction", 3, 0.0), r"zero direction \(rays 3\)"),
        (broken("direction", 4, 0.5), "not of unit length"),
        (broken("origin", 1, np.inf), r"origin that is not finite or beyond 1e\+07 m \(rays 1\)"),
        (broken("origin", 1, 1e38), r"beyond 1e\+07 m \(rays 1\)"),
        ({"hit": np.full((6, 3), -1e8)}, r"a hit point beyond 1e\+07 m \(rays 0, 1"),
        (broken("t", 5, np.nan), r"time that is not finite \(rays 5\)"),
        (broken("person", 0, 7), r"unknown person \(rays 0\)"),
        (broken("confidence", 0, 1.5), r"confidence outside \[0, 1\]"),
        ({"head": np.tile([[0.0, 0, 2], [np.nan, 0, 0]], (3, 1))}, r"head that is not of unit length \(rays 0, 2, 4\)"),
        ({"origin": np.zeros((5, 3))}, r"origin has shape \(5, 3\)"),
        ({"t": ["now"] * 6}, '"t" of rays holds what is no number'),
        ({"head": [["x"] * 3] * 6}, '"head"'),
        ({"person": ["ann"] * 5 + ["cy"]}, r"'cy' is a person of the rays and none of persons"),
        ({"cohort": ["old"] * 6}, "'old'"),
        ({"persons": "ann"}, "persons are several names"),
        ({"metadata": {}}, "state units, up axis and handedness"),
    ],
)
def test_refuses_by_row(change, message):
    with pytest.raises(ValueError, match=message):
        some(**change)


@pytest.mark.parametrize("kind", [list, tuple, np.array, lambda names: np.array(names, object)])
def test_people_may_be_named(kind):
    rays = some(person=kind(["bo", "ann", "bo", "bo", "ann", "ann"]), cohort=kind(["old"] * 6), cohorts=("new", "old"))
    assert rays.person.tolist() == [1, 0, 1, 1, 0, 0] and rays.person.dtype == np.int32
    assert rays.cohort is not None and rays.cohort.tolist() == [1] * 6


def test_whole_numbers_are_taken_as_what_they_stand_for():
    n = 4
    rays = Rays(
        np.arange(n),
        np.zeros(n, np.int8),
        ("ann",),
        np.zeros((n, 3), int),
        np.tile([0, 0, 1], (n, 1)),
        np.ones(n, int),
        np.ones((n, 3), int),
    )
    assert {a.dtype for a in (rays.t, rays.origin, rays.direction, rays.hit)} == {np.dtype(float)} and (
        rays.t + 0.5
    ).tolist() == [0.5, 1.5, 2.5, 3.5]


def test_select_keeps_codes_and_provenance():
    rays = some()
    part = rays.select(rays.person == 1)
    assert len(part) == 3 and part.persons == rays.persons and part.metadata == rays.metadata
    assert np.array_equal(part.origin, rays.origin[1::2])


def test_kept_in_place():
    """The same rays as selected, in the memory of all of them."""
    rng = np.random.default_rng(0)
    n = 700_000  # more than are moved at a time
    d = np.tile([1.0, 0, 0], (n, 1))
    rays = Rays(
        rng.random(n), rng.integers(0, 3, n), tuple("abc"), rng.random((n, 3)), d, rng.random(n), rng.random((n, 3))
    )
    mask = rng.random(n) < 0.6
    want = rays.select(mask)
    kept = rays.keep_in_place(mask)
    for name in ("t", "person", "origin", "direction", "confidence", "hit"):
        assert np.array_equal(getattr(kept, name), getattr(want, name))
        assert np.shares_memory(getattr(kept, name), getattr(rays, name))
    assert kept.cohort is None and len(kept) == mask.sum()
