"""Tests of `nerg_mi.rays.dataset`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.dataset import (
    EVERYTHING,
    Conditions,
    Head,
    PartFile,
    Source,
    bucket_of,
    merge_metadata,
    read_head,
    read_sources,
    write_head,
    write_source,
)
from nerg_mi.rays.rays import FRAME, Rays, merge_rays, sample_rows

from .making import crowd

# ---- Samples: each row as likely as any other, without room for all ----


@pytest.mark.parametrize("n, runs", [(7, None), (20, None), (33, None), (8, 4), (20, 3)])
def test_every_row_is_as_likely(n, runs):
    counts, each = np.zeros(40), None
    for seed in range(1000):
        rows = sample_rows(40, n, seed, runs)
        assert (np.diff(rows) > 0).all() and rows[0] >= 0 and rows[-1] < 40
        assert each in (None, len(rows))
        each = len(rows)
        counts[rows] += 1
    assert each == (n if runs is None else n // runs * runs)
    # Chi-square of 39 degrees of freedom: 72.1 at one in a thousand; samples without repeats spread less.
    expected = 1000 * each / 40
    assert ((counts - expected) ** 2 / expected).sum() < 72.1


def test_pairs_are_as_likely_too():
    together = np.zeros((6, 6))
    for seed in range(1500):
        rows = sample_rows(6, 2, seed)
        together[rows[0], rows[1]] += 1
    found = together[np.triu_indices(6, 1)]
    assert found.sum() == 1500 and ((found - 100) ** 2 / 100).sum() < 36.1


def test_runs_are_of_neighbours():
    rows = sample_rows(10_000, 600, 1, runs=6)
    jumps = np.count_nonzero(np.diff(rows) > 1)
    assert len(rows) == 600 and jumps <= 6


def test_all_and_equal_seeds():
    assert sample_rows(5, 5).tolist() == sample_rows(5, 9, 3, runs=2).tolist() == [0, 1, 2, 3, 4]
    assert np.array_equal(sample_rows(10**12, 50, 4), sample_rows(10**12, 50, 4))
    assert not np.array_equal(sample_rows(10**12, 50, 4), sample_rows(10**12, 50, 5))


# ---- The accounts of a dataset: written and read again, and refused where they are damaged ----

PART = PartFile("shop", "unknown", 3, 0, 5, 100, "a", "b", 0.0, 1.0, [0.0] * 3, [1.0] * 3, 0.5, 0, 2, False, False)

SOURCE = Source("0" * 32, "a.csv", "w", None, "r", 0, {"a": 2, "b": 3}, {}, [PART], {"frame": dict(FRAME)})

HEAD = Head(16)


def test_what_is_written_is_read(tmp_path):
    write_head(tmp_path, replace(HEAD, salt="s", closed=True))
    write_source(tmp_path, SOURCE)
    assert read_head(tmp_path) == Head(16, "s", True) and read_sources(tmp_path, HEAD) == [SOURCE]


def test_of_one_path_the_latest_counts(tmp_path):
    later = replace(SOURCE, id="1" * 32, generation=1)
    for source in (later, SOURCE, replace(SOURCE, id="2" * 32, where="other")):
        write_source(tmp_path, source)
    assert [source.id[0] for source in read_sources(tmp_path, HEAD)] == ["1", "2"]
    # One that was being written is none.
    (tmp_path / "_sources" / ".1.part.json").write_text("{")
    assert len(read_sources(tmp_path, HEAD)) == 2


@pytest.mark.parametrize(
    "change, why",
    [
        ({"id": "1" * 32}, '"id" is not that of its name'),
        ({"persons": {"a": 5, "b": 5}}, "not as many rays"),
        ({"persons": ["a"]}, '"persons" is no counts'),
        ({"generation": -1}, '"generation" is no count'),
        ({"stamp": 3}, '"stamp" is no text'),
        ({"more": 1}, "keys are not those"),
        ({"metadata": {"frame": 3}}, '"frame"'),
        ({"metadata": {"frame": dict(FRAME), "dropped": [3]}}, '"dropped"'),
        ({"parts": "x"}, '"parts" is no list'),
        ({"parts": [{"place": "x"}]}, "keys of a part"),
        *(
            ({"parts": [part]}, why)
            for part, why in (
                ({"place": "a\n/../.."}, "a place has a name"),
                ({"place": 3}, '"place" is no text'),
                ({"day": "../../etc"}, "a day is written"),
                ({"bucket": 16}, "bucket of this dataset"),
                ({"bucket": -1}, '"bucket" is no count'),
                ({"number": "../0"}, '"number" is no count'),
                ({"rays": 0}, "number of rays of a part"),
                ({"rays": 1 << 40}, "number of rays of a part"),
                ({"low": [0, 0]}, '"low" is no point'),
                ({"high": [0, 0, 1e999]}, '"high" is no point'),
                ({"start": None}, '"start" is no number'),
                ({"first": "nobody"}, '"first" is no person'),
                ({"cohorts": 1}, "yes or no"),
                ({"heads": None}, "yes or no"),
            )
        ),
        ({"parts": [{}, {}]}, "the same number|not as many"),
    ],
)
def test_a_damaged_account_is_one_sentence(tmp_path, change, why):
    write_source(tmp_path, SOURCE)
    (path,) = (tmp_path / "_sources").iterdir()
    about = json.loads(path.read_text())
    if isinstance(change.get("parts"), list) and change["parts"][0] != {"place": "x"}:
        change = {"parts": [about["parts"][0] | part for part in change["parts"]]}
    path.write_text(json.dumps(about | change))
    with pytest.raises(NergError, match=why) as error:
        read_sources(tmp_path, HEAD)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text, why",
    [
        ("[]", "no JSON object"),
        ("{", "not valid JSON"),
        ('{"version": 2, "buckets": 16}', "another version"),
        ('{"version": 1, "buckets": 0, "salt": null, "closed": false}', "number of buckets"),
        ('{"version": 1, "buckets": 1e9, "salt": null, "closed": false}', "number of buckets"),
        ('{"version": 1, "buckets": 16, "salt": 3, "closed": false}', '"salt" is no text'),
        ('{"version": 1, "buckets": 16, "salt": null}', '"closed"'),
    ],
)
def test_a_damaged_head_is_one_sentence(tmp_path, text, why):
    (tmp_path / "_dataset.json").write_text(text)
    with pytest.raises(NergError, match=why):
        read_head(tmp_path)


# ---- What need not be read: never what holds a ray that is asked for ----


@pytest.mark.parametrize(
    "given, holds",
    [
        ({}, True),
        ({"time": (1.0, None)}, True),  # its last
        ({"time": (1.1, None)}, False),
        ({"time": (None, 0.0)}, False),  # its first is at the end, which is not meant any more
        ({"time": (-5, 0.1)}, True),
        ({"box": [1, 2, 1, 2, 1, 2]}, True),  # touches it
        ({"box": [1.01, 2, 0, 2, 0, 2]}, False),
        ({"box": [-2, -0.1, 0, 2, 0, 2]}, False),
        ({"with_hit": True}, True),
        ({"min_confidence": 0.9}, True),
    ],
)
def test_parts_by_their_account(given, holds):
    assert Conditions(**given).may_hold(PART, 16) is holds
    bounds = {"t": (0.0, 1.0), **{f"origin_{axis}": (0.0, 1.0) for axis in "xyz"}}
    assert Conditions(**given).may_hold_group(bounds) is holds and Conditions(**given).may_hold_group({})


def test_parts_by_people():
    name = next(f"ab{k}" for k in range(1000) if bucket_of(f"ab{k}", 16) == PART.bucket)
    assert Conditions(persons=[name, "zoe"]).may_hold(PART, 16)  # between its first, a, and its last, b
    other = next(f"ab{k}" for k in range(1000) if bucket_of(f"ab{k}", 16) != PART.bucket)
    assert not Conditions(persons=[other]).may_hold(PART, 16)
    assert Conditions(persons=["bo"]).may_hold_group({"person": ("ann", "bo")})
    assert not Conditions(persons=["c", "a"]).may_hold_group({"person": ("ann", "bo")})


def test_rays_of_a_block():
    rays = crowd()
    kept = Conditions(persons=["ann", "somebody else"], time=(10, 20)).select(rays)
    assert set(kept.person) == {rays.persons.index("ann")} and kept.t.min() >= 10 and kept.t.max() < 20
    mask = (rays.person == rays.persons.index("ann")) & (rays.t >= 10) & (rays.t < 20)
    assert np.array_equal(kept.t, rays.t[mask])
    assert len(Conditions(without_persons=["nobody"]).select(rays)) == len(rays)
    assert len(Conditions(cohorts=["x"]).select(rays)) == 0
    assert EVERYTHING.select(rays) is rays and not EVERYTHING.any and Conditions(with_hit=True).any


def test_a_box_that_is_none():
    with pytest.raises(NergError, match="a box is"):
        Conditions(box=[0, 1]).check()


# ---- Rays of several blocks as one, and what is said of all of their sources ----

AHEAD = np.array([[0.0, 1.0, 0.0]])


def ray(t: float, name: str, others=(), **more) -> Rays:
    persons = tuple(sorted({name, *others}))
    return Rays([t], [persons.index(name)], persons, AHEAD, AHEAD, [1.0], **more)


def test_people_who_occur_and_what_some_lack():
    blocks = [ray(0, "b", ["a", "z"]), ray(1, "a", hit=2 * AHEAD, cohort=[1], cohorts=("x", "y")), ray(2, "b")]
    found = merge_rays(blocks)
    assert found.persons == ("a", "b") and [found.persons[k] for k in found.person] == ["b", "a", "b"]
    assert found.t.tolist() == [0, 1, 2] and np.isnan(found.hit[[0, 2]]).all() and found.hit[1].tolist() == [0, 2, 0]
    assert [found.cohorts[k] for k in found.cohort] == ["unknown", "y", "unknown"]
    assert found.metadata == {"frame": FRAME}
    headed = merge_rays([ray(0, "b"), ray(1, "b", head=AHEAD)])
    assert headed.head.dtype == np.float32 and np.isnan(headed.head[0]).all() and headed.head[1].tolist() == [0, 1, 0]
    without = merge_rays([ray(0, "b"), ray(1, "b")])
    assert without.hit is None and without.cohort is None and without.cohorts == ()


def test_metadata_are_what_holds_for_all():
    about = {"frame": dict(FRAME), "preset": "table", "tick": 1.0, "rows_read": 4, "sources": [{"file": "a"}]}
    about["dropped"] = [{"reason": "blink", "file": "a", "count": 1, "rows": [[1, 1]]}]
    about["eye_distance"] = {"ann": 0.06}
    about["complaints"] = ["the frame is mirrored", "the clock jumps"]
    other = {
        **about,
        "complaints": ["the clock jumps", "the gaze is frozen"],
        "eye_distance": {"bo": 0.07},
        "tick": 2.0,
        "rows_read": 5,
        "sources": [{"file": "b"}],
        "dropped": [],
        "missing": {"hit points": 2},
    }
    fields = dict(where="", stamp=None, recipe="", generation=0, persons={}, cohorts={}, parts=[])
    found = merge_metadata([Source(id=n, file=n, metadata=m, **fields) for n, m in (("a", about), ("b", other))])
    assert found["rows_read"] == 9 and found["sources"] == [{"file": "a"}, {"file": "b"}]
    assert found["eye_distance"] == {"ann": 0.06, "bo": 0.07}
    assert found["complaints"] == ["the frame is mirrored", "the clock jumps", "the gaze is frozen"]
    assert found["dropped"] == about["dropped"] and found["preset"] == "table" and "tick" not in found
    assert found["missing"] == {"hit points": 2}
