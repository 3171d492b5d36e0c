"""Tables with a column map: gaze directions, head poses, or both."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.ranges import Range, ValidatedDataclass
from nerg_mi.tracking.rays import TRACKING, merge_tracking

from . import poses
from .base import FROM_DOCUMENTATION, RaysBuilder, Signature, TrackingFrame, option, tick_option, valid_option
from .columns import (
    PERSON_NAMES,
    ColumnFinder,
    ColumnMap,
    is_counter,
    mark_valid,
    parse_length_unit,
    parse_valid,
    require_valid_values,
    split_column_name,
)
from .tables import TableBlock, iterate_table, read_table_columns


@dataclass(frozen=True, kw_only=True)
class TableOptions(ValidatedDataclass):
    """Options for what tables do not contain. Raises `NergError` for invalid values."""

    columns: ColumnMap | None = option(  # required
        None,
        'Column map: "origin=x,y,z direction=dx,dy,dz t=time person=id confidence=c hit=hx,hy,hz cohort=g"; for heads, '
        "instead of direction: xyzw=..., wxyz=..., ypr=yaw,pitch,roll or matrix=... (12 or 16 columns, also instead of "
        "origin); for a direction as angles: azel=azimuth,elevation (right, up) or yawpitch=yaw,pitch, with - before a "
        "name to negate it; for checks: head=x,y,z (or qx,qy,qz,qw), eyes=lx,ly,lz,rx,ry,rz.",
        flag="--map",
        parse=ColumnMap.parse,
        is_recorded=False,
    )
    units: str = option("m", "Unit of length of a table read with --map: m, cm or mm.", is_recorded=False)
    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", is_recorded=False)
    handedness: str = option(
        "right", "Handedness of a table read with --map: right, or left (Unity).", flag="--hand", is_recorded=False
    )
    forward: str | None = option(
        None,
        "Forward axis of the head's frame.",
        default_text="y up: z (left-handed) or -z, otherwise x",
        is_recorded=False,
    )
    radians: bool = option(
        False, "Angles of a table read with --map are in radians instead of degrees.", is_recorded=False
    )
    person_from: str = option(
        "column", "Source of the participants' names in a table read with --map: column or filename.", is_recorded=False
    )
    tracking: str | None = option(
        None,
        "What the directions of a table read with --map are: eye (gaze) or head.",
        default_text="as in a column tracking; else head for a head pose without a direction, and for directions with "
        "head, hmd or camera in their names; otherwise eye",
        is_recorded=False,
    )
    min_confidence: float = option(0.0, "Drop rows below this confidence.", within=Range(0, 1))
    valid: str | None = valid_option()
    tick: float = tick_option()

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_valid(self.valid)
        poses.parse_axis(self.forward_axis, "forward")
        if self.tracking not in (None, "eye", "head"):
            raise NergError(f'{parameter("tracking")} must be eye or head, got "{sanitize(self.tracking, 40)}"')
        if self.person_from not in ("column", "filename"):
            raise NergError(
                f'persons are named by "column" or "filename" ({parameter("person_from")}), not by "{self.person_from}"'
            )

    @property
    def frame(self) -> TrackingFrame:
        """The declared frame. Raises `NergError` for invalid values."""
        return TrackingFrame(self.up, self.handedness, self.units)

    @property
    def forward_axis(self) -> str:
        """Forward axis of the head's frame."""
        return self.forward or poses.default_forward(self.up, self.handedness)


class Table:
    """CSV or Parquet tables with a column map.

    Directions may have any length, or be two angles from ``forward``: ``azel`` (see
    :func:`nerg_mi.tracking.readers.poses.directions_from_azimuths`) or ``yawpitch``. If the map has a head pose
    (``xyzw``, ``wxyz``, ``ypr``, ``matrix``), ``direction``, angles and ``eye`` are in the head's frame, and without a
    direction the ray is the direction of the head, the ``forward`` axis of its frame. See
    :func:`nerg_mi.tracking.readers.poses.rotations_from_angles` for yaw, pitch and roll. Rows below ``min_confidence``
    are dropped. ``tick`` is the unit of the time column in seconds; without such a column, the sampling interval.
    """

    name = "table"
    files = "CSV or Parquet tables, whose columns are named by `--map` (comma, semicolon or tab; `.gz` too)"
    frame_description = "declared: `--up`, `--hand`, `--units`"
    evidence = FROM_DOCUMENTATION
    signature = Signature()
    Options = TableOptions

    def frame(self, files: Sequence[Path], options: TableOptions) -> TrackingFrame:
        return options.frame

    def read(self, files: Sequence[Path], options: TableOptions, builder: RaysBuilder) -> None:
        add_tables(files, options, builder)


_MIN_ANGLES = 20  # rows needed to judge the unit of angles
_MAX_VALUES = 1000  # maximum number of different values of a column of validity

TABLE = Table()
READERS = (TABLE,)


def add_tables(
    files: Sequence[Path], options: TableOptions, builder: RaysBuilder, validity: Sequence[str] = ()
) -> None:
    """Add the rays of ``files`` to ``builder``, whose frame is ``options.frame``.

    ``validity`` are columns of validity whose values are interpreted automatically, unless ``options.valid`` names
    columns. Raises `NergError` for missing columns, cells that are not numbers, and uncertain values of validity.
    """
    if options.columns is None:
        raise NergError(f"a table needs a column map; specify its columns ({parameter('columns')})")
    valid = parse_valid(options.valid)
    if valid is None:
        valid = {name: require_valid_values(files[0].name, name, _count_values(files, name)) for name in validity}
    rows = MappedRows(options.columns, options, valid)
    builder.add_metadata(columns=str(rows.columns), min_confidence=options.min_confidence, tick=options.tick)
    if rows.columns.pose or rows.columns.angles:
        builder.add_metadata(forward=options.forward_axis)
    if rows.columns.ypr or rows.columns.angles:
        builder.add_metadata(degrees=not options.radians)
    if rows.columns.t is None and options.tick == 1.0:
        builder.add_warning(
            f"no column is the time, so rows are one second apart: name it ({parameter('columns', 't=...')}), or set "
            f"the sampling interval ({parameter('tick')})"
        )
    _check_units(rows.columns, options, builder)
    for path in files:
        rows.add(path, builder)
    rows.check_poses(builder)


def _check_units(columns: ColumnMap, options: TableOptions, builder: RaysBuilder) -> None:
    """Warn about columns whose names state another unit than that in which they are read."""
    lengths = [name for role in ("origin", "hit", "eye", "eyes") for name in getattr(columns, role) or ()]
    named = next((name for name in lengths if parse_length_unit(name) not in (None, options.units)), None)
    if named is not None:
        builder.add_warning(
            f"{sanitize(named, 40)!r} is in {parse_length_unit(named)} by its name, but was read in "
            f"{options.units}: set {parameter('units', parse_length_unit(named))} (with {parameter('columns')}), "
            "unless the name is wrong"
        )


def _count_values(files: Sequence[Path], column: str) -> Counter[str]:
    """Count the values of a column of text in all ``files``."""
    counts = Counter[str]()
    for path in files:
        for block in iterate_table(path, (), [column], on_bad_line=lambda line, why: None):
            for value, count in zip(*np.unique(block.texts[:, 0], return_counts=True)):
                counts[str(value)] += int(count)
            if len(counts) > _MAX_VALUES:
                break
    return counts


def find_person(table: ColumnFinder, builder: RaysBuilder) -> str | None:
    """Find the column of participants by its usual names. A row counter is reported to ``builder`` and ignored."""
    name = table.find(*PERSON_NAMES)
    if name is None or not is_counter(next((b.texts[:, 0] for b in iterate_table(table.path, (), [name])), ())):
        return name
    builder.add_warning(
        f"{name!r} has another value in nearly every row, like a row counter, and is not used as the participant: "
        f"each file is one participant (or specify the column: {parameter('columns', f'person={name}')})"
    )
    return None


def person_from_filename(path: Path) -> str:
    """File name without suffixes (``anna`` for ``anna.csv.gz``)."""
    return path.name.split(".")[0]


_HEAD_WORDS, _GAZE_WORDS = {"head", "headset", "hmd", "camera"}, {"gaze", "eye", "eyes"}


def find_tracking(columns: ColumnMap) -> str:
    """Whether the directions of ``columns`` are gaze ("eye") or those of heads ("head"), by their roles and names."""
    names = columns.direction or (getattr(columns, columns.angles) if columns.angles else ())
    if not names:
        return "head"
    words = {word for name in names for word in split_column_name(name).split("_")}
    # Directions next to those of heads, or in their frame, are gaze.
    is_head = words & _HEAD_WORDS and not words & _GAZE_WORDS and not columns.head and not columns.pose
    return "head" if is_head else "eye"


_TRACKING_COLUMN = "tracking"


class MappedRows:
    """Converts rows of tables with equal columns to rays."""

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
        self.tracking = options.tracking or find_tracking(columns)
        self.texts = [c for c in (self.person, columns.cohort, *valid) if c]
        self._num_angles, self._max_angle = 0, 0.0
        self._turns = self._moves = False  # rotations and positions of matrices

    def add(self, path: Path, builder: RaysBuilder) -> None:
        """Add the rows of ``path``."""
        builder.begin_source(path)
        first_row = 0
        clocks = {self.columns.t: self.options.tick} if self.columns.t else {}
        # Tables that were written from rays say what their directions are.
        is_stated = self.options.tracking is None and read_table_columns(path).count(_TRACKING_COLUMN) == 1
        texts = [*self.texts, _TRACKING_COLUMN] if is_stated else self.texts
        for block in builder.read_table(path, self.numbers, texts, clocks=clocks):
            tracking = merge_tracking(set(block.texts[:, -1].tolist()) & TRACKING.keys()) if is_stated else "unknown"
            self._add_block(path, block, first_row, builder, self.tracking if tracking == "unknown" else tracking)
            first_row += len(block.lines)

    def check_poses(self, builder: RaysBuilder) -> None:
        """Warn if matrices may be transposed, which only their positions show, and if all angles that were read as
        degrees are so small that they are probably radians."""
        if self._turns and not self._moves:
            names = ", ".join(sanitize(name, 40) for name in self.pose_columns[:2])
            builder.add_warning(
                f"the matrices {names}, ... turn, but all their positions are 0, 0, 0: if they are written column "
                f"by column, name their columns row by row ({parameter('columns', 'matrix=...')}); otherwise the heads "
                "stay at the origin"
            )
        # Heads turn around; gaze in the head's frame exceeds two degrees.
        limit = 2 * np.pi if self.columns.pose == "ypr" else np.pi / 2
        if self.options.radians or self._num_angles < _MIN_ANGLES or not 0 < self._max_angle <= limit:
            return
        names = ", ".join(sanitize(name, 40) for name in (*self.pose_columns, *self.angle_columns))
        builder.add_warning(
            f"{names} were read as degrees, but none exceeds {self._max_angle:.3g}: are they radians "
            f"({parameter('columns')} with {parameter('radians', True)}), or a quaternion without its w?"
        )

    def _add_block(self, path: Path, block: TableBlock, first_row: int, builder: RaysBuilder, tracking: str) -> None:
        """Add the rows of ``block``, the first of which is row ``first_row`` of the file."""
        columns, options = self.columns, self.options
        value = dict(zip(self.numbers, block.numbers.T))
        word = dict(zip(self.texts, block.texts.T))
        vector = lambda names: np.stack([value[c] for c in names], axis=1)
        n = len(block.lines)
        t = value[columns.t] if columns.t else np.arange(first_row, first_row + n, dtype=np.float64)
        confidence = value[columns.confidence] if columns.confidence else np.ones(n)
        origin, direction, head = self._compute_geometry(vector)
        if angles := self.angle_columns or self.pose_columns * (columns.pose == "ypr"):
            self._num_angles += n
            self._max_angle = max(self._max_angle, float(np.nanmax(np.abs(vector(angles)), initial=0.0)))
        drop = self._find_unusable_poses(path, block, vector)
        is_uncertain = confidence < options.min_confidence
        drop |= {f"confidence below {options.min_confidence:g} (option min_confidence)": is_uncertain}
        for name, words in self.valid.items():
            values_text = " or ".join(dict.fromkeys(w.lower() for w in words)) or "valid"
            drop[f"{name} is not {values_text} (option valid)"] = ~mark_valid(word[name], words)
        builder.add(
            t * options.tick,
            word[self.person] if self.person else person_from_filename(path),
            origin,
            direction,
            rows=block.lines,
            tracking=tracking,
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

    def _find_unusable_poses(
        self, path: Path, block: TableBlock, vector: Callable[[Sequence[str]], np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Reasons to drop rows for their pose, with masks (n,). Raises `NergError` for a last row of a matrix that is
        not 0, 0, 0, 1."""
        columns = self.columns
        if columns.pose in ("xyzw", "wxyz"):
            return poses.find_unusable_quaternions(vector(self.pose_columns))
        if columns.matrix is None:
            return {}
        values = vector(self.pose_columns)
        poses.check_last_rows(values, f"{path}, the matrix {columns.matrix[0]!r}, ...", block.lines)
        rotations, positions = poses.rotations_from_matrices(values)
        is_pose = np.isfinite(rotations).all(axis=(1, 2))
        self._moves |= bool(positions[is_pose].any())
        self._turns |= not np.allclose(rotations[is_pose], np.eye(3))
        return poses.find_unusable_matrices(values)

    def _compute_geometry(
        self, vector: Callable[[Sequence[str]], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Origins and directions (n, 3) of a block, and directions of heads, if different; ``vector`` stacks
        columns."""
        columns, forward = self.columns, poses.parse_axis(self.options.forward_axis, "forward")
        direction = self._compute_directions(vector)
        if not columns.pose:
            head = vector(columns.head) if columns.head else None
            if head is not None and head.shape[1] == 4:
                head = poses.rotations_from_quaternions(head) @ forward
            return vector(columns.origin or ()), np.asarray(direction), head
        rotation, position = _read_pose(columns.pose, vector(self.pose_columns), self.options)
        origin = vector(columns.origin or ()) if position is None else position
        if columns.eye:
            origin = origin + poses.rotate(rotation, vector(columns.eye))
        if direction is not None:
            return origin, poses.rotate(rotation, direction), rotation @ forward
        return origin, rotation @ forward, None

    def _compute_directions(self, vector: Callable[[Sequence[str]], np.ndarray]) -> np.ndarray | None:
        """The directions (n, 3) in the table; None if the table only has a pose."""
        if self.columns.direction:
            return vector(self.columns.direction)
        if not self.columns.angles:
            return None
        options, angles = self.options, vector(self.angle_columns) * self.angle_signs
        if self.columns.azel:
            forward = options.forward_axis
            return poses.directions_from_azimuths(angles, options.up, forward, options.handedness, not options.radians)
        rotation = poses.rotations_from_angles(angles, options.up, options.forward_axis, not options.radians)
        return rotation @ poses.parse_axis(options.forward_axis, "forward")


def _read_pose(kind: str, values: np.ndarray, options: TableOptions) -> tuple[np.ndarray, np.ndarray | None]:
    """Rotations (N, 3, 3) from head to world of the pose columns (N, C), and positions (N, 3), if they contain
    these."""
    if kind == "matrix":
        return poses.rotations_from_matrices(values)
    if kind == "ypr":
        return poses.rotations_from_angles(values, options.up, options.forward_axis, not options.radians), None
    return poses.rotations_from_quaternions(values, kind), None
