"""Gaze in the space of a motion capture system: Qualisys' gaze vectors, and Pupil Labs' Neon located by any system."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import BadLineCallback, read_line_blocks, resolve_path

from .base import DESCRIPTION, RaysBuilder, Signature, TrackingFrame, option
from .columns import ColumnFinder
from .table import person_from_filename

# ---- Gaze vectors ----
#
# Gaze vectors as Qualisys Track Manager exports them: a header of words and values, then numbers between tabs.
#
# After QTM's manual ("Gaze vector data (_g.tsv)"). The header, the names of the columns and the time are options of the
# export, so that each may be missing.

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
class GazeVectorLayout:
    """Where samples begin, and what stands in their cells."""

    first: int  # line of the first sample
    cells: tuple[int, ...]  # of `_COLUMNS`
    time: int | None  # cell of the seconds
    step: float  # seconds from sample to sample, where no cell tells
    start: float  # seconds of the first
    width: int  # cells of a line


def iterate_gaze_vectors(path: Path, on_bad: BadLineCallback | None = None) -> Iterator[GazeVectors]:
    """The samples of ``path`` in blocks.

    Raises `NergError` for what is no such file, for times that nothing tells, and, unless ``on_bad`` is given, for a
    line that cannot be read; ``on_bad`` is told of such lines, which are left out.
    """
    layout, count, sample = _read_layout(path), 0, 0
    with closing(read_line_blocks(path, _WHAT, _BLOCK)) as blocks:
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
                    why = f": {sanitize(line, 60)!r} is no sample ({sanitize(error)}); correct or remove the line"
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


def _read_layout(path: Path) -> GazeVectorLayout:
    """What the head of the file, or its first sample, tells."""
    with closing(read_line_blocks(path, _WHAT, _HEADER_LINES)) as blocks:
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
) -> GazeVectorLayout:
    if time is not None:
        return GazeVectorLayout(first, cells, time, 0.0, 0.0, width)
    try:
        rate, offset = float(about.get("FREQUENCY", "")), float(about.get("START_OFFSET", "") or 0)
    except ValueError:
        rate, offset = 0.0, 0.0
    if not (0 < rate < 1e6 and abs(offset) < 1e9):
        raise NergError(
            f"{path} tells no time: neither a column Time nor a FREQUENCY in its header; export it from QTM with "
            "its header"
        )
    return GazeVectorLayout(first, cells, None, 1 / rate, -offset, width)


def _cells(line: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.lstrip("\ufeff").rstrip("\r\n").split("\t")]


def _number(cell: str) -> float:
    return np.nan if cell.lower() in _MISSING else float(cell)


# ---- Readers ----

_EYE = re.compile(r"_g(_[12])?$")


@dataclass(frozen=True, kw_only=True)
class QualisysOptions:
    """How the laboratory's space was calibrated."""

    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", recorded=False)


class Qualisys:
    """``*_g.tsv`` of QTM, or ``*_g_1.tsv`` and ``*_g_2.tsv`` of two eyes; a folder has all of those in it.

    Columns ``X Pos`` to ``Z Vec``, in millimetres and in the laboratory's frame (right-handed; z is up where its
    calibration was left as it is), and where they were exported a sample's number and time; else samples are counted at
    the header's ``FREQUENCY`` from ``-START_OFFSET``. Column names may be missing. The files of two eyes become one
    ray: from midway between them, along the mean of their directions; where one of them was not seen, the other's
    alone. The person is the file's name before ``_g``.
    """

    name = "qualisys"
    files = "gaze vectors of Qualisys Track Manager, `*_g.tsv` or `*_g_1.tsv` and `*_g_2.tsv`, or folders of them"
    world = "the laboratory's, right-handed, mm, whose axis `--up` points up"
    checked_on = DESCRIPTION
    signature = Signature(
        line=lambda line: "its first line names a gaze vector" if line.startswith("GAZE_VECTOR_NAME\t") else None
    )
    Options = QualisysOptions

    def frame(self, files: Sequence[Path], options: QualisysOptions) -> TrackingFrame:
        return TrackingFrame(up=options.up, units="mm")

    def read(self, files: Sequence[Path], options: QualisysOptions, builder: RaysBuilder) -> None:
        paths = list(dict.fromkeys(path for given in files for path in _gaze_files(given)))
        for path in paths:
            left, right = (path.with_name(_EYE.sub(eye, path.stem) + path.suffix) for eye in ("_g_1", "_g_2"))
            if left == right or path not in (left, right) or not {left, right} <= set(paths):
                _add_eye(path, None, builder)
            elif path == left:
                _add_eye(left, _whole(right, builder), builder)


def _gaze_files(given: Path) -> list[Path]:
    if not given.is_dir():
        return [given]
    found = sorted(p for p in given.iterdir() if p.suffix.lower() == ".tsv" and _EYE.search(p.stem))
    if not found:
        raise NergError(f"there are no gaze vectors (*_g.tsv) in {given}; export them from QTM (TSV, eye tracker)")
    return found


def _whole(path: Path, builder: RaysBuilder) -> np.ndarray:
    """Positions and directions of an eye by the number of the sample (n, 6); NaN where there is none."""
    builder.source(path)
    blocks = list(iterate_gaze_vectors(path, builder.on_bad))
    whole = np.full((max((int(block.samples[-1]) + 1 for block in blocks), default=0), 6), np.nan)
    for block in blocks:
        whole[block.samples] = block.vectors
        builder.count_lines(len(block.lines))
    return whole


def _add_eye(path: Path, other: np.ndarray | None, builder: RaysBuilder) -> None:
    """Add the samples of an eye, with those of the ``other`` one (n, 6)."""
    builder.source(path)
    for block in iterate_gaze_vectors(path, builder.on_bad):
        eyes = block.vectors[:, None]
        if other is not None:
            beside = np.full(block.vectors.shape, np.nan)
            there = block.samples < len(other)
            beside[there] = other[block.samples[there]]
            eyes = np.stack([block.vectors, beside], axis=1)
        seen = np.isfinite(eyes).all(axis=2) & (np.abs(eyes[:, :, 3:]).max(axis=2) > 0)
        share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        known = np.where(seen[:, :, None], eyes, 1.0)
        direction = known[:, :, 3:] / np.linalg.norm(known[:, :, 3:], axis=2, keepdims=True)
        builder.add(
            block.times,
            _EYE.sub("", path.stem),
            (share[:, :, None] * known[:, :, :3]).sum(axis=1),
            (share[:, :, None] * direction).sum(axis=1),
            rows=block.lines,
            drop={"no eye was seen": ~seen.any(axis=1)},
        )


@dataclass(frozen=True, kw_only=True)
class NeonMocapOptions:
    """What the table does not say of the laboratory."""

    up: str | None = option(None, "Up axis: x, y, z, -x, -y or -z.", recorded=False)  # needed
    units: str = option("mm", "Unit of length: m, cm or mm.", recorded=False)


class NeonMocap:
    """``gaze_in_mocap_space.csv``, which Pupil Labs' neon_mocap_localization makes of Neon's gaze and the poses of its
    markers, whatever the name it is given.

    ``gaze_origin_X`` to ``gaze_dir_Z`` in the motion capture's frame and unit, ``timestamp [ns]`` since 1970; samples
    without markers are empty and dropped. The axis that points ``up`` has to be said, since systems differ (z in
    Qualisys and Vicon, y in OptiTrack). The person is the folder where the file has its usual name, else the file.
    """

    name = "neon_mocap"
    files = "`gaze_in_mocap_space.csv` of Pupil Labs' neon_mocap_localization"
    world = "the motion capture's, right-handed: `--up`, `--units`"
    checked_on = DESCRIPTION
    signature = Signature(
        columns=(("timestamp [ns]", "gaze_origin_X", "gaze_origin_Y", "gaze_origin_Z", "gaze_dir_X"),),
        options={"--up": "UP"},
        question="the up axis of the motion capture (--up)",
    )
    Options = NeonMocapOptions

    def frame(self, files: Sequence[Path], options: NeonMocapOptions) -> TrackingFrame:
        return TrackingFrame(up=options.up or "z", units=options.units)

    def read(self, files: Sequence[Path], options: NeonMocapOptions, builder: RaysBuilder) -> None:
        if options.up is None:
            raise NergError(
                "motion capture systems differ in which axis points up; say it (--up z of Qualisys and Vicon, "
                "--up y of OptiTrack)"
            )
        for path in files:
            columns = ColumnFinder(path)
            time = columns.find("timestamp_[ns]")
            if time is None:
                there = ", ".join(sanitize(c, 40) for c in columns.columns[:8])
                raise NergError(f'{path} has no column "timestamp [ns]"; its columns are {there}')
            names = [time, *columns.vector("gaze_origin"), *columns.vector("gaze_dir")]
            builder.source(path)
            usual = path.name.startswith("gaze_in_mocap_space")
            person = resolve_path(path).parent.name if usual else person_from_filename(path)
            for v, _, lines in builder.read_table(path, names):
                lost = np.asarray(np.isnan(v[:, 1:]).any(axis=1))
                builder.add(
                    v[:, 0] * 1e-9,
                    person or path.stem,
                    v[:, 1:4],
                    v[:, 4:7],
                    rows=lines,
                    drop={"the glasses' markers were not seen": lost},
                )


READERS = (Qualisys(), NeonMocap())
