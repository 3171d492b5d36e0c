"""Row groups of a part; what is refused of them is tried in `test_dataset`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.rays import dataset_write
from nerg_mi.rays.dataset import read_groups

from .making import write_dataset

pytest.importorskip("pyarrow")


def test_groups_their_rows_and_bounds(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_write, "GROUP_ROWS", 50)
    dataset, _ = write_dataset(tmp_path, 1)
    source, part = max(dataset.parts, key=lambda found: found[1].rays)
    seen = []

    def wanted(first, count, bounds):
        seen.append((first, count, bounds))
        return first != 50

    groups = list(read_groups(dataset.folder, source, part, wanted))
    assert [first for first, _ in groups] == [first for first, *_ in seen if first != 50]
    assert sum(count for _, count, _ in seen) == part.rays > 100
    for first, rays in groups:
        _, count, bounds = next(entry for entry in seen if entry[0] == first)
        assert len(rays) == count and bounds["t"] == (rays.t.min(), rays.t.max())
        assert bounds["origin_y"] == (np.float32(rays.origin[:, 1].min()), np.float32(rays.origin[:, 1].max()))
        assert bounds["person"] == (rays.persons[0], rays.persons[-1])
    (_, bare), *_ = read_groups(dataset.folder, source, part, lambda *_: True, hits=False)
    assert bare.hit is None and bare.cohort is not None
