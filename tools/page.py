"""Tables of the documentation that commands print: put in place of the one that stands there."""

from __future__ import annotations

from pathlib import Path

from nerg_mi.files.atomic import write_text
from nerg_mi.files.tables import format_markdown_table as table

__all__ = ["replace_table", "table", "update"]


def replace_table(document: str, title: str, text: str) -> str:
    """``document`` with the first table below the heading ``title`` exchanged for ``text``, or ``text`` added there.

    The heading is of the second or third level. Raises ``ValueError`` where there is no such heading.
    """
    lines = document.split("\n")
    mark = next((mark for mark in ("##", "###") if f"{mark} {title}" in lines), None)
    if mark is None:
        raise ValueError(f'the document has no heading "## {title}" to put a table under; add it')
    start = lines.index(f"{mark} {title}") + 1
    # What ends its part of the page: a heading of its own level or above.
    ends = tuple(f"{'#' * level} " for level in range(2, len(mark) + 1))
    stop = next((k for k in range(start, len(lines)) if lines[k].startswith(ends)), len(lines))
    first = next((k for k in range(start, stop) if lines[k].startswith("|")), None)
    if first is None:
        last = stop
        while last > start and not lines[last - 1].strip():
            last -= 1
        return "\n".join([*lines[:last], "", *text.split("\n"), "", *lines[stop:]]).rstrip("\n") + "\n"
    end = next((k for k in range(first, stop) if not lines[k].startswith("|")), stop)
    return "\n".join([*lines[:first], *text.split("\n"), *lines[end:]])


def update_table(path: str | Path | None, title: str, text: str) -> None:
    """Print ``text``, and put it into the page ``path`` (None: only print)."""
    print(text)
    if path is not None:
        path = Path(path)
        write_text(path, replace_table(path.read_text(encoding="utf-8"), title, text))
