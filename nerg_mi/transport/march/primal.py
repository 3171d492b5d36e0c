"""The march itself: opacity, depth and colour along rays, without derivatives.

Steps lie at midpoint-sampled constant density, or what another rule makes of them (``rules``); optical depth
accumulates in log space, so that opacity is -expm1(-τ) to full precision however thin the medium. Steps whose midpoint
lies in an empty cell of the medium's occupancy grid are leapt over without an evaluation; marching ends behind opaque
surfaces.
"""

from __future__ import annotations

import drjit as dr

from nerg_mi.maths.types import Bool, Float
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.painting import Painter
from nerg_mi.transport.media.protocol import Medium

from .occlusion import Occlusion
from .quadrature import absorbed_share
from .rules import RULES, boundaries
from .settings import MarchResult, MarchSettings
from .stepping import advance

LOG2 = 0.6931471805599453


def march_primal(
    medium: Medium,
    ray: LocalRay,
    t0: Float,
    t1: Float,
    active: Bool,
    settings: MarchSettings,
    offset: Float | None,
    color: Painter | None,
    count: bool,
    until: Float | None,
    fine_from: Float | None,
    occlusion: Occlusion | None = None,
) -> MarchResult:
    """March ``ray`` from ``t0`` to ``t1``; the arguments are those of ``march.march``."""
    Float = type(t0)
    goal, end = limits(Float, settings, until)

    # The loops are functional rather than @dr.syntax: what they close over (fields, settings) stays
    # out of the loop state, where a field's weight arrays would be carried along lane by lane.
    quadrature = RULES.find(settings.quadrature)
    cells = boundaries(quadrature, medium)

    def body(active, t, share, carry, lost, tau, moment, half, slope, enter, enter_tau, total, pending, n, m, known):
        part = Float(1) if share is None else share
        active, t, delta, t_next = advance(medium, ray, t, t1, part, settings, active, cells, fine_from)
        if occlusion is not None:
            clear = active & occlusion.clear(t, tau)
            known, active = known | clear, active & ~clear
        step = quadrature.step(medium, ray, t, delta, t_next, carry, active, color is not None)
        weight = dr.exp(-tau) * absorbed_share(step.dtau)
        moment, lost_moment = add(moment, lost[1], weight * dr.fma(delta, step.share, t - t0))
        # The sum that the next step starts from: a goal between it and a plain sum would be crossed by no step.
        after, lost_tau = add(tau, lost[0], step.dtau)
        crosses = active & (tau < goal) & (after >= goal)
        half = dr.select(crosses, t + step.crossing(goal - tau), half)
        slope = dr.select(crosses, delta / dr.select(crosses, step.dtau, 1), slope)
        enter, enter_tau = dr.select(crosses, t, enter), dr.select(crosses, tau, enter_tau)

        if color is not None:
            painter = color
            pending = pending + weight
            lit = active & (pending > settings.color_cutoff)
            shown = dr.if_stmt(
                (lit,), lit, lambda lit: step.paint(painter, lit), lambda lit: painter.zero(), label="colour"
            )
            total = total + pending * shown
            pending = dr.select(lit, 0, pending)
            if count:
                m = m + dr.select(lit, 1, 0)
        if count:
            n = n + step.evals

        tau = after
        if occlusion is not None:
            hidden = active & occlusion.hidden(t_next, tau)
            known, active = known | hidden, active & ~hidden
        active = active & (t_next < t1) & (tau < end)
        return (
            active,
            t_next,
            None if share is None else Float(1),
            step.carry,
            (lost_tau, lost_moment),
            tau,
            moment,
            half,
            slope,
            enter,
            enter_tau,
            total,
            pending,
            n,
            m,
            known,
        )

    start = (
        active,
        t0,
        # A state that never changes would have the loop recorded twice.
        None if offset is None else Float(offset),
        quadrature.start(Float),
        (Float(0), Float(0)),
        Float(0),
        Float(0),
        Float(dr.inf),
        Float(0),
        Float(0),
        Float(0),
        None if color is None else color.zero(),
        None if color is None else Float(0),
        Float(0) if count else None,
        Float(0) if count and color is not None else None,
        None if occlusion is None else dr.mask_t(Float)(False),
    )
    state = dr.while_loop(start, lambda active, *_: active, body, label="march")
    tau, moment, half, slope, enter, enter_tau, total, pending, n, m, known = state[5:]
    if color is not None:
        # What never gathered enough weight for a colour of its own takes that of the rest.
        painted = absorbed_share(tau) - pending
        total *= dr.select(painted > 0, 1 + pending / dr.select(painted > 0, painted, 1), 0)
    return MarchResult(tau, moment, half, slope, enter, enter_tau, total, n, m, known)


def add(total: Float, lost: Float, term: Float) -> tuple[Float, Float]:
    """``(total + term, lost)`` with the rounding of the sum carried along (Kahan 1965).

    A thousand plain additions lose two digits, and the derivative of a depth divides what is lost by the opacity.
    """
    term = term - lost
    after = total + term
    return after, (after - total) - term


def limits(Float: type, settings: MarchSettings, until: Float | None) -> tuple[Float, Float]:
    """Optical depths ``(goal, end)``: whose crossing is looked for, and at which marching ends. ``Float``: array type
    of distances."""
    if until is None:
        return Float(LOG2), Float(settings.opaque)
    goal = Float(dr.detach(until))
    return goal, dr.minimum(goal, settings.opaque)
