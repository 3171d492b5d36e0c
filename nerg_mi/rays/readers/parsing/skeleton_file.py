"""The skeleton file: one pose a line, ``id|time|[numbers]``.

The tracking format of the NeRG paper (Section 5.1): a person's id, an integer
time or frame number, and keypoints (there 22) of three coordinates each, or of
three and a confidence. A keypoint that was not seen is ``nan``, lies at exactly
0, 0, 0 or another fill value, or has no confidence. What the keypoints mean is the business of
:mod:`nerg_mi.rays.readers.parsing.bodies`.
"""

from __future__ import annotations

import gzip
import io
import itertools
import operator
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import replacing
from nerg_mi.files.bounded import plain
from nerg_mi.files.line_blocks import OnBadLine, line_blocks

from .fill_values import fill_values

KEYPOINTS = 22
_SNIFFED = 1000  # lines, of which the first one that is whole says how many numbers there are


class Layout(NamedTuple):
    """How the numbers of a line are divided."""

    keypoints: int = KEYPOINTS
    width: int = 3  # x, y, z; or 4, with a confidence

    @property
    def values(self) -> int:
        return self.keypoints * self.width

    def __str__(self) -> str:
        return f"{self.keypoints} keypoints of x, y, z" + (" and a confidence" if self.width == 4 else "")


PAPER_LAYOUT = Layout()


class SkeletonRows(NamedTuple):
    """A run of N poses of K keypoints."""

    ids: np.ndarray  # (N,) str
    times: np.ndarray  # (N,) int64, in the file's unit
    keypoints: np.ndarray  # (N, K, 3) float64, NaN where unseen
    lines: np.ndarray  # (N,) int64, the 1-based line of the file that each stands on
    confidence: np.ndarray  # (N, K) float64, of the keypoints that are wanted; one where the file has none


def write_skeleton(
    path: str | os.PathLike, ids: Sequence[str], times: np.ndarray, keypoints: np.ndarray, *, decimals: int = 6
) -> None:
    """Write poses in the order given; a name ending in ``.gz`` is compressed.

    ``ids``: N names without ``|`` or line breaks. ``times``: (N,) integers.
    ``keypoints``: (N, K, 3), NaN where unseen, or (N, K, 4) with confidences.
    ``decimals``: digits after the point; 6 (a micrometre) turns a head by at most 1e-5 rad.
    Equal input gives equal bytes. Raises ``ValueError`` for wrong shapes, times
    that are not integers, or an id that the format cannot hold.
    """
    keypoints = np.asarray(keypoints, dtype=np.float64)
    times = np.asarray(times)
    n = len(ids)
    if keypoints.ndim != 3 or len(keypoints) != n or keypoints.shape[2] not in (3, 4):
        raise ValueError(f"keypoints have shape {keypoints.shape}, expected ({n}, K, 3): one pose for each id")
    if times.shape != (n,) or not np.issubdtype(times.dtype, np.integer):
        raise ValueError(
            f"times must be {n} integers (the format has no fractions), got shape {times.shape} "
            f"of {times.dtype}; multiply seconds by the frame rate and round"
        )
    for i, name in enumerate(ids):
        if not str(name).strip() or any(c in str(name) for c in "|\r\n"):
            raise NergError(f"id {name!r} of pose {i} is empty or holds '|' or a line break; rename the person")

    flat = keypoints.reshape(n, -1)
    form = ", ".join([f"%.{decimals}f"] * flat.shape[1])
    with replacing(path) as temporary, _written(temporary, Path(path).name) as out:
        for name, time, values in zip(ids, times, flat):
            out.write(f"{name}|{int(time)}|[{form % tuple(values)}]\n")


def count_values(path: str | os.PathLike) -> int | None:
    """How many numbers the first line has that follows the format; None where none of the first lines does."""
    for block in line_blocks(path, "skeleton file", _SNIFFED):
        bodies = [fields[2].strip() for line in block if len(fields := line.split("|")) == 3]
        return next((body.count(",") + 1 for body in bodies if body[:1] == "[" and body[-1:] == "]"), None)
    return None


def iterate_skeleton(
    path: str | os.PathLike,
    chunk: int = 8192,
    keypoints: Sequence[int] | None = None,
    on_bad: OnBadLine | None = None,
    layout: Layout = PAPER_LAYOUT,
) -> Iterator[SkeletonRows]:
    """Yield the poses of a file in runs of at most ``chunk`` lines, so that
    memory stays bounded (a day of a store is some 2.6 million lines).

    ``keypoints``: which of those of the ``layout`` are wanted; the others are counted but not
    converted, and come out NaN. Empty lines are skipped. Raises `NergError` for a damaged file and, naming file and
    line, for a line that does not follow the format; where ``on_bad`` is given, that is told of such lines, which are
    left out.
    """
    wanted = range(layout.keypoints) if keypoints is None else sorted(set(keypoints))
    columns = [layout.width * k + i for k in wanted for i in range(layout.width)]
    before = 0
    for block in line_blocks(path, "skeleton file", chunk):
        ids: list[str] = []
        times: list[int] = []
        texts: list[str] = []
        lines: list[int] = []
        for number, line in enumerate(block, start=before + 1):
            line = line.strip()
            if not line:
                continue
            found = _fields(line, layout)
            if isinstance(found, str):
                _refuse(path, number, found, on_bad)
                continue
            ids.append(found[0])
            times.append(found[1])
            texts.append(found[2])
            lines.append(number)
        before += len(block)
        if ids:
            rows = _rows(path, ids, times, texts, lines, columns, on_bad, layout)
            if len(rows.ids):
                yield rows


def _fields(line: str, layout: Layout) -> tuple[str, int, str] | str:
    """Id, time and the text of the numbers of a line; or what is wrong with it."""
    fields = line.split("|")
    if len(fields) != 3:
        return f": {len(fields)} fields separated by '|', expected id|time|[{layout.values} numbers]"
    body = fields[2].strip()
    if not (body.startswith("[") and body.endswith("]")):
        return ": the keypoints are not enclosed in '[' and ']'"
    if body.count(",") != layout.values - 1:
        return f": {body.count(',') + 1} numbers, expected {layout.values} ({layout})"
    try:
        time = int(fields[1])
    except ValueError:
        return f": the time {plain(fields[1], 40)!r} is not an integer"
    if not -(1 << 63) <= time < 1 << 63:
        return f": the time {plain(fields[1], 40)!r} is too large for 64 bits"
    return fields[0].strip(), time, body[1:-1]


def _refuse(path: str | os.PathLike, line: int, why: str, on_bad: OnBadLine | None) -> None:
    if on_bad is None:
        raise NergError(
            f"{path}, line {line}{why}; mend or remove the line, or leave such lines out with --skip-bad-lines"
        )
    on_bad(line, why)


def read_skeleton(path: str | os.PathLike, layout: Layout = PAPER_LAYOUT) -> SkeletonRows:
    """All poses of a file at once; see :func:`iterate_skeleton` for the errors."""
    runs = list(iterate_skeleton(path, layout=layout))
    if not runs:
        raise NergError(f"{path} holds no poses; expected lines id|time|[{layout.values} numbers]")
    return SkeletonRows(*(np.concatenate(column) for column in zip(*runs)))


def _rows(
    path: str | os.PathLike,
    ids: list[str],
    times: list[int],
    texts: list[str],
    lines: list[int],
    columns: list[int],
    on_bad: OnBadLine | None,
    layout: Layout,
) -> SkeletonRows:
    # One conversion for the whole run; only when it fails is the line searched for.
    pick = operator.itemgetter(*columns)
    try:
        found = _numbers(texts, columns, pick, fast=len(columns) == layout.values)
    except ValueError:
        kept = []
        for i, (line, text) in enumerate(zip(lines, texts)):
            word = next((w for w in pick(text.split(",")) if not _is_number(w)), None)
            if word is None:
                kept.append(i)
            else:
                _refuse(path, line, f": {plain(word.strip(), 60)!r} is not a number", on_bad)
        ids, times, texts, lines = ([column[i] for i in kept] for column in (ids, times, texts, lines))
        # NumPy knows fewer spellings than Python.
        found = _numbers(texts, columns, pick, fast=False)
    values = np.full((len(ids), layout.values), np.nan)
    values[:, columns] = found
    values = values.reshape(len(ids), *layout)
    points, confidence = values[:, :, :3], values[:, :, 3] if layout.width == 4 else np.ones(values.shape[:2])
    points[np.isfinite(fill_values(points)) | ~(confidence > 0)] = np.nan
    return SkeletonRows(
        np.array(ids, dtype=str), np.array(times, dtype=np.int64), points, np.array(lines, dtype=np.int64), confidence
    )


def _numbers(texts: list[str], columns: list[int], pick: operator.itemgetter, fast: bool) -> np.ndarray:
    if fast:
        return np.loadtxt(texts, delimiter=",", comments=None, dtype=np.float64, ndmin=2)
    # Faster than loadtxt's usecols, which converts what it leaves out.
    words = itertools.chain.from_iterable(pick(text.split(",")) for text in texts)
    return np.fromiter(map(float, words), dtype=np.float64, count=len(texts) * len(columns)).reshape(-1, len(columns))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@contextmanager
def _written(path: Path, name: str) -> Iterator[IO[str]]:
    """A text file to write, compressed where ``name``, that which it will have, ends in ``.gz``."""
    with path.open("wb") as raw:
        if not name.endswith(".gz"):
            with io.TextIOWrapper(raw, encoding="utf-8", newline="\n") as out:
                yield out
            return
        # With its later name in it and no time: equal poses give equal bytes, whenever they are written.
        with io.TextIOWrapper(gzip.GzipFile(name, "wb", fileobj=raw, mtime=0), encoding="utf-8", newline="\n") as out:
            yield out
