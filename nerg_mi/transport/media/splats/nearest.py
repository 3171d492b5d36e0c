"""The next Gaussians along rays, in the order of their peaks.

Where a Gaussian is densest along the ray decides its place among them, not where the ray enters its ellipsoid, nor how
far its centre is. The tree is walked nearer child first; a box is left out where it begins behind the last of the
Gaussians that are wanted, or behind where those already found leave no light. A ray may start inside of Gaussians: what
counts is that their peak lies before it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr

from nerg_mi.maths.types import Bool, Float, UInt32
from nerg_mi.transport.media.hits import LastHit, NextHits
from nerg_mi.transport.media.local_ray import LocalRay

from .arrays import SplatArrays
from .tree import COLUMNS

AT_ONCE = 12
"""So many are found in one walk through the tree."""


@dataclass
class _Walk:
    """Where a walk is. ``way``: a bit for each level, after a leading 1, whether it is in the farther child."""

    active: Bool
    node: UInt32
    way: UInt32
    # Distance behind which nothing is wanted.
    far: Float
    t: list[Float]
    absorbed: list[Float]
    index: list[UInt32]
    evals: Float


class SplatHits:
    """What rays meet of ``arrays``: a `media.hits.Hits`."""

    at_once = AT_ONCE

    def __init__(self, arrays: SplatArrays):
        self.arrays = arrays

    def nearest(
        self, ray: LocalRay, after: LastHit, before: Float, transmittance: Float, stop: Float, active: Bool
    ) -> NextHits:
        """See `media.hits.Hits`."""
        a, o, d = self.arrays, ray.o, ray.d
        Float = type(before)
        UInt32 = dr.uint32_array_t(Float)
        # Axes along which the ray stands still never decide, unless it is outside of a box.
        inverse = [dr.rcp(dr.select(dr.abs(v) > 1e-30, v, 1e-30)) for v in (d.x, d.y, d.z)]
        origin = (o.x, o.y, o.z)

        def test(walk: _Walk) -> _Walk:
            place = dr.gather(UInt32, a.places, walk.node - a.leaves, walk.active)
            t, absorbed, distance = a.peak(place, o, d, walk.active)
            behind = (t > after.t) | ((t == after.t) & (place > after.index))
            good = walk.active & behind & (distance < a.extent**2) & (t < walk.far) & (t < before)
            t = dr.select(good, t, dr.inf)
            light, far, ts, shares, places = transmittance, walk.far, [], [], []
            for here, share, held in zip(walk.t, walk.absorbed, walk.index):
                first = (t < here) | ((t == here) & (place < held))
                ts.append(dr.select(first, t, here))
                shares.append(dr.select(first, absorbed, share))
                places.append(dr.select(first, place, held))
                t, absorbed = dr.select(first, here, t), dr.select(first, share, absorbed)
                place = dr.select(first, held, place)
                light = light * dr.select(ts[-1] < dr.inf, 1 - shares[-1], 1)
                # What is equally far is still wanted: its place decides.
                far = dr.select(light <= stop, dr.minimum(far, _above(ts[-1])), far)
            far, evals = dr.minimum(far, _above(ts[-1])), walk.evals + dr.select(walk.active, 1, 0)
            return replace(walk, far=far, t=ts, absorbed=shares, index=places, evals=evals)

        def step(walk: _Walk) -> _Walk:
            shape = (COLUMNS, dr.width(walk.node))
            box = dr.gather(a.rows, a.nodes, walk.node, walk.active, shape=shape)
            near, far = dr.maximum(after.t, 0), walk.far
            for i in range(3):
                t0, t1 = (box[i] - origin[i]) * inverse[i], (box[i + 3] - origin[i]) * inverse[i]
                near, far = dr.maximum(near, dr.minimum(t0, t1)), dr.minimum(far, dr.maximum(t0, t1))
            met = walk.active & (near <= far)
            leaf = walk.node >= a.leaves
            tested = dr.if_stmt(
                (replace(walk, active=met & leaf),), met & leaf, test, lambda walk: walk, label="Gaussian"
            )
            down = met & ~leaf
            along = dr.select(box[6] < 0.5, d.x, dr.select(box[6] < 1.5, d.y, d.z))
            nearer = (walk.node << 1) | dr.select(along < 0, UInt32(1), UInt32(0))
            # Up to the last node whose farther child is still to be seen.
            up = dr.tzcnt(walk.way + 1)
            node = dr.select(down, nearer, (walk.node >> up) ^ 1)
            way = dr.select(down, walk.way << 1, (walk.way + 1) >> up)
            return replace(tested, active=walk.active & (way != 1), node=node, way=way)

        start = _Walk(
            active,
            UInt32(1),
            UInt32(1),
            Float(before),
            [Float(dr.inf) for _ in range(AT_ONCE)],
            [Float(0) for _ in range(AT_ONCE)],
            [UInt32(0) for _ in range(AT_ONCE)],
            Float(0),
        )
        (walk,) = dr.while_loop((start,), lambda walk: walk.active, lambda walk: (step(walk),), label="nearest")
        return NextHits(walk.t, walk.absorbed, walk.index, walk.evals)

    def again(self, ray: LocalRay, index: UInt32, active: Bool) -> tuple[Float, Float]:
        """See `media.hits.Hits`."""
        t, absorbed, _ = self.arrays.peak(index, ray.o, ray.d, active)
        return t, absorbed


def _above(t: Float) -> Float:
    """The next greater number, or a little more: ``t < _above(t)`` for finite ``t``."""
    return dr.fma(dr.abs(t), 2.0**-22, t + 1e-37)
