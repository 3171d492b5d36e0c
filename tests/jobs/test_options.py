"""Typed options of every job: frozen, of keywords alone, each told once, and light to import."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import get_type_hints

import pytest

from nerg_mi.jobs import options

MODULES = [importlib.import_module(f"{options.__name__}.{m.name}") for m in pkgutil.iter_modules(options.__path__)]
KINDS = [k for m in MODULES for k in vars(m).values() if is_dataclass(k) and k.__module__ == m.__name__]


def test_there_are_options():
    assert {"GazeOptions", "GazeEvaluationOptions", "AblationOptions"} <= {k.__name__ for k in KINDS}


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_options_are_frozen_and_told(kind):
    made = kind()
    with pytest.raises(TypeError):
        kind(1)
    for f in fields(kind):
        assert f.metadata["help"].strip() and not f.metadata["help"].startswith("--"), f.name
        with pytest.raises(FrozenInstanceError):
            setattr(made, f.name, None)
    assert set(get_type_hints(kind)) == {f.name for f in fields(kind)}


@pytest.mark.parametrize("module", MODULES, ids=lambda m: m.__name__)
def test_they_import_nothing_heavy(module):
    """A command shows its help by them."""
    code = f"import sys, {module.__name__}; print(*{{'numpy', 'drjit', 'mitsuba'}} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == ""
