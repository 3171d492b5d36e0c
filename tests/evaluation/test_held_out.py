"""Evaluations of gaze fields, folds and priors, and their geometries."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.environment.environment import Environment, make_hit_geometry, no_geometry
from nerg_mi.environment.gaze import GazeField
from nerg_mi.errors import NergError
from nerg_mi.evaluation import folds as folding
from nerg_mi.evaluation import held_out, next_look_scores
from nerg_mi.evaluation.baselines import PRIOR
from nerg_mi.evaluation.folds import SCORED, folds
from nerg_mi.evaluation.gaze import SCORES
from nerg_mi.evaluation.gaze_report import read_results
from nerg_mi.evaluation.held_out import evaluate_gaze
from nerg_mi.evaluation.next_look import HEAD_METHODS, NextLook
from nerg_mi.evaluation.next_look_scores import make_ray_distance, next_look
from nerg_mi.fields import gaze_base
from nerg_mi.files.tables import write_json
from nerg_mi.formats.alignments import read_similarity
from nerg_mi.formats.fields import load_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.tasks.jobs import report_jobs
from nerg_mi.tasks.settings import Parallel
from nerg_mi.threads import set_thread_count
from nerg_mi.tracking.rays import TRACKING, Rays
from nerg_mi.train import gaze as training
from nerg_mi.train.gaze import train_gaze
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.prior import compute_elevation_density, train_prior
from tests.evaluation.test_gaze import crowd
from tests.notes import find_wrong_notes
from tests.plugins import fields
from tests.recorder import Recorder
from tests.refusals import mentions
from tests.tasks.clusters import ClusterOfProcesses, wait_until
from tests.train.gaze.looks import BOX, around, looking_at

# ---- The evaluation of a gaze field as a job: rows, files and refused input ----


OPTIONS = {"min_rays": 8, "directions": 128, "resamples": 2, "pictures": 1}
TRAINING = {"radius": 0.5, "probes": 8, "steps": 2, "directions": 64, "validation_zones": 0, "min_rays": 8}
TRAINING |= {"prior_folds": 1}  # more of them take long
HELD_OUT = {**TRAINING, "test_zones": 1, "test_positions": 3}


def test_scores_are_listed_with_the_baselines(trained, tmp_path):
    result = evaluate_gaze(trained / "gaze.safetensors", trained / "rays.npz", **OPTIONS, output=tmp_path / "eval")
    names = [row["method"] for row in result.rows]
    assert names[0] == "gaze field" and "uniform" in names and "nearest rays" in names and result.split == "pos"
    assert all(set(SCORES) <= set(row) for row in result.rows) and 1 <= result.positions <= 3 and result.people >= 2
    assert {row["method"] for row in result.persons} == {"gaze field", "nearest rays", "re-aimed hits"}
    files = {"gaze.md", "gaze.csv", "persons.csv", "gaze.json", "positions.png", "positions.csv"}
    assert {p.name for p in result.files} == files
    # All participants are in one zone; a field without support would warn at each position.
    assert len(result.by_position) == result.positions and {row["group"] for row in result.by_position} == {"0"}
    assert all(row["support"] >= 0 and row["KLD"] > 0 for row in result.by_position)
    assert {row["method"] for row in result.calibration} >= {"gaze field", "nearest rays"}
    for name in result.TABLES:
        assert not find_wrong_notes(getattr(result, name)), name
    for name in ("gaze.csv", "persons.csv", "positions.csv"):
        with open(tmp_path / "eval" / name, encoding="utf-8", newline="") as file:
            assert not find_wrong_notes(csv.DictReader(file)), name
    assert read_results(tmp_path / "eval" / "gaze.json").rows[0]["note"] == result.rows[0]["note"]
    # Nobody was held out, so all rays are at held-out positions.
    assert {row["kind"] for row in result.verdicts} == {"new positions"}
    assert {row["method"] for row in result.verdicts} >= {"gaze field", "stack", "re-aimed hits"}
    assert [row["bits"] for row in result.verdicts if row["method"] == PRIOR] == [0]
    first, *lead = result.verdict.splitlines()
    assert "verdict" in first and len(lead) == 1 and "new positions" in lead[0]
    # Calibrated on the data that the folds of the training held out.
    assert result.calibration[1]["method"] == "gaze field, calibrated"
    # At the test positions, and at the origins of all held-out rays.
    assert result.calibration[-1]["method"] == "gaze field, new positions, calibrated"
    data = json.loads((tmp_path / "eval" / "gaze.json").read_text())
    assert data["methods"][0]["KLD"] == result.rows[0]["KLD"] and data["tracking"] == result.tracking
    text = (tmp_path / "eval" / "gaze.md").read_text()
    assert "directions of equal area" in text and TRACKING[result.tracking] in text


def test_without_an_output_folder_nothing_is_written(trained, tmp_path, monkeypatch):
    before, options, tune = set(trained.iterdir()), [], held_out.make_tuned_baselines
    monkeypatch.setattr(held_out, "make_tuned_baselines", lambda *args, **k: options.append(k) or tune(*args, **k))
    rays = Rays.load(trained / "rays.npz").with_tracking("head")
    result = evaluate_gaze(trained / "gaze.safetensors", rays, **OPTIONS)
    assert result.tracking == "head"
    assert result.files == [] and set(trained.iterdir()) == before and result.rows[0]["method"] == "gaze field"
    written = evaluate_gaze(trained / "gaze.safetensors", rays, **OPTIONS, output=tmp_path / "eval").files
    saved = result.save(tmp_path / "saved")
    assert [p.name for p in saved] == [p.name for p in written] and saved[-1].name == "positions.png"
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(saved[:-1], written))
    # The folds of the baselines hold out what the test does, or, if that is better for a baseline, people alone.
    kinds = [(k["participants"], k["positions"]) for k in options]
    assert result.split == "pos" and kinds == [(False, True), (True, False)] * 2


def test_unusable_inputs_are_refused(trained, tmp_path):
    gaze = trained / "gaze.safetensors"
    crowd(2000).save(tmp_path / "rays.npz")
    with pytest.raises(NergError, match=r"give the unchanged file rays.npz"):
        evaluate_gaze(gaze, tmp_path / "rays.npz", **OPTIONS)
    with pytest.raises(NergError, check=mentions("test_participants")):
        evaluate_gaze(gaze, trained / "rays.npz", **OPTIONS, split="both")
    train_gaze(crowd(1000), "none", **TRAINING, output=tmp_path / "gaze.safetensors")
    with pytest.raises(NergError, match="trained on all positions"):
        evaluate_gaze(tmp_path / "gaze.safetensors", crowd(1000), **OPTIONS)


# ---- The next look: fit, files and refused input ----


def test_the_next_look_is_fitted_and_scored(tmp_path, rgb, monkeypatch):
    rays = crowd(3000)
    # Each participant has a sample per second.
    rays = replace(rays, t=np.sum(np.tril(rays.person[:, None] == rays.person), axis=1))
    gaze = tmp_path / "gaze.safetensors"
    train_gaze(rays, "hits", **HELD_OUT, test_participants=0.5, voxel_size=0.3, output=gaze)
    options = {"elapsed": (1.0, 3.0), "earlier": 3, "max_looks": 64, "resamples": 10}
    used, make_prior, sample = [], next_look_scores.make_prior_baseline, next_look_scores._sample_looks
    with monkeypatch.context() as patch:
        patch.setattr(next_look_scores, "make_prior_baseline", lambda r, **k: used.append(r) or make_prior(r, **k))
        patch.setattr(
            next_look_scores, "_sample_looks", lambda r, rows, *a: used.append(r.select(rows)) or sample(r, rows, *a)
        )
        result = next_look(gaze, rays, **options, output=tmp_path / "next")
    provenance = load_gaze(gaze, ns)[1]["provenance"]
    test, held_out = provenance["test"], {rays.persons.index(name) for name in provenance["test"]["people"]}
    distances = [np.linalg.norm(r.origin[:, None] - np.array(test["centres"]), axis=2).min(axis=1) for r in used]
    # The prior is that of the training, weights are fitted near held-out positions, others are scored at them.
    assert [held_out & set(r.person) for r in used] == [set(), set(), held_out]
    assert distances[0].min() > test["purged_within"] >= distances[1].max() and distances[2].max() <= test["radius"]
    assert {row["elapsed"] for row in result.rows} == {1.0, 3.0} and (result.fitted, result.scored) == (2, 2)
    assert [path.name for path in result.files] == ["next.md", "next.csv", "next.json"]
    assert not find_wrong_notes(result.rows) and result.rows[0]["note"]
    # Positions count as extrapolated if they are farther from recorded ones than this number of radii.
    monkeypatch.setattr(gaze_base, "CUTOFF_RADII", 1e-9)
    recorder = Recorder()
    next_look(gaze, rays, **options, progress=recorder)
    assert sum("extrapolated" in text for text in recorder.warnings) == 1
    monkeypatch.undo()
    written = json.loads((tmp_path / "next" / "next.json").read_text())
    assert NextLook.from_json(written["model"]).weights == pytest.approx(result.model.weights)
    assert written["rows"][0]["bits"] == result.rows[0]["bits"] and result.rows[0]["looks"] <= 64
    # Looks without hit points end at the surfaces of the geometry.
    place = GazeField.load(gaze).open_environment()
    distance = make_ray_distance(place)
    assert distance is not None and rays.hit is not None
    recorded = np.linalg.norm(rays.hit - rays.origin, axis=1)
    assert np.median(np.abs(distance(rays.origin, rays.direction) - recorded)) < 0.3
    scaled = make_ray_distance(replace(place, align=Similarity(np.diag([2.0, 2, 2, 1]))))
    assert scaled is not None
    np.testing.assert_allclose(
        scaled(rays.origin / 2, rays.direction), distance(rays.origin, rays.direction) / 2, rtol=1e-4
    )
    with pytest.raises(NergError, check=mentions("elapsed")):
        next_look(gaze, rays, **options | {"elapsed": (3.0, 1.0)})
    with pytest.raises(NergError, match="0.001 s before"):
        next_look(gaze, rays, **options | {"elapsed": (0.001,)})
    # The rays of a training are recognised by what it uses, without heads.
    heads = replace(rays, head=rays.direction)
    head_options = {"head": True, "max_looks": 64, "resamples": 10}
    result = next_look(gaze, heads, **head_options, output=tmp_path / "head")
    assert [row["method"] for row in result.rows] == list(HEAD_METHODS) and {r["elapsed"] for r in result.rows} == {0}
    assert result.model.gaze_in_head == pytest.approx(np.array([1.0, 0, 0]), abs=1e-6)
    # Gaze is the direction of the head.
    assert result.rows[0]["bits"] > 3
    with pytest.raises(NergError, check=mentions("elapsed")):
        next_look(gaze, heads, **head_options, elapsed=(1.0,))
    with pytest.raises(NergError, match="heads"):
        next_look(gaze, rays, **head_options)


def test_the_next_look_needs_held_out_participants(trained):
    with pytest.raises(NergError, check=mentions("test_participants")):
        next_look(trained / "gaze.safetensors", trained / "rays.npz")


# ---- Folds: in workers, one of which is killed, with stored parts, and in this process ----


SMALL = {"folds": 2, "test_zones": 1, "test_positions": 3, "radius": 0.6, "probes": 8, "steps": 2}
SMALL |= {"directions": 128, "min_rays": 8, "splits": "both,pos"}
ONE = Parallel(threads=1)


class Killer(Recorder):
    """Kills the first worker when the first fold is reported, while it computes another one."""

    def __init__(self, cluster):
        super().__init__()
        self.cluster = cluster

    def message(self, text):
        super().message(text)
        if text.startswith("fold 0"):
            self.cluster.workers[0].kill()


def test_two_workers_give_equal_scores_although_one_is_killed(equal_processes, tmp_path, rgb):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    crowd(3000).save(tmp_path / "rays.npz")
    with ClusterOfProcesses(tmp_path) as cluster:
        recorder = Killer(cluster)
        cluster.start_worker(), cluster.start_worker()
        wait_until(lambda: all("connected to" in cluster.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        where = {"parallel": replace(ONE, scheduler=cluster.address), "output": tmp_path / "out"}
        result = folds(tmp_path / "rays.npz", "none", **SMALL | {"folds": 3}, **where, progress=recorder)
        assert cluster.workers[0].poll() is not None and cluster.workers[1].poll() is None
    assert {p.name for p in result.files} == {"folds.md", "folds.csv", "positions.csv", "folds.json"}
    assert {row["fold"] for row in result.each} == {0, 1, 2} and {row["split"] for row in result.rows} == {
        "both",
        "pos",
    }
    # The zone of each fold is a separate group, and all positions together form another group.
    assert {row["group"].split()[0] for row in result.by_position} == {"0", "1", "2"}
    assert {row["split"] for row in result.uncertainty} == {"both", "pos", "anywhere"}
    assert result.calibration[0]["folds"] == 3 and 0 <= result.calibration[0]["80%"] <= 1
    ours = [row["KLD"] for row in result.each if row["split"] == "both" and row["method"] == "gaze field"]
    assert result.rows[0]["KLD"] == pytest.approx(sum(ours) / 3) and ours[0] != ours[1]
    assert result.rows[0]["KLD.low"] < result.rows[0]["KLD"] and all(f.path.is_file() for f in result.fields)
    set_thread_count(1)
    expected = folds(tmp_path / "rays.npz", "none", **SMALL | {"folds": 3}, output=tmp_path / "here", parallel=ONE)
    assert [f.read_bytes() for f in expected.files] == [f.read_bytes() for f in result.files]
    in_memory = folds(crowd(3000), "none", **SMALL | {"folds": 3})
    assert in_memory.rows == result.rows and in_memory.fields[0].path is None and not in_memory.files
    saved = in_memory.save(tmp_path / "saved")
    assert [f.read_bytes() for f in saved] == [f.read_bytes() for f in result.files]


@pytest.fixture(autouse=True)
def threads():
    """Settings of the process that a job changes are restored."""
    before = dr.thread_count()
    yield
    set_thread_count(before)


@pytest.fixture
def folds_trained(monkeypatch):
    """The seeds of the folds that are trained and scored; the work itself is skipped."""
    seeds = []

    def score(common, seed, output):
        seeds.append(seed)
        rows = [{"method": "gaze field", "KLD": 1.0 / (1 + seed), "CC": 0.5}]
        tables = {"rows": rows, "by_position": [], "calibration": [], "verdicts": []}
        write_json(output / SCORED, dict.fromkeys(common.splits, tables))

    score.__qualname__ = "train_and_score"

    monkeypatch.setattr(folding, "train_and_score", score)
    monkeypatch.setattr(GazeField, "load", lambda path: path)
    return seeds


def test_stored_folds_are_not_trained_again(tmp_path, folds_trained):
    def go(rays=None, **changes):
        folds_trained.clear()
        parallel = Parallel(store=tmp_path / "store", threads=changes.pop("threads", 1))
        folds(rays or crowd(300), "none", **SMALL | changes, output=tmp_path / "out", parallel=parallel)
        return list(folds_trained)

    assert go() == [0, 1] and go() == [] and go(folds=4) == [2, 3] and go(seed=2, folds=3) == [4]
    # Other rays or another recipe start another evaluation; a change of the schedule does not.
    assert go(crowd(301)) == [0, 1] and go(steps=3) == [0, 1] and go(threads=2) == []
    (job,) = report_jobs(tmp_path / "store").jobs
    assert (job.name, job.total, job.remaining) == (f"nerg eval folds {tmp_path / 'out'}", 2, 0)


def test_missing_values_of_folds_have_a_reason(tmp_path, monkeypatch):
    """One fold has too few participants for intervals, no samples at own origins, and no split half."""

    def score(common, seed, output):
        rows = [{"method": name, **dict.fromkeys(SCORES, 0.5 + seed), "integral": 1.0} for name in ("gaze field", "b")]
        position = {"x": 0.0, "y": 0.0, "z": 0.0, "group": "0", "KLD": 1.0, "support": 3.0}
        region = {"method": "gaze field", "80%": 0.8}
        if seed:
            rows[0] |= {"bits.low": 0.0, "bits.high": 2.0}
            rows[1] |= {"bits.low": 0.0, "bits.high": 2.0, "bits.gap": 0.0, "bits.gap.low": 0.0, "bits.gap.high": 0.1}
            rows.append({"method": "split half", "bits": 0.5})
            position |= {"half": 0.5, "excess": 0.5}
            region |= {"80%.low": 0.7, "80%.high": 0.9}
        else:
            rows[1] |= {"bits at own origin": np.nan, "bits.gap": 0.0}
        verdict = {"kind": "new positions", "method": "gaze field", "bits": 0.5, "rays": 40, "people": 2}
        baseline = verdict | {"method": "b", "bits.gap": 0.1}
        if seed:
            verdict |= {"bits.low": 0.0, "bits.high": 2.0}
            baseline |= {"bits.low": 0.0, "bits.high": 2.0, "bits.gap.low": 0.0, "bits.gap.high": 0.1}
        tables = {"rows": rows, "by_position": [position], "calibration": [region], "verdicts": [verdict, baseline]}
        write_json(output / SCORED, dict.fromkeys(common.splits, tables), allow_nan=True)

    score.__qualname__ = "train_and_score"
    monkeypatch.setattr(folding, "train_and_score", score)
    monkeypatch.setattr(GazeField, "load", lambda path: path)
    result = folds(crowd(300), "none", **SMALL, output=tmp_path / "out")
    for name in result.TABLES:
        assert getattr(result, name) and not find_wrong_notes(getattr(result, name)), name
    for name in ("folds.csv", "positions.csv"):
        with open(tmp_path / "out" / name, encoding="utf-8", newline="") as file:
            assert not find_wrong_notes(csv.DictReader(file)), name
    notes = {row["note"] for row in result.each if row["fold"] == 0}
    assert any("participants" in note for note in notes) and any("own origin" in note for note in notes)


def test_wrong_arguments_of_folds_are_refused(tmp_path):
    with pytest.raises(NergError, check=mentions("splits")):
        folds(crowd(300), "none", **SMALL | {"splits": "both,time"})
    with pytest.raises(NergError, check=mentions("environment")):
        folds(crowd(300), **SMALL)


@pytest.mark.nightly
def test_ensemble_spread_is_evaluated_like_support(tmp_path):
    options = SMALL | {"ensemble": 2, "splits": "both", "prior_folds": 0}
    result = folds(crowd(3000), "none", **options, output=tmp_path / "out")
    assert {(row["signal"], row["error"]) for row in result.uncertainty} >= {("support", "KLD"), ("spread", "KLD")}
    assert all(row["spread"] > 0 for row in result.by_position)
    assert "spread" in (tmp_path / "out" / "folds.md").read_text()


def test_positions_belong_to_the_zone_of_the_nearest_centre():
    account = {"centres": [[0, 0, 0], [5, 0, 0]], "zone": [3, 7]}
    assert held_out._groups(account, "pos", np.array([[4.9, 0, 0], [0.2, 0, 0]])) == ["7", "3"]


def test_spread_of_an_ensemble_is_its_mean_standard_deviation(monkeypatch):
    monkeypatch.setattr(held_out, "score_positions", lambda *args, spread, **options: spread)
    members = np.random.default_rng(0).random((3, 2, 5))
    test, field = (
        SimpleNamespace(centres=np.zeros((2, 3)), directions=np.zeros((5, 3))),
        SimpleNamespace(network=SimpleNamespace(support=None)),
    )
    spread = held_out._positions(test, field, None, lambda *at: members, lambda *at: members[0], None, 0)
    deviation = np.sqrt(((members - members.mean(axis=0)) ** 2).sum(axis=0) / 2)
    np.testing.assert_allclose(spread, 4 * np.pi * deviation.mean(axis=1))


# ---- The prior field of other environments: messages, content of its checkpoint, and refused input ----


def looking(elevation: float, count: int = 200, seed: int = 0) -> Rays:
    """Two participants looking at one ``elevation`` (radians) in all azimuths."""
    rng = np.random.default_rng(seed)
    up, around = elevation + 0.1 * rng.normal(size=count), rng.uniform(0, 2 * np.pi, count)
    d = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)
    return Rays(np.arange(count), np.arange(count) % 2, ("a", "b"), rng.normal(size=(count, 3)), d, np.ones(count))


def test_a_prior_checkpoint_is_the_density_of_other_scenes(tmp_path, rgb):
    places = [looking(-0.6), looking(0.2, seed=1)]
    for k, rays in enumerate(places):
        rays.save(tmp_path / f"{k}.npz")
    path = tmp_path / "prior.safetensors"
    result = train_prior([tmp_path / "0.npz", tmp_path / "1.npz"])
    result.save(path)
    assert [(p["file"], p["rays"], p["persons"]) for p in result.provenance["places"]] == [
        ("0.npz", 200, 2),
        ("1.npz", 200, 2),
    ]
    field, metadata = load_gaze(path, result.network.ns)
    assert metadata["provenance"] == result.provenance
    ns, sine = field.ns, np.array([-0.9, -0.56, 0.0, 0.2, 0.8])
    r = ns.Array3f(np.stack([np.sqrt(1 - sine**2), 0 * sine, sine]).astype(np.float32))
    gaze = np.array(field.evaluate(r, ns.Array3f(30.0, 4.0, 1.6), r, integral=ns.Float(1.0))[0])
    # Rows of the table are 2.8 degrees, and a thousandth is uniform.
    np.testing.assert_allclose(gaze, compute_elevation_density(places, sine), atol=0.006)
    with pytest.raises(NergError, match="is a prior from other scenes, for which no rays"):
        evaluate_gaze(path, places[0])
    assert train_prior(tmp_path / "1.npz").provenance["places"] == result.provenance["places"][1:]
    # Rays in memory are accepted.
    same = train_prior([places[0], places[1].with_tracking("head")])
    assert same.provenance["tracking"] == "mixed" and result.provenance["tracking"] == "unknown"
    assert same.path is None and "file" not in same.provenance["places"][0]
    np.testing.assert_array_equal(np.array(same.network.prior.array), np.array(field.prior.array))


def test_wrong_prior_inputs_are_refused(tmp_path):
    with pytest.raises(NergError, match="at least one file"):
        train_prior([])
    with pytest.raises(NergError, match="safetensors"):
        train_prior([looking(0.0)]).save(tmp_path / "prior.npz")
    none = looking(0.0).select(np.zeros(200, bool))
    with pytest.raises(NergError, match="of those given; leave it out"):
        train_prior([looking(0.0), none])


# ---- Geometries of jobs: one of each kind, opened again for an evaluation, and alignments from files ----


WALL = '<scene version="3.0.0"><shape type="cube"/></scene>'


@pytest.fixture
def rays():
    return looking_at((1.5, 0.4, 1.2))


def make_gaze(folder, kind, rays, provenance=None):
    """A gaze field that was trained in an environment of a ``kind``, whose file is in ``folder``."""
    if kind == "field":
        fields.radiance(folder / "place.safetensors")
    (folder / "place.xml").write_text(WALL)
    if kind == "hits":
        environment = make_hit_geometry(rays, 0.2).save(folder / "place")
    elif kind == "none":
        environment = no_geometry(rays.origin)
    else:
        environment = Environment.open(folder / f"place.{'safetensors' if kind == 'field' else 'xml'}")
    stored = json.loads(json.dumps(environment.metadata)) | (provenance or {})
    return environment, GazeField(SimpleNamespace(box=BOX), stored, "gaze.safetensors", folder / "gaze.safetensors")


@pytest.mark.parametrize("kind", ["field", "scene", "hits", "none"])
def test_the_environment_is_located_next_to_the_checkpoint(rays, tmp_path, kind):
    place, gaze = make_gaze(tmp_path, kind, rays, {"align": np.diag([2.0, 2, 2, 1]).tolist()})
    assert place.kind == kind and (place.radiance is not None) == (kind == "field")
    again = gaze.open_environment()
    assert again.kind == kind and again.align.scale == pytest.approx(2)
    assert again.box == (BOX if kind == "none" else place.box)
    if kind == "none":
        return
    (tmp_path / "other.xml").write_text(WALL.replace("cube", "sphere"))
    with pytest.raises(NergError, match="is not what .* was trained in", check=mentions("environment")):
        gaze.open_environment(tmp_path / "other.xml")
    if kind == "field":
        fields.radiance(place.path, density_scale=3.0)
    else:
        place.path.write_bytes(place.path.read_bytes() + b" ")
    with pytest.raises(NergError, match="is not the file that", check=mentions("environment")):
        gaze.open_environment()
    place.path.unlink()
    with pytest.raises(NergError, match="does not exist", check=mentions("environment")):
        gaze.open_environment()


@pytest.mark.parametrize("kind", ["scene", "hits", "none"])
@pytest.mark.parametrize("word", ["hits", "none"])
def test_an_evaluation_takes_the_words_of_its_training(rays, tmp_path, kind, word):
    _, gaze = make_gaze(tmp_path, kind, rays)
    if word == kind:
        assert gaze.open_environment(word).kind == kind
        assert gaze.open_environment(Path(word)).kind == kind, "as the command line gives it"
    else:
        with pytest.raises(NergError, check=mentions("environment")) as refusal:
            gaze.open_environment(word)
        trained = {"scene": "place.xml", "hits": "hits", "none": "none"}[kind]
        assert f'"{word}"' in str(refusal.value) and f'in "{trained}"' in str(refusal.value)


def test_a_checkpoint_without_an_environment_is_refused():
    with pytest.raises(NergError, match="does not store the geometry that it was trained"):
        GazeField(SimpleNamespace(box=BOX), {}).open_environment()


def test_without_geometry_the_box_contains_all_observers(rays):
    views = tuple(around(5))
    for samples, seen in ((rays, ()), (None, views), (rays, views)):
        place = training._make_environment("none", Supervision(samples, seen), None, Recorder())
        positions = np.concatenate(([samples.origin] if samples else []) + [v.camera.center[None] for v in seen])
        np.testing.assert_allclose(place.box.lower, positions.min(axis=0) - 2)


def test_an_alignment_file_contains_a_similarity(tmp_path):
    path = tmp_path / "align.json"
    path.write_text(json.dumps(np.diag([3.0, 3, 3, 1]).tolist()))
    assert read_similarity(path, "align", "rays to field").scale == pytest.approx(3)
    for wrong in ("[1, 2]", '{"a": 1}', json.dumps(np.diag([3.0, 2, 3, 1]).tolist())):
        path.write_text(wrong)
        with pytest.raises(NergError, match=r"align_views.*align\.json"):
            read_similarity(path, "align_views", "photos to field")
