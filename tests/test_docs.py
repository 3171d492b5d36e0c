"""What the pages say of options and defaults is what the code has."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields

import pytest
import typer

import nerg_mi.cli
from nerg_mi.evaluation.study import subject as study_subject
from nerg_mi.formats.torch_ngp import unpickling
from nerg_mi.transport.march.settings import MarchSettings
from nerg_mi.transport.observer.surroundings import COUNT
from tests.conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FOREIGN = {"--tcnn", "--ff"}  # of torch-ngp
NUMBERS = "zero one two three four five six seven eight nine ten".split()


def options() -> set[str]:
    """Every option of every command and of every script."""
    found = {"--help"}

    def walk(command):
        for parameter in command.params:
            found.update(parameter.opts + parameter.secondary_opts)
        for other in getattr(command, "commands", {}).values():
            walk(other)

    for name in nerg_mi.cli.COMMANDS:
        walk(typer.main.get_command(nerg_mi.cli.build_app(name)))
    for folder in ("benchmarks", "examples", "tools", "scenes/store", "scenes/tabletop", "tests/renders"):
        for script in (ROOT / folder).glob("*.py"):
            found.update(re.findall(r'"(--[a-z][a-z0-9-]*)"', script.read_text()))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test01_options_that_are_named_exist(page):
    named = set(re.findall(r"(?<![\w-])(--[a-z][a-z0-9-]*)", page.read_text()))
    assert named <= options() | FOREIGN


def test03_defaults_of_the_march_are_the_integrators(rgb):
    made = rgb.load_dict({"type": "nerg", "density": {"type": "constvolume"}}).settings
    for f in fields(MarchSettings):
        if f.name != "step":
            assert getattr(made, f.name) == f.default, f.name


def test05_numbers_that_are_constants():
    page = lambda name: (ROOT / "docs" / name).read_text()
    assert f"a sum over {COUNT:,} directions" in page("gaze-evaluation.md")
    assert f"allow-list of {NUMBERS[len(unpickling._ALLOWED)]} names" in page("interchange.md")
    assert f"{study_subject.FINER} times shorter" in page("error-and-time.md")
    spp = (
        inspect.signature(__import__("nerg_mi.evaluation.images", fromlist=["x"]).score_views).parameters["spp"].default
    )
    assert f"{spp} rays a pixel (`--spp`)" in page("radiance-training.md")
    for script in ("fox_radiance.py", "store_radiance.py"):
        assert f'"--spp", type=int, default={spp}' in (ROOT / "benchmarks" / script).read_text(), script


def test06_tests_that_are_named_exist():
    named = {m for page in PAGES for m in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", page.read_text(encoding="utf-8"))}
    assert len(named) > 20
    missing = [
        f"{file}::{name}"
        for file, name in sorted(named)
        if f"\ndef {name}(" not in (ROOT / file).read_text(encoding="utf-8")
    ]
    assert not missing
