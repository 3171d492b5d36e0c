"""Where density may be while a field trains, and the bound that is stored when it is done.

A cubic grid over the field's unit cube, x varying fastest, as instant-ngp keeps it: each cell
remembers a decaying maximum of the optical depth that one step finds in it.
"""
from __future__ import annotations

import drjit as dr
import numpy as np

from ..capture.cameras import Camera
from ..field.box import Box
from ..field.occupancy import OccupancyGrid

_DECAY = 0.6
# A share of the cells is refreshed at a time; the strides walk over all of them.
_PARTS = 8


class DensityGrid:
    """Decaying maxima of σ times ``step``, and the cells in which samples are taken.

    ``step``: length, in scene units, that turns density into optical depth; ``threshold``: optical
    depth a step from which on a cell counts, lowered to half of the mean while the field is thin.
    """

    def __init__(self, ns, box: Box, resolution: int, step: float, cameras: list[Camera], min_views: int,
                 threshold: float = 0.01):
        self.ns, self.box, self.resolution, self.step, self.threshold = ns, box, resolution, step, threshold
        cells = resolution**3
        self.index = dr.arange(ns.UInt32, cells)
        self.seen = self._seen(cameras, min_views)
        if not dr.any(self.seen):
            raise ValueError(
                f"not one cell of the scene box {box.lower} to {box.upper} is seen by {min_views} cameras; "
                "give a box that holds what the pictures show with --aabb"
            )
        self.seen_count = int(dr.count(self.seen)[0])
        self.value = dr.select(self.seen, ns.Float(1), 0)
        self.bits = dr.select(self.seen, ns.UInt8(1), 0)
        dr.eval(self.value, self.bits)
        self._turn = 0

    def _corner(self, index):
        """Lower corner of cells in the unit cube."""
        r = self.resolution
        z = index // (r * r)
        y = index // r - z * r
        x = index - (z * r + y) * r
        return self.ns.Array3f(x, y, z) / r

    def _to_world(self, u):
        return (u - 0.5) * self.box.side + self.ns.Array3f(*self.box.center)

    def _seen(self, cameras: list[Camera], min_views: int):
        """Cells whose centre lies within the box and in at least ``min_views`` pictures.

        Occlusion and distortion are not considered; pictures are taken to be 10 % wider instead.
        """
        Float, UInt32 = self.ns.Float, self.ns.UInt32
        p = self._to_world(self._corner(self.index) + 0.5 / self.resolution)
        cell = self.box.side / self.resolution
        center, half = np.asarray(self.box.center), (np.subtract(self.box.upper, self.box.lower) + cell) / 2
        inside = dr.all(dr.abs(p - self.ns.Array3f(*center)) < self.ns.Array3f(*half))
        count = dr.zeros(UInt32, self.resolution**3)
        dr.eval(p, inside)
        for camera in cameras:
            i = camera.intrinsics
            rows = [Float(v) for v in np.vstack([camera.to_world[:3, :3].T.ravel(), ]).ravel()]
            origin = [Float(v) for v in camera.center]
            edge = [Float(v) for v in (i.cx / i.fx, (i.width - i.cx) / i.fx, i.cy / i.fy, (i.height - i.cy) / i.fy)]
            # As literals the pose would compile one kernel a camera.
            dr.make_opaque(rows, origin, edge)
            d = [p[k] - origin[k] for k in range(3)]
            x, y, z = (rows[3 * k] * d[0] + rows[3 * k + 1] * d[1] + rows[3 * k + 2] * d[2] for k in range(3))
            left, right, up, down = (e * 1.1 for e in edge)
            sees = (z < 0) & (x > left * z) & (x < -right * z) & (-y > up * z) & (-y < -down * z)
            count += dr.select(sees, UInt32(1), 0)
            dr.eval(count)
        return inside & (count >= min(min_views, len(cameras)))

    def occupied(self, p, active):
        """Mask of the points ``p`` (Array3f, world) in cells that may hold density."""
        r = self.resolution
        u = (p - self.ns.Array3f(*self.box.center)) / self.box.side + 0.5
        c = [self.ns.UInt32(dr.clip(x * r, 0, r - 1)) for x in (u.x, u.y, u.z)]
        return active & (dr.gather(self.ns.UInt8, self.bits, c[0] + r * (c[1] + r * c[2]), active) > 0)

    def update(self, density, rng: np.random.Generator) -> None:
        """Look at one random point in an eighth of the cells; ``density``: σ at world points, without gradient."""
        total = self.resolution**3
        index = dr.arange(self.ns.UInt32, total // _PARTS) * _PARTS + dr.opaque(self.ns.UInt32, self._turn % _PARTS)
        self._turn += 1
        index = dr.gather(self.ns.UInt32, index, dr.compress(dr.gather(self.ns.Bool, self.seen, index)))
        if dr.width(index) > 0:
            jitter = self.ns.Array3f(*[self.ns.Float(rng.random(dr.width(index), np.float32)) for _ in range(3)])
            p = self._to_world(self._corner(index) + jitter / self.resolution)
            found = density(p, True) * self.step
            # Beyond some optical depth more says nothing, and would drown the mean.
            value = dr.maximum(dr.gather(self.ns.Float, self.value, index) * _DECAY, dr.minimum(found, 10))
            dr.scatter(self.value, value, index, mode=dr.ReduceMode.Permute)
            dr.eval(self.value)
        mean = dr.sum(self.value) / self.seen_count
        bound = dr.minimum(self.threshold, 0.5 * mean)
        self.bits = dr.select(self.seen & (self.value > bound), self.ns.UInt8(1), 0)
        dr.eval(self.bits)

    @property
    def fraction(self) -> float:
        """Share of all cells that samples are taken in."""
        return float(dr.sum(self.ns.Float(self.bits))[0]) / self.resolution**3

    def bound(self, density, rng: np.random.Generator, probes: int = 3) -> OccupancyGrid:
        """A grid for rendering. A cell is empty when no probe in it finds density above the threshold.

        ``probes``**3 jittered points a cell are looked at, and every cell that touches an occupied one
        stays on, so that a bump between the probes of a face is not cut. The threshold, in 1/unit, is
        the density that absorbs ``self.threshold`` in one training step. Cells that too few cameras see
        are empty by definition: nothing was learnt there.
        """
        limit = self.threshold / self.step
        found = dr.zeros(self.ns.UInt8, self.resolution**3)
        for k in range(probes**3):
            index = dr.compress(self.seen & (found == 0))
            if dr.width(index) == 0:
                break
            stratum = self.ns.Array3f(k % probes, k // probes % probes, k // probes**2)
            dr.make_opaque(stratum)
            jitter = self.ns.Array3f(*[self.ns.Float(rng.random(dr.width(index), np.float32)) for _ in range(3)])
            p = self._to_world(self._corner(index) + (stratum + jitter) / (probes * self.resolution))
            hit = dr.compress(density(p, True) > limit)
            if dr.width(hit) > 0:
                dr.scatter(found, self.ns.UInt8(1), dr.gather(self.ns.UInt32, index, hit))
                dr.eval(found)
        from scipy.ndimage import binary_dilation

        shape = (self.resolution,) * 3
        bits = binary_dilation(found.numpy().reshape(shape) > 0, np.ones((3, 3, 3)))
        return OccupancyGrid(bits & self.seen.numpy().reshape(shape), self.ns, limit)
