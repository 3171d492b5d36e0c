"""Where parts lie, and what their columns are."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays import dataset
from nerg_mi.rays.rays import Rays

pytest.importorskip("pyarrow")


def test_days_are_those_of_utc():
    moments = [datetime(2024, 2, 29, 23, 59, 59, tzinfo=timezone.utc), datetime(2024, 3, 1, tzinfo=timezone.utc)]
    days = dataset.days_of(np.array([m.timestamp() for m in moments]))
    assert [str(np.datetime64(int(d), "D")) for d in days] == ["2024-02-29", "2024-03-01"]


@pytest.mark.parametrize("t", [[0.0, 12.5], [1.7e9, 3.0], [1.7e18], [], [-5.0]])
def test_other_clocks_tell_no_day(t):
    assert dataset.days_of(np.array(t)) is None


def test_buckets_depend_on_the_name_alone_and_are_even():
    found = [dataset.bucket_of(f"user{k}", 16) for k in range(4000)]
    counts = np.bincount(found, minlength=16)
    assert len(counts) == 16 and counts.min() > 180 and counts.max() < 320
    # They stand in folders for good.
    assert [dataset.bucket_of(name, 16) for name in ("ann", "bo", "名")] == [2, 0, 3]


def test_a_place_may_be_called_as_its_people_do():
    for place in ("北 hall", "a/b", "..", "x=1", "100 %"):
        folder = Path("d.rays") / dataset.folder_of(dataset.check_place(place), "unknown", 3)
        assert len(folder.parts) == 4 and ".." not in folder.parts
        assert dataset.split_path(folder) == (Path("d.rays"), {"place": place, "day": "unknown", "bucket": "3"})


@pytest.mark.parametrize("place", ["", " a", "a\n", "x" * 65, "\x1b[2J"])
def test_what_is_no_place(place):
    with pytest.raises(NergError, match="--place-name"):
        dataset.check_place(place)


@pytest.mark.parametrize("day", ["", "2024-13-01", "2023-02-29", "today", "2024-1-1", "../x"])
def test_what_is_no_day(day):
    with pytest.raises(NergError, match="--day"):
        dataset.check_day(day)
    assert dataset.check_day("2024-02-29") == "2024-02-29" and dataset.check_day("unknown") == "unknown"


def test_columns():
    ahead = np.tile([0.0, 1.0, 0.0], (3, 1))
    rays = Rays([1.7e9 + 1e-6, 0.1, 2.0], [2, 0, 2], ("a", "b", "c"), ahead * 0.1, ahead, [0.7, 1, 1])
    table = dataset.table_of(rays, np.array([2, 0]))
    assert table.schema == dataset.schema()
    assert table.column("person").to_pylist() == ["c", "c"] and table.column("t").to_pylist() == [2.0, 1.7e9 + 1e-6]
    # Exact, so that rays of just the least confidence are still there.
    assert table.column("confidence").to_pylist() == [1.0, 0.7]
    assert table.column("cohort").null_count == 2 and np.isnan(table.column("hit_x").to_numpy()).all()
    assert table.column("origin_y").to_pylist() == [float(np.float32(0.1))] * 2
