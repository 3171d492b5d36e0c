"""Automatic choice of a camera that shows a scene, or the attention of an observer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.transport.geometry import SURFACE_OPACITY

Trace = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

_COARSE_SIZE, _FINE_SIZE = (18, 12), (48, 32)
_NUM_CANDIDATES = 10
# Surfaces closer than this fraction of the typical distance fill an image.
_NEAR_FRACTION = 0.2
# Relative difference of mean and median depth that indicates fog rather than a surface.
_FOG_FRACTION = 0.1
# A surface is attended if its gaze density exceeds this fraction of the maximum.
_ATTENTION_THRESHOLD = 0.15


@dataclass(frozen=True)
class ScoredView:
    """A camera at ``origin`` (3,) that looks at ``target`` (3,), its score (0..1), the fraction of pixels with a
    surface, and the share of the observer's attention in the image (None without an observer)."""

    origin: np.ndarray
    target: np.ndarray
    score: float
    surface_fraction: float
    attention_share: float | None = None


@dataclass(frozen=True)
class PinholeFrame:
    """Image of a pinhole camera: horizontal ``fov`` in degrees, ``aspect`` (width by height) and ``up`` axis (3,)."""

    fov: float
    aspect: float
    up: np.ndarray

    def axes(self, ahead: np.ndarray) -> np.ndarray:
        """Return the right, up and forward axes (..., 3, 3) of cameras with unit forward directions ``ahead`` (...,
        3)."""
        right = np.cross(ahead, self.up)
        right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-9)
        return np.stack([right, np.cross(right, ahead), ahead], axis=-2)

    def directions(self, ahead: np.ndarray, width: int, height: int) -> np.ndarray:
        """Return the unit directions (..., height * width, 3) of the pixels of cameras with forward directions
        ``ahead`` (..., 3)."""
        half_width = np.tan(np.radians(self.fov / 2))
        x = ((np.arange(width) + 0.5) / width * 2 - 1) * half_width
        y = (1 - (np.arange(height) + 0.5) / height * 2) * half_width / self.aspect
        local = np.stack([*(v.ravel() for v in np.meshgrid(x, y)), np.ones(width * height)], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return local @ self.axes(np.asarray(ahead, float))

    def pixels(self, origins: np.ndarray, ahead: np.ndarray, points: np.ndarray, width: int, height: int) -> np.ndarray:
        """Return the pixel index (N, P) of ``points`` (P, 3) in cameras at ``origins`` (N, 3); -1 if outside."""
        away = points[None] - origins[:, None]
        local = np.einsum("npj,nij->npi", away, self.axes(ahead))
        z = np.maximum(local[..., 2], 1e-9)
        half_width = np.tan(np.radians(self.fov / 2))
        x = np.floor((local[..., 0] / z / half_width + 1) / 2 * width)
        y = np.floor((1 - local[..., 1] / z / half_width * self.aspect) / 2 * height)
        inside = (local[..., 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.where(inside, y * width + x, -1).astype(int)


@dataclass(frozen=True)
class SeenSurfaces:
    """Surfaces around an observer at a position (3,): unit ``directions`` (P, 3), ``depth`` (P,), whether each
    direction meets a surface (P,), ``attention`` density in 1/sr (P,), and solid angles (P,)."""

    observer: np.ndarray
    directions: np.ndarray
    depth: np.ndarray
    is_hit: np.ndarray
    attention: np.ndarray
    solid_angle: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """End points of the directions (P, 3)."""
        return self.observer + self.depth[:, None] * self.directions

    @property
    def median_depth(self) -> float:
        """Median depth of the surfaces; 0 if there are none."""
        return float(np.median(self.depth[self.is_hit])) if self.is_hit.any() else 0.0

    @cached_property
    def main_direction(self) -> np.ndarray:
        """Unit direction (3,) of the largest attention, smoothed by a von Mises-Fisher kernel of concentration 8
        (about 20 degrees)."""
        share = np.where(self.is_hit, self.attention * self.solid_angle, 0)
        # (P, P), in place: it takes hundreds of megabytes.
        kernel = self.directions @ self.directions.T
        kernel -= 1
        kernel *= 8
        np.exp(kernel, out=kernel)
        return self.directions[np.argmax(kernel @ share)]

    def mean_target(self, width: float = 60.0) -> np.ndarray | None:
        """Return the mean point (3,) of the attention within ``width`` degrees of the main direction; None without
        attention.

        Distances are clipped to three times the median depth.
        """
        towards = self.directions @ self.main_direction > np.cos(np.radians(width))
        share = np.where(self.is_hit & towards, self.attention * self.solid_angle, 0)
        if not share.sum() > 0:
            return None
        clipped = np.minimum(self.depth, 3 * self.median_depth)[:, None] * self.directions
        return self.observer + share @ clipped / share.sum()


class ViewScorer:
    """Scores images by their depth and attention.

    The score increases with the fraction of surface pixels, the distance and the spread of depths, and the attention in
    the image, and decreases with surfaces close to the camera.

    Parameters
    ----------
    trace
        Traces rays, and returns median depth and opacity.
    frame
        Image of the camera.
    typical_distance
        Typical distance of surfaces.
    seen
        Surfaces around an observer whose attention should be shown.
    trace_mean
        Traces rays, and returns mean depth. It equals the median on surfaces and differs in fog, for example in
        unobserved parts of a radiance field.
    """

    def __init__(
        self,
        trace: Trace,
        frame: PinholeFrame,
        typical_distance: float,
        seen: SeenSurfaces | None = None,
        trace_mean: Trace | None = None,
    ):
        self.trace, self.frame, self.typical_distance, self.seen, self.trace_mean = (
            trace,
            frame,
            typical_distance,
            seen,
            trace_mean,
        )

    def score_views(self, origins: np.ndarray, targets: np.ndarray, size: tuple[int, int]) -> list[ScoredView]:
        """Score cameras at ``origins`` that look at ``targets``, (N, 3) each, in images of the given size."""
        width, height = size
        ahead = targets - origins
        ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        directions = self.frame.directions(ahead, width, height)
        o = np.repeat(origins, width * height, axis=0)
        depth, opacity = self.trace(o, directions.reshape(-1, 3))
        depth, is_hit = depth.reshape(len(origins), -1), opacity.reshape(len(origins), -1) >= SURFACE_OPACITY
        surface_fraction, near_fraction = (
            is_hit.mean(axis=1),
            (is_hit & (depth < _NEAR_FRACTION * self.typical_distance)).mean(axis=1),
        )
        spread = np.array([_depth_spread(d[m]) for d, m in zip(depth, is_hit)])
        # More distant surfaces show more of the scene.
        relative_depth = (
            np.array([np.median(d[m]) if m.any() else 0.0 for d, m in zip(depth, is_hit)]) / self.typical_distance
        )
        score = surface_fraction * (1 - near_fraction) ** 3 * (0.35 + 0.65 * np.minimum(spread / 0.6, 1))
        score = score * (0.1 + 0.9 * np.minimum(relative_depth, 1))
        if self.trace_mean is not None:
            mean_depth = self.trace_mean(o, directions.reshape(-1, 3))[0].reshape(depth.shape)
            clarity = np.exp(-np.abs(mean_depth - depth) / np.maximum(depth, 1e-9) / _FOG_FRACTION)
            score = score * (0.02 + 0.98 * np.where(is_hit, clarity, 0).sum(axis=1) / np.maximum(is_hit.sum(axis=1), 1))
        attention: list[float | None] = [None] * len(origins)
        if self.seen is not None:
            attention_share, covered = self._attention_shares(origins, ahead, directions, depth, is_hit, size)
            # Attended surfaces should cover a third of the image; the rest shows the context.
            score = score * (0.05 + 0.95 * attention_share) * (0.25 + 0.75 * np.minimum(covered / 0.3, 1))
            attention = [float(x) for x in attention_share]
        return [ScoredView(*row) for row in zip(origins, targets, score.tolist(), surface_fraction.tolist(), attention)]

    def _attention_shares(
        self,
        origins: np.ndarray,
        ahead: np.ndarray,
        directions: np.ndarray,
        depth: np.ndarray,
        is_hit: np.ndarray,
        size: tuple[int, int],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the share of the observer's attention in each image, and the fraction of its pixels on attended
        surfaces."""
        seen = self.seen
        assert seen is not None
        share = np.where(seen.is_hit, seen.attention * seen.solid_angle, 0)
        points = seen.points
        pixel = self.frame.pixels(origins, ahead, points, *size)
        away = np.linalg.norm(points[None] - origins[:, None], axis=-1)
        depth_at_pixel = np.take_along_axis(np.where(is_hit, depth, np.inf), np.maximum(pixel, 0), axis=1)
        visible = (pixel >= 0) & (away < 1.1 * depth_at_pixel + 0.02 * self.typical_distance)
        attention_share = (visible * share).sum(axis=1) / max(share.sum(), 1e-12)
        if not share.any():
            return np.ones(len(origins)), np.ones(len(origins))
        # Pixels on attended surfaces that are visible to the observer.
        from scipy.spatial import KDTree

        surface = origins[:, None] + depth[..., None] * directions
        from_observer = surface - seen.observer
        distance = np.linalg.norm(from_observer, axis=-1)
        _, nearest = KDTree(seen.directions).query(
            (from_observer / np.maximum(distance, 1e-9)[..., None]).reshape(-1, 3)
        )
        nearest = nearest.reshape(distance.shape)
        top = _ATTENTION_THRESHOLD * float(np.quantile(seen.attention[seen.is_hit], 0.99))
        is_attended = (seen.attention[nearest] > top) & (
            distance < 1.1 * seen.depth[nearest] + 0.02 * self.typical_distance
        )
        return attention_share, (is_hit & is_attended).mean(axis=1)

    def best_index(self, origins: np.ndarray, targets: np.ndarray) -> int:
        """Return the index of the best of a few cameras."""
        return int(np.argmax([shot.score for shot in self.score_views(origins, targets, _COARSE_SIZE)]))

    def find_best(self, origins: np.ndarray, targets: np.ndarray) -> ScoredView | None:
        """Return the best of many cameras; None if no image shows a surface."""
        is_valid = np.linalg.norm(targets - origins, axis=1) > 1e-6 * max(self.typical_distance, 1e-12)
        if not is_valid.any():
            return None
        candidates = sorted(
            self.score_views(origins[is_valid], targets[is_valid], _COARSE_SIZE), key=lambda s: -s.score
        )[:_NUM_CANDIDATES]
        refined = self.score_views(
            np.array([s.origin for s in candidates]), np.array([s.target for s in candidates]), _FINE_SIZE
        )
        best = max(refined, key=lambda s: s.score)
        return best if best.score > 0 else None


def _depth_spread(depth: np.ndarray) -> float:
    """Return the standard deviation of the logarithm of the depth."""
    return float(np.std(np.log(np.maximum(depth, 1e-9)))) if depth.size else 0.0


def view_of_observer(
    trace: Trace, frame: PinholeFrame, seen: SeenSurfaces, trace_mean: Trace | None = None
) -> ScoredView | None:
    """Return the camera that shows best where an observer looks, from a position visible to the observer; None without
    surfaces.

    ``trace_mean``: as for `ViewScorer`.
    """
    target = seen.mean_target()
    if target is None:
        return None
    up = frame.up / np.linalg.norm(frame.up)
    forward = seen.main_direction - up * (seen.main_direction @ up)
    forward = forward if np.linalg.norm(forward) > 1e-6 else np.roll(up, 1) - up * (np.roll(up, 1) @ up)
    forward /= np.linalg.norm(forward)
    sideways = np.cross(up, forward)
    azimuth = np.arange(16) / 16 * 2 * np.pi
    directions = []
    for elevation in np.radians([8, 20, 33, 47]):
        level = np.cos(azimuth)[:, None] * forward + np.sin(azimuth)[:, None] * sideways
        directions.append(np.cos(elevation) * level + np.sin(elevation) * up)
    along = np.concatenate(directions)
    depth, opacity = trace(np.broadcast_to(seen.observer, along.shape).copy(), along)
    free_distance = np.where(opacity >= SURFACE_OPACITY, depth, np.inf)
    origins = []
    for fraction in (0.85, 0.5):
        # Stay close to the attended surfaces.
        away = np.minimum(fraction * free_distance, 2.5 * fraction * seen.median_depth)
        origins.append(seen.observer + along * away[:, None])
    positions = np.concatenate(origins)
    is_far = np.linalg.norm(positions - seen.observer, axis=1) > 0.3 * seen.median_depth
    positions = positions[is_far]
    if not len(positions):
        return None
    # Look at the target, or half way to it to include the observer's surroundings.
    targets = [target, 0.5 * (target + seen.observer)]
    all_targets = np.concatenate([np.broadcast_to(t, positions.shape) for t in targets])
    return ViewScorer(trace, frame, seen.median_depth, seen, trace_mean).find_best(
        np.concatenate([positions, positions]), all_targets
    )


def view_of_scene(
    trace: Trace,
    frame: PinholeFrame,
    lower: np.ndarray,
    upper: np.ndarray,
    allow_outside: bool = True,
    trace_mean: Trace | None = None,
    is_solid: Callable[[np.ndarray], np.ndarray] | None = None,
) -> ScoredView | None:
    """Return the camera that shows best the box between ``lower`` and ``upper`` (3,); None without surfaces.

    Parameters
    ----------
    trace, frame, trace_mean
        As for `ViewScorer`.
    lower, upper
        Corners of the box.
    allow_outside
        Whether the camera may be outside the box.
    is_solid
        Returns whether points (N, 3) are inside a solid, where no camera is placed.
    """
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
    # Heights at or above the centre give familiar views.
    shares[vertical] = (0.5, 0.7) if up[vertical] > 0 else (0.5, 0.3)
    grid = np.stack([a.ravel() for a in np.meshgrid(*shares, indexing="ij")], axis=-1)
    interior = lower + grid * size
    clearance = _clearance(trace, interior, radius)
    interior = interior[clearance > 0.06 * radius]
    for elevation in np.radians([-5, -20]):
        along = np.cos(elevation) * level + np.sin(elevation) * up
        origins.append(np.repeat(interior, len(along), axis=0))
        targets.append(origins[-1] + np.tile(along, (len(interior), 1)) * 0.5 * radius)
    # Captures often surround an object at the centre.
    away = [fraction * 0.5 * float(size.max()) for fraction in (0.3, 0.5, 0.7)]
    away += [1.15 * radius / np.tan(np.radians(frame.fov / 2))] if allow_outside else []
    for distance in away:
        for elevation in np.radians([5, 18, 35]):
            origins.append(center + distance * (np.cos(elevation) * finer + np.sin(elevation) * up))
            targets.append(np.broadcast_to(center, origins[-1].shape))
    if not len(o := np.concatenate(origins)):
        return None
    ends = np.concatenate(targets)
    if is_solid is not None:
        positions, which = np.unique(o, axis=0, return_inverse=True)
        is_free = ~is_solid(positions)[which.reshape(-1)]
        o, ends = o[is_free], ends[is_free]
    return ViewScorer(trace, frame, 0.5 * radius, trace_mean=trace_mean).find_best(o, ends) if len(o) else None


def _clearance(trace: Trace, points: np.ndarray, default: float) -> np.ndarray:
    """Return the distance of surfaces from each of ``points`` (N, 3), the 10 % quantile over directions."""
    directions = fibonacci_directions(64)
    depth, opacity = trace(np.repeat(points, len(directions), axis=0), np.tile(directions, (len(points), 1)))
    depth = np.where(opacity >= SURFACE_OPACITY, depth, default).reshape(len(points), -1)
    return np.quantile(depth, 0.1, axis=1)
