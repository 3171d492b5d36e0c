"""Building rays of what readers find: one frame for all, what cannot be used dropped, with an account of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import size_of
from nerg_mi.files.checksum import file_sha256
from nerg_mi.files.line_blocks import OnBadLine
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.ranges import FARTHEST
from nerg_mi.rays.rays import COLUMNS, FRAME, Rays

from .frames import RAYS, Frame
from .parsing.fill_values import FilledOrigins, fill_values, is_aimed
from .parsing.tables import TableBlock, iterate_table, table_columns
from .parsing.validity import looks_like_validity

BAD_LINES = 0.01
"""Share of a file's lines that may be left out since they cannot be read."""

SOURCE_BYTES = 16 << 30
"""A file may have so many bytes, for its checksum takes a second for each of some 10^9."""

STREAMED = 1 << 20
"""So many rays are kept at a time where somebody takes them as they come."""

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
        frame: Frame = RAYS,
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
        self._persons, self._cohorts = _Names(), _Names()
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
        there = table_columns(path) if header is None else header
        self.note_unused(name for name in there if name and name not in used)
        how = {"first_line": first_line, "clocks": clocks, "on_note": self.note}
        return iterate_table(path, numbers, texts, header, self.on_bad, **how)

    def note_unused(self, columns: Iterable[str]) -> None:
        """Name columns of the files that are not used on the card of the rays."""
        self._unused.update(dict.fromkeys(columns))

    @property
    def on_bad(self) -> OnBadLine | None:
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
        size_of(path, "tracking file", SOURCE_BYTES)
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
            f"origin is beyond {FARTHEST:g} m": ~(np.abs(self._moved(origin)) <= FARTHEST).all(axis=1),
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
            beyond = (np.abs(part["hit"]) > FARTHEST).any(axis=1)
            if beyond.any():
                part["hit"][beyond] = np.nan
                self._missing[f"hit points beyond {FARTHEST:g} m"] += int(np.count_nonzero(beyond))
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


class _Names:
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
