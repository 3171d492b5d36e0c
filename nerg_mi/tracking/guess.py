"""Proposes how to import an unknown tracking table, from its column names, known file formats and its first rows.

The up axis and the unit are those with which rows stay at 0.7 to 2.3 m. The time unit is stated by the name, makes
the values dates of this century, or makes the rate a device's. Heads look along the axis on which they walk. Gaze is
in the head's frame if its origins do not move while another position does, or if that brings it nearer to the head's
direction. Handedness is always a guess: y up is taken as Unity's left-handed frame unless heads look along -z, z up
in centimetres as Unreal's.
"""

from __future__ import annotations

import itertools
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.html import Summary
from nerg_mi.files.safe_read import read_line_blocks, resolve_path

from .filters import estimate_interval
from .readers import poses
from .readers.base import MAX_BAD_LINE_FRACTION, UNITS, Reader
from .readers.cells import is_missing
from .readers.columns import (
    DIRECTION_WORDS,
    GAZE_WORDS,
    HEAD_WORDS,
    HIT_WORDS,
    ROTATION_WORDS,
    SIDE_WORDS,
    ColumnFinder,
    ColumnMap,
    Roles,
    are_degrees,
    find_head_positions,
    find_roles,
    find_valid_values,
    is_counter,
    is_validity_column,
    parse_time_unit,
    split_stem,
)
from .readers.registry import iterate_readers
from .readers.tables import iterate_samples, iterate_table, parse_clock_seconds, read_table_columns, split_component

# ---- Evidence from rows ----
#
# The rows of a table suggest its frame: the up axis and the unit of length from the heights of heads, the unit of time
# from the sampling interval, the forward axis of heads from walking, and the frame of gaze from its angle to the head.

_MIN_EYE_HEIGHT, _MAX_EYE_HEIGHT = 0.7, 2.3  # metres; range of eye heights of sitting and standing people
_MAX_HEIGHT_RANGE = 1.2  # metres; maximum range of the height of one head
_DEVICE_RATES = 5.0, 2100.0  # sampling rates of existing devices, Hz
_USUAL_RATE = 25.0  # Hz; slower devices are less likely than another unit of time
_PLAUSIBLE_RATES = 1.0, 2020.0  # Hz; from this to the fastest eye trackers (2,000 Hz) with their jitter
_TIME_UNITS = {
    1.0: "seconds",
    1e-3: "milliseconds",
    1e-6: "microseconds",
    1e-9: "nanoseconds",
    1e-7: "ticks of 100 ns (.NET, Windows)",
}
_CLOCKS = (
    *((unit, 0.0, "Unix times") for unit in (1.0, 1e-3, 1e-6, 1e-9)),
    (1e-7, -62_135_596_800.0, ".NET ticks since the year 1"),
    (1e-7, -11_644_473_600.0, "Windows file times since 1601"),
)
"""Unit in seconds, Unix time of the origin in seconds, and name of clocks that count from a date."""
_CLOCK_RANGE = 946_684_800.0, 4_102_444_800.0  # Unix times of the years 2000 to 2100
_STEP_SECONDS = 0.5  # duration of a walking step for the comparison with gaze
_WALKING_SPEEDS = 0.3, 3.0  # m/s
_MIN_COSINE = 0.3  # minimum mean cosine between the forward axis and walking
_MIN_WALKING_STEPS = 50


@dataclass(frozen=True)
class UpAxis:
    """Up axis and unit of length, with ``height``, the median coordinate along the axis in metres."""

    up: str
    units: str
    height: float


def find_up_axis(positions: np.ndarray) -> UpAxis | None:
    """Find the axis along which head positions (n, 3) stay at eye height in metres, centimetres or millimetres; None
    if no axis does, or if several do."""
    positions = positions[np.isfinite(positions).all(axis=1)]
    if not len(positions):
        return None
    low, median, high = np.percentile(positions, [5, 50, 95], axis=0)
    has_movement = np.ptp(positions, axis=0).max() > 0
    candidates = []
    for units, metre in UNITS.items():
        for axis in range(3):
            height, height_range = abs(median[axis]) * metre, (high - low)[axis] * metre
            # Constant coordinates along all axes are not heights but a constant of another kind.
            if _MIN_EYE_HEIGHT <= height <= _MAX_EYE_HEIGHT and height_range < _MAX_HEIGHT_RANGE and has_movement:
                candidates.append(
                    (UpAxis(("-" if median[axis] < 0 else "") + "xyz"[axis], units, height), height_range)
                )
    preferred = [f for f in candidates if f[0].units == "m"] or candidates
    if len(preferred) > 1:
        # In a small room each coordinate may be near 1.6 m: height is the one that varies least.
        preferred.sort(key=lambda f: f[1])
        if preferred[0][1] > 0.5 * preferred[1][1]:
            return None
    return preferred[0][0] if preferred else None


def find_clock(times: np.ndarray) -> tuple[float, str] | None:
    """Find the unit in seconds and the name of a clock for which ``times`` (n,) are dates of this century."""
    median = np.median(times[np.isfinite(times)]) if np.isfinite(times).any() else np.nan
    for unit, origin, name in _CLOCKS:
        if _CLOCK_RANGE[0] <= median * unit + origin <= _CLOCK_RANGE[1]:
            return unit, name
    return None


def find_time_units(times: np.ndarray) -> list[float]:
    """Return the units of ``times`` (n,) in seconds that give the sampling rate of a device, the most likely first.

    Steps of 166,667 are 60 Hz in ticks of 100 ns, but 6 Hz in microseconds: units that give a usual rate come first.
    """
    rate = _find_rate(times)
    units = [t for t in _TIME_UNITS if _DEVICE_RATES[0] <= rate / t <= _DEVICE_RATES[1]]
    return sorted(units, key=lambda t: rate / t < _USUAL_RATE)


def _is_plausible_rate(rate: float) -> bool:
    return _PLAUSIBLE_RATES[0] <= rate <= _PLAUSIBLE_RATES[1]


def _find_rate(times: np.ndarray) -> float:
    """Samples per unit of ``times`` (n,); NaN without steps."""
    step = np.diff(times[np.isfinite(times)])
    return 1 / estimate_interval(step)


def is_unit(vectors: np.ndarray, tolerance: float = 0.02) -> bool:
    """Whether nearly all finite rows of (n, C) have length one; zero rows count as missing."""
    length = np.linalg.norm(vectors, axis=1)
    length = length[np.isfinite(length) & (length > 1e-9)]
    return bool(length.size and np.mean(np.abs(length - 1) < tolerance) > 0.95)


def find_forward_axis(
    rotations: np.ndarray, positions: np.ndarray, seconds: np.ndarray, up: str, metre: float
) -> str | None:
    """Find the axis of the head's frame that points in the walking direction; None if there is too little walking, or
    no such axis.

    Parameters
    ----------
    rotations
        (n, 3, 3), head to table frame.
    positions
        (n, 3), in the unit of the table.
    seconds
        (n,) times.
    up
        Up axis of the table.
    metre
        Length of the unit of the table in metres.
    """
    heading = _find_headings(positions, seconds, up, metre)
    is_valid = np.isfinite(heading).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
    if is_valid.sum() < _MIN_WALKING_STEPS:
        return None
    horizontal = _horizontal_mask(up)
    mean_cosines = {
        name: float(np.mean(np.sum((rotations[is_valid] @ axis) * horizontal * heading[is_valid], axis=1)))
        for name, axis in poses.AXES.items()
        if name[-1] != up[-1]
    }
    best = max(mean_cosines, key=mean_cosines.__getitem__)
    return best if mean_cosines[best] > _MIN_COSINE else None


def is_gaze_in_head_frame(gaze: np.ndarray, rotations: np.ndarray, forward: str) -> bool | None:
    """Whether ``gaze`` (n, 3) is in the head's frame rather than in that of the table: the frame in which it is nearer
    to the direction of the head. None if both are similar, as for a head that does not turn."""
    ahead = poses.AXES[forward]
    length = np.linalg.norm(gaze, axis=1)
    is_valid = np.isfinite(rotations).all(axis=(1, 2)) & (length > 1e-9)
    d, heads = gaze[is_valid] / length[is_valid, None], rotations[is_valid] @ ahead
    if not len(d):
        return None
    angle = lambda cosine: float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
    local, world = angle(d @ ahead), angle(np.sum(d * heads, axis=1))
    return None if abs(local - world) < 5.0 else local < world


def _find_headings(positions: np.ndarray, seconds: np.ndarray, up: str, metre: float) -> np.ndarray:
    """Unit horizontal directions (n, 3) of motion over the next half second; NaN where nobody walks."""
    out = np.full(positions.shape, np.nan)
    step = np.median(np.diff(seconds)) if len(seconds) > 1 else np.nan
    if not step > 0:
        return out
    lag = max(1, min(round(_STEP_SECONDS / step), len(positions) - 1))
    moved = (positions[lag:] - positions[:-lag]) * _horizontal_mask(up)
    duration = seconds[lag:] - seconds[:-lag]
    length = np.linalg.norm(moved, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = metre * length / duration
        is_walking = (speed > _WALKING_SPEEDS[0]) & (speed < _WALKING_SPEEDS[1]) & (duration < 4 * _STEP_SECONDS)
    out[:-lag][is_walking] = moved[is_walking] / length[is_walking, None]
    return out


def _horizontal_mask(up: str) -> np.ndarray:
    """One for each horizontal axis, zero for the up axis, (3,)."""
    return (np.arange(3) != "xyz".index(up[-1])).astype(np.float64)


# ---- Presets found by their signature (`nerg_mi.tracking.readers.base.Signature`) ----


def find_preset_by_files(path: Path) -> tuple[Reader[Any], str] | None:
    """Find the reader of a file or folder by file names; returns the reader and the reason."""
    folder = path if path.is_dir() else path.parent
    for reader in iterate_readers():
        for file, companion in reader.signature.files:
            if (path.is_dir() or path.name == file) and (folder / file).is_file() and (folder / companion).is_file():
                return reader, f"{file} with {companion} next to it"
        ending = reader.signature.ending
        if ending and path.name.lower().endswith(ending):
            return reader, f"its name ends in {ending}"
    return None


def find_preset_by_first_line(path: Path) -> tuple[Reader[Any], str] | None:
    """Find the reader of a file by its first line, if that is not a header; returns the reader and the reason."""
    for block in read_line_blocks(path, "tracking file", 1):
        return next(
            ((reader, reason) for reader in iterate_readers() if (reason := reader.signature.line(block[0]))), None
        )
    return None


def find_preset_by_columns(table: ColumnFinder) -> tuple[Reader[Any], str] | None:
    """Find the reader of a table by its columns; returns the reader and the reason."""
    available = set(table.columns)
    matches = [
        (columns, reader)
        for reader in iterate_readers()
        for columns in reader.signature.columns
        if available.issuperset(columns)
    ]
    if matches:
        columns, reader = max(matches, key=lambda match: len(match[0]))
        return reader, f"it has the columns {', '.join(columns)}"
    return next(((reader, reason) for reader in iterate_readers() if (reason := reader.signature.table(table))), None)


# ---- First rows of a table, and which columns contain numbers or times ----


_MIN_NUMBERS = 0.95  # fraction of the cells of a column that are numbers; the import reports the others
_MAX_BLOCKS = 16  # blocks of 65,536 rows that are searched if columns are empty in those before
_MAX_COLUMNS = 400  # columns of numbers that are read


class TableSample:
    """At most 65,536 rows of the ``columns`` of a table that contain numbers; ``numbers[name]`` is (n,) float64.

    They are the first rows, or later ones if columns are empty in the first. Times in text form are converted to
    seconds, and their columns are in ``clocks``. Columns with a repeated name are excluded. Raises `NergError` if more
    than 1 % of the rows have more or fewer cells than the header.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        self.columns = [name for name in columns if list(columns).count(name) == 1]
        self.repeated = sorted(set(columns) - set(self.columns))
        kinds = _find_numeric_columns(path, list(columns))
        wanted = [name for name in self.columns if name in kinds][:_MAX_COLUMNS]
        self._block = 0
        for name in (wanted or self.columns)[:1]:
            self.read_texts(split_component(name, read_table_columns(path)) or name)
        self.clocks = {name for name in wanted if kinds[name]}
        self.numbers: dict[str, np.ndarray] = {}
        # The import reports cells that are not numbers.
        clocks = dict.fromkeys(self.clocks, 1.0)
        max_cells = -1
        blocks = iterate_table(path, wanted, on_bad_line=lambda line, why: None, clocks=clocks)
        for k, block in enumerate(itertools.islice(blocks, _MAX_BLOCKS)):
            num_cells = np.isfinite(block.numbers).any(axis=0).sum()
            if num_cells > max_cells:
                self.numbers, self._block, max_cells = dict(zip(wanted, block.numbers.T)), k, num_cells
            if max_cells == len(wanted):
                break
        self.rows = len(next(iter(self.numbers.values()), ()))

    def stack_columns(self, names: Sequence[str]) -> np.ndarray:
        """Columns as (n, C); NaN for columns without numbers."""
        missing = np.full(self.rows, np.nan)
        return np.stack([self.numbers.get(name, missing) for name in names], axis=1)

    def read_texts(self, name: str) -> np.ndarray:
        """Cells (n,) of a column as text."""
        bad: list[tuple[int, str]] = []
        blocks = iterate_table(self.path, (), [name], on_bad_line=lambda line, why: bad.append((line, why)))
        for block in itertools.islice(blocks, self._block, None):
            if len(bad) > max(1, MAX_BAD_LINE_FRACTION * len(block.lines)):
                break
            return block.texts[:, 0]
        if len(bad) > 1:
            raise NergError(f"{self.path}, line {bad[0][0]}{bad[0][1]}")
        return np.empty(0, str)


def _find_numeric_columns(path: Path, columns: list[str]) -> dict[str, bool]:
    """Columns that contain only numbers, or only times, or empty cells, apart from a few cells; the value is whether
    they are times in text form."""
    if path.suffix.lower() == ".parquet":
        return {name: kind for name in dict.fromkeys(columns) if (kind := _is_parquet_clock(path, name)) is not None}
    kinds: dict[str, Counter[bool | None]] = {name: Counter() for name in columns}
    header = read_table_columns(path)
    for name in columns:
        if (base := split_component(name, header)) is not None:
            kinds[name][False], kinds[base][None] = 1, 1
    open_columns = {k for k, name in enumerate(columns) if columns.count(name) == 1 and not kinds[name]}
    for rows in itertools.islice(iterate_samples(path), _MAX_BLOCKS):
        for cells in rows:
            for k in open_columns:
                if k < len(cells) and not is_missing(cells[k]):
                    kinds[columns[k]][_is_clock_time(cells[k])] += 1
        if all(kinds[columns[k]] for k in open_columns):
            break
    shares = {(name, k): n / counts.total() for name, counts in kinds.items() for k, n in counts.items()}
    return {name: kind for (name, kind), share in shares.items() if kind is not None and share >= _MIN_NUMBERS}


def _is_clock_time(cell: str) -> bool | None:
    """False for a number, True for a time, None for other text."""
    try:
        # The table reader decides whether a comma is the decimal sign.
        float(cell.replace(",", ".", 1))
    except ValueError:
        return True if parse_clock_seconds(cell) else None
    return False


def _is_parquet_clock(path: Path, name: str) -> bool | None:
    for is_clock, clocks in ((False, None), (True, {name: 1.0})):
        try:
            next(iterate_table(path, [name], clocks=clocks), None)
        except NergError:
            continue
        return is_clock
    return None


# ---- Proposals for the import of unknown tables: a preset, or a column map with its frame ----
#
# Nothing is imported: a proposal lists what is certain, what is a guess and what only the user knows, and the command.


@dataclass(repr=False)
class Proposal(Summary):
    """Proposed import of ``paths``: ``options`` of the command line in addition to the preset or the column map, and
    sentences about what is certain, what is guessed and what is open."""

    paths: list[Path]
    preset: str | None = None
    columns: ColumnMap | None = None
    options: dict[str, str] = field(default_factory=dict)
    certain: list[str] = field(default_factory=list)
    assumptions: list[str] = field(default_factory=list)
    questions: list[str] = field(default_factory=list)
    # Folder that was named in place of the paths; the output is named after it.
    folder: Path | None = None

    @property
    def command(self) -> str | None:
        """The complete import command; None if nothing can be proposed."""
        if self.preset is None and self.columns is None:
            return None
        what = ["--preset", self.preset] if self.preset else ["--map", str(self.columns)]
        stem = resolve_path(self.paths[0]).name.split(".")[0] if self.folder is None else resolve_path(self.folder).name
        stem = stem or "rays"
        words = ["nerg", "rays", "import", *map(str, self.paths), "-o", f"{stem}.npz", *what]
        for flag, value in self.options.items():
            words += [flag, value] if value else [flag]
        return shlex.join(words)


_TABLE_SUFFIXES = (".csv", ".csv.gz", ".tsv", ".txt", ".parquet")


def propose_imports(paths: Sequence[str | Path]) -> list[Proposal]:
    """Propose imports of tracking files or folders of recordings; one proposal for all files that are imported alike.

    A folder that is not a recording is replaced by the tables in it, and its subfolders with recordings or tables are
    named. Raises `NergError` as `propose_import` does, and for a folder without tables.
    """
    out: list[Proposal] = []
    for source in map(Path, paths):
        for path in _find_tables(source):
            proposal = propose_import(path)
            proposal.folder = source if path != source else None
            settings = proposal.preset, proposal.columns, proposal.options
            existing = next((p for p in out if proposal.command and (p.preset, p.columns, p.options) == settings), None)
            if existing is None:
                out.append(proposal)
            else:
                existing.paths += proposal.paths
                existing.folder = existing.folder if existing.folder == proposal.folder else None
    _finish_folders(out)
    return out


def _finish_folders(proposals: Sequence[Proposal]) -> None:
    """Name the subfolders of the folders of ``proposals``, and the outputs of several proposals of one folder after
    their files."""
    folders = [p.folder for p in proposals if p.folder is not None]
    for folder in dict.fromkeys(folders):
        first = next(p for p in proposals if p.folder == folder)
        if usable := _find_usable_subfolders(folder):
            first.questions.append(
                f"only the tables directly in {folder} were read; recordings or tables are also in its subfolders "
                f"{_list_names(usable)}: nerg rays guess {shlex.quote(str(usable[0]))}"
            )
    for proposal in proposals:
        if proposal.folder is not None and folders.count(proposal.folder) > 1:
            proposal.folder = None


_MAX_SUBFOLDERS = 1000  # subfolders that are inspected


def _find_usable_subfolders(folder: Path) -> list[Path]:
    """The subfolders that are a recording, or contain tables."""
    return [p for p in _list_subfolders(folder)[:_MAX_SUBFOLDERS] if _find_tables(p) != [p] or find_preset_by_files(p)]


def _list_subfolders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _list_names(paths: Sequence[Path], max_names: int = 4) -> str:
    more = f" and {len(paths) - max_names} more" if len(paths) > max_names else ""
    return ", ".join(p.name for p in paths[:max_names]) + more


def _find_tables(path: Path) -> list[Path]:
    """The tables in a folder that is not a recording; otherwise the path itself."""
    if not path.is_dir() or find_preset_by_files(path) is not None:
        return [path]
    return sorted(p for p in path.iterdir() if p.is_file() and p.name.lower().endswith(_TABLE_SUFFIXES)) or [path]


def propose_import(path: str | Path) -> Proposal:
    """Propose the import of a tracking file or of the folder of a recording.

    Raises `NergError` for a file that is damaged or not a table.
    """
    path = Path(path)
    out = Proposal([path])
    match = find_preset_by_files(path)
    if match is None:
        if path.is_dir():
            raise _make_folder_error(path)
        match = find_preset_by_first_line(path) if path.suffix.lower() != ".parquet" else None
    table = ColumnFinder(path) if match is None else None
    if table is not None:
        match = find_preset_by_columns(table)
    if match is not None:
        _propose_preset(out, *match)
        return out
    assert table is not None
    if not any(_is_name(c) for c in table.columns):
        raise NergError(f"the first line of {path} contains no column names; add a header to the table")
    _propose_columns(out, TableSample(path, table.columns), find_roles(table.columns))
    return out


def _make_folder_error(path: Path) -> NergError:
    """The error for a folder that is neither a recording nor contains tables."""
    if usable := _find_usable_subfolders(path):
        subfolders = _list_subfolders(path)
        return NergError(
            f"the folder {path} is not a recording of a known format and has no table; of its subfolders "
            f"({_list_names(subfolders)}) use one with recordings: nerg rays guess {shlex.quote(str(usable[0]))}"
        )
    names = ", ".join(
        f"{file} and {companion}" for reader in iterate_readers() for file, companion in reader.signature.files
    )
    return NergError(f"the folder {path} is not a recording of a known format ({names}); name a file in it instead")


def _is_name(column: str) -> bool:
    try:
        float(column)
    except ValueError:
        return bool(column)
    return False


def _propose_preset(out: Proposal, reader: Reader[Any], reason: str) -> None:
    out.preset = reader.name
    out.certain.append(f"the preset {reader.name}: {reason}")
    out.options |= reader.signature.options
    if reader.signature.question:
        out.questions.append(reader.signature.question)


def _propose_columns(out: Proposal, sample: TableSample, roles: Roles) -> None:
    """Propose a column map in ``out``, as far as possible."""
    numbers = sample.numbers
    if sample.repeated:
        out.questions.append(
            f"several columns are called {', '.join(map(repr, sample.repeated[:8]))}; rename all but one"
        )
    vectors = {s: v for s, v in roles.vectors.items() if all(c in numbers for c in v)}
    quaternions = {
        s: q for s, q in roles.quaternions.items() if all(c in numbers for c in q) and is_unit(sample.stack_columns(q))
    }
    # A position named like a quaternion (x, y, z and w) is not one.
    vectors |= {s: q[:3] for s, q in roles.quaternions.items() if s not in quaternions and all(c in numbers for c in q)}
    parts = {stem: split_stem(stem) for stem in (*vectors, *quaternions)}
    eulers = {stem: vectors.pop(stem) for stem in list(vectors) if parts[stem] & ROTATION_WORDS}
    direction = _find_best(
        vectors,
        lambda s: (
            4 * bool(parts[s] & DIRECTION_WORDS)
            + 2 * is_unit(sample.stack_columns(vectors[s]))
            - _side_penalty(parts[s])
        ),
        min_score=2,
        tie_break=lambda s: bool(parts[s] & GAZE_WORDS) - 2 * bool(parts[s] & HEAD_WORDS),
    )
    hit = _find_best(
        vectors, lambda s: 3 * bool(parts[s] & HIT_WORDS) - _side_penalty(parts[s]), min_score=3, excluded=(direction,)
    )
    find_position = lambda prefer, but: _find_best(
        vectors,
        lambda s: (
            2
            + 3 * bool(parts[s] & prefer)
            - 3 * bool(parts[s] & (HIT_WORDS | DIRECTION_WORDS))
            - _side_penalty(parts[s])
        ),
        min_score=1,
        excluded=but,
    )
    quaternion = _find_best(
        quaternions, lambda s: 2 + 2 * bool(parts[s] & HEAD_WORDS) - _side_penalty(parts[s]), min_score=1
    )
    matrix = next((m for m in roles.matrices.values() if all(c in numbers for c in m)), None)
    head = find_position(HEAD_WORDS, (direction, hit))
    eye = find_position(GAZE_WORDS, (direction, hit, head)) if head is not None and parts[head] & HEAD_WORDS else None
    has_pose = quaternion is not None or matrix is not None
    still = eye or head
    moving_head = _find_moving_head(sample, vectors, still) if matrix is None else None
    if moving_head is not None and still is not None:
        head, eye = moving_head, still
        names, moving_names = ", ".join(vectors[still]), ", ".join(vectors[moving_head])
        out.assumptions.append(f"the gaze is in the head's frame: {names} do not move, but {moving_names} do")

    origin = head if has_pose or eye is None or moving_head is not None else eye
    upright = None
    head_positions = (
        sample.stack_columns(matrix)[:, 3:12:4] if matrix else sample.stack_columns(vectors[origin]) if origin else None
    )
    if head_positions is not None:
        upright = find_up_axis(head_positions)
    time = _find_time(out, sample, roles)
    settings = _propose_frame(out, upright, _find_gravity_up(sample, roles))
    rotations = None
    if matrix is not None:
        rotations, _ = poses.rotations_from_matrices(sample.stack_columns(matrix))
        try:
            poses.check_last_rows(sample.stack_columns(matrix), "the matrix", np.arange(2, sample.rows + 2))
        except NergError as error:
            out.questions.append(f"{error}; the import refuses it")
        is_mirrored = poses.is_mirrored(sample.stack_columns(matrix))
        if is_mirrored.any():
            out.questions.append(
                f"{is_mirrored.sum():,} of {len(is_mirrored):,} rows: {poses.MIRRORED_MATRIX}; the import drops them"
            )
    elif quaternion is not None:
        rotations = poses.rotations_from_quaternions(sample.stack_columns(quaternions[quaternion]))
    gaze = sample.stack_columns(vectors[direction]) if direction else None
    angles, degrees = None, True
    euler = _find_best(eulers, lambda s: 2 * bool(parts[s] & HEAD_WORDS) - _side_penalty(parts[s]), min_score=2)
    if rotations is None and euler is not None and "up" in settings:
        angles, degrees, rotations = _read_euler_angles(sample, eulers[euler], settings["up"])
        # Directions in the world need no rotation of the head.
        forward = poses.default_forward(settings["up"], "left")
        if moving_head is None and gaze is not None and not is_gaze_in_head_frame(gaze, rotations, forward):
            angles = rotations = None
    if direction and gaze is not None and not is_unit(gaze):
        _question_lengths(out, vectors[direction], gaze)
    is_local = _propose_pose(out, settings, rotations, gaze, head_positions, time[1], moving_head is not None)
    if moving_head is not None and rotations is None and direction is not None:
        out.questions.append(
            "the head's rotation, without which gaze in the head's frame cannot be placed in the world"
        )
        direction = None
    if rotations is not None and gaze is not None and is_local is False:
        quaternion = matrix = rotations = angles = None
        if origin is None or (eye is not None and parts[eye] & GAZE_WORDS):
            origin = eye or origin
    mapping: dict = {
        "t": time[0],
        "person": _find_person_column(out, sample, roles),
        "confidence": _find_confidence(roles, sample),
        "hit": vectors[hit] if hit else None,
        "direction": vectors[direction] if direction else None,
        "xyzw": quaternions[quaternion] if quaternion else None,
        "matrix": matrix,
        "ypr": angles,
        "origin": vectors[origin] if origin and matrix is None else None,
        "eye": vectors[eye] if rotations is not None and is_local and eye and eye != origin else None,
    }
    if mapping["eye"] and not np.nan_to_num(sample.stack_columns(mapping["eye"])).any():
        mapping["eye"] = None
    if angles is not None:
        out.assumptions.append(f"the head turns by {', '.join(angles)} (yaw, pitch, roll)")
        if not degrees:
            out.options["--radians"] = ""
            out.assumptions.append("these angles are radians: they stay within 2 pi")
    _propose_angles(out, sample, roles, mapping)
    _propose_validity(out, sample)
    _finish_proposal(out, sample, roles, mapping)


def _find_moving_head(sample: TableSample, vectors: dict[str, tuple[str, ...]], eye: str | None) -> str | None:
    """The stem of positions that move while those of ``eye`` do not, as in the head's frame; None without these."""
    if eye is None:
        return None
    others = (stem for stem in find_head_positions(vectors) if stem != eye)
    positions = lambda stem: sample.stack_columns(vectors[stem])
    return next((stem for stem in others if poses.is_fixed(positions(eye), positions(stem))), None)


def _read_euler_angles(
    sample: TableSample, columns: tuple[str, ...], up: str
) -> tuple[tuple[str, ...], bool, np.ndarray]:
    """Yaw, pitch and roll among the columns of rotations about x, y and z, whether they are degrees, and rotations
    (n, 3, 3)."""
    forward = poses.default_forward(up, "left")
    (side,) = set("xyz") - {up[-1], forward[-1]}
    names = tuple(columns["xyz".index(axis)] for axis in (up[-1], side, forward[-1]))
    angles = sample.stack_columns(names)
    degrees = are_degrees(names)
    degrees = bool(np.nanmax(np.abs(angles), initial=0.0) > 2 * np.pi) if degrees is None else degrees
    return names, degrees, poses.rotations_from_angles(angles, up, forward, degrees)


def _question_lengths(out: Proposal, names: Sequence[str], vectors: np.ndarray) -> None:
    """Ask whether ``vectors`` (n, 3) of other lengths than 1 are directions."""
    lengths = np.linalg.norm(vectors, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    if lengths.size:
        low, high = np.percentile(lengths, [5, 95])
        out.questions.append(
            f"whether {', '.join(names)} is a direction: its length is {low:.3g} to {high:.3g} (5 to 95 %) instead of "
            "1; the import normalises it; a point is mapped with hit= instead"
        )


def _side_penalty(parts: set[str]) -> int:
    """Penalty of vectors of a single eye in the choice of columns."""
    return 2 * bool(parts & SIDE_WORDS)


def _find_best(stems, score, min_score: int, excluded: tuple = (), tie_break=lambda stem: 0) -> str | None:
    """The stem with the highest score of at least ``min_score``; ties are decided by ``tie_break``, then by the order
    in the file."""
    candidates = [s for s in stems if s not in excluded and score(s) >= min_score]
    return max(candidates, key=lambda s: (score(s), tie_break(s)), default=None)


def _find_time(out: Proposal, sample: TableSample, roles: Roles) -> tuple[str | None, np.ndarray | None]:
    """Find the column of time, and its values in seconds."""
    name = next((c for c in (*roles.times, *sorted(sample.clocks)) if c in sample.numbers), None)
    if name is None:
        reason = "no column has a usual name"
        if unreadable := next((c for c in roles.times if c in sample.columns), None):
            cell = sanitize(next(iter(sample.read_texts(unreadable)), ""), 40)
            reason = f"{unreadable!r} contains {cell!r}, which is neither a number nor like 2024-05-01T12:00:00.25"
        out.questions.append(
            f"the time: {reason}; without t= rows are numbered, and {parameter('tick')} is the sampling interval"
        )
        return None, None
    times = sample.numbers[name]
    rate = _find_rate(times)
    if name in sample.clocks:
        out.certain.append(f"{name!r} contains times of day, or dates with times (in UTC without an offset)")
        _question_rate(out, name, rate, "seconds")
        return name, times
    named_unit, clock, units = parse_time_unit(name), find_clock(times), find_time_units(times)
    if clock and units and not _is_plausible_rate(rate / clock[0]):
        clock = None  # the clock of a device that started some time ago, in another unit
    detected = clock[0] if clock else units[0] if units else None
    tick = named_unit or detected
    if named_unit:
        out.certain.append(f"{name!r} is the time, in {_TIME_UNITS[named_unit]} by its name")
    elif clock:
        out.assumptions.append(f"{name!r} is the time, in {_TIME_UNITS[clock[0]]}: its values are {clock[1]}")
    elif detected:
        others = [f"{_TIME_UNITS[t]} ({rate / t:.3g} Hz, {parameter('tick', f'{t:g}')})" for t in units[1:]]
        out.assumptions.append(
            f"{name!r} is the time, in {_TIME_UNITS[detected]}: the sampling rate is {rate / detected:.3g} Hz"
            + (f"; it may also be in {' or '.join(others)}" if others else "")
        )
    else:
        out.questions.append(
            f"the unit of the time {name!r}: no unit gives the sampling rate of a device ({parameter('tick')}, seconds)"
        )
    if named_unit and detected and named_unit not in (detected, *units):
        evidence = "values" if clock else "sampling rate"
        out.assumptions.append(f"by its {evidence} {name!r} would be in {_TIME_UNITS[detected]}: is its name right?")
    _question_rate(out, name, rate / (tick or 1.0), _TIME_UNITS[tick or 1.0])
    if tick and tick != 1.0:
        out.options["--tick"] = f"{tick:g}"
    return name, times * (tick or 1.0)


def _question_rate(out: Proposal, name: str, rate: float, unit: str) -> None:
    """Ask whether the time is right if its sampling rate in Hz is implausible."""
    if np.isfinite(rate) and not _is_plausible_rate(rate):
        out.questions.append(
            f"whether {name!r} is the time, in {unit}: the sampling rate is {rate:.3g} Hz, which trackers do not "
            f"have ({parameter('tick')}, or another column as t=)"
        )


def _find_gravity_up(sample: TableSample, roles: Roles) -> str | None:
    """The axis opposite to gravity, if the table has columns of gravity."""
    if roles.gravity is None or not sample.rows:
        return None
    pull = np.nan_to_num(np.nanmedian(sample.stack_columns(roles.gravity), axis=0))
    axis = int(np.argmax(np.abs(pull)))
    if np.abs(pull[axis]) < 0.95 * np.linalg.norm(pull) or not pull.any():
        return None
    return ("-" if pull[axis] > 0 else "") + "xyz"[axis]


def _propose_frame(out: Proposal, upright: UpAxis | None, gravity_up: str | None) -> dict[str, str]:
    """Propose the up axis and the unit of length, from the heights of heads, or from gravity."""
    if gravity_up is not None:
        out.certain.append(f"{gravity_up} is up, opposite to the columns of gravity")
    if upright is None or (gravity_up is not None and upright.up != gravity_up):
        if gravity_up is None:
            out.questions.append(
                f"the up axis ({parameter('up')}), the handedness ({parameter('handedness')}) and the unit "
                f"({parameter('units')}): there is not exactly one axis along which the rows stay at eye height"
            )
            out.options |= {"--up": "UP", "--hand": "HAND", "--units": "UNIT"}
            return {}
        out.options["--up"] = gravity_up
        out.assumptions.append("the unit is the metre; the rows are not at eye height, as if 0 were not the floor")
        return {"up": gravity_up, "metre": "m"}
    out.options["--up"] = upright.up
    if upright.units != "m":
        out.options["--units"] = upright.units
    which = f"the unit is {upright.units}" if gravity_up else f"{upright.up} is up and the unit {upright.units}"
    out.assumptions.append(f"{which}: the rows stay at {upright.height:.2f} m along {upright.up}")
    return {"up": upright.up, "metre": upright.units}


def _propose_pose(
    out: Proposal,
    settings: dict[str, str],
    rotations: np.ndarray | None,
    gaze: np.ndarray | None,
    positions: np.ndarray | None,
    seconds: np.ndarray | None,
    is_known_local: bool,
) -> bool | None:
    """Propose the handedness and the forward axis in ``out``; returns whether gaze is in the head's frame."""
    up = settings.get("up")
    forward = None
    if rotations is not None and up and positions is not None and seconds is not None:
        forward = find_forward_axis(rotations, positions, seconds, up, UNITS[settings["metre"]])
        if forward:
            out.assumptions.append(f"the forward axis of heads is {forward}: it points in the walking direction")
    is_unity = up == "y" and forward != "-z"
    is_unreal = up is not None and up.endswith("z") and settings["metre"] == "cm"
    hand = "left" if is_unity or is_unreal else "right"
    if up:
        out.options["--hand"] = hand
        which = "like camera frames" if up == "-y" else "like most frames with this up axis"
        if hand == "left":
            which = "like Unity (y up)" if is_unity else "like Unreal (z up, in centimetres)"
        out.assumptions.append(
            f"the frame is {hand}-handed, {which}; the rows cannot confirm it: a mirrored scene means the other hand"
        )
    if rotations is None:
        return None
    default = poses.default_forward(up, hand) if up else None
    if forward is not None and forward != default:
        out.options["--forward"] = forward
    if forward is None:
        usual_one = f"{default} is usual in such a frame" if default else "it depends on the frame"
        out.questions.append(
            f"the forward axis of heads ({parameter('forward')}): {usual_one}, and there is no walking to confirm it"
        )
    if gaze is None or is_known_local:
        return is_known_local or None
    is_local = is_gaze_in_head_frame(gaze, rotations, forward or default or "z")
    if is_local is None:
        out.questions.append(
            "whether the gaze is in the head's frame: the rows do not tell; the head's frame is assumed"
        )
        return True
    where_to = "the head's frame" if is_local else "the world frame, so that the head's pose is omitted"
    out.assumptions.append(f"the gaze is in {where_to}: this is nearer to the direction of the head")
    return is_local


def _find_confidence(roles: Roles, sample: TableSample) -> str | None:
    """The column of confidences, if they are in [0, 1]."""
    if roles.confidence is None or roles.confidence not in sample.numbers:
        return None
    values = sample.numbers[roles.confidence]
    values = values[np.isfinite(values)]
    return roles.confidence if values.size and values.min() >= 0 and values.max() <= 1 else None


def _find_person_column(out: Proposal, sample: TableSample, roles: Roles) -> str | None:
    """The column of participants, unless it is a row counter."""
    if roles.person not in sample.columns or not is_counter(sample.read_texts(roles.person)):
        return roles.person if roles.person in sample.columns else None
    out.questions.append(
        f"{roles.person!r} has another value in nearly every row: it is a row counter, not a participant"
    )
    return None


def _propose_validity(out: Proposal, sample: TableSample) -> None:
    """Propose columns of validity and their values for valid rows."""
    words = []
    for name in filter(is_validity_column, sample.columns):
        values = sorted(set(sample.read_texts(name).tolist()))
        valid = find_valid_values(name, values)
        if valid is None or any(c in name + "".join(valid) for c in ",="):
            out.questions.append(
                f"which values of {name!r} mark valid rows ({parameter('valid')}): "
                f"{', '.join(map(repr, values[:8]))}{', ...' if len(values) > 8 else ''}"
            )
        elif valid:
            out.assumptions.append(f"rows are valid where {name!r} is {' or '.join(valid)}")
            words.append(shlex.quote(name) + "=" + ",".join(map(shlex.quote, valid)))
    if words:
        out.options["--valid"] = " ".join(words)


def _propose_angles(out: Proposal, sample: TableSample, roles: Roles, mapping: dict) -> None:
    """Propose angles as the direction or the head's pose, if there is no vector."""
    has_pose = mapping["xyzw"] or mapping["matrix"]
    names: tuple[str, ...] | None = None
    if mapping["direction"] is None and roles.azel and all(c in sample.numbers for c in roles.azel):
        names = mapping["azel"] = roles.azel
        out.assumptions.append("azimuths increase to the right and elevations upwards; put - before a name otherwise")
    elif mapping["direction"] is None and roles.yaw_pitch_roll:
        if all(c in sample.numbers for c in roles.yaw_pitch_roll):
            names = roles.yaw_pitch_roll
            gaze = any(set(n.lower().replace("_", " ").split()) & GAZE_WORDS for n in names)
            mapping["yawpitch" if has_pose or (gaze and len(names) == 2) else "ypr"] = names[: 2 if has_pose else 3]
            out.assumptions.append(
                "yaw turns about the up axis, then pitch about the sideways one, by the usual matrices in this frame; "
                "put - before a name of yawpitch otherwise"
            )
    if names is None:
        return
    named_degrees = are_degrees(names)
    max_angle = float(np.nanmax(np.abs(sample.stack_columns(names)), initial=0.0))
    degrees = named_degrees if named_degrees is not None else max_angle > 2 * np.pi
    if not degrees:
        out.options["--radians"] = ""
    how = "by their names" if named_degrees is not None else f"the largest value is {max_angle:.3g}"
    which = out.certain if named_degrees is not None else out.assumptions
    which.append(f"the angles are {'degrees' if degrees else 'radians'}: {how}")


def _finish_proposal(out: Proposal, sample: TableSample, roles: Roles, mapping: dict) -> None:
    named = {key: value for key, value in mapping.items() if value}
    try:
        out.columns = ColumnMap(**named)
    except NergError as error:
        out.options = {}
        out.questions.append(
            f"no column map can be proposed ({error}); the columns with numbers are "
            f"{', '.join(list(sample.numbers)[:24]) or 'none'}"
        )
        return
    for key in ("origin", "direction", "hit", "eye", "xyzw", "matrix", "ypr"):
        if key in named:
            out.assumptions.append(
                f"{key}: {', '.join(named[key][:4])}{', ...' if len(named[key]) > 4 else ''} by its names"
            )
    if "person" in named:
        out.assumptions.append(f"person: {named['person']!r} by its name")
    else:
        out.questions.append("the person: no column names participants; the file is taken as one participant")
    used = {name for value in named.values() if not isinstance(value, str) for name in value}
    unused = [v[0] for v in (*roles.vectors.values(), *roles.quaternions.values()) if not used & set(v)]
    if unused:
        out.questions.append(f"unused columns: {', '.join(unused[:8])}{', ...' if len(unused) > 8 else ''}")
