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
    forward: np.ndarray
    up: np.ndarray
    fov: float
    aspect: float

    @classmethod
    def look_at(cls, origin: Any, target: Any, up: Any, fov: float, aspect: float) -> PinholeView:
        """One that looks at ``target``; ``up`` is made perpendicular, and chosen where it lies along the view."""
        origin = np.asarray(origin, float)
        forward = _normalize(np.asarray(target, float) - origin)
        up = np.asarray(up, float)
        if np.linalg.norm(np.cross(forward, up)) < 1e-6:
            up = np.eye(3)[np.argmin(np.abs(forward))]
        return cls(origin, forward, _normalize(up - forward * (forward @ up)), float(fov), float(aspect))

    @classmethod
    def from_page(cls, camera: Any) -> PinholeView:
        """That of a `viser.CameraHandle`, whose frame has x to the right, y down and z ahead."""
        w, x, y, z = camera.wxyz
        forward = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        down = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
        aspect = camera.image_width / camera.image_height if camera.image_height else 1.5
        return cls.look_at(camera.position, np.asarray(camera.position) + forward, -down, camera.fov, aspect)

    @classmethod
    def from_sensor(cls, sensor: Any) -> PinholeView:
        """That of a perspective sensor of a Mitsuba scene; of others the place and the direction, and a usual lens."""
        import mitsuba as mi

        pose = np.array(sensor.world_transform().matrix, float).reshape(4, 4)
        width, height = map(int, sensor.film().crop_size())
        params: Any = mi.traverse(sensor)
        fov_x = math.radians(float(np.ravel(params["x_fov"])[0])) if "x_fov" in params else math.radians(70)
        fov = 2 * math.atan(math.tan(fov_x / 2) * height / width)
        return cls.look_at(pose[:3, 3], pose[:3, 3] + pose[:3, 2], pose[:3, 1], fov, width / height)

    @property
    def target(self) -> np.ndarray:
        """A point (3,) that it looks at, so far away that rounding it to the digits of a file does not turn it."""
        return self.origin + max(1.0, float(np.linalg.norm(self.origin))) * self.forward

    @property
    def fov_x_degrees(self) -> float:
        """Degrees between the left and the right border."""
        return math.degrees(2 * math.atan(math.tan(self.fov / 2) * self.aspect))

    def to_camera(self, width: int) -> Camera:
        """The same as a `Camera` whose pictures are ``width`` pixels wide."""
        target = self.origin + self.forward
        size = dict(width=width, height=self.picture_height(width))
        return Camera(tuple(self.origin), tuple(target), tuple(self.up), self.fov_x_degrees, **size)

    def picture_height(self, width: int) -> int:
        """Rows of a picture with ``width`` columns."""
        return max(round(width / self.aspect), 1)

    def ray_directions(self, width: int, height: int, offsets: np.ndarray) -> np.ndarray:
        """Unit directions (height * width, 3) through a picture's pixels, row by row. ``within`` (height * width, 2):
        where in each pixel, 0..1 from its upper left corner."""
        column = (np.tile(np.arange(width), height) + offsets[:, 0]) / width * 2 - 1
        row = 1 - (np.repeat(np.arange(height), width) + offsets[:, 1]) / height * 2
        half_height = math.tan(self.fov / 2)
        right = np.cross(self.forward, self.up)
        # Pixels are squares, as those of a `Camera`, whose height follows from its width.
        half_width = half_height * self.aspect
        half_height = half_width * height / width
        directions = self.forward + (column * half_width)[:, None] * right + (row * half_height)[:, None] * self.up
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _normalize(v: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(v))
    return v / length if length > 0 else np.array([1.0, 0.0, 0.0])


def make_heading(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) with the columns ahead, left and up, level by ``up``."""
    level = forward - up * (forward @ up)
    if np.linalg.norm(level) < 1e-6:
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - up * (level @ up)
    level = level / np.linalg.norm(level)
    return np.stack([level, np.cross(up, level), up], axis=1)


def get_observer_forward(scene: Scene) -> np.ndarray:
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

BAND_SIZES = tuple(1 << k for k in range(13, 18))
"""Numbers of rays in a band."""

ROUGH_DIRECTIONS = 1 << 12
"""Of the integral over an observer's sphere that a normalised gaze field is divided by: right to some thousandths, in a
tenth of the time that the settings of a scene take."""

DOWNSAMPLING_STAGES = (4, 2, 1)
"""The picture is computed first with a quarter of its columns and rows, then with half of them, then with all."""


@dataclass(frozen=True, eq=False)
class StagePicture:
    """``values`` (height, width) or (height, width, channels) by quantity, means of ``samples`` a pixel; ``seconds``
    since it was begun; ``share``: one of `SHARES`; ``whole``: whether this is the last."""

    values: dict[str, np.ndarray]
    samples: int
    seconds: float
    downsampling: int
    is_final: bool


class BandPace:
    """How many rays a band has, one of `SIZES`, learnt from the time of those before."""

    def __init__(self) -> None:
        self._index = 0
        self._num_slow = 0

    @property
    def num_rays(self) -> int:
        """So many."""
        return BAND_SIZES[self._index]

    def record(self, seconds: float) -> None:
        """A band of `rays` took so long."""
        # Once is chance, or a kernel that was compiled.
        self._num_slow = self._num_slow + 1 if seconds > 1.5 * BAND_SECONDS else 0
        if self._num_slow > 1:
            self._index, self._num_slow = max(self._index - 1, 0), 0
        elif seconds < 0.4 * BAND_SECONDS:
            self._index = min(self._index + 1, len(BAND_SIZES) - 1)


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
    for downsampling in DOWNSAMPLING_STAGES:
        columns = max(width // downsampling, 1)
        rows = max(view.picture_height(width) // downsampling, 1)
        samples = spp if downsampling == 1 else 1
        for sample in range(samples):
            offsets = random.random((rows * columns, 2)) if sample or samples > 1 else np.full((rows * columns, 2), 0.5)
            directions = view.ray_directions(columns, rows, offsets)
            parts: list[dict[str, np.ndarray]] = []
            done = 0
            while done < len(directions):
                band_start = time.perf_counter()
                part, size = directions[done : done + pace.num_rays], pace.num_rays
                band_seed = seed + 7919 * sample + done
                # The last and largest picture is that of the scene's own settings.
                with rough_integrals(scene, downsampling > 1), override_attribute(scene, "ceiling", ceiling):
                    traced = _trace_from(
                        scene, view.origin, pad_directions(part, size), quantities, observer, band_seed
                    )
                parts.append({name: v[: len(part)] for name, v in traced.items()})
                pace.record(time.perf_counter() - band_start)
                done += len(part)
                yield None
            values = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
            shaped = {name: v.reshape(rows, columns, *v.shape[1:]).astype(np.float64) for name, v in values.items()}
            sums = shaped if sample == 0 else {name: sums[name] + v for name, v in shaped.items()}
            num_samples = sample + 1
            # Each one twice as good as the one before; others would only be sent.
            if num_samples == samples or num_samples & (num_samples - 1) == 0:
                means = {name: (v / num_samples).astype(np.float32) for name, v in sums.items()}
                is_final = downsampling == 1 and num_samples == samples
                yield StagePicture(means, num_samples, time.perf_counter() - start, downsampling, is_final)


@contextmanager
def override_attribute(scene: Scene, name: str, value: Any) -> Iterator[None]:
    """Let the scene's integrator have this attribute within the block."""
    previous = getattr(scene.integrator, name)
    setattr(scene.integrator, name, value)
    try:
        yield
    finally:
        setattr(scene.integrator, name, previous)


def rough_integrals(scene: Scene, is_rough: bool = True) -> AbstractContextManager[None]:
    """Let gaze fields be integrated over `DIRECTIONS` alone within the block, where ``rough``."""
    settings = scene.integrator.observer_settings
    fewer = replace(settings, directions=min(settings.directions, ROUGH_DIRECTIONS)) if is_rough else settings
    return override_attribute(scene, "observer_settings", fewer)


def pad_directions(directions: np.ndarray, size: int) -> np.ndarray:
    """``directions`` with the last one again and again, up to ``size``."""
    missing = size - len(directions)
    return np.concatenate([directions, np.repeat(directions[-1:], missing, axis=0)]) if missing > 0 else directions


def _trace_from(
    scene: Scene,
    origin: np.ndarray,
    directions: np.ndarray,
    quantities: Sequence[str],
    observer: np.ndarray | None,
    seed: int,
) -> dict[str, np.ndarray]:
    """Quantities (N,) or (N, channels) of rays from ``origin``."""
    observer_position = origin if observer is None else observer
    traced = trace(scene, origin[None], directions, list(quantities), observers=observer_position[None], seed=seed)
    return {name: np.asarray(traced[name][0]) for name in quantities}


# ---- Proxy ----
#
# What the browser draws by itself: points on the surfaces of a place, with the gaze that they attract.
#
# Rays in all directions, from places that see different parts of it, end on surfaces; of points that lie in one cell of
# a grid one is kept. They are in such an order that the first of them are spread over the place as evenly as all: a
# browser that draws slowly is given fewer, and a step of their gaze says roughly that of all.

RAYS_PER_POSITION = 1 << 14
"""Rays from each place."""

MAX_POSITIONS = 12
"""So many places are looked from."""

MAX_POINTS = 60_000
"""So many points are kept at most: what a browser without a graphics card still moves."""

BATCH_SIZE = 1 << 14
"""Points whose gaze is computed in one step."""

MAX_FREE_POSITIONS = 1 << 11
"""Places in free air that are remembered at most."""

NUM_LEVELS = 4
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
    nearest: np.ndarray
    free_positions: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of what nearly all points lie in: a few may be far off."""
        return np.percentile(self.points, 0.5, axis=0), np.percentile(self.points, 99.5, axis=0)


def gather_points(
    scene: Scene, positions: Sequence[np.ndarray], max_positions: int = MAX_POSITIONS
) -> Iterator[PointProxy | None]:
    """Points seen from ``eyes`` (3,), and from places between them and what they see; None between steps, a first
    proxy of ``eyes`` alone, and in the end that of all."""
    directions = np.asarray(fibonacci_directions(RAYS_PER_POSITION), float)
    seeds = 1 if scene.integrator.medium is not None else LIGHT_SEEDS
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    free_positions: list[np.ndarray] = []
    visited: list[np.ndarray] = []
    queue = [np.asarray(eye, float) for eye in positions]
    while len(visited) < max_positions:
        if len(visited) == len(positions) and parts:
            yield replace(downsample_points(parts), free_positions=_subsample_positions(free_positions))
        position = queue.pop(0) if queue else _farthest_position(free_positions, visited)
        if position is None:
            break
        visited.append(position)
        traced = trace(scene, position, directions, ["color", "depth", "opacity"])
        color = np.asarray(traced.color, float) / seeds
        yield None
        for seed in range(1, seeds):
            color += (
                np.asarray(trace(scene, position, directions, ["color", "depth", "opacity"], seed=seed).color, float)
                / seeds
            )
            yield None
        hit = (np.asarray(traced.opacity) > 0.5) & (traced.depth > 0) & np.isfinite(traced.depth)
        depth = np.asarray(traced.depth, float)
        points = position + depth[:, None] * directions
        parts.append((points[hit], color[hit]))
        # Half way to a surface that is not near there is room to look from.
        far_rays = np.flatnonzero(hit & (depth > np.median(depth[hit])))[::97] if hit.any() else []
        free_positions += [position + 0.5 * depth[k] * directions[k] for k in far_rays]
    yield replace(downsample_points(parts), free_positions=_subsample_positions(free_positions))


def _subsample_positions(positions: Sequence[np.ndarray]) -> np.ndarray:
    array = np.array(positions, float).reshape(-1, 3)
    return array[:: max(-(-len(array) // MAX_FREE_POSITIONS), 1)]


def find_free_position(
    scene: Scene, proxy: PointProxy, position: np.ndarray, free_position: np.ndarray
) -> np.ndarray | None:
    """A position (3,) a little before the surface that hides ``at`` (3,) from the ``free`` one, where ``at`` lies
    within something: where none of the places in free air is seen from it, though it is not outside of the place.
    None where it does not."""
    lower, upper = proxy.bounds
    if (position < lower).any() or (position > upper).any():
        return None
    offsets = np.concatenate([free_position[None], proxy.free_positions]) - position
    distance = np.linalg.norm(offsets, axis=1)
    if not distance[0] > proxy.size:
        return None
    directions = offsets / np.maximum(distance, 1e-12)[:, None]
    if (_trace_depth(scene, position, directions) >= distance).any():
        return None
    depth = float(_trace_depth(scene, free_position, -directions[:1])[0])
    return free_position - directions[0] * max(min(depth, distance[0]) - 4 * proxy.size, 0.0)


def _trace_depth(scene: Scene, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (N,) to the surfaces in unit ``directions`` (N, 3), infinite where there is none."""
    # As many rays as `gather` traces, whose kernel it is.
    traced = trace(scene, origin, pad_directions(directions, RAYS_PER_POSITION), ["color", "depth", "opacity"])
    depth = np.asarray(traced.depth, float).ravel()
    hit = (np.asarray(traced.opacity).ravel() > 0.5) & np.isfinite(depth)
    return np.where(hit, depth, np.inf)[: len(directions)]


def downsample_points(parts: Sequence[tuple[np.ndarray, np.ndarray]], max_points: int = MAX_POINTS) -> PointProxy:
    """``found`` points (N, 3) with their colours (N, 3): one of those in each cell, ``most`` in all at most."""
    points, color = (np.concatenate([pair[k] for pair in parts]) for k in (0, 1))
    if not len(points):
        return order_points(points, color, 1.0)
    lower, upper = np.percentile(points, 0.5, axis=0), np.percentile(points, 99.5, axis=0)
    size = max(float(np.linalg.norm(upper - lower)), 1e-6) / 400
    while True:
        first = _select_one_per_cell(points - lower, size)
        if len(first) <= max_points:
            break
        size *= max((len(first) / max_points) ** 0.5, 1.02)
    return order_points(points[first], color[first], size)


def order_points(points: np.ndarray, color: np.ndarray, size: float) -> PointProxy:
    """The proxy of ``points`` (N, 3), of which there is one in each cell of ``size``, with their ``color`` (N, 3)."""
    from scipy.spatial import KDTree

    rank = np.zeros(len(points), int)
    widths = [size * 2 ** (k / 2) for k in range(1, NUM_LEVELS)]
    selected = np.arange(len(points))
    for k, width in enumerate(widths, 1):
        selected = selected[_select_one_per_cell(points[selected], width)]
        rank[selected] = k
    # Of one level in any order but that of the eyes, whose points would otherwise be the first.
    order = np.lexsort((np.random.default_rng(0).random(len(points)), -rank))
    points, color = points[order].astype(np.float32), color[order].astype(np.float32)
    counts = [int((rank >= k).sum()) for k in range(NUM_LEVELS)]
    nearest = np.asarray(KDTree(points[:BATCH_SIZE]).query(points)[1] if len(points) else (), int)
    return PointProxy(points, color, size, tuple(zip(counts, [size, *widths])), nearest)


def _select_one_per_cell(points: np.ndarray, size: float) -> np.ndarray:
    """Indices, in their order, of one of ``points`` (N, 3) in each cell of a grid."""
    cells = np.floor(points / size).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def compute_point_gaze(scene: Scene, proxy: PointProxy, observer: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
    """``gaze`` (1/sr) and ``visibility`` (N,) of the points of ``proxy`` for the ``observer`` (3,), after each step
    better: of points that are still to come that of the nearest one. Without a gaze field there is no gaze."""
    names = ["gaze", "visibility"] if scene.has_gaze else ["visibility"]
    points, values_by_name = proxy.points, {}
    for a in range(0, len(points), BATCH_SIZE):
        part = points[a : a + BATCH_SIZE]
        with rough_integrals(scene):
            # Kernels are compiled for a number of points.
            observed = observe(scene, pad_directions(part, BATCH_SIZE), observers=observer[None], quantities=names)
        for name in names:
            values = np.asarray(observed[name][0, : len(part)])
            if a == 0:
                values_by_name[name] = values[proxy.nearest]
            else:
                values_by_name[name][a : a + len(part)] = values
        yield {name: values.copy() for name, values in values_by_name.items()}


def _farthest_position(positions: Sequence[np.ndarray], visited: Sequence[np.ndarray]) -> np.ndarray | None:
    """The one of ``free`` places that is farthest from all that were ``visited``."""
    if not positions:
        return None
    distances = np.linalg.norm(np.array(positions)[:, None] - np.array(visited)[None], axis=2).min(axis=1)
    return positions[int(np.argmax(distances))]
