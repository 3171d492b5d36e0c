"""Tests of the manifests and conditions of `nerg_mi.tracking.dataset`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.dataset import (
    NO_CONDITIONS,
    Conditions,
    DatasetManifest,
    PartFile,
    SourceManifest,
    compute_bucket,
    read_dataset_manifest,
    read_source_manifests,
    write_dataset_manifest,
    write_source_manifest,
)
from nerg_mi.tracking.rays import FRAME

from .making import crowd

# ---- Manifests: written and read, and refused if damaged ----

PART = PartFile("shop", "unknown", 3, 0, 5, 100, "a", "b", 0.0, 1.0, [0.0] * 3, [1.0] * 3, 0.5, 0, 2, False, False)

SOURCE = SourceManifest("0" * 32, "a.csv", "w", None, "r", 0, {"a": 2, "b": 3}, {}, [PART], {"frame": dict(FRAME)})

HEAD = DatasetManifest(16)


def test_manifests_round_trip(tmp_path):
    write_dataset_manifest(tmp_path, replace(HEAD, salt="s", closed=True))
    write_source_manifest(tmp_path, SOURCE)
    assert read_dataset_manifest(tmp_path) == DatasetManifest(16, "s", True) and read_source_manifests(
        tmp_path, HEAD
    ) == [SOURCE]


def test_latest_generation_of_a_path_is_used(tmp_path):
    later = replace(SOURCE, id="1" * 32, generation=1)
    for source in (later, SOURCE, replace(SOURCE, id="2" * 32, where="other")):
        write_source_manifest(tmp_path, source)
    assert [source.id[0] for source in read_source_manifests(tmp_path, HEAD)] == ["1", "2"]
    # An unfinished manifest is ignored.
    (tmp_path / "_sources" / ".1.part.json").write_text("{")
    assert len(read_source_manifests(tmp_path, HEAD)) == 2


@pytest.mark.parametrize(
    "change, why",
    [
        ({"id": "1" * 32}, '"id" does not match its file name'),
        ({"persons": {"a": 5, "b": 5}}, "numbers of rays of its participants"),
        ({"persons": ["a"]}, '"persons" is not counts'),
        ({"generation": -1}, '"generation" is not a count'),
        ({"stamp": 3}, '"stamp" is not text'),
        ({"more": 1}, "keys are not those"),
        ({"metadata": {"frame": 3}}, '"frame"'),
        ({"metadata": {"frame": dict(FRAME), "dropped": [3]}}, '"dropped"'),
        ({"parts": "x"}, '"parts" is not a list'),
        ({"parts": [{"place": "x"}]}, "keys than those of a part"),
        *(
            ({"parts": [part]}, why)
            for part, why in (
                ({"place": "a\n/../.."}, "the name of an environment"),
                ({"place": 3}, '"place" is not text'),
                ({"day": "../../etc"}, "a day is written"),
                ({"bucket": 16}, "bucket of this dataset"),
                ({"bucket": -1}, '"bucket" is not a count'),
                ({"number": "../0"}, '"number" is not a count'),
                ({"rays": 0}, "number of rays of a part"),
                ({"rays": 1 << 40}, "number of rays of a part"),
                ({"low": [0, 0]}, '"low" is not a point'),
                ({"high": [0, 0, 1e999]}, '"high" is not a point'),
                ({"start": None}, '"start" is not a number'),
                ({"first": "nobody"}, '"first" is not a participant'),
                ({"cohorts": 1}, "a boolean"),
                ({"heads": None}, "a boolean"),
            )
        ),
        ({"parts": [{}, {}]}, "the same number|numbers of rays"),
    ],
)
def test_damaged_source_manifest_is_refused(tmp_path, change, why):
    write_source_manifest(tmp_path, SOURCE)
    (path,) = (tmp_path / "_sources").iterdir()
    manifest = json.loads(path.read_text())
    if isinstance(change.get("parts"), list) and change["parts"][0] != {"place": "x"}:
        change = {"parts": [manifest["parts"][0] | part for part in change["parts"]]}
    path.write_text(json.dumps(manifest | change))
    with pytest.raises(NergError, match=why) as error:
        read_source_manifests(tmp_path, HEAD)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text, why",
    [
        ("[]", "not a JSON object"),
        ("{", "not valid JSON"),
        ('{"version": 2, "buckets": 16}', "another version"),
        ('{"version": 1, "buckets": 0, "salt": null, "closed": false}', "number of buckets"),
        ('{"version": 1, "buckets": 1e9, "salt": null, "closed": false}', "number of buckets"),
        ('{"version": 1, "buckets": 16, "salt": 3, "closed": false}', '"salt" is not text'),
        ('{"version": 1, "buckets": 16, "salt": null}', '"closed"'),
    ],
)
def test_damaged_dataset_manifest_is_refused(tmp_path, text, why):
    (tmp_path / "_dataset.json").write_text(text)
    with pytest.raises(NergError, match=why):
        read_dataset_manifest(tmp_path)


# ---- Skipping of parts and groups: never of one with matching rays ----


@pytest.mark.parametrize(
    "settings, holds",
    [
        ({}, True),
        ({"time": (1.0, None)}, True),  # its last time
        ({"time": (1.1, None)}, False),
        ({"time": (None, 0.0)}, False),  # the end is exclusive
        ({"time": (-5, 0.1)}, True),
        ({"box": [1, 2, 1, 2, 1, 2]}, True),  # touches it
        ({"box": [1.01, 2, 0, 2, 0, 2]}, False),
        ({"box": [-2, -0.1, 0, 2, 0, 2]}, False),
        ({"with_hit": True}, True),
        ({"min_confidence": 0.9}, True),
    ],
)
def test_parts_are_selected_by_their_manifest(settings, holds):
    assert Conditions(**settings).may_match_part(PART, 16) is holds
    bounds = {"t": (0.0, 1.0), **{f"origin_{axis}": (0.0, 1.0) for axis in "xyz"}}
    assert Conditions(**settings).may_match_group(bounds) is holds and Conditions(**settings).may_match_group({})


def test_parts_are_selected_by_person():
    name = next(f"ab{k}" for k in range(1000) if compute_bucket(f"ab{k}", 16) == PART.bucket)
    assert Conditions(persons=[name, "zoe"]).may_match_part(PART, 16)  # between its first and last name, a and b
    other = next(f"ab{k}" for k in range(1000) if compute_bucket(f"ab{k}", 16) != PART.bucket)
    assert not Conditions(persons=[other]).may_match_part(PART, 16)
    assert Conditions(persons=["bo"]).may_match_group({"person": ("ann", "bo")})
    assert not Conditions(persons=["c", "a"]).may_match_group({"person": ("ann", "bo")})


def test_rays_of_a_block_are_selected():
    rays = crowd()
    selected = Conditions(persons=["ann", "somebody else"], time=(10, 20)).select(rays)
    assert set(selected.person) == {rays.persons.index("ann")} and selected.t.min() >= 10 and selected.t.max() < 20
    mask = (rays.person == rays.persons.index("ann")) & (rays.t >= 10) & (rays.t < 20)
    assert np.array_equal(selected.t, rays.t[mask])
    assert len(Conditions(without_persons=["nobody"]).select(rays)) == len(rays)
    assert len(Conditions(cohorts=["x"]).select(rays)) == 0
    assert NO_CONDITIONS.select(rays) is rays and not NO_CONDITIONS.has_any and Conditions(with_hit=True).has_any


def test_invalid_box_is_refused():
    with pytest.raises(NergError, match="a box needs"):
        Conditions(box=[0, 1]).validate()
