"""Which module imports which, read from the syntax trees: nothing is imported to find out.

Names are those of the installed package: `plugins/nerg.py` is `nerg_mi.plugins.nerg`.
"""

from __future__ import annotations

import ast
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "nerg_mi"
FOLDERS = {PACKAGE: PACKAGE, "plugins": f"{PACKAGE}/plugins", "scenes": f"{PACKAGE}/scenes"}
"""Folder of the checkout -> folder in the installed package, as pyproject.toml maps them."""


@dataclass(frozen=True)
class Import:
    """The statement in line `line` of the module `source` that imports the module `target`.

    `names`: what is taken out of `target` (none where it is imported as a whole). `when`: "load", with the module;
    "call", within a function; "types", only for type checkers.
    """

    source: str
    target: str
    line: int
    names: tuple[str, ...]
    when: str


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Name of each module and package of the installed package -> its file in the checkout `root`."""
    found = {}
    for folder, installed in FOLDERS.items():
        for path in sorted((root / folder).rglob("*.py")):
            inner = path.relative_to(root / folder).with_suffix("").parts
            parts = [*installed.split("/"), *inner]
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def assemble(folder: Path, root: Path = ROOT) -> Path:
    """Copy the package's sources into `folder` as they are installed; the folder that holds `nerg_mi`."""
    for name, path in modules(root).items():
        target = folder.joinpath(*name.split("."))
        target = target / "__init__.py" if path.name == "__init__.py" else target.with_suffix(".py")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    return folder


def room(module: str) -> str:
    """The first folder below the package that a module lies in, or the module's own name at the root: "transport"."""
    return module.split(".")[1] if "." in module else module


def imports_of(module: str, path: Path, known: dict[str, Path]) -> list[Import]:
    """The imports of modules in `known` by the module of that name and file."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found = []
    for node, when in _statements(ast.parse(path.read_text(encoding="utf-8")).body, "load"):
        if isinstance(node, ast.Import):
            taken = [(alias.name, None) for alias in node.names]
        else:
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            taken = [(base, alias.name) for alias in node.names]
        names: dict[str, list[str]] = {}
        for base, name in taken:
            if name is not None and f"{base}.{name}" in known:
                names.setdefault(f"{base}.{name}", [])
            elif base in known:
                names.setdefault(base, []).extend(filter(None, [name]))
        found += [Import(module, target, node.lineno, tuple(what), when) for target, what in names.items()]
    return found


def _statements(body: list, when: str) -> Iterator[tuple[ast.Import | ast.ImportFrom, str]]:
    """Every import below these nodes, with the moment at which it is carried out."""
    for node in body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            yield node, when
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            yield from _statements(list(ast.iter_child_nodes(node)), "call" if when == "load" else when)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from _statements(node.body, "types")
            yield from _statements(node.orelse, when)
        else:
            yield from _statements(list(ast.iter_child_nodes(node)), when)


def all_imports(root: Path = ROOT) -> list[Import]:
    """Every import of one module of the package by another."""
    known = modules(root)
    return [i for name, path in known.items() for i in imports_of(name, path, known)]


def circles(pairs: set[tuple[str, str]]) -> list[list[str]]:
    """The groups of nodes of a graph, given as its arrows, from each of which every other can be reached.

    Tarjan, "Depth-first search and linear graph algorithms", SIAM Journal on Computing 1 (1972).
    """
    after: dict[str, list[str]] = {}
    for source, target in sorted(pairs):
        after.setdefault(source, []).append(target)
        after.setdefault(target, [])
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(node: str) -> None:
        number[node] = low[node] = len(number)
        stack.append(node)
        for other in after[node]:
            if other not in number:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], number[other])
        if low[node] == number[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1 or node in after[node]:
                found.append(sorted(group))

    for node in after:
        if node not in number:
            visit(node)
    return sorted(found)
