"""Qualisys and neon_mocap: gaze in the space of a motion capture system.

Gaze vectors of Qualisys are in millimetres, z up unless calibrated otherwise (``--up y``); without a time column
samples are counted at the header's frequency. Samples with one eye use that eye. The participant is the file's name
before ``_g``. Pupil Labs' neon_mocap_localization locates a Neon by any system.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import BadLineCallback, read_line_blocks, resolve_path
from nerg_mi.files.values import parse_float

from .base import FROM_DOCUMENTATION, RaysBuilder, Signature, TrackingFrame, option
from .cells import is_missing
from .columns import ColumnFinder
from .table import person_from_filename
from .tables import explain_columns

# ---- Gaze vectors ----
#
# Gaze vectors exported from Qualisys Track Manager (QTM): a header of words and values, then numbers separated by tabs.
#
# See QTM's manual ("Gaze vector data (_g.tsv)"). The header, the column names and the time are options of the export,
# and may be missing.

_COLUMN_NAMES = ("x pos", "y pos", "z pos", "x vec", "y vec", "z vec")
_BLOCK = 1 << 16  # lines converted at a time
_HEADER_LINES = 200
_FILE_KIND = "file of gaze vectors"


class GazeVectors(NamedTuple):
    """A run of n samples."""

    times: np.ndarray  # (n,) seconds
    vectors: np.ndarray  # (n, 6) position in mm and direction, NaN for empty cells
    samples: np.ndarray  # (n,) number of the sample in the file, from 0
    lines: np.ndarray  # (n,) line number in the file, from 1


@dataclass(frozen=True)
class GazeVectorLayout:
    """Position of the samples in a file, and the roles of their cells."""

    first: int  # line of the first sample
    cells: tuple[int, ...]  # indices of the cells with `_COLUMN_NAMES`
    time: int | None  # index of the cell with the time in seconds
    step: float  # sampling interval in seconds, without such a cell
    start: float  # time of the first sample in seconds, without such a cell
    width: int  # number of cells per line


def iterate_gaze_vectors(path: Path, on_bad_line: BadLineCallback | None = None) -> Iterator[GazeVectors]:
    """Iterate over the samples of ``path`` in blocks.

    Raises `NergError` for another file, for unknown times, and, without ``on_bad_line``, for an unreadable line;
    otherwise ``on_bad_line`` is called with such lines, which are skipped.
    """
    layout, count, sample = _read_layout(path), 0, 0
    with closing(read_line_blocks(path, _FILE_KIND, _BLOCK)) as blocks:
        for lines in blocks:
            num_samples: list[tuple[float, list[float], int, int]] = []
            for number, line in enumerate(lines, count + 1):
                if number < layout.first or not line.strip("\r\n "):
                    continue
                try:
                    cells = _split_cells(line)
                    if not layout.width <= len(cells) <= layout.width + (not cells[-1]):
                        raise ValueError(f"{len(cells)} cells, not {layout.width}")
                    time = (
                        layout.start + sample * layout.step
                        if layout.time is None
                        else _parse_number(cells[layout.time])
                    )
                    num_samples.append((time, [_parse_number(cells[i]) for i in layout.cells], sample, number))
                except ValueError as error:
                    reason = f": {sanitize(line, 60)!r} is not a sample ({sanitize(error)}); correct or remove the line"
                    if on_bad_line is None:
                        raise NergError(
                            f"{path}, line {number}{reason}, or skip such lines with "
                            f"{parameter('skip_bad_lines', True)}"
                        ) from None
                    on_bad_line(number, reason)
                sample += 1
            count += len(lines)
            if num_samples:
                times, vectors, samples, numbers = zip(*num_samples)
                yield GazeVectors(np.array(times), np.array(vectors), np.array(samples), np.array(numbers))


def _read_layout(path: Path) -> GazeVectorLayout:
    """Read the layout from the header of the file, or from its first sample."""
    with closing(read_line_blocks(path, _FILE_KIND, _HEADER_LINES)) as blocks:
        lines = next(blocks, [])
    header: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        cells = _split_cells(line)
        names = [re.sub(r"\s+", " ", cell).lower() for cell in cells]
        indices = [next((i for i, name in enumerate(names) if name.endswith(wanted)), None) for wanted in _COLUMN_NAMES]
        if all(i is not None for i in indices):
            time = names.index("time") if "time" in names else None
            return _make_layout(
                path, number + 1, tuple(i for i in indices if i is not None), time, header, len(cells) - (not cells[-1])
            )
        if re.match(r"[A-Za-z_]", cells[0]) and not is_missing(cells[0]):
            header[cells[0].upper()] = cells[1] if len(cells) > 1 else ""
        elif len(cells) in (6, 8):
            # Without column names: six numbers, possibly after the number and the time of the sample.
            time = 1 if len(cells) == 8 else None
            return _make_layout(path, number, tuple(range(len(cells) - 6, len(cells))), time, header, len(cells))
        elif line.strip():
            break
    raise NergError(
        f"{path} has no gaze vectors (X Pos, Y Pos, Z Pos, X Vec, Y Vec, Z Vec between tabs); export them from QTM "
        "(TSV, eye tracker), with column headers"
    )


def _make_layout(
    path: Path, first: int, cells: tuple[int, ...], time: int | None, header: dict[str, str], width: int
) -> GazeVectorLayout:
    if time is not None:
        return GazeVectorLayout(first, cells, time, 0.0, 0.0, width)
    try:
        rate, offset = float(header.get("FREQUENCY", "")), float(header.get("START_OFFSET", "") or 0)
    except ValueError:
        rate, offset = 0.0, 0.0
    if not (0 < rate < 1e6 and abs(offset) < 1e9):
        raise NergError(
            f"{path} has no times: neither a column Time nor a FREQUENCY in its header; export it from QTM with its "
            "header"
        )
    return GazeVectorLayout(first, cells, None, 1 / rate, -offset, width)


def _split_cells(line: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.rstrip("\r\n").split("\t")]


def _parse_number(cell: str) -> float:
    return np.nan if is_missing(cell) else parse_float(cell)


# ---- Readers ----

_EYE_SUFFIX = re.compile(r"_g(_[12])?$")


@dataclass(frozen=True, kw_only=True)
class QualisysOptions:
    """Options for the calibration of the laboratory."""

    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", is_recorded=False)


class Qualisys:
    """``*_g.tsv`` of QTM, or ``*_g_1.tsv`` and ``*_g_2.tsv`` of two eyes; or a folder of these.

    Columns are ``X Pos`` to ``Z Vec``, in millimetres and in the laboratory's frame (right-handed; z is up in QTM's
    default calibration), and optionally the number and the time of a sample; otherwise times follow from the header's
    ``FREQUENCY`` and ``START_OFFSET``. Column names may be missing. The files of two eyes are combined to one ray, from
    midway between the eyes along the mean of their directions; if only one eye was tracked, it is used alone. The
    participant is the file name before ``_g``.
    """

    name = "qualisys"
    files = "gaze vectors of Qualisys Track Manager, `*_g.tsv` or `*_g_1.tsv` and `*_g_2.tsv`, or folders of them"
    frame_description = "that of the laboratory, right-handed, mm; `--up` points up"
    evidence = FROM_DOCUMENTATION
    signature = Signature(
        line=lambda line: "its first line names a gaze vector" if line.startswith("GAZE_VECTOR_NAME\t") else None
    )
    Options = QualisysOptions

    def frame(self, files: Sequence[Path], options: QualisysOptions) -> TrackingFrame:
        return TrackingFrame(up=options.up, units="mm")

    def read(self, files: Sequence[Path], options: QualisysOptions, builder: RaysBuilder) -> None:
        paths = list(dict.fromkeys(path for file in files for path in _find_gaze_files(file)))
        for path in paths:
            left, right = (path.with_name(_EYE_SUFFIX.sub(eye, path.stem) + path.suffix) for eye in ("_g_1", "_g_2"))
            if left == right or path not in (left, right) or not {left, right} <= set(paths):
                _add_eye(path, None, builder)
            elif path == left:
                _add_eye(left, _read_eye(right, builder), builder)


def _find_gaze_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(p for p in path.iterdir() if p.suffix.lower() == ".tsv" and _EYE_SUFFIX.search(p.stem))
    if not files:
        raise NergError(f"there are no gaze vectors (*_g.tsv) in {path}; export them from QTM (TSV, eye tracker)")
    return files


def _read_eye(path: Path, builder: RaysBuilder) -> np.ndarray:
    """Positions and directions of an eye by number of the sample, (n, 6); NaN for missing samples."""
    builder.begin_source(path)
    blocks = list(iterate_gaze_vectors(path, builder.on_bad_line))
    vectors = np.full((max((int(block.samples[-1]) + 1 for block in blocks), default=0), 6), np.nan)
    for block in blocks:
        vectors[block.samples] = block.vectors
        builder.count_lines(len(block.lines))
    return vectors


def _add_eye(path: Path, other: np.ndarray | None, builder: RaysBuilder) -> None:
    """Add the samples of an eye, combined with those of the ``other`` eye (n, 6)."""
    builder.begin_source(path)
    for block in iterate_gaze_vectors(path, builder.on_bad_line):
        both_eyes = block.vectors[:, None]
        if other is not None:
            other_vectors = np.full(block.vectors.shape, np.nan)
            is_available = block.samples < len(other)
            other_vectors[is_available] = other[block.samples[is_available]]
            both_eyes = np.stack([block.vectors, other_vectors], axis=1)
        is_seen = np.isfinite(both_eyes).all(axis=2) & (np.abs(both_eyes[:, :, 3:]).max(axis=2) > 0)
        weight = is_seen / np.maximum(is_seen.sum(axis=1, keepdims=True), 1)
        values = np.where(is_seen[:, :, None], both_eyes, 1.0)
        direction = values[:, :, 3:] / np.linalg.norm(values[:, :, 3:], axis=2, keepdims=True)
        builder.add(
            block.times,
            _EYE_SUFFIX.sub("", path.stem),
            (weight[:, :, None] * values[:, :, :3]).sum(axis=1),
            (weight[:, :, None] * direction).sum(axis=1),
            rows=block.lines,
            tracking="eye",
            drop={"no eye was seen": ~is_seen.any(axis=1)},
        )


@dataclass(frozen=True, kw_only=True)
class NeonMocapOptions:
    """Options for what the table does not contain."""

    up: str | None = option(None, "Up axis: x, y, z, -x, -y or -z.", is_recorded=False)  # required
    units: str = option("mm", "Unit of length: m, cm or mm.", is_recorded=False)


class NeonMocap:
    """``gaze_in_mocap_space.csv``, which Pupil Labs' neon_mocap_localization computes from Neon's gaze and the poses of
    its markers; it may be renamed.

    ``gaze_origin_X`` to ``gaze_dir_Z`` are in the motion capture's frame and unit, ``timestamp [ns]`` is since 1970;
    samples without markers are empty and are dropped. The ``up`` axis is required, since systems differ (z for Qualisys
    and Vicon, y for OptiTrack). The participant is the folder if the file has its usual name, otherwise the file name.
    """

    name = "neon_mocap"
    files = "`gaze_in_mocap_space.csv` of Pupil Labs' neon_mocap_localization"
    frame_description = "that of the motion capture, right-handed: `--up`, `--units`"
    evidence = FROM_DOCUMENTATION
    signature = Signature(
        columns=(("timestamp [ns]", "gaze_origin_X", "gaze_origin_Y", "gaze_origin_Z", "gaze_dir_X"),),
        options={"--up": "UP"},
        question=f"the up axis of the motion capture ({parameter('up')})",
    )
    Options = NeonMocapOptions

    def frame(self, files: Sequence[Path], options: NeonMocapOptions) -> TrackingFrame:
        return TrackingFrame(up=options.up or "z", units=options.units)

    def read(self, files: Sequence[Path], options: NeonMocapOptions, builder: RaysBuilder) -> None:
        if options.up is None:
            raise NergError(
                f"motion capture systems have different up axes; specify it ({parameter('up', 'z')} for Qualisys "
                f"and Vicon, {parameter('up', 'y')} for OptiTrack)"
            )
        for path in files:
            columns = ColumnFinder(path)
            time = columns.find("timestamp_[ns]")
            if time is None:
                raise NergError(f'{path} has no column "timestamp [ns]"; {explain_columns(columns.columns)}')
            names = [time, *columns.require_vector("gaze_origin"), *columns.require_vector("gaze_dir")]
            builder.begin_source(path)
            has_usual_name = path.name.startswith("gaze_in_mocap_space")
            person = resolve_path(path).parent.name if has_usual_name else person_from_filename(path)
            for v, _, lines in builder.read_table(path, names):
                is_missing = np.asarray(np.isnan(v[:, 1:]).any(axis=1))
                builder.add(
                    v[:, 0] * 1e-9,
                    person or path.stem,
                    v[:, 1:4],
                    v[:, 4:7],
                    rows=lines,
                    tracking="eye",
                    drop={"the glasses' markers were not seen": is_missing},
                )


READERS = (Qualisys(), NeonMocap())
