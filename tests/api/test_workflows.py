"""Tests of the functions that run workflows."""

from __future__ import annotations

import doctest
import json
from pathlib import Path

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.analysis import bake
from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows import evaluate, next_look, study, train_gaze, train_radiance
from nerg_mi.workflows.gaze_commands import GazeEvaluationOptions, GazeOptions, NextLookOptions
from nerg_mi.workflows.radiance_commands import RadianceOptions, RadianceScoreOptions
from nerg_mi.workflows.scene_commands import StudyOptions
from tests.surfaces.meshes import box


def run_example(function, names):
    """Count the failing statements of the example in a docstring."""
    (example,) = doctest.DocTestFinder().find(function, function.__name__, globs=names)
    return doctest.DocTestRunner().run(example).failed


# ---- Alignment ----


ROWS = "0,0,0,1,0,0\n2,0,0,5,0,0\n0,1,0,1,2,0\n0,0,1,1,0,2\n"


def test_files_may_be_named_by_strings(tmp_path):
    (tmp_path / "p.csv").write_text("x,y,z,place_x,place_y,place_z\n" + ROWS)
    result = nerg.align(output=str(tmp_path / "a.json"), pairs=str(tmp_path / "p.csv"))
    np.testing.assert_allclose(result.matrix, json.loads((tmp_path / "a.json").read_text())["matrix"])
    np.testing.assert_allclose(result.matrix[:3, :3], 2 * np.eye(3), atol=1e-12)


# ---- `nerg.bake`: its example, and rays in memory or in a file ----


@pytest.mark.nightly
def test01_the_example_runs(rgb):
    assert run_example(bake, {}) == 0


def test02_rays_in_memory_and_in_a_file_are_one(rgb, tmp_path):
    v, f = box((0, 0, 0), (4, 3, 2.5))
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    rays = Rays([0.0, 0.1], [0, 0], ("a",), np.ones((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]]), np.ones(2))
    rays.save(tmp_path / "a.npz")
    first = bake(tmp_path / "room.ply", rays=rays, max_edge=1.0)
    second = bake(str(tmp_path / "room.ply"), str(tmp_path / "b.json"), rays=str(tmp_path / "a.npz"), max_edge=1.0)
    assert np.array_equal(first.density, second.density) and second.files == (tmp_path / "b.json",)
    with pytest.raises(NergError, match='"smoth".*"smooth"'):
        bake(tmp_path / "room.ply", rays=rays, smoth=0.1)


# ---- Options are passed on to the jobs; the examples (test_names) run the jobs ----


class Request(Exception):
    """Ends a job before it starts; holds its options."""


LLVM = {"mode": "llvm_ad_rgb"}
JOBS = {
    "evaluate_radiance": (
        train_radiance,
        lambda: nerg.evaluate_radiance("f.safetensors", "photos", spp=3, pictures="out"),
        (Path("f.safetensors"), Path("photos"), RadianceScoreOptions(spp=3, pictures=Path("out"), **LLVM)),
    ),
    "evaluate_gaze": (
        evaluate,
        lambda: nerg.evaluate_gaze("g.safetensors", "r.npz", "out", split="pos"),
        (Path("g.safetensors"), Path("r.npz"), "out", GazeEvaluationOptions(split="pos", **LLVM)),
    ),
    "evaluate_next_look": (
        next_look,
        lambda: nerg.next_look("g.safetensors", "r.npz", "out", earlier=5),
        (Path("g.safetensors"), Path("r.npz"), "out", NextLookOptions(earlier=5, **LLVM)),
    ),
    "run_study": (
        study,
        lambda: nerg.study("slab", "out", quick=True),
        ("slab", "out", StudyOptions(quick=True, **LLVM)),
    ),
    "train_radiance": (
        train_radiance,
        lambda: nerg.train_radiance("photos", "out.safetensors", options=RadianceOptions(seed=3), steps=7),
        (Path("photos"), "out.safetensors", RadianceOptions(seed=3, steps=7, **LLVM)),
    ),
    "train_gaze": (
        train_gaze,
        lambda: nerg.train_gaze(None, geometry="none", kappa=9.0),
        (None, None, GazeOptions(geometry="none", kappa=9.0, **LLVM)),
    ),
}


@pytest.fixture
def captured(monkeypatch, tmp_path):
    """Workflows that raise with their options, and the files that they need."""
    monkeypatch.chdir(tmp_path)
    for name in ("f.safetensors", "g.safetensors", "r.npz", "photos"):
        Path(name).touch()

    def raise_it(*arguments):
        raise Request(*arguments)

    for job, (module, *_) in JOBS.items():
        monkeypatch.setattr(module, job, raise_it)


@pytest.mark.parametrize("job", JOBS)
def test01_options_reach_the_workflows(captured, job):
    _, call, expected = JOBS[job]
    with pytest.raises(Request) as result:
        call()
    assert result.value.args[: len(expected)] == expected


@pytest.mark.parametrize(
    "name", ["evaluate_radiance", "evaluate_gaze", "next_look", "study", "train_gaze", "train_radiance"]
)
def test02_invalid_options_are_refused(name):
    with pytest.raises(nerg.NergError, match=f'{name} has no option "nothing"'):
        getattr(nerg, name)("a", "b", nothing=3)
    with pytest.raises(nerg.NergError, match=f"{name} uses the active variant"):
        getattr(nerg, name)("a", "b", mode="scalar_rgb")


def test03_active_variant_is_kept(mono, captured):
    with pytest.raises(Request) as result:
        nerg.train_radiance("photos")
    assert result.value.args[2].mode == "llvm_ad_mono" and mono.variant() == "llvm_ad_mono"


# ---- Statistics from a notebook: the example of its docstring, and its options ----


def test01_the_example(tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    assert run_example(nerg.statistics, {"folder": tmp_path}) == 0


def test02_unknown_options_are_refused():
    with pytest.raises(NergError, match='no option "area"'):
        nerg.statistics("a.npz", area="x")


# ---- Tracking files in, rays out ----


COLUMNS = "origin=x,y,z direction=dx,dy,dz t=t person=who"


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "day.csv"
    path.write_text("t,who,x,y,z,dx,dy,dz\n0,Ada,100,200,160,1,0,0\n1,Bob,100,200,160,0,0,1\n")
    return path


def test01_options_are_the_readers(table):
    rays = nerg.import_rays(table, columns=COLUMNS, units="cm")
    assert np.allclose(rays.origin, [(1, 2, 1.6)] * 2) and rays.persons == ("Ada", "Bob")


def test02_options_of_the_import(table, tmp_path):
    out = tmp_path / "rays.npz"
    rays = nerg.import_rays([table], columns=COLUMNS, output=out, pseudonyms=True)
    assert not {"Ada", "Bob"} & set(rays.persons)
    assert nerg.load_rays(out).persons == rays.persons


def test03_invalid_options_are_refused(table):
    with pytest.raises(nerg.NergError, match="colums"):
        nerg.import_rays(table, colums=COLUMNS)
    with pytest.raises(nerg.NergError, match='"nope"'):
        nerg.import_rays(table, "nope")
    with pytest.raises(nerg.NergError, match="choose some of them with columns$"):
        nerg.import_rays(table, columns=COLUMNS.replace("t=", "t=no"))
    for columns in ({"time": "t"}, ["t"]):
        with pytest.raises(nerg.NergError, match=f"columns is text .* got {type(columns).__name__}"):
            nerg.import_rays(table, columns=columns)


def test04_progress_is_reported(table):
    messages = []

    class Reporter:
        def message(self, text): ...
        def warn(self, text): ...
        def progress(self, share, text=""):
            messages.append(text)

    nerg.import_rays(table, columns=COLUMNS, progress=Reporter())
    assert any("day.csv" in text for text in messages)


# ---- A training returns a field in memory with its provenance ----


@pytest.mark.nightly
def test04_trained_fields_can_be_rendered(rgb, tmp_path):
    rng = np.random.default_rng(0)
    origin = rng.uniform((1, 1, 1.5), (2, 2, 1.6), (500, 3))
    direction = rng.normal(size=(500, 3)) * (1, 1, 0.2)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = nerg.Rays(np.arange(500.0), np.zeros(500, int), ("Ada",), origin, direction, np.ones(500))
    field = nerg.train_gaze(rays, tmp_path / "gaze.safetensors", geometry="none", steps=1, validation_zones=0, probes=4)
    assert field.name == "gaze.safetensors" and field.provenance["steps"] == 1
    again = nerg.load_gaze(tmp_path / "gaze.safetensors")
    walls = {"type": "cube", "to_world": rgb.ScalarTransform4f().scale(4)}
    a, b = (
        nerg.trace(nerg.make_scene(gaze=g, shapes=walls), (1.5, 1.5, 1.5), [(1, 0, 0), (0, 1, 0.1)], "gaze").gaze
        for g in (field, again)
    )
    assert np.array_equal(a, b) and (a > 0).all()
