"""The parts of a source, as other programs read them."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays import dataset, dataset_write
from nerg_mi.rays.dataset import Head, read_sources, write_head
from nerg_mi.rays.dataset_write import SourceWriter
from nerg_mi.rays.rays import FRAME, Rays

from .making import DAY, crowd

pq = pytest.importorskip("pyarrow.parquet")
ID = "0" * 32
ABOUT = {"file": "a.csv", "where": "w", "stamp": None, "recipe": "r", "generation": 0}


def test_parts_by_day_and_bucket_in_the_order_of_people_and_times(tmp_path):
    import pyarrow.dataset

    rays = crowd(start=DAY + 86_350)  # fifty seconds before midnight
    writer = SourceWriter(tmp_path, ID, 4)
    writer.add(rays, "shop / 1")
    writer.add(rays.select(rays.t < 0))
    source = writer.finish({"frame": dict(FRAME)}, **ABOUT)
    write_head(tmp_path, Head(4))
    assert read_sources(tmp_path, Head(4)) == [source] and writer.rays == source.rays == 1000
    assert writer.persons == ("ann", "bo", "zoe", "名")
    names = np.array(rays.persons)[rays.person]
    assert source.persons == {name: int((names == name).sum()) for name in sorted(rays.persons)}
    for part in source.parts:
        path = tmp_path / part.path(ID)
        table = pq.read_table(path, partitioning=None)
        who, t = table.column("person").to_pylist(), table.column("t").to_pylist()
        assert list(zip(who, t)) == sorted(zip(who, t)) and len(t) == part.rays
        assert {dataset.bucket_of(name, 4) for name in who} == {part.bucket} and (part.first, part.last) == (
            who[0],
            who[-1],
        )
        assert (part.start, part.end, part.bytes) == (min(t), max(t), path.stat().st_size)
        same = np.array(who[1:]) == np.array(who[:-1])
        steps = np.diff(t)[same]
        assert np.isclose(part.recorded, steps[steps <= 1].sum()) and part.duplicates == 0 and part.hits == 0
        for k, axis in enumerate("xyz"):
            column = table.column(f"origin_{axis}").to_numpy()
            assert (part.low[k], part.high[k]) == (column.min(), column.max())
    # Others see the folders as columns.
    found = pyarrow.dataset.dataset(tmp_path, format="parquet", partitioning="hive").to_table()
    assert set(found.column("day").to_pylist()) == {"2024-10-04", "2024-10-05"}
    assert set(found.column("place").to_pylist()) == {"shop / 1"} and found.num_rows == 1000


def test_a_day_that_is_given_and_one_that_nobody_knows(tmp_path):
    for id, given, there in (("0" * 32, "2020-01-01", "2020-01-01"), ("1" * 32, None, "unknown")):
        writer = SourceWriter(tmp_path, id, 4)
        writer.add(crowd(start=DAY if given else 0.0), day=given)
        assert {part.day for part in writer.finish({"frame": dict(FRAME)}, **ABOUT).parts} == {there}


def test_parts_and_groups_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_write, "PART_ROWS", 300)
    monkeypatch.setattr(dataset_write, "GROUP_ROWS", 100)
    writer = SourceWriter(tmp_path, ID, 1)
    writer.add(crowd())
    parts = writer.finish({"frame": dict(FRAME)}, **ABOUT).parts
    assert [part.rays for part in parts] == [300, 300, 300, 100] and [part.number for part in parts] == [0, 1, 2, 3]
    assert pq.ParquetFile(tmp_path / parts[0].path(ID)).metadata.num_row_groups == 3


def test_what_a_dataset_does_not_take(tmp_path):
    rays = crowd(3)
    far = Rays(rays.t, rays.person, rays.persons, rays.origin * 0 + 9000, rays.direction, rays.confidence)
    with pytest.raises(NergError, match=r"9e\+03 m from zero.*--units"):
        SourceWriter(tmp_path, ID, 1).add(far)
    odd = Rays(rays.t, rays.person, ("a", "b", "c", "\udce4"), rays.origin, rays.direction, rays.confidence)
    with pytest.raises(NergError, match="is no text"):
        SourceWriter(tmp_path, ID, 1).add(odd)
    assert not list(tmp_path.iterdir())


def test_many_runs_of_dropped_rows_are_counted(tmp_path):
    rows = [[2 * k, 2 * k] for k in range(1500)]
    dropped = [{"reason": "blink", "file": "a", "count": 1500, "rows": rows}]
    found = SourceWriter(tmp_path, ID, 1).finish({"frame": dict(FRAME), "dropped": dropped}, **ABOUT)
    (entry,) = found.metadata["dropped"]
    assert len(entry["rows"]) == 1000 and entry["rows_not_named"] == 500 and entry["count"] == 1500
