"""The viewer's picture of the place: points that stand for it, the view, and its refinement while nothing moves."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nerg_mi.api.arrays import Camera
from nerg_mi.api.query import observe, trace
from nerg_mi.api.scene import Scene
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.transport.geometry import Ceiling

# ---- From where a page looks, and the rays of its picture ----


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A pinhole camera: ``origin`` (3,) in scene units, the unit vectors ``ahead`` and ``up`` (3,), perpendicular to
    each other, ``fov`` in radians between the lower and the upper border, and ``aspect``, width by height."""

    origin: np.ndarray
    ahead: np.ndarray
    up: np.ndarray
    fov: float
    aspect: float

    @classmethod
    def of(cls, origin: Any, target: Any, up: Any, fov: float, aspect: float) -> PinholeView:
        """One that looks at ``target``; ``up`` is made perpendicular, and chosen where it lies along the view."""
        origin = np.asarray(origin, float)
        ahead = _unit(np.asarray(target, float) - origin)
        up = np.asarray(up, float)
        if np.linalg.norm(np.cross(ahead, up)) < 1e-6:
            up = np.eye(3)[np.argmin(np.abs(ahead))]
        return cls(origin, ahead, _unit(up - ahead * (ahead @ up)), float(fov), float(aspect))

    @classmethod
    def of_page(cls, camera: Any) -> PinholeView:
        """That of a `viser.CameraHandle`, whose frame has x to the right, y down and z ahead."""
        w, x, y, z = camera.wxyz
        ahead = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        down = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
        aspect = camera.image_width / camera.image_height if camera.image_height else 1.5
        return cls.of(camera.position, np.asarray(camera.position) + ahead, -down, camera.fov, aspect)

    @classmethod
    def of_sensor(cls, sensor: Any) -> PinholeView:
        """That of a perspective sensor of a Mitsuba scene; of others the place and the direction, and a usual lens."""
        import mitsuba as mi

        pose = np.array(sensor.world_transform().matrix, float).reshape(4, 4)
        width, height = map(int, sensor.film().crop_size())
        params: Any = mi.traverse(sensor)
        across = math.radians(float(np.ravel(params["x_fov"])[0])) if "x_fov" in params else math.radians(70)
        fov = 2 * math.atan(math.tan(across / 2) * height / width)
        return cls.of(pose[:3, 3], pose[:3, 3] + pose[:3, 2], pose[:3, 1], fov, width / height)

    @property
    def target(self) -> np.ndarray:
        """A point (3,) that it looks at, so far away that rounding it to the digits of a file does not turn it."""
        return self.origin + max(1.0, float(np.linalg.norm(self.origin))) * self.ahead

    @property
    def across(self) -> float:
        """Degrees between the left and the right border."""
        return math.degrees(2 * math.atan(math.tan(self.fov / 2) * self.aspect))

    def camera(self, width: int) -> Camera:
        """The same as a `Camera` whose pictures are ``width`` pixels wide."""
        target = self.origin + self.ahead
        size = dict(width=width, height=self.height(width))
        return Camera(tuple(self.origin), tuple(target), tuple(self.up), self.across, **size)

    def height(self, width: int) -> int:
        """Rows of a picture with ``width`` columns."""
        return max(round(width / self.aspect), 1)

    def rays(self, width: int, height: int, within: np.ndarray) -> np.ndarray:
        """Unit directions (height * width, 3) through a picture's pixels, row by row. ``within`` (height * width, 2):
        where in each pixel, 0..1 from its upper left corner."""
        column = (np.tile(np.arange(width), height) + within[:, 0]) / width * 2 - 1
        row = 1 - (np.repeat(np.arange(height), width) + within[:, 1]) / height * 2
        rise = math.tan(self.fov / 2)
        right = np.cross(self.ahead, self.up)
        # Pixels are squares, as those of a `Camera`, whose height follows from its width.
        run = rise * self.aspect
        rise = run * height / width
        found = self.ahead + (column * run)[:, None] * right + (row * rise)[:, None] * self.up
        return found / np.linalg.norm(found, axis=1, keepdims=True)


def _unit(v: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(v))
    return v / length if length > 0 else np.array([1.0, 0.0, 0.0])


def heading_of(ahead: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) with the columns ahead, left and up, level by ``up``."""
    level = ahead - up * (ahead @ up)
    if np.linalg.norm(level) < 1e-6:
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - up * (level @ up)
    level = level / np.linalg.norm(level)
    return np.stack([level, np.cross(up, level), up], axis=1)


def ahead_of(scene: Scene) -> np.ndarray:
    """Where the observer of ``scene`` is turned to."""
    pose = np.array(scene.integrator.observer.world_transform().matrix, float).reshape(4, 4)
    return pose[:3, 2]


# ---- Refining ----
#
# A picture that is refined in steps: small at once, then in full, then with more samples a pixel.
#
# It is a generator, so that whoever drives it can stop between two bands of rays. Its values are those of the
# integrator `nerg` (`nerg_mi.api.query.trace`).

BAND_SECONDS = 0.35
"""A band of rays should take so long at most: what is more urgent waits for its end."""

SIZES = tuple(1 << k for k in range(13, 18))
"""Numbers of rays in a band."""

DIRECTIONS = 1 << 12
"""Of the integral over an observer's sphere that a normalised gaze field is divided by: right to some thousandths, in a
tenth of the time that the settings of a scene take."""

SHARES = (4, 2, 1)
"""The picture is computed first with a quarter of its columns and rows, then with half of them, then with all."""


@dataclass(frozen=True, eq=False)
class StagePicture:
    """``values`` (height, width) or (height, width, channels) by quantity, means of ``samples`` a pixel; ``seconds``
    since it was begun; ``share``: one of `SHARES`; ``whole``: whether this is the last."""

    values: dict[str, np.ndarray]
    samples: int
    seconds: float
    share: int
    whole: bool


class BandPace:
    """How many rays a band has, one of `SIZES`, learnt from the time of those before."""

    def __init__(self) -> None:
        self._at = 0
        self._slow = 0

    @property
    def rays(self) -> int:
        """So many."""
        return SIZES[self._at]

    def learn(self, seconds: float) -> None:
        """A band of `rays` took so long."""
        # Once is chance, or a kernel that was compiled.
        self._slow = self._slow + 1 if seconds > 1.5 * BAND_SECONDS else 0
        if self._slow > 1:
            self._at, self._slow = max(self._at - 1, 0), 0
        elif seconds < 0.4 * BAND_SECONDS:
            self._at = min(self._at + 1, len(SIZES) - 1)


def refine(
    scene: Scene,
    view: PinholeView,
    observer: np.ndarray | None,
    quantities: Sequence[str],
    width: int,
    spp: int,
    pace: BandPace,
    *,
    ceiling: Ceiling | None = None,
    seed: int = 0,
) -> Iterator[StagePicture | None]:
    """Pictures of ``quantities``, each better than the one before; None after each band of one.

    ``observer`` (3,): whose gaze it is; None: that of whoever stands at the camera. ``width`` in pixels and ``spp``
    samples a pixel of the last. ``ceiling``: what is left out of views from above, whatever the scene says of it.
    """
    start = time.perf_counter()
    random = np.random.default_rng(seed)
    sums: dict[str, np.ndarray] = {}
    for share in SHARES:
        columns = max(width // share, 1)
        rows = max(view.height(width) // share, 1)
        samples = spp if share == 1 else 1
        for sample in range(samples):
            within = random.random((rows * columns, 2)) if sample or samples > 1 else np.full((rows * columns, 2), 0.5)
            directions = view.rays(columns, rows, within)
            parts: list[dict[str, np.ndarray]] = []
            done = 0
            while done < len(directions):
                began = time.perf_counter()
                part, size = directions[done : done + pace.rays], pace.rays
                turn = seed + 7919 * sample + done
                # The last and largest picture is that of the scene's own settings.
                with rough_integrals(scene, share > 1), changed(scene, "ceiling", ceiling):
                    found = _traced(scene, view.origin, filled(part, size), quantities, observer, turn)
                parts.append({name: v[: len(part)] for name, v in found.items()})
                pace.learn(time.perf_counter() - began)
                done += len(part)
                yield None
            values = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
            shaped = {name: v.reshape(rows, columns, *v.shape[1:]).astype(np.float64) for name, v in values.items()}
            sums = shaped if sample == 0 else {name: sums[name] + v for name, v in shaped.items()}
            number = sample + 1
            # Each one twice as good as the one before; others would only be sent.
            if number == samples or number & (number - 1) == 0:
                means = {name: (v / number).astype(np.float32) for name, v in sums.items()}
                whole = share == 1 and number == samples
                yield StagePicture(means, number, time.perf_counter() - start, share, whole)


@contextmanager
def changed(scene: Scene, name: str, value: Any) -> Iterator[None]:
    """Let the scene's integrator have this attribute within the block."""
    before = getattr(scene.integrator, name)
    setattr(scene.integrator, name, value)
    try:
        yield
    finally:
        setattr(scene.integrator, name, before)


def rough_integrals(scene: Scene, rough: bool = True) -> AbstractContextManager[None]:
    """Let gaze fields be integrated over `DIRECTIONS` alone within the block, where ``rough``."""
    settings = scene.integrator.observer_settings
    fewer = replace(settings, directions=min(settings.directions, DIRECTIONS)) if rough else settings
    return changed(scene, "observer_settings", fewer)


def filled(directions: np.ndarray, size: int) -> np.ndarray:
    """``directions`` with the last one again and again, up to ``size``."""
    missing = size - len(directions)
    return np.concatenate([directions, np.repeat(directions[-1:], missing, axis=0)]) if missing > 0 else directions


def _traced(
    scene: Scene,
    origin: np.ndarray,
    directions: np.ndarray,
    quantities: Sequence[str],
    observer: np.ndarray | None,
    seed: int,
) -> dict[str, np.ndarray]:
    """Quantities (N,) or (N, channels) of rays from ``origin``."""
    eyes = origin if observer is None else observer
    found = trace(scene, origin[None], directions, list(quantities), observers=eyes[None], seed=seed)
    return {name: np.asarray(found[name][0]) for name in quantities}


# ---- Proxy ----
#
# What the browser draws by itself: points on the surfaces of a place, with the gaze that they attract.
#
# Rays in all directions, from places that see different parts of it, end on surfaces; of points that lie in one cell of
# a grid one is kept. They are in such an order that the first of them are spread over the place as evenly as all: a
# browser that draws slowly is given fewer, and a step of their gaze says roughly that of all.

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
class PointProxy:
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


def gather(scene: Scene, eyes: Sequence[np.ndarray], places: int = PLACES) -> Iterator[PointProxy | None]:
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


def way_out(scene: Scene, proxy: PointProxy, at: np.ndarray, free: np.ndarray) -> np.ndarray | None:
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


def thin(found: Sequence[tuple[np.ndarray, np.ndarray]], most: int = POINTS) -> PointProxy:
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


def ordered(points: np.ndarray, color: np.ndarray, size: float) -> PointProxy:
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
    return PointProxy(points, color, size, tuple(zip(counts, [size, *widths])), near)


def _one_in_each_cell(points: np.ndarray, size: float) -> np.ndarray:
    """Indices, in their order, of one of ``points`` (N, 3) in each cell of a grid."""
    cells = np.floor(points / size).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def bake(scene: Scene, proxy: PointProxy, observer: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
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
