"""Volume rendering of one ray: opacity, depth and colour by marching a medium.

Steps lie at midpoint-sampled constant density (see ``quadrature``); optical depth
accumulates in log space, so opacity is -expm1(-τ) to full precision however thin
the medium. Steps whose midpoint lies in an empty cell of the medium's occupancy
grid are leapt over without an evaluation; marching ends behind opaque surfaces.
Derivatives come from ``adjoint``, which marches again instead of storing samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr

from nerg_mi.maths.elementary import quotient

from .quadrature import absorbed_share
from .rules import rule

LOG2 = 0.6931471805599453
# Least step as a share of the distance: four spacings of single precision.
_SPACING = 2.0**-21
# Optical depth that counts as a first trace of matter.
_TRACE = 1e-3


@dataclass(frozen=True)
class MarchSettings:
    """Controls of a march; lengths in scene units. The defaults are those of the integrator ``nerg``.

    ``step``: step length; ``dt_gamma``: steps are at least this share of the distance
    travelled (instant-ngp's cone stepping; 0: uniform); ``stop``: transmittance below which
    what lies behind is left out; ``color_cutoff``: samples are gathered until they weigh this much,
    and share the last one's colour;
    ``quadrature``: see ``rules``; ``coarse``: steps in front of all matter are this many times longer
    (``fine_start`` finds where it begins; 1: one step length everywhere); ``cell_step``: longest step of ``cells``,
    whose steps otherwise end at voxel boundaries only (``step``, ``dt_gamma``, ``coarse`` and a first step's
    ``offset`` do not apply to them).
    """

    step: float
    dt_gamma: float = 0.0
    stop: float = 1e-7
    color_cutoff: float = 1e-3
    quadrature: str = "constant"
    coarse: float = 1.0
    cell_step: float = math.inf

    @property
    def opaque(self) -> float:
        """Optical depth at which marching stops."""
        return -math.log(self.stop) if self.stop > 0 else math.inf


@dataclass
class MarchResult:
    """What a march gathered along each ray.

    ``tau``: optical depth; ``moment``: weighted sum of distances from ``origin`` on, the distance at
    which the march began (far from the ray's start, sums of whole distances would lose their last
    digits); ``half``: distance at which
    transmittance crosses 1/2 (infinite where it does not), or the optical depth ``until``;
    ``half_slope``: change of ``half`` with that optical depth, detached; ``enter``, ``enter_tau``: start
    of the step that crosses, and the optical depth there; ``color``: weighted sum of
    colours (None when no colour was asked for); ``density_evals``, ``color_evals``: evaluations made
    (None unless counted).
    """

    tau: object
    moment: object
    half: object
    half_slope: object
    enter: object
    enter_tau: object
    color: object = None
    density_evals: object = None
    color_evals: object = None
    origin: object = 0

    @property
    def opacity(self):
        return absorbed_share(self.tau)

    @property
    def expected_depth(self):
        """Mean distance of absorption, 0 where nothing absorbs."""
        alpha = self.opacity
        some = alpha > 0
        return dr.select(some, self.origin + quotient(self.moment, dr.select(some, alpha, 1)), 0)


def march(
    medium,
    ray,
    t0,
    t1,
    active,
    settings: MarchSettings,
    *,
    offset=None,
    color=None,
    count: bool = False,
    until=None,
    fine_from=None,
) -> MarchResult:
    """March ``ray`` (``media.protocol.LocalRay``) from ``t0`` to ``t1``.

    ``offset`` in [0, 1]: length of the first step as a share of a full one (jitter; None: a full
    step). ``color``: array type of the medium's colour, or a function of one's entry that makes it; None for a
    density-only pass. ``until``: optical depth at which to end, for a march that only looks for that crossing.
    ``count``: count evaluations. ``fine_from``: distance up to which steps are coarse. Differentiable in the ray,
    ``t0``, ``t1``, ``until`` and the medium's parameters.
    """
    from .adjoint import attached, differentiable_march

    Float = type(ray.t_near)
    active = dr.mask_t(Float)(active) & (t0 < t1)
    arguments = (Float(t0), Float(t1), active, settings, offset, color, count, until, fine_from)
    if attached(medium, ray, t0, t1):
        result = differentiable_march(medium, ray, *arguments)
    else:
        result = march_primal(medium, ray, *arguments)
    result.origin = arguments[0]
    if until is not None and dr.grad_enabled(until):
        crossed = dr.isfinite(result.half)
        result.half = dr.select(crossed, dr.fma(result.half_slope, until - dr.detach(until), result.half), result.half)
    return result


def march_primal(medium, ray, t0, t1, active, settings, offset, color, count, until, fine_from) -> MarchResult:
    """The march itself, without derivatives."""
    Float = type(t0)
    goal, end = limits(Float, settings, until)

    # The loops are functional rather than @dr.syntax: what they close over (fields, settings) stays
    # out of the loop state, where a field's weight arrays would be carried along lane by lane.
    quadrature = rule(settings.quadrature, medium)

    def body(active, t, share, carry, lost, tau, moment, half, slope, enter, enter_tau, total, pending, n, m):
        active, t, delta, t_next = advance(medium, ray, t, t1, share, settings, active, quadrature.planes, fine_from)
        step = quadrature.step(medium, ray, t, delta, t_next, carry, active, color)
        weight = dr.exp(-tau) * absorbed_share(step.dtau)
        moment, lost_moment = add(moment, lost[1], weight * dr.fma(delta, step.share, t - t0))
        # The sum that the next step starts from: a goal between it and a plain sum would be crossed by no step.
        after, lost_tau = add(tau, lost[0], step.dtau)
        crosses = active & (tau < goal) & (after >= goal)
        half = dr.select(crosses, t + step.crossing(goal - tau), half)
        slope = dr.select(crosses, delta / dr.select(crosses, step.dtau, 1), slope)
        enter, enter_tau = dr.select(crosses, t, enter), dr.select(crosses, tau, enter_tau)

        if color is not None:
            pending = pending + weight
            lit = active & (pending > settings.color_cutoff)
            total = total + pending * dr.if_stmt((lit,), lit, step.color, lambda lit: color(0), label="colour")
            pending = dr.select(lit, 0, pending)
            if count:
                m = m + dr.select(lit, 1, 0)
        if count:
            n = n + step.evals

        tau = after
        active = active & (t_next < t1) & (tau < end)
        return (
            active,
            t_next,
            Float(1),
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
        )

    start = (
        active,
        t0,
        Float(1 if offset is None else offset),
        quadrature.start(Float),
        (Float(0), Float(0)),
        Float(0),
        Float(0),
        Float(dr.inf),
        Float(0),
        Float(0),
        Float(0),
        None if color is None else color(0),
        None if color is None else Float(0),
        Float(0) if count else None,
        Float(0) if count and color is not None else None,
    )
    state = dr.while_loop(start, lambda active, *_: active, body, label="march")
    *sums, total, pending, n, m = state[5:]
    if color is not None:
        # What never gathered enough weight for a colour of its own takes that of the rest.
        painted = absorbed_share(sums[0]) - pending
        total *= dr.select(painted > 0, 1 + pending / dr.select(painted > 0, painted, 1), 0)
    return MarchResult(*sums, total, n, m)


def add(total, lost, term):
    """``(total + term, lost)`` with the rounding of the sum carried along (Kahan 1965).

    A thousand plain additions lose two digits, and the derivative of a depth divides what is lost by the opacity.
    """
    term = term - lost
    after = total + term
    return after, (after - total) - term


def limits(Float, settings: MarchSettings, until):
    """Optical depths ``(goal, end)``: whose crossing is looked for, and at which marching ends."""
    if until is None:
        return Float(LOG2), Float(settings.opaque)
    goal = Float(dr.detach(until))
    return goal, dr.minimum(goal, settings.opaque)


def fine_start(medium, ray, t0, t1, active, settings: MarchSettings):
    """Distance from which matter must be marched finely, and the density evaluations that finding it took.

    A coarse density-only march looks for the first trace of matter. What is thinner than a coarse step may be missed.
    """
    scout = replace(settings, step=settings.step * settings.coarse, coarse=1.0, quadrature="constant")
    with dr.suspend_grad():
        found = march(medium, ray, t0, t1, active, scout, until=_TRACE, count=True)
        return dr.select(dr.isfinite(found.half), found.enter - scout.step, dr.inf), found.density_evals


def scouted_march(medium, ray, t0, t1, active, settings: MarchSettings, **options) -> MarchResult:
    """``march`` with coarse steps in front of all matter, where ``settings.coarse`` asks for them."""
    if settings.coarse <= 1:
        return march(medium, ray, t0, t1, active, settings, **options)
    fine_from, scouted = fine_start(medium, ray, t0, t1, active, settings)
    result = march(medium, ray, t0, t1, active, settings, fine_from=fine_from, **options)
    if result.density_evals is not None:
        result.density_evals = result.density_evals + scouted
    return result


def advance(medium, ray, t, t1, share, settings, active, planes=None, fine_from=None):
    """The next step to evaluate: ``(active, t, delta, t_next)``, from ``t`` on, ``delta`` long.

    ``planes`` (``cells.VoxelCells``): end the step where the ray leaves a voxel instead.
    """
    if planes is not None:
        # Empty cells are left by strides that are too short to pass over any matter beside them.
        stride = min(settings.step, 0.5 * planes.edge, settings.cell_step)
        settings, fine_from = replace(settings, step=stride, dt_gamma=0.0), None
    if medium.occupancy is not None:
        t, share = _leap(medium, ray, t, t1, share, settings, active, fine_from)
        active = active & (t < t1)
    if planes is None:
        t_next = t + step_length(t, settings, fine_from) * share
    else:
        # Rounding may put a boundary that has just been reached before t: a march must still go on.
        least = t + dr.maximum(t * _SPACING, settings.step * _SPACING)
        t_next = dr.maximum(dr.minimum(planes.next_boundary(ray, t), t + settings.cell_step), least)
    # The last step ends at the exit.
    t_next = dr.minimum(t_next, t1)
    # What a step covers is what t moves by, rounding included, so that steps leave no gap and no overlap.
    return active, t, t_next - t, t_next


def step_length(t, settings: MarchSettings, fine_from=None):
    """Length of the step that starts at ``t``."""
    # A step must move t: it is at least a few spacings of the floats around it.
    step = dr.maximum(t * max(settings.dt_gamma, _SPACING), settings.step)
    if fine_from is None:
        return step
    return dr.select(t + step * settings.coarse <= fine_from, step * settings.coarse, step)


def _leap(medium, ray, t, t1, share, settings, active, fine_from):
    """Advance ``t`` by whole steps to the first whose midpoint lies in an occupied cell."""
    grid = medium.occupancy
    o, d = medium.to_unit(ray.o), medium.vector_to_unit(ray.d)

    def body(seeking, t, share):
        full = step_length(t, settings, fine_from)
        step = full * share
        middle = t + 0.5 * dr.minimum(step, t1 - t)
        u = o + d * middle
        k = grid.empty_cells(u, seeking)
        # The cells at chessboard distance < k around this one are empty: a box of 2k - 1 cells.
        reach = type(t)(k) - 1
        gap = type(t)(dr.inf)
        for uc, dc, cells in zip((u.x, u.y, u.z), (d.x, d.y, d.z), grid.cells):
            low = dr.floor(uc * cells) - reach
            wall = dr.select(dc > 0, low + 2 * reach + 1, low) - uc * cells
            gap = dr.minimum(gap, dr.select(dc != 0, wall / dr.select(dc != 0, dc * cells, 1), dr.inf))
        # Every step whose midpoint is certainly in that box is passed over. The next one's midpoint is
        # half a step beyond this step's end; at least this step itself is passed.
        whole = dr.maximum(dr.floor((middle + gap - t - step) / full + 0.5), 0)
        jump = seeking & (k > 0)
        landing = t + step + whole * full
        if fine_from is not None:
            # Coarse steps end where fine ones begin.
            landing = dr.select(t < fine_from, dr.minimum(landing, dr.maximum(fine_from, t + step)), landing)
        t = dr.select(jump, landing, t)
        share = dr.select(jump, 1, share)
        return jump & (t < t1), t, share

    _, t, share = dr.while_loop((active, t, share), lambda seeking, *_: seeking, body, label="leap")
    return t, share
