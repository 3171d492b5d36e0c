"""Areas of interest: boxes with names, as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.files.bounded import read_json

BYTES = 4 << 20
"""A file of areas may have so many bytes."""

MOST = 1000
"""And so many areas."""

_LETTERS = 80


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


def read_regions(path: str | Path) -> list[Region]:
    """The areas of a JSON file as `to_json` writes it, ``{"regions": [{"name": ..., "min": [x, y, z], "max": ...}]}``;
    whatever else is in it is passed over. Raises `NergError` for anything else."""
    found = read_json(path, "file of areas", BYTES)
    listed = found.get("regions") if isinstance(found, dict) else None
    if not isinstance(listed, list) or len(listed) > MOST:
        raise NergError(f'"{path}" is no file of areas: it needs "regions", a list of at most {MOST} boxes')
    regions = []
    for k, one in enumerate(listed):
        try:
            name, lower, upper = one["name"], list(one["min"]), list(one["max"])
            if not isinstance(name, str) or not all(is_number(v) for v in (*lower, *upper)):
                raise ValueError
        except (TypeError, KeyError, ValueError) as error:
            raise NergError(f'"{path}": area {k + 1} needs "name", "min" and "max", three numbers each') from error
        try:
            regions.append(Region.of(name, lower, upper))
        except (NergError, OverflowError) as error:
            raise NergError(f'"{path}", area {k + 1}: {error}') from error
    names = [region.name for region in regions]
    if len(set(names)) < len(names):
        raise NergError(f'"{path}" has two areas of one name; rename one of them')
    return regions


def is_number(value: object) -> bool:
    """Whether a value of a JSON file is one."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def to_json(regions: Sequence[Region]) -> str:
    """``regions`` as the text of a JSON file."""
    listed = [{"name": r.name, "min": list(r.lower), "max": list(r.upper)} for r in regions]
    return json.dumps({"regions": listed}, indent=1) + "\n"
