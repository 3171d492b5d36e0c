"""Training and evaluation on datasets of rays."""

from __future__ import annotations

import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation.held_out import evaluate_gaze
from nerg_mi.tracking.dataset import open_rays
from nerg_mi.train.gaze import train_gaze
from tests.evaluation.test_gaze import crowd as evaluated_crowd
from tests.evaluation.test_held_out import HELD_OUT, OPTIONS
from tests.recorder import Recorder
from tests.tracking.dataset.making import write_dataset
from tests.tracking.test_selection import write_dataset_of


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A dataset of 3,000 rays of four participants in a corridor."""
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")
    return write_dataset_of(evaluated_crowd(3000), tmp_path_factory.mktemp("crowded") / "corridor.rays")


@pytest.mark.parametrize("max_samples", [pytest.param(10_000, marks=pytest.mark.nightly), 2500])
def test_training_and_evaluation_use_the_same_rays(crowded, tmp_path, max_samples):
    heard, gaze = Recorder(), tmp_path / "gaze.safetensors"
    trained = train_gaze(crowded, "none", **HELD_OUT, max_samples=max_samples, seed=3, output=gaze, progress=heard)
    metadata = trained.provenance["rays_file"]
    count = min(max_samples, 3000)
    assert metadata["file"] == "corridor.rays" and (metadata["rays"], metadata["most"], metadata["seed"]) == (
        count,
        max_samples,
        3,
    )
    assert trained.provenance["test"]["rays"] == count and f"{count:,} rays of {crowded}" in heard.messages
    result = evaluate_gaze(gaze, crowded, **OPTIONS)
    # The same scores as for the rays in memory.
    rays = open_rays(crowded, max_samples, 3)
    alone = train_gaze(rays, "none", **HELD_OUT, seed=3, output=tmp_path / "alone.safetensors")
    assert alone.provenance["test"] == trained.provenance["test"]
    # The order in which two threads sum gradients varies, so two fits agree up to rounding only.
    scored = evaluate_gaze(tmp_path / "alone.safetensors", rays, **OPTIONS)
    assert [row["KLD"] for row in scored.rows] == pytest.approx([row["KLD"] for row in result.rows], rel=1e-6)


def test_evaluation_refuses_another_dataset(crowded, tmp_path):
    train_gaze(crowded, "none", **HELD_OUT, output=tmp_path / "gaze.safetensors")
    dataset, _ = write_dataset(tmp_path, 1)
    with pytest.raises(NergError, match=r"corridor\.rays"):
        evaluate_gaze(tmp_path / "gaze.safetensors", dataset.folder, **OPTIONS)
