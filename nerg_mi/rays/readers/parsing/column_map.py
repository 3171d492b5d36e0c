"""Which columns of a table of rays mean what.

Written as ``origin=x,y,z direction=dx,dy,dz t=time person=id confidence=valid hit=hx,hy,hz cohort=group``. In place of
a direction, or beside one that is in the head's own frame, the head's pose: ``xyzw=qx,qy,qz,qw`` or
``wxyz=qw,qx,qy,qz`` (quaternion, its order in its name), ``ypr=yaw,pitch,roll`` (or yaw and pitch),
``matrix=m00,m01,...`` (12 or 16 columns, row by row, head to world; it holds the origin as well). ``eye=ex,ey,ez``:
where the eye is in the head's frame. A direction may also be two angles: ``azel=azimuth,elevation`` (right and up) or
``yawpitch=yaw,pitch`` (which turn as those of ``ypr`` do); ``-`` before the name of a column turns its sign. For
checks: ``head=fx,fy,fz`` or ``head=qx,qy,qz,qw``, where the head points while the direction is in the table's frame,
and ``eyes=lx,ly,lz,rx,ry,rz``, where both eyes are.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from nerg_mi.errors import NergError

_COUNTS = {
    "origin": (3,),
    "direction": (3,),
    "azel": (2,),
    "yawpitch": (2,),
    "xyzw": (4,),
    "wxyz": (4,),
    "ypr": (2, 3),
    "matrix": (12, 16),
    "eye": (3,),
    "hit": (3,),
    "t": (1,),
    "person": (1,),
    "confidence": (1,),
    "cohort": (1,),
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

        names = [name for field in fields(self) for name in self._columns_of(field.name)]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise NergError(f"column map: the column {repeated!r} has two roles; name another one for each of them")

    def _columns_of(self, field: str) -> tuple[str, ...]:
        """The names of a field's columns, without the signs of angles."""
        value = getattr(self, field) or ()
        names = (value,) if isinstance(value, str) else value
        return tuple(name.removeprefix("-") for name in names) if field in ANGLES else names

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
        words = []
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None:
                words.append(_quoted(f"{field.name}={value if isinstance(value, str) else ','.join(value)}"))
        return " ".join(words)


def _quoted(word: str) -> str:
    """A word as `ColumnMap.parse` takes it apart, in double quotes where it has to be."""
    if not any(c.isspace() or c in "\"'\\" for c in word):
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'
