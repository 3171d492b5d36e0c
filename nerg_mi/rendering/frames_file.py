"""Sequences of pictures: a CSV file whose header names `<default>`s of a scene and whose rows are their values in each
picture."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from nerg_mi.errors import NergError, plain
from nerg_mi.files.safe_read import read_bytes, reading
from nerg_mi.files.tables import write_csv

BYTES = 64 << 20
"""A file of frames may have so many bytes."""

FRAMES = 1_000_000
"""And so many frames."""

_COLUMNS = 64
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)


def read_frames(path: str | Path) -> list[dict[str, str]]:
    """Values by the name of their `<default>`, of each picture. Raises `NergError` for what is no such file, naming the
    line."""
    raw = read_bytes(path, "file of frames", BYTES)
    with reading(path, "file of frames", "correct it"):
        text = raw.decode("utf-8-sig")
    names: list[str] | None = None
    frames: list[dict[str, str]] = []
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        for cells in lines:
            if not any(cell.strip() for cell in cells):
                continue
            if names is None:
                names = _names(path, [cell.strip() for cell in cells])
                continue
            if len(cells) != len(names):
                raise NergError(
                    f'"{path}" (line {lines.line_num}) has {len(cells)} values for {len(names)} names; positions have '
                    'commas in them and need quotes: "1, 2, 3"'
                )
            if len(frames) == FRAMES:
                raise NergError(f'"{path}" has more than {FRAMES:,} frames; divide it')
            frames.append(dict(zip(names, cells)))
    except csv.Error as error:
        raise NergError(f'"{path}" (line {lines.line_num}) is no CSV: {plain(error)}; correct it') from error
    if not frames:
        raise NergError(f'"{path}" holds no frames: a line of names of <default>s, and a line for each picture')
    return frames


def _names(path: str | Path, names: list[str]) -> list[str]:
    bad = next((name for name in names if not _NAME.fullmatch(name)), None)
    if bad is not None or len(names) > _COLUMNS:
        what = f"{len(names)} names" if bad is None else f'"{plain(bad, 40)}"'
        raise NergError(f'"{path}" begins with {what}, where names of <default>s of the scene are needed, such as eye')
    if len(set(names)) < len(names):
        raise NergError(f'"{path}" names a <default> twice; leave one of the columns')
    return names


def write_frames(path: str | Path, frames: Sequence[Mapping[str, str]]) -> None:
    """Write ``frames``, whole or not at all."""
    write_csv(path, frames)


def numbered(output: Path, number: int, count: int) -> Path:
    """The file of the picture ``number``, from 1 on, of ``count``: walk.png, walk_0001.png."""
    return output.with_name(f"{output.stem}_{number:0{max(4, len(str(count)))}d}{output.suffix}")
