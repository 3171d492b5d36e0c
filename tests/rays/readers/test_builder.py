"""The account of what an import leaves out."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers import builder as collecting
from nerg_mi.rays.readers.builder import RaysBuilder


def add(builder, n, gone=(), first=1):
    origin = np.zeros((n, 3))
    origin[list(gone)] = np.nan
    builder.add(np.arange(n) * 0.1, "ann", origin, np.tile([1.0, 0, 0], (n, 1)), rows=np.arange(first, first + n))


def test_more_runs_than_are_named(tmp_path, monkeypatch):
    """Every other row is a blink: their number is exact, and the file can be read again."""
    monkeypatch.setattr(collecting, "NAMED_RUNS", 10)
    builder = RaysBuilder()
    (tmp_path / "a.csv").write_text("x")
    builder.source(tmp_path / "a.csv")
    add(builder, 14, [0, 1, 4, 6, 8, 10])
    add(builder, 14, [0, 2, 4, 6, 8, 10, 11], first=15)
    rays = builder.build()
    (lost,) = rays.metadata["dropped"]
    assert lost["count"] == 13 and len(lost["rows"]) == 10 and lost["rows"][0] == [1, 2]
    assert lost["rows_not_named"] == 13 - sum(b - a + 1 for a, b in lost["rows"]) > 0
    rays.save(tmp_path / "r.npz")
    assert Rays.load(tmp_path / "r.npz").metadata == rays.metadata


def test_bad_lines_are_bounded_by_file(tmp_path):
    """The lines of one file do not make up for those of another."""
    for name in "abc":
        (tmp_path / name).write_text("x")
    builder = RaysBuilder(skip_bad_lines=True)
    builder.source(tmp_path / "a")
    add(builder, 1000)
    builder.source(tmp_path / "b")
    add(builder, 198)
    for line in (3, 4):
        builder.on_bad(line, ": 2 cells")
    builder.source(tmp_path / "c")
    add(builder, 100)
    for line in (7, 8):
        builder.on_bad(line, ": 2 cells")
    with pytest.raises(NergError, match="c: 2 of 102 lines cannot be read, more than the 1 %.*line 7: 2 cells"):
        builder.build()
    assert RaysBuilder().on_bad is None


def test_a_file_of_another_kind_ends_early(tmp_path):
    (tmp_path / "a").write_text("x")
    builder = RaysBuilder(skip_bad_lines=True)
    builder.source(tmp_path / "a")
    with pytest.raises(NergError, match="lines cannot be read"):
        for line in range(1, 10**6):
            builder.on_bad(line, ": 1 cells")
    assert line < 20_000
