"""The accounts of a dataset: written and read again, and refused where they are damaged."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.dataset import Head, Part, Source, read_head, read_sources, write_head, write_source
from nerg_mi.rays.rays import FRAME

PART = Part("shop", "unknown", 3, 0, 5, 100, "a", "b", 0.0, 1.0, [0.0] * 3, [1.0] * 3, 0.5, 0, 2, False, False)
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
