"""Areas of interest: boxes with names, as JSON: drawn in the viewer, counted by a report, written by hand."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.bounded import read_json

BYTES = 4 << 20
"""A file of areas may have so many bytes."""

MOST = 1000
"""And so many areas."""

_LETTERS = 80
_EXAMPLE = '{"shelf": [[0, 0, 0], [1, 2, 3]]}'


@dataclass(frozen=True)
class Region:
    """A box between two corners, in scene units."""

    name: str
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        corners = np.array([self.lower, self.upper], float)
        if corners.shape != (2, 3) or not (np.abs(corners) < 1e30).all() or not (corners[0] < corners[1]).all():
            raise NergError(f'the area "{plain(self.name, 40)}" needs a lower and an upper corner of three numbers')
        if not self.name.strip() or len(self.name) > _LETTERS or not self.name.isprintable():
            raise NergError(
                f'an area needs a name of 1 to {_LETTERS} printable characters, got "{plain(self.name, 40)}"'
            )

    @classmethod
    def of(cls, name: str, lower: Iterable[float], upper: Iterable[float]) -> Region:
        """The same of any numbers. Raises `NergError` where they are not three each."""
        low, high = [float(v) for v in lower], [float(v) for v in upper]
        if len(low) != 3 or len(high) != 3:
            raise NergError(f'the area "{plain(name, 40)}" needs a lower and an upper corner of three numbers')
        return cls(name, (low[0], low[1], low[2]), (high[0], high[1], high[2]))

    @property
    def corners(self) -> np.ndarray:
        """(2, 3)."""
        return np.array([self.lower, self.upper], float)

    def holds(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether ``points`` (..., 3) lie in it, or no farther than ``margin`` from it along each axis."""
        lower, upper = self.corners
        return np.all((points >= lower - margin) & (points <= upper + margin), axis=-1)


def read_regions(path: str | Path) -> list[Region]:
    """The areas of a JSON file, in its order.

    Either as `to_json` writes them, ``{"regions": [{"name": "shelf", "min": [x, y, z], "max": [x, y, z]}]}`` with
    anything beside, or names and boxes alone: ``{"shelf": [[x, y, z], [x, y, z]]}``, or ``{"shelf": {"min": [...],
    "max": [...]}}``. Raises `NergError` for what is neither.
    """
    found = read_json(path, "file of areas", BYTES)
    if isinstance(found, dict) and isinstance(found.get("regions"), list):
        listed = [(one.get("name"), one) if isinstance(one, dict) else (None, one) for one in found["regions"]]
    elif isinstance(found, dict):
        listed = list(found.items())
    else:
        raise NergError(f'"{path}" names no areas; write {_EXAMPLE} in the coordinates of the place')
    if not 0 < len(listed) <= MOST:
        raise NergError(f'"{path}" has {len(listed)} areas, and 1 to {MOST} are read; write {_EXAMPLE}')
    regions = [_region(name, given, f'"{path}", area {k + 1}') for k, (name, given) in enumerate(listed)]
    names = [region.name for region in regions]
    if len(set(names)) < len(names):
        raise NergError(f'"{path}" has two areas of one name; rename one of them')
    return regions


def _region(name: object, given: object, where: str) -> Region:
    corners: Any = (given.get("min"), given.get("max")) if isinstance(given, dict) else given
    try:
        lower, upper = (list(corner) for corner in corners)
        if not isinstance(name, str) or not all(is_number(v) for v in (*lower, *upper)):
            raise ValueError
    except (TypeError, ValueError) as error:
        raise NergError(f"{where} needs a name, and two corners of three numbers each, as in {_EXAMPLE}") from error
    try:
        return Region.of(name, lower, upper)
    except (NergError, OverflowError) as error:
        raise NergError(f"{where}: {error}") from error


def is_number(value: object) -> bool:
    """Whether a value of a JSON file is one."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def to_json(regions: Sequence[Region]) -> str:
    """``regions`` as the text of a JSON file."""
    listed = [{"name": r.name, "min": list(r.lower), "max": list(r.upper)} for r in regions]
    return json.dumps({"regions": listed}, indent=1) + "\n"
