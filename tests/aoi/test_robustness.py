"""Robustness of conclusions: true differences survive other choices, others do not, and parts equal the loop."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.aoi import robustness, statistics
from nerg_mi.aoi.areas import Areas
from nerg_mi.aoi.placed import open_placed_areas
from nerg_mi.aoi.predicted import viewpoints_at
from nerg_mi.aoi.robustness import Predictions, list_networks
from nerg_mi.aoi.robustness_output import explain_variance
from nerg_mi.aoi.settings import AoiSampling, Choices, TrackerError
from nerg_mi.fields.gaze_base import make_prior_table, table_directions
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tracking.rays import Rays, merge_rays
from tests.aoi.place import people, write_place
from tests.conftest import ROOT
from tests.plugins.fields import GRID
from tests.recorder import Recorder
from tests.tasks.clusters import ClusterOfProcesses, wait_until

CENTERS = np.array([[-8.0, 0.0], [0.0, 0.0], [8.0, 0.0], [0.0, 12.0]])  # degrees; the last one is no area
DISTANCE = 10.0
AREAS = {
    name: [
        [DISTANCE - 0.1, *(DISTANCE * np.tan(np.radians(center - 3)))],
        [DISTANCE, *(DISTANCE * np.tan(np.radians(center + 3)))],
    ]
    for name, center in zip("abc", CENTERS)
}
FIXATION, RATE = 6, 20  # samples of a fixation, and samples per second


def record(shares: np.ndarray, seed: int, count: int = 16, fixations: int = 40) -> Rays:
    """Participants who look at the centres with ``shares`` of their fixations, around which their own shares vary."""
    rng = np.random.default_rng(seed)
    angles = []
    for _ in range(count):
        target = rng.choice(len(CENTERS), fixations, p=rng.dirichlet(20 * shares))
        middle = CENTERS[target] + rng.uniform(-2.5, 2.5, (fixations, 2))
        angles.append(np.repeat(middle, FIXATION, axis=0) + rng.normal(0, 0.05, (fixations * FIXATION, 2)))
    y, z = np.tan(np.radians(np.concatenate(angles))).T
    each = fixations * FIXATION
    return nerg.Rays.from_arrays(
        np.zeros((count * each, 3)),
        np.column_stack([np.ones_like(y), y, z]),
        times=np.tile(np.arange(each) / RATE, count),
        participants=np.repeat([f"p{k:02d}" for k in range(count)], each),
        tracking="eye",
    )


def write_gaze(path: Path, seed: int, geometry: str = "surface", sha256: str | None = None) -> Path:
    """A gaze field of noise, mixed with a prior that looks along the x axis."""
    rows = 8
    density = np.exp(20 * (table_directions(rows)[:, 0] - 1))
    config = LogGazeConfig(
        GRID, width=16, layers=1, sh_degree=2, mix=0.3, prior=rows, prior_factor=False, geometry=geometry
    )
    prior = make_prior_table(density, rows, ns, fibonacci_directions(4096))
    field = LogGazeField.random(config, Box((0, 0, 0), (6, 4, 3)), ns, seed, prior)
    table = 2 * np.random.default_rng(seed).normal(size=len(field.grid.table)).astype(np.float32)
    field.set_parameters({"grid.table": ns.Float(table)})
    recorded = {"geometry_file": {"file": "room", "sha256": sha256}} if sha256 else {}
    save_gaze(field, path, {"geometry": "none"} if geometry == "none" else recorded)
    return path


FIXED = Choices(margin=(0.03, 0.03), growth=(0, 0), weighting=("participants",), glance_duration=(0.3, 0.3))
COARSE = {"viewpoints": 6, "sampling": AoiSampling(directions=512, aoi_samples=4)}


def estimates_of(result, conclusion, measure="share"):
    rows = [e for e in result.estimates if (e["conclusion"], e["measure"]) == (conclusion, measure)]
    return np.array([row["estimate"] for row in rows])


def verdicts(result, measure="share"):
    return {row["conclusion"]: row["verdict"] for row in result.conclusions if row["measure"] == measure}


def test01_a_true_difference_survives():
    result = nerg.robustness(record(np.array([0.5, 0.2, 0.1, 0.2]), 1), AREAS, analyses=20)
    rows = {row["conclusion"]: row for row in result.conclusions if row["measure"] == "share"}
    assert rows["a > b"]["verdict"] == rows["a > c"]["verdict"] == rows["a is number 1"]["verdict"] == "survives"
    assert rows["a > b"]["excludes_zero"] > 0.99
    assert rows["a > b"]["reference"] == pytest.approx(0.3, abs=0.08)
    assert {choice["samples"] for choice in result.analyses} == {"all", "fixations"}


def test02_equal_areas_hardly_ever_differ():
    counts = []
    for seed in range(8):
        result = nerg.robustness(record(np.array([0.25, 0.25, 0.25, 0.25]), seed), AREAS, analyses=10)
        counts += [verdict for name, verdict in verdicts(result).items() if ">" in name]
    assert len(counts) > 20
    assert counts.count("survives") <= 4 and counts.count("undecided") >= 12


def test12_the_reference_predicts_as_statistics_do(tmp_path, rgb):
    write_place(tmp_path, gaze=False)
    gaze = [write_gaze(tmp_path / f"{seed}.safetensors", seed) for seed in range(2)]
    inputs, areas = [tmp_path / "scene.xml", people(each=40)], tmp_path / "areas.json"
    result = nerg.robustness([*inputs, *gaze], areas, analyses=10, choices=replace(FIXED, margin=(0.01, 0.1)), **COARSE)
    stats = nerg.statistics([*inputs, gaze[0]], areas, resamples=199, **COARSE).aois
    values = {(r["value"], r["aoi"]): r for r in stats if r["source"] == "predicted"}
    compared = 0
    for row in result.conclusions:
        assert row["source"] == "predicted" and row["measure"] in ("share", "hit_ratio")
        names = row["conclusion"].split(" > ")
        if ": " not in names[0] and len(names) == 2:
            one, other = (values["", name][row["measure"]] for name in names)
            assert row["reference"] == pytest.approx(one - other, rel=1e-6)
            compared += 1
    assert compared == 2 and any("cohort" in row["conclusion"] for row in result.conclusions)
    assert {row["field"] for row in result.analyses} == {1, 2}
    weights = {round(row["prior_weight"], 3) for row in result.analyses}
    assert len(weights) > 1 and min(weights) >= 0.176 and max(weights) <= 0.462  # half and twice the odds 3 : 7


def test13_fields_and_priors_decide(tmp_path, rgb):
    write_place(tmp_path, gaze=False)
    gaze = [write_gaze(tmp_path / f"{seed}.safetensors", seed) for seed in range(2)]
    inputs, areas = [tmp_path / "scene.xml", people(each=40)], tmp_path / "areas.json"

    def test(gaze_inputs, weights):
        choices = replace(FIXED, prior_weight=weights)
        result = nerg.robustness([*inputs, *gaze_inputs], areas, analyses=20, choices=choices, **COARSE)
        (name,) = (n for n in verdicts(result) if "cohort" not in n and " > " in n)
        row = next(r for r in result.conclusions if (r["conclusion"], r["measure"]) == (name, "share"))
        return result, row, estimates_of(result, name)

    result, row, estimates = test(gaze, (0.3, 0.3))
    of_field = [estimates[[a["field"] == k for a in result.analyses]] for k in (1, 2)]
    assert all(np.ptp(values) < 1e-9 for values in of_field) and abs(of_field[0][0] - of_field[1][0]) > 1e-4
    assert row["decides"] == "field" and row["explained"] > 0.99
    assert of_field[0][0] == pytest.approx(row["reference"], rel=1e-6)
    result, row, estimates = test(gaze[:1], (0.0, 1.0))
    weights = np.array([a["prior_weight"] for a in result.analyses])
    assert row["decides"] == "prior_weight" and len(set(weights)) == 5
    # A mixture is linear in its weight.
    line = np.polynomial.Polynomial.fit(weights, estimates, 1)
    assert np.allclose(line(weights), estimates, atol=0.02 * np.ptp(estimates))


def test16_predictions_are_corrected_for_the_tracker(tmp_path, rgb):
    write_place(tmp_path, gaze=False)
    gaze = write_gaze(tmp_path / "gaze.safetensors", 1)
    inputs, areas = [tmp_path / "scene.xml", people(each=40, cohorts=False), gaze], tmp_path / "areas.json"
    settings = {"error": TrackerError(accuracy=3.0), **COARSE}
    choices = replace(FIXED, prior_weight=(0.3, 0.3))
    result = nerg.robustness(inputs, areas, analyses=10, choices=choices, **settings)
    rows = nerg.statistics(inputs, areas, resamples=199, **settings).tracker
    values = {row["aoi"]: row for row in rows if (row["source"], row["measure"]) == ("predicted", "share")}
    (row,) = (r for r in result.conclusions if " > " in r["conclusion"] and r["measure"] == "share")
    one, other = (values[name] for name in row["conclusion"].split(" > "))
    assert row["reference"] == pytest.approx(one["corrected"] - other["corrected"], rel=1e-6)
    assert all(file.is_file() for file in result.save(tmp_path / "out"))
    ignored = [a["tracker"] == "ignored" for a in result.analyses]
    estimates = estimates_of(result, row["conclusion"])
    assert 0 < sum(ignored) < 10
    assert np.allclose(estimates[ignored], one["recorded"] - other["recorded"], rtol=1e-6)
    assert np.allclose(estimates[~np.array(ignored)], row["reference"], rtol=1e-6)


def test14_a_field_moves_with_its_tracking(tmp_path, rgb):
    """Where surfaces are unknown, a shift of the tracking is the opposite shift of all areas."""
    gaze = nerg.GazeField.load(write_gaze(tmp_path / "gaze.safetensors", 3, geometry="none"))
    eyes = np.array([[1.0, 2, 1.6], [2.0, 1, 1.5]])
    shift = np.array([0.2, -0.1, 0.05])

    def predict(offset, choice):
        corners = (np.array([[4.0, 1.5, 1.0], [4.2, 2.5, 2.0]]) - offset).tolist()
        placed = open_placed_areas(None, gaze, Areas.open({"sign": corners}))
        base = Predictions(placed, list_networks([gaze]), viewpoints_at(eyes), True)
        return base.compute(base.get_reference() | choice).share

    moved, at_rest = predict(np.zeros(3), dict(zip(("shift_x", "shift_y", "shift_z"), shift))), predict(shift, {})
    assert np.allclose(moved, at_rest, rtol=0.02)
    assert not np.allclose(predict(np.zeros(3), {}), moved, rtol=0.05)


class Stopper(Recorder):
    """Stops after four analyses."""

    def progress(self, fraction: float, text: str = "") -> None:
        super().progress(fraction, text)
        if text.startswith("4 of 11"):
            raise KeyboardInterrupt


@pytest.mark.parametrize("is_predicted", [False, True])
def test15_analyses_resume(tmp_path, rgb, monkeypatch, is_predicted):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    write_place(tmp_path, gaze=False)
    inputs = [tmp_path / "scene.xml", people(each=20)]
    # The second field is in memory.
    gaze = [write_gaze(tmp_path / f"{seed}.safetensors", seed) for seed in range(2)] if is_predicted else []
    gaze[1:] = [replace(nerg.GazeField.load(file), path=None) for file in gaze[1:]]
    settings = {**COARSE, "analyses": 10, "choices": replace(FIXED, prior_weight=(0.3, 0.3))}
    parallel = Parallel(store=tmp_path / "store", scheduler="local:1")

    def test(**more):
        return nerg.robustness([*inputs, *gaze], tmp_path / "areas.json", **settings, **more)

    with pytest.raises(KeyboardInterrupt):
        test(parallel=parallel, progress=Stopper())
    recorder = Recorder()
    result = test(parallel=parallel, progress=recorder)
    done = [int(text.split()[0]) for _, text in recorder.steps if " of 11 " in text]
    assert done[0] >= 4 and done[-1] == 11
    assert result.estimates == test().estimates


def test21_ctrl_c_in_the_last_step_is_noticed(monkeypatch):
    """Counting the only block of rays, and evaluating the last analysis."""
    rays, calls = record(np.array([0.4, 0.3, 0.1, 0.2]), 2, count=4), []

    def press(function, call):
        def run(*arguments):
            result = function(*arguments)
            calls.append(result)
            if len(calls) == call:
                signal.raise_signal(signal.SIGINT)
            return result

        return run

    evaluate = robustness.Evaluation.evaluate
    for owner, name, function, call, analyse, options in (
        (statistics, "count_block", statistics.count_block, 1, nerg.statistics, {}),
        (robustness.Evaluation, "evaluate", evaluate, 11, nerg.robustness, {"analyses": 10}),
    ):
        calls.clear()
        monkeypatch.setattr(owner, name, press(function, call))
        with pytest.raises(KeyboardInterrupt):
            analyse(rays, AREAS, **options)
        assert len(calls) == call


def test20_a_cluster_gives_the_same_tables(tmp_path, rgb, equal_processes):
    """Recordings with validations and cohorts in files, and predictions of fields in files and in memory."""
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    write_place(tmp_path, gaze=False)
    rays = people(each=20).with_tracking("eye")
    gaze = [write_gaze(tmp_path / f"{seed}.safetensors", seed) for seed in range(2)]
    inputs = [tmp_path / "scene.xml", rays]
    fields = [gaze[0], replace(nerg.GazeField.load(gaze[1]), path=None)]
    for name, columns in (("validation", "accuracy,precision"), ("cohorts", "cohort")):
        values = "1.5,0.2" if name == "validation" else "all"
        rows = [f"{p},{values}{k % 2 if name == 'cohorts' else ''}" for k, p in enumerate(sorted(rays.persons))]
        (tmp_path / f"{name}.csv").write_text("\n".join([f"person,{columns}", *rows]))
    options = {name: tmp_path / f"{name}.csv" for name in ("validation", "cohorts")} | {"align": np.eye(4)}
    options |= {**COARSE, "analyses": 10, "error": TrackerError(draws=2)}
    cases = [(inputs, {}), ([*inputs, *fields], {"choices": replace(FIXED, prior_weight=(0.3, 0.3))})]

    def test(number, **more):
        return nerg.robustness(cases[number][0], tmp_path / "areas.json", **options, **cases[number][1], **more)

    with ClusterOfProcesses(tmp_path) as cluster:
        cluster.start_worker(), cluster.start_worker()
        wait_until(lambda: all("connected to" in cluster.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        parallels = [Parallel(store=tmp_path / f"store{k}", scheduler=cluster.address) for k in range(2)]
        results = [test(k, parallel=parallel) for k, parallel in enumerate(parallels)]
    for k, result in enumerate(results):
        expected = test(k)
        assert result.estimates == expected.estimates and result.conclusions == expected.conclusions
        assert result.analyses == expected.analyses and any("cohort" in r["conclusion"] for r in result.conclusions)
        assert {a["tracker"] for a in result.analyses} == {"corrected", "ignored"}


def test09_the_reference_has_the_differences_of_statistics():
    rays, windows = (
        record(np.array([0.3, 0.1, 0.02, 0.58]), 3, count=12, fixations=12),
        {"early": (0, 1.5), "late": (1.5, 4)},
    )
    result = nerg.robustness(rays, AREAS, analyses=10, windows=windows, resamples=1999)
    ours = {(row["conclusion"], row["measure"]): row for row in result.conclusions}
    compared = 0
    for row in nerg.statistics(rays, AREAS, windows=windows).differences:
        sign, names = (1, ("late", "early")) if row["difference"] > 0 else (-1, ("early", "late"))
        key = f"{row['aoi']}: window {names[0]} > {names[1]}", row["measure"]
        if key in ours and row["low"] is not None:
            limits = sorted((sign * row["low"], sign * row["high"]))
            expected = pytest.approx([sign * row["difference"], *limits], rel=1e-6)
            assert [ours[key][name] for name in ("reference", "low", "high")] == expected, key
            compared += 1
    assert compared >= 5


def test17_cohorts_and_groups_of_areas_are_compared_as_in_statistics(tmp_path):
    first, second = (
        record(np.array(shares), seed, count=8)
        for seed, shares in enumerate(([0.5, 0.1, 0.2, 0.2], [0.1, 0.3, 0.3, 0.3]))
    )
    second = replace(second, persons=tuple(f"q{name}" for name in second.persons))
    rays, cohorts = merge_rays([first, second]), tmp_path / "cohorts.csv"
    rows = [f"{name},{'other' if name[0] == 'q' else 'one'}" for name in rays.persons]
    cohorts.write_text("\n".join(["person,cohort", *rows]))
    areas = {**AREAS, "a or b": {"parts": ["a", "b"]}, "b or c": {"parts": ["b", "c"]}, "twice": {"parts": ["a or b"]}}
    result = nerg.robustness(rays, areas, cohorts=cohorts, analyses=10, resamples=1999)
    stats = nerg.statistics(rays, areas, cohorts=cohorts)
    shares = {row["aoi"]: row["share"] for row in stats.aois if row["cell"] == "all"}
    ours = {row["conclusion"]: row for row in result.conclusions if row["measure"] == "share"}
    # Groups are compared with each other and with other areas, if no sample can be on both by definition.
    pairs = {frozenset(name.split(" > ")) for name in ours if " > " in name and ": " not in name}
    assert pairs == {frozenset(pair) for pair in ("ab", "ac", "bc")}
    differences = [row for row in stats.differences if row["measure"] == "share"]
    assert {row["aoi"] for row in differences} == set(areas) and len(differences) == 6
    for row in differences:
        names = ("one", "other") if row["difference"] < 0 else ("other", "one")
        row_of_cohorts = ours[f"{row['aoi']}: cohort {names[0]} > {names[1]}"]
        assert row_of_cohorts["reference"] == pytest.approx(abs(row["difference"]), rel=1e-6)
    assert ours["a: cohort one > other"]["verdict"] == "survives"
    areas = {**AREAS, "a or b": {"parts": ["a", "b"]}}
    result = nerg.robustness(rays, areas, cohorts=cohorts, analyses=10)
    (row,) = (r for r in result.conclusions if "a or b" in r["conclusion"].split(" > ") and r["measure"] == "share")
    assert row["conclusion"] == "a or b > c" and row["verdict"] == "survives"
    assert row["reference"] == pytest.approx(shares["a or b"] - shares["c"], rel=1e-6)
    assert not any(r["conclusion"].startswith("a or b is number") for r in result.conclusions)
    assert any("cohort" in axes.get_title("left") for axes in result.draw().ravel())


def test18_cohorts_that_are_not_compared_are_reported(tmp_path):
    rays, recorder = record(np.array([0.3, 0.3, 0.2, 0.2]), 1, count=7), Recorder()
    (tmp_path / "cohorts.csv").write_text("\n".join(["person,cohort", *(f"{p},cohort {p}" for p in rays.persons)]))
    nerg.robustness(rays, AREAS, cohorts=tmp_path / "cohorts.csv", analyses=10, progress=recorder)
    assert any("first 5 of 7" in text and '"cohort p05"' in text for text in recorder.warnings)


def test19_slow_samples_are_named_as_the_reason_for_no_fixations():
    rays, recorder = record(np.array([0.4, 0.3, 0.1, 0.2]), 2, count=4), Recorder()
    slow = replace(rays, t=4 * rays.t)  # five samples per second
    result = nerg.robustness(slow, AREAS, analyses=10, progress=recorder)
    assert {choice["samples"] for choice in result.analyses} == {"all"}
    (text,) = (text for text in recorder.messages if "fixation" in text)
    assert "0.2 s apart" in text and "max_step" in text and "degrees per second" not in text
    with pytest.raises(nerg.NergError, match="0.2 s apart") as error:
        nerg.robustness(slow, AREAS, analyses=10, choices=Choices(samples=("fixations",)))
    assert "max_step" in error.value.parameters


def test11_an_environment_in_memory_has_its_alignment(tmp_path, rgb):
    write_place(tmp_path, gaze=False)
    align = Similarity(np.eye(4) + np.eye(4, k=3) * 0.3)
    environment, rays = nerg.Environment.open(tmp_path / "scene.xml"), people(each=40)
    areas, settings = tmp_path / "areas.json", {"analyses": 10, "choices": Choices(samples=("all",))}
    expected = nerg.robustness([tmp_path / "scene.xml", rays], areas, align=align, **settings)
    result = nerg.robustness([replace(environment, align=align), rays], areas, **settings)
    unaligned = nerg.robustness([environment, rays], areas, **settings)
    assert result.estimates == expected.estimates != unaligned.estimates
    assert result.provenance.settings["align"] == expected.provenance.settings["align"] == align.matrix.tolist()


def test03_equal_seeds_give_equal_tables():
    rays = record(np.array([0.4, 0.3, 0.1, 0.2]), 2, count=6)
    first, second = (nerg.robustness(rays, AREAS, analyses=10, seed=3) for _ in range(2))
    assert first.conclusions == second.conclusions and first.estimates == second.estimates
    assert nerg.robustness(rays, AREAS, analyses=10, seed=4).analyses != first.analyses
    # More analyses contain the first ones.
    assert nerg.robustness(rays, AREAS, analyses=12, seed=3).analyses[:10] == first.analyses


def test04_parts_equal_the_loop(tmp_path, rgb, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    write_place(tmp_path, gaze=False)
    align = nerg.Alignment(np.eye(4), {"kind": "pairs"}, {}, {"cm": 2.0, "degrees": 0.5, "scale_percent": 0.1})
    align.save(tmp_path / "align.json")
    align_file, error = tmp_path / "align.json", TrackerError(accuracy=1.0, draws=2)

    def test(parallel: Parallel):
        inputs = [tmp_path / "scene.xml", people(each=40).with_tracking("eye")]
        areas = tmp_path / "areas.json"
        return nerg.robustness(inputs, areas, align=align_file, error=error, analyses=10, parallel=parallel)

    result, parts = test(Parallel()), test(Parallel(store=tmp_path / "store", scheduler="local:1"))
    assert parts.estimates == result.estimates and parts.conclusions == result.conclusions
    names = {row["conclusion"] for row in result.conclusions}
    assert any(name.startswith("both: cohort") for name in names) and not any("both >" in name for name in names)
    assert {choice["tracker"] for choice in result.analyses} == {"corrected", "ignored"}
    shifts = np.array([[choice[f"shift_{axis}"] for axis in "xyz"] for choice in result.analyses])
    assert 0 < np.abs(shifts).max() <= 0.04
    assert 0 < max(abs(choice["rotation"]) for choice in result.analyses) <= 1.0


def test05_the_choice_that_decides_is_named():
    """An area whose lower edge crosses the gaze gains gaze as it grows; nothing else changes shares here."""
    rays = record(np.array([0.5, 0.2, 0.1, 0.2]), 1)
    halved = {**AREAS, "a": [[DISTANCE - 0.1, -2, 0.0], [DISTANCE, -0.8, 1.0]]}
    choices = Choices(tolerance=(0.0, 0.0), growth=(-0.3, 0.3), weighting=("participants",), samples=("all",))
    result = nerg.robustness(rays, halved, analyses=40, choices=choices)
    row = next(row for row in result.conclusions if (row["conclusion"], row["measure"]) == ("a > c", "share"))
    growth = [choice["growth"] for choice in result.analyses]
    estimates = [e["estimate"] for e in result.estimates if (e["conclusion"], e["measure"]) == ("a > c", "share")]
    assert np.all(np.diff(np.array(estimates)[np.argsort(growth)]) >= -1e-9)
    assert row["decides"] == "growth" and row["explained"] > 0.8
    assert row["smallest"] < row["reference"] < row["largest"]


def test06_explained_variance():
    rng = np.random.default_rng(0)
    number, text = rng.random(200).tolist(), rng.choice(["x", "y"], 200).tolist()
    values = np.array([1.0 if t == "x" else 0.0 for t in text])
    assert explain_variance(text, values) == pytest.approx(1.0)
    assert explain_variance(number, values) < 1e-12
    assert explain_variance(number, np.array(number)) == pytest.approx(15 / 16, abs=0.02)
    assert explain_variance(number, np.ones(200)) < 1e-12
    some = [v if t == "x" else None for v, t in zip(number, text)]
    explained = explain_variance(some, np.array([v if t == "x" else 0.5 for v, t in zip(number, text)]))
    assert 0.8 < explained <= 1.0
    assert explain_variance([None] * 200, values) < 1e-12


@pytest.mark.parametrize(
    "choices",
    [
        {"min_visit": (0.2, 0.1)},
        {"min_visit": (0.1,)},
        {"tolerance": (0.0, 50.0)},
        {"samples": ("some",)},
        {"weighting": ()},
        {"shift": -1.0},
    ],
)
def test07_invalid_ranges(choices):
    with pytest.raises(nerg.NergError, match=next(iter(choices))):
        Choices(**choices)


def test08_invalid_inputs(tmp_path, rgb):
    rays = record(np.array([0.4, 0.3, 0.1, 0.2]), 2, count=3, fixations=5)
    write_place(tmp_path)
    with pytest.raises(nerg.NergError, match="rays"):
        nerg.robustness(tmp_path / "scene.xml", AREAS)
    with pytest.raises(nerg.NergError, match="AOIs"):
        nerg.robustness(rays)
    with pytest.raises(nerg.NergError, match="fixation"):
        nerg.robustness(rays.with_tracking("head"), AREAS, choices=Choices(samples=("fixations",)))
    weighted = Choices(prior_weight=(0.1, 0.2))
    with pytest.raises(nerg.NergError, match="prior"):
        nerg.robustness([rays, tmp_path / "gaze.safetensors", tmp_path / "scene.xml"], AREAS, choices=weighted)
    gaze = write_gaze(tmp_path / "0.safetensors", 0), write_gaze(tmp_path / "1.safetensors", 1, sha256="0" * 64)
    with pytest.raises(nerg.NergError, match="environment"):
        nerg.robustness([rays, tmp_path / "scene.xml", *gaze], AREAS)


def test10_files_and_verdict(tmp_path):
    windows = {"early": (0.0, 3.0), "late": (3.0, 100.0)}
    result = nerg.robustness(record(np.array([0.4, 0.3, 0.1, 0.2]), 5), AREAS, analyses=10, windows=windows)
    files = result.save(tmp_path / "out")
    assert all(file.is_file() for file in files) and sorted(tmp_path.joinpath("out").iterdir()) == sorted(files)
    assert json.loads((tmp_path / "out" / "about.json").read_text())
    assert len(result.to_dataframe()) == len(result.conclusions)
    assert len(result.estimates) == 10 * len(result.conclusions)
    assert any("window early > late" in n or "window late > early" in n for n in verdicts(result))
    depends = [row for row in result.conclusions if row["verdict"] == "depends"]
    assert len(result.verdict.splitlines()) == 1 + len(depends)
