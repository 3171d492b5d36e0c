"""Every number that a user gives has a range, declared with it, and is tried at the range's ends and beyond them."""

from __future__ import annotations

import importlib
import math
import pkgutil
import re
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
import typer
from typer.core import TyperOption

import nerg_mi.aoi
import nerg_mi.rays.readers
import nerg_mi.workflows
from nerg_mi.cli.building import build_command
from nerg_mi.errors import NergError
from nerg_mi.ranges import FARTHEST, FLAG, RANGE, Checked, Range, check_number, ranged
from nerg_mi.rays.readers.registry import shared_options
from nerg_mi.train import gaze_settings, radiance_settings
from nerg_mi.workflows import rays
from nerg_mi.workflows.base import Command
from nerg_mi.workflows.scene_commands import KINDS as FIGURES
from tools.command_pages import commands


def _modules():
    for package in (nerg_mi.aoi, nerg_mi.workflows, nerg_mi.rays.readers):
        yield package
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            yield importlib.import_module(module.name)
    yield from (gaze_settings, radiance_settings, rays)


KINDS = list(
    dict.fromkeys(
        kind
        for kind in (
            *(kind for module in _modules() for kind in vars(module).values()),
            *(figure.options for figure in FIGURES.values()),
        )
        if isinstance(kind, type)
        and is_dataclass(kind)
        and (issubclass(kind, Checked) or any(RANGE in f.metadata for f in fields(kind)))
    )
)
LEFT_OUT = {"settings", "output", "train_output", "test_output", "align_output", "salt"}
"""Fields that are no options of the command line, or spelt otherwise there."""
# What other options need beside them.
BESIDE: dict[str, dict[str, Any]] = {
    "FilterOptions": {"with_hit": True},
    "SplitOptions": {"persons": ("Ada",)},
    "GazeSettings": {"steps": 1},
    "RadianceSettings": {"steps": 1},
}
STRANGE = (
    *(math.nan, math.inf, -math.inf, 1e308, -1e308, 10**400, -(10**400), 10**5000, 2**31, 2**32, 1e38, -0.0, 5e-324),
    *(float(np.finfo(np.float32).max), True, "1", None),
)


def _numbers(kind):
    return [f for f in fields(kind) if re.search(r"\b(int|float)\b", str(f.type))]


def _fault(kind, field, value) -> str | None:
    """What is said about a ``value`` of ``field``, but for what is said of several options together."""
    given = {**BESIDE.get(kind.__name__, {}), field.name: (value,) * 3 if "tuple" in str(field.type) else value}
    if field.name == "minutes" and "Settings" in kind.__name__:
        given.pop("steps")
    try:
        kind(**given)
    except NergError as error:
        return str(error) if "must be a" in str(error) or "must lie in" in str(error) else None
    return None


def test_all_kinds_of_options_are_found():
    names = {kind.__name__ for kind in KINDS}
    assert {"BakeOptions", "GazeOptions", "FoldOptions", "TableOptions", "TickOption", "ProbeSettings"} <= names


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: f"{k.__module__}.{k.__name__}")
def test_every_number_is_refused_beyond_its_range_and_nowhere_else(kind):
    assert not _numbers(kind) or issubclass(kind, Checked)
    for field in _numbers(kind):
        within = field.metadata[RANGE]
        assert isinstance(within, Range), f"{field.name} has no range"
        whole = re.search(r"\bint\b", str(field.type))
        for end, beyond in ((within.low, -1), (within.high, 1)):
            ends = (int(end), int(end) + beyond) if whole else (end, math.nextafter(end, beyond * math.inf))
            assert _fault(kind, field, ends[0]) is None
            assert "must lie in" in (_fault(kind, field, ends[1]) or "")
        for value in STRANGE:
            number = type(value) is int or (type(value) is float and not whole)
            none = value is None and "None" in str(field.type) and "tuple" not in str(field.type)
            said = _fault(kind, field, value)
            assert (said is None) == (none or (number and within.low <= value <= within.high)), (field.name, value)
            name = field.metadata.get(FLAG) or field.name.replace("_", "-" if FLAG in field.metadata else "_")
            assert said is None or (name in said and len(said) < 200)


@pytest.mark.parametrize(
    "kind", [k for k in KINDS if all("help" in f.metadata for f in fields(k))], ids=lambda k: k.__name__
)
def test_the_command_line_refuses_the_same(kind):
    made: list[Any] = []
    left_out = tuple({f.name for f in fields(kind)} & LEFT_OUT)
    take = lambda options, reporter: made.append(options)
    run = build_command(Command("take", take, "", "", kind, left_out, None, {}))
    for field in _numbers(kind):
        flag = field.metadata[FLAG] or "--" + field.name.replace("_", "-")
        for value in ("nan", "1e400", "1" + 400 * "0"):
            text = ",".join([value] * 3) if field.metadata["parse"] else value
            with pytest.raises((NergError, typer.BadParameter)):
                run.main([f"{flag}={text}"], standalone_mode=False)
    assert not made


def test_every_number_of_the_command_line_shows_its_range():
    """Also where a command declares an option itself; those of readers of rays are checked by them."""
    of_readers = {option.name for option in shared_options()}
    options = [p for _, command, _ in commands() for p in command.params if isinstance(p, TyperOption)]
    numbers = [p for p in options if p.type_descriptor.annotation in (int, float) and p.name not in of_readers]
    limits = {(p.name, (i := p.type_descriptor.parameter_info).min, i.max) for p in numbers}
    assert len(limits) > 80 and [limit for limit in limits if None in limit] == []


def test_several_numbers_are_checked_one_by_one():
    from dataclasses import dataclass

    @dataclass(frozen=True)
    class Some(Checked):
        sizes: tuple[int, ...] = ranged((1, 2), Range(1, 9))

    assert Some(sizes=(1, 9)).sizes == (1, 9)
    for wrong in ((1, 10), (1, 2.5), 3, "12"):
        with pytest.raises(NergError, match="^sizes must"):
            Some(sizes=wrong)


def test_numbers_of_numpy_are_numbers():
    check_number(np.float32(2), Range(0, FARTHEST), "x")
    check_number(np.int64(2), Range(0, FARTHEST), "x", whole=True)
