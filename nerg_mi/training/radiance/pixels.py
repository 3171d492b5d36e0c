"""All training pixels as device arrays, and batches of their rays."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.types import Array3f, Float, UInt32
from nerg_mi.photos.images import View

from .unproject import LensTable

# A pixel's place in its colours is 32 bits, four channels each.
_MOST = 2**30
_DEPTH_STEPS = 65535


@dataclass
class PixelBatch:
    """Rays of chosen pixels: ``o``, ``d`` (Array3f, world, d of unit length), ``rgb`` (Array3f, sRGB, straight),
    ``alpha`` (Float or None), ``depth`` (Float, scene units, 0 where unknown; None without any)."""

    o: Array3f
    d: Array3f
    rgb: Array3f
    alpha: Float | None
    depth: Float | None
    frame: UInt32


class PixelBank:
    """Pixels of ``views`` that their masks leave in; which of them are drawn is the caller's business.

    A pixel takes 3 bytes (8-bit pictures) or 6 (others), a third more with alpha, 2 with depth, and 4 with masks; its
    ray is computed from its camera when it is drawn. Depth keeps 1/65535 of its picture's largest.
    """

    def __init__(self, ns, views: list[View]):
        self.ns = ns
        counts = [v.pixels.shape[0] * v.pixels.shape[1] for v in views]
        used = [n if v.mask is None else int(np.count_nonzero(v.mask)) for n, v in zip(counts, views)]
        self.size = sum(used)
        if sum(counts) >= _MOST:
            raise NergError(f"{sum(counts)} training pixels are too many; load the pictures at a smaller width")
        self.centers = np.array([v.camera.center for v in views])
        self._ends = ns.UInt32(np.cumsum(counts).astype(np.uint32))
        self._starts = ns.UInt32(np.cumsum([0, *counts[:-1]]).astype(np.uint32))
        self._widths = ns.UInt32(np.array([v.pixels.shape[1] for v in views], np.uint32))
        self._lenses = LensTable(ns, [v.camera.intrinsics for v in views])
        self._pose = ns.Float(np.concatenate([v.camera.to_world[:3].ravel() for v in views]).astype(np.float32))
        self._frames = len(views)
        self._where = None
        if any(v.mask is not None for v in views):
            starts = np.cumsum([0, *counts[:-1]])
            self._where = ns.UInt32(
                np.concatenate(
                    [(start + np.flatnonzero(_mask(v).ravel())).astype(np.uint32) for start, v in zip(starts, views)]
                )
            )
        self._store_colors(views, used)
        self._store_depth(views, used)

    def _store_colors(self, views: list[View], used: list[int]) -> None:
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

    def _store_depth(self, views: list[View], used: list[int]) -> None:
        self._depth, self.depth_everywhere = None, False
        self.has_depth = any(v.depth is not None for v in views)
        if not self.has_depth:
            return
        table, unit, at = np.zeros(self.size, "<u2"), np.zeros(len(views), np.float32), 0
        for k, (view, n) in enumerate(zip(views, used)):
            if view.depth is not None:
                depth = view.depth.ravel() if view.mask is None else view.depth[view.mask]
                unit[k] = max(float(depth.max(initial=0)), 1e-30) / _DEPTH_STEPS
                # What is known must not round to unknown.
                table[at : at + n] = np.where(depth > 0, np.clip(np.round(depth / unit[k]), 1, _DEPTH_STEPS), 0)
            at += n
        self.depth_everywhere = np.count_nonzero(table) >= 0.999 * self.size
        self._depth, self._depth_unit = self.ns.UInt8(table.view(np.uint8)), self.ns.Float(unit)

    @property
    def bytes_per_pixel(self) -> float:
        """Device memory of what is kept for each pixel."""
        kept = [self._colors, *(a for a in (self._where, self._depth) if a is not None)]
        return sum(dr.width(a) * dr.itemsize_v(a) for a in kept) / self.size

    def batch(self, index) -> PixelBatch:
        """Rays and colours of the pixels at ``index`` (UInt32)."""
        ns = self.ns
        frame, column, row = self._locate(index)
        x, y, z = self._lenses.directions(frame, column, row)
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
        """Frame, column and row (UInt32) of the pixels at ``index``."""
        ns = self.ns
        pixel = index if self._where is None else dr.gather(ns.UInt32, self._where, index)
        frame = ns.UInt32(0)
        if self._frames > 1:
            frame = dr.binary_search(0, self._frames - 1, lambda k: dr.gather(ns.UInt32, self._ends, k) <= pixel)
        offset = pixel - dr.gather(ns.UInt32, self._starts, frame)
        # The unused lanes of a vector gather 0, and a division of integers by it kills the process.
        width = dr.maximum(dr.gather(ns.UInt32, self._widths, frame), 1)
        row = offset // width
        return frame, offset - row * width, row

    def surface_points(self, chunk: int = 2**20):
        """The points (Array3f, world) that the pixels with depth see, ``chunk`` pixels at a time."""
        for first in range(0, self.size, chunk):
            index = dr.arange(self.ns.UInt32, min(chunk, self.size - first)) + dr.opaque(self.ns.UInt32, first)
            pixels = self.batch(index)
            if pixels.depth is not None:
                known: UInt32 = dr.compress(pixels.depth > 0)
                yield dr.gather(self.ns.Array3f, pixels.o + pixels.d * pixels.depth, known)


def _mask(view: View) -> np.ndarray:
    return np.ones(view.shape, bool) if view.mask is None else view.mask
