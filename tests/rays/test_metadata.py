"""The JSON document of a rays file: what is read, and what is refused."""

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import VERSION, read_metadata

GOOD = {
    "version": VERSION,
    "frame": {"units": "m", "up": "z", "handedness": "right"},
    "persons": ["ann", "bo"],
    "cohorts": [],
    "source_frame": {"units": "cm", "up": "y", "handedness": "left"},
    "transform": np.eye(4).tolist(),
    "rows_read": 12,
    "sources": [{"file": "a.csv", "sha256": "00"}, {"file": "b.csv"}],
    "dropped": [{"reason": "blink", "count": 2, "file": "a.csv", "rows": [[3, 4]]}, {"reason": "other", "count": 1}],
    "steps": [
        {"step": "filter", "kept": 9, "of": 10},
        {"step": "fixations", "kept": 9, "of": 9, "by": "ivt"},
        {"step": "split", "kept": 5, "of": 9, "by": {"position": {"radius": 0.25, "test_centres": [[0, 0, 1.5]]}}},
    ],
    "tick": 0.001,
    "anything": {"else": [1, "two"]},
}


def read(**change):
    about = {**GOOD, **change}
    return read_metadata(json.dumps({k: v for k, v in about.items() if v is not ...}), "r.npz")


def test_what_is_known_and_what_is_not():
    assert read() == {k: v for k, v in GOOD.items() if k != "version"}
    least = json.dumps({k: GOOD[k] for k in ("version", "frame", "persons")})
    assert set(read_metadata(least.encode(), "r.npz")) == {"frame", "persons"}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"version": VERSION + 1}, "another version"),
        ({"version": ...}, 'lack "version"'),
        ({"persons": ...}, 'lack "persons"'),
        ({"frame": ...}, 'lack "frame"'),
        ({"frame": {"units": "m", "up": "z"}}, '"frame" .*frame of units'),
        ({"persons": ["ann", 2]}, '"persons" .*list of names'),
        ({"transform": np.zeros((4, 4)).tolist()}, "can be inverted"),
        ({"transform": np.eye(3).tolist()}, "can be inverted"),
        ({"transform": (np.arange(16).reshape(4, 4) + 1).tolist()}, "can be inverted"),
        ({"rows_read": -1}, "number of rows"),
        ({"rows_read": True}, "number of rows"),
        ({"sources": [{"sha256": "00"}]}, "list of files"),
        ({"dropped": [{"reason": "blink", "count": 2, "rows": [[3]]}]}, "list of reasons"),
        ({"dropped": [{"count": 2}]}, "list of reasons"),
        ({"steps": [{"step": "filter", "kept": 1}]}, "list of steps"),
        ({"steps": [{"step": "split", "kept": 1, "of": 2, "by": {"position": {"radius": "far"}}}]}, "list of steps"),
        ({"steps": [{"step": "split", "kept": 1, "of": 2, "by": {"position": {"test_centres": [[1, 2]]}}}]}, "steps"),
        ({"eye_distance": {"ann": "wide"}}, "distances in metres"),
        ({"eye_distance": [0.06]}, "distances in metres"),
        ({"floor": 0}, '"floor" .*word'),
        ({"tick": 0}, "time in seconds"),
        ({"tick": "1"}, "time in seconds"),
    ],
)
def test_refusals(change, message):
    with pytest.raises(NergError, match=f"r.npz.*{message}|{message}.*r.npz"):
        read(**change)


def test_what_is_no_document():
    for text in ("[]", "1", "{", ""):
        with pytest.raises(NergError, match=r"r\.npz"):
            read_metadata(text, "r.npz")
