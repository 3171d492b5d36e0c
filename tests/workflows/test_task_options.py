"""What parts of a job are kept by: each option of each divided command changes a key exactly when the part's work is
given another value, and none can be left out by hand."""

from __future__ import annotations

import types
import typing
from dataclasses import dataclass, fields, replace
from pathlib import Path

import pytest

from nerg_mi.aoi.options import CountOptions, PredictionOptions, StatisticsOptions
from nerg_mi.surfaces.sources import GazeSettings, RaySettings
from nerg_mi.tasks.task import Part, Plan, rebuilt
from nerg_mi.workflows.ablation import training_options
from nerg_mi.workflows.evaluate import fold_options
from nerg_mi.workflows.film import picture_options
from nerg_mi.workflows.gaze_commands import AblationOptions, FoldOptions
from nerg_mi.workflows.options import PartOptions, as_base, option
from nerg_mi.workflows.scene_commands import FilmOptions, StudyOptions
from nerg_mi.workflows.study import planned_study
from tests.tasks import works

STORE = {"store", "scheduler", "threads"}

# Of each command, what its parts are given of its options, and which options that leaves out: those of the schedule,
# and those by which the command chooses parts or makes something of their outputs, none of which a part sees.
COMMANDS = {
    "render": (FilmOptions, picture_options, STORE | {"defaults", "frames", "fps"}),
    "ablate": (AblationOptions, training_options, STORE | {"recipes", "variant", "seeds", "cameras", "size"}),
    "study": (
        StudyOptions,
        lambda o: planned_study(None, "sphere", o).options,
        STORE - {"threads"} | {"only", "defaults", "scene_kind"},
    ),
    "folds": (FoldOptions, fold_options, STORE | {"folds", "first", "splits", "most"}),
}
AFTER_COUNTS = {"eyes", "glance", "what_if", "visibility", "observers", "height", "floor", "step", "min_people"}
AFTER_COUNTS |= {"names", "salt", "resamples", "seed"} | STORE
OF_COUNTS = {f.name for f in fields(CountOptions)} - {f.name for f in fields(PredictionOptions)}
COMMANDS["stats, counts"] = (StatisticsOptions, lambda o: as_base(o, CountOptions), AFTER_COUNTS | {"directions"})
COMMANDS["stats, a field"] = (StatisticsOptions, lambda o: as_base(o, PredictionOptions), AFTER_COUNTS | OF_COUNTS)
COMMANDS["bake, a field"] = (GazeSettings, lambda o: o, set())
COMMANDS["bake, rays"] = (RaySettings, lambda o: o, set())


def other_value(kind, f, options, folder):
    """A valid value of the field ``f`` of options, other than that of ``options``."""
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
    (task,) = Plan("p", works.mixed, value, [Part("a")], ".txt").tasks
    return task.key


@pytest.mark.parametrize("command", list(COMMANDS))
def test_each_option_changes_the_key_of_a_part_exactly_when_it_changes_its_work(command, tmp_path):
    kind, of_parts, others = COMMANDS[command]
    options = kind()
    before, left_out = key(of_parts(options)), set()
    for f in fields(kind):
        changed = of_parts(replace(options, **{f.name: other_value(kind, f, options, tmp_path)}))
        same_work = rebuilt(changed) == rebuilt(of_parts(options))
        assert (key(changed) == before) == same_work, f.name
        if same_work:
            left_out.add(f.name)
    assert left_out == others


@dataclass(frozen=True, kw_only=True)
class Later(CountOptions):
    """Options to which some were added."""

    weight: float = option(1.0, "A new option.")
    processes: int = option(1, "One that changes no result.", changes_result=False)


def test_a_new_option_is_in_the_key_and_one_of_the_schedule_is_not():
    assert key(Later(weight=2.0)) != key(Later()) and key(Later(processes=2)) == key(Later())
    assert rebuilt(Later(processes=2)).processes == 1


def test_a_file_is_its_bytes_wherever_it_lies(tmp_path):
    def options(folder, text):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "zones.json").write_text(text)
        return CountOptions(zones=tmp_path / folder / "zones.json")

    before = key(options("a", "one"))
    assert key(options("b", "one")) == before != key(options("a", "two"))


def test_parts_are_asked_for_by_either_option():
    assert not PartOptions().in_parts
    assert PartOptions(store=Path("s")).in_parts and PartOptions(scheduler="local").in_parts


def test_what_runs_has_what_cannot_change_a_result_at_its_default():
    (task,) = Plan("p", works.mixed, None, [Part(PartOptions(store=Path("s"), scheduler="tcp://a:1"))], ".txt").tasks
    assert task.value == PartOptions() and not task.files
