"""Rays of several blocks as one, and what is said of all of their sources."""

from __future__ import annotations

import numpy as np

from nerg_mi.rays.dataset import Source, merge_counts, merge_metadata, merge_rays
from nerg_mi.rays.rays import FRAME, Rays

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


def test_nothing():
    assert len(merge_rays([])) == 0 and merge_rays([]).persons == ()


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
    }
    fields = dict(where="", stamp=None, recipe="", generation=0, persons={}, cohorts={}, parts=[])
    found = merge_metadata([Source(id=n, file=n, metadata=m, **fields) for n, m in (("a", about), ("b", other))])
    assert found["rows_read"] == 9 and found["sources"] == [{"file": "a"}, {"file": "b"}]
    assert found["eye_distance"] == {"ann": 0.06, "bo": 0.07}
    assert found["complaints"] == ["the frame is mirrored", "the clock jumps", "the gaze is frozen"]
    assert found["dropped"] == about["dropped"] and found["preset"] == "table" and "tick" not in found


def test_counts():
    assert list(merge_counts([{"b": 1}, {"a": 2, "b": 3}]).items()) == [("a", 2), ("b", 4)]
