"""Areas of interest that are boxes with names, as JSON: drawn in the viewer, counted by a report, written by hand.

What else may stand in such a file (parts of meshes, shapes of a scene, groups, the objects of a recording) is read by
`nerg_mi.formats.areas`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.safe_read import read_json
from nerg_mi.ranges import FARTHEST

BYTES = 4 << 20
"""A file of areas may have so many bytes."""

MOST = 1000
"""And so many areas."""

Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""

BEYOND_BOXES = ("mesh", "shape", "parts", "adt")
"""Keys of which an area has one that is no box."""

_LETTERS = 80
_EXAMPLE = '{"shelf": [[0, 0, 0], [1, 2, 3]]}'


@dataclass(frozen=True)
class Region:
    """A box between two corners, in scene units; turned about its middle by the unit quaternion ``turn``, if any."""

    name: str
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    turn: Quaternion | None = None

    def __post_init__(self) -> None:
        corners = np.array([self.lower, self.upper], float)
        if corners.shape == (2, 3) and not (np.abs(corners) <= FARTHEST).all():
            raise NergError(
                f'the area "{plain(self.name, 40)}" reaches to {np.abs(corners).max():g}; its corners must be finite, '
                f"and at most {FARTHEST:g}"
            )
        if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
            raise NergError(
                f'the area "{plain(self.name, 40)}" needs a lower and an upper corner of three numbers, each '
                "less in the lower one"
            )
        check_name(self.name)
        if self.turn is not None:
            size = math.hypot(*self.turn) if len(self.turn) == 4 else math.nan
            if not abs(size - 1) < 1e-3:
                raise NergError(f'the turn of the area "{plain(self.name, 40)}" is no rotation; give a unit quaternion')

    @classmethod
    def of(
        cls, name: str, lower: Iterable[float], upper: Iterable[float], turn: Iterable[float] | float | None = None
    ) -> Region:
        """The same of any numbers. ``turn``: a quaternion (x, y, z, w) of any length but zero, or degrees about z,
        counter-clockwise seen from above. Raises `NergError` where they are not three each, or no rotation."""
        low, high = [float(v) for v in lower], [float(v) for v in upper]
        if len(low) != 3 or len(high) != 3:
            raise NergError(f'the area "{plain(name, 40)}" needs a lower and an upper corner of three numbers')
        return cls(name, (low[0], low[1], low[2]), (high[0], high[1], high[2]), _turn(turn, name))

    @property
    def corners(self) -> np.ndarray:
        """(2, 3)."""
        return np.array([self.lower, self.upper], float)

    @property
    def middle(self) -> np.ndarray:
        """(3,)."""
        return self.corners.mean(axis=0)

    @property
    def matrix(self) -> np.ndarray:
        """Rotation (3, 3) whose columns are the box's own axes."""
        if self.turn is None:
            return np.eye(3)
        x, y, z, w = np.array(self.turn, float) / math.hypot(*self.turn)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    def to_own(self, points: np.ndarray) -> np.ndarray:
        """``points`` (..., 3) turned back about the middle, where this is the box between `corners`."""
        return points if self.turn is None else (points - self.middle) @ self.matrix + self.middle

    def place(self, points: np.ndarray) -> np.ndarray:
        """The inverse of `to_own`."""
        return points if self.turn is None else (points - self.middle) @ self.matrix.T + self.middle

    @property
    def vertices(self) -> np.ndarray:
        """The box's own eight corners (8, 3); bit k of a row's number chooses the upper one along axis k."""
        upper = (np.arange(8)[:, None] >> np.arange(3) & 1).astype(bool)
        return self.place(np.where(upper, self.corners[1], self.corners[0]))

    @property
    def bounds(self) -> np.ndarray:
        """Corners (2, 3) of the smallest upright box around it."""
        return self.corners if self.turn is None else np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def holds(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether ``points`` (..., 3) lie in it, or no farther than ``margin`` from it along each of its axes."""
        lower, upper = self.corners
        with np.errstate(invalid="ignore"):
            points = self.to_own(np.asarray(points, float))
        return np.all((points >= lower - margin) & (points <= upper + margin), axis=-1)


def check_name(name: str) -> None:
    """Raise `NergError` for a name that no area may have."""
    if not name.strip() or len(name) > _LETTERS or not name.isprintable():
        raise NergError(f'an area needs a name of 1 to {_LETTERS} printable characters, got "{plain(name, 40)}"')


def _turn(turn: Iterable[float] | float | None, name: str) -> Quaternion | None:
    if turn is None:
        return None
    if isinstance(turn, (int, float)):
        half = math.radians(float(turn)) / 2 if math.isfinite(turn) else math.nan
        x, y, z, w = 0.0, 0.0, math.sin(half), math.cos(half)
    else:
        given = [float(v) for v in turn]
        size = math.hypot(*given)
        if len(given) != 4 or not 1e-6 < size < 1e6:
            raise NergError(f'the turn of the area "{plain(name, 40)}" is degrees about z, or four numbers x, y, z, w')
        x, y, z, w = (v / size for v in given)
    if not math.isfinite(x + y + z + w):
        raise NergError(f'the turn of the area "{plain(name, 40)}" is degrees about z, or four numbers x, y, z, w')
    return (x, y, z, w)


def read_regions(path: str | Path) -> list[Region]:
    """The areas of a JSON file that are boxes, in its order; others are passed over (`nerg_mi.formats.areas`).

    Either as `to_json` writes them, ``{"regions": [{"name": "shelf", "min": [x, y, z], "max": [x, y, z]}]}`` with
    anything beside, or names and boxes alone: ``{"shelf": [[x, y, z], [x, y, z]]}``, or ``{"shelf": {"min": [...],
    "max": [...]}}``. A box may have a ``turn`` about its middle: degrees about z, or a quaternion x, y, z, w. Raises
    `NergError` for what is neither, and where none is a box.
    """
    entries = read_entries(path)
    boxes = [parse_box(e) for e in entries if e.is_box]
    if not boxes:
        raise NergError(f'"{path}" has no area that is a box; draw one in the viewer, or write {_EXAMPLE}')
    return boxes


@dataclass(frozen=True)
class Entry:
    """What a file says of an area: its ``name`` and what it is ``given`` as; ``where``: for errors."""

    name: object
    given: Any
    where: str

    @property
    def is_box(self) -> bool:
        """Whether it is a box, or nothing that is known."""
        return not (isinstance(self.given, dict) and any(key in self.given for key in BEYOND_BOXES))


def read_entries(path: str | Path) -> list[Entry]:
    """What a file of areas has, not looked at yet. Raises `NergError` for what is no such file, and for names that come
    twice."""
    found = read_json(path, "file of areas", BYTES)
    if isinstance(found, dict) and isinstance(found.get("regions"), list):
        listed = [(one.get("name"), one) if isinstance(one, dict) else (None, one) for one in found["regions"]]
    elif isinstance(found, dict):
        listed = list(found.items())
    else:
        raise NergError(f'"{path}" names no areas; write {_EXAMPLE} in the coordinates of the place')
    if not 0 < len(listed) <= MOST:
        raise NergError(f'"{path}" has {len(listed)} areas, and 1 to {MOST} are read; write {_EXAMPLE}')
    names = [name for name, _ in listed if isinstance(name, str)]
    if len(set(names)) < len(names):
        raise NergError(f'"{path}" has two areas of one name; rename one of them')
    return [Entry(name, given, f'"{path}", area {k + 1}') for k, (name, given) in enumerate(listed)]


def parse_box(entry: Entry) -> Region:
    """The box of an entry. Raises `NergError` for what is none."""
    name, given, where = entry.name, entry.given, entry.where
    corners: Any = (given.get("min"), given.get("max")) if isinstance(given, dict) else given
    turn: Any = given.get("turn") if isinstance(given, dict) else None
    try:
        lower, upper = (list(corner) for corner in corners)
        numbers = [*lower, *upper, *(turn if isinstance(turn, list) else [] if turn is None else [turn])]
        if not isinstance(name, str) or not all(is_number(v) for v in numbers):
            raise ValueError
    except (TypeError, ValueError) as error:
        raise NergError(f"{where} needs a name, and two corners of three numbers each, as in {_EXAMPLE}") from error
    try:
        return Region.of(name, lower, upper, turn)
    except (NergError, OverflowError) as error:
        raise NergError(f"{where}: {error}") from error


def is_number(value: object) -> bool:
    """Whether a value of a JSON file is one."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def to_json(regions: Sequence[Region], others: Sequence[dict[str, Any]] = ()) -> str:
    """``regions`` as the text of a JSON file, with ``others`` as they stood in one after them."""
    return json.dumps({"regions": [*map(box_json, regions), *others]}, indent=1) + "\n"


def box_json(region: Region) -> dict[str, Any]:
    """A box as it stands in a file."""
    turn = {} if region.turn is None else {"turn": list(region.turn)}
    return {"name": region.name, "min": list(region.lower), "max": list(region.upper), **turn}
