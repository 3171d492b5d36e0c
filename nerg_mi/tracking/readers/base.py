"""Interface of readers: the protocol, options, the builder of rays, and frames of reference."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from nerg_mi.errors import NergError, clean_text, parameter, sanitize
from nerg_mi.files.atomic import file_sha256
from nerg_mi.files.safe_read import BadLineCallback, check_regular_file
from nerg_mi.files.values import normalize_name, to_name
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.maths.transforms import transform_points
from nerg_mi.ranges import IS_OPTION, MAX_COORDINATE, RANGE, TIME_UNITS, Range, ValidatedDataclass
from nerg_mi.tracking.rays import COLUMNS, FRAME, Rays, merge_tracking

from .cells import MISSING_WORDS
from .columns import ColumnFinder, may_be_validity_column, parse_time_unit
from .head_frame import HeadFrameFinder, read_head_columns
from .poses import FilledOriginFinder, find_fill_values, is_aimed
from .tables import TableBlock, find_column, iterate_table, read_table_columns, split_component

# ---- Frames ----
#
# Frames of tracking data, and the conversion to the common frame of rays, which only happens here.
#
# The common frame is right-handed with z up, in metres.

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # Units of length by name, in metres
UP_AXES = ("y", "z", "x", "-y", "-z", "-x")
HANDEDNESSES = ("right", "left")


@dataclass(frozen=True)
class TrackingFrame:
    """The frame of tracking data. Raises `NergError` for unknown values."""

    up: str = "z"  # up axis: x, y, z, -x, -y or -z
    handedness: str = "right"  # right or left
    units: str = "m"  # unit of length: m, cm or mm

    def __post_init__(self) -> None:
        if self.up not in UP_AXES or self.handedness not in HANDEDNESSES:
            raise NergError(
                f'the frame "{self.up} up, {self.handedness}-handed" is unknown; '
                f"up is one of {', '.join(UP_AXES)}, handedness is left or right"
            )
        if self.units not in UNITS:
            raise NergError(f'the unit "{self.units}" is unknown; use one of {", ".join(UNITS)}')

    def __str__(self) -> str:
        return f"{self.up} up, {self.handedness}-handed, {self.units}"

    def to_dict(self) -> dict[str, str]:
        """Values for the metadata of rays: ``up``, ``handedness`` and ``units``."""
        return asdict(self)

    def to_rays(self) -> np.ndarray:
        """4x4 matrix from this frame to the common frame of rays (right-handed, z up, metres).

        x is kept (with x up, y becomes x). z up, right: identity. y up, right: (x, -z, y), a rotation. y up, left
        (Unity): (x, z, y), a reflection that maps Unity's forward axis to y. z up, left (Unreal): (x, -y, z). -y up,
        right (OpenCV camera): (x, z, -y).
        """
        z = np.eye(3)["xyz".index(self.up[-1])] * (-1.0 if self.up[0] == "-" else 1.0)
        x = np.eye(3)[1 if self.up[-1] == "x" else 0]
        y = np.cross(z, x) * (1.0 if self.handedness == "right" else -1.0)
        matrix = np.eye(4)
        matrix[:3, :3] = UNITS[self.units] * np.stack([x, y, z])
        return matrix + 0.0  # no negative zeros


RAYS_FRAME = TrackingFrame()  # The common frame of rays
UNITY = TrackingFrame(up="y", handedness="left")  # Unity's world frame
OPENGL = TrackingFrame(up="y")  # World frame of OpenGL, OpenXR and HoloLens


# ---- Building rays: conversion to the common frame, removal of invalid rows, and a record of what was dropped ----

MAX_BAD_LINE_FRACTION = 0.01  # Maximum fraction of unreadable lines of a file that may be skipped
MAX_SOURCE_BYTES = 16 << 30  # Maximum size of a file: its checksum takes a second per 10^9 bytes
STREAM_RAYS = 1 << 20  # Number of rays that are passed to `on_rays` at a time
MAX_LISTED_RUNS = 500_000
"""Maximum number of runs of dropped rows that are listed; more (every other row may be a blink) are only counted."""

_MAX_UNUSED_NAMES = 256  # names of unused columns in the metadata

_MISSING_NAMES = MISSING_WORDS - {"na"}  # written by programs for a missing name; NA may be initials

_EYE_DISTANCE = "eye_distance"  # a column while reading; then the median per participant in the metadata


def _to_runs(rows: np.ndarray) -> list[list[int]]:
    """Convert row numbers to inclusive runs [first, last], which list blinks compactly."""
    if not rows.size:
        return []
    rows = np.unique(rows)
    cuts = np.flatnonzero(np.diff(rows) > 1)
    first = rows[np.r_[0, cuts + 1]]
    last = rows[np.r_[cuts, rows.size - 1]]
    return [[int(a), int(b)] for a, b in zip(first, last)]


def _median_by_person(values: np.ndarray, person: np.ndarray, persons: Sequence[str]) -> dict[str, float]:
    """Median of the finite ``values`` (n,) of each participant with any."""
    is_finite = np.isfinite(values)
    values, person = values[is_finite], person[is_finite]
    order = np.argsort(person, kind="stable")
    ends = np.searchsorted(person[order], np.arange(len(persons) + 1))
    groups = zip(persons, np.split(values[order], ends[1:-1]))
    return {name: round(float(np.median(person_values)), 5) for name, person_values in groups if person_values.size}


class RaysBuilder:
    """Collects rays source by source, converts them to the common frame, drops invalid rows, and records how many rows
    of which source were dropped for which reason.

    Parameters
    ----------
    frame
        Frame of all rows.
    skip_bad_lines
        Whether to skip and record unreadable lines, at most `MAX_BAD_LINE_FRACTION` of a file, or one.
    on_source
        Called with the name of each source when it begins.
    on_rays
        Receives rays as soon as there are `STREAM_RAYS` of them, with no metadata but their frame, so that memory is
        bounded for sources of any size; `build` then returns the last ones.
    """

    def __init__(
        self,
        frame: TrackingFrame = RAYS_FRAME,
        *,
        skip_bad_lines: bool = False,
        on_source: Callable[[str], None] | None = None,
        on_rays: Callable[[Rays], None] | None = None,
    ) -> None:
        self._frame, self._transform, self._on_source = frame, frame.to_rays(), on_source
        self._on_rays = on_rays
        self._metadata: dict[str, Any] = {}
        self._parts: list[dict[str, np.ndarray]] = []
        self._part_sizes: list[int] = []
        self._persons, self._cohorts = NameCodes(), NameCodes()
        self._sources: list[dict[str, Any]] = []
        self._path = Path()  # of the current source
        self._dropped: list[dict[str, Any]] = []
        self._rows_read = self._num_runs = 0
        self._unused_columns: dict[str, None] = {}
        self._missing = Counter[str]()
        self._tracking = set[str]()
        metre = float(np.cbrt(abs(np.linalg.det(self._transform[:3, :3]))))
        self._make_origin_finder = lambda: FilledOriginFinder(metre)
        self._filled_origins, self._head_frames = self._make_origin_finder(), HeadFrameFinder(metre)
        self._skips_bad_lines, self._num_lines, self._bad_lines, self._first_bad_line = skip_bad_lines, 0, [], ""

    def add_metadata(self, **entries: Any) -> None:
        """Add entries to the metadata of the rays; values must be serialisable as JSON."""
        self._metadata.update(entries)

    def add_warning(self, sentence: str) -> None:
        """Add a warning with the likely mistake in the files and the remedy, for the quality report."""
        warnings = self._metadata.setdefault("complaints", [])
        if (text := clean_text(sentence)) not in warnings:
            warnings.append(text)

    def read_table(
        self,
        path: Path,
        numbers: Sequence[str],
        texts: Sequence[str] = (),
        *,
        also_used: Sequence[str] = (),
        header: Sequence[str] | None = None,
        first_line: int = 1,
        separator: str = ",",
        clocks: Mapping[str, float] | None = None,
    ) -> Iterator[TableBlock]:
        """Read a table of the current source in blocks (`iterate_table`); records unreadable lines and unused columns.

        ``also_used`` are columns that are read separately.
        """
        available = read_table_columns(path) if header is None else header
        columns = [find_column(name, available) for name in (*numbers, *texts, *also_used)]
        used = {split_component(name, available) or name for name in columns}
        unused = [name for name in available if name and name not in used]
        self.add_unused_columns(unused)
        if header is None:
            self._head_frames.add_table(unused, functools.partial(read_head_columns, path))
        for name, tick in (clocks or {}).items():
            unit = parse_time_unit(name)
            if unit is not None and not math.isclose(unit, tick):
                self.add_warning(
                    f"{sanitize(name, 40)!r} is in units of {unit:g} s by its name, but was read in units of "
                    f"{tick:g} s: set {parameter('tick', f'{unit:g}')}, unless the name is wrong"
                )
        settings = {"first_line": first_line, "separator": separator, "clocks": clocks, "on_note": self.add_metadata}
        return iterate_table(path, numbers, texts, header, self.on_bad_line, **settings)

    def read_all(self, path: Path, numbers: Sequence[str]) -> np.ndarray:
        """Read columns (n, C) of a table without rays, as `read_table` does, and count its lines."""
        blocks = [block.numbers for block in self.read_table(path, numbers)]
        values = np.concatenate(blocks or [np.empty((0, len(numbers)))])
        self.count_lines(len(values))
        return values

    def add_unused_columns(self, columns: Iterable[str]) -> None:
        """Add names of unused columns to the quality report."""
        self._unused_columns.update(dict.fromkeys(columns))

    def add_data_frame(self, unused: list[str], read: Callable[[Sequence[str]], np.ndarray]) -> None:
        """Add a table in memory with its ``unused`` columns; ``read`` returns the complete rows (n, C) of some."""
        self.add_unused_columns(unused)
        self._head_frames.add_table(unused, read)

    @property
    def on_bad_line(self) -> BadLineCallback | None:
        """Callback for unreadable lines, with the line number (from 1) and the reason; None if these are errors."""
        return self._record_bad_line if self._skips_bad_lines else None

    def _record_bad_line(self, line: int, reason: str) -> None:
        self._first_bad_line = self._first_bad_line or f"line {line}{reason}"
        self._bad_lines.append(line)
        # Not a file of the format: stop before all of its lines are counted.
        if len(self._bad_lines) > 10_000 + MAX_BAD_LINE_FRACTION * self._num_lines:
            self._end_source()

    def count_lines(self, n: int) -> None:
        """Count lines of the current source that were read but give no rays."""
        self._num_lines += n

    def _end_source(self) -> None:
        """Record the bad lines of the current source. Raises `NergError` if there are too many."""
        bad, lines = len(self._bad_lines), self._num_lines + len(self._bad_lines)
        if bad > max(1, MAX_BAD_LINE_FRACTION * lines):
            raise NergError(
                f"{self._sources[-1]['file']}: {bad:,} of {lines:,} lines are unreadable, more than the maximum of "
                f"{100 * MAX_BAD_LINE_FRACTION:g} % for {parameter('skip_bad_lines', True)} (the first is "
                f"{self._first_bad_line})"
            )
        if bad:
            self._record_dropped(
                "the line is incomplete, has too many cells, or a cell that is not a number (option skip_bad_lines)",
                np.array(self._bad_lines),
            )
            self._rows_read += bad
        if self._sources and "sha256" not in self._sources[-1]:
            self._sources[-1]["sha256"] = file_sha256(self._path)
        self._num_lines, self._bad_lines, self._first_bad_line = 0, [], ""
        for code, count in self._filled_origins.undecided_counts.items():
            self.add_warning(
                f"the first {count:,} rows of {self._persons.get_name(code)} in {self._sources[-1]['file']} have one "
                "fill value as their origin, and were kept; exclude them (nerg rays filter --start)"
            )
        self._filled_origins = self._make_origin_finder()
        if self._sources:
            self._head_frames.end_source(self._sources[-1]["file"])

    def begin_source(self, path: Path, name: str | None = None) -> None:
        """Begin a source. Only its file name (or ``name``, if files have the same name) and its checksum are recorded.

        The checksum is computed at the end, so that files of another format are rejected before reading gigabytes.
        """
        self._end_source()
        check_regular_file(path, "tracking file", MAX_SOURCE_BYTES)
        if self._on_source is not None:
            self._on_source(name or path.name)
        self._path = path
        self._sources.append({"file": normalize_name(name or path.name)})

    def add(
        self,
        t: np.ndarray,
        person: Sequence[str] | np.ndarray | str,
        origin: np.ndarray,
        direction: np.ndarray,
        *,
        rows: np.ndarray,
        tracking: str = "unknown",
        confidence: np.ndarray | None = None,
        hit: np.ndarray | None = None,
        cohort: Sequence[str] | np.ndarray | None = None,
        head: np.ndarray | None = None,
        eye_distance: np.ndarray | None = None,
        drop: dict[str, np.ndarray] | None = None,
        recorded_origin: np.ndarray | None = None,
        recorded_direction: np.ndarray | None = None,
    ) -> None:
        """Add n rows of the current source.

        A row is dropped for the first reason that applies. Rows without a participant are dropped, rows without a
        cohort belong to the cohort "unknown".

        Parameters
        ----------
        t
            (n,) seconds.
        person
            Name of the participant of each row, or one name for all.
        origin, hit
            (n, 3) eye or head position, and point of regard on a surface, in the frame and units of the builder.
        direction
            (n, 3) in that frame, of any length.
        rows
            (n,) row numbers in the source, from 1.
        tracking
            What was tracked, of `nerg_mi.tracking.rays.TRACKING`: "eye", or "head" if ``direction`` is that of the
            head.
        confidence
            (n,) in [0, 1]. Default: 1.
        cohort
            Name of the group of participants of each row.
        head
            (n, 3) direction of the head in that frame, of any length, NaN or zero if unknown. Omit it if ``direction``
            is that of the head.
        eye_distance
            (n,) distance between the eyes, in the units of the origins, NaN if an eye was not tracked.
        drop
            Reasons of the format, with masks (n,) of the rows to drop; a reason names the option that controls it, as
            in "confidence below 0.5 (option --min-confidence)". They precede those of the builder: values that are
            NaN, and zero directions.
        recorded_origin, recorded_direction
            (n, 3) values in the file, if ``origin`` and ``direction`` are computed from these; exact fill values such
            as 0, 0, 0 or -1, -1, -1 are detected in them.
        """
        n = len(t)
        person = self._persons.encode(person, n)
        length = np.linalg.norm(direction, axis=1)
        confidence = np.ones(n) if confidence is None else np.asarray(confidence, dtype=np.float64)
        is_filled_origin = self._filled_origins.find(origin if recorded_origin is None else recorded_origin, person)
        fill = find_fill_values(direction if recorded_direction is None else recorded_direction)
        reasons = {
            **(drop or {}),
            "person is missing": person == self._persons.get_code(""),
            "origin is a repeated fill value": is_filled_origin,
            **{f"direction is the fill value {f:g}, {f:g}, {f:g}": fill == f for f in np.unique(fill[abs(fill) > 0])},
            "time is missing": ~np.isfinite(t),
            "origin is missing": ~np.isfinite(origin).all(axis=1),
            f"origin is beyond {MAX_COORDINATE:g} m": ~(np.abs(self._to_rays_frame(origin)) <= MAX_COORDINATE).all(
                axis=1
            ),
            "direction is missing": ~np.isfinite(length),
            "direction is zero": length == 0,
            "confidence is missing or outside [0, 1]": ~((confidence >= 0) & (confidence <= 1)),
        }
        is_kept = np.ones(n, dtype=bool)
        for reason, mask in reasons.items():
            dropped = is_kept & mask
            if dropped.any():
                self._record_dropped(reason, np.asarray(rows)[dropped])
                is_kept &= ~mask
        self._rows_read += n
        self._num_lines += n
        R = self._transform[:3, :3]
        scale = np.cbrt(abs(np.linalg.det(R)))
        part = {
            "t": np.asarray(t, dtype=np.float64)[is_kept],
            "person": person[is_kept],
            "origin": self._to_rays_frame(origin[is_kept]),
            "direction": (direction[is_kept] / length[is_kept, None]) @ (R / scale).T,
            "confidence": confidence[is_kept],
        }
        recorded = origin if recorded_origin is None else recorded_origin
        self._head_frames.add_rays(recorded[is_kept], part["direction"] if head is None else None)
        if hit is not None:
            hit = self._mask_filled_hits(hit, origin, direction, is_kept)
            part["hit"] = self._to_rays_frame(hit[is_kept])
            is_too_far = (np.abs(part["hit"]) > MAX_COORDINATE).any(axis=1)
            if is_too_far.any():
                part["hit"][is_too_far] = np.nan
                self._missing[f"hit points beyond {MAX_COORDINATE:g} m"] += int(np.count_nonzero(is_too_far))
        if head is not None:
            with np.errstate(invalid="ignore", divide="ignore"):
                unit = head[is_kept] / np.linalg.norm(head[is_kept], axis=1, keepdims=True)
            part["head"] = (unit @ (R / scale).T).astype(np.float32)
        if eye_distance is not None:
            part[_EYE_DISTANCE] = (scale * eye_distance[is_kept]).astype(np.float32)
        if cohort is not None:
            part["cohort"] = self._cohorts.encode(cohort, n)[is_kept]
        self._parts.append(part)
        self._part_sizes.append(int(is_kept.sum()))
        if is_kept.any():
            self._tracking.add(tracking)
        if self._on_rays is not None and sum(self._part_sizes) >= STREAM_RAYS:
            self._on_rays(self._take_rays({"frame": dict(FRAME)}))

    def _mask_filled_hits(
        self, hit: np.ndarray, origin: np.ndarray, direction: np.ndarray, is_kept: np.ndarray
    ) -> np.ndarray:
        """Replace hit points (n, 3) that are fill values by NaN, unless the ray points at them, and count these."""
        fill = find_fill_values(hit)
        rows = np.flatnonzero(np.isfinite(fill) & is_kept)
        rows = rows[~is_aimed(origin[rows], direction[rows], hit[rows])]
        if not len(rows):
            return hit
        for value, count in zip(*np.unique(fill[rows], return_counts=True)):
            self._missing[f"hit points that are the fill value {value:g}, {value:g}, {value:g}"] += int(count)
        hit = hit.copy()
        hit[rows] = np.nan
        return hit

    def _to_rays_frame(self, points: np.ndarray) -> np.ndarray:
        """Transform ``points`` (N, 3) to the common frame."""
        with np.errstate(over="ignore", invalid="ignore"):
            return transform_points(self._transform, points)

    def _record_dropped(self, reason: str, rows: np.ndarray) -> None:
        name = self._sources[-1]["file"] if self._sources else ""
        entry = next((e for e in self._dropped if e["reason"] == reason and e["file"] == name), None)
        if entry is None:
            entry = {"reason": reason, "file": name, "count": 0, "rows": []}
            self._dropped.append(entry)
        runs = _to_runs(rows)
        listed = runs[: max(0, MAX_LISTED_RUNS - self._num_runs)]
        self._num_runs += len(listed)
        entry["count"] += int(rows.size)
        entry["rows"] += listed
        if len(listed) < len(runs):
            entry["rows_not_named"] = entry.get("rows_not_named", 0) + sum(
                last - first + 1 for first, last in runs[len(listed) :]
            )

    def build(self) -> Rays:
        """Return the rays with all metadata, and empty the builder. Raises `NergError` if no rays were collected; with
        `on_rays`, the last rays may be none."""
        self._end_source()
        if not sum(self._part_sizes) and self._on_rays is None:
            if not self._rows_read:
                names = ", ".join(source["file"] for source in self._sources[:4])
                raise NergError(f"there are no samples in {sanitize(names)}; record or export them again")
            reasons = "; ".join(f"{d['count']} rows: {d['reason']}" for d in self._dropped[:4])
            raise NergError(
                f"none of {self._rows_read} rows gives a ray ({reasons}); check which values or columns are used"
            )
        unused_validity = [name for name in self._unused_columns if may_be_validity_column(name)]
        if unused_validity:
            suffix = f" and {len(unused_validity) - 3} more" if len(unused_validity) > 3 else ""
            self.add_warning(
                f"{', '.join(map(repr, unused_validity[:3]))}{suffix} may mark valid rows by their names, but are "
                f"not used; use it with {parameter('columns')} and {parameter('valid')}"
            )
        remedy = f"{parameter('columns')}; nerg rays guess proposes a column map"
        if not self._sources:
            self._head_frames.end_source("")
            remedy = "import_rays does so for a table in a file"
        for sentence in self._head_frames.describe(remedy):
            self.add_warning(sentence)
        metadata = {
            "frame": dict(FRAME),
            "tracking": merge_tracking(self._tracking),
            "transform": self._transform.tolist(),
            "source_frame": self._frame.to_dict(),
            "sources": self._sources,
            "rows_read": self._rows_read,
            "dropped": self._dropped,
            **({"missing": dict(self._missing)} if self._missing else {}),
            **({"unused_columns": list(self._unused_columns)[:_MAX_UNUSED_NAMES]} if self._unused_columns else {}),
            **({"has_fixed_origins": True} if self._head_frames.has_fixed_origins else {}),
            **self._metadata,
        }
        return self._take_rays(metadata)

    def _take_rays(self, metadata: dict[str, Any]) -> Rays:
        """Return the collected rays and remove them from the builder."""
        if not self._parts:
            empty = np.zeros((0, 3))
            return Rays(empty[:, 0], np.zeros(0, np.int32), (), empty, empty, empty[:, 0], metadata=metadata)
        columns = {name: self._join_column(name) for name in COLUMNS if any(name in part for part in self._parts)}
        columns["person"], persons = self._persons.sort_codes(columns["person"])
        if any(_EYE_DISTANCE in part for part in self._parts):
            metadata[_EYE_DISTANCE] = _median_by_person(self._join_column(_EYE_DISTANCE), columns["person"], persons)
        cohorts: tuple[str, ...] = ()
        if "cohort" in columns:
            columns["cohort"], cohorts = self._cohorts.sort_codes(columns["cohort"])
            cohorts = tuple(c or "unknown" for c in cohorts)
        self._parts, self._part_sizes = [], []
        check_near_origin(columns["origin"], "the tracking data", np.linalg.inv(self._transform))
        return Rays(**columns, persons=persons, cohorts=cohorts, metadata=metadata)

    def _join_column(self, name: str) -> np.ndarray:
        """Join a column of all parts; parts without it get NaN or the cohort "". Frees the parts' columns, so that at
        most one column exists twice."""
        make_default = {
            "hit": lambda n: np.full((n, 3), np.nan),
            "head": lambda n: np.full((n, 3), np.nan, np.float32),
            _EYE_DISTANCE: lambda n: np.full(n, np.nan, np.float32),
            "cohort": lambda n: self._cohorts.encode("", n),
        }
        return np.concatenate(
            [
                part.pop(name) if name in part else make_default[name](n)
                for part, n in zip(self._parts, self._part_sizes)
            ]
        )


class NameCodes:
    """Codes of names in order of appearance, to avoid storing text for millions of rows."""

    def __init__(self) -> None:
        self._code_by_name: dict[str, int] = {}

    def get_code(self, name: str) -> int:
        return self._code_by_name.setdefault(name, len(self._code_by_name))

    def get_name(self, code: int) -> str:
        return list(self._code_by_name)[code]

    def encode(self, names: Sequence[str] | np.ndarray | str, n: int) -> np.ndarray:
        """Codes (n,) int32 of one name for all rows, or of n names."""
        if isinstance(names, str):
            return np.full(n, self.get_code(to_name(names)), dtype=np.int32)
        names = np.asarray(names, dtype=str)
        # Rows of one participant are mostly contiguous: look up names only where they change.
        starts = np.flatnonzero(np.r_[True, names[1:] != names[:-1]][:n])
        texts = map(to_name, names[starts].tolist())
        codes = np.array([self.get_code("" if s.lower() in _MISSING_NAMES else s) for s in texts], dtype=np.int32)
        return np.repeat(codes, np.diff(np.r_[starts, n]))

    def sort_codes(self, codes: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Convert codes to codes into the sorted names that occur; returns both."""
        names = list(self._code_by_name)
        used = sorted(np.unique(codes), key=lambda c: names[c])
        rank = np.zeros(len(names), dtype=np.int32)
        rank[used] = np.arange(len(used))
        return rank[codes], tuple(names[c] for c in used)


# ---- Options ----
#
# Typed options of a reader: fields of a frozen dataclass. The command line and the manual are generated from them.

_OPTION_KEY = "nerg_mi.reader_option"


@dataclass(frozen=True)
class Option:
    """One option of a reader, from :func:`list_options`."""

    name: str  # of the dataclass field
    flag: str  # on the command line: --tick; "" for an option that only Python has
    kind: type  # of the value without None: str, float, int, bool, Path; str if there is a `parse`
    default: Any  # of the field
    default_text: str  # the default in words; may be empty
    help: str  # a sentence, with units
    parse: Callable[[str], Any] | None  # converts the text of the command line to the value
    is_recorded: bool  # whether the value is added to the metadata of rays under its name


def option(
    default: Any,
    help: str,
    *,
    flag: str | None = None,
    default_text: str | None = None,
    within: Range | None = None,
    parse: Callable[[str], Any] | None = None,
    is_recorded: bool = True,
) -> Any:
    """Declare a field of a reader's options, with its description for the command line and the manual.

    Parameters
    ----------
    flag
        Flag on the command line. Default: the field's name with hyphens. "" for an option that only Python has.
    default_text
        Default in words, if the value is not self-explanatory.
    within
        Range of a number. Required for numbers, together with `ValidatedDataclass` as a base of the dataclass.
    parse
        Converts the text of the command line to the value; raises `NergError` naming the flag. Without it, the field
        is a str, float, int, bool or Path, or None.
    is_recorded
        False for values that the metadata of rays contain in another form, such as the frame.
    """
    spec = {"help": help, "flag": flag, "default_text": default_text, "parse": parse, "is_recorded": is_recorded}
    metadata = {_OPTION_KEY: spec, RANGE: within, IS_OPTION: flag != ""}
    return dataclasses.field(default=default, metadata=metadata)


def tick_option(default: float = 1.0) -> Any:
    """Declare the option for the unit of time of a file, in seconds."""
    return option(default, "Unit of the file's time, in seconds.", within=TIME_UNITS)


def valid_option() -> Any:
    """Declare the option for columns of validity, to be parsed by `parse_valid`."""
    return option(
        None,
        'Columns of validity and their values for valid rows, as "gaze_status=2" or "isValid=true,1"; '
        "none: do not use any.",
    )


@dataclass(frozen=True, kw_only=True)
class NoOptions:
    """Options of a reader without options."""


@dataclass(frozen=True, kw_only=True)
class TickOption(ValidatedDataclass):
    """Options of readers of files with an unknown unit of time. Raises `NergError` for an invalid unit."""

    tick: float = tick_option()


# Evaluating annotations runs code: do it once per class, when a reader is registered, and not while reading files.
@functools.cache
def list_options(kind: type) -> tuple[Option, ...]:
    """List the options of a dataclass, in the order of its fields.

    Raises ``TypeError`` for a class that is not a dataclass, or a field that was not declared by :func:`option`.
    """
    if not dataclasses.is_dataclass(kind):
        raise TypeError(f"{kind.__qualname__} is not a dataclass; the options of a reader must be a frozen dataclass")
    hints = typing.get_type_hints(kind)
    options = []
    for field in dataclasses.fields(kind):
        if _OPTION_KEY not in field.metadata:
            raise TypeError(f"{kind.__qualname__}.{field.name} has no description; declare it with option(...)")
        spec = field.metadata[_OPTION_KEY]
        default_text = spec["default_text"]
        if default_text is None:
            default_text = (
                "" if field.default is None or isinstance(field.default, bool) else _format_number(field.default)
            )
        options.append(
            Option(
                name=field.name,
                flag="--" + field.name.replace("_", "-") if spec["flag"] is None else spec["flag"],
                kind=str if spec["parse"] else _strip_optional(hints[field.name]),
                default=field.default,
                default_text=default_text,
                help=spec["help"],
                parse=spec["parse"],
                is_recorded=spec["is_recorded"],
            )
        )
    return tuple(options)


def list_recorded_options(options: Any) -> dict[str, Any]:
    """Values of options for the metadata of rays: those that are set, tuples as lists. Files are recorded as sources
    when a reader begins them."""
    recorded = [o for o in list_options(type(options)) if o.is_recorded and o.kind is not Path]
    values = {o.name: getattr(options, o.name) for o in recorded}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items() if v is not None}


def _strip_optional(hint: Any) -> type:
    """Return ``float`` for ``float | None``."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
    return hint


def _format_number(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# ---- Interface of a reader of tracking files ----
#
# To add a format, write a module in this package with a class that implements :class:`Reader`, and list an object of it
# in the module's ``READERS``; :mod:`nerg_mi.tracking.readers.registry` finds it. The command line, its help and the
# manual's table are generated from it. A reader parses files and declares their frame; the builder drops invalid rows,
# converts the frame and records what was dropped, in the same way for all formats.

O = TypeVar("O")
"""Type of a reader's options: a frozen dataclass whose fields are declared by
`nerg_mi.tracking.readers.base.option`."""

FROM_RECORDINGS = "read on real recordings"
"""Value of `evidence` for a reader whose tests read recordings of the device."""
FROM_DOCUMENTATION = "built from documentation"
"""The same, for a reader whose tests read files made after the manual or source of the program that writes them."""


@dataclass(frozen=True, kw_only=True)
class Signature:
    """How `nerg rays guess` recognises files of a format: any of these criteria. Without any, it is not proposed."""

    files: tuple[tuple[str, str], ...] = ()
    """Pairs of file names that identify a folder as a recording."""

    ending: str = ""
    """Suffix of the file name, in lower case."""

    columns: tuple[tuple[str, ...], ...] = ()
    """Sets of columns, all of which must be present; of several matching formats, the one with the largest set wins."""

    line: Callable[[str], str | None] = lambda line: None
    """Returns why the first line of a file identifies the format, or None."""

    table: Callable[[ColumnFinder], str | None] = lambda table: None
    """Returns why the columns of a table identify the format, or None; for columns with several names. Tried last."""

    options: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Flags that only the user can set, with placeholders as values."""

    question: str = ""
    """Description of these options."""


class FixedFrameReader:
    """Base of readers whose files always have one frame, by default without options."""

    fixed_frame: TrackingFrame
    Options: type[Any] = NoOptions

    def frame(self, files: Sequence[Path], options: Any) -> TrackingFrame:
        return self.fixed_frame


class Reader(Protocol[O]):
    """A format of tracking files."""

    name: str
    """Value of ``--preset``: lower case letters, digits and underscores."""

    files: str
    """Input files and their required columns, as a phrase of Markdown."""

    frame_description: str
    """Frame of the files, as a phrase of Markdown."""

    evidence: str
    """What shows that the reader is right, as a phrase that begins with `FROM_RECORDINGS` or `FROM_DOCUMENTATION`."""

    signature: Signature
    """How its files are recognised."""

    Options: type[O]
    """Class of its options; `nerg_mi.tracking.readers.base.NoOptions` if it has none."""

    def frame(self, files: Sequence[Path], options: O) -> TrackingFrame:
        """The one frame of the rows that `read` adds: fixed, set by ``options``, or read from ``files``."""
        ...

    def read(self, files: Sequence[Path], options: O, builder: RaysBuilder) -> None:
        """Add the rays of ``files`` (or folders), source by source, to ``builder``.

        Call ``builder.begin_source(path)`` for each file, and ``builder.add`` for each block of its rows: times in
        seconds, origins and hit points in the frame and units of `frame`, directions of any length, confidences in
        [0, 1], NaN for missing values, row numbers from 1, whether eyes or heads were tracked (``tracking``), and the
        format's own reasons to ``drop`` rows. Pass
        ``head`` and ``eye_distance`` if the file has them, for the checks of the quality report. If height 0 of the
        files is not the floor, call ``builder.add_metadata(floor="unknown")``. If origins or directions are computed,
        pass those of the file as ``recorded_origin`` and ``recorded_direction``, to detect fill values.

        Read tables with ``builder.read_table``, which records unused columns. Report unreadable lines to
        ``builder.on_bad_line`` if it is not None. Options are added to the metadata automatically; add further entries
        with ``builder.add_metadata``. Memory must be bounded by the block size.

        Raises `NergError` for errors of the user: a missing column or file, a damaged file, a required option.
        """
        ...
