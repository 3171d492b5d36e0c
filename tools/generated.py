"""Generate parts of the manual from the code: commands, plugins, presets, recipes, checks, statistics, registries.

    python -m tools.generated [--check]

In a page, a generated part is between `<!-- made by make docs: NAME -->` and `<!-- end -->`, and is replaced. With
`--check` nothing is written, and the exit code is 1 if a part is out of date.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before Dr.Jit and Mitsuba)
from tools import command_pages, manual
from tools.page import aligned, cells, table, table_or_list, wrapped

ROOT = Path(__file__).resolve().parents[1]
PLUGINS = ("nerg", "nerf", "splats", "gazefield", "gazekde", "panorama")


def plugins() -> str:
    """A section for each plugin: its parameters and its documentation."""
    _choose_variant()
    sections = []
    for name in PLUGINS:
        page = manual.parse_manual(import_module(f"nerg_mi.plugins.{name}").__doc__ or "")
        sections += [f"## {page.title}", page.parameter_list(), page.body]
    return "\n\n".join(sections)


def presets() -> str:
    """The presets of `nerg rays import`."""
    from nerg_mi.rays.readers.registry import format_preset_table

    return _relisted(format_preset_table())


def checks() -> str:
    """The data-quality checks."""
    from nerg_mi.rays.quality import format_check_table

    return _relisted(format_check_table())


def _relisted(text: str) -> str:
    """A Markdown table as a list where its lines are too long to be read."""
    head, _, *rows = map(cells, text.strip().split("\n"))
    listed = table_or_list(head, rows)
    # Only a cell of a table needs a backslash in front of a bar.
    return listed if listed.startswith("|") else listed.replace("\\|", "|")


def recipes() -> str:
    """The settings of each gaze recipe: field, length, losses and probes."""
    from nerg_mi.train import gaze_recipes

    entries = list(gaze_recipes.load_recipes().values())
    rows: list[tuple[str, ...]] = []
    parts = (("", "settings", "make_gaze_settings"), ("probes: ", "probes", "make_probe_settings"))
    for prefix, keys, build in parts:
        values = [getattr(recipe, build)() for recipe in entries]
        names = dict.fromkeys(name for recipe in entries for name in getattr(recipe, keys))
        rows += [(f"{prefix}`{name}`", *(_shown(getattr(v, name)) for v in values)) for name in names]
    configs = [_flat(recipe.list_architectures(gaze_recipes.FieldOptions())[0]) for recipe in entries]
    names = dict.fromkeys(name for config in configs for name in config)
    rows += [(f"field: `{name}`", *(_shown(c.get(name)) for c in configs)) for name in names]
    summaries = "\n".join(wrapped(f"- `{recipe.name}`: {recipe.summary}.") for recipe in entries)
    return f"{summaries}\n\n{table(('setting', *(f'`{recipe.name}`' for recipe in entries)), rows)}"


def _flat(config: object, prefix: str = "") -> dict[str, object]:
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


def registered() -> str:
    """The extension points with their registered entries."""
    _choose_variant()
    from nerg_mi.fields import gaze_base as gaze_fields
    from nerg_mi.measures.tables import MEASURES_BY_NAME
    from nerg_mi.rays.readers.registry import list_reader_names
    from nerg_mi.train import gaze_recipes
    from nerg_mi.transport.aovs import AOVS
    from nerg_mi.transport.depth import DEPTHS
    from nerg_mi.transport.quadrature import RULES

    rows = (
        ("gaze field", "nerg_mi/fields/gaze_base.py", gaze_fields.kinds()),
        ("quadrature rule", "nerg_mi/transport/quadrature.py", RULES.names()),
        ("depth", "nerg_mi/transport/depth.py", DEPTHS.names()),
        ("AOV", "nerg_mi/transport/aovs.py", AOVS),
        ("tracking reader", "nerg_mi/rays/readers/base.py", list_reader_names()),
        ("statistic", "nerg_mi/measures/tables.py", MEASURES_BY_NAME),
        ("gaze recipe", "nerg_mi/train/gaze_recipes.py", gaze_recipes.load_recipes()),
    )
    rows = [(what, f"`{file}`", ", ".join(f"`{name}`" for name in names)) for what, file, names in rows]
    return table_or_list(("what", "protocol, or table", "entries"), rows)


def _choose_variant() -> None:
    """Choose a Mitsuba variant, which the modules of plugins need to be imported."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")


def measures() -> str:
    """The statistics of `nerg stats` with their definitions."""
    from nerg_mi.measures.tables import MEASURES

    rows = [(m.title, m.definition, m.population, "yes" if m.is_compared else "") for m in MEASURES]
    return table_or_list(("statistic", "definition", "over", "compared"), rows)


PARTS: dict[str, Callable[[], str]] = {
    "plugins": plugins,
    "presets": presets,
    "checks": checks,
    "commands": command_pages.format_reference,
    "measures": measures,
    "recipes": recipes,
    "registered": registered,
}
"""Name of a part -> the function that generates its text."""

_PART = re.compile(r"(<!-- made by make docs: (\w+) -->\n)(.*?)(<!-- end -->)", re.S)


def pages() -> list[Path]:
    """The pages that can contain generated parts."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def regenerate(text: str) -> str:
    """The page `text` with each part generated again. Raises `KeyError` for an unknown part."""
    return _PART.sub(lambda m: f"{m[1]}\n{aligned(PARTS[m[2]]().strip())}\n\n{m[4]}", text)


def find_outdated(write: bool = False) -> list[str]:
    """The pages with a part that is out of date; `write` updates them."""
    outdated = []
    for page in pages():
        before = page.read_text(encoding="utf-8")
        after = regenerate(before)
        if after != before:
            outdated.append(str(page.relative_to(ROOT)))
            if write:
                page.write_text(after, encoding="utf-8")
    return outdated


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a page is out of date")
    options = parser.parse_args(arguments)
    outdated = find_outdated(write=not options.check)
    for page in outdated:
        print(f"{page} is out of date: run make docs" if options.check else f"wrote {page}")
    return int(options.check and bool(outdated))


if __name__ == "__main__":
    sys.exit(main())
