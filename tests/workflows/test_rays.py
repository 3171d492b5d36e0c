"""Rays: imports, filters, splits and plots of files and of datasets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError
from nerg_mi.rays.dataset import DatasetManifest, RayDataset, load_rays, write_dataset_manifest
from nerg_mi.rays.dataset_write import SourceWriter
from nerg_mi.rays.rays import FRAME, Rays
from nerg_mi.rays.readers.registry import make_options
from nerg_mi.workflows import rays
from nerg_mi.workflows.evaluate import evaluate_gaze
from nerg_mi.workflows.rays import (
    FilterSteps,
    filter_rays,
    import_rays,
    make_quality_report,
    plot_rays,
    smallest_mask,
    split_rays,
)
from nerg_mi.workflows.rays_commands import FilterOptions, PlotOptions, RaysImportOptions, SplitOptions
from nerg_mi.workflows.train_gaze import train_gaze
from tests.cli.rays.running import write_walk
from tests.evaluation.test_gaze import crowd as evaluated_crowd
from tests.rays.dataset.making import DAY, assert_same, crowd, settings, write_dataset, write_source
from tests.rays.readers.examples import EXAMPLES
from tests.refusals import mentions
from tests.workflows.test_gaze import OPTIONS, TRAINING

from .recorder import Recorder

# ---- The steps of a filter, in place and on a copy ----


def test_filter_steps_are_recorded_in_order():
    rays = crowd()
    steps = FilterSteps(rays, in_place=False)
    steps.select({"time": (10, 60)})
    steps.sample(100, seed=3)
    assert [(s.name, s.kept, s.of) for s in steps.taken] == [("filter", 500, 1000), ("sample", 100, 500)]
    assert steps.rays.metadata["steps"][1] == {"step": "sample", "kept": 100, "of": 500, "seed": 3}
    assert len(rays) == 1000 and "steps" not in rays.metadata and len(set(steps.rays.t)) == 100


def test_a_filter_that_removes_all_rays_is_refused():
    steps = FilterSteps(crowd(), in_place=True)
    with pytest.raises(NergError, match="rays; widen its conditions"):
        steps.select({"time": (1e6, None)})
    steps = FilterSteps(crowd().select(np.zeros(1000, bool)), in_place=True, strict=False)
    for fixations, one_ray in (("ivt", False), ("idt", True)):
        assert steps.follow(FilterOptions(fixations=fixations, merge_fixations=one_ray, thin=2)) == 0
    assert [s.of for s in steps.taken] == [0] * 4


def test_random_keys_select_samples_uniformly():
    counts = np.zeros(20)
    for seed in range(2000):
        mask = smallest_mask(np.random.default_rng(seed).random(20), 5)
        assert mask.sum() == 5
        counts += mask
    assert ((counts - 500) ** 2 / 500).sum() < 43.8  # chi-square of 19 degrees of freedom at one in a thousand
    assert smallest_mask(np.zeros(3), 5).all() and not smallest_mask(np.arange(3.0), 0).any()


# ---- Jobs on tracking data from a notebook: rays or files, results, and progress ----


class Heard:
    """A reporter that records its messages."""

    def __init__(self):
        self.messages, self.shares = [], []

    def message(self, text):
        self.messages.append(text)

    def warn(self, text):
        raise AssertionError(text)

    def progress(self, share, text=""):
        self.shares.append((share, text))


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def columns(rays):
    return [rays.t, rays.person, rays.origin, rays.direction, rays.confidence, rays.hit]


def test_files_are_imported(tmp_path):
    source, heard = EXAMPLES["table"].make(tmp_path), Heard()
    (tmp_path / "more.csv").write_text(source.read_text())
    settings = make_options("table", EXAMPLES["table"].options)
    options = RaysImportOptions(settings=settings, output=tmp_path / "rays.npz")
    result = import_rays([source, tmp_path / "more.csv"], options, heard)
    assert len(result.rays) == 40 == result.summary.rays and result.rays.persons == ("ann", "bo")
    assert heard.shares == [(0.0, "reading gaze.csv"), (0.5, "reading more.csv")] and heard.messages == []
    saved = Rays.load(tmp_path / "rays.npz")
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(columns(saved), columns(result.rays)))
    assert len(import_rays(source, RaysImportOptions(settings=settings)).rays) == 20


def test_alignment_maps_rays_to_file_coordinates(tmp_path):
    """The alignment matrix maps training rays to file coordinates."""
    source, align = EXAMPLES["table"].make(tmp_path), tmp_path / "align.json"
    table = EXAMPLES["table"].options
    settings = make_options("table", {**table, "up": "-y", "units": "mm"})
    rays = import_rays(source, RaysImportOptions(settings=settings, align_output=align)).rays
    back = read_similarity(align, "--align", "rays to field")
    plain = import_rays(source, RaysImportOptions(settings=make_options("table", table))).rays
    assert np.isclose(back.scale, 1000.0)
    assert np.allclose(rays.origin @ back.matrix[:3, :3].T + back.matrix[:3, 3], plain.origin)
    with pytest.raises(NergError, match="left-handed"):
        left = make_options("table", {**table, "up": "y", "handedness": "left"})
        import_rays(source, RaysImportOptions(settings=left, align_output=align, output=tmp_path / "none.npz"))
    assert not (tmp_path / "none.npz").exists()


def test_a_salt_makes_pseudonyms_reproducible(tmp_path):
    source = EXAMPLES["table"].make(tmp_path)
    settings = make_options("table", EXAMPLES["table"].options)
    (tmp_path / "salt").write_bytes(bytes(range(32)))
    one, two = (
        import_rays(source, RaysImportOptions(settings=settings, pseudonyms=True, salt=tmp_path / "salt"))
        for _ in range(2)
    )
    assert one.rays.persons == two.rays.persons and not set(one.rays.persons) & {"ann", "bo"}
    with pytest.raises(NergError, match="salt needs pseudonyms=True; add it, or leave out"):
        RaysImportOptions(settings=settings, salt=tmp_path / "salt")


def test_an_unwritable_output_is_refused_before_the_import(tmp_path, walk):
    (tmp_path / "folder.npz").mkdir()
    for output in (tmp_path / "rays.txt", tmp_path / "folder.npz"):
        for job in (
            lambda output=output: import_rays("absent.csv", RaysImportOptions(reader="varjo", output=output)),
            lambda output=output: filter_rays("absent.npz", FilterOptions(start=0, output=output)),
            lambda output=output: split_rays("absent.npz", SplitOptions(test_participants=0.5, test_output=output)),
        ):
            with pytest.raises(NergError, match=output.name):
                job()


def test_filter_does_not_modify_its_input(walk):
    rays, heard = Rays.load(walk).with_tracking("eye"), Heard()
    before = [column.copy() for column in columns(rays)]
    options = FilterOptions(persons=["a", "c"], start=10, end=30, fixations="idt", dispersion_threshold=30, thin=1)
    result = filter_rays(rays, options, heard)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(before, columns(rays))) and len(rays) == 12_000
    assert [s["step"] for s in result.rays.metadata["steps"]] == ["filter", "fixations", "thin"]
    assert result.fixations > 0 and heard.messages[1] == f"{result.fixations:,} fixations (idt)"
    assert heard.messages[0] == f"filter: {result.rays.metadata['steps'][0]['kept']:,} of 12,000 rays"
    from_file = filter_rays(walk, options)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(columns(from_file.rays), columns(result.rays)))
    assert filter_rays(rays, FilterOptions(start=10)).fixations is None


def test_fixations_of_unknown_tracking_are_reported_once(walk):
    for tracking in ("unknown", "eye"):
        recorder = Recorder()
        for options in (FilterOptions(fixations="ivt"), FilterOptions(start=0)):
            filter_rays(Rays.load(walk).with_tracking(tracking), options, recorder)
        assert sum("heads" in line for line in recorder.warnings) == (tracking == "unknown")


def test_fixations_of_a_dataset_of_unknown_tracking_are_reported_once(parquet, walk, tmp_path):
    folder, recorder = write_dataset_of(Rays.load(walk), tmp_path / "walk.rays"), Recorder()
    options = FilterOptions(fixations="idt", dispersion_threshold=30, output=tmp_path / "few.rays")
    filter_rays(folder, options, recorder)
    assert sum("heads" in line for line in recorder.warnings) == 1


def test_filter_selects_one_ray_per_fixation(walk):
    result = filter_rays(
        walk, FilterOptions(fixations="ivt", velocity_threshold=300, min_fixation=0.1, merge_fixations=True)
    )
    (step,) = result.rays.metadata["steps"]
    assert len(result.rays) == result.fixations == step["kept"] and step["one_ray"] and step["velocity"] == 300
    assert step["least"] == 0.1 and step["of"] == 12_000  # noqa: RUF069 (stored)


def test_split_separates_training_and_test_rays(walk, tmp_path):
    heard = Heard()
    rays = Rays.load(walk)
    options = SplitOptions(test_participants=0.5, test_time=0.3, gap=1, seed=2, train_output=tmp_path / "train.npz")
    result = split_rays(rays, options, heard)
    assert len(result.train) + len(result.test) + result.purged == len(rays) and result.purged > 0
    assert not set(result.train.t) & set(result.test.t) and not (tmp_path / "test.npz").exists()
    assert len(Rays.load(tmp_path / "train.npz")) == len(result.train)
    (step,) = result.test.metadata["steps"]
    assert step["side"] == "test" and step["seed"] == 2 and step["by"]["time"] == {"share": 0.3, "gap": 1, "of": "all"}
    assert heard.messages == [
        f"{len(result.train):,} training rays, {len(result.test):,} test rays, {result.purged:,} purged of 12,000"
    ]


def test_plots_are_written(walk, tmp_path):
    split = split_rays(walk, SplitOptions(test_zones=2, min_rays=8, test_positions=10))
    figure = plot_rays(split.train, PlotOptions(kind="layout", test=split.test, output=tmp_path / "p.png"))
    assert figure.axes and (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    assert plot_rays(walk).axes
    assert "directions of heads" in plot_rays(Rays.load(walk).with_tracking("head")).get_title(loc="left")


@pytest.mark.parametrize(
    "make, message",
    [
        (FilterOptions, "no selection is given; add for instance"),
        (lambda: FilterOptions(fixations="magic"), "ivt or idt"),
        (lambda: FilterOptions(merge_fixations=True), "add fixations"),
        (SplitOptions, "no criterion is given for the split; add"),
        (lambda: PlotOptions(kind="map"), "density or layout"),
        (lambda: PlotOptions(test="a.npz"), 'add kind="layout"'),
    ],
)
def test_contradictory_options_are_refused(make, message):
    with pytest.raises(NergError, match=message):
        make()


# ---- Jobs on datasets: import, summary, filters, training and evaluation, as for files ----


@pytest.fixture
def parquet():
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")


def options(**changes) -> RaysImportOptions:
    return RaysImportOptions(**{"settings": settings(), "workers": 1, **changes})


@pytest.fixture
def files(tmp_path):
    return [write_source(tmp_path / "files" / f"{k}.csv", k, 200, start=DAY) for k in range(3)]


def test_files_are_imported_into_a_dataset(parquet, files, tmp_path):
    heard, output = Recorder(), tmp_path / "shop.rays"
    result = import_rays(files, options(output=output, environment="shop"), heard)
    at_once = import_rays(files, options(workers=None))
    assert_same(result.rays, at_once.rays)
    assert result.summary.rays == 597 and result.lines[0][0] == "dataset" and at_once.lines == ()
    assert heard.messages == ["imported 3 sources, 597 rays"]
    import_rays(files, options(output=output, environment="shop"), heard)
    assert heard.messages[1] == "nothing to import; 3 unchanged"
    north = write_source(tmp_path / "north.csv", 5, 100)
    card = import_rays([north], options(output=output, environment="north"), heard)
    assert card.summary.rays == 99 and len(RayDataset.open(output)) == 696
    assert [(title, c.summary.rays) for title, c in make_quality_report(output)] == [
        (f"{output}: north", 99),
        (f"{output}: shop", 597),
    ]
    assert [title for title, _ in make_quality_report(output / "place=north")] == [str(output / "place=north")]


def test_an_environment_has_one_name(parquet, files, tmp_path):
    """A composed and a decomposed letter are equal."""
    output = tmp_path / "a.rays"
    for path, name in zip(files, ["Cafe\u0301", "Caf\u00e9"]):
        import_rays([path], options(output=output, environment=name, workers=1))
    assert RayDataset.open(output).places == ("Caf\u00e9",)
    assert len(RayDataset.open(output / "place=Cafe\u0301")) == len(RayDataset.open(output))


def test_failed_sources_are_reported_at_the_end(parquet, files, tmp_path):
    files[1].write_text("t\n")
    with pytest.raises(NergError, match=r"1\.csv.*1.*3"):
        import_rays(files, options(output=tmp_path / "shop.rays"))
    assert len(RayDataset.open(tmp_path / "shop.rays")) == 398


def test_pseudonyms_of_datasets_match_those_of_files(parquet, files, tmp_path):
    (tmp_path / "salt").write_bytes(bytes(range(32)))
    salted = {"pseudonyms": True, "salt": tmp_path / "salt"}
    result = import_rays(files, options(output=tmp_path / "a.rays", **salted))
    assert result.rays.persons == import_rays(files, RaysImportOptions(settings=settings(), **salted)).rays.persons
    random = import_rays(files, options(output=tmp_path / "b.rays", pseudonyms=True))
    assert len(random.rays.persons) == 9 and not set(random.rays.persons) & set(result.rays.persons)
    with pytest.raises(NergError, match="random salt"):
        import_rays(files, options(output=tmp_path / "b.rays", pseudonyms=True))


@pytest.mark.parametrize(
    "arguments, why",
    [
        ({"environment": "x"}, "environment applies to datasets only; use an"),
        ({"day": "2024-01-01", "output": "a.npz"}, "day applies to datasets only; use an output"),
        ({"workers": 0, "output": "a.rays"}, "workers must lie in"),
        ({"align_output": "a.json", "output": "a.rays"}, "align_output does not apply to datasets,"),
    ],
)
def test_wrong_dataset_options_are_refused(parquet, arguments, why):
    with pytest.raises(NergError, match=why):
        RaysImportOptions(**arguments)


@pytest.mark.parametrize(
    "changes",
    [
        {"persons": ("p0_0", "p2_1")},
        {"start": DAY + 1, "end": DAY + 2, "with_hit": True},
        {"fixations": "ivt", "velocity_threshold": 1e5, "start": DAY + 1},
        {"fixations": "idt", "dispersion_threshold": 170.0, "merge_fixations": True, "min_fixation": 0.05},
        {"thin": 0.5, "thin_distance": 9.0, "box": (0, 4, 0, 4, 0, 3)},
    ],
)
def test_filters_of_datasets_match_those_of_files(parquet, tmp_path, changes):
    dataset, rays = write_dataset(tmp_path)
    heard, expected = Recorder(), Recorder()
    result = filter_rays(dataset.folder, FilterOptions(**changes, output=tmp_path / "a.parquet"), heard)
    # Fixations of a participant may depend on the rounding of positions.
    rays = dataset.load()
    in_memory = filter_rays(rays, FilterOptions(**changes), expected)
    assert_same(result.rays, in_memory.rays)
    assert_same(Rays.load(tmp_path / "a.parquet"), in_memory.rays)
    assert heard.messages.pop() == f"wrote {tmp_path / 'a.parquet'}"
    assert result.fixations == in_memory.fixations and sorted(heard.messages) == sorted(
        m.replace(": mean rays,", ":") for m in expected.messages
    )
    counts = lambda r: [(s["step"], s["kept"], s["of"]) for s in r.metadata["steps"]]
    assert counts(result.rays) == counts(in_memory.rays)
    # Into another dataset: the same rays.
    other = filter_rays(dataset.folder, FilterOptions(**changes, output=tmp_path / "b.rays"))
    assert other.rays is None and other.fixations == in_memory.fixations
    assert_same(load_rays(tmp_path / "b.rays"), in_memory.rays)
    assert counts(load_rays(tmp_path / "b.rays")) == counts(in_memory.rays)
    with pytest.raises(NergError, match="was filtered from another"):
        import_rays([tmp_path / "files" / "0.csv"], options(output=tmp_path / "b.rays"))


def test_samples_of_a_dataset_are_uniform(parquet, tmp_path):
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
    # Samples are uniform over blocks: each source has a third of the rays.
    thirds = np.array(
        [counts[np.array(rays.persons)[rays.person] == f"p{k}_{j}"].sum() for k in range(3) for j in range(3)]
    )
    assert counts.sum() == 1200 and counts.max() <= 8 and thirds.min() > 80 and thirds.max() < 190
    with pytest.raises(NergError, check=mentions("sample")):
        filter_rays(dataset.folder, FilterOptions(sample=4, output=tmp_path / "c.rays"))


def test_impossible_filters_of_datasets_are_refused(parquet, tmp_path, monkeypatch):
    dataset, _ = write_dataset(tmp_path)
    with pytest.raises(NergError, match="rays are selected; widen the conditions"):
        filter_rays(dataset.folder, FilterOptions(start=0, end=1, output=tmp_path / "a.rays"))
    assert not (tmp_path / "a.rays").exists()
    monkeypatch.setattr(rays, "MAX_LOADED_RAYS", 500)
    with pytest.raises(NergError, match="more than 500 rays"):
        filter_rays(dataset.folder, FilterOptions(with_hit=True))
    with pytest.raises(NergError, match="not empty"):
        filter_rays(dataset.folder, FilterOptions(with_hit=True, output=dataset.folder))


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A dataset of 3,000 rays of four participants in a corridor."""
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")
    return write_dataset_of(evaluated_crowd(3000), tmp_path_factory.mktemp("crowded") / "corridor.rays")


def write_dataset_of(rays, folder):
    """A dataset of ``rays``, which does not state their tracking."""
    write_dataset_manifest(folder, DatasetManifest(2))
    writer = SourceWriter(folder, "0" * 32, 2)
    writer.add(rays, "corridor")
    writer.finish({"frame": dict(FRAME)}, file="a", where="w", stamp=None, recipe="r", generation=0)
    return folder


@pytest.mark.parametrize("max_samples", [10_000, 2500])
def test_training_and_evaluation_use_the_same_rays(parquet, crowded, tmp_path, max_samples):
    heard, gaze = Recorder(), tmp_path / "gaze.safetensors"
    trained = train_gaze(crowded, gaze, replace(TRAINING, max_samples=max_samples, seed=3), heard)
    metadata = trained.provenance["rays_file"]
    count = min(max_samples, 3000)
    assert metadata["file"] == "corridor.rays" and (metadata["rays"], metadata["most"], metadata["seed"]) == (
        count,
        max_samples,
        3,
    )
    assert trained.provenance["test"]["rays"] == count and f"{count:,} rays of {crowded}" in heard.messages
    result = evaluate_gaze(gaze, crowded, options=OPTIONS)
    # The same scores as for the rays in memory.
    rays = load_rays(crowded, max_samples, 3)
    alone = train_gaze(rays, tmp_path / "alone.safetensors", replace(TRAINING, seed=3))
    assert alone.provenance["test"] == trained.provenance["test"]
    # The order in which two threads sum gradients varies, so two fits agree up to rounding only.
    scored = evaluate_gaze(tmp_path / "alone.safetensors", rays, options=OPTIONS)
    assert [row["KLD"] for row in scored.rows] == pytest.approx([row["KLD"] for row in result.rows], rel=1e-6)


def test_evaluation_refuses_another_dataset(parquet, crowded, tmp_path):
    train_gaze(crowded, tmp_path / "gaze.safetensors", TRAINING)
    dataset, _ = write_dataset(tmp_path, 1)
    with pytest.raises(NergError, match=r"corridor\.rays"):
        evaluate_gaze(tmp_path / "gaze.safetensors", dataset.folder, options=OPTIONS)
