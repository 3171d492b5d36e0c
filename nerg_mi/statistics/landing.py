"""Which things rays land on: boxes in closed form, whatever else by what somebody has cast, and what hides them.

A ray is on a box if it crosses it and the first surface that it meets lies in the box: near - margin <= depth < far +
margin, where it enters at ``near`` and leaves at ``far``. So a larger box never has less, boxes that fill space without
overlap share out all rays that meet a surface (with a margin of 0), and a ray that crosses a box and ends behind it is
not on it. A ray is on a mesh or a shape if it meets it before it meets another surface: at ``near`` <= depth + margin.
Where no surfaces are known, things are solid: one hides another that the ray enters after it has left the first; things
that overlap along the ray both have the look.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from nerg_mi.formats.regions import Region
from nerg_mi.maths.geometry import box_interval

MARGIN = 0.03
"""In metres: of surfaces that are known as exactly as a radiance field has them."""


class Thing(Protocol):
    """What can be looked at, in the coordinates of the place."""

    @property
    def name(self) -> str:
        """Of its area."""
        ...

    @property
    def open(self) -> bool:
        """Whether it is a surface, of which nobody is inside."""
        ...

    def interval(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(near, far)`` (N,): where rays (N, 3) enter and leave it; ``near`` >= ``far`` where they miss it, and
        ``near`` < 0 from within. Of a surface both are its distance, and infinite where it is missed."""
        ...

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        """Middle (3,) and radius of a ball around it."""
        ...

    def may_meet(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Whether rays (N, 3) may be on it (N,): they cross a box around it."""
        ...

    def samples(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """About ``count`` points (S, 3) spread over its surface evenly by area, and their outward normals (S, 3), zero
        where both sides are seen; always the same ones."""
        ...


@dataclass(frozen=True)
class Box:
    """A box, upright or turned."""

    region: Region
    open = False

    @property
    def name(self) -> str:
        return self.region.name

    def interval(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        region = self.region
        turned = d if region.turn is None else d @ region.matrix
        return box_interval(region.to_own(np.asarray(o, float)), turned, *region.corners)

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        lower, upper = self.region.corners
        return self.region.middle, float(np.linalg.norm(upper - lower)) / 2

    def may_meet(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        near, far = self.interval(o, d)
        return (near < far) & (far > 0)

    def samples(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self.region.corners
        size = upper - lower
        # An edge of the squares whose number is about the count.
        faces = 2 * np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
        edge = np.sqrt(faces.sum() / count)
        points, normals = [], []
        for axis in range(3):
            u, v = (k for k in range(3) if k != axis)
            steps = [max(1, round(float(size[k] / edge))) for k in (u, v)]
            a, b = (lower[k] + (np.arange(n) + 0.5) / n * size[k] for k, n in zip((u, v), steps))
            grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
            for side, sign in ((lower, -1.0), (upper, 1.0)):
                face = np.empty((len(grid), 3))
                face[:, (u, v)], face[:, axis] = grid, side[axis]
                out = np.zeros((len(grid), 3))
                out[:, axis] = sign
                points.append(face)
                normals.append(out)
        found = np.concatenate(points), np.concatenate(normals)
        return self.region.place(found[0]), found[1] @ self.region.matrix.T


@dataclass(frozen=True)
class Landed:
    """What N rays land on, thing by thing: the ``rows`` of those that are on it, and at which ``distance`` each enters
    it, or from within meets the surface there."""

    count: int
    rows: tuple[np.ndarray, ...]
    distance: tuple[np.ndarray, ...]

    def matrix(self) -> np.ndarray:
        """Whether each ray is on each thing (N, K)."""
        found = np.zeros((self.count, len(self.rows)), bool)
        for k, rows in enumerate(self.rows):
            found[rows, k] = True
        return found


def land(
    things: Sequence[Thing],
    o: np.ndarray,
    d: np.ndarray,
    depth: np.ndarray | None,
    margin: float = 0.0,
    among: Sequence[np.ndarray] | None = None,
) -> Landed:
    """What rays (N, 3) with unit directions land on.

    ``depth`` (N,): of the surface that each meets, infinite where it meets none; None: no surfaces are known.
    ``margin``: a surface may lie so far in front of a thing, or behind the end of a box, and yet be its own.
    ``among``: of each thing the rows, rising, of the rays that may be on it; None: all.
    """
    if depth is None:
        return _land_on_solids(things, o, d, margin)
    rows, distance = [], []
    for k, thing in enumerate(things):
        some = slice(None) if among is None else among[k]
        near, far = thing.interval(o[some], d[some])
        reach = depth[some]
        if thing.open:
            on, at = np.isfinite(near) & (near >= 0) & (near <= reach + margin), near
        else:
            ends = (near - margin <= reach) & (reach < far + margin)
            on, at = (near < far) & (far > 0) & ends & np.isfinite(reach), np.where(near < 0, reach, near)
        found = np.flatnonzero(on)
        rows.append(found if among is None else among[k][found])
        distance.append(at[found].astype(np.float64))
    return Landed(len(o), tuple(rows), tuple(distance))


def _land_on_solids(things: Sequence[Thing], o: np.ndarray, d: np.ndarray, margin: float) -> Landed:
    """What rays land on where nothing is known but the things."""
    spans = [thing.interval(o, d) for thing in things]
    entered = [
        (near >= 0) & (np.isfinite(near) if thing.open else near < far) for thing, (near, far) in zip(things, spans)
    ]
    reach = np.full(len(o), np.inf)
    for (_, far), met in zip(spans, entered):
        reach = np.where(met, np.minimum(reach, far), reach)
    rows = [np.flatnonzero(met & (near <= reach + margin)) for (near, _), met in zip(spans, entered)]
    return Landed(len(o), tuple(rows), tuple(near[r].astype(np.float64) for (near, _), r in zip(spans, rows)))


def regroup(landed: Landed, members: Sequence[tuple[int, ...]]) -> Landed:
    """The same for areas that consist of some of the things each, ``members``: a ray is on an area if it is on any of
    them, at the least of their distances."""
    rows, distance = [], []
    for of in members:
        if len(of) == 1:
            rows.append(landed.rows[of[0]])
            distance.append(landed.distance[of[0]])
            continue
        every = np.concatenate([landed.rows[k] for k in of])
        far = np.concatenate([landed.distance[k] for k in of])
        order = np.lexsort((far, every))
        found, first = np.unique(every[order], return_index=True)
        rows.append(found)
        distance.append(far[order][first])
    return Landed(landed.count, tuple(rows), tuple(distance))


def unite(parts: Sequence[Landed]) -> Landed:
    """What the same rays land on in any of several ways, such as the directions of a cone: of each thing the union of
    the rays, with the distance of the first way that has it."""
    count, things = parts[0].count, len(parts[0].rows)
    rows, distance = [], []
    for k in range(things):
        every = np.concatenate([part.rows[k] for part in parts])
        far = np.concatenate([part.distance[k] for part in parts])
        found, first = np.unique(every, return_index=True)
        rows.append(found)
        distance.append(far[first])
    return Landed(count, tuple(rows), tuple(distance))


def concatenate(parts: Sequence[Landed]) -> Landed:
    """What rays land on that follow each other."""
    starts = np.cumsum([0, *(part.count for part in parts)])
    things = len(parts[0].rows)
    rows = [np.concatenate([part.rows[k] + a for part, a in zip(parts, starts)]) for k in range(things)]
    distance = [np.concatenate([part.distance[k] for part in parts]) for k in range(things)]
    return Landed(int(starts[-1]), tuple(rows), tuple(distance))


def cone(d: np.ndarray, degrees: float, rings: Sequence[tuple[float, int]] = ((0.5, 6), (1.0, 12))) -> list[np.ndarray]:
    """Unit directions (N, 3) about each of ``d`` (N, 3), itself first, then so many evenly on each of the ``rings``
    (share of the angle ``degrees``, number): 19 directions that leave no hole wider than half of the angle."""
    d = np.asarray(d, float)
    sign = np.where(d[:, 2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + d[:, 2])
    b = d[:, 0] * d[:, 1] * a
    # Two unit vectors beside each direction (Duff et al. 2017).
    u = np.stack([1 + sign * d[:, 0] ** 2 * a, sign * b, -sign * d[:, 0]], axis=1)
    v = np.stack([b, sign + d[:, 1] ** 2 * a, -d[:, 1]], axis=1)
    found = [d]
    for share, number in rings:
        angle = np.radians(degrees * share)
        for turn in 2 * np.pi * np.arange(number) / number:
            found.append(np.cos(angle) * d + np.sin(angle) * (np.cos(turn) * u + np.sin(turn) * v))
    return found
