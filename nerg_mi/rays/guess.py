"""Proposes how an unknown table of tracking is imported: by names of columns, signatures of programs and rows."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_line_blocks, resolve_path

from .readers import poses
from .readers.base import BAD_LINES, UNITS, Reader
from .readers.columns import (
    ColumnFinder,
    ColumnMap,
    Roles,
    find_roles,
    in_degrees,
    is_counter,
    is_validity,
    time_unit,
    valid_values,
)
from .readers.registry import readers
from .readers.tables import clock_seconds, iterate_table

# ---- Row evidence ----
#
# What the rows of a table tell of its frame: the up axis and the unit by where heads are, the clock by its steps, the
# way heads look by where they walk, and whether gaze is the head's or the world's by how far it is from the head.

_LOW, _HIGH = 0.7, 2.3  # metres: so high are eyes, of people who sit or stand
_STAYS = 1.2  # metres: they hardly vary more in height
_RATES = 5.0, 2100.0  # rows a second of devices that there are
_TICKS = (1.0, 1e-3, 1e-6, 1e-9, 1e-7)
_STEP = 0.5  # seconds of walking that are looked at
_WALK = 0.3, 3.0  # metres a second
_AHEAD = 0.3  # mean cosine of a way to look and walking, from which on it is ahead
_FEWEST = 50  # steps of walking


@dataclass(frozen=True)
class Standing:
    """The axis that is up and the unit of length, by ``height``, the median along it in metres."""

    up: str
    units: str
    height: float


def find_standing(places: np.ndarray) -> Standing | None:
    """Of places of heads (n, 3), the one axis along which they stay where eyes are, in metres, centimetres or
    millimetres; None where no axis does, or two do."""
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return None
    low, middle, high = np.percentile(places, [5, 50, 95], axis=0)
    moves = np.ptp(places, axis=0).max() > 0
    found = []
    for units, metre in UNITS.items():
        for axis in range(3):
            height, varies = abs(middle[axis]) * metre, (high - low)[axis] * metre
            # An axis along which nothing moves may be a constant of another kind, but for a head that is not tracked.
            if _LOW <= height <= _HIGH and varies < _STAYS and moves:
                found.append((Standing(("-" if middle[axis] < 0 else "") + "xyz"[axis], units, height), varies))
    metres = [f for f in found if f[0].units == "m"] or found
    if len(metres) > 1:
        # Somebody who stays in a room may be at 1.6 m along each axis: up is where all of the time is spent.
        metres.sort(key=lambda f: f[1])
        if metres[0][1] > 0.5 * metres[1][1]:
            return None
    return metres[0][0] if metres else None


def find_tick(times: np.ndarray) -> float | None:
    """Seconds in a unit of ``times`` (n,), under which rows come as often as a device's; None where none fits."""
    step = np.diff(times[np.isfinite(times)])
    step = step[step > 0]
    if not step.size:
        return None
    middle = float(np.median(step))
    return next((t for t in _TICKS if _RATES[0] <= 1 / (middle * t) <= _RATES[1]), None)


def is_unit(vectors: np.ndarray, tolerance: float = 0.02) -> bool:
    """Whether nearly all of (n, C) that are finite have the length one; zeros count as missing."""
    length = np.linalg.norm(vectors, axis=1)
    length = length[np.isfinite(length) & (length > 1e-9)]
    return bool(length.size and np.mean(np.abs(length - 1) < tolerance) > 0.95)


def find_forward(turns: np.ndarray, places: np.ndarray, seconds: np.ndarray, up: str, metre: float) -> str | None:
    """The axis of the head's frame that points where people walk; None where they do not walk, or no axis does.

    ``turns`` (n, 3, 3) head to table, ``places`` (n, 3), ``seconds`` (n,); ``metre``: of a unit of length.
    """
    way = _walking(places, seconds, up, metre)
    good = np.isfinite(way).all(axis=1) & np.isfinite(turns).all(axis=(1, 2))
    if good.sum() < _FEWEST:
        return None
    level = _level(up)
    agree = {
        name: float(np.mean(np.sum((turns[good] @ axis) * level * way[good], axis=1)))
        for name, axis in poses.AXES.items()
        if name[-1] != up[-1]
    }
    best = max(agree, key=agree.__getitem__)
    return best if agree[best] > _AHEAD else None


def find_local(gaze: np.ndarray, turns: np.ndarray, forward: str) -> bool | None:
    """Whether ``gaze`` (n, 3) is in the head's frame rather than the table's: as which it is nearer to where the head
    points. None where both are alike, as of a head that does not turn."""
    ahead = poses.AXES[forward]
    length = np.linalg.norm(gaze, axis=1)
    good = np.isfinite(turns).all(axis=(1, 2)) & (length > 1e-9)
    d, heads = gaze[good] / length[good, None], turns[good] @ ahead
    if not len(d):
        return None
    angle = lambda cosine: float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
    local, world = angle(d @ ahead), angle(np.sum(d * heads, axis=1))
    return None if abs(local - world) < 5.0 else local < world


def _walking(places: np.ndarray, seconds: np.ndarray, up: str, metre: float) -> np.ndarray:
    """Unit directions (n, 3) of the level way of the next half second; NaN where nobody walks."""
    out = np.full(places.shape, np.nan)
    step = np.median(np.diff(seconds)) if len(seconds) > 1 else np.nan
    if not step > 0:
        return out
    lag = max(1, min(round(_STEP / step), len(places) - 1))
    moved = (places[lag:] - places[:-lag]) * _level(up)
    taken = seconds[lag:] - seconds[:-lag]
    length = np.linalg.norm(moved, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = metre * length / taken
        walks = (speed > _WALK[0]) & (speed < _WALK[1]) & (taken < 4 * _STEP)
    out[:-lag][walks] = moved[walks] / length[walks, None]
    return out


def _level(up: str) -> np.ndarray:
    """One for each axis but the up one."""
    return (np.arange(3) != "xyz".index(up[-1])).astype(np.float64)


# ---- Presets by what tells their files from others (`nerg_mi.rays.readers.base.Signature`) ----


def preset_of_files(path: Path) -> tuple[Reader[Any], str] | None:
    """The reader of a file or a folder ``path`` by the names of files, and why."""
    folder = path if path.is_dir() else path.parent
    for reader in readers():
        for file, beside in reader.signature.files:
            if (path.is_dir() or path.name == file) and (folder / file).is_file() and (folder / beside).is_file():
                return reader, f"{file} with {beside} beside it"
        ending = reader.signature.ending
        if ending and path.name.lower().endswith(ending):
            return reader, f"its name ends in {ending}"
    return None


def preset_of_text(path: Path) -> tuple[Reader[Any], str] | None:
    """The reader of a file by its first line, where that is no header, and why."""
    for block in read_line_blocks(path, "tracking file", 1):
        return next(((reader, why) for reader in readers() if (why := reader.signature.line(block[0]))), None)
    return None


def preset_of_columns(table: ColumnFinder) -> tuple[Reader[Any], str] | None:
    """The reader of a table by its columns, and which of them tell."""
    there = set(table.columns)
    sets = [
        (columns, reader) for reader in readers() for columns in reader.signature.columns if there.issuperset(columns)
    ]
    if sets:
        columns, reader = max(sets, key=lambda found: len(found[0]))
        return reader, f"it has the columns {', '.join(columns)}"
    return next(((reader, why) for reader in readers() if (why := reader.signature.table(table))), None)


# ---- The first rows of a table: which of its columns hold numbers or times, and these ----


_PEEKED = 40  # lines that tell which columns hold numbers
_WORDS = {"", "nan", "na", "n/a", "null", "none", "-"}
_WIDEST = 400  # columns of which numbers are looked at


class TableSample:
    """At most 65,536 rows of those ``columns`` of a table that hold numbers; ``numbers[name]`` is (n,) float64.

    Times as text are seconds, and named in ``clocks``. A name that several columns have is none. Raises `NergError`
    where more than 1 % of the rows have more or fewer cells than the header.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        self.columns = [name for name in columns if list(columns).count(name) == 1]
        self.repeated = sorted(set(columns) - set(self.columns))
        kinds = _numeric(path, list(columns))
        wanted = [name for name in self.columns if name in kinds][:_WIDEST]
        for name in (wanted or self.columns)[:1]:
            self.texts(name)
        self.clocks = {name for name in wanted if kinds[name]}
        self.numbers: dict[str, np.ndarray] = {}
        # Cells that are no numbers are left to the import.
        clocks = dict.fromkeys(self.clocks, 1.0)
        for block in iterate_table(path, wanted, on_bad=lambda line, why: None, clocks=clocks):
            self.numbers = dict(zip(wanted, block.numbers.T))
            break
        self.rows = len(next(iter(self.numbers.values()), ()))

    def vector(self, names: Sequence[str]) -> np.ndarray:
        """Columns as (n, C); NaN for those that hold no numbers."""
        missing = np.full(self.rows, np.nan)
        return np.stack([self.numbers.get(name, missing) for name in names], axis=1)

    def texts(self, name: str) -> np.ndarray:
        """The cells of a column as they stand (n,)."""
        bad: list[tuple[int, str]] = []
        for block in iterate_table(self.path, (), [name], on_bad=lambda line, why: bad.append((line, why))):
            if len(bad) > max(1, BAD_LINES * len(block.lines)):
                break
            return block.texts[:, 0]
        if len(bad) > 1:
            raise NergError(f"{self.path}, line {bad[0][0]}{bad[0][1]}")
        return np.empty(0, str)


def _numeric(path: Path, columns: list[str]) -> dict[str, bool]:
    """Names of the columns that hold numbers or times alone, or nothing, and whether they hold times as text."""
    if path.suffix.lower() == ".parquet":
        return {name: kind for name in dict.fromkeys(columns) if (kind := _parquet_kind(path, name)) is not None}
    head, *rows = next(iter(read_line_blocks(path, "table", _PEEKED + 1)), [""])
    separator = max(",;\t", key=head.count)
    kinds: list[set[bool | None]] = [set() for _ in columns]
    for line in rows:
        try:
            cells = next(csv.reader([line], delimiter=separator), [])
        except csv.Error:
            continue
        for k, cell in enumerate(cells[: len(columns)]):
            if cell.strip().lower() not in _WORDS:
                kinds[k].add(_kind(cell))
    return {name: True in kind for name, kind in zip(columns, kinds) if kind in ({True}, {False})}


def _kind(cell: str) -> bool | None:
    """False of a number, True of a time, None of another text."""
    try:
        # Whether a comma is the decimal sign is left to the reader of the table.
        float(cell.replace(",", ".", 1))
    except ValueError:
        return True if clock_seconds(cell) else None
    return False


def _parquet_kind(path: Path, name: str) -> bool | None:
    for is_clock, clocks in ((False, None), (True, {name: 1.0})):
        try:
            next(iterate_table(path, [name], clocks=clocks), None)
        except NergError:
            continue
        return is_clock
    return None


# ---- A proposal of how to import an unknown table: a preset, or a column map with the frame that it needs ----
#
# Nothing is applied: the proposal says what is sure, what is a guess and what no file says, and gives the command to
# run.

_DIRECTION = {"dir", "direct", "direction", "forward", "vec", "vector", "ray", "normal", "look", "gazedir"}
_HIT = {"hit", "point", "intersection", "target", "fixation", "poi", "collision"}
_HEAD = {"head", "hmd", "camera", "cam", "device", "body", "headset"}
_GAZE = {"gaze", "eye", "eyes"}
_SIDES = {"left", "right", "l", "r", "0", "1"}


@dataclass
class Proposal:
    """How to import ``paths``; ``options`` of the command line beside the preset or the map, and sentences on what is
    ``sure``, what is ``guessed`` and what is ``open``."""

    paths: list[Path]
    preset: str | None = None
    columns: ColumnMap | None = None
    options: dict[str, str] = field(default_factory=dict)
    certain: list[str] = field(default_factory=list)
    guesses: list[str] = field(default_factory=list)
    questions: list[str] = field(default_factory=list)

    @property
    def command(self) -> str | None:
        """The whole import command; None where nothing can be proposed."""
        if self.preset is None and self.columns is None:
            return None
        what = ["--preset", self.preset] if self.preset else ["--map", str(self.columns)]
        stem = resolve_path(self.paths[0]).name.split(".")[0] or "rays"
        words = ["nerg", "rays", "import", *map(str, self.paths), "-o", f"{stem}.npz", *what]
        for flag, value in self.options.items():
            words += [flag, value] if value else [flag]
        return shlex.join(words)


_TABLES = (".csv", ".csv.gz", ".tsv", ".txt", ".parquet")


def propose_imports(paths: Sequence[str | Path]) -> list[Proposal]:
    """What tracking files, or folders of recordings, are likely to be: a proposal for all that are imported alike.

    A folder that is no recording stands for the tables in it. Raises `NergError` as `propose_import` does, and for a
    folder without tables.
    """
    out: list[Proposal] = []
    for path in (table for source in paths for table in _tables_in(Path(source))):
        new = propose_import(path)
        how = new.preset, new.columns, new.options
        alike = next((p for p in out if new.command and (p.preset, p.columns, p.options) == how), None)
        if alike is None:
            out.append(new)
        else:
            alike.paths += new.paths
    return out


def _tables_in(path: Path) -> list[Path]:
    """The tables of a folder that is no recording, or the path itself."""
    if not path.is_dir() or preset_of_files(path) is not None:
        return [path]
    return sorted(p for p in path.iterdir() if p.is_file() and p.name.lower().endswith(_TABLES)) or [path]


def propose_import(path: str | Path) -> Proposal:
    """What the tracking file, or folder of a recording, ``path`` is likely to be.

    Raises `NergError` for a file that is no table, or is damaged.
    """
    path = Path(path)
    out = Proposal([path])
    found = preset_of_files(path)
    if found is None:
        if path.is_dir():
            names = ", ".join(f"{file} and {beside}" for reader in readers() for file, beside in reader.signature.files)
            raise NergError(
                f"the folder {path} is of no recording that is known by its files ({names}); name a file of it"
            )
        found = preset_of_text(path) if path.suffix.lower() != ".parquet" else None
    table = ColumnFinder(path) if found is None else None
    if table is not None:
        found = preset_of_columns(table)
    if found is not None:
        _use_preset(out, *found)
        return out
    assert table is not None
    if not any(_is_name(c) for c in table.columns):
        raise NergError(f"the first line of {path} holds no names of columns; a table needs a header: add one")
    _use_columns(out, TableSample(path, table.columns), find_roles(table.columns))
    return out


def _is_name(column: str) -> bool:
    try:
        float(column)
    except ValueError:
        return bool(column)
    return False


def _use_preset(out: Proposal, reader: Reader[Any], why: str) -> None:
    out.preset = reader.name
    out.certain.append(f"the preset {reader.name}: {why}")
    out.options |= reader.signature.options
    if reader.signature.question:
        out.questions.append(reader.signature.question)


def _use_columns(out: Proposal, sample: TableSample, roles: Roles) -> None:
    """Fill ``out`` with a column map, as far as there is one."""
    numbers = sample.numbers
    if sample.repeated:
        out.questions.append(f"several columns are called {', '.join(map(repr, sample.repeated[:8]))}: rename all but one")
    vectors = {s: v for s, v in roles.vectors.items() if all(c in numbers for c in v)}
    quaternions = {
        s: q for s, q in roles.quaternions.items() if all(c in numbers for c in q) and is_unit(sample.vector(q))
    }
    # A place named like a quaternion (x, y, z beside w) is none.
    vectors |= {s: q[:3] for s, q in roles.quaternions.items() if s not in quaternions and all(c in numbers for c in q)}
    parts = {stem: set(stem.replace("*", "").split("_")) for stem in (*vectors, *quaternions)}
    direction = _best(
        vectors,
        lambda s: 4 * bool(parts[s] & _DIRECTION) + 2 * is_unit(sample.vector(vectors[s])) - _aside(parts[s]),
        least=2,
        more=lambda s: bool(parts[s] & _GAZE) - 2 * bool(parts[s] & _HEAD),
    )
    hit = _best(vectors, lambda s: 3 * bool(parts[s] & _HIT) - _aside(parts[s]), least=3, but=(direction,))
    place = lambda prefer, but: _best(
        vectors,
        lambda s: 2 + 3 * bool(parts[s] & prefer) - 3 * bool(parts[s] & (_HIT | _DIRECTION)) - _aside(parts[s]),
        least=1,
        but=but,
    )
    turn = _best(quaternions, lambda s: 2 + 2 * bool(parts[s] & _HEAD) - _aside(parts[s]), least=1)
    matrix = next((m for m in roles.matrices.values() if all(c in numbers for c in m)), None)
    head = place(_HEAD, (direction, hit))
    eye = place(_GAZE, (direction, hit, head)) if head is not None and parts[head] & _HEAD else None
    has_pose = turn is not None or matrix is not None

    origin = head if has_pose or eye is None else eye
    standing = None
    where = sample.vector(matrix)[:, 3:12:4] if matrix else sample.vector(vectors[origin]) if origin else None
    if where is not None:
        standing = find_standing(where)
    time = _find_time(out, sample, roles)
    settings = _frame(out, standing, _gravity_up(sample, roles))
    turns = None
    if matrix is not None:
        turns, _ = poses.rotations_from_matrices(sample.vector(matrix))
        mirrored = poses.is_mirrored(sample.vector(matrix))
        if mirrored.any():
            out.questions.append(f"{mirrored.sum():,} of {len(mirrored):,} rows: {poses.MIRRORED}; the import drops them")
    elif turn is not None:
        turns = poses.rotations_from_quaternions(sample.vector(quaternions[turn]))
    gaze = sample.vector(vectors[direction]) if direction else None
    local = _pose_evidence(out, settings, turns, gaze, where, time[1])
    if turns is not None and gaze is not None and local is False:
        turn = matrix = turns = None
        if origin is None or (eye is not None and parts[eye] & _GAZE):
            origin = eye or origin
    chosen: dict = {
        "t": time[0],
        "person": _person(out, sample, roles),
        "confidence": _confidence(roles, sample),
        "hit": vectors[hit] if hit else None,
        "direction": vectors[direction] if direction else None,
        "xyzw": quaternions[turn] if turn else None,
        "matrix": matrix,
        "origin": vectors[origin] if origin and matrix is None else None,
        "eye": vectors[eye] if turns is not None and local and eye and eye != origin else None,
    }
    _use_angles(out, sample, roles, chosen)
    _use_validity(out, sample)
    _finish(out, sample, roles, chosen)


def _aside(parts: set[str]) -> int:
    """How much less likely a vector is of one eye only, or none that a head or gaze has."""
    return 2 * bool(parts & _SIDES)


def _best(stems, score, least: int, but: tuple = (), more=lambda stem: 0) -> str | None:
    """The stem of the highest score, of those that have ``least``; ``more`` decides between equal ones, then the order
    in the file."""
    fits = [s for s in stems if s not in but and score(s) >= least]
    return max(fits, key=lambda s: (score(s), more(s)), default=None)


def _find_time(out: Proposal, sample: TableSample, roles: Roles) -> tuple[str | None, np.ndarray | None]:
    """The column of the time, and its seconds."""
    name = next((c for c in (*roles.times, *sorted(sample.clocks)) if c in sample.numbers), None)
    if name is None:
        why = "no column is called so"
        if unread := next((c for c in roles.times if c in sample.columns), None):
            cell = sanitize(next(iter(sample.texts(unread)), ""), 40)
            why = f"{unread!r} holds {cell!r}, which is read neither as a number nor as 2024-05-01T12:00:00.25"
        out.questions.append(f"the time: {why}; without t= rows are numbered, and --tick is the time of one")
        return None, None
    if name in sample.clocks:
        out.certain.append(f"{name!r} holds times of day, or dates with them (in UTC where no offset is written)")
        return name, sample.numbers[name]
    stated, fits = time_unit(name), find_tick(sample.numbers[name])
    tick = stated or fits
    if stated:
        out.certain.append(f"{name!r} is the time, in units of {stated:g} s by its name")
    elif fits:
        out.assumptions.append(f"{name!r} is the time, in units of {fits:g} s by the steps between its rows")
    else:
        out.questions.append(f"the unit of the time {name!r}: its steps fit no device (--tick, seconds in one unit)")
    if stated and fits and not np.isclose(stated, fits):
        out.assumptions.append(f"the steps of {name!r} would be a device's in units of {fits:g} s: is its name right?")
    if tick and tick != 1.0:
        out.options["--tick"] = f"{tick:g}"
    return name, sample.numbers[name] * (tick or 1.0)


def _gravity_up(sample: TableSample, roles: Roles) -> str | None:
    """The axis against which gravity pulls, where the table has columns of it."""
    if roles.gravity is None or not sample.rows:
        return None
    pull = np.nan_to_num(np.nanmedian(sample.vector(roles.gravity), axis=0))
    axis = int(np.argmax(np.abs(pull)))
    if np.abs(pull[axis]) < 0.95 * np.linalg.norm(pull) or not pull.any():
        return None
    return ("-" if pull[axis] > 0 else "") + "xyz"[axis]


def _frame(out: Proposal, standing: Standing | None, against: str | None) -> dict[str, str]:
    """Up and units, as far as the rows tell: by where heads are, or by the axis ``against`` which gravity pulls."""
    if against is not None:
        out.certain.append(f"{against} is up: the columns of gravity say so")
    if standing is None or (against is not None and standing.up != against):
        if against is None:
            out.questions.append(
                "which axis is up (--up), the hand (--hand) and the unit (--units): along no one axis do the rows stay "
                "at the height of eyes"
            )
            out.options |= {"--up": "UP", "--hand": "HAND", "--units": "UNIT"}
            return {}
        out.options["--up"] = against
        out.assumptions.append("the unit is the metre; the rows are at no height that would tell, as where 0 is no floor")
        return {"up": against, "metre": "m"}
    out.options["--up"] = standing.up
    if standing.units != "m":
        out.options["--units"] = standing.units
    which = f"the unit is {standing.units}" if against else f"{standing.up} is up and the unit {standing.units}"
    out.assumptions.append(f"{which}: the rows stay at {standing.height:.2f} m along {standing.up}")
    return {"up": standing.up, "metre": standing.units}


def _pose_evidence(
    out: Proposal,
    settings: dict[str, str],
    turns: np.ndarray | None,
    gaze: np.ndarray | None,
    where: np.ndarray | None,
    seconds: np.ndarray | None,
) -> bool | None:
    """Hand and forward axis into ``out``, and whether gaze is in the head's frame."""
    up = settings.get("up")
    forward = None
    if turns is not None and up and where is not None and seconds is not None:
        forward = find_forward(turns, where, seconds, up, UNITS[settings["metre"]])
        if forward:
            out.assumptions.append(f"heads look along their {forward}: that is where they walk to")
    unity = up == "y" and forward != "-z"
    unreal = up is not None and up.endswith("z") and settings["metre"] == "cm"
    hand = "left" if unity or unreal else "right"
    if up:
        out.options["--hand"] = hand
        which = "as cameras' frames are" if up == "-y" else "as most worlds with that axis up are"
        if hand == "left":
            which = "as Unity's worlds with y up are" if unity else "as Unreal's worlds (z up, in centimetres) are"
        out.assumptions.append(
            f"the world is {hand}-handed, {which}; no row tells: a mirrored place is the sign of the other"
        )
    if turns is None:
        return None
    default = poses.default_forward(up, hand) if up else None
    if forward is not None and forward != default:
        out.options["--forward"] = forward
    if forward is None:
        usual_one = f"{default} is usual in such a world" if default else "it depends on the world"
        out.questions.append(f"the axis along which heads look (--forward): {usual_one}, and nobody walks in the rows")
    if gaze is None:
        return None
    local = find_local(gaze, turns, forward or default or "z")
    if local is None:
        out.questions.append("whether the gaze is in the head's frame: its rows tell neither; it is taken for the head's")
        return True
    where_to = "the head's frame" if local else "the world, so that the head's pose is left out"
    out.assumptions.append(f"the gaze is in {where_to}: so it is nearer to where the head points")
    return local


def _confidence(roles: Roles, sample: TableSample) -> str | None:
    """The column of confidences, if they are from 0 to 1."""
    if roles.confidence is None or roles.confidence not in sample.numbers:
        return None
    values = sample.numbers[roles.confidence]
    values = values[np.isfinite(values)]
    return roles.confidence if values.size and values.min() >= 0 and values.max() <= 1 else None


def _person(out: Proposal, sample: TableSample, roles: Roles) -> str | None:
    """The column of participants, unless it counts rows."""
    if roles.person not in sample.columns or not is_counter(sample.texts(roles.person)):
        return roles.person if roles.person in sample.columns else None
    out.questions.append(f"{roles.person!r} has another value in nearly every row: it counts rows, not participants")
    return None


def _use_validity(out: Proposal, sample: TableSample) -> None:
    """Columns of validity, and which of their values mark valid rows."""
    words = []
    for name in filter(is_validity, sample.columns):
        values = sorted(set(sample.texts(name).tolist()))
        valid = valid_values(name, values)
        if valid is None or any(c in name + "".join(valid) for c in ",="):
            out.questions.append(
                f"which values of {name!r} mark valid rows (--valid): {', '.join(map(repr, values[:8]))}"
                f"{', ...' if len(values) > 8 else ''}"
            )
        elif valid:
            out.assumptions.append(f"rows are valid where {name!r} is {' or '.join(valid)}")
            words.append(shlex.quote(name) + "=" + ",".join(map(shlex.quote, valid)))
    if words:
        out.options["--valid"] = " ".join(words)


def _use_angles(out: Proposal, sample: TableSample, roles: Roles, chosen: dict) -> None:
    """Angles, where there is no vector: as a direction, or as the head's pose."""
    posed = chosen["xyzw"] or chosen["matrix"]
    names: tuple[str, ...] | None = None
    if chosen["direction"] is None and roles.azel and all(c in sample.numbers for c in roles.azel):
        names = chosen["azel"] = roles.azel
        out.assumptions.append("azimuths turn to the right and elevations up; put - before a name where they do not")
    elif chosen["direction"] is None and roles.yaw_pitch_roll:
        if all(c in sample.numbers for c in roles.yaw_pitch_roll):
            names = roles.yaw_pitch_roll
            gaze = any(set(n.lower().replace("_", " ").split()) & _GAZE for n in names)
            chosen["yawpitch" if posed or (gaze and len(names) == 2) else "ypr"] = names[: 2 if posed else 3]
            out.assumptions.append(
                "yaw and pitch turn as docs/reference/formats.md tells of this frame; put - before a name of yawpitch where not"
            )
    if names is None:
        return
    stated = in_degrees(names)
    most = float(np.nanmax(np.abs(sample.vector(names)), initial=0.0))
    degrees = stated if stated is not None else most > 2 * np.pi
    if not degrees:
        out.options["--radians"] = ""
    how = "by their names" if stated is not None else f"the largest is {most:.3g}"
    which = out.certain if stated is not None else out.assumptions
    which.append(f"the angles are {'degrees' if degrees else 'radians'}: {how}")


def _finish(out: Proposal, sample: TableSample, roles: Roles, chosen: dict) -> None:
    named = {key: value for key, value in chosen.items() if value}
    try:
        out.columns = ColumnMap(**named)
    except NergError as error:
        out.options = {}
        out.questions.append(
            f"no map can be proposed ({error}); its columns that hold numbers are "
            f"{', '.join(list(sample.numbers)[:24]) or 'none'}"
        )
        return
    for key in ("origin", "direction", "hit", "eye", "xyzw", "matrix"):
        if key in named:
            out.assumptions.append(
                f"{key}: {', '.join(named[key][:4])}{', ...' if len(named[key]) > 4 else ''} by its names"
            )
    if "person" in named:
        out.assumptions.append(f"person: {named['person']!r} by its name")
    else:
        out.questions.append("the person: no column names participants, and the file is one")
    used = {name for value in named.values() if not isinstance(value, str) for name in value}
    left = [v[0] for v in (*roles.vectors.values(), *roles.quaternions.values()) if not used & set(v)]
    if left:
        out.questions.append(f"what is left out: {', '.join(left[:8])}{', ...' if len(left) > 8 else ''}")
