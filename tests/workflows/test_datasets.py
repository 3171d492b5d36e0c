"""Jobs on datasets: imported, summed up and filtered as files are, and trained and scored on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.dataset import Head, RayDataset, write_head
from nerg_mi.rays.dataset_open import load_rays
from nerg_mi.rays.dataset_write import SourceWriter
from nerg_mi.rays.rays import FRAME, Rays
from nerg_mi.workflows import rays
from nerg_mi.workflows.evaluate import evaluate_gaze
from nerg_mi.workflows.rays import card_of, filter_rays, import_rays
from nerg_mi.workflows.rays_commands import FilterOptions, RaysImportOptions
from nerg_mi.workflows.train_gaze import train_gaze
from tests.evaluation.test_gaze import crowd
from tests.rays.dataset.making import DAY, assert_same, settings, write_dataset, write_source
from tests.workflows.test_evaluation import OPTIONS, TRAINING

from .recorder import Recorder

pytest.importorskip("pyarrow")


def options(**given) -> RaysImportOptions:
    return RaysImportOptions(**{"settings": settings(), "workers": 1, **given})


@pytest.fixture
def files(tmp_path):
    return [write_source(tmp_path / "files" / f"{k}.csv", k, 200, start=DAY) for k in range(3)]


def test_import(files, tmp_path):
    heard, output = Recorder(), tmp_path / "shop.rays"
    found = import_rays(files, options(output=output, place_name="shop"), heard)
    at_once = import_rays(files, options(workers=None))
    assert_same(found.rays, at_once.rays)
    assert found.summary.rays == 597 and found.lines[0][0] == "dataset" and at_once.lines == ()
    assert heard.messages == ["imported 3 sources, 597 rays"]
    import_rays(files, options(output=output, place_name="shop"), heard)
    assert heard.messages[1] == "nothing to import; 3 unchanged"
    more = write_source(tmp_path / "north.csv", 5, 100)
    card = import_rays([more], options(output=output, place_name="north"), heard)
    assert card.summary.rays == 99 and len(RayDataset.open(output)) == 696
    assert [(title, c.summary.rays) for title, c in card_of(output)] == [
        (f"{output}: north", 99),
        (f"{output}: shop", 597),
    ]
    assert [title for title, _ in card_of(output / "place=north")] == [str(output / "place=north")]


def test_what_could_not_be_imported_is_told_in_the_end(files, tmp_path):
    files[1].write_text("t\n")
    with pytest.raises(NergError, match=r"1\.csv.*1.*3"):
        import_rays(files, options(output=tmp_path / "shop.rays"))
    assert len(RayDataset.open(tmp_path / "shop.rays")) == 398


def test_pseudonyms(files, tmp_path):
    (tmp_path / "salt").write_bytes(bytes(range(32)))
    salted = {"pseudonyms": True, "salt": tmp_path / "salt"}
    found = import_rays(files, options(output=tmp_path / "a.rays", **salted))
    assert found.rays.persons == import_rays(files, RaysImportOptions(settings=settings(), **salted)).rays.persons
    random = import_rays(files, options(output=tmp_path / "b.rays", pseudonyms=True))
    assert len(random.rays.persons) == 9 and not set(random.rays.persons) & set(found.rays.persons)
    with pytest.raises(NergError, match="random salt"):
        import_rays(files, options(output=tmp_path / "b.rays", pseudonyms=True))


@pytest.mark.parametrize(
    "given, why",
    [
        ({"place_name": "x"}, "--place-name belongs to datasets"),
        ({"day": "2024-01-01", "output": "a.npz"}, "--day belongs to datasets"),
        ({"workers": 0, "output": "a.rays"}, "--workers must lie in"),
        ({"align_output": "a.json", "output": "a.rays"}, "--write-align belongs to files"),
    ],
)
def test_options_of_datasets(given, why):
    with pytest.raises(NergError, match=why):
        RaysImportOptions(**given)


@pytest.mark.parametrize(
    "given",
    [
        {"persons": ("p0_0", "p2_1")},
        {"start": DAY + 1, "end": DAY + 2, "with_hit": True},
        {"fixations": "ivt", "velocity": 1e5, "start": DAY + 1},
        {"fixations": "idt", "dispersion": 170.0, "one_ray": True, "least": 0.05},
        {"thin": 0.5, "thin_distance": 9.0, "box": (0, 4, 0, 4, 0, 3)},
    ],
)
def test_filters_are_those_of_a_file(tmp_path, given):
    dataset, rays = write_dataset(tmp_path)
    heard, expected = Recorder(), Recorder()
    found = filter_rays(dataset.folder, FilterOptions(**given, output=tmp_path / "a.parquet"), heard)
    # What is found of a person may depend on the rounding of places.
    rays = dataset.load()
    whole = filter_rays(rays, FilterOptions(**given), expected)
    assert_same(found.rays, whole.rays)
    assert_same(Rays.load(tmp_path / "a.parquet"), whole.rays)
    assert heard.messages.pop() == f"wrote {tmp_path / 'a.parquet'}"
    assert found.fixations == whole.fixations and sorted(heard.messages) == sorted(
        m.replace(": one ray each,", ":") for m in expected.messages
    )
    counts = lambda r: [(s["step"], s["kept"], s["of"]) for s in r.metadata["steps"]]
    assert counts(found.rays) == counts(whole.rays)
    # Into another dataset: the same rays.
    other = filter_rays(dataset.folder, FilterOptions(**given, output=tmp_path / "b.rays"))
    assert other.rays is None and other.fixations == whole.fixations
    assert_same(load_rays(tmp_path / "b.rays"), whole.rays)
    assert counts(load_rays(tmp_path / "b.rays")) == counts(whole.rays)
    with pytest.raises(NergError, match="was filtered from another"):
        import_rays([tmp_path / "files" / "0.csv"], options(output=tmp_path / "b.rays"))


def test_samples(tmp_path):
    dataset, rays = write_dataset(tmp_path)
    plain = filter_rays(dataset.folder, FilterOptions(sample=50, seed=2)).rays
    assert np.array_equal(plain.t, dataset.sample(50, 2).t)
    counts = np.zeros(len(rays))
    place = {(t, x): k for k, (t, x) in enumerate(zip(rays.t.tolist(), rays.origin[:, 0].astype(np.float32).tolist()))}
    for seed in range(30):
        some = filter_rays(dataset.folder, FilterOptions(sample=40, seed=seed, cohorts=("x",))).rays
        assert len(some) == 40 and some.cohorts == ("x",)
        assert [s["step"] for s in some.metadata["steps"]] == ["filter", "sample"]
        counts[[place[t, x] for t, x in zip(some.t.tolist(), some.origin[:, 0].tolist())]] += 1
    # In all blocks as likely: a third of the rays is of each source.
    thirds = np.array(
        [counts[np.array(rays.persons)[rays.person] == f"p{k}_{j}"].sum() for k in range(3) for j in range(3)]
    )
    assert counts.sum() == 1200 and counts.max() <= 8 and thirds.min() > 80 and thirds.max() < 190
    with pytest.raises(NergError, match="--sample"):
        filter_rays(dataset.folder, FilterOptions(sample=4, output=tmp_path / "c.rays"))


def test_filters_that_cannot_be(tmp_path, monkeypatch):
    dataset, _ = write_dataset(tmp_path)
    with pytest.raises(NergError, match="nothing is left of 1,197 rays"):
        filter_rays(dataset.folder, FilterOptions(start=0, end=1, output=tmp_path / "a.rays"))
    assert not (tmp_path / "a.rays").exists()
    monkeypatch.setattr(rays, "MOST", 500)
    with pytest.raises(NergError, match="more than 500 rays are left"):
        filter_rays(dataset.folder, FilterOptions(with_hit=True))
    with pytest.raises(NergError, match="not empty"):
        filter_rays(dataset.folder, FilterOptions(with_hit=True, output=dataset.folder))


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A dataset of 3,000 rays of four people in a corridor."""
    folder = tmp_path_factory.mktemp("crowded") / "corridor.rays"
    write_head(folder, Head(2))
    writer = SourceWriter(folder, "0" * 32, 2)
    writer.add(crowd(3000), "corridor")
    writer.finish({"frame": dict(FRAME)}, file="a", where="w", stamp=None, recipe="r", generation=0)
    return folder


@pytest.mark.parametrize("most", [10_000, 2500])
def test_training_and_scores_are_of_the_same_rays(crowded, tmp_path, most):
    heard, gaze = Recorder(), tmp_path / "gaze.safetensors"
    trained = train_gaze(crowded, gaze, replace(TRAINING, most=most, seed=3), heard)
    about = trained.provenance["rays_file"]
    count = min(most, 3000)
    assert about["file"] == "corridor.rays" and (about["rays"], about["most"], about["seed"]) == (count, most, 3)
    assert trained.provenance["test"]["rays"] == count and f"{count:,} rays of {crowded}" in heard.messages
    found = evaluate_gaze(gaze, crowded, options=OPTIONS)
    # As of the rays themselves.
    rays = load_rays(crowded, most, 3)
    alone = train_gaze(rays, tmp_path / "alone.safetensors", replace(TRAINING, seed=3))
    assert alone.provenance["test"] == trained.provenance["test"]
    # Two threads add up a gradient in an order of their own, so that two fits agree to rounding alone.
    scored = evaluate_gaze(tmp_path / "alone.safetensors", rays, options=OPTIONS)
    assert [row["KLD"] for row in scored.rows] == pytest.approx([row["KLD"] for row in found.rows], rel=1e-6)


def test_another_dataset_is_not_scored(crowded, tmp_path):
    train_gaze(crowded, tmp_path / "gaze.safetensors", TRAINING)
    dataset, _ = write_dataset(tmp_path, 1)
    with pytest.raises(NergError, match=r"corridor\.rays"):
        evaluate_gaze(tmp_path / "gaze.safetensors", dataset.folder, options=OPTIONS)
