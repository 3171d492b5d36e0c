"""Columns of tables: by which names they are found, and which say whether a row is valid."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize

from .tables import read_table_columns

# ---- Columns of a table by the names that they usually have ----

_ENOUGH = 20  # rows that tell a counter from people


class ColumnFinder:
    """Columns of one table by the names that they usually have.

    Spaces and dots are underscores, cases are one. Where no column is called so, names are taken apart into words too:
    ``gazeOrigin_x``, ``GazeOriginX`` and ``gaze origin [x]`` are ``gaze_origin_x``. Units in brackets are left out.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.columns = path, read_table_columns(path)
        self._by_name = {re.sub(r"[ .]", "_", c).lower(): c for c in reversed(self.columns)}
        self._by_words = {column_words(c): c for c in reversed(self.columns)}

    def find_vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...] | None:
        """The columns ``stem_x``, ``stem_y``, ... of the first of ``stems`` that has all of ``axes``; None without. Of
        the stem "" and of those that no column has with an underscore: ``x`` and ``stemx``."""
        ways = [(self._by_name, "_", stems), (self._by_words, "_", stems), (self._by_words, "", stems)]
        for known, joint, tried in ways:
            for stem in tried:
                names = [f"{stem}{joint if stem else ''}{axis}" for axis in axes]
                if all(n in known for n in names):
                    return tuple(known[n] for n in names)
        return None

    def vector(self, *stems: str, axes: str = "xyz") -> tuple[str, ...]:
        """As `find_vector`; raises `NergError` naming what there is where there are none."""
        found = self.find_vector(*stems, axes=axes)
        if found is None:
            wanted = " or ".join(f"{s}{'_' if s else ''}{{{','.join(axes)}}}" for s in stems)
            there = ", ".join(sanitize(c, 40) for c in self.columns[:16])
            raise NergError(f"{self.path} has no columns {wanted}; its columns are {there}; name them with --map")
        return found

    def find(self, *names: str) -> str | None:
        """The first of these columns that is there."""
        known = next((known for known in (self._by_name, self._by_words) if any(n in known for n in names)), {})
        return next((known[n] for n in names if n in known), None)

    def time(self, *names: str) -> str:
        """As `find`; raises `NergError` where there is no time."""
        found = self.find(*names)
        if found is None:
            raise NergError(f"{self.path} has no time; name its columns with --map")
        return found


def is_counter(values: Sequence[str] | np.ndarray) -> bool:
    """Whether values (n,) of rows are hardly ever the same, as those of a counter are, and not those of people."""
    return len(values) >= _ENOUGH and len(np.unique(values)) > 0.5 * len(values)


def column_words(column: str) -> str:
    """The words of a column's name in lower case with underscores between them, without a unit in brackets that is none
    of the axes: ``Gaze Origin.X (mm)`` is ``gaze_origin_x``."""
    axis = lambda unit: f"_{unit[1]}" if unit[1].lower() in tuple("xyzw") else ""
    # No name that is looked for is longer, and a bracket is looked for the end of.
    name = re.sub(r"[(\[]([^)\]]*)[)\]]", axis, column[:200])
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return re.sub(r"[^0-9a-z]+", "_", name.lower()).strip("_")


# ---- Which columns of a table of rays mean what ----
#
# Written as ``origin=x,y,z direction=dx,dy,dz t=time person=id confidence=valid hit=hx,hy,hz cohort=group``. In place
# of a direction, or beside one that is in the head's own frame, the head's pose: ``xyzw=qx,qy,qz,qw`` or
# ``wxyz=qw,qx,qy,qz`` (quaternion, its order in its name), ``ypr=yaw,pitch,roll`` (or yaw and pitch),
# ``matrix=m00,m01,...`` (12 or 16 columns, row by row, head to world; it holds the origin as well). ``eye=ex,ey,ez``:
# where the eye is in the head's frame. A direction may also be two angles: ``azel=azimuth,elevation`` (right and up) or
# ``yawpitch=yaw,pitch`` (which turn as those of ``ypr`` do); ``-`` before the name of a column turns its sign. For
# checks: ``head=fx,fy,fz`` or ``head=qx,qy,qz,qw``, where the head points while the direction is in the table's frame,
# and ``eyes=lx,ly,lz,rx,ry,rz``, where both eyes are.

_COUNTS = {
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
POSES = ("xyzw", "wxyz", "ypr", "matrix")
ANGLES = ("azel", "yawpitch")


@dataclass(frozen=True)
class ColumnMap:
    """Names of a table's columns. Required: where (``origin``, or in ``matrix``) and whereto (``direction``, angles or
    a pose).

    A ``direction``, or its angles, is in the head's frame beside a pose, and in the table's without one. Without ``t``
    rows are numbered, without ``person`` the file is the person, without ``confidence`` it is one. Raises `NergError`
    for a map that is incomplete or says one thing twice.
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
        poses = [p for p in POSES if getattr(self, p)]
        if len(poses) > 1:
            raise NergError(f"column map: {' and '.join(poses)} are two poses of one head; keep one of them")
        if self.origin is None and self.matrix is None:
            raise NergError("column map: origin is missing; add origin=x,y,z with the names of its columns")
        if self.origin is not None and self.matrix is not None:
            raise NergError("column map: origin is given twice, since matrix holds it; leave out origin")
        ways = [w for w in ("direction", *ANGLES) if getattr(self, w)]
        if len(ways) > 1:
            raise NergError(f"column map: {' and '.join(ways)} are two directions; keep one of them")
        if not ways and not poses:
            raise NergError(
                "column map: direction is missing; add direction=x,y,z with the names of its columns, angles "
                "(azel or yawpitch), or a pose (xyzw, wxyz, ypr or matrix)"
            )
        if self.eye is not None and not poses:
            raise NergError(
                "column map: eye is in the head's frame and needs a pose; add one (xyzw, wxyz, ypr or matrix)"
            )
        if self.head is not None and (poses or not (self.direction or self.angles)):
            raise NergError(
                "column map: head says where the head points while direction is in the table's frame; leave out "
                + (" or ".join(["head", *poses]) if poses else "head, or add direction")
            )

        names = [name for role in fields(self) for name in self._columns_of(role.name)]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise NergError(f"column map: the column {repeated!r} has two roles; name another one for each of them")

    def _columns_of(self, role: str) -> tuple[str, ...]:
        """The names of a role's columns, without the signs of angles."""
        value = getattr(self, role) or ()
        names = (value,) if isinstance(value, str) else value
        return tuple(name.removeprefix("-") for name in names) if role in ANGLES else names

    @property
    def pose(self) -> str | None:
        """Name of the pose's field, if there is one."""
        return next((p for p in POSES if getattr(self, p)), None)

    @property
    def angles(self) -> str | None:
        """Name of the field of a direction's angles, if there is one."""
        return next((a for a in ANGLES if getattr(self, a)), None)

    @classmethod
    def parse(cls, text: str) -> ColumnMap:
        """From ``"origin=x,y,z direction=dx,dy,dz t=time ..."``; names with spaces in double quotes.

        Raises `NergError` for an unknown or repeated field, a wrong number of columns, or an incomplete map.
        """
        import shlex

        try:
            words = shlex.split(text)
        except ValueError as error:
            raise NergError(f"column map: {str(error)[:1].lower()}{str(error)[1:]} in {text!r}; close it") from None
        # By a field's name what its type says: `_COUNTS` tells which are of one column.
        found: dict[str, Any] = {}
        for word in words:
            key, _, value = word.partition("=")
            columns = tuple(c.strip() for c in value.split(",") if c.strip())
            if key not in _COUNTS or key in found:
                raise NergError(f"column map: {key!r} is unknown or given twice; use {', '.join(_COUNTS)}, each once")
            if len(columns) not in _COUNTS[key]:
                needed = " or ".join(map(str, _COUNTS[key]))
                raise NergError(f"column map: {key} needs {needed} column name(s), got {len(columns)} in {word!r}")
            found[key] = columns[0] if _COUNTS[key] == (1,) else columns
        return cls(**found)

    def __str__(self) -> str:
        given = {name: value for name, value in vars(self).items() if value is not None}
        return " ".join(
            _quoted(f"{name}={value if isinstance(value, str) else ','.join(value)}") for name, value in given.items()
        )


def _quoted(word: str) -> str:
    """A word as `ColumnMap.parse` takes it apart, in double quotes where it has to be."""
    if not any(c.isspace() or c in "\"'\\" for c in word):
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'


# ---- Usual names ----
#
# Names that columns of headsets' logs usually have, in lower case with underscores; the earlier ones are preferred.

TIMES = ("t", "time", "timestamp", "time_s", "unity_time", "utc_timestamp", "raw_timestamp", "sender_time")
PERSONS = ("person", "participant", "participant_id", "participantid", "user", "user_id", "userid")
PERSONS += ("subject", "subject_id", "id")
HITS = ("hit", "gaze_hit", "hit_point", "hit_pos", "hit_position")
DIRECTIONS = ("gaze_dir", "gaze_direction", "gaze_forward")
EYES = ("gaze_origin", "gaze_position", "eye_position")
HEADS = ("head_pos", "head_position", "hmd_pos")
ROTATIONS = ("head_rot", "head_rotation", "hmd_rot")

# Names that do not say of what: where there are none of those above.
BARE_DIRECTIONS = ("dir", "direction", "d")
BARE_PLACES = ("origin", "pos", "position", "")
BARE_ROTATIONS = ("rot", "rotation", "quaternion", "quat", "q")

MORE_HEADS = (*HEADS, "hmd_position", "camera_pos", "camera_position", "cam_pos", "cam_position")
"""Of heads in logs of one headset, where a camera is the head's."""
MORE_ROTATIONS = (*ROTATIONS, "hmd_rotation", "camera_rot", "camera_rotation", "cam_rot", "cam_rotation")


# ---- Columns that say whether the gaze of a row is valid: how they are named, and what their values mean ----

# Of the gaze as a whole, as one word: isvalid, gazevalidity, combinedgazestatus. Those of one eye are none.
_OF_GAZE = re.compile(
    r"(is|has|was)?(gaze|eyes?|combined|tracking|tracker|ray|data|sample)*(is|has|was)?"
    r"(valid(ity)?|status|tracked|trackingstate)(flag|code)?|(is|has)?valid(gaze|eyes?|data|sample)|"
    r"(is)?(gaze|eye)trackingenabledandvalid"
)
# Words of names that may say so, too.
_MAY_BE = {"detected", "available", "found", "lost", "missing", "dropout", "blink", "blinking", "worn", "tracked"}
_VALID = ("valid", "true", "tracked", "tracking", "ok", "yes")
_INVALID = (
    *("invalid", "false", "lost", "untracked", "nottracked", "nottracking", "notvalid", "no", "none", "limited"),
    *("adjust", "calibrating", "unavailable", "missing", "error", "nan", "null", "na", ""),
)
_VARJO = {0, 1, 2}  # invalid, being calibrated, valid
_SHOWN = 6


def is_validity(column: str) -> bool:
    """Whether the name of a column says that it holds the validity of the gaze."""
    return bool(_OF_GAZE.fullmatch(column_words(column).replace("_", "")))


def looks_like_validity(column: str) -> bool:
    """Whether a name may be that of a validity of any kind, such as ``left_eye_validity``."""
    return "valid" in column.lower() or is_validity(column) or not _MAY_BE.isdisjoint(column_words(column).split("_"))


def valid_values(column: str, values: Iterable[str]) -> list[str] | None:
    """Those of the ``values`` of a column of validity that mark a valid row; None where one of them has no meaning that
    is certain.

    Words speak for themselves. A code of 1 beside 0 is "true", unless the column is a status, whose codes are the
    device's. The status of the gaze with codes to 2 is Varjo's: 0 invalid, 1 being calibrated, 2 valid.
    """
    words = {value: re.sub(r"[^a-z0-9.]", "", value.lower()) for value in values}
    codes = {value: float(value) for value in words if re.fullmatch(r"\s*[+-]?\d{1,9}(\.0*)?\s*", value)}
    name = column_words(column).replace("_", "")
    is_status = name.endswith(("status", "state", "code"))
    if is_status and "gaze" in name and 2 in codes.values() and set(codes.values()) <= _VARJO:
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
    """As `valid_values`; raises `NergError` naming the values, which occur ``counts`` times, where one has no meaning
    that is certain."""
    valid = valid_values(column, counts)
    if valid is None:
        some = sorted(counts, key=lambda value: -counts[value])[:_SHOWN]
        shown = ", ".join(f"{sanitize(value, 20) or 'nothing'} ({counts[value]:,} rows)" for value in some)
        more = f" and {len(counts) - _SHOWN} more" if len(counts) > _SHOWN else ""
        raise NergError(
            f"{source}: the column {sanitize(column, 40)!r} holds {shown}{more}, and nothing says which of them mark "
            f'valid rows; name those (--valid "{sanitize(column, 40)}=VALUE,VALUE"), or use no such column (--valid none)'
        )
    return valid


def mark_valid(cells: np.ndarray, values: Iterable[str]) -> np.ndarray:
    """Whether cells (n,) are one of the ``values``, (n,) bool; cases are one, and so are 2 and 2.0."""
    wanted = {_key(value) for value in values}
    different, where = np.unique(cells, return_inverse=True)
    return np.array([_key(cell) in wanted for cell in different.tolist()], bool)[where]


def _key(text: str) -> str:
    text = text.strip().lower()
    return text.partition(".")[0] if re.fullmatch(r"\d+\.0*", text) else text


def parse_valid(text: str | None) -> dict[str, tuple[str, ...]] | None:
    """Columns with the values of valid rows, of ``"gaze_status=2 isValid=true,1"``; none of ``none``; None without a
    text. Raises `NergError` for another text."""
    if text is None:
        return None
    import shlex

    try:
        words = [] if text.strip().lower() == "none" else shlex.split(text)
        pairs = {name: tuple(v.strip() for v in values.split(",")) for name, values in (w.split("=", 1) for w in words)}
    except ValueError:
        pairs = {"": ()}
    if any(not name or not any(values) for name, values in pairs.items()) or (not pairs and "none" not in text.lower()):
        raise NergError(f'--valid is {sanitize(text, 60)!r}; it is COLUMN=VALUE,VALUE (several between spaces), or "none"')
    return pairs


# ---- What the columns of a table are by their names: vectors, quaternions, matrices, angles, times, people ----

# What may stand before the letter of an axis in one word: tx, posX, GazeQX.
_BEFORE = ("", "t", "q", "p", "d", "h", "v", "g", "pos", "rot", "dir", "vec", "quat", "gaze", "head", "hit", "eye")
_NEVER = (
    *("velocity", "vel", "speed", "acceleration", "accel", "gyro", "gravity", "magnetic", "angular", "linear"),
    *("ecef", "scale", "size", "color", "uv", "std", "var", "screen", "webcam", "px", "pixel", "norm2d", "pupil"),
    *("target", "aoi", "hand", "controller", "screenpoint", "velo"),
)
_TIME_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0, "seconds": 1.0, "µs": 1e-6, "100ns": 1e-7}
_PEOPLE = (*PERSONS, "pid", "participant_name", "subject_name", "user_name", "person_id", "player")
_SURE = ("confidence", "gaze_confidence", "conf", "quality")


@dataclass
class Roles:
    """Columns of a table by what they may be, each kind by its stem: the words around the letters of the axes."""

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
    """The roles that the names of ``columns`` tell; those with a comma or an equals sign, which no map can name, have
    none."""
    words = {c: column_words(c) for c in columns if c and not set(c) & set(",=")}
    roles, every = Roles(), set(words.values())
    groups: dict[str, dict[str, str]] = {}
    cells: dict[str, dict[str, str]] = {}
    gravity: dict[str, str] = {}
    for column, name in words.items():
        parts = name.split("_")
        if "gravity" in parts:
            for _, axis in _axes(parts):
                gravity.setdefault(axis, column)
        if any(part in _NEVER and not (part == "px" and name.replace("px", "pz") in every) for part in parts):
            continue
        for stem, axis in _axes(parts):
            groups.setdefault(stem, {}).setdefault(axis, column)
        found = re.fullmatch(r"(.*?)_?m?([0-3])_?([0-3])", name)
        if found:
            cells.setdefault(found[1], {})[found[2] + found[3]] = column
    for stem, found in groups.items():
        if set("xyzw") <= set(found):
            roles.quaternions[stem] = tuple(found[a] for a in "xyzw")
        elif set("xyz") <= set(found):
            roles.vectors[stem] = tuple(found[a] for a in "xyz")
    for stem, found in cells.items():
        rows = 4 if "33" in found else 3
        names = [f"{r}{c}" for r in range(rows) for c in range(4)]
        if all(n in found for n in names):
            roles.matrices[stem] = tuple(found[n] for n in names)
    if set("xyz") <= set(gravity):
        roles.gravity = gravity["x"], gravity["y"], gravity["z"]
    _find_angles(words, roles)
    ranks = {column: rank for column, name in words.items() if (rank := _time_rank(name)) is not None}
    roles.times = sorted(ranks, key=ranks.__getitem__)
    roles.person = next((c for p in _PEOPLE for c, w in words.items() if w == p), None)
    roles.confidence = next((c for p in _SURE for c, w in words.items() if w == p), None)
    return roles


def time_unit(column: str) -> float | None:
    """Seconds of the unit that a column's name states; None where it states none."""
    bracket = re.search(r"[(\[]([^)\]]{1,12})[)\]]", column)
    last = column_words(column).split("_")[-1]
    return _TIME_UNITS.get(bracket[1].strip().lower() if bracket else last)


def in_degrees(columns: Sequence[str]) -> bool | None:
    """Whether the names of angles state degrees; None where they state nothing."""
    text = " ".join(columns).lower()
    if "rad" in text:
        return False
    return True if "deg" in text else None


def _axes(parts: list[str]) -> list[tuple[str, str]]:
    """Stems and axes that a name may mean: of the last word that is, or ends with, the letter of an axis."""
    for k in range(len(parts) - 1, -1, -1):
        part = parts[k]
        if part and part[-1] in "xyzw" and part[:-1] in _BEFORE:
            return [("_".join([*parts[:k], part[:-1] + "*", *parts[k + 1 :]]), part[-1])]
    return []


def _find_angles(words: dict[str, str], roles: Roles) -> None:
    def one(*names: str) -> str | None:
        avoid = {"left", "right", "low", "high", "std"}
        fits = (c for what in names for c, w in words.items() if what in w.split("_") and not avoid & set(w.split("_")))
        return next(fits, None)

    azimuth, elevation = one("azimuth", "az"), one("elevation", "el")
    if azimuth and elevation:
        roles.azel = azimuth, elevation
    yaw, pitch, roll = one("yaw"), one("pitch"), one("roll")
    if yaw and pitch:
        roles.yaw_pitch_roll = (yaw, pitch, roll) if roll else (yaw, pitch)


def _time_rank(words: str) -> int | None:
    """How likely a name is that of the time, the smaller the more; None: it is none."""
    exact = ("t", "time", "timestamp", "time_s", "sample_time", "unity_time", "utc_timestamp", "timestep")
    if words in exact:
        return exact.index(words)
    parts = words.split("_")
    if not any(p in ("time", "timestamp", "timestamps", "clock", "utc") for p in parts):
        return None
    return 20 + 5 * len({"relative", "frame", "device", "raw", "duration", "delta", "dt"} & set(parts)) + len(parts)
