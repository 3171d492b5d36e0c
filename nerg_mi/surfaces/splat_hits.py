"""The Gaussians that rays meet, hit by hit, as arrays of NumPy: sums of them are the same to the bit each time.

A kernel that added to the Gaussians itself would add in whatever order its threads arrive. So it only finds hits, some
at a time, as the march does (`nerg_mi.transport.march.hits`), and the light that is left is followed in float64.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import aligned, vector_of
from nerg_mi.transport.march.settings import HITS_STOP
from nerg_mi.transport.media.hits import LastHit
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.splats.arrays import SplatArrays
from nerg_mi.transport.media.splats.nearest import SplatHits


@dataclass(frozen=True, eq=False)
class Group:
    """The next hits of the rays numbered ``rows`` (M,), nearest first, K at most: ``index`` (M, K) of the Gaussians in
    the order of the file, ``arriving`` and ``absorbed`` (M, K), the light that reaches each and the share of it that it
    takes, which is 0 where there is no hit. ``left`` (M,): light behind the last; ``through`` (M,): nothing is met of
    it any more."""

    rows: np.ndarray
    index: np.ndarray
    arriving: np.ndarray
    absorbed: np.ndarray
    left: np.ndarray
    through: np.ndarray


def groups_of_hits(
    arrays: SplatArrays,
    origins: np.ndarray,
    directions: np.ndarray,
    before: np.ndarray | None = None,
    stop: float = HITS_STOP,
) -> Generator[Group, np.ndarray | None, None]:
    """What rays with ``origins`` (N, 3) and unit ``directions`` (N, 3), in the frame of ``arrays``, meet of them.

    Up to the distances ``before`` (N,), everywhere without them, and until no more than ``stop`` of the light is left.
    Who has seen enough of a ray may `send` the rows that go on, a part of those of the last group.
    """
    hits, order = SplatHits(arrays), np.array(arrays.order).astype(np.int64)
    rows, ends = np.arange(len(origins)), np.full(len(origins), np.inf) if before is None else np.asarray(before)
    light, last, thing = np.ones(len(origins)), np.full(len(origins), -1e-37), np.zeros(len(origins), np.int64)
    while len(rows):
        t, absorbed, place = _next(hits, origins[rows], directions[rows], (last, thing), ends[rows], light, stop)
        met = np.isfinite(t)
        absorbed = np.where(met, absorbed, 0.0)
        after = light[:, None] * np.cumprod(1 - absorbed, axis=1)
        arriving = np.concatenate([light[:, None], after[:, :-1]], axis=1)
        left = after[:, -1]
        more = met[:, -1] & (left > stop)
        # A group is cut short where no light is left, too.
        through = ~more & (left > stop)
        index = np.where(met, order[np.where(met, place, 0)], -1)
        wanted = yield Group(rows, index, arriving, absorbed, left, through)
        if wanted is not None:
            more &= np.isin(rows, wanted)
        rows, light, last, thing = rows[more], left[more], t[more, -1], place[more, -1]


def _next(hits, origins, directions, after, before, light, stop) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, share and place in the tree (M, K) of the next hits; distances are infinite where there are none."""
    import mitsuba as mi

    o, d = vector_of(mi.Point3f, origins), vector_of(mi.Vector3f, directions)
    count = len(origins)
    given = lambda values: mi.Float(aligned(values))
    ray = LocalRay(o, d, d, mi.Float(0), mi.Float(dr.inf))
    last = LastHit(given(after[0]), mi.UInt32(aligned(after[1], np.uint32)))
    with dr.suspend_grad():
        found = hits.nearest(
            ray, last, given(before), given(light), dr.opaque(mi.Float, stop), dr.full(mi.Bool, True, count)
        )
        dr.eval(found.t, found.absorbed, found.index)
    stacked = lambda values, kind: np.stack([np.array(v).astype(kind) for v in values], axis=1)
    return stacked(found.t, np.float64), stacked(found.absorbed, np.float64), stacked(found.index, np.int64)
