"""Write the reference of the manual, which is not in the repository, from the code: commands, Python, plugins, formats.

    python -m tools.reference [FOLDER]

writes its pages into docs/reference; `docs/conf.py` does so before each build of the manual. Texts are docstrings of
modules, of functions and of the options of commands; tables are those of the code.
"""

from __future__ import annotations

import ast
import functools
import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import nerg_mi as nerg  # chooses the libLLVM, so it comes before Dr.Jit and Mitsuba
from nerg_mi.files.atomic import write_text
from tools import command_pages, manual
from tools.page import aligned, cells, table, table_or_list, wrapped

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "reference"
PLUGINS = ("nerg", "nerf", "splats", "gazefield", "gazekde", "panorama")

FILES = {
    "formats": "Files of nerg_mi",
    "tracking/rays": "Gaze samples",
    "tracking/dataset": "Datasets of gaze samples",
    "aoi/areas": "Areas of interest",
    "aoi/changes": "Changes",
    "photos": "Posed photos",
    "photos/cameras": "Lenses",
    "photos/images": "Images, masks and depth maps",
    "photos/transforms": "Keys of transforms.json",
    "photos/dataset": "Coordinates and extent",
    "formats/meshes": "Meshes",
    "formats/splats": "Gaussian splats",
    "formats/torch_ngp": "Checkpoints of other programs",
}
"""Modules whose docstrings are the page on formats -> their headings."""

TRACKING = {
    "tracking/readers/columns": "Column maps",
    "tracking/readers/tables": "Rows that are dropped",
    "tracking/guess": "Proposals of nerg rays guess",
    "tracking/readers/scene_glasses": "Glasses with a scene camera",
}
"""The same of the page on recordings, which also has the modules with readers."""


# ---- Pages ----


def commands() -> str:
    """The command line: each command, option and default, and the settings of recipes."""
    intro = read_docstring(ROOT / "nerg_mi" / "cli" / "__init__.py")
    recipes = f"## Training recipes\n\nOf `nerg train gaze --recipe`.\n\n{format_recipes()}"
    return f"# Commands\n\n{intro}\n\n{command_pages.format_reference()}\n\n{recipes}"


def python() -> str:
    """Directives of Sphinx for each public name by package, and for the classes in their signatures."""
    public = [getattr(nerg, name) for name in nerg.__all__]
    sections = ["# Python", "`help(nerg.render)` shows the text of a name. With `import nerg_mi as nerg`:"]
    by_package: dict[str, list[Any]] = {}
    for value in [*public, *sorted(_named_classes(public), key=lambda v: v.__name__)]:
        by_package.setdefault(".".join(value.__module__.split(".")[:2]), []).append(value)
    for package, values in sorted(by_package.items()):
        title = (import_module(package).__doc__ or "").split(".")[0].split(":")[0].strip()
        directives = [_directive(value, value in public) for value in values]
        sections.append(f"## {title}\n\n```{{eval-rst}}\n{''.join(directives)}```")
    return "\n\n".join(sections)


def plugins() -> str:
    """A section for each plugin: its parameters and its documentation."""
    sections = ["# Plugins", "`import nerg_mi` registers these plugins in every variant of Mitsuba."]
    for name in PLUGINS:
        page = manual.parse_manual(_raw_docstring(ROOT / "plugins" / f"{name}.py"))
        sections += [f"## {page.title}", page.parameter_list(), page.body]
    return "\n\n".join(sections)


def formats() -> str:
    """Files that are read and written, other than recordings."""
    return "\n\n".join(["# Formats", *_sections(FILES)])


def recordings() -> str:
    """Tracking formats: common rules, each reader with its options, and the checks of data."""
    from nerg_mi.tracking.quality import format_check_table
    from nerg_mi.tracking.readers.registry import format_preset

    sections = ["# Formats of recordings", *_sections(TRACKING)]
    for module in reader_modules():
        presets = "\n".join(wrapped(f"- {format_preset(reader)}") for reader in import_module(module).READERS)
        title, text = split_title(read_docstring(_module_path(module)))
        sections.append(f"## {title}\n\n{text}\n\n{presets}")
    return "\n\n".join([*sections, "## Checks of data quality", _relisted(format_check_table())])


PAGES = {"commands": commands, "python": python, "plugins": plugins, "formats": formats, "recordings": recordings}
"""Name of a page, in the order of the manual's contents -> the function that generates its text."""


def write_pages(folder: Path = FOLDER) -> None:
    """Write all pages into ``folder``; those that have not changed keep their time."""
    choose_variant()
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in PAGES.items():
        path, text = folder / f"{name}.md", aligned(make()) + "\n"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)


@functools.cache
def find_sections() -> dict[str, str]:
    """Files, relative to the checkout -> page and anchor of their docstrings or tables in the reference."""
    sections = {
        "nerg_mi/cli/__init__.py": "commands.md",
        "nerg_mi/tracking/checks.py": "recordings.md#checks-of-data-quality",
        "nerg_mi/tracking/readers/__init__.py": "recordings.md",
        "nerg_mi/train/gaze_recipes.py": "commands.md#training-recipes",
    }
    for page, titles in (("formats", FILES), ("recordings", TRACKING)):
        sections |= {_relative(f"nerg_mi/{module}"): f"{page}.md#{anchor(title)}" for module, title in titles.items()}
    for module in reader_modules():
        path = _module_path(module)
        title = split_title(read_docstring(path))[0]
        sections[str(path.relative_to(ROOT))] = f"recordings.md#{anchor(title)}"
    for name in PLUGINS:
        title = manual.parse_manual(_raw_docstring(ROOT / "plugins" / f"{name}.py")).title
        sections[f"plugins/{name}.py"] = f"plugins.md#{anchor(title)}"
    return sections


# ---- Docstrings ----


def _raw_docstring(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def read_docstring(path: Path) -> str:
    """The docstring of the module ``path`` as Markdown, without importing it."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", _raw_docstring(path))
    return wrapped(re.sub(r"``([^`]+)``", r"`\1`", text))


def split_title(text: str) -> tuple[str, str]:
    """The title of a docstring that begins with "Title: text", and the text."""
    title, _, rest = text.partition(":")
    rest = rest.strip()
    return title, rest[:1].upper() + rest[1:]


def anchor(title: str) -> str:
    """The anchor of a heading, as Sphinx and code hosts form it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def _relative(module: str) -> str:
    return f"{module}/__init__.py" if (ROOT / module).is_dir() else f"{module}.py"


def _module_path(module: str) -> Path:
    return ROOT / (module.replace(".", "/") + ".py")


def _sections(titles: dict[str, str]) -> Iterator[str]:
    for module, title in titles.items():
        yield f"## {title}\n\n{read_docstring(ROOT / _relative(f'nerg_mi/{module}'))}"


def reader_modules() -> list[str]:
    """Modules with readers of recordings, by name."""
    from nerg_mi.tracking.readers.registry import iterate_readers

    return sorted({type(reader).__module__ for reader in iterate_readers()})


# ---- Python ----

_INTERNAL = {"GazeNetwork", "RadianceNetwork", "Range"}
"""Classes in signatures of public functions that are no part of the interface."""

_PARTS = ("aoi.attention.SurfaceAttention", "environment.gaze.GazeRegions", "evaluation.next_look.NextLook",
          "evaluation.next_look.PastLooks", "progress.Reporter")  # fmt: skip
"""Classes of the interface that no signature of a function names."""


def _named_classes(public: list[Any]) -> set[type]:
    """Classes of nerg_mi that the signatures of ``public`` functions name, and `_PARTS`."""
    classes = set()
    for path in _PARTS:
        module, _, name = path.rpartition(".")
        classes.add(getattr(import_module(f"nerg_mi.{module}"), name))
    for function in filter(inspect.isfunction, public):
        for name in set(re.findall(r"\b[A-Z]\w+", str(inspect.signature(function)))) - _INTERNAL:
            value = vars(sys.modules[function.__module__]).get(name)
            if inspect.isclass(value) and value.__module__.startswith("nerg_mi") and value not in public:
                classes.add(value)
    return classes


def _directive(value: Any, is_public: bool) -> str:
    kind = "function" if inspect.isfunction(value) else "exception" if issubclass(value, Exception) else "class"
    path = f"nerg_mi.{value.__name__}" if is_public else f"{value.__module__}.{value.__name__}"
    members = "   :members:\n" if kind == "class" else ""
    return f".. auto{kind}:: {path}\n{members}"


# ---- Tables ----


def _relisted(text: str) -> str:
    """A Markdown table as a list where its lines are too long to be read."""
    head, _, *rows = map(cells, text.strip().split("\n"))
    listed = table_or_list(head, rows)
    # Only a cell of a table needs a backslash in front of a bar.
    return listed if listed.startswith("|") else listed.replace("\\|", "|")


def format_recipes() -> str:
    """The settings of each gaze recipe: field, length, losses and probes."""
    from nerg_mi.train import gaze_recipes

    entries = list(gaze_recipes.load_recipes().values())
    rows: list[tuple[str, ...]] = []
    for prefix, part in (("", "settings"), ("probes: ", "probes")):
        values = [getattr(recipe, part) for recipe in entries]
        names = [f.name for f in fields(values[0]) if any(getattr(v, f.name) != f.default for v in values)]
        rows += [(f"{prefix}`{name}`", *(_shown(getattr(v, name)) for v in values)) for name in names]
    configs = [_flat(recipe.list_architectures("field")[0]) for recipe in entries]
    names = dict.fromkeys(name for config in configs for name in config)
    rows += [(f"field: `{name}`", *(_shown(c.get(name)) for c in configs)) for name in names]
    summaries = "\n".join(wrapped(f"- `{recipe.name}`: {recipe.summary}.") for recipe in entries)
    return f"{summaries}\n\n{table(('setting', *(f'`{recipe.name}`' for recipe in entries)), rows)}"


def _flat(config: Any, prefix: str = "") -> dict[str, object]:
    """The settings of a field; those of its parts as "part.setting"."""
    flat: dict[str, object] = {}
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            flat |= _flat(value, f"{prefix}{f.name}.")
        elif not isinstance(value, tuple):  # a box, which belongs to the environment
            flat[prefix + f.name] = value
    return flat


def _shown(value: object) -> str:
    """A setting in a cell of a table."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:,}" if isinstance(value, int) else f"{value:g}" if isinstance(value, float) else str(value)


def choose_variant() -> None:
    """Choose a Mitsuba variant, which the modules of plugins need to be imported."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")


if __name__ == "__main__":
    write_pages(*map(Path, sys.argv[1:2]))
