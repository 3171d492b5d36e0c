"""Every script imports nerg_mi before Dr.Jit and Mitsuba: it chooses the libLLVM, and refuses one that would abort the
process. And what scripts import of this repository is there, also what only a run to the end would come to."""

from __future__ import annotations

import ast
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tools.imports import modules

SCRIPTS = sorted(p for folder in ("benchmarks", "examples", "tools") for p in (ROOT / folder).glob("*.py"))


def packages(tree: ast.Module, everywhere: bool) -> list[tuple[int, int, str]]:
    """Line, place in it, and first name of what is imported; ``everywhere``: inside of functions too."""
    nodes = ast.walk(tree) if everywhere else tree.body
    found = [
        (n.lineno, n.col_offset + k, a.name.split(".")[0])
        for n in nodes
        if isinstance(n, ast.Import)
        for k, a in enumerate(n.names)
    ]
    found += [(n.lineno, n.col_offset, (n.module or "").split(".")[0]) for n in nodes_from(tree, everywhere)]
    return sorted(found)


def nodes_from(tree: ast.Module, everywhere: bool) -> list[ast.ImportFrom]:
    return [n for n in (ast.walk(tree) if everywhere else tree.body) if isinstance(n, ast.ImportFrom)]


def late(source: str) -> str | None:
    """What of ``source`` is imported before nerg_mi is, at the level of its module; None where nothing is."""
    tree = ast.parse(source)
    needing = [entry for entry in packages(tree, True) if entry[2] in ("drjit", "mitsuba")]
    ours = [entry for entry in packages(tree, False) if entry[2] == "nerg_mi"]
    if needing and not (ours and ours[0] < needing[0]):
        return f"line {needing[0][0]}: {needing[0][2]}"
    for node in ast.walk(tree):
        # Programs that are run in a process of their own.
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and "import mitsuba" in node.value.replace("drjit as dr, ", "")
        ):
            try:
                inner = late(node.value)
            except SyntaxError:  # prose
                continue
            if inner:
                return f"in the program at line {node.lineno}, {inner}"
    return None


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test01_libllvm_is_chosen_first(path):
    assert late(path.read_text()) is None


@pytest.mark.parametrize(
    "source, found",
    [
        ("import mitsuba as mi\nimport nerg_mi", "line 1: mitsuba"),
        ("def main():\n    import drjit as dr\n    import nerg_mi", "line 2: drjit"),
        ("from drjit import auto\n", "line 1: drjit"),
        (
            "import nerg_mi\nRUN = 'import drjit as dr, mitsuba as mi; import nerg_mi'",
            "in the program at line 2, line 1: drjit",
        ),
        ("import nerg_mi, mitsuba as mi", None),
        ("import nerg_mi.scenes\nimport mitsuba", None),
        ("'''An import mitsuba in prose.'''", None),
    ],
)
def test02_what_is_found(source, found):
    assert late(source) == found


def known() -> dict[str, Path]:
    """Name of each module that a script may import from this repository -> its file."""
    found = modules()
    for path in [*SCRIPTS, *(ROOT / "tools").rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    # Benchmarks find each other beside them.
    return found | {path.stem: path for path in (ROOT / "benchmarks").glob("*.py")}


KNOWN = known()
OURS = {name.split(".")[0] for name in KNOWN}


@cache
def bound(path: Path) -> set[str]:
    """Names that the file ``path`` binds at the level of its module."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {a.asname or a.name for a in node.names}
    return found


def missing(source: str) -> list[str]:
    """Modules and names of this repository that ``source`` imports, anywhere, and that are not there."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name.split(".")[0] in OURS and a.name not in KNOWN]
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS:
            there = bound(KNOWN[node.module]) if node.module in KNOWN else set()
            names = (f"{node.module}.{a.name}" for a in node.names if a.name not in there)
            found += [name for name in names if name not in KNOWN]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "import " in node.value:
            with suppress(SyntaxError):  # prose
                found += missing(node.value)
    return found


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test03_what_is_imported_is_there(path):
    assert missing(path.read_text()) == []


def test04_what_is_missing():
    source = (
        "def f():\n    from nerg_mi.maths import box, circle\n    import nerg_mi.nowhere\nRUN = 'import nerg_mi.gone'"
    )
    assert sorted(missing(source)) == ["nerg_mi.gone", "nerg_mi.maths.circle", "nerg_mi.nowhere"]
