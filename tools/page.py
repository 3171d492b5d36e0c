"""Source of the pages of the manual: tables with aligned columns, and lines that are not too long."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from nerg_mi.files.tables import format_markdown_table as table

__all__ = ["aligned", "cells", "table", "table_or_list", "wrapped"]

WIDTH = 100
"""Columns of a line of source."""

_BAR = re.compile(r"(?<!\\)\|")
_RULE = re.compile(r":?-+:?")
# A code span, a short link or the target of a link stays on one line, and so does what would begin a list there.
_WORD = re.compile(r"(?:(`+)(?!`).+?(?<!`)\1(?!`)|\[[^\[\]]{1,40}\]\([^)\s]*\)|\]\([^)\s]*\)|\S)+")
_MARK = re.compile(r"[-+*#>|]+|\d+[.)]|=+")
_LONGEST_SPAN = 60


def cells(line: str) -> list[str]:
    """The cells of a line of a Markdown table, without the spaces around them."""
    return [cell.strip() for cell in _BAR.split(line.strip())[1:-1]]


def aligned(text: str) -> str:
    """`text` with the columns of each Markdown table padded to one width; columns with ``---:`` end at the right."""
    out: list[str] = []
    for is_table, lines in _runs(text.split("\n")):
        out += _aligned_table(lines) if is_table else lines
    return "\n".join(out)


def _runs(lines: Sequence[str]) -> Iterator[tuple[bool, list[str]]]:
    """`lines` in runs that are tables or not; what stands in fences is no table."""
    run: list[str] = []
    was_table = fenced = False
    for line in lines:
        fenced ^= line.lstrip().startswith("```")
        is_table = line.startswith("|") and not fenced
        if run and is_table != was_table:
            yield was_table, run
            run = []
        run.append(line)
        was_table = is_table
    if run:
        yield was_table, run


def _aligned_table(lines: Sequence[str]) -> list[str]:
    rows = [cells(line) for line in lines]
    if len(rows) < 2 or not all(_RULE.fullmatch(cell) for cell in rows[1]):
        return list(lines)
    columns = max(map(len, rows))
    rows = [[*row, *[""] * (columns - len(row))] for row in rows]
    at_right = [cell.endswith(":") for cell in rows[1]]
    texts = [*rows[:1], *rows[2:]]
    widths = [max(3, *(len(row[k]) for row in texts)) for k in range(columns)]
    padded = [
        " | ".join(cell.rjust(w) if right else cell.ljust(w) for cell, w, right in zip(row, widths, at_right))
        for row in texts
    ]
    rule = " | ".join("-" * (w - 1) + ":" if right else "-" * w for w, right in zip(widths, at_right))
    return [f"| {line} |" for line in (padded[0], rule, *padded[1:])]


def table_or_list(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An aligned table where its lines have `WIDTH` columns at most, else a list: the first cell of each row, then the
    others by their heads."""
    text = aligned(table(head, rows))
    if max(map(len, text.split("\n"))) <= WIDTH:
        return text
    items = []
    for first, second, *rest in rows:
        others = [f"{_capital(name)}: {cell}" for name, cell in zip(head[2:], rest) if cell]
        parts = [part.rstrip(".") + "." for part in ([second] if second else []) + others]
        term = first if first.startswith("`") else f"**{first}**"
        items.append(wrapped(f"- {term}: {' '.join(parts)}"))
    return "\n".join(items)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def wrapped(text: str, width: int = WIDTH) -> str:
    """`text` with paragraphs and items of lists broken at `width` columns; fences, tables, headings and comments stay.

    Code spans and targets of links are not broken, so that a line may be longer.
    """
    out: list[str] = []
    block: list[str] = []
    fenced = False

    def flush() -> None:
        if block:
            out.extend(_filled(block, width))
            block.clear()

    for line in text.split("\n"):
        if line.lstrip().startswith("```"):
            flush()
            fenced = not fenced
            out.append(line)
        elif (
            fenced or not line.strip() or line.startswith(("|", "#", "<!--")) or (not block and line.startswith("    "))
        ):
            flush()
            out.append(line)
        else:
            if re.match(r"\s*([-*+]|\d+[.)])\s", line):
                flush()
            block.append(line)
    flush()
    return "\n".join(out)


def _filled(lines: Sequence[str], width: int) -> list[str]:
    """A paragraph, or an item of a list, as lines."""
    start = re.match(r"\s*(?:(?:[-*+]|\d+[.)])\s+)?", lines[0])
    first = start[0] if start else ""
    rest = " " * len(first)
    words = [match[0] for match in _WORD.finditer(" ".join([lines[0][len(first) :], *(s.strip() for s in lines[1:])]))]
    joined: list[str] = []
    for word in words:
        spans = [len(span) for span in re.findall(r"`[^`]+`", word)]
        if joined and _MARK.fullmatch(word):
            joined[-1] += f" {word}"
        elif spans and max(spans) > _LONGEST_SPAN:
            joined += word.split()
        else:
            joined.append(word)
    out, line = [], first
    for word in joined:
        if line.strip() and line not in (first, rest) and len(line) + 1 + len(word) > width:
            out.append(line)
            line = rest
        line += word if line in (first, rest) else f" {word}"
    return [*out, line.rstrip()]
