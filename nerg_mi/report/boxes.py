"""Named objects: boxes, by their names, in a JSON file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.bounded import read_json

MOST = 500
"""A file has so many boxes at most."""

_BYTES = 1 << 20
_NAME = 100


@dataclass(frozen=True, eq=False)
class Box:
    """What is called ``name`` lies between ``lower`` and ``upper`` (3,), in the coordinates of the place."""

    name: str
    lower: np.ndarray
    upper: np.ndarray

    def holds(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether ``points`` (..., 3) lie in it, or no farther than ``margin`` from it along each axis."""
        return np.all((points >= self.lower - margin) & (points <= self.upper + margin), axis=-1)


def read_boxes(path: str | Path) -> tuple[Box, ...]:
    """The boxes of a JSON file, in its order.

    Either names and boxes, ``{"shelf": [[x0, y0, z0], [x1, y1, z1]]}`` or ``{"shelf": {"min": [...], "max":
    [...]}}``, or ``{"regions": [{"name": "shelf", "min": [...], "max": [...]}]}`` with anything beside. Raises
    `NergError` for what is neither.
    """
    found = read_json(path, "file of objects", _BYTES)
    if isinstance(found, dict) and isinstance(found.get("regions"), list):
        entries = [(r.get("name"), r) if isinstance(r, dict) else (None, r) for r in found["regions"]]
    elif isinstance(found, dict):
        entries = list(found.items())
    else:
        raise _wrong(path, "it is no JSON object")
    if not 0 < len(entries) <= MOST:
        raise _wrong(path, f"it has {len(entries)} boxes, and 1 to {MOST} are read")
    boxes = tuple(_box(name, given, path) for name, given in entries)
    names = [box.name for box in boxes]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise _wrong(path, f'"{plain(twice, 40)}" is in it twice')
    return boxes


def _box(name: object, given: object, path: str | Path) -> Box:
    if not isinstance(name, str) or not 0 < len(name) <= _NAME:
        raise _wrong(path, f"a box is called {plain(name, 40)}; names have 1 to {_NAME} characters")
    corners = [given.get("min"), given.get("max")] if isinstance(given, dict) else given
    try:
        lower, upper = np.array(corners, np.float64).reshape(2, 3)
    except (TypeError, ValueError, OverflowError):
        raise _wrong(path, f'"{plain(name, 40)}" has no lower and upper corner of three numbers each') from None
    if not (np.isfinite([lower, upper]).all() and (lower < upper).all()):
        raise _wrong(path, f'the lower corner of "{plain(name, 40)}" is not below its upper one')
    return Box(name, lower, upper)


def _wrong(path: str | Path, why: str) -> NergError:
    return NergError(
        f'"{path}" names no objects ({why}); write {{"name": [[x0, y0, z0], [x1, y1, z1]], ...}} in the coordinates of '
        "the place"
    )
