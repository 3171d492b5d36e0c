"""Pixels of photos, with depth, as training data of radiance fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.types import Array3f, Float, UInt32
from nerg_mi.photos.cameras import Intrinsics, find_fisheye_limit, project
from nerg_mi.photos.dataset import MAX_CONVERGENCE_ANGLE, find_focus
from nerg_mi.photos.images import PhotoView

# ---- Pixel directions on the device: the float32 counterpart of `photos.cameras.image_to_directions` ----


# Starting from the image coordinates, Newton's iteration converges to float32 in 3 to 5 steps at the corners of usual
# lenses.
_STEPS = 8
_ROUNDING = 1e-5


class LensTable:
    """Lens parameters of some frames on the device; only what these lenses need is computed.

    A row has the half-pixel offset and inverse focal length of both axes, then eight distortion coefficients and, for
    fisheyes, the image radius and angle at which they end (0: no fisheye).
    """

    def __init__(self, ns, lenses: list[Intrinsics]):
        self.ns = ns
        self.is_fisheye = [i.fisheye for i in lenses]
        plain = [i for i in lenses if not i.fisheye]
        self.is_distorted = any(any(i.distortion) for i in plain)
        self.is_rational = any(i.k4 or i.k5 or i.k6 for i in plain)
        rows = [[0.5 - i.cx, 0.5 - i.cy, 1 / i.fx, 1 / i.fy, *i.distortion, *_get_fisheye_end(i)] for i in lenses]
        self._columns = [ns.Float(c) for c in np.array(rows, np.float32).T]

    def compute_directions(self, frame, column, row):
        """Compute the directions (3 Floats, OpenGL camera frame, not normalised) of pixels ``column``, ``row`` of
        ``frame``, UInt32.
        """
        ns = self.ns
        get = lambda k: dr.gather(ns.Float, self._columns[k], frame)
        x, y = (ns.Float(column) + get(0)) * get(2), (ns.Float(row) + get(1)) * get(3)
        z = ns.Float(1)
        if self.is_distorted or any(self.is_fisheye):
            k = [get(4 + n) for n in range(8)]
            out = self._undistort_pinhole(x, y, k) if self.is_distorted else (x, y, z)
            if any(self.is_fisheye):
                end, angle = get(12), get(13)
                fisheye = self._undistort_fisheye(x, y, k, end, angle)
                out = fisheye if all(self.is_fisheye) else tuple(dr.select(end > 0, b, a) for a, b in zip(out, fisheye))
            x, y, z = out
        return x, -y, -z

    def _undistort_pinhole(self, x0, y0, k):
        """Invert OpenCV's distortion model by Newton's iteration, see `photos.cameras.undistort`."""
        k1, k2, p1, p2, k3, k4, k5, k6 = k
        x, y = x0, y0
        for _ in range(_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
            if self.is_rational:
                under = dr.rcp(1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
                radial *= under
                slope = (slope - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) * under
            ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - x0
            ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - y0
            a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
            b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            d = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
            inverse = dr.rcp(a * d - b * b)
            x, y = x - (d * ex - b * ey) * inverse, y - (a * ey - b * ex) * inverse
        return x, y, self.ns.Float(1)

    def _undistort_fisheye(self, x, y, k, end, max_angle):
        """Invert the fisheye model by Newton's iteration on the angle within its monotonic range."""
        k1, k2, _, _, k3, k4, _, _ = k
        r = dr.sqrt(x * x + y * y)
        goal = dr.minimum(r, end)
        low, high, theta = self.ns.Float(0), max_angle, dr.minimum(goal, max_angle)
        for _ in range(3 * _STEPS):
            t = theta * theta
            excess = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) - goal
            slope = 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))
            low, high = dr.select(excess > 0, low, theta), dr.select(excess > 0, theta, high)
            step = theta - excess / slope
            # Where the polynomial flattens, Newton's step may leave the bracket by more than rounding error: bisect
            # instead.
            theta = dr.select((step > low - _ROUNDING) & (step < high + _ROUNDING), step, 0.5 * (low + high))
        sine, cosine = dr.sincos(theta)
        across = dr.select(r > 1e-7, sine / dr.maximum(r, 1e-7), 1)
        return x * across, y * across, cosine


def _get_fisheye_end(lens: Intrinsics) -> tuple[float, float]:
    """Return the image radius and angle at which a fisheye ends."""
    if not lens.fisheye:
        return 0.0, 0.0
    angle, radius = find_fisheye_limit(lens)
    return radius, angle


# ---- All training pixels as device arrays, and batches of their rays ----

# The index into the colours is 32 bits, with four channels per pixel.
_MAX_PIXELS = 2**30
_DEPTH_STEPS = 65535


@dataclass
class PixelBatch:
    """Rays and colours of selected pixels.

    ``o``, ``d`` are ray origins and unit directions (Array3f, world), ``rgb`` (Array3f) is sRGB with straight alpha,
    ``alpha`` is Float or None, ``depth`` (Float, scene units) is 0 where unknown, or None without any depth.
    """

    o: Array3f
    d: Array3f
    rgb: Array3f
    alpha: Float | None
    depth: Float | None
    frame: UInt32


class PixelBank:
    """Unmasked pixels of ``views`` on the device.

    Notes
    -----
    A pixel takes 3 bytes (8-bit pictures) or 6 (others), a third more with alpha, 2 with depth, and 4 with masks. Its
    ray is computed from its camera on demand. Depth is quantised to 1/65535 of the largest depth of its picture.
    """

    def __init__(self, ns, views: list[PhotoView]):
        self.ns = ns
        counts = [v.pixels.shape[0] * v.pixels.shape[1] for v in views]
        used = [n if v.mask is None else int(np.count_nonzero(v.mask)) for n, v in zip(counts, views)]
        self.size = sum(used)
        if sum(counts) >= _MAX_PIXELS:
            raise NergError(
                f"{sum(counts)} training pixels are too many; use a smaller {parameter('width')} or fewer photos"
            )
        self.centers = np.array([v.camera.center for v in views])
        self._ends = ns.UInt32(np.cumsum(counts).astype(np.uint32))
        self._starts = ns.UInt32(np.cumsum([0, *counts[:-1]]).astype(np.uint32))
        self._widths = ns.UInt32(np.array([v.pixels.shape[1] for v in views], np.uint32))
        self._lenses = LensTable(ns, [v.camera.intrinsics for v in views])
        self._pose = ns.Float(np.concatenate([v.camera.to_world[:3].ravel() for v in views]).astype(np.float32))
        self._frames = len(views)
        self._pixel_index = None
        if any(v.mask is not None for v in views):
            starts = np.cumsum([0, *counts[:-1]])
            self._pixel_index = ns.UInt32(
                np.concatenate(
                    [
                        (start + np.flatnonzero(_get_mask(v).ravel())).astype(np.uint32)
                        for start, v in zip(starts, views)
                    ]
                )
            )
        self._store_colors(views, used)
        self._store_depth(views, used)
        self.points = PointPixels.find(views, used)

    def _store_colors(self, views: list[PhotoView], used: list[int]) -> None:
        self._channels = 4 if any(v.has_alpha for v in views) else 3
        bytes_ = all(v.pixels.dtype == np.uint8 for v in views)
        table = np.empty((self.size, self._channels), np.uint8 if bytes_ else np.float16)
        at = 0
        for view, n in zip(views, used):
            pixels = view.pixels if bytes_ else view.color
            if view.mask is not None:
                pixels = pixels[view.mask]
            c = pixels.shape[-1]
            table[at : at + n, :c] = pixels.reshape(-1, c)
            table[at : at + n, c:] = 255 if bytes_ else 1
            at += n
        self._color_type = self.ns.UInt8 if bytes_ else self.ns.Float16
        self._color_unit = 1 / 255 if bytes_ else 1.0
        self._colors = self._color_type(table.ravel())

    def _store_depth(self, views: list[PhotoView], used: list[int]) -> None:
        self._depth, self.has_full_depth = None, False
        self.has_depth = any(v.depth is not None for v in views)
        if not self.has_depth:
            return
        table, unit, at = np.zeros(self.size, "<u2"), np.zeros(len(views), np.float32), 0
        for k, (view, n) in enumerate(zip(views, used)):
            if view.depth is not None:
                depth = view.depth.ravel() if view.mask is None else view.depth[view.mask]
                unit[k] = max(float(depth.max(initial=0)), 1e-30) / _DEPTH_STEPS
                # Known depth must not round to 0, which means unknown.
                table[at : at + n] = np.where(depth > 0, np.clip(np.round(depth / unit[k]), 1, _DEPTH_STEPS), 0)
            at += n
        self.has_full_depth = np.count_nonzero(table) >= 0.999 * self.size
        self._depth, self._depth_unit = self.ns.UInt8(table.view(np.uint8)), self.ns.Float(unit)

    def gather_batch(self, index) -> PixelBatch:
        """Gather rays and colours of the pixels at ``index`` (UInt32)."""
        ns = self.ns
        frame, column, row = self._locate(index)
        x, y, z = self._lenses.compute_directions(frame, column, row)
        m = [dr.gather(ns.Float, self._pose, frame * 12 + k) for k in range(12)]
        d = dr.normalize(ns.Array3f(*[m[4 * r] * x + m[4 * r + 1] * y + m[4 * r + 2] * z for r in range(3)]))
        o = ns.Array3f(m[3], m[7], m[11])
        color = [
            ns.Float(dr.gather(self._color_type, self._colors, index * self._channels + k)) * self._color_unit
            for k in range(self._channels)
        ]
        rgb, alpha = ns.Array3f(*color[:3]), color[3] if self._channels == 4 else None
        depth = None
        if self._depth is not None:
            low, high = (ns.Float(dr.gather(ns.UInt8, self._depth, index * 2 + k)) for k in range(2))
            depth = (low + 256 * high) * dr.gather(ns.Float, self._depth_unit, frame)
        dr.eval(o, d, rgb, alpha, depth, frame)
        return PixelBatch(o, d, rgb, alpha, depth, frame)

    def _locate(self, index):
        """Return frame, column and row (UInt32) of the pixels at ``index``."""
        ns = self.ns
        pixel = index if self._pixel_index is None else dr.gather(ns.UInt32, self._pixel_index, index)
        frame = ns.UInt32(0)
        if self._frames > 1:
            frame = dr.binary_search(0, self._frames - 1, lambda k: dr.gather(ns.UInt32, self._ends, k) <= pixel)
        offset = pixel - dr.gather(ns.UInt32, self._starts, frame)
        # Unused SIMD lanes gather 0, and an integer division by zero kills the process.
        width = dr.maximum(dr.gather(ns.UInt32, self._widths, frame), 1)
        row = offset // width
        return frame, offset - row * width, row

    def iter_surface_points(self, chunk: int = 2**20):
        """Yield the surface points (Array3f, world) of the pixels with depth, ``chunk`` pixels at a time."""
        for first in range(0, self.size, chunk):
            index = dr.arange(self.ns.UInt32, min(chunk, self.size - first)) + dr.opaque(self.ns.UInt32, first)
            pixels = self.gather_batch(index)
            if pixels.depth is not None:
                has_depth: Any = dr.compress(pixels.depth > 0)
                yield dr.gather(self.ns.Array3f, pixels.o + pixels.d * pixels.depth, has_depth)


# ---- Points of a reconstruction: pixels whose distance is known, and space that the cameras see through ----


# Points whose distance has a larger relative standard error are not used.
_MAX_POINT_ERROR = 0.1
# Minimum number of points of a photo, and the fraction of them that may be outliers in front of everything else.
_MIN_CLEARING_POINTS, _NEAR_OUTLIERS = 50, 0.02
# Maximum distance of empty space relative to the nearest point.
_CLEAR_MARGIN = 0.8


@dataclass(frozen=True)
class PointPixels:
    """Pixels that show a point of the reconstruction.

    Attributes
    ----------
    index
        (N,) uint32 index into the pixels of a `PixelBank`.
    distance
        (N,) float32 distance of the point along the ray of the pixel, in scene units.
    error
        (N,) float32 standard error of the distance, in scene units.
    """

    index: np.ndarray
    distance: np.ndarray
    error: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    @staticmethod
    def find(views: list[PhotoView], counts: list[int]) -> PointPixels:
        """Find the pixels in ``views``, of which the bank has ``counts`` pixels each."""
        parts, first = [np.zeros((3, 0))], 0
        for view, count in zip(views, counts):
            if view.points is not None:
                pixel, distance, error = _locate_points(view)
                rank = np.cumsum(_get_mask(view).ravel()) - 1
                parts.append(np.stack([first + rank[pixel], distance, error]))
            first += count
        index, distance, error = np.concatenate(parts, axis=1)
        return PointPixels(index.astype(np.uint32), distance.astype(np.float32), error.astype(np.float32))


def _locate_points(view: PhotoView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixel (row by row), distance and error of the precise points of ``view`` that its mask admits."""
    assert view.points is not None
    positions, relative = view.points.positions, view.points.relative_errors
    pixels, selected = _project_inside(view, positions)
    selected &= relative <= _MAX_POINT_ERROR
    column, row = pixels[selected].astype(int).T
    distance = np.linalg.norm(positions[selected] - view.camera.center, axis=1)
    unmasked, pixel = _get_mask(view)[row, column], row * view.shape[1] + column
    return pixel[unmasked], distance[unmasked], (distance * relative[selected])[unmasked]


def _project_inside(view: PhotoView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel coordinates (N, 2) of ``points`` and the mask (N,) of those that are within the image."""
    pixels, is_visible = project(points, view.camera)
    return pixels, is_visible & np.all((pixels >= 0) & (pixels < view.shape[::-1]), axis=1)


@dataclass(frozen=True)
class FreeSpace:
    """Empty space near the cameras, where fog would otherwise explain single photos.

    Attributes
    ----------
    near
        (V,) float32 distance from each camera within which all space is empty, in scene units.
    clear
        (V,) float32 distance from each camera within which the space that it sees is empty.
    """

    near: np.ndarray
    clear: np.ndarray

    @property
    def ray_starts(self) -> np.ndarray:
        """(V,) float32 distance from each camera at which its rays start."""
        return np.maximum(self.near, self.clear)

    @staticmethod
    def within(num_cameras: int, near: float) -> FreeSpace:
        """Return the space within ``near`` of each camera."""
        return FreeSpace(np.full(num_cameras, near, np.float32), np.zeros(num_cameras, np.float32))

    @staticmethod
    def find(views: list[PhotoView], near: float, in_view: float, around: float) -> FreeSpace:
        """Find the empty space of the cameras of ``views``. It contains no point of the reconstruction.

        Parameters
        ----------
        views : list of PhotoView
            The training photos.
        near : float
            Minimum distance in scene units.
        in_view : float
            Fraction of the distance to the nearest points of a photo, except outliers, up to which its camera sees
            through empty space.
        around : float
            Radius of the empty space around cameras that look at a common point, as a fraction of their distance to
            it. With depth, which tells more, it is not used.
        """
        points = [view.points.positions for view in views if view.points is not None]
        distinct = np.unique(np.concatenate([np.zeros((0, 3)), *points]), axis=0)
        radius = np.maximum(near, around * find_focus_distances(views)).astype(np.float32)
        clear = np.zeros_like(radius)
        for k, view in enumerate(views):
            distances = np.linalg.norm(distinct - view.camera.center, axis=1)
            radius[k] = max(near, min(radius[k], _CLEAR_MARGIN * np.min(distances, initial=np.inf)))
            clear[k] = _find_clear_distance(view, distinct, distances, in_view)
        return FreeSpace(radius, clear)


def _find_clear_distance(view: PhotoView, points: np.ndarray, distances: np.ndarray, fraction: float) -> float:
    """Return how far the camera of ``view`` sees through empty space, with the reconstruction's ``points`` at
    ``distances``; 0 if its photo has too few points.
    """
    if view.points is None or len(view.points) < _MIN_CLEARING_POINTS:
        return 0.0
    matched = np.linalg.norm(view.points.positions - view.camera.center, axis=1)
    distance = fraction * float(np.quantile(matched, _NEAR_OUTLIERS))
    # Points of other photos count if they are in view, and only if they are nearer.
    near = distances < distance / _CLEAR_MARGIN
    is_visible = _project_inside(view, points[near])[1]
    return min(distance, _CLEAR_MARGIN * float(np.min(distances[near][is_visible], initial=np.inf)))


def find_focus_distances(views: list[PhotoView]) -> np.ndarray:
    """Return the distance (V,) of cameras that look at a common point from it; 0 for others, and with depth."""
    if len(views) < 2 or any(view.depth is not None for view in views):
        return np.zeros(len(views))
    focus, angles = find_focus([view.camera for view in views])
    if np.median(angles) >= MAX_CONVERGENCE_ANGLE:
        return np.zeros(len(views))
    return np.linalg.norm([view.camera.center - focus for view in views], axis=1)


def _get_mask(view: PhotoView) -> np.ndarray:
    return np.ones(view.shape, bool) if view.mask is None else view.mask
