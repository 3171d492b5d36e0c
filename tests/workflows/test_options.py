"""Typed options of every workflow, keys of stored parts, and the backend of a workflow."""

from __future__ import annotations

import importlib
import pkgutil
import types
import typing
from dataclasses import FrozenInstanceError, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import get_type_hints

import drjit as dr
import pytest

import nerg_mi.workflows
from nerg_mi import options
from nerg_mi.aoi.options import CountOptions, PredictionOptions, StatisticsOptions
from nerg_mi.errors import NergError
from nerg_mi.options import PartOptions, exposed_options, option, shared_options, to_base
from nerg_mi.progress import SILENT
from nerg_mi.ranges import ValidatedDataclass
from nerg_mi.surfaces.sources import GazeSumSettings, RaySettings
from nerg_mi.tasks.task import Part, Plan, rebuild_value
from nerg_mi.threads import set_thread_count
from nerg_mi.train.gaze_settings import GazeSettings as TrainingSettings
from nerg_mi.train.gaze_settings import ProbeSettings
from nerg_mi.workflows import evaluate
from nerg_mi.workflows.base import select_backend, versions
from nerg_mi.workflows.evaluate import fold_options
from nerg_mi.workflows.gaze_commands import FoldOptions, GazeEvaluationOptions, GazeOptions
from nerg_mi.workflows.rays_commands import FilterOptions, SplitOptions
from nerg_mi.workflows.render import picture_options
from nerg_mi.workflows.scene_commands import FilmOptions, StudyOptions
from nerg_mi.workflows.study import plan_study
from tests.tasks import works

# ---- Typed options of every workflow: frozen, keyword-only, each with a help text ----


MODULES = [
    importlib.import_module(f"nerg_mi.workflows.{m.name}") for m in pkgutil.iter_modules(nerg_mi.workflows.__path__)
]
MODULES.append(importlib.import_module(StatisticsOptions.__module__))
# Required options, if the defaults alone are not valid.
SAID = {"FilterOptions": {"thin": 1.0}, "SplitOptions": {"test_zones": 3}}
KINDS = [
    kind
    for module in MODULES
    for kind in vars(module).values()
    if is_dataclass(kind)
    and isinstance(kind, type)
    and issubclass(kind, ValidatedDataclass)
    and kind.__module__ == module.__name__
]


def test_there_are_options():
    assert {"GazeOptions", "GazeEvaluationOptions", "FoldOptions"} <= {k.__name__ for k in KINDS}


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_options_are_frozen_and_documented(kind):
    made = kind(**SAID.get(kind.__name__, {}))
    with pytest.raises(TypeError):
        kind(1)
    for f in fields(kind):
        option = "--" + f.name.replace("_", "-")
        assert f.metadata["help"].strip() and not f.metadata["help"].startswith(option), f.name
        with pytest.raises(FrozenInstanceError):
            setattr(made, f.name, None)
    assert set(get_type_hints(kind)) == {f.name for f in fields(kind)}


def test_number_ranges_are_checked():
    for text in ("1,-2.5,3e2", "1 -2.5 3e2"):
        assert options.parse_numbers(text, "--box") == (1.0, -2.5, 300.0)
    for text in ("", "1,,2", "a"):
        with pytest.raises(NergError, match="box must be comma-separated numbers"):
            options.parse_numbers(text, "--box")


@pytest.mark.parametrize("text", ["1,2", "1,2,1.1e7", "nan,0,0", "1" + 400 * "0" + ",0,0", "x" * 1500])
def test_points_are_parsed(text):
    assert options.parse_point("1,-2,1e7", "--up") == (1.0, -2.0, 1e7)
    for refused in (options.parse_point, lambda text, flag: StatisticsOptions(observers=(text,))):
        with pytest.raises(NergError, match="observers? (is|must)"):
            refused(text, "observer")


def test_definitions_are_parsed():
    pairs = ["spp=4", "name=a=b", "empty="]
    assert options.parse_definitions(pairs, "--define") == {"spp": "4", "name": "a=b", "empty": ""}
    assert options.parse_definitions((), "--define") == {}
    for pair in ("level", "=3", ""):
        with pytest.raises(NergError, match="write KEY=VALUE"):
            options.parse_definitions([pair], "--define")


# ---- Options of folds, including those of geometries and of parts ----


def test_folds_include_geometry_and_part_options():
    options = FoldOptions(geometry="hits", store=Path("kept"))
    assert options.in_parts and (options.folds, options.seed, options.test_participants) == (5, 0, 0.5)
    assert set(options.splits.split(",")) == {"both", "pos", "people"}


def test_repeated_options_are_read_again_and_equal_names_are_not():
    folds = FoldOptions(geometry="none", recipe="small", kappa=9.0)
    shared = shared_options(folds, GazeOptions)
    assert shared["recipe"] == "small" and shared["geometry"] == "none"
    assert not {"kappa", "min_rays", "threads"} & set(shared)
    scoring = {"kappa": 9.0, "directions": 2048, "min_rays": 64}
    assert shared_options(folds, GazeEvaluationOptions) == scoring
    assert FoldOptions(ensemble=1000).ensemble == 1000, "with the range that it has in a training"


# ---- A setting of gaze trainings is also an option of folds ----

FIELDS = [f for kind in (ProbeSettings, TrainingSettings) for f in fields(kind) if "help" in f.metadata]
SETTINGS = {f.name for f in FIELDS}
CHANGED_SETTINGS = {"learning_rate": 0.5, "max_rays": 7, "placement": "grid", "resample_directions": True}


class Stop(Exception):
    pass


@pytest.fixture
def training(monkeypatch):
    """The options with which a training starts, before it is stopped."""
    seen = []

    def begin(*arguments):
        seen.extend(a for a in arguments if isinstance(a, GazeOptions))
        raise Stop

    monkeypatch.setattr(evaluate, "train_gaze", begin)
    return seen


def test_folds_have_the_training_settings(training, tmp_path):
    options = FoldOptions(geometry="hits", **CHANGED_SETTINGS)
    with pytest.raises(Stop):
        evaluate.train_and_score(evaluate.FoldInputs(options, ("both",), None, None), 3, tmp_path)
    assert {name: getattr(training[0], name) for name in CHANGED_SETTINGS} == CHANGED_SETTINGS and training[0].seed == 3
    # Options of the test probes have the same names, and are not passed to the training.
    assert training[0].kappa is training[0].radius is None


def test_every_training_setting_is_covered():
    assert {f.name for f in fields(FoldOptions)} | {"seed", "freeze", "validation_zones"} >= SETTINGS
    assert exposed_options(FoldOptions()) == {}
    assert set(exposed_options(FoldOptions(**CHANGED_SETTINGS))) == set(CHANGED_SETTINGS)


# ---- Options of filtering and splitting; tests/workflows/test_rays.py tests their effect on rays ----


def test_empty_options_are_refused():
    with pytest.raises(NergError, match="no selection is given"):
        FilterOptions()
    with pytest.raises(NergError, match="no criterion is given"):
        SplitOptions()


def test_an_unknown_detector_is_refused():
    with pytest.raises(NergError, match='"dbscan"'):
        FilterOptions(fixations="dbscan")
    with pytest.raises(NergError, match="add fixations"):
        FilterOptions(merge_fixations=True, thin=1.0)


def test_conditions_list_the_selected_options():
    assert FilterOptions(end=2.0, persons=("Ada",), thin=1.0).conditions == {"time": (None, 2.0), "persons": ["Ada"]}
    assert FilterOptions(thin=1.0).conditions == {}
    assert FilterOptions(box=(0, 1, 0, 1, 0, 1)).conditions == {"box": [0, 1, 0, 1, 0, 1]}


# ---- Keys of stored parts ----


STORE = {"store", "scheduler", "worker_wait", "threads"}

# For each command: its options, the function that returns the options of its parts, and the options that the parts do
# not receive. These concern the schedule, the selection of parts, or the processing of their outputs.
COMMANDS = {
    "render": (FilmOptions, picture_options, STORE | {"defaults", "frames", "fps"}),
    "study": (
        StudyOptions,
        lambda o: plan_study(None, "sphere", o).options,
        STORE - {"threads"} | {"only", "defaults", "scene_kind"},
    ),
    "folds": (FoldOptions, fold_options, STORE | {"folds", "seed", "splits", "max_samples"}),
}
AFTER_COUNTS = {"viewpoints", "glance_duration", "what_if", "observers", "eye_height", "floor_height"}
AFTER_COUNTS |= {"grid_step", "min_participants"}
AFTER_COUNTS |= {"show_names", "salt", "resamples", "power", "seed"} | STORE
OF_COUNTS = {f.name for f in fields(CountOptions)} - {f.name for f in fields(PredictionOptions)}
COMMANDS["stats, counts"] = (StatisticsOptions, lambda o: to_base(o, CountOptions), AFTER_COUNTS | {"directions"})
COMMANDS["stats, a field"] = (StatisticsOptions, lambda o: to_base(o, PredictionOptions), AFTER_COUNTS | OF_COUNTS)
COMMANDS["bake, a field"] = (GazeSumSettings, lambda o: o, set())
COMMANDS["bake, rays"] = (RaySettings, lambda o: o, set())


def other_value(kind, f, options, folder):
    """A valid value of the field ``f`` that differs from that of ``options``."""
    hint, old = typing.get_type_hints(kind)[f.name], getattr(options, f.name)
    kinds = [k for k in typing.get_args(hint) if k is not type(None)] if is_union(hint) else [hint]
    for k in kinds:
        if k is bool:
            return not old
        if k in (int, float):
            low, high = (w.low, w.high) if (w := f.metadata.get("nerg_mi.range")) else (0, 100)
            near = [k(v) for v in (low, low + 1, (low + high) / 2, high, 1, 2)]
            return next(v for v in near if v != old and low <= v <= high)
        if k is Path:
            (folder / f.name).write_text(f.name)
            return folder / f.name
        if typing.get_origin(k) is tuple:
            return ("a=0,1",) if f.name == "windows" else ("1,2,3",)
        if typing.get_origin(k) is not None:
            return {"level": "0.5"}
        if k is str:
            return "auto" if f.name == "mode" and old != "auto" else f"{old or ''}x"
    raise AssertionError(f"what is another {f.name}?")


def is_union(hint):
    return typing.get_origin(hint) in (typing.Union, types.UnionType)


def key(value):
    (task,) = Plan("p", works.write_mixture, value, [Part("a")], ".txt").tasks
    return task.key


@pytest.mark.parametrize("command", list(COMMANDS))
def test_an_option_changes_the_part_key_only_if_it_changes_the_result(command, tmp_path):
    kind, of_parts, excluded = COMMANDS[command]
    options = kind()
    before, left_out = key(of_parts(options)), set()
    for f in fields(kind):
        changed = of_parts(replace(options, **{f.name: other_value(kind, f, options, tmp_path)}))
        same_work = rebuild_value(changed) == rebuild_value(of_parts(options))
        assert (key(changed) == before) == same_work, f.name
        if same_work:
            left_out.add(f.name)
    assert left_out == excluded


@dataclass(frozen=True, kw_only=True)
class Later(CountOptions):
    """Options with additional fields."""

    weight: float = option(1.0, "A new option.")
    processes: int = option(1, "One that changes no result.", changes_result=False)


def test_new_options_are_in_the_key_and_scheduling_options_are_not():
    assert key(Later(weight=2.0)) != key(Later()) and key(Later(processes=2)) == key(Later())
    assert rebuild_value(Later(processes=2)).processes == 1


def test_a_file_is_identified_by_its_content(tmp_path):
    def options(folder, text):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "zones.json").write_text(text)
        return CountOptions(zones=tmp_path / folder / "zones.json")

    before = key(options("a", "one"))
    assert key(options("b", "one")) == before != key(options("a", "two"))


def test_either_option_enables_parts():
    assert not PartOptions().in_parts
    assert PartOptions(store=Path("s")).in_parts and PartOptions(scheduler="local").in_parts


def test_parts_run_with_default_scheduling_options():
    (task,) = Plan(
        "p", works.write_mixture, None, [Part(PartOptions(store=Path("s"), scheduler="tcp://a:1"))], ".txt"
    ).tasks
    assert task.value == PartOptions() and not task.files


# ---- The default reporter of jobs ----


def test_the_default_reporter_is_silent(capsys):
    SILENT.message("a")
    SILENT.warn("b")
    SILENT.progress(0.5, "c")
    assert capsys.readouterr() == ("", "")


# ---- Versions of programs in a report ----


def test_versions_of_all_components_are_listed():
    installed = versions("llvm_ad_rgb")
    assert set(installed) == {"nerg_mi", "mitsuba", "drjit", "numpy", "python", "libLLVM"} and all(installed.values())
    assert "libLLVM" not in versions("scalar_rgb")


# ---- The backend of a job ----


def test_variant_and_threads(rgb):
    before = dr.thread_count()
    rgb.set_variant("llvm_ad_mono")
    try:
        assert select_backend("llvm_ad_rgb", 1).__name__ == "drjit.llvm.ad"
        assert rgb.variant() == "llvm_ad_rgb" and dr.thread_count() == 1
    finally:
        set_thread_count(before)
    select_backend("llvm_ad_rgb")
    assert dr.thread_count() == before


@pytest.mark.parametrize(
    "mode, said", [("llvm_rgb", "available variants: scalar_rgb,"), ("scalar_rgb", "need a JIT variant")]
)
def test_unsupported_variants_are_refused(mode, said):
    with pytest.raises(NergError, match=said):
        select_backend(mode)
