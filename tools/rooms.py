"""The rooms of the package and which of them import which: a picture made of the sources."""

from __future__ import annotations

import ast
import sys

from tools.imports import PACKAGE, ROOT, all_imports, modules, room
from tools.svg import FAINT, INK, PALE, Drawing

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

BESIDE = {"scenes": "jobs", "plugins": "rendering"}
"""Rooms that the layers of pyproject.toml leave out, since rules of their own hold for them -> the room above them."""
SCRIPTS = (f"{PACKAGE}.scenes.store.make", f"{PACKAGE}.scenes.tabletop.make")
"""Modules that are run and not imported: like benchmarks, they stand above all rooms."""
MODULES = "errors ..."
"""What the picture calls the modules that lie in no room."""


UPWARD = "#c81e1e"
"""Colour of what should not be."""


def layers() -> list[str]:
    """The rooms from top to bottom, as the import rules of pyproject.toml have them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (levels,) = [c["layers"] for c in contracts if c["type"] == "layers" and c["containers"] == [PACKAGE]]
    names = [name.strip(" ()") for level in levels for name in level.replace(":", "|").split("|")]
    rooms = [name for name in names if (ROOT / PACKAGE / name / "__init__.py").is_file()]
    for name, above in BESIDE.items():
        rooms.insert(rooms.index(above) + 1, name)
    return [*rooms, MODULES]


def purpose(name: str) -> str:
    """The first sentence of a room's docstring, up to a semicolon."""
    if name == MODULES:
        return "What every room may use: errors told in one sentence, Ctrl-C, libLLVM, registration with Mitsuba."
    text = ast.get_docstring(ast.parse(modules()[f"{PACKAGE}.{name}"].read_text(encoding="utf-8"))) or ""
    return " ".join(text.split("\n\n")[0].split()).split(". ")[0].split("; ")[0].rstrip(".").replace("`", "") + "."


def inner(name: str) -> list[str]:
    """The folders within a room, two deep."""
    depth = len(f"{PACKAGE}.{name}".split("."))
    packages = [m.split(".")[depth:] for m, path in modules().items() if path.name == "__init__.py" and room(m) == name]
    return ["/".join(parts) for parts in sorted(packages) if 1 <= len(parts) <= 2]


def arrows() -> dict[tuple[str, str], str]:
    """Pairs of rooms of which the first imports the second -> "load", or "call" where it only does within
    functions."""
    known, found = set(layers()), {}
    for i in all_imports():
        if (
            i.when == "types"
            or i.source in (PACKAGE, *SCRIPTS)
            or (i.names and all(n.startswith("__") for n in i.names))
        ):
            continue
        source, target = (r if r in known else MODULES for r in (room(i.source), room(i.target)))
        if source != target and found.get((source, target)) != "load":
            found[source, target] = i.when
    return found


def draw() -> str:
    """The picture: a row for each room, with a dot under each room that it imports from."""
    rooms, pairs = layers(), arrows()
    row, left, dots, column = 40, 20, 700, 24
    drawing = Drawing(dots + column * len(rooms) + 40, 110 + row * len(rooms) + 46, "The rooms of nerg_mi")
    drawing.words(left, 40, "The rooms of nerg_mi", size=18, bold=True)
    drawing.words(left, 62, "Each imports only from rooms below it.", color=PALE)
    for k, name in enumerate(rooms):
        y, x = 110 + row * k, dots + column * (k + 0.5)
        drawing.rectangle(left, y, dots - left - 20, row - 6, fill="#f0f4f8", line=FAINT)
        drawing.words(left + 10, y + 21, name, size=13, bold=True)
        drawing.words(left + 112, y + 15, purpose(name), size=10)
        drawing.words(left + 112, y + 28, " · ".join(inner(name)), size=9, color=PALE)
        drawing.words(x + 4, 102, name, size=10, turned=-60)
        drawing.line(dots, y + row / 2 - 3, dots + column * len(rooms), y + row / 2 - 3)
        drawing.line(x, 110, x, 110 + row * len(rooms) - 6)
        drawing.rectangle(x - 5, y + row / 2 - 8, 10, 10, fill=FAINT)
    for (source, target), when in sorted(pairs.items()):
        x, y = dots + column * (rooms.index(target) + 0.5), 110 + row * rooms.index(source) + row / 2 - 3
        color = INK if rooms.index(target) > rooms.index(source) else UPWARD
        drawing.dot(x, y, 5, fill=color if when == "load" else "#ffffff", line=color)
    y = 110 + row * len(rooms) + 18
    drawing.dot(dots + 6, y, 5)
    drawing.words(dots + 18, y + 4, "imports when it is loaded", size=10, color=PALE)
    drawing.dot(dots + 206, y, 5, fill="#ffffff", line=INK)
    drawing.words(dots + 218, y + 4, "only within functions", size=10, color=PALE)
    return drawing.text()
