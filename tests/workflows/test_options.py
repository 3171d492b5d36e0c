"""Typed options of every workflow: frozen, of keywords alone, each with its help."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import get_type_hints

import pytest

import nerg_mi.workflows
from nerg_mi.aoi.measured import StatisticsOptions
from nerg_mi.errors import NergError
from nerg_mi.ranges import Checked
from nerg_mi.workflows import options

MODULES = [
    importlib.import_module(f"nerg_mi.workflows.{m.name}") for m in pkgutil.iter_modules(nerg_mi.workflows.__path__)
]
MODULES.append(importlib.import_module(StatisticsOptions.__module__))
# What has to be said where the defaults alone mean nothing.
SAID = {"FilterOptions": {"thin": 1.0}, "SplitOptions": {"zones": 3}}
KINDS = [
    kind
    for module in MODULES
    for kind in vars(module).values()
    if is_dataclass(kind)
    and isinstance(kind, type)
    and issubclass(kind, Checked)
    and kind.__module__ == module.__name__
]


def test_there_are_options():
    assert {"GazeOptions", "GazeEvaluationOptions", "AblationOptions"} <= {k.__name__ for k in KINDS}


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_options_are_frozen_and_told(kind):
    made = kind(**SAID.get(kind.__name__, {}))
    with pytest.raises(TypeError):
        kind(1)
    for f in fields(kind):
        own = "--" + f.name.replace("_", "-")
        assert f.metadata["help"].strip() and not f.metadata["help"].startswith(own), f.name
        with pytest.raises(FrozenInstanceError):
            setattr(made, f.name, None)
    assert set(get_type_hints(kind)) == {f.name for f in fields(kind)}


def test_numbers():
    for text in ("1,-2.5,3e2", "1 -2.5 3e2"):
        assert options.parse_numbers(text, "--box") == (1.0, -2.5, 300.0)
    for text in ("", "1,,2", "a"):
        with pytest.raises(NergError, match="--box is numbers with commas between them"):
            options.parse_numbers(text, "--box")


@pytest.mark.parametrize("text", ["1,2", "1,2,1.1e7", "nan,0,0", "1" + 400 * "0" + ",0,0", "x" * 1500])
def test_points(text):
    assert options.parse_point("1,-2,1e7", "--up") == (1.0, -2.0, 1e7)
    for refused in (options.parse_point, lambda text, flag: StatisticsOptions(observers=(text,))):
        with pytest.raises(NergError, match="--observer (is|must)"):
            refused(text, "--observer")


def test_definitions():
    pairs = ["spp=4", "name=a=b", "empty="]
    assert options.parse_definitions(pairs, "--define") == {"spp": "4", "name": "a=b", "empty": ""}
    assert options.parse_definitions((), "--define") == {}
    for pair in ("level", "=3", ""):
        with pytest.raises(NergError, match="write -D key=value"):
            options.parse_definitions([pair], "--define")
