"""The card of a dataset: that of the same rays in a file, but for what it says is of a sample."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.rays.dataset_open import summarise_dataset
from nerg_mi.rays.quality import summarise

from .making import write_dataset

pytest.importorskip("pyarrow")
EXACT = ("rays", "persons", "duplicates", "rows_read", "dropped", "cohorts")


def test_all_rays(tmp_path):
    dataset, rays = write_dataset(tmp_path)
    loaded, found, lines = summarise_dataset(dataset)
    whole = summarise(rays)
    assert [getattr(found, name) for name in EXACT] == [getattr(whole, name) for name in EXACT]
    for name in ("duration", "box_low", "box_high", "eye_height", "hit_share", "speed_p95", "hit_distance", "rate"):
        assert np.allclose(getattr(found, name), getattr(whole, name), rtol=1e-5), name
    assert len(loaded) == len(rays) and [name for name, _ in lines] == ["dataset"]
    assert lines[0][1].startswith("3 sources in ") and lines[0][1].endswith(
        "place shop, day 2 from 2024-10-04 to 2024-10-05"
    )


def test_a_sample(tmp_path):
    dataset, rays = write_dataset(tmp_path)
    some, found, lines = summarise_dataset(dataset, 640)
    whole = summarise(rays)
    assert [getattr(found, name) for name in EXACT] == [getattr(whole, name) for name in EXACT] and len(some) == 640
    for name in ("duration", "box_low", "box_high", "hit_share"):
        assert np.allclose(getattr(found, name), getattr(whole, name), rtol=1e-5), name
    assert abs(found.eye_height[1] - whole.eye_height[1]) < 0.1
    assert "640 rays in 64 runs" in dict(lines)["sampled"]
