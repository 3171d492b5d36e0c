"""What readers have in common: the protocol, their options, the builder of rays, and frames of reference."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.files.safe_read import BadLineCallback, check_regular_file
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.ranges import MAX_COORDINATE, FLAG, RANGE, TIME_UNITS, ValidatedDataclass, Range
from nerg_mi.rays.rays import COLUMNS, FRAME, Rays

from .columns import ColumnFinder, looks_like_validity
from .poses import FilledOrigins, fill_values, is_aimed
from .tables import TableBlock, iterate_table, read_table_columns

# ---- Frames ----
#
# Declared frames of tracking data, and the way from them to the frame of rays: the only place where it is converted.
#
# The frame of rays is right-handed with z up, in metres.

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # Units of length by name, in metres
UPS = ("y", "z", "x", "-y", "-z", "-x")
HANDS = ("right", "left")


@dataclass(frozen=True)
class TrackingFrame:
    """The frame of tracking data. Raises `NergError` for a word that is not known."""

    up: str = "z"  # the axis that points up: x, y, z, -x, -y or -z
    handedness: str = "right"  # right or left
    units: str = "m"  # of length: m, cm or mm

    def __post_init__(self) -> None:
        if self.up not in UPS or self.handedness not in HANDS:
            raise NergError(
                f'frame "{self.up} up, {self.handedness}-handed" is not known; '
                f"up is one of {', '.join(UPS)}, handedness is left or right"
            )
        if self.units not in UNITS:
            raise NergError(f'units "{self.units}" are not known; use one of {", ".join(UNITS)}')

    def __str__(self) -> str:
        return f"{self.up} up, {self.handedness}-handed, {self.units}"

    def to_dict(self) -> dict[str, str]:
        """As it stands in the metadata of rays: ``up``, ``handedness`` and ``units``."""
        return asdict(self)

    def to_rays(self) -> np.ndarray:
        """4x4 matrix from this frame to that of rays (right-handed, z up, metres).

        x is kept (where x is up, y becomes x). z up, right: nothing. y up, right: (x, -z, y), a rotation. y up, left
        (Unity): (x, z, y), the mirror that makes Unity's forward our y. z up, left (Unreal): (x, -y, z). -y up, right
        (a camera of OpenCV): (x, z, -y).
        """
        z = np.eye(3)["xyz".index(self.up[-1])] * (-1.0 if self.up[0] == "-" else 1.0)
        x = np.eye(3)[1 if self.up[-1] == "x" else 0]
        y = np.cross(z, x) * (1.0 if self.handedness == "right" else -1.0)
        matrix = np.eye(4)
        matrix[:3, :3] = UNITS[self.units] * np.stack([x, y, z])
        return matrix + 0.0  # no negative zeros


RAYS = TrackingFrame()  # The frame of rays
UNITY = TrackingFrame(up="y", handedness="left")  # Unity's world
OPENGL = TrackingFrame(up="y")  # A world with y up as OpenGL, OpenXR and HoloLens have it


# ---- Building rays of what readers find: one frame for all, what cannot be used dropped, with an account of it ----

BAD_LINES = 0.01  # Share of a file's lines that may be left out since they cannot be read
SOURCE_BYTES = 16 << 30  # A file may have so many bytes, for its checksum takes a second for each of some 10^9
STREAMED = 1 << 20  # So many rays are kept at a time where somebody takes them as they come
NAMED_RUNS = 500_000
"""So many runs of dropped rows are named; of more, as where every other row is a blink, only the number is kept."""

_UNUSED = 256  # columns that are not used and kept by name

_NO_NAMES = {"nan", "none", "null", "n/a", "<na>"}  # what programs write where there is no name

_EYES = "eye_distance"  # a column while files are read; of the rays, one number a person in the metadata


def _ranges(rows: np.ndarray) -> list[list[int]]:
    """Sorted row numbers as inclusive [first, last] runs: blinks come in runs,
    so that every dropped row can be named in little space."""
    if not rows.size:
        return []
    rows = np.unique(rows)
    cuts = np.flatnonzero(np.diff(rows) > 1)
    first = rows[np.r_[0, cuts + 1]]
    last = rows[np.r_[cuts, rows.size - 1]]
    return [[int(a), int(b)] for a, b in zip(first, last)]


def _medians(values: np.ndarray, person: np.ndarray, persons: Sequence[str]) -> dict[str, float]:
    """Median of the ``values`` (n,) of each of the ``persons`` for whom there are some."""
    known = np.isfinite(values)
    values, person = values[known], person[known]
    order = np.argsort(person, kind="stable")
    ends = np.searchsorted(person[order], np.arange(len(persons) + 1))
    found = zip(persons, np.split(values[order], ends[1:-1]))
    return {name: round(float(np.median(mine)), 5) for name, mine in found if mine.size}


class RaysBuilder:
    """Collects rays source by source, takes them into the frame of rays, drops what cannot be used, and keeps the
    account: how many rows of which source were dropped, and why.

    ``frame``: that of all that is added. ``skip_bad_lines``: leave out lines that cannot be read, with an account of
    them too, as long as they are at most `BAD_LINES` of a file's, or one. ``on_source``: called with the name of each
    source as it is begun. ``on_rays``: takes the rays as soon as there are `STREAMED` of them, with no metadata but
    their frame, so that memory is bounded whatever the size of the sources; `build` then gives the last ones.
    """

    def __init__(
        self,
        frame: TrackingFrame = RAYS,
        *,
        skip_bad_lines: bool = False,
        on_source: Callable[[str], None] | None = None,
        on_rays: Callable[[Rays], None] | None = None,
    ) -> None:
        self._frame, self._transform, self._on_source = frame, frame.to_rays(), on_source
        self._on_rays = on_rays
        self._notes: dict[str, Any] = {}
        self._parts: list[dict[str, np.ndarray]] = []
        self._kept: list[int] = []
        self._persons, self._cohorts = NameCodes(), NameCodes()
        self._sources: list[dict[str, Any]] = []
        self._path = Path()  # of the present source
        self._dropped: list[dict[str, Any]] = []
        self._rows_read = self._runs = 0
        self._unused: dict[str, None] = {}
        self._missing = Counter[str]()
        self._filled = FilledOrigins(1.0)
        self._skips, self._lines, self._bad, self._first_bad = skip_bad_lines, 0, [], ""

    def note(self, **what: Any) -> None:
        """Keep something in the metadata of the rays; values as JSON has them."""
        self._notes.update(what)

    def complain(self, sentence: str) -> None:
        """Say what is likely wrong with the files, and the remedy; it stands on the card of the rays."""
        found = self._notes.setdefault("complaints", [])
        if sentence not in found:
            found.append(sentence)

    def read_table(
        self,
        path: Path,
        numbers: Sequence[str],
        texts: Sequence[str] = (),
        *,
        also_used: Sequence[str] = (),
        header: Sequence[str] | None = None,
        first_line: int = 1,
        clocks: Mapping[str, float] | None = None,
    ) -> Iterator[TableBlock]:
        """Blocks of a table of the present source, as `iterate_table` gives them, with an account of the lines that
        cannot be read and of the columns that are not used; ``also_used``: those that are read in another way."""
        used = {*numbers, *texts, *also_used}
        there = read_table_columns(path) if header is None else header
        self.note_unused(name for name in there if name and name not in used)
        how = {"first_line": first_line, "clocks": clocks, "on_note": self.note}
        return iterate_table(path, numbers, texts, header, self.on_bad, **how)

    def read_whole(self, path: Path, numbers: Sequence[str]) -> np.ndarray:
        """Columns (n, C) of a table that gives no rays, whose lines are counted, as `read_table` reads them."""
        blocks = [block.numbers for block in self.read_table(path, numbers)]
        values = np.concatenate(blocks or [np.empty((0, len(numbers)))])
        self.count_lines(len(values))
        return values

    def note_unused(self, columns: Iterable[str]) -> None:
        """Name columns of the files that are not used on the card of the rays."""
        self._unused.update(dict.fromkeys(columns))

    @property
    def on_bad(self) -> BadLineCallback | None:
        """Called with each line that cannot be read: its number, from 1, and why. None where it ends the import."""
        return self._bad_line if self._skips else None

    def _bad_line(self, line: int, why: str) -> None:
        self._first_bad = self._first_bad or f"line {line}{why}"
        self._bad.append(line)
        # Files of another format altogether: their lines need not all be counted.
        if len(self._bad) > 10_000 + BAD_LINES * self._lines:
            self._end_source()

    def count_lines(self, n: int) -> None:
        """Count lines of the present source that were read and give no rays."""
        self._lines += n

    def _end_source(self) -> None:
        """Account for the bad lines of the present source. Raises `NergError` if they are too many."""
        bad, lines = len(self._bad), self._lines + len(self._bad)
        if bad > max(1, BAD_LINES * lines):
            raise NergError(
                f"{self._sources[-1]['file']}: {bad:,} of {lines:,} lines cannot be read, more than the "
                f"{100 * BAD_LINES:g} % that --skip-bad-lines leaves out (the first is {self._first_bad})"
            )
        if bad:
            self._drop("the line is cut off, has cells too many, or holds one that is no number", np.array(self._bad))
            self._rows_read += bad
        if self._sources and "sha256" not in self._sources[-1]:
            self._sources[-1]["sha256"] = file_sha256(self._path)
        self._lines, self._bad, self._first_bad = 0, [], ""
        for code, count in self._filled.undecided.items():
            self.complain(
                f"the first {count:,} rows of {self._persons.name(code)} in {self._sources[-1]['file']} have one exact "
                "fill value as their origin, and were kept; leave them out (nerg rays filter --time)"
            )
        self._filled = FilledOrigins(float(np.cbrt(abs(np.linalg.det(self._transform[:3, :3])))))

    def source(self, path: Path, name: str | None = None) -> None:
        """Begin a file; only its name (or another one, where files share theirs) is recorded, with its checksum.

        The checksum is computed at the file's end: what is not of the format is refused before gigabytes are read."""
        self._end_source()
        check_regular_file(path, "tracking file", SOURCE_BYTES)
        if self._on_source is not None:
            self._on_source(name or path.name)
        self._path = path
        self._sources.append({"file": name or path.name})

    def add(
        self,
        t: np.ndarray,
        person: Sequence[str] | np.ndarray | str,
        origin: np.ndarray,
        direction: np.ndarray,
        *,
        rows: np.ndarray,
        confidence: np.ndarray | None = None,
        hit: np.ndarray | None = None,
        cohort: Sequence[str] | np.ndarray | None = None,
        head: np.ndarray | None = None,
        eye_distance: np.ndarray | None = None,
        drop: dict[str, np.ndarray] | None = None,
        recorded_origin: np.ndarray | None = None,
        recorded_direction: np.ndarray | None = None,
    ) -> None:
        """Add n rows of the present source.

        ``t`` (n,) seconds. ``person``: a name for each row, or one for all. ``origin`` (n, 3) and ``hit`` (n, 3), the
        point looked at: in the frame and units given to the builder. ``direction`` (n, 3) in the same frame, of any
        length. ``confidence`` (n,) in [0, 1], by default one. ``cohort``: the name of each row's group of people.
        ``head`` (n, 3): where the head points, in the same frame, of any length, NaN or zero where that is unknown;
        left out where ``direction`` is the head's. ``eye_distance`` (n,): between both eyes, in the same units and
        recorded as the origins are, NaN where one is not seen. ``rows`` (n,): 1-based rows of the
        source. ``drop``: reasons of the recording's own, each with its mask (n,), before those found here: what is NaN
        or, of a direction, zero. ``recorded_origin`` and ``recorded_direction`` (n, 3): as the file has them, where
        ``origin`` and ``direction`` were computed of them: exact fill values such as 0, 0, 0 or -1, -1, -1 are looked
        for there. A row counts under the first reason it meets; one without a person's name is dropped,
        one without a cohort is of the cohort "unknown".
        """
        n = len(t)
        person = self._persons.codes(person, n)
        length = np.linalg.norm(direction, axis=1)
        confidence = np.ones(n) if confidence is None else np.asarray(confidence, dtype=np.float64)
        filled_origins = self._filled.find(origin if recorded_origin is None else recorded_origin, person)
        fill = fill_values(direction if recorded_direction is None else recorded_direction)
        reasons = {
            **(drop or {}),
            "person is missing": person == self._persons.code(""),
            "origin is a repeated fill value": filled_origins,
            **{f"direction is the fill value {f:g}, {f:g}, {f:g}": fill == f for f in np.unique(fill[abs(fill) > 0])},
            "time is missing": ~np.isfinite(t),
            "origin is missing": ~np.isfinite(origin).all(axis=1),
            f"origin is beyond {MAX_COORDINATE:g} m": ~(np.abs(self._moved(origin)) <= MAX_COORDINATE).all(axis=1),
            "direction is missing": ~np.isfinite(length),
            "direction is zero": length == 0,
            "confidence is missing or outside [0, 1]": ~((confidence >= 0) & (confidence <= 1)),
        }
        keep = np.ones(n, dtype=bool)
        for reason, mask in reasons.items():
            gone = keep & mask
            if gone.any():
                self._drop(reason, np.asarray(rows)[gone])
                keep &= ~mask
        self._rows_read += n
        self._lines += n
        R = self._transform[:3, :3]
        scale = np.cbrt(abs(np.linalg.det(R)))
        part = {
            "t": np.asarray(t, dtype=np.float64)[keep],
            "person": person[keep],
            "origin": self._moved(origin[keep]),
            "direction": (direction[keep] / length[keep, None]) @ (R / scale).T,
            "confidence": confidence[keep],
        }
        if hit is not None:
            hit = self._without_filled(hit, origin, direction, keep)
            part["hit"] = self._moved(hit[keep])
            beyond = (np.abs(part["hit"]) > MAX_COORDINATE).any(axis=1)
            if beyond.any():
                part["hit"][beyond] = np.nan
                self._missing[f"hit points beyond {MAX_COORDINATE:g} m"] += int(np.count_nonzero(beyond))
        if head is not None:
            with np.errstate(invalid="ignore", divide="ignore"):
                unit = head[keep] / np.linalg.norm(head[keep], axis=1, keepdims=True)
            part["head"] = (unit @ (R / scale).T).astype(np.float32)
        if eye_distance is not None:
            part[_EYES] = (scale * eye_distance[keep]).astype(np.float32)
        if cohort is not None:
            part["cohort"] = self._cohorts.codes(cohort, n)[keep]
        self._parts.append(part)
        self._kept.append(int(keep.sum()))
        if self._on_rays is not None and sum(self._kept) >= STREAMED:
            self._on_rays(self._take({"frame": dict(FRAME)}))

    def _without_filled(
        self, hit: np.ndarray, origin: np.ndarray, direction: np.ndarray, keep: np.ndarray
    ) -> np.ndarray:
        """Hit points (n, 3) with NaN for fill values at which the ray does not point, which are counted."""
        fill = fill_values(hit)
        rows = np.flatnonzero(np.isfinite(fill) & keep)
        rows = rows[~is_aimed(origin[rows], direction[rows], hit[rows])]
        if not len(rows):
            return hit
        for value, count in zip(*np.unique(fill[rows], return_counts=True)):
            self._missing[f"hit points that are the fill value {value:g}, {value:g}, {value:g}"] += int(count)
        hit = hit.copy()
        hit[rows] = np.nan
        return hit

    def _moved(self, points: np.ndarray) -> np.ndarray:
        """``points`` (N, 3) in the frame of rays."""
        with np.errstate(over="ignore", invalid="ignore"):
            return points @ self._transform[:3, :3].T + self._transform[:3, 3]

    def _drop(self, reason: str, rows: np.ndarray) -> None:
        name = self._sources[-1]["file"] if self._sources else ""
        entry = next((e for e in self._dropped if e["reason"] == reason and e["file"] == name), None)
        if entry is None:
            entry = {"reason": reason, "file": name, "count": 0, "rows": []}
            self._dropped.append(entry)
        runs = _ranges(rows)
        named = runs[: max(0, NAMED_RUNS - self._runs)]
        self._runs += len(named)
        entry["count"] += int(rows.size)
        entry["rows"] += named
        if len(named) < len(runs):
            entry["rows_not_named"] = entry.get("rows_not_named", 0) + sum(
                last - first + 1 for first, last in runs[len(named) :]
            )

    def build(self) -> Rays:
        """The rays collected, with the metadata of all; the builder is empty afterwards. Raises `NergError` when no ray
        is left, unless somebody has taken the rays as they came: then these may be none."""
        self._end_source()
        if not sum(self._kept) and self._on_rays is None:
            why = "; ".join(f"{d['count']} rows: {d['reason']}" for d in self._dropped[:4]) or "the files hold no rows"
            raise NergError(f"no ray is left of {self._rows_read} rows ({why}); check the column map and the preset")
        doubtful = [name for name in self._unused if looks_like_validity(name)]
        if doubtful:
            more = f" and {len(doubtful) - 3} more" if len(doubtful) > 3 else ""
            self.complain(
                f"{', '.join(map(repr, doubtful[:3]))}{more} may say by name which rows are valid, and is not used; "
                "use it with --map and --valid"
            )
        metadata = {
            "frame": dict(FRAME),
            "transform": self._transform.tolist(),
            "source_frame": self._frame.to_dict(),
            "sources": self._sources,
            "rows_read": self._rows_read,
            "dropped": self._dropped,
            **({"missing": dict(self._missing)} if self._missing else {}),
            **({"unused_columns": list(self._unused)[:_UNUSED]} if self._unused else {}),
            **self._notes,
        }
        return self._take(metadata)

    def _take(self, metadata: dict[str, Any]) -> Rays:
        """The rays that are here, which the builder then has no more."""
        if not self._parts:
            none = np.zeros((0, 3))
            return Rays(none[:, 0], np.zeros(0, np.int32), (), none, none, none[:, 0], metadata=metadata)
        columns = {name: self._column(name) for name in COLUMNS if any(name in part for part in self._parts)}
        columns["person"], persons = self._persons.sorted(columns["person"])
        if any(_EYES in part for part in self._parts):
            metadata[_EYES] = _medians(self._column(_EYES), columns["person"], persons)
        cohorts: tuple[str, ...] = ()
        if "cohort" in columns:
            columns["cohort"], cohorts = self._cohorts.sorted(columns["cohort"])
            cohorts = tuple(c or "unknown" for c in cohorts)
        self._parts, self._kept = [], []
        check_near_origin(columns["origin"], "what is tracked", np.linalg.inv(self._transform))
        return Rays(**columns, persons=persons, cohorts=cohorts, metadata=metadata)

    def _column(self, name: str) -> np.ndarray:
        """A column of all parts; those without one get NaN or the cohort "". The parts' own are let go, so that no more
        than one column is there twice."""
        lacking = {
            "hit": lambda n: np.full((n, 3), np.nan),
            "head": lambda n: np.full((n, 3), np.nan, np.float32),
            _EYES: lambda n: np.full(n, np.nan, np.float32),
            "cohort": lambda n: self._cohorts.codes("", n),
        }
        return np.concatenate(
            [part.pop(name) if name in part else lacking[name](n) for part, n in zip(self._parts, self._kept)]
        )


class NameCodes:
    """Numbers for names, in the order met: texts of millions of rows are not kept."""

    def __init__(self) -> None:
        self._code: dict[str, int] = {}

    def code(self, name: str) -> int:
        return self._code.setdefault(name, len(self._code))

    def name(self, code: int) -> str:
        return list(self._code)[code]

    def codes(self, names: Sequence[str] | np.ndarray | str, n: int) -> np.ndarray:
        """Codes (n,) int32 of one name for all or of n names."""
        if isinstance(names, str):
            return np.full(n, self.code(names.strip()), dtype=np.int32)
        names = np.asarray(names, dtype=str)
        # Rows of one person mostly follow each other: names are looked up where they change.
        starts = np.flatnonzero(np.r_[True, names[1:] != names[:-1]][:n])
        stripped = (name.strip() for name in names[starts].tolist())
        codes = np.array([self.code("" if s.lower() in _NO_NAMES else s) for s in stripped], dtype=np.int32)
        return np.repeat(codes, np.diff(np.r_[starts, n]))

    def sorted(self, codes: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Codes into the sorted names of those that occur, and these names."""
        names = list(self._code)
        used = sorted(np.unique(codes), key=lambda c: names[c])
        place = np.zeros(len(names), dtype=np.int32)
        place[used] = np.arange(len(used))
        return place[codes], tuple(names[c] for c in used)


# ---- Options ----
#
# Typed options of a reader: fields of a frozen dataclass, from which the command line and the manual are made.

_KEY = "nerg_mi.reader_option"


@dataclass(frozen=True)
class Option:
    """One option of a reader, as :func:`options_of` finds it."""

    name: str  # of the dataclass's field
    flag: str  # on the command line: --tick
    kind: type  # of the value, without None: str, float, int, bool, Path; str where `parse` makes the value
    default: Any  # of the field
    shown: str  # the default in words; empty where there is none to speak of
    help: str  # a sentence, units included
    parse: Callable[[str], Any] | None  # from the command line's text to the value
    recorded: bool  # whether a value goes into the metadata of rays under its name


def option(
    default: Any,
    help: str,
    *,
    flag: str | None = None,
    shown: str | None = None,
    within: Range | None = None,
    parse: Callable[[str], Any] | None = None,
    recorded: bool = True,
) -> Any:
    """A field of a reader's options, with what is said of it on the command line and in the manual.

    ``flag``: on the command line, where that is not the field's name with hyphens. ``shown``: the default in words,
    where it does not speak for itself. ``within``: the range of its numbers, which each option that has any needs, and
    for which the dataclass derives from `Checked`. ``parse``: makes the value of the command line's text, and raises
    `NergError` naming the flag; without it the field's type is that of the command line (str, int, float, bool or Path,
    or None besides). ``recorded``: false for what the metadata of rays tell in another way, as the frame.
    """
    about = {"help": help, "flag": flag, "shown": shown, "parse": parse, "recorded": recorded}
    return dataclasses.field(default=default, metadata={_KEY: about, RANGE: within, FLAG: flag or ""})


def tick_option(default: float = 1.0) -> Any:
    """The unit of the file's time, in seconds."""
    return option(default, "Seconds in one unit of the file's time.", within=TIME_UNITS)


def valid_option() -> Any:
    """Which values of columns of validity mark valid rows; to be parsed by `parse_valid`."""
    return option(
        None,
        'Columns of validity and the values of rows that are kept, as "gaze_status=2" or "isValid=true,1"; '
        "none: no column is one.",
    )


@dataclass(frozen=True, kw_only=True)
class NoOptions:
    """The options of a reader that has none."""


@dataclass(frozen=True, kw_only=True)
class TickOption(ValidatedDataclass):
    """For readers of files whose unit of time is not known. Raises `NergError` for what is no length of time."""

    tick: float = tick_option()


# Annotations are evaluated as code: once, when a reader is registered, and not beside files that are read.
@functools.cache
def list_options(kind: type) -> tuple[Option, ...]:
    """The options of a dataclass, in the order of its fields.

    Raises ``TypeError`` for one that is no frozen dataclass, or a field that was not made by :func:`option`.
    """
    if not dataclasses.is_dataclass(kind):
        raise TypeError(f"{kind.__qualname__} is no dataclass; options of a reader are a frozen one")
    hints = typing.get_type_hints(kind)
    found = []
    for field in dataclasses.fields(kind):
        if _KEY not in field.metadata:
            raise TypeError(f"{kind.__qualname__}.{field.name} says nothing of itself; make it with option(...)")
        about = field.metadata[_KEY]
        shown = about["shown"]
        if shown is None:
            shown = "" if field.default is None or isinstance(field.default, bool) else _number(field.default)
        found.append(
            Option(
                name=field.name,
                flag=about["flag"] or "--" + field.name.replace("_", "-"),
                kind=str if about["parse"] else _without_none(hints[field.name]),
                default=field.default,
                shown=shown,
                help=about["help"],
                parse=about["parse"],
                recorded=about["recorded"],
            )
        )
    return tuple(found)


def recorded_options(options: Any) -> dict[str, Any]:
    """The values that go into the metadata of rays: those that are set, tuples as lists. Files are kept there as
    sources, when a reader begins them."""
    known = [o for o in list_options(type(options)) if o.recorded and o.kind is not Path]
    values = {o.name: getattr(options, o.name) for o in known}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items() if v is not None}


def _without_none(hint: Any) -> type:
    """``float`` of ``float | None``."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
    return hint


def _number(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# ---- What a reader of tracking files is ----
#
# To add a format, write a module (in `glasses` or `headsets` where it is of one) with a class that has what
# :class:`Reader` names, and an object of it in its ``READERS``; add the module to the list in
# :mod:`nerg_mi.rays.readers.registry`. The command line, its help and the manual's table are made from it. A reader
# takes files apart and says in which frame they are; dropping rows, converting the frame and keeping the account is the
# builder's work, the same for all.

O = TypeVar("O")
"""The type of a reader's options: a frozen dataclass whose fields are made by `nerg_mi.rays.readers.base.option`."""

RECORDINGS = "recordings"  # Of a reader that was checked on recordings of people
DESCRIPTION = "generated files"
"""Of one that was checked on files made after the source or manual of the program that writes them."""


@dataclass(frozen=True, kw_only=True)
class Signature:
    """By what `nerg rays guess` tells files of a format from others: any of these. Without any it is not proposed."""

    files: tuple[tuple[str, str], ...] = ()
    """Names of a file and of one beside it, which make a folder of both a recording."""

    ending: str = ""
    """How the name of a file ends, in lower case."""

    columns: tuple[tuple[str, ...], ...] = ()
    """Columns that a table has, all of them; where those of several formats are there, the largest set counts."""

    line: Callable[[str], str | None] = lambda line: None
    """What in the first line of a file tells, or None."""

    table: Callable[[ColumnFinder], str | None] = lambda table: None
    """What in a table's columns tells where a reader looks for them by several names, or None. Asked last."""

    options: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Flags of what no file says, with a word in place of the value."""

    question: str = ""
    """What these are."""


class InFrame:
    """A base of readers whose files are always in one frame, and who have no options unless they say so."""

    fixed: TrackingFrame
    Options: type[Any] = NoOptions

    def frame(self, files: Sequence[Path], options: Any) -> TrackingFrame:
        return self.fixed


class Reader(Protocol[O]):
    """A format of tracking files."""

    name: str
    """Its word for ``--preset``: lower case letters, digits and underscores."""

    files: str
    """What to give, in a phrase of Markdown: the files, and the columns that they need."""

    world: str
    """The frame of its files, in a phrase of Markdown."""

    checked_on: str
    """What it was checked on: `RECORDINGS`, `DESCRIPTION`, or words of its own."""

    signature: Signature
    """By what its files are told from others."""

    Options: type[O]
    """Its options; `nerg_mi.rays.readers.base.NoOptions` where it has none."""

    def frame(self, files: Sequence[Path], options: O) -> TrackingFrame:
        """The frame of what `read` adds: fixed, declared by ``options``, or found in ``files``; one for all of them."""
        ...

    def read(self, files: Sequence[Path], options: O, builder: RaysBuilder) -> None:
        """Add the rays of ``files`` (or folders), source by source, to ``builder``.

        Each file is begun with ``builder.source(path)``, and its rows are added block by block with ``builder.add``:
        times in seconds, origins and hit points in the frame and units of `frame`, directions of any length,
        confidences in [0, 1], NaN where something is missing, the 1-based ``rows`` of the file, and reasons of the
        format's own to ``drop`` some. The checks of rays see more where the file has heads (``head``) and both eyes
        (``eye_distance``); where the height 0 of the files is not the floor, ``builder.note(floor="unknown")`` says so.
        Tables are read by ``builder.read_table``, which names the columns that are not used. Where origins or
        directions are computed, ``recorded_origin`` and ``recorded_direction`` are those of the file, in which fill
        values are looked for. Lines that cannot be read are told to ``builder.on_bad`` where there is one. What
        else is worth keeping goes into the metadata with ``builder.note``; options are kept there already. Memory stays
        bounded by the blocks. Raises `NergError` for what the user can mend: a missing column or file, a damaged one,
        an option that is needed.
        """
        ...
