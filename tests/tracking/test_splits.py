"""Tests of `nerg_mi.tracking.splits`; `tests/tracking/test_filters.py` tests each criterion."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.splits import split_rays
from tests.cli.rays.running import write_walk
from tests.recorder import Recorder
from tests.refusals import mentions


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def test_training_and_test_rays_are_disjoint(walk, tmp_path):
    recorder, rays = Recorder(), Rays.load(walk)
    split = split_rays(rays, test_participants=0.5, test_time=0.3, gap=1, seed=2, progress=recorder)
    train, test = split
    assert len(train) + len(test) + split.purged == len(rays) and split.purged > 0
    assert not set(train.t) & set(test.t) and not set(train.participants) & set(test.participants)
    (step,) = test.metadata["steps"]
    assert step["side"] == "test" and step["seed"] == 2 and step["by"]["time"] == {"share": 0.3, "gap": 1, "of": "all"}
    assert recorder.messages == [
        f"{len(train):,} training rays, {len(test):,} test rays, {split.purged:,} purged of 12,000"
    ]
    files = split.save(tmp_path / "half.npz")
    assert [file.name for file in files] == ["half-train.npz", "half-test.npz"]
    assert [len(Rays.load(file)) for file in files] == [len(train), len(test)]


def test_training_rays_keep_their_distance_from_test_positions(walk):
    train, test = split_rays(walk, test_zones=2, test_positions=10, min_rays=8)
    centres = np.array(test.metadata["steps"][-1]["by"]["position"]["test_centres"])
    assert np.linalg.norm(train.origin[:, None] - centres[None], axis=2).min() > 0.5


@pytest.mark.parametrize(
    "options, names",
    [({}, ["test_zones", "test_participants", "persons", "test_time"]), ({"test_time": 0.5, "clock": "a"}, ["clock"])],
)
def test_wrong_arguments_are_refused(walk, options, names):
    with pytest.raises(NergError, check=mentions(*names)):
        split_rays(walk, **options)
