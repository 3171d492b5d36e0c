"""Imports of scripts exist, including those that only a full run reaches; and nerg_mi, which selects the libLLVM, is
imported before Dr.Jit and Mitsuba."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec

import pytest

from tests.conftest import ROOT

SCRIPTS = sorted(p for folder in ("benchmarks", "examples", "tools") for p in (ROOT / folder).glob("*.py"))
EXTRAS = {
    "bpy",
    "torch",
    "pyarrow",
    "distributed",
    "importlinter",
    "nbformat",
    "jupyter_client",
    "nbclient",
    "pymovements",
    "eyedentify3d",
    "gazeaudit",
    "viser",
}
OURS = {"nerg_mi", "tests", "tools", *(p.stem for p in (ROOT / "benchmarks").glob("*.py"))}


def imports(source: str) -> Iterator[tuple[str, str | None]]:
    """Modules that ``source`` imports anywhere, also in programs for other processes, with each name imported from
    them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((a.name, None) for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, a.name) for a in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "import " in node.value:
            with suppress(SyntaxError):  # prose
                yield from imports(node.value)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_imported_names_exist(rgb, monkeypatch, path):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    for module, name in imports(path.read_text(encoding="utf-8")):
        top = module.split(".")[0]
        assert top in EXTRAS or find_spec(top), f"there is no {top}"
        if top in OURS and not (name and hasattr(import_module(module), name)):
            import_module(f"{module}.{name}" if name else module)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_libllvm_is_selected_first(path):
    order = [module.split(".")[0] for module, _ in imports(path.read_text(encoding="utf-8"))]
    if {"drjit", "mitsuba"} & {*order}:
        assert "nerg_mi" in order[: min(order.index(name) for name in ("drjit", "mitsuba") if name in order)]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_no_value_is_expected_of_procedures(rgb, path):
    """A function of nerg_mi that is annotated to return nothing is not assigned."""
    source = path.read_text(encoding="utf-8")
    origins = {name: module for module, name in imports(source) if name and module.startswith("nerg_mi")}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assign) and isinstance(call := node.value, ast.Call):
            name = call.func.id if isinstance(call.func, ast.Name) else None
            if name in origins:
                function = getattr(import_module(origins[name]), name, None)
                assert getattr(function, "__annotations__", {}).get("return", "") != "None", ast.unparse(node)
