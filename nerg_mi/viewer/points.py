"""Views, their progressive refinement, and the points that the browser draws."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nerg_mi.environment.arrays import Camera
from nerg_mi.environment.queries import observe, trace
from nerg_mi.environment.scene import Scene
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.progress import SILENT
from nerg_mi.transport.geometry import Ceiling

from .lattice import Lattice

# ---- Views ----


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A pinhole camera.

    Parameters
    ----------
    origin : ndarray of shape (3,)
        Position in scene units.
    forward, up : ndarray of shape (3,)
        Orthogonal unit vectors in the frame of the scene.
    fov : float
        Vertical field of view in radians.
    aspect : float
        Width divided by height.
    """

    origin: np.ndarray
    forward: np.ndarray
    up: np.ndarray
    fov: float
    aspect: float

    @classmethod
    def look_at(cls, origin: Any, target: Any, up: Any, fov: float, aspect: float) -> PinholeView:
        """Make a view from ``origin`` towards ``target``.

        ``up`` is made orthogonal to the viewing direction; if the two are parallel, another axis replaces it.
        """
        origin = np.asarray(origin, float)
        forward = _normalize(np.asarray(target, float) - origin)
        up = np.asarray(up, float)
        if np.linalg.norm(np.cross(forward, up)) < 1e-6:
            up = np.eye(3)[np.argmin(np.abs(forward))]
        return cls(origin, forward, _normalize(up - forward * (forward @ up)), float(fov), float(aspect))

    @classmethod
    def from_page(cls, camera: Any) -> PinholeView:
        """Make the view of a `viser.CameraHandle`, whose frame has x right, y down and z forward."""
        w, x, y, z = camera.wxyz
        forward = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        down = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
        aspect = camera.image_width / camera.image_height if camera.image_height else 1.5
        return cls.look_at(camera.position, np.asarray(camera.position) + forward, -down, camera.fov, aspect)

    @classmethod
    def from_sensor(cls, sensor: Any) -> PinholeView:
        """Make the view of a Mitsuba sensor. Sensors that are not perspective get a field of view of 70 degrees."""
        import mitsuba as mi

        pose = np.array(sensor.world_transform().matrix, float).reshape(4, 4)
        width, height = map(int, sensor.film().crop_size())
        params: Any = mi.traverse(sensor)
        fov_x = math.radians(float(np.ravel(params["x_fov"])[0])) if "x_fov" in params else math.radians(70)
        fov = 2 * math.atan(math.tan(fov_x / 2) * height / width)
        return cls.look_at(pose[:3, 3], pose[:3, 3] + pose[:3, 2], pose[:3, 1], fov, width / height)

    @property
    def target(self) -> np.ndarray:
        """A point (3,) on the optical axis, distant enough that rounding it in a file does not rotate the view."""
        return self.origin + max(1.0, float(np.linalg.norm(self.origin))) * self.forward

    @property
    def fov_x_degrees(self) -> float:
        """Horizontal field of view in degrees."""
        return math.degrees(2 * math.atan(math.tan(self.fov / 2) * self.aspect))

    def to_camera(self, width: int) -> Camera:
        """Make a `Camera` with pictures of ``width`` pixels."""
        target = self.origin + self.forward
        size = dict(width=width, height=self.picture_height(width))
        return Camera(tuple(self.origin), tuple(target), tuple(self.up), self.fov_x_degrees, **size)

    def picture_height(self, width: int) -> int:
        """Return the height in pixels of a picture of ``width`` pixels."""
        return max(round(width / self.aspect), 1)

    def make_lattice(self, width: int, pixels_per_ray: int = 1) -> Lattice:
        """Make the `Lattice` of a picture of ``width`` pixels."""
        return Lattice(width, self.picture_height(width), pixels_per_ray)

    def ray_directions(self, width: int, height: int, offsets: np.ndarray) -> np.ndarray:
        """Compute the directions of the rays through the pixels of a picture.

        Parameters
        ----------
        width, height : int
            Size of the picture in pixels.
        offsets : ndarray of shape (height * width, 2)
            Position in each pixel, from 0 to 1, measured from its upper left corner.

        Returns
        -------
        ndarray of shape (height * width, 3)
            Unit vectors in the frame of the scene, row by row.
        """
        column = (np.tile(np.arange(width), height) + offsets[:, 0]) / width * 2 - 1
        row = 1 - (np.repeat(np.arange(height), width) + offsets[:, 1]) / height * 2
        half_height = math.tan(self.fov / 2)
        right = np.cross(self.forward, self.up)
        # Pixels are square, as those of `Camera`.
        half_width = half_height * self.aspect
        half_height = half_width * height / width
        directions = self.forward + (column * half_width)[:, None] * right + (row * half_height)[:, None] * self.up
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _normalize(v: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(v))
    return v / length if length > 0 else np.array([1.0, 0.0, 0.0])


def make_heading(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Make the rotation (3, 3) with the columns forward, left and up, whose forward is ``forward`` projected to the
    horizontal."""
    level = forward - up * (forward @ up)
    if np.linalg.norm(level) < 1e-6:
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - up * (level @ up)
    level = level / np.linalg.norm(level)
    return np.stack([level, np.cross(up, level), up], axis=1)


def get_observer_forward(scene: Scene) -> np.ndarray:
    """Return the viewing direction (3,) of the observer of ``scene``."""
    pose = np.array(scene.integrator.observer.world_transform().matrix, float).reshape(4, 4)
    return pose[:3, 2]


# ---- Progressive refinement ----
#
# A picture is rendered at low resolution, then at full resolution, then with more samples per pixel. The refinement is
# a generator, so that it can stop after each band of rays. The values are those of the integrator `nerg`
# (`nerg_mi.environment.queries.trace`).

BAND_SECONDS = 0.35
"""Target for the longest time of a band of rays, in seconds: a more urgent task waits this long."""

BAND_SIZES = tuple(1 << k for k in range(13, 18))
"""The possible numbers of rays in a band."""

ROUGH_DIRECTIONS = 1 << 12
"""Maximum number of directions for the integral that normalises a gaze field, in all but the last picture.

The relative error is a few thousandths, at a tenth of the time of the default settings.
"""

DOWNSAMPLING_STAGES = (4, 2, 1)
"""Factors by which the successive pictures are downsampled."""


@dataclass(frozen=True, eq=False)
class StagePicture:
    """A picture of one stage of the refinement.

    Parameters
    ----------
    values : dict of str to ndarray
        Quantities of shape (height, width) or (height, width, channels), averaged over the samples.
    samples : int
        Samples per pixel.
    seconds : float
        Time since the refinement started.
    downsampling : int
        The factor of the stage, one of `DOWNSAMPLING_STAGES`.
    is_final : bool
        Whether this is the last picture.
    """

    values: dict[str, np.ndarray]
    samples: int
    seconds: float
    downsampling: int
    is_final: bool


class BandPace:
    """Chooses the number of rays in a band from the time of previous bands."""

    def __init__(self) -> None:
        self._index = 0
        self._num_slow = 0

    @property
    def num_rays(self) -> int:
        """The number of rays in the next band, one of `BAND_SIZES`."""
        return BAND_SIZES[self._index]

    def record(self, seconds: float) -> None:
        """Record that a band of `num_rays` rays took ``seconds``."""
        # A single slow band can be due to the compilation of a kernel.
        self._num_slow = self._num_slow + 1 if seconds > 1.5 * BAND_SECONDS else 0
        if self._num_slow > 1:
            self._index, self._num_slow = max(self._index - 1, 0), 0
        elif seconds < 0.4 * BAND_SECONDS:
            self._index = min(self._index + 1, len(BAND_SIZES) - 1)


FRAME_SECONDS = 1 / 15
"""Target for the time of a frame during a movement, in seconds."""

MAX_FRAME_SECONDS = {False: 0.1, True: 0.2}
"""Maximum time of a frame, in seconds, of a moving camera and of a moving observer; slower movements are shown by
points. Those move with the camera at once, but the gaze of a moving observer is not on them."""

_RETRY_SECONDS, _RETRY_FRAMES = 2.0, 50
"""Times after which frames that were too slow are timed again, in seconds and as a multiple of their time."""

_FRAME_OVERHEAD = 0.006
"""Time of a frame that does not depend on its size, in seconds: kernels are started, and the image is encoded."""

FRAME_SIZES = ((640, 1), (640, 2), (640, 4), (320, 2))
"""The possible widths in pixels of the frames of a movement, and their pixels per ray."""

_NUM_SLOW_FRAMES = 2
"""Frames of a new size whose time is not typical: their program is traced and recorded, and kernels are compiled."""


class FramePace:
    """Chooses the rays of the frames of a movement from the time of previous frames.

    Frames of a view at rest, whose colours and surfaces are kept, are timed separately.
    """

    def __init__(self) -> None:
        self._counts: Counter[tuple[bool, int]] = Counter()
        self._seconds: dict[tuple[bool, int], deque[float]] = {}
        # The last number of rays of each kind.
        self._last: dict[bool, int] = {}
        self._last_time = 0.0

    def record(self, seconds: float, num_rays: int, is_view_kept: bool = False) -> None:
        """Record that a frame of ``num_rays`` rays took ``seconds``."""
        key = is_view_kept, num_rays
        self._counts[key] += 1
        self._last_time = time.monotonic()
        if self._counts[key] > _NUM_SLOW_FRAMES:
            self._seconds.setdefault(key, deque(maxlen=5)).append(seconds)
            self._last[is_view_kept] = num_rays

    def estimate(self, num_rays: int, is_view_kept: bool = False) -> float:
        """Return the expected seconds of a frame of ``num_rays`` rays; infinite if nothing was recorded."""
        is_view_kept = is_view_kept in self._last and is_view_kept
        if is_view_kept not in self._last:
            return math.inf
        # The median: single times contain the compilation of a kernel.
        last = self._last[is_view_kept]
        seconds = float(np.median(self._seconds[is_view_kept, last]))
        scaled = _FRAME_OVERHEAD + max(seconds - _FRAME_OVERHEAD, 0.1 * seconds) * num_rays / last
        if (is_view_kept, num_rays) not in self._seconds:
            return scaled
        recorded = float(np.median(self._seconds[is_view_kept, num_rays]))
        # An earlier view may have been slower, and more rays take at most proportionally longer than the last ones.
        return min(recorded, scaled) if num_rays > last else recorded

    def choose_lattice(self, view: PinholeView, max_width: int, is_view_kept: bool = False) -> Lattice | None:
        """Return the pixels of the next frame of ``view``; None if rays are too slow for frames, or of unknown
        speed."""
        lattices = [view.make_lattice(min(width, max_width), count) for width, count in FRAME_SIZES]
        seconds = [self.estimate(lattice.num_rays, is_view_kept) for lattice in lattices]
        fast = [lattice for lattice, estimate in zip(lattices, seconds) if estimate <= FRAME_SECONDS]
        return fast[0] if fast else lattices[-1] if seconds[-1] <= MAX_FRAME_SECONDS[is_view_kept] else None

    def start_retry(self, view: PinholeView, max_width: int, is_view_kept: bool = False) -> bool:
        """Return whether frames that `choose_lattice` refuses should be timed again: other work may have slowed them
        down. Once is enough until `record`."""
        width, count = FRAME_SIZES[-1]
        seconds = self.estimate(view.make_lattice(min(width, max_width), count).num_rays, is_view_kept)
        now = time.monotonic()
        is_due = math.isfinite(seconds) and now - self._last_time > max(_RETRY_SECONDS, _RETRY_FRAMES * seconds)
        if is_due:
            self._last_time = now
        return is_due


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
    min_width: int = 0,
    seed: int = 0,
) -> Iterator[StagePicture | None]:
    """Render pictures of increasing quality.

    Parameters
    ----------
    scene : Scene
        The scene.
    view : PinholeView
        The camera.
    observer : ndarray of shape (3,) or None
        Position of the observer in scene units. None: the observer is at the camera.
    quantities : sequence of str
        The quantities to compute, as for `nerg_mi.environment.queries.trace`.
    width : int
        Width of the final picture in pixels.
    spp : int
        Samples per pixel of the final picture.
    pace : BandPace
        Chooses the size of the bands.
    ceiling : Ceiling or None
        The part of the scene to hide in views from above; it replaces the ceiling of the scene.
    min_width : int
        Pictures that are not wider are left out, except the final one.
    seed : int
        Seed of the sample positions.

    Yields
    ------
    StagePicture or None
        A picture after each stage, and None after each band of rays.
    """
    start = time.perf_counter()
    random = np.random.default_rng(seed)
    sums: dict[str, np.ndarray] = {}
    for downsampling in DOWNSAMPLING_STAGES:
        columns = max(width // downsampling, 1)
        if downsampling > 1 and columns <= min_width:
            continue
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
                # The final picture uses the settings of the scene.
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
            # Only pictures with twice the samples of the previous one are worth sending.
            if num_samples == samples or num_samples & (num_samples - 1) == 0:
                means = {name: (v / num_samples).astype(np.float32) for name, v in sums.items()}
                is_final = downsampling == 1 and num_samples == samples
                yield StagePicture(means, num_samples, time.perf_counter() - start, downsampling, is_final)


@contextmanager
def override_attribute(scene: Scene, name: str, value: Any) -> Iterator[None]:
    """Set an attribute of the scene's integrator for the duration of the block."""
    previous = getattr(scene.integrator, name)
    setattr(scene.integrator, name, value)
    try:
        yield
    finally:
        setattr(scene.integrator, name, previous)


def rough_integrals(scene: Scene, is_rough: bool = True) -> AbstractContextManager[None]:
    """Limit the integral of gaze fields to `ROUGH_DIRECTIONS` directions within the block, if ``is_rough``."""
    settings = scene.integrator.observer_settings
    fewer = replace(settings, directions=min(settings.directions, ROUGH_DIRECTIONS)) if is_rough else settings
    return override_attribute(scene, "observer_settings", fewer)


def pad_directions(directions: np.ndarray, size: int) -> np.ndarray:
    """Pad ``directions`` (N, 3) to ``size`` rows with copies of the last row."""
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
    """Compute quantities (N,) or (N, channels) of rays from ``origin`` (3,) in ``directions`` (N, 3)."""
    observer_position = origin if observer is None else observer
    options = {"observers": observer_position[None], "seed": seed, "progress": SILENT}
    traced = trace(scene, origin[None], directions, list(quantities), **options)
    return {name: np.asarray(traced[name][0]) for name in quantities}


# ---- Point proxy ----
#
# The browser draws points on the surfaces of the scene, coloured by their gaze. Rays in all directions are traced from
# several positions; one point per cell of a grid is kept. The points are ordered so that any first part of them covers
# the scene evenly: a slow browser gets fewer points, and the first batch of gaze values approximates all of them.

RAYS_PER_POSITION = 1 << 14
"""Rays traced from each position."""

MAX_POSITIONS = 12
"""Maximum number of positions from which rays are traced."""

MAX_POINTS = 60_000
"""Maximum number of points, which a browser without a graphics card can still draw."""

BATCH_SIZE = 1 << 14
"""Number of points whose gaze is computed in one step."""

MAX_FREE_POSITIONS = 1 << 11
"""Maximum number of positions in free space that are stored."""

NUM_LEVELS = 4
"""Number of point levels: the cells of each level are √2 times wider than those of the previous one."""

LIGHT_SEEDS = 4
"""Number of samples of the light on shapes, which is random."""


@dataclass(frozen=True, eq=False)
class Points:
    """Coloured points.

    Parameters
    ----------
    points : ndarray of shape (N, 3)
        Positions in scene units.
    colors : ndarray of shape (N, 3), uint8
        Colours in sRGB.
    size : float
        Width of the grid cells, each of which contains at most one point.
    """

    points: np.ndarray
    colors: np.ndarray
    size: float


@dataclass(frozen=True, eq=False)
class PointProxy:
    """Points on the surfaces of a scene.

    Parameters
    ----------
    points : ndarray of shape (N, 3)
        Positions in scene units.
    color : ndarray of shape (N, 3)
        Linear RGB.
    size : float
        Width of the grid cells, each of which contains at most one point.
    levels : tuple of (int, float)
        For each level, the number of points, counted from the first, and the width of its cells.
    nearest : ndarray of shape (N,), int
        Index of the nearest of the first `BATCH_SIZE` points.
    free_positions : ndarray of shape (F, 3)
        Positions in free space.
    """

    points: np.ndarray
    color: np.ndarray
    size: float
    levels: tuple[tuple[int, float], ...]
    nearest: np.ndarray
    free_positions: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a box that contains nearly all points; the outermost 0.5 % are ignored."""
        return np.percentile(self.points, 0.5, axis=0), np.percentile(self.points, 99.5, axis=0)


def gather_points(
    scene: Scene, positions: Sequence[np.ndarray], max_positions: int = MAX_POSITIONS
) -> Iterator[PointProxy | None]:
    """Sample points on the surfaces of ``scene``.

    Parameters
    ----------
    scene : Scene
        The scene.
    positions : sequence of ndarray of shape (3,)
        Positions from which rays are traced first.
    max_positions : int
        Maximum number of positions; the others are chosen in free space.

    Yields
    ------
    PointProxy or None
        A first proxy of ``positions`` alone, the complete proxy at the end, and None between steps.
    """
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
        # The midpoint of a ray to a distant surface is in free space.
        far_rays = np.flatnonzero(hit & (depth > np.median(depth[hit])))[::97] if hit.any() else []
        free_positions += [position + 0.5 * depth[k] * directions[k] for k in far_rays]
    yield replace(downsample_points(parts), free_positions=_subsample_positions(free_positions))


def _subsample_positions(positions: Sequence[np.ndarray]) -> np.ndarray:
    array = np.array(positions, float).reshape(-1, 3)
    return array[:: max(-(-len(array) // MAX_FREE_POSITIONS), 1)]


def find_free_position(
    scene: Scene, proxy: PointProxy, position: np.ndarray, free_position: np.ndarray
) -> np.ndarray | None:
    """Find a position in free space for a ``position`` inside a solid.

    ``position`` counts as inside a solid if it is within the bounds of the scene and no free position is visible from
    it.

    Parameters
    ----------
    scene : Scene
        The scene.
    proxy : PointProxy
        Its points and positions in free space.
    position : ndarray of shape (3,)
        The position to check.
    free_position : ndarray of shape (3,)
        A position in free space, from which ``position`` was reached.

    Returns
    -------
    ndarray of shape (3,) or None
        A position in front of the first surface between ``free_position`` and ``position``; None if ``position`` is
        free.
    """
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
    """Trace the distance (N,) to the surfaces along unit ``directions`` (N, 3); infinite where a ray hits none."""
    # The same number of rays as in `gather_points`, so that the kernel is reused.
    traced = trace(scene, origin, pad_directions(directions, RAYS_PER_POSITION), ["color", "depth", "opacity"])
    depth = np.asarray(traced.depth, float).ravel()
    hit = (np.asarray(traced.opacity).ravel() > 0.5) & np.isfinite(depth)
    return np.where(hit, depth, np.inf)[: len(directions)]


def downsample_points(parts: Sequence[tuple[np.ndarray, np.ndarray]], max_points: int = MAX_POINTS) -> PointProxy:
    """Keep one point per cell of a grid that is coarse enough for ``max_points`` points.

    ``parts``: pairs of points (N, 3) and linear colours (N, 3).
    """
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
    """Order ``points`` (N, 3), one per cell of width ``size``, by level, with their linear ``color`` (N, 3)."""
    from scipy.spatial import KDTree

    rank = np.zeros(len(points), int)
    widths = [size * 2 ** (k / 2) for k in range(1, NUM_LEVELS)]
    selected = np.arange(len(points))
    for k, width in enumerate(widths, 1):
        selected = selected[_select_one_per_cell(points[selected], width)]
        rank[selected] = k
    # Random order within a level; otherwise the points of the first positions would come first.
    order = np.lexsort((np.random.default_rng(0).random(len(points)), -rank))
    points, color = points[order].astype(np.float32), color[order].astype(np.float32)
    counts = [int((rank >= k).sum()) for k in range(NUM_LEVELS)]
    nearest = np.asarray(KDTree(points[:BATCH_SIZE]).query(points)[1] if len(points) else (), int)
    return PointProxy(points, color, size, tuple(zip(counts, [size, *widths])), nearest)


def _select_one_per_cell(points: np.ndarray, size: float) -> np.ndarray:
    """Return the sorted indices of one of ``points`` (N, 3) per cell of a grid."""
    cells = np.floor(points / size).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def compute_point_gaze(scene: Scene, proxy: PointProxy, observer: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
    """Compute the gaze on the points of ``proxy`` in steps.

    Parameters
    ----------
    scene : Scene
        The scene.
    proxy : PointProxy
        The points (N, 3).
    observer : ndarray of shape (3,)
        Position of the observer in scene units.

    Yields
    ------
    dict of str to ndarray
        ``gaze`` (N,) in 1/sr, if the scene has a gaze field, and ``visibility`` (N,). Points that are not computed yet
        have the value of the nearest computed point.
    """
    names = ["gaze", "visibility"] if scene.has_gaze else ["visibility"]
    points, values_by_name = proxy.points, {}
    for a in range(0, len(points), BATCH_SIZE):
        part = points[a : a + BATCH_SIZE]
        with rough_integrals(scene):
            # Kernels depend on the number of points.
            observed = observe(
                scene, pad_directions(part, BATCH_SIZE), observers=observer[None], quantities=names, progress=SILENT
            )
        for name in names:
            values = np.asarray(observed[name][0, : len(part)])
            if a == 0:
                values_by_name[name] = values[proxy.nearest]
            else:
                values_by_name[name][a : a + len(part)] = values
        yield {name: values.copy() for name, values in values_by_name.items()}


def _farthest_position(positions: Sequence[np.ndarray], visited: Sequence[np.ndarray]) -> np.ndarray | None:
    """Return the one of ``positions`` that is farthest from all ``visited`` positions."""
    if not positions:
        return None
    distances = np.linalg.norm(np.array(positions)[:, None] - np.array(visited)[None], axis=2).min(axis=1)
    return positions[int(np.argmax(distances))]
