"""The typed options of all jobs: frozen, of keywords alone, each with a meaning, and light to load."""

import dataclasses
import importlib
import pkgutil
import subprocess
import sys

import pytest

from nerg_mi.jobs import options

MODULES = [f"{options.__name__}.{m.name}" for m in pkgutil.iter_modules(options.__path__)]
KINDS = [
    kind
    for name in MODULES
    for kind in vars(importlib.import_module(name)).values()
    if dataclasses.is_dataclass(kind) and kind.__module__ == name
]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_each_option_has_a_default_and_a_meaning(kind):
    assert kind() == kind() and kind.__doc__
    for field in dataclasses.fields(kind):
        assert field.kw_only and field.metadata["help"].partition("  [default: ")[0].endswith("."), field.name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(kind(), dataclasses.fields(kind)[0].name, None)
    with pytest.raises(TypeError):
        kind(None)


def test_there_are_some_of_every_job():
    assert len(KINDS) >= len(MODULES) > 5


def test_they_load_nothing_heavy():
    code = f"import sys, {', '.join(MODULES)}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"mitsuba", "drjit", "numpy", "scipy", "typer"} & set(loaded)
