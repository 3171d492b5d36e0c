"""Tests of `nerg_mi.tracking.selection`: filters of rays, files and datasets."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.cli.building import choose_spelling
from nerg_mi.errors import NergError, clean_text
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking import selection
from nerg_mi.tracking.dataset import DatasetManifest, RayDataset, write_dataset_manifest
from nerg_mi.tracking.dataset_write import SourceWriter
from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.imports import import_rays
from nerg_mi.tracking.rays import FRAME, Rays
from nerg_mi.tracking.selection import filter_rays, smallest_mask
from tests.cli.rays.running import write_walk
from tests.recorder import Recorder
from tests.refusals import mentions
from tests.tracking.dataset.making import DAY, MAP, assert_same, crowd, write_dataset
from tests.tracking.people import some_rays


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


@pytest.fixture
def parquet():
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")


def write_dataset_of(rays, folder):
    """A dataset of ``rays``, which does not state their tracking."""
    write_dataset_manifest(folder, DatasetManifest(2))
    writer = SourceWriter(folder, "0" * 32, 2)
    writer.add(rays, "corridor")
    writer.finish({"frame": dict(FRAME)}, file="a", where="w", stamp=None, recipe="r", generation=0)
    return folder


def steps_of(rays):
    return [(step["step"], step["kept"], step["of"]) for step in rays.metadata["steps"]]


# ---- Rays in memory and in files ----


def test_steps_are_recorded_in_order():
    rays = crowd()
    before = {name: column.copy() for name, column in rays.columns().items()}
    few = filter_rays(rays, start=10, end=60, sample=100, seed=3)
    assert steps_of(few) == [("filter", 500, 1000), ("sample", 100, 500)] and len(set(few.t)) == 100
    assert few.metadata["steps"][1] == {"step": "sample", "kept": 100, "of": 500, "seed": 3}
    assert "steps" not in rays.metadata and all(np.array_equal(rays.columns()[k], v) for k, v in before.items())


def test_rays_and_their_file_are_filtered_alike(walk):
    rays, recorder = Rays.load(walk).with_tracking("eye"), Recorder()
    rays.save(walk)
    options = dict(persons=["a", "c"], start=10, end=30, fixations="idt", dispersion_threshold=30, thin=1)
    few = filter_rays(rays, **options, progress=recorder)
    assert [name for name, *_ in steps_of(few)] == ["filter", "fixations", "thin"] and len(rays) == 12_000
    assert recorder.messages[0] == f"filter: {few.metadata['steps'][0]['kept']:,} of 12,000 rays"
    assert recorder.messages[1].endswith(" fixations (idt)")
    assert_same(filter_rays(walk, **options), few)


@pytest.mark.parametrize("tracking", ["unknown", "eye"])
def test_fixations_of_unknown_tracking_are_reported_once(walk, tracking):
    recorder = Recorder()
    for options in ({"fixations": "ivt"}, {"start": 0}):
        filter_rays(Rays.load(walk).with_tracking(tracking), **options, progress=recorder)
    assert sum("heads" in line for line in recorder.warnings) == (tracking == "unknown")


def test_one_ray_per_fixation(walk):
    recorder = Recorder()
    rules = EventRules(velocity_threshold=300, min_fixation=0.1)
    options = dict(fixations="ivt", rules=rules, merge_fixations=True)
    rays = filter_rays(walk, **options, progress=recorder)
    (step,) = rays.metadata["steps"]
    assert len(rays) == step["kept"] and step["one_ray"] and step["of"] == 12_000
    assert f"{len(rays):,} fixations (ivt)" in recorder.messages and step.items() >= rules.describe().items()


def test_samples_are_uniform():
    counts = np.zeros(20)
    for seed in range(2000):
        mask = smallest_mask(np.random.default_rng(seed).random(20), 5)
        assert mask.sum() == 5
        counts += mask
    assert ((counts - 500) ** 2 / 500).sum() < 43.8  # chi-square of 19 degrees of freedom at one in a thousand
    assert smallest_mask(np.zeros(3), 5).all() and not smallest_mask(np.arange(3.0), 0).any()


@pytest.mark.parametrize(
    "options, names",
    [
        ({}, ["start", "fixations", "sample"]),
        ({"fixations": "magic"}, ["fixations"]),
        ({"merge_fixations": True}, ["merge_fixations", "fixations"]),
        ({"box": (0, 1, 0, np.nan, 0, 1)}, ["box"]),
        ({"start": "noon"}, ["start"]),
    ],
)
def test_wrong_arguments_are_refused(options, names):
    with pytest.raises(NergError, check=mentions(*names)):
        filter_rays(crowd(), **options)


def test_refused_selections(walk, tmp_path):
    with pytest.raises(NergError, match=r"selects none of 1,000 rays \(.*1000000.*\); widen its conditions"):
        filter_rays(crowd(), start=1e6)
    with pytest.raises(NergError, match=r"Rays\.from_dataframe"):
        filter_rays({"t": [0]}, start=0)
    (tmp_path / "folder.npz").mkdir()
    for output in ("rays.txt", "folder.npz", "walk.rays"):
        with pytest.raises(NergError, match=output):
            filter_rays(walk, start=0, output=tmp_path / output)


# ---- Datasets ----


def test_fixations_of_a_dataset_of_unknown_tracking_are_reported_once(parquet, walk, tmp_path):
    folder, recorder = write_dataset_of(Rays.load(walk), tmp_path / "walk.rays"), Recorder()
    options = dict(fixations="idt", dispersion_threshold=30, output=tmp_path / "few.rays")
    filter_rays(folder, **options, progress=recorder)
    assert sum("heads" in line for line in recorder.warnings) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"persons": ("p0_0", "p2_1")},
        {"start": DAY + 1, "end": DAY + 2, "with_hit": True},
        {"fixations": "ivt", "rules": EventRules(velocity_threshold=1e5), "start": DAY + 1},
        {"fixations": "idt", "dispersion_threshold": 170.0, "merge_fixations": True},
        # No block but one has fixations.
        {"fixations": "ivt", "rules": EventRules(velocity_threshold=1e5, min_fixation=2.6), "thin": 0.5},
        {"thin": 0.5, "thin_distance": 9.0, "box": (0, 4, 0, 4, 0, 3)},
    ],
)
def test_datasets_are_filtered_as_files(parquet, tmp_path, changes):
    dataset, _ = write_dataset(tmp_path)
    recorder, expected = Recorder(), Recorder()
    result = filter_rays(dataset.folder, **changes, output=tmp_path / "a.parquet", progress=recorder)
    # Fixations of a participant may depend on the rounding of positions.
    in_memory = filter_rays(dataset.load(), **changes, progress=expected)
    assert_same(result, in_memory)
    assert_same(Rays.load(tmp_path / "a.parquet"), in_memory)
    assert recorder.messages.pop() == f"wrote {tmp_path / 'a.parquet'}"
    assert sorted(recorder.messages) == sorted(expected.messages) and steps_of(result) == steps_of(in_memory)
    # Into another dataset: the same rays.
    other = filter_rays(dataset, **changes, output=tmp_path / "b.rays")
    assert isinstance(other, RayDataset) and other.folder == tmp_path / "b.rays"
    assert_same(other.load(), in_memory)
    assert steps_of(other.load()) == steps_of(in_memory)
    with pytest.raises(NergError, match="was filtered from another"):
        import_rays(tmp_path / "files" / "0.csv", columns=MAP, output=tmp_path / "b.rays", workers=1)


def test_samples_of_a_dataset_are_uniform(parquet, tmp_path):
    dataset, rays = write_dataset(tmp_path)
    plain = filter_rays(dataset.folder, sample=50, seed=2)
    assert np.array_equal(plain.t, dataset.sample(50, 2).t)
    counts = np.zeros(len(rays))
    place = {(t, x): k for k, (t, x) in enumerate(zip(rays.t.tolist(), rays.origin[:, 0].astype(np.float32).tolist()))}
    for seed in range(30):
        some = filter_rays(dataset.folder, sample=40, seed=seed, cohorts=["x"])
        assert len(some) == 40 and some.cohorts == ("x",)
        assert [name for name, *_ in steps_of(some)] == ["filter", "sample"]
        counts[[place[t, x] for t, x in zip(some.t.tolist(), some.origin[:, 0].tolist())]] += 1
    # Samples are uniform over blocks: each source has a third of the rays.
    thirds = np.array(
        [counts[np.array(rays.persons)[rays.person] == f"p{k}_{j}"].sum() for k in range(3) for j in range(3)]
    )
    assert counts.sum() == 1200 and counts.max() <= 8 and thirds.min() > 80 and thirds.max() < 190
    with pytest.raises(NergError, check=mentions("sample")):
        filter_rays(dataset.folder, sample=4, output=tmp_path / "c.rays")


@pytest.mark.parametrize("fixations", ["ivt", "idt"])
@pytest.mark.parametrize("merge_fixations", [False, True])
def test_the_reason_for_no_fixations_is_named(fixations, merge_fixations, parquet, tmp_path):
    slow = some_rays(40, t=np.arange(40) / 5).with_tracking("eye")
    options: dict = {"fixations": fixations, "merge_fixations": merge_fixations, "progress": Recorder()}
    for rays in (slow, write_dataset_of(slow, tmp_path / "slow.rays")):
        with pytest.raises(NergError, match="0.2 s apart.* 0.1 s") as error:
            filter_rays(rays, **options)
        assert set(error.value.parameters) == {"max_step"}
        assert "--max-step" in clean_text(error.value.message, choose_spelling(["rays", "filter"]))
        assert len(filter_rays(rays, **options, rules=EventRules(max_step=0.3))) == (1 if merge_fixations else 40)
    fast = some_rays(40, t=np.arange(40) / 50, direction=fibonacci_directions(64)[::-1][:40])
    with pytest.raises(NergError) as error:
        filter_rays(fast.with_tracking("eye"), **options)
    assert ("velocity_threshold" if fixations == "ivt" else "dispersion_threshold") in error.value.parameters


def test_impossible_filters_of_datasets_are_refused(parquet, tmp_path, monkeypatch):
    dataset, _ = write_dataset(tmp_path)
    with pytest.raises(NergError, match="rays are selected; widen the conditions"):
        filter_rays(dataset.folder, start=0, end=1, output=tmp_path / "a.rays")
    assert not (tmp_path / "a.rays").exists()
    monkeypatch.setattr(selection, "MAX_LOADED_RAYS", 500)
    with pytest.raises(NergError, match="more than 500 rays"):
        filter_rays(dataset.folder, with_hit=True)
    with pytest.raises(NergError, match="not empty"):
        filter_rays(dataset.folder, with_hit=True, output=dataset.folder)
