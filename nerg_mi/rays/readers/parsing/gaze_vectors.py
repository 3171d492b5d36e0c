"""Gaze vectors as Qualisys Track Manager exports them: a header of words and values, then numbers between tabs.

After QTM's manual ("Gaze vector data (_g.tsv)"). The header, the names of the columns and the time are options of the
export, so that each may be missing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.files.line_blocks import OnBadLine, line_blocks

_COLUMNS = ("x pos", "y pos", "z pos", "x vec", "y vec", "z vec")
_BLOCK = 1 << 16  # lines converted at a time
_HEADER_LINES = 200
_MISSING = {"", "nan", "null", "-"}
_WHAT = "file of gaze vectors"


class GazeVectors(NamedTuple):
    """A run of n samples."""

    times: np.ndarray  # (n,) seconds
    vectors: np.ndarray  # (n, 6) position in mm and direction, NaN where a cell is empty
    samples: np.ndarray  # (n,) which of the file they are, from 0
    lines: np.ndarray  # (n,) of the file, from 1


@dataclass(frozen=True)
class _Layout:
    """Where samples begin, and what stands in their cells."""

    first: int  # line of the first sample
    cells: tuple[int, ...]  # of `_COLUMNS`
    time: int | None  # cell of the seconds
    step: float  # seconds from sample to sample, where no cell tells
    start: float  # seconds of the first
    width: int  # cells of a line


def iterate_gaze_vectors(path: Path, on_bad: OnBadLine | None = None) -> Iterator[GazeVectors]:
    """The samples of ``path`` in blocks.

    Raises `NergError` for what is no such file, for times that nothing tells, and, unless ``on_bad`` is given, for a
    line that cannot be read; ``on_bad`` is told of such lines, which are left out.
    """
    layout, count, sample = _read_layout(path), 0, 0
    with closing(line_blocks(path, _WHAT, _BLOCK)) as blocks:
        for lines in blocks:
            found: list[tuple[float, list[float], int, int]] = []
            for number, line in enumerate(lines, count + 1):
                if number < layout.first or not line.strip("\r\n "):
                    continue
                try:
                    cells = _cells(line)
                    if not layout.width <= len(cells) <= layout.width + (not cells[-1]):
                        raise ValueError(f"{len(cells)} cells, not {layout.width}")
                    time = layout.start + sample * layout.step if layout.time is None else _number(cells[layout.time])
                    found.append((time, [_number(cells[i]) for i in layout.cells], sample, number))
                except ValueError as error:
                    why = f": {plain(line, 60)!r} is no sample ({plain(error)}); correct or remove the line"
                    if on_bad is None:
                        raise NergError(
                            f"{path}, line {number}{why}, or leave such lines out with --skip-bad-lines"
                        ) from None
                    on_bad(number, why)
                sample += 1
            count += len(lines)
            if found:
                times, vectors, samples, numbers = zip(*found)
                yield GazeVectors(np.array(times), np.array(vectors), np.array(samples), np.array(numbers))


def _read_layout(path: Path) -> _Layout:
    """What the head of the file, or its first sample, tells."""
    with closing(line_blocks(path, _WHAT, _HEADER_LINES)) as blocks:
        head = next(blocks, [])
    about: dict[str, str] = {}
    for number, line in enumerate(head, 1):
        cells = _cells(line)
        names = [re.sub(r"\s+", " ", cell).lower() for cell in cells]
        where = [next((i for i, name in enumerate(names) if name.endswith(wanted)), None) for wanted in _COLUMNS]
        if all(i is not None for i in where):
            time = names.index("time") if "time" in names else None
            return _layout(
                path, number + 1, tuple(i for i in where if i is not None), time, about, len(cells) - (not cells[-1])
            )
        if re.match(r"[A-Za-z_]", cells[0]) and cells[0].lower() not in _MISSING:
            about[cells[0].upper()] = cells[1] if len(cells) > 1 else ""
        elif len(cells) in (6, 8):
            # Without names: six numbers, or a sample's number and its time before them.
            time = 1 if len(cells) == 8 else None
            return _layout(path, number, tuple(range(len(cells) - 6, len(cells))), time, about, len(cells))
        elif line.strip():
            break
    raise NergError(
        f"{path} has no gaze vectors (X Pos, Y Pos, Z Pos, X Vec, Y Vec, Z Vec between tabs); export them from QTM "
        "(TSV, eye tracker), with column headers"
    )


def _layout(
    path: Path, first: int, cells: tuple[int, ...], time: int | None, about: dict[str, str], width: int
) -> _Layout:
    if time is not None:
        return _Layout(first, cells, time, 0.0, 0.0, width)
    try:
        rate, offset = float(about.get("FREQUENCY", "")), float(about.get("START_OFFSET", "") or 0)
    except ValueError:
        rate, offset = 0.0, 0.0
    if not (0 < rate < 1e6 and abs(offset) < 1e9):
        raise NergError(
            f"{path} tells no time: neither a column Time nor a FREQUENCY in its header; export it from QTM with "
            "its header"
        )
    return _Layout(first, cells, None, 1 / rate, -offset, width)


def _cells(line: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.lstrip("\ufeff").rstrip("\r\n").split("\t")]


def _number(cell: str) -> float:
    return np.nan if cell.lower() in _MISSING else float(cell)
