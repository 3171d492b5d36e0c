"""One picture of a dataset: where people were, where they looked, and when."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerg_mi.maths.sphere import fibonacci_directions

Trace = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
SURFACE_OPACITY = 0.5
"""Opacity from which on a ray meets a surface."""

_COARSE, _FINE = (18, 12), (48, 32)
_KEPT = 10
# Nearer than this share of the usual distance things fill a picture.
_NEAR = 0.2
# Where the mean and the median depth differ by this share there is more fog than surface.
_FOG = 0.1
# Attention above this share of its greatest density counts as seen where it is seen.
_ATTENDED = 0.15


@dataclass(frozen=True)
class CameraView:
    """A camera at ``origin`` (3,) that looks at ``target`` (3,); ``score``: 0 .. 1, of `Judge`; ``opaque``: share of
    its picture that shows surfaces; ``attended``: share of the observer's attention that it shows, None without one."""

    origin: np.ndarray
    target: np.ndarray
    score: float
    surface_fraction: float
    attention_share: float | None = None


@dataclass(frozen=True)
class PinholeFrame:
    """Pixels of a pinhole camera: ``fov``, degrees from left to right, ``aspect``: width by height, ``up`` (3,)."""

    fov: float
    aspect: float
    up: np.ndarray

    def axes(self, ahead: np.ndarray) -> np.ndarray:
        """Right, up and ahead (..., 3, 3) of cameras that look along unit ``ahead`` (..., 3)."""
        right = np.cross(ahead, self.up)
        right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-9)
        return np.stack([right, np.cross(right, ahead), ahead], axis=-2)

    def directions(self, ahead: np.ndarray, width: int, height: int) -> np.ndarray:
        """Unit directions (..., height * width, 3) of the pixels of cameras that look along ``ahead`` (..., 3)."""
        reach = np.tan(np.radians(self.fov / 2))
        x = ((np.arange(width) + 0.5) / width * 2 - 1) * reach
        y = (1 - (np.arange(height) + 0.5) / height * 2) * reach / self.aspect
        local = np.stack([*(v.ravel() for v in np.meshgrid(x, y)), np.ones(width * height)], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return local @ self.axes(np.asarray(ahead, float))

    def pixels(self, origins: np.ndarray, ahead: np.ndarray, points: np.ndarray, width: int, height: int) -> np.ndarray:
        """The pixel (N, P) in which each of ``points`` (P, 3) lies for cameras at ``origins`` (N, 3); -1 outside."""
        away = points[None] - origins[:, None]
        local = np.einsum("npj,nij->npi", away, self.axes(ahead))
        z = np.maximum(local[..., 2], 1e-9)
        reach = np.tan(np.radians(self.fov / 2))
        x = np.floor((local[..., 0] / z / reach + 1) / 2 * width)
        y = np.floor((1 - local[..., 1] / z / reach * self.aspect) / 2 * height)
        inside = (local[..., 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.where(inside, y * width + x, -1).astype(int)


@dataclass(frozen=True)
class SeenSurfaces:
    """What somebody at ``eye`` (3,) meets: unit ``directions`` (P, 3), ``depth`` (P,), whether it is a surface,
    ``met`` (P,) bool, and ``attention`` (P,), density in 1/sr; ``weight`` (P,): solid angles."""

    observer: np.ndarray
    directions: np.ndarray
    depth: np.ndarray
    is_hit: np.ndarray
    attention: np.ndarray
    solid_angle: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """Where the directions end (P, 3)."""
        return self.observer + self.depth[:, None] * self.directions

    @property
    def median_depth(self) -> float:
        """How far away most of what is met is; 0 where nothing is."""
        return float(np.median(self.depth[self.is_hit])) if self.is_hit.any() else 0.0

    @cached_property
    def main_direction(self) -> np.ndarray:
        """Unit direction (3,) towards which most of the attention goes, within some 20 degrees (a von Mises-Fisher
        kernel of concentration 8); of even attention some direction."""
        share = np.where(self.is_hit, self.attention * self.solid_angle, 0)
        # (P, P), in place: it takes hundreds of megabytes.
        kernel = self.directions @ self.directions.T
        kernel -= 1
        kernel *= 8
        np.exp(kernel, out=kernel)
        return self.directions[np.argmax(kernel @ share)]

    def mean_target(self, width: float = 60.0) -> np.ndarray | None:
        """Mean point (3,) of the attention within ``width`` degrees around the main direction, far ones counted as
        three times the usual distance; None where there is none."""
        towards = self.directions @ self.main_direction > np.cos(np.radians(width))
        share = np.where(self.is_hit & towards, self.attention * self.solid_angle, 0)
        if not share.sum() > 0:
            return None
        near = np.minimum(self.depth, 3 * self.median_depth)[:, None] * self.directions
        return self.observer + share @ near / share.sum()


class ViewScorer:
    """Scores pictures by their depths: the share that shows surfaces, less what is right before the lens, how far away
    these are, how many sizes of depth there are, and how much of the attention of ``seen`` there is in them.

    ``usual``: how far away things are. ``mean``: gives the mean depth at which light ends where ``trace`` gives the
    median; they are the same on a surface and differ by half in fog, as there is in a field where no photo looked.
    """

    def __init__(
        self,
        trace: Trace,
        frame: PinholeFrame,
        typical_distance: float,
        seen: SeenSurfaces | None = None,
        trace_mean: Trace | None = None,
    ):
        self.trace, self.frame, self.typical_distance, self.seen, self.trace_mean = trace, frame, typical_distance, seen, trace_mean

    def shots(self, origins: np.ndarray, targets: np.ndarray, size: tuple[int, int]) -> list[CameraView]:
        """One a camera at ``origins`` (N, 3) that looks at ``targets`` (N, 3), in pictures of ``size``."""
        width, height = size
        ahead = targets - origins
        ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        directions = self.frame.directions(ahead, width, height)
        o = np.repeat(origins, width * height, axis=0)
        depth, opacity = self.trace(o, directions.reshape(-1, 3))
        depth, met = depth.reshape(len(origins), -1), opacity.reshape(len(origins), -1) >= SURFACE_OPACITY
        opaque, near = met.mean(axis=1), (met & (depth < _NEAR * self.typical_distance)).mean(axis=1)
        spread = np.array([_spread(d[m]) for d, m in zip(depth, met)])
        # The farther away things are, the more of the place there is in the picture.
        reach = np.array([np.median(d[m]) if m.any() else 0.0 for d, m in zip(depth, met)]) / self.typical_distance
        score = opaque * (1 - near) ** 3 * (0.35 + 0.65 * np.minimum(spread / 0.6, 1))
        score = score * (0.1 + 0.9 * np.minimum(reach, 1))
        if self.trace_mean is not None:
            other = self.trace_mean(o, directions.reshape(-1, 3))[0].reshape(depth.shape)
            clear = np.exp(-np.abs(other - depth) / np.maximum(depth, 1e-9) / _FOG)
            score = score * (0.02 + 0.98 * np.where(met, clear, 0).sum(axis=1) / np.maximum(met.sum(axis=1), 1))
        attended: list[float | None] = [None] * len(origins)
        if self.seen is not None:
            shown, covered = self._attention(origins, ahead, directions, depth, met, size)
            # A third of the picture is enough for what is attended: the rest tells where that is.
            score = score * (0.05 + 0.95 * shown) * (0.25 + 0.75 * np.minimum(covered / 0.3, 1))
            attended = [float(x) for x in shown]
        return [CameraView(*row) for row in zip(origins, targets, score.tolist(), opaque.tolist(), attended)]

    def _attention(
        self,
        origins: np.ndarray,
        ahead: np.ndarray,
        directions: np.ndarray,
        depth: np.ndarray,
        met: np.ndarray,
        size: tuple[int, int],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of each picture the share of the observer's attention that it shows, and the share of its pixels that show
        attended surfaces. What the observer meets is known in the directions of ``seen`` alone."""
        seen = self.seen
        assert seen is not None
        share = np.where(seen.is_hit, seen.attention * seen.solid_angle, 0)
        points = seen.points
        pixel = self.frame.pixels(origins, ahead, points, *size)
        away = np.linalg.norm(points[None] - origins[:, None], axis=-1)
        there = np.take_along_axis(np.where(met, depth, np.inf), np.maximum(pixel, 0), axis=1)
        visible = (pixel >= 0) & (away < 1.1 * there + 0.02 * self.typical_distance)
        shown = (visible * share).sum(axis=1) / max(share.sum(), 1e-12)
        if not share.any():
            return np.ones(len(origins)), np.ones(len(origins))
        # The other way round: which pixels lie where the observer looks, and are not hidden from there.
        from scipy.spatial import KDTree

        surface = origins[:, None] + depth[..., None] * directions
        way = surface - seen.observer
        distance = np.linalg.norm(way, axis=-1)
        _, nearest = KDTree(seen.directions).query((way / np.maximum(distance, 1e-9)[..., None]).reshape(-1, 3))
        nearest = nearest.reshape(distance.shape)
        top = _ATTENDED * float(np.quantile(seen.attention[seen.is_hit], 0.99))
        attended = (seen.attention[nearest] > top) & (distance < 1.1 * seen.depth[nearest] + 0.02 * self.typical_distance)
        return shown, (met & attended).mean(axis=1)

    def best_index(self, origins: np.ndarray, targets: np.ndarray) -> int:
        """Number of the best of a few cameras."""
        return int(np.argmax([shot.score for shot in self.shots(origins, targets, _COARSE)]))

    def best(self, origins: np.ndarray, targets: np.ndarray) -> CameraView | None:
        """The best of many cameras; None where none of them shows anything."""
        apart = np.linalg.norm(targets - origins, axis=1) > 1e-6 * max(self.typical_distance, 1e-12)
        if not apart.any():
            return None
        found = sorted(self.shots(origins[apart], targets[apart], _COARSE), key=lambda s: -s.score)[:_KEPT]
        again = self.shots(np.array([s.origin for s in found]), np.array([s.target for s in found]), _FINE)
        best = max(again, key=lambda s: s.score)
        return best if best.score > 0 else None


def _spread(depth: np.ndarray) -> float:
    """How many sizes of depth there are: the standard deviation of its logarithm."""
    return float(np.std(np.log(np.maximum(depth, 1e-9)))) if depth.size else 0.0


def view_of_observer(trace: Trace, frame: PinholeFrame, seen: SeenSurfaces, trace_mean: Trace | None = None) -> CameraView | None:
    """The camera that shows best what the observer of ``seen`` looks at: in free sight of the observer, from above or
    beside. ``mean``: as `Judge` has it. None where nothing is met."""
    target = seen.mean_target()
    if target is None:
        return None
    up = frame.up / np.linalg.norm(frame.up)
    across = seen.main_direction - up * (seen.main_direction @ up)
    across = across if np.linalg.norm(across) > 1e-6 else np.roll(up, 1) - up * (np.roll(up, 1) @ up)
    across /= np.linalg.norm(across)
    beside = np.cross(up, across)
    azimuth = np.arange(16) / 16 * 2 * np.pi
    directions = []
    for elevation in np.radians([8, 20, 33, 47]):
        level = np.cos(azimuth)[:, None] * across + np.sin(azimuth)[:, None] * beside
        directions.append(np.cos(elevation) * level + np.sin(elevation) * up)
    along = np.concatenate(directions)
    depth, opacity = trace(np.broadcast_to(seen.observer, along.shape).copy(), along)
    free = np.where(opacity >= SURFACE_OPACITY, depth, np.inf)
    origins = []
    for share in (0.85, 0.5):
        # Not farther than what the observer looks at needs.
        away = np.minimum(share * free, 2.5 * share * seen.median_depth)
        origins.append(seen.observer + along * away[:, None])
    places = np.concatenate(origins)
    far = np.linalg.norm(places - seen.observer, axis=1) > 0.3 * seen.median_depth
    places = places[far]
    if not len(places):
        return None
    # At what is looked at, or half way to it, so that the observer's surroundings are in the picture.
    targets = [target, 0.5 * (target + seen.observer)]
    every = np.concatenate([np.broadcast_to(t, places.shape) for t in targets])
    return ViewScorer(trace, frame, seen.median_depth, seen, trace_mean).best(np.concatenate([places, places]), every)


def view_of_scene(
    trace: Trace,
    frame: PinholeFrame,
    lower: np.ndarray,
    upper: np.ndarray,
    allow_outside: bool = True,
    trace_mean: Trace | None = None,
    is_solid: Callable[[np.ndarray], np.ndarray] | None = None,
) -> CameraView | None:
    """The camera that shows best what lies between the corners ``lower`` and ``upper`` (3,): from within, where it can
    stand free, or, with ``outside``, from around. ``mean``: as `Judge` has it; ``solid``: whether points (N, 3) lie
    inside of something solid, where no camera stands. None where nothing is met."""
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    up = frame.up / np.linalg.norm(frame.up)
    center, size = (lower + upper) / 2, upper - lower
    radius = 0.5 * float(np.linalg.norm(size))
    side, front = frame.axes(np.roll(up, 1) - up * (up @ np.roll(up, 1)))[..., [0, 2], :]
    ring = lambda count: np.arange(count)[:, None] / count * 2 * np.pi
    level, finer = (np.cos(a) * front + np.sin(a) * side for a in (ring(8), ring(12)))
    origins, targets = [], []
    vertical = int(np.argmax(np.abs(up)))
    shares: list[tuple[float, ...]] = [(0.2, 0.5, 0.8)] * 3
    # People look at places from the middle of their height, or from above it.
    shares[vertical] = (0.5, 0.7) if up[vertical] > 0 else (0.5, 0.3)
    grid = np.stack([a.ravel() for a in np.meshgrid(*shares, indexing="ij")], axis=-1)
    within = lower + grid * size
    free = _clearance(trace, within, radius)
    within = within[free > 0.06 * radius]
    for elevation in np.radians([-5, -20]):
        along = np.cos(elevation) * level + np.sin(elevation) * up
        origins.append(np.repeat(within, len(along), axis=0))
        targets.append(origins[-1] + np.tile(along, (len(within), 1)) * 0.5 * radius)
    # What photos were taken around is often in the middle.
    away = [share * 0.5 * float(size.max()) for share in (0.3, 0.5, 0.7)]
    away += [1.15 * radius / np.tan(np.radians(frame.fov / 2))] if allow_outside else []
    for distance in away:
        for elevation in np.radians([5, 18, 35]):
            origins.append(center + distance * (np.cos(elevation) * finer + np.sin(elevation) * up))
            targets.append(np.broadcast_to(center, origins[-1].shape))
    if not len(o := np.concatenate(origins)):
        return None
    ends = np.concatenate(targets)
    if is_solid is not None:
        places, which = np.unique(o, axis=0, return_inverse=True)
        outside_of_all = ~is_solid(places)[which.reshape(-1)]
        o, ends = o[outside_of_all], ends[outside_of_all]
    return ViewScorer(trace, frame, 0.5 * radius, trace_mean=trace_mean).best(o, ends) if len(o) else None


def _clearance(trace: Trace, points: np.ndarray, far: float) -> np.ndarray:
    """How far matter is from each of ``points`` (N, 3), in the direction in which it is nearest but for a tenth."""
    around = fibonacci_directions(64)
    depth, opacity = trace(np.repeat(points, len(around), axis=0), np.tile(around, (len(points), 1)))
    depth = np.where(opacity >= SURFACE_OPACITY, depth, far).reshape(len(points), -1)
    return np.quantile(depth, 0.1, axis=1)
