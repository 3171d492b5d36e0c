"""Tests of `nerg_mi.workflows.rays`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.registry import make_options
from nerg_mi.workflows.rays import FilterSteps, filter_rays, import_rays, least_mask, plot_rays, split_rays
from nerg_mi.workflows.rays_commands import FilterOptions, PlotOptions, RaysImportOptions, SplitOptions
from tests.cli.rays.running import write_walk
from tests.rays.dataset.making import crowd
from tests.rays.readers.examples import EXAMPLES

# ---- The steps of a filter, of rays that nobody else holds and of those that somebody does ----


def test_steps_and_what_is_kept_of_them():
    rays = crowd()
    steps = FilterSteps(rays, own=False)
    steps.select({"time": (10, 60)})
    steps.sample(100, seed=3)
    assert [(s.name, s.kept, s.of) for s in steps.taken] == [("filter", 500, 1000), ("sample", 100, 500)]
    assert steps.rays.metadata["steps"][1] == {"step": "sample", "kept": 100, "of": 500, "seed": 3}
    assert len(rays) == 1000 and "steps" not in rays.metadata and len(set(steps.rays.t)) == 100


def test_nothing_is_left():
    steps = FilterSteps(crowd(), own=True)
    with pytest.raises(NergError, match="filter leaves none of 1,000 rays"):
        steps.select({"time": (1e6, None)})
    steps = FilterSteps(crowd().select(np.zeros(1000, bool)), own=True, strict=False)
    for fixations, one_ray in (("ivt", False), ("idt", True)):
        assert steps.follow(FilterOptions(fixations=fixations, one_ray=one_ray, thin=2)) == 0
    assert [s.of for s in steps.taken] == [0] * 4


def test_the_least_numbers_are_any_as_likely():
    counts = np.zeros(20)
    for seed in range(2000):
        mask = least_mask(np.random.default_rng(seed).random(20), 5)
        assert mask.sum() == 5
        counts += mask
    assert ((counts - 500) ** 2 / 500).sum() < 43.8  # chi-square of 19 degrees of freedom at one in a thousand
    assert least_mask(np.zeros(3), 5).all() and not least_mask(np.arange(3.0), 0).any()


# ---- Jobs on tracking, as a notebook calls them: rays or files in, results out, the reporter told ----


class Heard:
    """A reporter that keeps what it is told."""

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


def test_import(tmp_path):
    given, heard = EXAMPLES["table"].make(tmp_path), Heard()
    (tmp_path / "more.csv").write_text(given.read_text())
    settings = make_options("table", EXAMPLES["table"].options)
    options = RaysImportOptions(settings=settings, output=tmp_path / "rays.npz")
    result = import_rays([given, tmp_path / "more.csv"], options, heard)
    assert len(result.rays) == 40 == result.summary.rays and result.rays.persons == ("ann", "bo")
    assert heard.shares == [(0.0, "reading gaze.csv"), (0.5, "reading more.csv")] and heard.messages == []
    kept = Rays.load(tmp_path / "rays.npz")
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(columns(kept), columns(result.rays)))
    assert len(import_rays(given, RaysImportOptions(settings=settings)).rays) == 20


def test_the_way_back_to_the_files(tmp_path):
    """The matrix that training is given takes rays to where they stood in the file."""
    given, align = EXAMPLES["table"].make(tmp_path), tmp_path / "align.json"
    table = EXAMPLES["table"].options
    settings = make_options("table", {**table, "up": "-y", "units": "mm"})
    rays = import_rays(given, RaysImportOptions(settings=settings, align_output=align)).rays
    back = read_similarity(align, "--align", "rays to field")
    plain = import_rays(given, RaysImportOptions(settings=make_options("table", table))).rays
    assert np.isclose(back.scale, 1000.0)
    assert np.allclose(rays.origin @ back.matrix[:3, :3].T + back.matrix[:3, 3], plain.origin)
    with pytest.raises(NergError, match="left-handed"):
        left = make_options("table", {**table, "up": "y", "handedness": "left"})
        import_rays(given, RaysImportOptions(settings=left, align_output=align, output=tmp_path / "none.npz"))
    assert not (tmp_path / "none.npz").exists()


def test_import_under_pseudonyms(tmp_path):
    given = EXAMPLES["table"].make(tmp_path)
    settings = make_options("table", EXAMPLES["table"].options)
    (tmp_path / "salt").write_bytes(bytes(range(32)))
    one, two = (
        import_rays(given, RaysImportOptions(settings=settings, pseudonyms=True, salt=tmp_path / "salt"))
        for _ in range(2)
    )
    assert one.rays.persons == two.rays.persons and not set(one.rays.persons) & {"ann", "bo"}
    with pytest.raises(NergError, match="belongs to --pseudonyms"):
        RaysImportOptions(settings=settings, salt=tmp_path / "salt")


def test_an_output_that_cannot_be_written_is_found_first(tmp_path, walk):
    (tmp_path / "folder.npz").mkdir()
    for output in (tmp_path / "rays.txt", tmp_path / "folder.npz"):
        for job in (
            lambda output=output: import_rays("absent.csv", RaysImportOptions(reader="varjo", output=output)),
            lambda output=output: filter_rays("absent.npz", FilterOptions(start=0, output=output)),
            lambda output=output: split_rays("absent.npz", SplitOptions(people=0.5, test_output=output)),
        ):
            with pytest.raises(NergError, match=output.name):
                job()


def test_filter_leaves_the_rays_that_it_was_given(walk):
    rays, heard = Rays.load(walk), Heard()
    before = [column.copy() for column in columns(rays)]
    options = FilterOptions(persons=["a", "c"], start=10, end=30, fixations="idt", dispersion=30, thin=1)
    found = filter_rays(rays, options, heard)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(before, columns(rays))) and len(rays) == 12_000
    assert [s["step"] for s in found.rays.metadata["steps"]] == ["filter", "fixations", "thin"]
    assert found.fixations > 0 and heard.messages[1] == f"{found.fixations:,} fixations (idt)"
    assert heard.messages[0] == f"filter: {found.rays.metadata['steps'][0]['kept']:,} of 12,000 rays"
    from_file = filter_rays(walk, options)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(columns(from_file.rays), columns(found.rays)))
    assert filter_rays(rays, FilterOptions(start=10)).fixations is None


def test_one_ray_a_fixation(walk):
    found = filter_rays(walk, FilterOptions(fixations="ivt", velocity=300, least=0.1, one_ray=True))
    (step,) = found.rays.metadata["steps"]
    assert len(found.rays) == found.fixations == step["kept"] and step["one_ray"] and step["velocity"] == 300
    assert step["least"] == 0.1 and step["of"] == 12_000


def test_split(walk, tmp_path):
    heard = Heard()
    rays = Rays.load(walk)
    options = SplitOptions(people=0.5, time=0.3, gap=1, seed=2, train_output=tmp_path / "train.npz")
    found = split_rays(rays, options, heard)
    assert len(found.train) + len(found.test) + found.purged == len(rays) and found.purged > 0
    assert not set(found.train.t) & set(found.test.t) and not (tmp_path / "test.npz").exists()
    assert len(Rays.load(tmp_path / "train.npz")) == len(found.train)
    (step,) = found.test.metadata["steps"]
    assert step["side"] == "test" and step["seed"] == 2 and step["by"]["time"] == {"share": 0.3, "gap": 1, "of": "all"}
    assert heard.messages == [
        f"{len(found.train):,} training rays, {len(found.test):,} test rays, {found.purged:,} purged of 12,000"
    ]


def test_plot(walk, tmp_path):
    split = split_rays(walk, SplitOptions(zones=2, min_rays=8, positions=10))
    figure = plot_rays(split.train, PlotOptions(kind="layout", test=split.test, output=tmp_path / "p.png"))
    assert figure.axes and (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    assert plot_rays(walk).axes


@pytest.mark.parametrize(
    "make, message",
    [
        (FilterOptions, "say which rays"),
        (lambda: FilterOptions(fixations="magic"), "ivt or idt"),
        (lambda: FilterOptions(one_ray=True), "add --fixations"),
        (SplitOptions, "say how to split"),
        (lambda: PlotOptions(kind="map"), "density or layout"),
        (lambda: PlotOptions(test="a.npz"), "add --kind layout"),
    ],
)
def test_options_that_contradict_each_other(make, message):
    with pytest.raises(NergError, match=message):
        make()
