"""Texts of options, keys of stored parts, and the backend of a command."""

from __future__ import annotations

import types
import typing
from dataclasses import dataclass, fields, replace
from pathlib import Path

import drjit as dr
import pytest

from nerg_mi import options
from nerg_mi.aoi.measured import Counting
from nerg_mi.aoi.settings import AoiSampling, VisitRules
from nerg_mi.cli.declarations import select_backend
from nerg_mi.environment.scene_loading import list_library_versions
from nerg_mi.errors import NergError
from nerg_mi.options import option
from nerg_mi.progress import SILENT
from nerg_mi.surfaces.sources import GazeSumSettings, RaySettings
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import Part, Plan, rebuild_value
from nerg_mi.threads import set_thread_count
from tests.tasks import works

# ---- Texts of options ----


def test_numbers_are_parsed():
    for text in ("1,-2.5,3e2", "1 -2.5 3e2"):
        assert options.parse_numbers(text, "--box") == (1.0, -2.5, 300.0)
    for text in ("", "1,,2", "a"):
        with pytest.raises(NergError, match="box must be comma-separated numbers"):
            options.parse_numbers(text, "--box")


@pytest.mark.parametrize("text", ["1,2", "1,2,1.1e7", "nan,0,0", "1" + 400 * "0" + ",0,0", "x" * 1500])
def test_points_are_parsed(text):
    assert options.parse_point("1,-2,1e7", "--up") == (1.0, -2.0, 1e7)
    with pytest.raises(NergError, match="observer (is|must)"):
        options.parse_point(text, "observer")


def test_definitions_are_parsed():
    pairs = ["spp=4", "name=a=b", "empty="]
    assert options.parse_definitions(pairs, "--define") == {"spp": "4", "name": "a=b", "empty": ""}
    assert options.parse_definitions((), "--define") == {}
    for pair in ("level", "=3", ""):
        with pytest.raises(NergError, match="write KEY=VALUE"):
            options.parse_definitions([pair], "--define")


# ---- Keys of stored parts ----


STORE = {"store", "scheduler", "threads"}

# For each command: its options, the function that returns the options of its parts, and the options that the parts do
# not receive. These concern the schedule, the selection of parts, or the processing of their outputs.
COMMANDS = {"stats": (AoiSampling, lambda o: o, set())}
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
class Later(VisitRules):
    """Options with additional fields."""

    weight: float = option(1.0, "A new option.")
    processes: int = option(1, "One that changes no result.", changes_result=False)


def test_new_options_are_in_the_key_and_scheduling_options_are_not():
    assert key(Later(weight=2.0)) != key(Later()) and key(Later(processes=2)) == key(Later())
    assert rebuild_value(Later(processes=2)).processes == 1


def test_a_file_is_identified_by_its_content(tmp_path):
    def options(folder, text):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "cohorts.csv").write_text(text)
        return Counting(cohorts=tmp_path / folder / "cohorts.csv")

    before = key(options("a", "one"))
    assert key(options("b", "one")) == before != key(options("a", "two"))


def test_either_option_enables_parts():
    assert not Parallel().in_parts
    assert Parallel(store=Path("s")).in_parts and Parallel(scheduler="local").in_parts


def test_parts_run_with_default_scheduling_options():
    (task,) = Plan(
        "p", works.write_mixture, None, [Part(Parallel(store=Path("s"), scheduler="tcp://a:1"))], ".txt"
    ).tasks
    assert task.value == Parallel() and not task.files


# ---- The default reporter ----


def test_the_default_reporter_is_silent(capsys):
    SILENT.message("a")
    SILENT.warn("b")
    SILENT.progress(0.5, "c")
    assert capsys.readouterr() == ("", "")


# ---- Versions of programs in a report ----


def test_versions_of_all_components_are_listed():
    installed = list_library_versions("llvm_ad_rgb")
    assert set(installed) == {"nerg_mi", "mitsuba", "drjit", "numpy", "python", "libLLVM"} and all(installed.values())
    assert "libLLVM" not in list_library_versions("scalar_rgb")


# ---- The backend of a command ----


def test_variant_and_threads(rgb):
    before = dr.thread_count()
    rgb.set_variant("llvm_ad_mono")
    try:
        select_backend("llvm_ad_rgb", 1)
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
