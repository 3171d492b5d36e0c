"""Generate the parts of pages in the repository that are derived from the code: devices, statistics, extension points.

    python -m tools.generated [--check]

In a page, a generated part is between `<!-- made by make docs: NAME -->` and `<!-- end -->`, and is replaced. With
`--check` nothing is written, and the exit code is 1 if a part is out of date. `tools/reference.py` writes whole pages.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before Dr.Jit and Mitsuba)
from tools.page import aligned, table, table_or_list
from tools.reference import FOLDER, ROOT, choose_variant


def devices() -> str:
    """The readers of recordings, and what each was tried on."""
    from nerg_mi.tracking.readers.base import FROM_RECORDINGS
    from nerg_mi.tracking.readers.registry import iterate_readers

    summarise = lambda files: re.split(r"[:;(]|, (?!and)", files)[0].strip()
    rows = [(f"`{reader.name}`", summarise(reader.files), reader.evidence) for reader in iterate_readers()]
    rows.sort(key=lambda row: not row[2].startswith(FROM_RECORDINGS))
    tested = sum(row[2].startswith(FROM_RECORDINGS) for row in rows)
    count = f"Of {len(rows)} readers, {tested} were tested on real recordings of their device."
    return f"{count}\n\n{table(('preset', 'files', 'evidence'), rows)}"


def registered() -> str:
    """The extension points with their registered entries."""
    choose_variant()
    from nerg_mi.aoi.tables import MEASURES_BY_NAME
    from nerg_mi.fields import gaze_base as gaze_fields
    from nerg_mi.tracking.readers.registry import list_reader_names
    from nerg_mi.train import gaze_recipes
    from nerg_mi.transport.aovs import AOVS
    from nerg_mi.transport.depth import DEPTHS
    from nerg_mi.transport.quadrature import RULES

    rows = (
        ("gaze field", "nerg_mi/fields/gaze_base.py", gaze_fields.kinds()),
        ("quadrature rule", "nerg_mi/transport/quadrature.py", RULES.names()),
        ("depth", "nerg_mi/transport/depth.py", DEPTHS.names()),
        ("AOV", "nerg_mi/transport/aovs.py", AOVS),
        ("tracking reader", "nerg_mi/tracking/readers/base.py", list_reader_names()),
        ("statistic", "nerg_mi/aoi/tables.py", MEASURES_BY_NAME),
        ("gaze recipe", "nerg_mi/train/gaze_recipes.py", gaze_recipes.load_recipes()),
    )
    rows = [(what, f"`{file}`", ", ".join(f"`{name}`" for name in names)) for what, file, names in rows]
    return table_or_list(("what", "protocol, or table", "entries"), rows)


def measures() -> str:
    """The statistics of `nerg stats` with their definitions."""
    from nerg_mi.aoi.tables import MEASURES

    rows = [(m.title, m.definition, m.population, "yes" if m.is_compared else "") for m in MEASURES]
    return table_or_list(("statistic", "definition", "over", "compared"), rows)


PARTS: dict[str, Callable[[], str]] = {"devices": devices, "measures": measures, "registered": registered}
"""Name of a part -> the function that generates its text."""

_PART = re.compile(r"(<!-- made by make docs: (\w+) -->\n)(.*?)(<!-- end -->)", re.S)


def pages() -> list[Path]:
    """The pages of the repository, without the reference."""
    manual = [page for page in sorted((ROOT / "docs").rglob("*.md")) if FOLDER not in page.parents]
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *manual]


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
