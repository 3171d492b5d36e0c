"""Columns of tables: recognition by their names, column maps, and columns that mark valid rows.

A column map (``--map``) names the columns of a CSV (comma, semicolon or tab; ``.gz`` too) or Parquet table, such as
``"origin=x,y,z direction=dx,dy,dz t=ms person=id confidence=c hit=hx,hy,hz cohort=group"``.

- Frames must be declared, since no file states them: ``--up``, ``--hand``, ``--units``, and for poses ``--forward``,
  the head's viewing axis. Its default is z in Unity (y up, left-handed), -z in OpenGL and OpenXR (y up,
  right-handed), x in ROS and Unreal (z up).
- Poses replace ``direction``: ``xyzw=qx,qy,qz,qw`` or ``wxyz=qw,qx,qy,qz`` (quaternion), ``ypr=yaw,pitch,roll``
  (degrees, or ``--radians``), or ``matrix=`` with 12 or 16 columns, head to world, row by row (``origin`` is then
  left out). With a pose and a ``direction``, the direction is in the head's frame, and so is ``eye``.
- Angles replace ``direction``, too: ``azel=azimuth,elevation`` turns right and up from ``--forward``;
  ``yawpitch=yaw,pitch`` turns as ``ypr`` does. A ``-`` before a name negates it (``azel=-yaw,pitch``). Next to a
  pose they are in the head's frame, otherwise in the world.
- Yaw turns about the up axis, then pitch about the sideways one, then roll about the forward one, each by the usual
  matrix in the file's coordinates: in Unity positive angles turn right and down, in ROS left and down, in OpenXR
  left and up.
- ``head=`` (a vector, or a quaternion x, y, z, w) and ``eyes=`` (both eyes, six columns) of a direction in the world
  serve the checks of data quality.
- Names with spaces: ``"t=timestamp [ns]"`` in quotes.
- Times: numbers in units of ``--tick``, ``2024-05-01T12:00:00.25`` (UTC without offset; also ``01.05.2024 12:00:00``
  and ``20240501T120000``) or ``12:00:00.25``, with AM or PM. Times of day without a date continue past midnight.
- Vectors in one cell, such as ``(1, 2, 3)`` or ``X=1 Y=2 Z=3``: a column ``c`` of these is ``origin=c``; its parts
  are ``c.x`` to ``c.w``.
- Decimal commas are read where cells are quoted, or between semicolons or tabs. A first line ``sep=;``, byte order
  marks and UTF-16 are read.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.values import fold_name

from .cells import AXES, is_missing
from .tables import TableBlock, explain_columns, find_vector_columns, iterate_table, read_table_columns

# ---- Columns of a table by their usual names ----

_MIN_ROWS = 20  # rows needed to distinguish a counter from participants


class ColumnFinder:
    """Columns of one table by their usual names.

    Spaces and dots count as underscores, and case is ignored. If no column matches, names are split into words:
    ``gazeOrigin_x``, ``GazeOriginX`` and ``gaze origin [x]`` are ``gaze_origin_x``. Units in brackets are ignored.
    Columns of vectors, ``GazeOrigin`` with cells (1, 2, 3), have the columns ``GazeOrigin.x``, ``GazeOrigin.y``, ...
    """

    def __init__(self, path: Path) -> None:
        self.path, self.columns = path, [*read_table_columns(path), *find_vector_columns(path)]
        self._by_name = {re.sub(r"[ .]", "_", c).lower(): c for c in reversed(self.columns)}
        self._by_words = {split_column_name(c): c for c in reversed(self.columns)}

    def find_vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...] | None:
        """The columns ``stem_x``, ``stem_y``, ... of the first of ``stems`` with all of ``axes``, or None. For the stem
        "", and if there are none with an underscore: ``x`` and ``stemx``."""
        lookups = [(self._by_name, "_", stems), (self._by_words, "_", stems), (self._by_words, "", stems)]
        for column_by_name, separator, candidates in lookups:
            for stem in candidates:
                names = [f"{stem}{separator if stem else ''}{axis}" for axis in axes]
                if all(n in column_by_name for n in names):
                    return tuple(column_by_name[n] for n in names)
        return None

    def require_vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...]:
        """As `find_vector`, but raises `NergError` listing the available columns instead of returning None."""
        vector_columns = self.find_vector(*stems, axes=axes)
        if vector_columns is None:
            wanted = " or ".join(f"{s}{'_' if s else ''}{{{','.join(axes)}}}" for s in stems)
            raise NergError(f"{self.path} has no columns {wanted}; {explain_columns(self.columns)}")
        return vector_columns

    def find(self, *names: str) -> str | None:
        """The first of ``names`` that is a column, or None."""
        column_by_name = next(
            (
                column_by_name
                for column_by_name in (self._by_name, self._by_words)
                if any(n in column_by_name for n in names)
            ),
            {},
        )
        return next((column_by_name[n] for n in names if n in column_by_name), None)

    def find_time(self, *names: str) -> str | None:
        """As `find`, also with a unit at the end of the name: ``timestamp_ms``, ``timeNs``."""
        by_stem = {
            words.rpartition("_")[0]: column
            for words, column in self._by_words.items()
            if words.rpartition("_")[2] in _TIME_UNITS
        }
        return self.find(*names) or next((by_stem[name] for name in names if name in by_stem), None)

    def require_time(self, *names: str) -> str:
        """As `find_time`, but raises `NergError` instead of returning None."""
        column = self.find_time(*names)
        if column is None:
            raise NergError(f"{self.path} has no column of time; {explain_columns(self.columns)}")
        return column


def open_named_table(
    path: Path, numbers: Sequence[str], texts: Sequence[str] = (), *, optional: Sequence[str] = ()
) -> tuple[list[str], Iterator[TableBlock]]:
    """Open a table that is no recording, such as one of cohorts: its columns are found by name as in `ColumnFinder`,
    that of ``person`` by any of `PERSON_NAMES`.

    Returns the names of those ``numbers`` and ``texts`` that the table has, and its blocks, whose columns these are.
    Raises `NergError` for a missing column that is not ``optional``, and, as the iterator does, for an unreadable line.
    """
    table = ColumnFinder(path)
    columns = {name: table.find(*(PERSON_NAMES if name == "person" else (name,))) for name in (*numbers, *texts)}
    missing = [name for name, column in columns.items() if column is None and name not in optional]
    if missing:
        remedy = explain_columns(table.columns, "rename columns in its header")
        raise NergError(f'"{path}" has no column {", ".join(missing)}; {remedy}')

    def refuse(line: int, reason: str) -> None:
        raise NergError(f"{path}, line {line}{reason}")

    select = lambda names: [column for name in names if (column := columns[name]) is not None]
    blocks = iterate_table(path, select(numbers), select(texts), on_bad_line=refuse)
    return [name for name, column in columns.items() if column is not None], blocks


def is_counter(values: Sequence[str] | np.ndarray) -> bool:
    """Whether the values (n,) are mostly different, like those of a row counter, unlike those of participants."""
    return len(values) >= _MIN_ROWS and len(np.unique(values)) > 0.5 * len(values)


def split_column_name(column: str) -> str:
    """Split a column name into lower case words, joined by underscores, without a unit in brackets (but with an axis):
    ``Gaze Origin.X (mm)`` is ``gaze_origin_x``."""
    axis = lambda unit: f"_{unit[1]}" if unit[1].lower() in tuple("xyzw") else ""
    # Usual names are shorter; the limit also bounds the search for closing brackets.
    name = re.sub(r"[(\[]([^)\]]*)[)\]]", axis, column[:200])
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return re.sub(r"[^0-9a-z]+", "_", name.lower()).strip("_")


# ---- Column map of a table ----
#
# Example: ``origin=x,y,z direction=dx,dy,dz t=time person=id confidence=valid hit=hx,hy,hz cohort=group``. Instead of a
# direction, or in addition to one in the head's frame, the pose of the head: ``xyzw=qx,qy,qz,qw`` or
# ``wxyz=qw,qx,qy,qz`` (quaternion, order as in the name), ``ypr=yaw,pitch,roll`` (or yaw and pitch), or
# ``matrix=m00,m01,...`` (12 or 16 columns, row by row, head to world; includes the origin). ``eye=ex,ey,ez``: position
# of the eye in the head's frame. A direction may also be two angles: ``azel=azimuth,elevation`` (right and up) or
# ``yawpitch=yaw,pitch`` (turning as those of ``ypr``); ``-`` before a column name negates it. For the checks:
# ``head=fx,fy,fz`` or ``head=qx,qy,qz,qw``, the direction or rotation of the head if ``direction`` is in the table's
# frame, and ``eyes=lx,ly,lz,rx,ry,rz``, the positions of both eyes. A column ``c`` with vectors such as (1, 2, 3) in
# its cells is ``c.x,c.y,c.z``, or ``c`` alone for origin, direction, eye, hit and xyzw.

_COLUMN_COUNTS = {
    **dict.fromkeys(("origin", "direction", "eye", "hit"), (3,)),
    "azel": (2,),
    "yawpitch": (2,),
    "xyzw": (4,),
    "wxyz": (4,),
    "ypr": (2, 3),
    "matrix": (12, 16),
    **dict.fromkeys(("t", "person", "confidence", "cohort"), (1,)),
    "head": (3, 4),
    "eyes": (6,),
}
# Fields that may name one column, whose cells contain vectors.
_VECTOR_FIELDS = ("origin", "direction", "eye", "hit", "xyzw")
POSE_FIELDS = ("xyzw", "wxyz", "ypr", "matrix")
ANGLE_FIELDS = ("azel", "yawpitch")


@dataclass(frozen=True)
class ColumnMap:
    """Names of a table's columns by role. Required: a position (``origin``, or in ``matrix``) and a direction
    (``direction``, angles or a pose).

    A ``direction`` or its angles are in the head's frame if there is a pose, otherwise in that of the table. Without
    ``t`` rows are numbered, without ``person`` each file is one participant, without ``confidence`` it is 1. Raises
    `NergError` for an incomplete or contradictory map.
    """

    origin: tuple[str, ...] | None = None
    direction: tuple[str, ...] | None = None
    azel: tuple[str, ...] | None = None
    yawpitch: tuple[str, ...] | None = None
    xyzw: tuple[str, ...] | None = None
    wxyz: tuple[str, ...] | None = None
    ypr: tuple[str, ...] | None = None
    matrix: tuple[str, ...] | None = None
    eye: tuple[str, ...] | None = None
    hit: tuple[str, ...] | None = None
    t: str | None = None
    person: str | None = None
    confidence: str | None = None
    cohort: str | None = None
    head: tuple[str, ...] | None = None
    eyes: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        poses = [p for p in POSE_FIELDS if getattr(self, p)]
        if len(poses) > 1:
            raise NergError(f"column map: {' and '.join(poses)} are two poses of one head; keep one of them")
        if self.origin is None and self.matrix is None:
            raise NergError("column map: origin is missing; add origin=x,y,z with the names of its columns")
        if self.origin is not None and self.matrix is not None:
            raise NergError("column map: origin is given twice, since matrix includes it; leave out origin")
        directions = [w for w in ("direction", *ANGLE_FIELDS) if getattr(self, w)]
        if len(directions) > 1:
            raise NergError(f"column map: {' and '.join(directions)} are two directions; keep one of them")
        if not directions and not poses:
            raise NergError(
                "column map: direction is missing; add direction=x,y,z with the names of its columns, angles "
                "(azel or yawpitch), or a pose (xyzw, wxyz, ypr or matrix)"
            )
        if self.eye is not None and not poses:
            raise NergError(
                "column map: \"eye\" is a position in the head's frame and needs the head's orientation; add one of "
                "the keys xyzw, wxyz, ypr and matrix"
            )
        if self.head is not None and (poses or not (self.direction or self.angles)):
            raise NergError(
                "column map: head is the direction of the head for a direction in the table's frame; leave out "
                + (" or ".join(["head", *poses]) if poses else "head, or add direction")
            )

        names = [name for role in fields(self) for name in self._columns_of(role.name)]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise NergError(f"column map: the column {repeated!r} has two roles; use another column for one of them")

    def _columns_of(self, role: str) -> tuple[str, ...]:
        """The columns of a role, without the signs of angles."""
        value = getattr(self, role) or ()
        names = (value,) if isinstance(value, str) else value
        return tuple(name.removeprefix("-") for name in names) if role in ANGLE_FIELDS else names

    @property
    def pose(self) -> str | None:
        """Name of the field of the pose, or None."""
        return next((p for p in POSE_FIELDS if getattr(self, p)), None)

    @property
    def angles(self) -> str | None:
        """Name of the field of the direction's angles, or None."""
        return next((a for a in ANGLE_FIELDS if getattr(self, a)), None)

    @classmethod
    def parse(cls, text: str) -> ColumnMap:
        """Parse ``"origin=x,y,z direction=dx,dy,dz t=time ..."``; names with spaces need double quotes.

        Raises `NergError` for an unknown or repeated field, a wrong number of columns, or an incomplete map.
        """
        import shlex

        try:
            words = shlex.split(text)
        except ValueError as error:
            raise NergError(f"column map: {str(error)[:1].lower()}{str(error)[1:]} in {text!r}; close it") from None
        # The types of the fields follow from `_COLUMN_COUNTS`: those with one column are strings.
        fields_by_name: dict[str, Any] = {}
        for word in words:
            key, _, value = word.partition("=")
            columns = tuple(c.strip() for c in value.split(",") if c.strip())
            if key not in _COLUMN_COUNTS or key in fields_by_name:
                raise NergError(
                    f"column map: {key!r} is unknown or given twice; use {', '.join(_COLUMN_COUNTS)}, each once"
                )
            if len(columns) == 1 and key in _VECTOR_FIELDS:
                columns = tuple(f"{columns[0]}.{axis}" for axis in AXES[: _COLUMN_COUNTS[key][0]])
            if len(columns) not in _COLUMN_COUNTS[key]:
                needed = " or ".join(map(str, _COLUMN_COUNTS[key]))
                raise NergError(
                    f"column map: {key} needs {needed} column name(s), got {len(columns)} in {word!r}; the parts of "
                    "vectors in the cells of a column c are c.x, c.y, c.z and c.w"
                )
            fields_by_name[key] = columns[0] if _COLUMN_COUNTS[key] == (1,) else columns
        return cls(**fields_by_name)

    def __str__(self) -> str:
        values = {name: value for name, value in vars(self).items() if value is not None}
        return " ".join(
            _quote(f"{name}={value if isinstance(value, str) else ','.join(value)}") for name, value in values.items()
        )


def _quote(word: str) -> str:
    """Quote a word for `ColumnMap.parse`, if necessary."""
    if not any(c.isspace() or c in "\"'\\" for c in word):
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'


# ---- Usual column names ----
#
# Usual names in logs of headsets, in lower case with underscores, in order of preference.

TIME_NAMES = ("t", "time", "timestamp", "time_s", "unity_time", "utc_timestamp", "raw_timestamp", "sender_time")
PERSON_NAMES = ("person", "participant", "participant_id", "participantid", "user", "user_id", "userid")
PERSON_NAMES += ("subject", "subject_id", "id")
HIT_NAMES = ("hit", "gaze_hit", "hit_point", "hit_pos", "hit_position")
DIRECTION_NAMES = ("gaze_dir", "gaze_direction", "gaze_forward")
EYE_NAMES = ("gaze_origin", "gaze_position", "eye_position")
HEAD_NAMES = ("head_pos", "head_position", "hmd_pos")
ROTATION_NAMES = ("head_rot", "head_rotation", "hmd_rot")

# Names without a subject, used if there are none of those above.
BARE_DIRECTION_NAMES = ("dir", "direction", "d")
BARE_POSITION_NAMES = ("origin", "pos", "position", "")
BARE_ROTATION_NAMES = ("rot", "rotation", "quaternion", "quat", "q")

HEADSET_POSITION_NAMES = (*HEAD_NAMES, "hmd_position", "camera_pos", "camera_position", "cam_pos", "cam_position")
"""Positions of the head in logs of one headset, in which the camera is the head."""
HEADSET_ROTATION_NAMES = (*ROTATION_NAMES, "hmd_rotation", "camera_rot", "camera_rotation", "cam_rot", "cam_rotation")


# ---- Columns that mark valid rows: their names, and the meaning of their values ----

# Names for the gaze as a whole, as one word: isvalid, gazevalidity, combinedgazestatus. Those of one eye do not match.
_GAZE_VALIDITY = re.compile(
    r"(is|has|was)?(gaze|eyes?|combined|tracking|tracker|ray|data|sample)*(is|has|was)?"
    r"(valid(ity)?|status|tracked|trackingstate)(flag|code)?|(is|has)?valid(gaze|eyes?|data|sample)|"
    r"(is)?(gaze|eye)trackingenabledandvalid"
)
# Further words that may indicate validity.
_VALIDITY_WORDS = {
    "detected",
    "available",
    "found",
    "lost",
    "missing",
    "dropout",
    "blink",
    "blinking",
    "worn",
    "tracked",
}
_VALID = ("valid", "true", "tracked", "tracking", "ok", "yes")
_INVALID = (
    *("invalid", "false", "lost", "untracked", "nottracked", "nottracking", "notvalid", "no", "none", "limited"),
    *("adjust", "calibrating", "unavailable", "error", ""),
)
_VARJO_CODES = {0, 1, 2}  # invalid, being calibrated, valid
_MAX_VALUES = 6


def is_validity_column(column: str) -> bool:
    """Whether a column contains the validity of the gaze, by its name."""
    return bool(_GAZE_VALIDITY.fullmatch(split_column_name(column).replace("_", "")))


def may_be_validity_column(column: str) -> bool:
    """Whether a column may contain a validity of any kind by its name, such as ``left_eye_validity``."""
    return (
        "valid" in column.lower()
        or is_validity_column(column)
        or not _VALIDITY_WORDS.isdisjoint(split_column_name(column).split("_"))
    )


def find_valid_values(column: str, values: Iterable[str]) -> list[str] | None:
    """The ``values`` of a column of validity that mark a valid row; None if the meaning of a value is uncertain.

    Words are interpreted literally. Codes 0 and 1 are false and true, unless the column is a status, whose codes depend
    on the device. A gaze status with codes up to 2 is that of Varjo: 0 invalid, 1 calibrating, 2 valid.
    """
    words = {value: re.sub(r"[^a-z0-9.]", "", value.lower()) for value in values}
    words |= {value: "" for value in words if is_missing(value)}
    codes = {value: float(value) for value in words if re.fullmatch(r"\s*[+-]?\d{1,9}(\.0*)?\s*", value)}
    name = split_column_name(column).replace("_", "")
    is_status = name.endswith(("status", "state", "code"))
    if is_status and "gaze" in name and 2 in codes.values() and set(codes.values()) <= _VARJO_CODES:
        valid_code = 2
    elif not is_status and set(codes.values()) <= {0, 1}:
        valid_code = 1
    elif codes:
        return None
    else:
        valid_code = -1
    if any(word not in _VALID + _INVALID for value, word in words.items() if value not in codes):
        return None
    return [value for value, word in words.items() if word in _VALID or codes.get(value) == valid_code]


def require_valid_values(source: str, column: str, counts: Mapping[str, int]) -> list[str]:
    """As `find_valid_values`, but raises `NergError` listing the values with their ``counts`` if one is uncertain."""
    valid = find_valid_values(column, counts)
    if valid is None:
        most_common = sorted(counts, key=lambda value: -counts[value])[:_MAX_VALUES]
        values_text = ", ".join(f"{sanitize(value, 20) or 'nothing'} ({counts[value]:,} rows)" for value in most_common)
        suffix = f" and {len(counts) - _MAX_VALUES} more" if len(counts) > _MAX_VALUES else ""
        raise NergError(
            f"{source}: the column {sanitize(column, 40)!r} contains {values_text}{suffix}, and it is uncertain "
            f"which of them mark valid rows; name these ({parameter('valid')} "
            f'"{sanitize(column, 40)}=VALUE,VALUE"), or use none ({parameter("valid", "none")})'
        )
    return valid


def mark_valid(cells: np.ndarray, values: Iterable[str]) -> np.ndarray:
    """Whether cells (n,) are among the ``values``, (n,) bool; ignores case, and 2.0 equals 2."""
    valid = {_normalise_cell(value) for value in values}
    unique, inverse = np.unique(cells, return_inverse=True)
    return np.array([_normalise_cell(cell) in valid for cell in unique.tolist()], bool)[inverse]


def _normalise_cell(text: str) -> str:
    text = fold_name(text).strip().lower()
    return text.partition(".")[0] if re.fullmatch(r"\d+\.0*", text) else text


def parse_valid(text: str | None) -> dict[str, tuple[str, ...]] | None:
    """Parse ``"gaze_status=2 isValid=true,1"`` to columns with their values for valid rows; ``none`` gives an empty
    dictionary, and None gives None. Raises `NergError` for other text."""
    if text is None:
        return None
    import shlex

    try:
        words = [] if text.strip().lower() == "none" else shlex.split(text)
        pairs = {name: tuple(v.strip() for v in values.split(",")) for name, values in (w.split("=", 1) for w in words)}
    except ValueError:
        pairs = {"": ()}
    if any(not name or not any(values) for name, values in pairs.items()) or (not pairs and "none" not in text.lower()):
        raise NergError(
            f"{parameter('valid')} is {sanitize(text, 60)!r}; it must be COLUMN=VALUE,VALUE (several separated by "
            'spaces), or "none"'
        )
    return pairs


# ---- Roles of columns by their names: vectors, quaternions, matrices, angles, times, participants ----

# Prefixes of the letter of an axis within a word: tx, posX, GazeQX.
_AXIS_PREFIXES = (
    "",
    "t",
    "q",
    "p",
    "d",
    "h",
    "v",
    "g",
    "pos",
    "rot",
    "dir",
    "vec",
    "quat",
    "gaze",
    "head",
    "hit",
    "eye",
)
_EXCLUDED_WORDS = (
    *("velocity", "vel", "speed", "acceleration", "accel", "gyro", "gravity", "magnetic", "angular", "linear"),
    *("ecef", "scale", "size", "color", "uv", "std", "var", "screen", "webcam", "px", "pixel", "norm2d", "pupil"),
    *("target", "aoi", "hand", "controller", "screenpoint", "velo"),
)
_TIME_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0, "seconds": 1.0, "100ns": 1e-7}
_TIME_UNITS |= {fold_name("\u00b5s"): 1e-6}
_PERSON_NAMES = (*PERSON_NAMES, "pid", "participant_name", "subject_name", "user_name", "person_id", "player")
_CONFIDENCE_NAMES = ("confidence", "gaze_confidence", "conf", "quality")


# Words in the names of vectors.
DIRECTION_WORDS = {"dir", "direct", "direction", "forward", "vec", "vector", "ray", "normal", "look", "gazedir"}
HIT_WORDS = {"hit", "point", "intersection", "target", "fixation", "poi", "collision"}
HEAD_WORDS = {"head", "hmd", "camera", "cam", "device", "body", "headset"}
GAZE_WORDS = {"gaze", "eye", "eyes"}
SIDE_WORDS = {"left", "right", "l", "r", "0", "1"}
ROTATION_WORDS = {"rotation", "rot", "euler", "angle", "angles", "orientation", "orient"}
_POSITION_WORDS = {"position", "pos", "origin", "location", "translation"}


def split_stem(stem: str) -> set[str]:
    """The words of the stem of a vector in `Roles`."""
    return set(stem.replace("*", "").split("_"))


def find_head_positions(vectors: Mapping[str, tuple[str, ...]]) -> list[str]:
    """The stems of vectors that may be positions of a head by their names, those named like a head first."""
    others = DIRECTION_WORDS | HIT_WORDS | ROTATION_WORDS | SIDE_WORDS
    words = {stem: split_stem(stem) for stem in vectors}
    positions = (s for s, w in words.items() if w & (HEAD_WORDS | _POSITION_WORDS) and not w & others)
    return sorted(positions, key=lambda stem: not words[stem] & HEAD_WORDS)


@dataclass
class Roles:
    """Possible roles of the columns of a table. Vectors and the like are by stem: the name without the axis."""

    vectors: dict[str, tuple[str, ...]] = field(default_factory=dict)  # x, y, z
    quaternions: dict[str, tuple[str, ...]] = field(default_factory=dict)  # x, y, z, w
    matrices: dict[str, tuple[str, ...]] = field(default_factory=dict)  # 12 or 16, row by row
    gravity: tuple[str, str, str] | None = None
    azel: tuple[str, str] | None = None
    yaw_pitch_roll: tuple[str, ...] | None = None  # two or three
    times: list[str] = field(default_factory=list)  # the most likely first
    person: str | None = None
    confidence: str | None = None


def find_roles(columns: Sequence[str]) -> Roles:
    """Find possible roles of ``columns`` by their names. Names with a comma or an equals sign, which a column map
    cannot contain, have none."""
    words = {c: split_column_name(c) for c in columns if c and not set(c) & set(",=")}
    roles, all_names = Roles(), set(words.values())
    groups: dict[str, dict[str, str]] = {}
    cells: dict[str, dict[str, str]] = {}
    gravity: dict[str, str] = {}
    for column, name in words.items():
        parts = name.split("_")
        if "gravity" in parts:
            for _, axis in _split_axis(parts):
                gravity.setdefault(axis, column)
        if any(
            part in _EXCLUDED_WORDS and not (part == "px" and name.replace("px", "pz") in all_names) for part in parts
        ):
            continue
        for stem, axis in _split_axis(parts):
            groups.setdefault(stem, {}).setdefault(axis, column)
        match = re.fullmatch(r"(.*?)_?m?([0-3])_?([0-3])", name)
        if match:
            cells.setdefault(match[1], {})[match[2] + match[3]] = column
    for stem, columns_by_axis in groups.items():
        if set("xyzw") <= set(columns_by_axis):
            roles.quaternions[stem] = tuple(columns_by_axis[a] for a in "xyzw")
        elif set("xyz") <= set(columns_by_axis):
            roles.vectors[stem] = tuple(columns_by_axis[a] for a in "xyz")
    for stem, columns_by_cell in cells.items():
        rows = 4 if "33" in columns_by_cell else 3
        names = [f"{r}{c}" for r in range(rows) for c in range(4)]
        if all(n in columns_by_cell for n in names):
            roles.matrices[stem] = tuple(columns_by_cell[n] for n in names)
    if set("xyz") <= set(gravity):
        roles.gravity = gravity["x"], gravity["y"], gravity["z"]
    _find_angles(words, roles)
    ranks = {column: rank for column, name in words.items() if (rank := _rank_time_name(name)) is not None}
    roles.times = sorted(ranks, key=ranks.__getitem__)
    roles.person = next((c for p in _PERSON_NAMES for c, w in words.items() if w == p), None)
    roles.confidence = next((c for p in _CONFIDENCE_NAMES for c, w in words.items() if w == p), None)
    return roles


def parse_time_unit(column: str) -> float | None:
    """The unit of time in the name of a column, in seconds; None if there is none."""
    bracket = re.search(r"[(\[]([^)\]]{1,12})[)\]]", column)
    last = split_column_name(column).split("_")[-1]
    return _TIME_UNITS.get(fold_name(bracket[1].strip()).lower() if bracket else last)


_LENGTH_UNITS = {"mm": "mm", "millimeters": "mm", "millimetres": "mm", "cm": "cm", "centimeters": "cm"}
_LENGTH_UNITS |= {"centimetres": "cm", "m": "m", "meters": "m", "metres": "m"}


def parse_length_unit(column: str) -> str | None:
    """The unit of length in the name of a column: m, cm or mm; None if there is none."""
    bracket = re.search(r"[(\[]([^)\]]{1,12})[)\]]", column)
    return _LENGTH_UNITS.get(bracket[1].strip().lower() if bracket else split_column_name(column).split("_")[-1])


def are_degrees(columns: Sequence[str]) -> bool | None:
    """Whether the names of angles contain degrees or radians; None if neither."""
    text = " ".join(columns).lower()
    if "rad" in text:
        return False
    return True if "deg" in text else None


def _split_axis(parts: list[str]) -> list[tuple[str, str]]:
    """Possible stem and axis of a name: of the last word that is, or ends with, the letter of an axis."""
    for k in range(len(parts) - 1, -1, -1):
        part = parts[k]
        if part and part[-1] in "xyzw" and part[:-1] in _AXIS_PREFIXES:
            return [("_".join([*parts[:k], part[:-1] + "*", *parts[k + 1 :]]), part[-1])]
    return []


def _find_angles(words: dict[str, str], roles: Roles) -> None:
    def find_column(*names: str) -> str | None:
        avoid = {"left", "right", "low", "high", "std"}
        matches = (
            c for what in names for c, w in words.items() if what in w.split("_") and not avoid & set(w.split("_"))
        )
        return next(matches, None)

    azimuth, elevation = find_column("azimuth", "az"), find_column("elevation", "el")
    if azimuth and elevation:
        roles.azel = azimuth, elevation
    yaw, pitch, roll = find_column("yaw"), find_column("pitch"), find_column("roll")
    if yaw and pitch:
        roles.yaw_pitch_roll = (yaw, pitch, roll) if roll else (yaw, pitch)


def _rank_time_name(words: str) -> int | None:
    """Rank of a name as that of the time, lower is more likely; None if it is not a time."""
    exact = ("t", "time", "timestamp", "time_s", "sample_time", "unity_time", "utc_timestamp", "timestep")
    if words in exact:
        return exact.index(words)
    parts = words.split("_")
    if not any(p in ("time", "timestamp", "timestamps", "ticks", "clock", "utc") for p in parts):
        return None
    return 20 + 5 * len({"relative", "frame", "device", "raw", "duration", "delta", "dt"} & set(parts)) + len(parts)
