"""Tables through a column map: a direction of its own, or a head's pose, or both."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import ValidatedDataclass, Range

from . import poses
from .base import RECORDINGS, RaysBuilder, Signature, TrackingFrame, option, tick_option, valid_option
from .columns import PERSONS, ColumnFinder, ColumnMap, is_counter, mark_valid, parse_valid, require_valid_values
from .tables import TableBlock, iterate_table


@dataclass(frozen=True, kw_only=True)
class TableOptions(ValidatedDataclass):
    """What no table says of itself. Raises `NergError` for words that are not known."""

    columns: ColumnMap | None = option(  # needed
        None,
        'Column map: "origin=x,y,z direction=dx,dy,dz t=time person=id confidence=c hit=hx,hy,hz cohort=g"; for heads, '
        "in place of direction: xyzw=..., wxyz=..., ypr=yaw,pitch,roll or matrix=... (12 or 16 columns, instead of "
        "origin too); a direction as angles: azel=azimuth,elevation (right, up) or yawpitch=yaw,pitch, - before a name "
        "turns its sign; for checks: head=x,y,z (or qx,qy,qz,qw), eyes=lx,ly,lz,rx,ry,rz.",
        flag="--map",
        parse=ColumnMap.parse,
        recorded=False,
    )
    units: str = option("m", "Unit of length of a mapped table: m, cm or mm.", recorded=False)
    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", recorded=False)
    handedness: str = option(
        "right", "Handedness of a mapped table: right, or left (Unity).", flag="--hand", recorded=False
    )
    forward: str | None = option(
        None, "Axis of a head's frame along which it looks.", shown="y up z (left-handed) or -z, else x", recorded=False
    )
    radians: bool = option(False, "Angles of a mapped table are in radians.", recorded=False)
    person_from: str = option("column", "Persons of a mapped table: column or filename.", recorded=False)
    min_confidence: float = option(0.0, "Drop rows below this confidence.", within=Range(0, 1))
    valid: str | None = valid_option()
    tick: float = tick_option()

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_valid(self.valid)
        poses.axis(self.looks_along, "forward")
        if self.person_from not in ("column", "filename"):
            raise NergError(f'persons are named by "column" or "filename" (--person-from), not by "{self.person_from}"')

    @property
    def frame(self) -> TrackingFrame:
        """The frame that was declared. Raises `NergError` for words that are not known."""
        return TrackingFrame(self.up, self.handedness, self.units)

    @property
    def looks_along(self) -> str:
        """The axis of a head's frame along which it looks."""
        return self.forward or poses.default_forward(self.up, self.handedness)


class Table:
    """CSV or Parquet tables through a column map.

    Directions need not be unit, and may be two angles from ``forward`` on: ``azel`` as told at
    :func:`nerg_mi.rays.readers.poses.directions_from_azimuths`, or ``yawpitch``. Where the map has a head's
    pose (``xyzw``, ``wxyz``, ``ypr``, ``matrix``), ``direction``, angles and ``eye`` are in the head's frame, and
    without a direction the ray is where the head points: along ``forward``, an axis of its frame. How yaw, pitch and
    roll turn is told at :func:`nerg_mi.rays.readers.poses.rotations_from_angles`. Rows with a confidence below
    ``min_confidence`` are dropped. ``tick``: seconds in one unit of the time column; without one, in one row.
    """

    name = "table"
    files = "CSV (comma, semicolon or tab; `.gz` too) or Parquet tables, whose columns are named by `--map`"
    world = "declared: `--up`, `--hand`, `--units`"
    checked_on = RECORDINGS
    signature = Signature()
    Options = TableOptions

    def frame(self, files: Sequence[Path], options: TableOptions) -> TrackingFrame:
        return options.frame

    def read(self, files: Sequence[Path], options: TableOptions, builder: RaysBuilder) -> None:
        add_tables(files, options, builder)


_VALUES = 1000  # of a column; one of more tells no validity

TABLE = Table()
READERS = (TABLE,)


def add_tables(
    files: Sequence[Path], options: TableOptions, builder: RaysBuilder, validity: Sequence[str] = ()
) -> None:
    """Add the rays of ``files`` to ``builder``, which was given ``options.frame``.

    ``validity``: columns of validity whose values speak for themselves; where ``options.valid`` names some, only those
    are used. Raises `NergError` for missing columns, cells that are no numbers, and values of validity whose meaning is
    not certain.
    """
    if options.columns is None:
        raise NergError("a table needs a column map; say what its columns are (--map)")
    valid = parse_valid(options.valid)
    if valid is None:
        valid = {name: require_valid_values(files[0].name, name, _count_values(files, name)) for name in validity}
    rows = MappedRows(options.columns, options, valid)
    builder.note(columns=str(rows.columns), min_confidence=options.min_confidence, tick=options.tick)
    if rows.columns.pose or rows.columns.angles:
        builder.note(forward=options.looks_along)
    if rows.columns.ypr or rows.columns.angles:
        builder.note(degrees=not options.radians)
    for path in files:
        rows.add(path, builder)


def _count_values(files: Sequence[Path], column: str) -> Counter[str]:
    """How often each value of a column of texts occurs in all ``files``."""
    counts = Counter[str]()
    for path in files:
        for block in iterate_table(path, (), [column], on_bad=lambda line, why: None):
            for value, count in zip(*np.unique(block.texts[:, 0], return_counts=True)):
                counts[str(value)] += int(count)
            if len(counts) > _VALUES:
                break
    return counts


def find_person(table: ColumnFinder, builder: RaysBuilder) -> str | None:
    """The column of participants by its usual names. One that differs in nearly every row is none, and ``builder``
    reports it."""
    name = table.find(*PERSONS)
    if name is None or not is_counter(next((b.texts[:, 0] for b in iterate_table(table.path, (), [name])), ())):
        return name
    builder.complain(
        f"{name!r} has another value in nearly every row, as a counter of rows has, and is not taken for participants: "
        f"each file is one (or name the column yourself: --map person={name})"
    )
    return None


def person_from_filename(path: Path) -> str:
    """The file's name without its endings (``anna.csv.gz`` is ``anna``)."""
    return path.name.split(".")[0]


class MappedRows:
    """Rows of tables that have the same columns, as rays."""

    def __init__(self, columns: ColumnMap, options: TableOptions, valid: Mapping[str, Sequence[str]]) -> None:
        self.columns, self.options, self.valid = columns, options, valid
        self.person = None if options.person_from == "filename" else columns.person
        self.pose_columns = getattr(columns, columns.pose) if columns.pose else ()
        signed = getattr(columns, columns.angles) if columns.angles else ()
        self.angle_columns = tuple(name.removeprefix("-") for name in signed)
        self.angle_signs = np.array([-1.0 if name.startswith("-") else 1.0 for name in signed])
        vectors = [getattr(columns, name) or () for name in ("origin", "direction", "eye", "hit", "head", "eyes")]
        self.numbers = [name for v in vectors for name in v]
        self.numbers += [*self.pose_columns, *self.angle_columns, *(c for c in (columns.t, columns.confidence) if c)]
        self.texts = [c for c in (self.person, columns.cohort, *valid) if c]

    def add(self, path: Path, builder: RaysBuilder) -> None:
        """Add the rows of ``path``."""
        builder.source(path)
        before = 0
        clocks = {self.columns.t: self.options.tick} if self.columns.t else {}
        for block in builder.read_table(path, self.numbers, self.texts, clocks=clocks):
            self._add_block(path, block, before, builder)
            before += len(block.lines)

    def _add_block(self, path: Path, block: TableBlock, before: int, builder: RaysBuilder) -> None:
        """Add the rows of ``block``, ahead of which the file has ``before`` others."""
        columns, options = self.columns, self.options
        value = dict(zip(self.numbers, block.numbers.T))
        word = dict(zip(self.texts, block.texts.T))
        vector = lambda names: np.stack([value[c] for c in names], axis=1)
        n = len(block.lines)
        t = value[columns.t] if columns.t else np.arange(before, before + n, dtype=np.float64)
        confidence = value[columns.confidence] if columns.confidence else np.ones(n)
        origin, direction, head = self._geometry(vector)
        pose = vector(self.pose_columns) if columns.pose == "matrix" else None
        drop = {} if pose is None else {poses.MIRRORED: poses.is_mirrored(pose)}
        drop |= {f"confidence below {options.min_confidence:g}": confidence < options.min_confidence}
        for name, words in self.valid.items():
            shown = " or ".join(dict.fromkeys(w.lower() for w in words)) or "valid"
            drop[f"{name} is not {shown}"] = ~mark_valid(word[name], words)
        builder.add(
            t * options.tick,
            word[self.person] if self.person else person_from_filename(path),
            origin,
            direction,
            rows=block.lines,
            confidence=confidence,
            hit=vector(columns.hit) if columns.hit else None,
            cohort=word[columns.cohort] if columns.cohort else None,
            head=head,
            eye_distance=np.linalg.norm(np.subtract(*np.split(vector(columns.eyes), 2, axis=1)), axis=1)
            if columns.eyes
            else None,
            drop=drop,
            recorded_origin=vector(columns.origin) if columns.origin else None,
            recorded_direction=vector(columns.direction) if columns.direction else None,
        )

    def _geometry(
        self, vector: Callable[[Sequence[str]], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Origins and directions (n, 3) of a block, whose columns ``vector`` stacks, and the heads', if they are not
        the directions."""
        columns, forward = self.columns, poses.axis(self.options.looks_along, "forward")
        direction = self._direction(vector)
        if not columns.pose:
            head = vector(columns.head) if columns.head else None
            if head is not None and head.shape[1] == 4:
                head = poses.rotations_from_quaternions(head) @ forward
            return vector(columns.origin or ()), np.asarray(direction), head
        turn, place = _pose(columns.pose, vector(self.pose_columns), self.options)
        origin = vector(columns.origin or ()) if place is None else place
        if columns.eye:
            origin = origin + poses.rotate(turn, vector(columns.eye))
        if direction is not None:
            return origin, poses.rotate(turn, direction), turn @ forward
        return origin, turn @ forward, None

    def _direction(self, vector: Callable[[Sequence[str]], np.ndarray]) -> np.ndarray | None:
        """The directions (n, 3) that the table gives beside a pose, or without one; None where the pose is all."""
        if self.columns.direction:
            return vector(self.columns.direction)
        if not self.columns.angles:
            return None
        options, angles = self.options, vector(self.angle_columns) * self.angle_signs
        if self.columns.azel:
            forward = options.looks_along
            return poses.directions_from_azimuths(angles, options.up, forward, options.handedness, not options.radians)
        turn = poses.rotations_from_angles(angles, options.up, options.looks_along, not options.radians)
        return turn @ poses.axis(options.looks_along, "forward")


def _pose(kind: str, values: np.ndarray, options: TableOptions) -> tuple[np.ndarray, np.ndarray | None]:
    """Rotations (N, 3, 3) from head to world of the pose columns (N, C), and where a head is, if they tell."""
    if kind == "matrix":
        return poses.rotations_from_matrices(values)
    if kind == "ypr":
        return poses.rotations_from_angles(values, options.up, options.looks_along, not options.radians), None
    return poses.rotations_from_quaternions(values, kind), None
