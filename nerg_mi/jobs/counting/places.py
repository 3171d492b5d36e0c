"""Places on the floor where nobody was tracked: where one can stand, and what is seen from there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.statistics.tables import Row
from nerg_mi.statistics.visibility import Isovists, standing
from nerg_mi.statistics.visits import ALL

from .surroundings import Surroundings
from .tracked import Eyes


def look_around(around: Surroundings, height: float, step: float, floor: float) -> np.ndarray:
    """Places (G, 3) at eye height where one can stand. Raises `NergError` where there are none."""
    lower, upper = around.bounds()
    found = standing(lower, upper, step * around.scale, height * around.scale, around.depth, floor)
    if not len(found):
        raise NergError(
            f"nobody can stand anywhere: there is no floor at {floor:g} (--floor) below eyes at {height:g} (--height)"
        )
    return found


def places_of(positions: np.ndarray) -> Eyes:
    """Somebody at each of ``positions`` (M, 3), who may turn round."""
    names = tuple(f"observer {k + 1:0{len(str(len(positions)))}d}" for k in range(len(positions)))
    return Eyes(positions, np.tile([1.0, 0, 0], (len(positions), 1)), names, (frozenset([ALL]),) * len(positions))


def isovist_rows(found: Isovists, names: Sequence[str], members: Sequence[tuple[int, ...]]) -> list[Row]:
    """A row for each place; of each area the share of its points that are seen from there."""
    rows = []
    for k, (x, y, z) in enumerate(found.points.tolist()):
        row: Row = {"x": x, "y": y, "z": z}
        row |= {n: float(getattr(found, n)[k]) for n in ("area", "perimeter", "nearest", "farthest", "radius")}
        rows.append(row | {f"sees {n}": float(found.seen[k, list(of)].mean()) for n, of in zip(names, members)})
    return rows
