"""What the browser draws by itself: points on the surfaces of a place, with the gaze that they attract.

Rays in all directions, from places that see different parts of it, end on surfaces; of points that lie in one cell of a
grid one is kept. They are in such an order that the first of them are spread over the place as evenly as all: a browser
that draws slowly is given fewer, and a step of their gaze says roughly that of all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nerg_mi.api.queries import observe, trace
from nerg_mi.api.scene import Scene
from nerg_mi.maths.sphere import fibonacci_directions

from .refining import filled, rough_integrals

RAYS = 1 << 14
"""Rays from each place."""

PLACES = 12
"""So many places are looked from."""

POINTS = 60_000
"""So many points are kept at most: what a browser without a graphics card still moves."""

BATCH = 1 << 14
"""Points whose gaze is computed in one step."""

FREE = 1 << 11
"""Places in free air that are remembered at most."""

LEVELS = 4
"""Numbers of points that a browser may be given: at each next one, cells are wider by a factor of √2."""

LIGHT_SEEDS = 4
"""Samples of the light on shapes, which is random."""


@dataclass(frozen=True, eq=False)
class Points:
    """``points`` (N, 3) in scene units with ``colors`` (N, 3) uint8, each in a cell of ``size``."""

    points: np.ndarray
    colors: np.ndarray
    size: float


@dataclass(frozen=True, eq=False)
class Proxy:
    """``points`` (N, 3) in scene units, their linear ``color`` (N, 3), and the ``size`` of the cells that they
    lie in. ``levels``: how many of the first points lie in cells of a size, ``(N, size)`` and fewer. ``near`` (N,): of
    the first `BATCH` points the one nearest to each. ``free`` (F, 3): places in free air."""

    points: np.ndarray
    color: np.ndarray
    size: float
    levels: tuple[tuple[int, float], ...]
    near: np.ndarray
    free: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of what nearly all points lie in: a few may be far off."""
        return np.percentile(self.points, 0.5, axis=0), np.percentile(self.points, 99.5, axis=0)


def gather(scene: Scene, eyes: Sequence[np.ndarray], places: int = PLACES) -> Iterator[Proxy | None]:
    """Points seen from ``eyes`` (3,), and from places between them and what they see; None between steps, a first
    proxy of ``eyes`` alone, and in the end that of all."""
    directions = np.asarray(fibonacci_directions(RAYS), float)
    seeds = 1 if scene.integrator.medium is not None else LIGHT_SEEDS
    found: list[tuple[np.ndarray, np.ndarray]] = []
    free: list[np.ndarray] = []
    visited: list[np.ndarray] = []
    waiting = [np.asarray(eye, float) for eye in eyes]
    while len(visited) < places:
        if len(visited) == len(eyes) and found:
            yield replace(thin(found), free=_some(free))
        at = waiting.pop(0) if waiting else _farthest(free, visited)
        if at is None:
            break
        visited.append(at)
        seen = trace(scene, at, directions, ["color", "depth", "opacity"])
        color = np.asarray(seen.color, float) / seeds
        yield None
        for seed in range(1, seeds):
            color += (
                np.asarray(trace(scene, at, directions, ["color", "depth", "opacity"], seed=seed).color, float) / seeds
            )
            yield None
        met = (np.asarray(seen.opacity) > 0.5) & (seen.depth > 0) & np.isfinite(seen.depth)
        depth = np.asarray(seen.depth, float)
        points = at + depth[:, None] * directions
        found.append((points[met], color[met]))
        # Half way to a surface that is not near there is room to look from.
        roomy = np.flatnonzero(met & (depth > np.median(depth[met])))[::97] if met.any() else []
        free += [at + 0.5 * depth[k] * directions[k] for k in roomy]
    yield replace(thin(found), free=_some(free))


def _some(free: Sequence[np.ndarray]) -> np.ndarray:
    places = np.array(free, float).reshape(-1, 3)
    return places[:: max(-(-len(places) // FREE), 1)]


def way_out(scene: Scene, proxy: Proxy, at: np.ndarray, free: np.ndarray) -> np.ndarray | None:
    """A position (3,) a little before the surface that hides ``at`` (3,) from the ``free`` one, where ``at`` lies
    within something: where none of the places in free air is seen from it, though it is not outside of the place.
    None where it does not."""
    lower, upper = proxy.bounds
    if (at < lower).any() or (at > upper).any():
        return None
    away = np.concatenate([free[None], proxy.free]) - at
    distance = np.linalg.norm(away, axis=1)
    if not distance[0] > proxy.size:
        return None
    directions = away / np.maximum(distance, 1e-12)[:, None]
    if (_depth(scene, at, directions) >= distance).any():
        return None
    depth = float(_depth(scene, free, -directions[:1])[0])
    return free - directions[0] * max(min(depth, distance[0]) - 4 * proxy.size, 0.0)


def _depth(scene: Scene, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (N,) to the surfaces in unit ``directions`` (N, 3), infinite where there is none."""
    # As many rays as `gather` traces, whose kernel it is.
    seen = trace(scene, origin, filled(directions, RAYS), ["color", "depth", "opacity"])
    depth = np.asarray(seen.depth, float).ravel()
    met = (np.asarray(seen.opacity).ravel() > 0.5) & np.isfinite(depth)
    return np.where(met, depth, np.inf)[: len(directions)]


def thin(found: Sequence[tuple[np.ndarray, np.ndarray]], most: int = POINTS) -> Proxy:
    """``found`` points (N, 3) with their colours (N, 3): one of those in each cell, ``most`` in all at most."""
    points, color = (np.concatenate([pair[k] for pair in found]) for k in (0, 1))
    if not len(points):
        return ordered(points, color, 1.0)
    lower, upper = np.percentile(points, 0.5, axis=0), np.percentile(points, 99.5, axis=0)
    size = max(float(np.linalg.norm(upper - lower)), 1e-6) / 400
    while True:
        first = _one_in_each_cell(points - lower, size)
        if len(first) <= most:
            break
        size *= max((len(first) / most) ** 0.5, 1.02)
    return ordered(points[first], color[first], size)


def ordered(points: np.ndarray, color: np.ndarray, size: float) -> Proxy:
    """The proxy of ``points`` (N, 3), of which there is one in each cell of ``size``, with their ``color`` (N, 3)."""
    from scipy.spatial import KDTree

    rank = np.zeros(len(points), int)
    widths = [size * 2 ** (k / 2) for k in range(1, LEVELS)]
    kept = np.arange(len(points))
    for k, width in enumerate(widths, 1):
        kept = kept[_one_in_each_cell(points[kept], width)]
        rank[kept] = k
    # Of one level in any order but that of the eyes, whose points would otherwise be the first.
    order = np.lexsort((np.random.default_rng(0).random(len(points)), -rank))
    points, color = points[order].astype(np.float32), color[order].astype(np.float32)
    counts = [int((rank >= k).sum()) for k in range(LEVELS)]
    near = np.asarray(KDTree(points[:BATCH]).query(points)[1] if len(points) else (), int)
    return Proxy(points, color, size, tuple(zip(counts, [size, *widths])), near)


def _one_in_each_cell(points: np.ndarray, size: float) -> np.ndarray:
    """Indices, in their order, of one of ``points`` (N, 3) in each cell of a grid."""
    cells = np.floor(points / size).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def bake(scene: Scene, proxy: Proxy, observer: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
    """``gaze`` (1/sr) and ``visibility`` (N,) of the points of ``proxy`` for the ``observer`` (3,), after each step
    better: of points that are still to come that of the nearest one. Without a gaze field there is no gaze."""
    names = ["gaze", "visibility"] if scene.has_gaze else ["visibility"]
    points, found = proxy.points, {}
    for a in range(0, len(points), BATCH):
        part = points[a : a + BATCH]
        with rough_integrals(scene):
            # Kernels are compiled for a number of points.
            seen = observe(scene, filled(part, BATCH), observers=observer[None], quantities=names)
        for name in names:
            values = np.asarray(seen[name][0, : len(part)])
            if a == 0:
                found[name] = values[proxy.near]
            else:
                found[name][a : a + len(part)] = values
        yield {name: values.copy() for name, values in found.items()}


def _farthest(free: Sequence[np.ndarray], visited: Sequence[np.ndarray]) -> np.ndarray | None:
    """The one of ``free`` places that is farthest from all that were ``visited``."""
    if not free:
        return None
    away = np.linalg.norm(np.array(free)[:, None] - np.array(visited)[None], axis=2).min(axis=1)
    return free[int(np.argmax(away))]
