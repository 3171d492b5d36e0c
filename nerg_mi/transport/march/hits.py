"""The march through a medium whose things are met one by one: from hit to hit, in their order.

A hit that absorbs the share α adds -ln(1 - α) of optical depth at its distance, all at once; the sums are those of
``primal``, with hits for steps. Half of the light is gone at the hit that takes it, so that a median needs no crossing.
"""

from __future__ import annotations

import drjit as dr

from nerg_mi.maths.arrays import log1p
from nerg_mi.maths.types import Bool, Float
from nerg_mi.transport.media.hits import Hits, LastHit
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.painting import Painter
from nerg_mi.transport.media.protocol import Medium

from .occlusion import Occlusion
from .primal import add, limits
from .settings import MarchResult, MarchSettings


def march_hits(
    medium: Medium,
    hits: Hits,
    ray: LocalRay,
    t0: Float,
    t1: Float,
    active: Bool,
    settings: MarchSettings,
    color: Painter | None,
    count: bool,
    until: Float | None,
    occlusion: Occlusion | None = None,
) -> MarchResult:
    """What ``ray`` meets of ``hits``, those of ``medium``, from the distance ``t0`` on and before ``t1``. The other
    arguments are those of ``march.march``; without derivatives."""
    Float = type(t0)
    UInt32 = dr.uint32_array_t(Float)
    goal, end = limits(Float, settings, until)
    stop = dr.exp(-end)

    def take(going, t, absorbed, index, lost, tau, moment, half, enter, enter_tau, total, m, known):
        """The first of the hits; the others move up."""
        here, share, thing = t[0], absorbed[0], index[0]
        if occlusion is not None:
            clear = going & occlusion.clear(here, tau)
            known, going = known | clear, going & ~clear
        dtau = dr.select(going, -log1p(-share), 0)
        weight = dr.select(going, dr.exp(-tau) * share, 0)
        moment, lost_moment = add(moment, lost[1], weight * (here - t0))
        after, lost_tau = add(tau, lost[0], dtau)
        crosses = going & (tau < goal) & (after >= goal)
        half, enter = dr.select(crosses, here, half), dr.select(crosses, here, enter)
        enter_tau = dr.select(crosses, tau, enter_tau)
        if color is not None:
            painter, lit = color, going & (weight > 0)
            total = total + weight * dr.if_stmt(
                (lit, thing),
                lit,
                lambda lit, thing: painter.paint(medium, [thing], ray.o + ray.d * here, ray.w, lit),
                lambda lit, thing: painter.zero(),
                label="colour",
            )
            if count:
                m = m + dr.select(lit, 1, 0)
        tau = after
        if occlusion is not None:
            hidden = going & occlusion.hidden(here, tau)
            known, going = known | hidden, going & ~hidden
        t, absorbed, index = t[1:] + [Float(dr.inf)], absorbed[1:] + [Float(0)], index[1:] + [UInt32(0)]
        going = going & (tau < end) & (t[0] < dr.inf)
        return going, t, absorbed, index, (lost_tau, lost_moment), tau, moment, half, enter, enter_tau, total, m, known

    def group(active, last, n, lost, tau, moment, half, enter, enter_tau, total, m, known):
        """The next hits, as many as are found at once."""
        found = hits.nearest(ray, last, t1, dr.exp(-tau), stop, active)
        if count:
            n = n + found.evals
        farthest = LastHit(found.t[-1], found.index[-1])
        going = active & (found.t[0] < dr.inf)
        state = going, found.t, found.absorbed, found.index, lost, tau, moment, half, enter, enter_tau, total, m, known
        state = dr.while_loop(state, lambda going, *_: going, take, label="hits")
        tau, known = state[5], state[12]
        active = active & (farthest.t < dr.inf) & (tau < end)
        if occlusion is not None:
            active = active & ~known
        return active, farthest, n, *state[4:]

    start = (
        active,
        # The first may lie at t0 itself.
        LastHit(dr.fma(dr.abs(t0), -(2.0**-22), t0 - 1e-37), UInt32(0)),
        Float(0) if count else None,
        (Float(0), Float(0)),
        Float(0),
        Float(0),
        Float(dr.inf),
        Float(0),
        Float(0),
        None if color is None else color.zero(),
        Float(0) if count and color is not None else None,
        None if occlusion is None else dr.mask_t(Float)(False),
    )
    state = dr.while_loop(start, lambda active, *_: active, group, label="groups of hits")
    n, _, tau, moment, half, enter, enter_tau, total, m, known = state[2:]
    return MarchResult(tau, moment, half, Float(0), enter, enter_tau, total, n, m, known)
