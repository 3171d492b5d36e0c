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
    DatasetManifest,
    PartFile,
    Source,
    bucket_of,
    read_dataset_manifest,
    read_sources,
    write_dataset_manifest,
    write_source,
)
from nerg_mi.rays.rays import FRAME

from .making import crowd

# ---- The accounts of a dataset: written and read again, and refused where they are damaged ----

PART = PartFile("shop", "unknown", 3, 0, 5, 100, "a", "b", 0.0, 1.0, [0.0] * 3, [1.0] * 3, 0.5, 0, 2, False, False)

SOURCE = Source("0" * 32, "a.csv", "w", None, "r", 0, {"a": 2, "b": 3}, {}, [PART], {"frame": dict(FRAME)})

HEAD = DatasetManifest(16)


def test_what_is_written_is_read(tmp_path):
    write_dataset_manifest(tmp_path, replace(HEAD, salt="s", closed=True))
    write_source(tmp_path, SOURCE)
    assert read_dataset_manifest(tmp_path) == DatasetManifest(16, "s", True) and read_sources(tmp_path, HEAD) == [SOURCE]


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
        read_dataset_manifest(tmp_path)


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
