"""All training pixels as device arrays, and batches of their rays."""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from ..capture.cameras import pixel_directions
from ..capture.images import View


@dataclass
class PixelBatch:
    """Rays of chosen pixels: ``o``, ``d`` (Array3f, world, d of unit length), ``rgb`` (Array3f, sRGB, straight),
    ``alpha`` (Float or None), ``depth`` (Float, scene units, 0 where unknown; None without any)."""

    o: object
    d: object
    rgb: object
    alpha: object
    depth: object


class PixelBank:
    """Pixels of ``views``; which of them are drawn is the caller's business."""

    def __init__(self, ns, views: list[View]):
        self.ns = ns
        self.size = sum(v.color.shape[0] * v.color.shape[1] for v in views)
        if self.size >= 2**31:
            raise ValueError(f"{self.size} training pixels are too many; load the pictures at a smaller width")
        frame = np.concatenate([np.full(v.color.shape[0] * v.color.shape[1], i, np.uint32) for i, v in enumerate(views)])
        tables: dict = {}
        directions = []
        for view in views:
            i = view.camera.intrinsics
            if i not in tables:
                d = pixel_directions(i).reshape(-1, 3)
                tables[i] = (d[:, :2] / -d[:, 2:]).astype(np.float32)
            directions.append(tables[i])
        self.centers = np.array([v.camera.center for v in views])
        self._frame = ns.UInt32(frame)
        self._xy = ns.Float(np.concatenate(directions).ravel())
        self._pose = ns.Float(np.concatenate([v.camera.to_world[:3].ravel() for v in views]).astype(np.float32))
        self._rgb = ns.Float16(np.concatenate([v.color[..., :3].reshape(-1, 3) for v in views]).ravel())
        self._alpha = self._depth = None
        if any(v.has_alpha for v in views):
            alpha = [(v.color[..., 3] if v.has_alpha else np.ones(v.color.shape[:2])).ravel() for v in views]
            self._alpha = ns.Float16(np.concatenate(alpha))
        if any(v.depth is not None for v in views):
            depth = [(v.depth if v.depth is not None else np.zeros(v.color.shape[:2])).ravel() for v in views]
            self._depth = ns.Float(np.concatenate(depth).astype(np.float32))
        self.has_depth = self._depth is not None
        self.depth_everywhere = self.has_depth and dr.count(self._depth > 0)[0] >= 0.999 * self.size

    def batch(self, index) -> PixelBatch:
        """Rays and colours of the pixels at ``index`` (UInt32)."""
        ns = self.ns
        frame = dr.gather(ns.UInt32, self._frame, index)
        x, y = dr.gather(ns.Array2f, self._xy, index)
        m = [dr.gather(ns.Float, self._pose, frame * 12 + k) for k in range(12)]
        # The camera looks along -z; xy are ideal image coordinates, the second already pointing up.
        d = dr.normalize(ns.Array3f(*[m[4 * r] * x + m[4 * r + 1] * y - m[4 * r + 2] for r in range(3)]))
        o = ns.Array3f(m[3], m[7], m[11])
        rgb = ns.Array3f(*[ns.Float(dr.gather(ns.Float16, self._rgb, index * 3 + k)) for k in range(3)])
        alpha = None if self._alpha is None else ns.Float(dr.gather(ns.Float16, self._alpha, index))
        depth = None if self._depth is None else dr.gather(ns.Float, self._depth, index)
        dr.eval(o, d, rgb, alpha, depth)
        return PixelBatch(o, d, rgb, alpha, depth)

    def surface_points(self, chunk: int = 2**20):
        """The points (Array3f, world) that the pixels with depth see, ``chunk`` pixels at a time."""
        for first in range(0, self.size, chunk):
            index = dr.arange(self.ns.UInt32, min(chunk, self.size - first)) + dr.opaque(self.ns.UInt32, first)
            pixels = self.batch(index)
            known = dr.compress(pixels.depth > 0)
            yield dr.gather(self.ns.Array3f, pixels.o + pixels.d * pixels.depth, known)
