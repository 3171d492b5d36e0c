"""What an area of interest can be, besides a box (`nerg_mi.formats.regions.Region`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.formats.regions import Region

DEEPEST = 100
"""So deep may groups be nested that stand before their parts."""


@dataclass(frozen=True)
class MeshPart:
    """The mesh in ``file``, or those of its faces whose numbers lie in one of the ranges ``faces``, ends included."""

    name: str
    file: Path
    faces: tuple[tuple[int, int], ...] | None = None

    def chosen(self, count: int) -> np.ndarray:
        """Which of ``count`` faces are of it, (count,) bool. Raises `NergError` for ranges beyond them."""
        if self.faces is None:
            return np.ones(count, bool)
        found = np.zeros(count, bool)
        for first, last in self.faces:
            if last >= count:
                raise NergError(
                    f'the area "{self.name}" asks for face {last} of "{self.file}", which has {count:,} (from 0 on)'
                )
            found[first : last + 1] = True
        return found


@dataclass(frozen=True)
class SceneShape:
    """The shape of the scene whose id is ``shape``."""

    name: str
    shape: str


@dataclass(frozen=True)
class Group:
    """Several others, by their names: whoever looks at one of its ``parts`` looks at it."""

    name: str
    parts: tuple[str, ...]


Area = Region | MeshPart | SceneShape | Group


@dataclass(frozen=True)
class Areas:
    """The areas of a file, in its order, whose names are different.

    ``others``: those that are no boxes, as they stand in the file. Raises `NergError` for groups of what there is not,
    and for groups that hold themselves.
    """

    areas: tuple[Area, ...]
    others: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        names = [a.name for a in self.areas]
        twice = next((n for n in names if names.count(n) > 1), None) if len(set(names)) < len(names) else None
        if twice is not None:
            raise NergError(f'two areas are called "{twice}"; rename one of them')
        for area in self.areas:
            if not isinstance(area, Group):
                continue
            unknown = next((p for p in area.parts if p not in names), None)
            if unknown is not None:
                raise NergError(f'the group "{area.name}" has a part "{unknown}", and there is no such area')
        self.members()

    @property
    def names(self) -> tuple[str, ...]:
        """Of all."""
        return tuple(a.name for a in self.areas)

    @property
    def boxes(self) -> list[Region]:
        """Those that are boxes."""
        return [a for a in self.areas if isinstance(a, Region)]

    @property
    def things(self) -> tuple[Region | MeshPart | SceneShape, ...]:
        """Those that are no groups."""
        return tuple(a for a in self.areas if not isinstance(a, Group))

    @property
    def solids(self) -> dict[str, tuple[int, ...]]:
        """Those that are boxes, or groups of boxes alone, by name: the numbers of the `boxes` that each consists of."""
        number = {k: n for n, k in enumerate(k for k, thing in enumerate(self.things) if isinstance(thing, Region))}
        every = self.members().items()
        return {name: tuple(number[k] for k in of) for name, of in every if all(k in number for k in of)}

    def members(self) -> dict[str, tuple[int, ...]]:
        """Of each area, which of the `things` it consists of, by their numbers."""
        by_name = {a.name: a for a in self.areas}
        known = {a.name: frozenset([k]) for k, a in enumerate(self.things)}
        for area in self.areas:
            _resolve(area, by_name, known, ())
        return {a.name: tuple(sorted(known[a.name])) for a in self.areas}


def _resolve(area: Area, by_name: dict[str, Area], known: dict[str, frozenset[int]], above: tuple[str, ...]) -> None:
    """Add to what is ``known`` of which things areas consist those of ``area`` and of its parts, each looked at once.
    Raises `NergError` for a group that holds itself."""
    if area.name in above or len(above) > DEEPEST:
        raise NergError(f'the group "{area.name}" holds itself, or groups are nested deeper than {DEEPEST}')
    if area.name in known or not isinstance(area, Group):
        return
    for part in area.parts:
        _resolve(by_name[part], by_name, known, (*above, area.name))
    known[area.name] = frozenset().union(*(known[part] for part in area.parts))
