"""Derivatives of a march from hit to hit, by finding the hits again.

The sums are those of ``adjoint``, with a hit's optical depth, its distance and its colour for a step's: nothing is
stored along the ray, however many hits there are. Which hits there are, and their order, carry no derivatives: one
that moves past another, or to where it is cut off, changes the sums by a jump that is not seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from nerg_mi.maths.arrays import log1p
from nerg_mi.maths.types import Bool, Color, Float, UInt32
from nerg_mi.transport.media.hits import LastHit
from nerg_mi.transport.media.local_ray import LocalRay

from .adjoint import March, Replayed
from .hits import march_hits
from .primal import add, limits
from .settings import MarchResult


@dataclass
class _State:
    """Where a repeated march is: the hit to come, and the sums in front of it."""

    active: Bool
    index: UInt32
    tau: Float
    moment: Float
    lost: tuple[Float, Float]
    color: Color | None


class HitMarch(March):
    """``march_hits`` as one node of the graph."""

    def _primal(self) -> MarchResult:
        medium, active, settings, _, color, count, until, _ = self.fixed
        t0, t1 = self.inputs[3:]
        return march_hits(medium, medium.hits, LocalRay(*self.inputs), t0, t1, active, settings, color, count, until)

    def _march_again(self, body: Callable[[Any, Any], tuple[Any, Any]], active: Bool, extra: Any) -> Any:
        medium, _, settings, _, color, _, until, _ = self.fixed
        ray, (t0, t1) = LocalRay(*(dr.detach(x) for x in self.inputs)), self.inputs[3:]
        Float = type(t0)
        UInt32 = dr.uint32_array_t(Float)
        end = limits(Float, settings, until)[1]

        def take(state, t, index, extra):
            """The first of the hits; the others move up."""
            state, extra = body(replace(state, index=index[0]), extra)
            t, index = t[1:] + [Float(dr.inf)], index[1:] + [UInt32(0)]
            return replace(state, active=state.active & (t[0] < dr.inf)), t, index, extra

        def group(active, last, state, extra):
            found = medium.hits.nearest(ray, last, t1, dr.exp(-state.tau), dr.exp(-end), active)
            farthest = LastHit(found.t[-1], found.index[-1])
            state = replace(state, active=active & (found.t[0] < dr.inf))
            state, _, _, extra = dr.while_loop(
                (state, found.t, found.index, extra), lambda state, *_: state.active, take, label="hits again"
            )
            return active & (farthest.t < dr.inf) & (state.tau < end), farthest, state, extra

        nothing = None if color is None else color.zero()
        state = _State(active, UInt32(0), Float(0), Float(0), (Float(0), Float(0)), nothing)
        first = LastHit(dr.fma(dr.abs(t0), -(2.0**-22), t0 - 1e-37), UInt32(0))
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            out = dr.while_loop((active, first, state, extra), lambda active, *_: active, group, label="hits adjoint")
        return out[3]

    def _replay(self, leaves: list[Any], state: Any) -> tuple[Replayed, Any]:
        medium, _, settings, _, color, _, until, _ = self.fixed
        o, d, w, t0, t1 = leaves
        goal, end = limits(type(t0), settings, until)
        active, tau = state.active, state.tau
        t, absorbed = medium.hits.again(LocalRay(o, d, w, t0, t1), state.index, active)
        dtau, mean = dr.select(active, -log1p(-absorbed), 0), t - t0
        transmittance = dr.exp(-tau)
        weight = dr.select(active, transmittance * dr.detach(absorbed), 0)
        moment, lost_moment = add(state.moment, state.lost[1], weight * dr.detach(mean))
        after, lost_tau = add(tau, state.lost[0], dr.detach(dtau))
        total, painted = state.color, None
        if color is not None:
            lit = active & (weight > 0)
            painted = dr.select(lit, color.paint(medium, [state.index], o + d * t, w, lit), 0)
            total = total + weight * dr.detach(painted)
        before = active & (after < goal)
        crosses = active & ~before & (tau < goal)
        replayed = Replayed(active, dtau, mean, painted, transmittance, before, crosses, t)
        lost = lost_tau, lost_moment
        return replayed, _State(active & (after < end), state.index, after, moment, lost, total)
