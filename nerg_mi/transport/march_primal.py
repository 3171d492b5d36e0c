"""The march through a medium forwards: settings, steps, optical depth and moments, hits and occlusion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from nerg_mi.maths.arrays import log1p, quotient
from nerg_mi.maths.types import Bool, Color, Float, UInt32

from .medium import Hits, LastHit, LocalRay, Medium, Occupancy, Painter, VoxelCells
from .quadrature import RULES, absorbed_fraction, boundaries

if TYPE_CHECKING:
    from typing_extensions import Self

# ---- Occlusion ----
#
# Whether a surface lies before a distance: a question that a march can answer before its end.
#
# An observer's ray towards a point has answered as soon as it has come to the point through almost nothing, or has met
# as much as makes a surface well before it. What follows, the surface itself in most cases, cannot change the answer:
# it is not evaluated.

_HALF = math.log(2)


@dataclass(frozen=True)
class Occlusion:
    """Asked of a ray: does its surface lie before ``before``, or even before ``hides`` (distances in scene units)?

    For depths at which half of a ray's own opacity is reached, where a surface takes ``surface_opacity``. Both answers
    are exact: a ray that has absorbed less than half of that opacity has not reached half of what makes it a surface;
    where transmittance 1/2 is passed, half of all that may still be absorbed lies behind.
    """

    before: Float
    hides: Float
    surface_opacity: float

    def clear(self, t: Float, tau: Float) -> Bool:
        """Whether nothing before ``before`` can be the surface, with the optical depth ``tau`` up to ``t``."""
        return (t >= self.before) & (tau < _optical_depth(0.5 * self.surface_opacity))

    def hidden(self, t: Float, tau: Float) -> Bool:
        """Whether the surface lies before ``hides``, with the optical depth ``tau`` up to ``t``."""
        return (t < self.hides) & (tau > max(_HALF, _optical_depth(self.surface_opacity)))


def _optical_depth(opacity: float) -> float:
    return -math.log1p(-opacity) if opacity < 1 else math.inf


# ---- What controls a march, and what it returns ----

DEFAULT_HITS_STOP = 1e-4
"""Transmittance at which the rasteriser of Gaussian splats stops (Kerbl et al. 2023)."""


@dataclass(frozen=True)
class MarchSettings:
    """Controls of a march; lengths in scene units. The defaults are those of the integrator ``nerg``."""

    # Length of a step.
    step: float
    # Steps are at least this share of the distance travelled (instant-ngp's cone stepping); 0: uniform steps.
    dt_gamma: float = 0.0
    # Transmittance below which what lies behind is left out.
    stop: float = 1e-7
    # Samples are gathered until they weigh this much, and share the last one's colour.
    color_cutoff: float = 1e-3
    # Name of the quadrature rule, one of `quadrature.RULES`.
    quadrature: str = "constant"
    # Steps in front of all matter are this many times longer; 1: one step length everywhere.
    coarse: float = 1.0
    # Whether the occupancy's finer form is made use of, where it has one.
    refined: bool = True
    # Longest step of a rule whose steps end at voxel boundaries, to which `step`, `dt_gamma`, `coarse` and the length
    # of the first step do not apply.
    cell_step: float = math.inf

    @property
    def opaque(self) -> float:
        """Optical depth at which marching stops."""
        return -math.log(self.stop) if self.stop > 0 else math.inf


def default_step(medium: Medium | None) -> float:
    """Step in scene units where none is asked for: the medium's own, or a 1024th of its diagonal. 1 without a
    medium, where nothing is marched."""
    if medium is None:
        return 1.0
    return medium.default_step or medium.length_scale / 1024


def default_growth(medium: Medium | None) -> float:
    """Growth of steps with distance (`MarchSettings.dt_gamma`) where none is asked for: what suits the medium."""
    return MarchSettings.dt_gamma if medium is None else medium.default_dt_gamma


def default_stop(medium: Medium | None) -> float:
    """`MarchSettings.stop` where none is asked for: of a medium of hits what its renderers and trainings stop at."""
    return MarchSettings.stop if medium is None or medium.hits is None else DEFAULT_HITS_STOP


def add(total: Float, lost: Float, term: Float) -> tuple[Float, Float]:
    """``(total + term, lost)`` with the rounding of the sum carried along (Kahan 1965).

    A thousand plain additions lose two digits, and the derivative of a depth divides what is lost by the opacity.
    """
    term = term - lost
    after = total + term
    return after, (after - total) - term


@dataclass(kw_only=True)
class MarchSums:
    """What matter along a ray adds up to, up to some point of it; rounding is carried along (`add`)."""

    # Optical depth.
    tau: Float
    # Sum of the distances of absorption from where the march began, weighted by what is absorbed: far from the ray's
    # start, sums of whole distances would lose their last digits.
    moment: Float
    # What rounding took from both.
    lost_tau: Float
    lost_moment: Float

    def absorb(
        self, active: Bool, dtau: Float, absorbed: Float, distance: Float, goal: Float
    ) -> tuple[Self, Float, Bool]:
        """``(sums, weight, crosses)`` behind matter of optical depth ``dtau``, which absorbs the share ``absorbed`` of
        the light that arrives, at the mean ``distance`` from where the march began (0 both where not ``active``).

        ``weight``: share of the ray's light that it absorbs; ``crosses``: where the optical depth ``goal`` is reached
        in it.
        """
        weight = dr.exp(-self.tau) * absorbed
        moment, lost_moment = add(self.moment, self.lost_moment, weight * distance)
        # The sum that the next step starts from: a goal between it and a plain sum would be crossed by no step.
        tau, lost_tau = add(self.tau, self.lost_tau, dtau)
        after = replace(self, tau=tau, moment=moment, lost_tau=lost_tau, lost_moment=lost_moment)
        return after, weight, active & (self.tau < goal) & (tau >= goal)


def nothing_absorbed(Float: type) -> dict[str, Any]:
    """The fields of `MarchSums` where a march begins."""
    return {name: Float(0) for name in ("tau", "moment", "lost_tau", "lost_moment")}


@dataclass(kw_only=True)
class MarchResult(MarchSums):
    """What a march gathered along each ray. Distances are in scene units, from the ray's start."""

    # Distance at which transmittance crosses 1/2, or optical depth the one asked for; infinite where it does not.
    half: Float
    # Change of `half` with that optical depth. Carries no derivatives.
    half_slope: Float
    # Start of the step that crosses, and the optical depth there. They carry no derivatives.
    enter: Float
    enter_tau: Float
    # Sum of colours, weighted by what is absorbed; None when no colour was asked for.
    color: Color = None
    # Evaluations made; None unless counted.
    density_evals: Float | None = None
    color_evals: Float | None = None
    # Where the march ended early, because what was asked of it (``occlusion``) is known; None: nowhere.
    known: Bool | None = None
    # Distance at which the march began.
    origin: Float | float = 0

    def cross(self, crosses: Bool, half: Float, slope: Float, enter: Float, enter_tau: Float) -> None:
        """Note where the optical depth that is looked for is reached, on the rays that cross it."""
        self.half = dr.select(crosses, half, self.half)
        self.half_slope = dr.select(crosses, slope, self.half_slope)
        self.enter = dr.select(crosses, enter, self.enter)
        self.enter_tau = dr.select(crosses, enter_tau, self.enter_tau)

    def settle(self, answered: Bool, active: Bool) -> Bool:
        """Note on which of the ``active`` rays the question of occlusion is ``answered``; the rays that go on."""
        answered = active & answered
        self.known = answered if self.known is None else self.known | answered
        return active & ~answered

    def count_in(self, other: MarchResult) -> None:
        """Add the density evaluations of another march to this one's, if they are counted."""
        if self.density_evals is not None and other.density_evals is not None:
            self.density_evals = self.density_evals + other.density_evals

    @property
    def opacity(self) -> Float:
        """1 - transmittance."""
        return absorbed_fraction(self.tau)

    @property
    def expected_depth(self) -> Float:
        """Mean distance of absorption, 0 where nothing absorbs."""
        alpha = self.opacity
        some = alpha > 0
        return dr.select(some, self.origin + quotient(self.moment, dr.select(some, alpha, 1)), 0)


# ---- Stepping ----
#
# From step to step: where the next one begins and ends, and how empty space is passed over.


# Least step as a share of the distance: four spacings of single precision.
_SPACING = 2.0**-21


def advance(
    medium: Medium,
    ray: LocalRay,
    t: Float,
    t1: Float,
    share: Float,
    settings: MarchSettings,
    active: Bool,
    cells: VoxelCells | None = None,
    fine_from: Float | None = None,
) -> tuple[Bool, Float, Float, Float]:
    """The next step to evaluate from the distance ``t`` on: ``(active, t, delta, t_next)``, where it begins, how long
    it is and where it ends.

    ``t1``: where the march ends; ``share``: length of the step as a share of a full one; ``cells``: end it where the
    ray leaves a voxel instead; ``fine_from``: distance up to which steps are coarse. Always moves on.
    """
    if cells is not None:
        # Empty cells are left by strides that are too short to pass over any matter beside them.
        stride = min(settings.step, 0.5 * cells.edge, settings.cell_step)
        settings, fine_from = replace(settings, step=stride, dt_gamma=0.0), None
    grid = medium.occupancy
    if grid is not None:
        grid = grid if settings.refined else grid.coarse
        t, share = leap(medium, grid, ray, t, t1, share, settings, active, fine_from)
        active = active & (t < t1)
    if cells is None:
        t_next = t + step_length(t, settings, fine_from) * share
    else:
        # Rounding may put a boundary that has just been reached before t: a march must still go on.
        least = t + dr.maximum(t * _SPACING, settings.step * _SPACING)
        t_next = dr.maximum(dr.minimum(cells.next_boundary(ray, t), t + settings.cell_step), least)
    # The last step ends at the exit.
    t_next = dr.minimum(t_next, t1)
    # What a step covers is what t moves by, rounding included, so that steps leave no gap and no overlap.
    return active, t, t_next - t, t_next


def step_length(t: Float, settings: MarchSettings, fine_from: Float | None = None) -> Float:
    """Length of the step that starts at the distance ``t``; ``fine_from``: distance up to which steps are coarse."""
    # A step must move t: it is at least a few spacings of the floats around it.
    step = dr.maximum(t * max(settings.dt_gamma, _SPACING), settings.step)
    if fine_from is None:
        return step
    return dr.select(t + step * settings.coarse <= fine_from, step * settings.coarse, step)


def leap(
    medium: Medium,
    grid: Occupancy,
    ray: LocalRay,
    t: Float,
    t1: Float,
    share: Float,
    settings: MarchSettings,
    active: Bool,
    fine_from: Float | None,
) -> tuple[Float, Float]:
    """``(t, share)`` of the first step whose midpoint lies in an occupied cell, or from ``t1`` on: ``t`` advanced by
    whole steps, of which the first is ``share`` of a full one long. ``grid``: the medium's occupancy."""
    o, d = medium.to_unit(ray.o), medium.vector_to_unit(ray.d)

    def body(seeking, t, share):
        full = step_length(t, settings, fine_from)
        step = full * share
        middle = t + 0.5 * dr.minimum(step, t1 - t)
        u = o + d * middle
        k = grid.distance_to_occupied(u, seeking)
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


# ---- Primal ----
#
# The march itself: opacity, depth and colour along rays, without derivatives.
#
# Steps lie at midpoint-sampled constant density, or what another rule makes of them (``rules``); optical depth
# accumulates in log space, so that opacity is -expm1(-τ) to full precision however thin the medium. Steps whose
# midpoint lies in an empty cell of the medium's occupancy grid are leapt over without an evaluation; marching ends
# behind opaque surfaces.

LOG2 = 0.6931471805599453


@dataclass
class MarchRequest:
    """What is asked of a march along any ray: the arguments of ``march.march``."""

    medium: Medium
    active: Bool
    settings: MarchSettings
    offset: Float | None
    color: Painter | None
    count: bool
    until: Float | float | None
    fine_from: Float | None
    occlusion: Occlusion | None

    def start(self, Float: type) -> MarchResult:
        """Of a march that has not met anything; ``Float``: array type of distances."""
        counted = self.count and self.color is not None
        return MarchResult(
            **nothing_absorbed(Float),
            half=Float(dr.inf),
            half_slope=Float(0),
            enter=Float(0),
            enter_tau=Float(0),
            color=None if self.color is None else self.color.zero(),
            density_evals=Float(0) if self.count else None,
            color_evals=Float(0) if counted else None,
            known=None if self.occlusion is None else dr.mask_t(Float)(False),
        )


@dataclass
class _StepState:
    """Where a march in steps is."""

    active: Bool
    t: Float
    # Length of the next step as a share of a full one; None: always 1.
    share: Float | None
    # What the next step reuses of the last one.
    carry: Any
    # Weight of the samples that have no colour yet; None without colour.
    pending: Any
    found: MarchResult


def march_primal(ray: LocalRay, t0: Float, t1: Float, request: MarchRequest) -> MarchResult:
    """March ``ray`` in steps from ``t0`` to ``t1``."""
    Float, medium, settings = type(t0), request.medium, request.settings
    color, fine_from, occlusion = request.color, request.fine_from, request.occlusion
    goal, end = limits(Float, settings, request.until)

    # The loops are functional rather than @dr.syntax: what they close over (fields, settings) stays
    # out of the loop state, where a field's weight arrays would be carried along lane by lane.
    quadrature = RULES.find(settings.quadrature)
    cells = boundaries(quadrature, medium)

    def body(state: _StepState) -> tuple[_StepState]:
        share = Float(1) if state.share is None else state.share
        active, t, delta, t_next = advance(medium, ray, state.t, t1, share, settings, state.active, cells, fine_from)
        found, tau, pending = replace(state.found), state.found.tau, state.pending
        if occlusion is not None:
            active = found.settle(occlusion.clear(t, tau), active)
        step = quadrature.step(medium, ray, t, delta, t_next, state.carry, active, color is not None)
        distance = dr.fma(delta, step.share, t - t0)
        found, weight, crosses = found.absorb(active, step.dtau, absorbed_fraction(step.dtau), distance, goal)
        slope = delta / dr.select(crosses, step.dtau, 1)
        found.cross(crosses, t + step.crossing(goal - tau), slope, t, tau)
        if color is not None:
            painter = color
            pending = pending + weight
            lit = active & (pending > settings.color_cutoff)
            shown = dr.if_stmt(
                (lit,), lit, lambda lit: step.paint(painter, lit), lambda lit: painter.zero(), label="colour"
            )
            found.color = found.color + pending * shown
            pending = dr.select(lit, 0, pending)
            if found.color_evals is not None:
                found.color_evals = found.color_evals + dr.select(lit, 1, 0)
        if found.density_evals is not None:
            found.density_evals = found.density_evals + step.evals
        if occlusion is not None:
            active = found.settle(occlusion.hidden(t_next, found.tau), active)
        active = active & (t_next < t1) & (found.tau < end)
        return (_StepState(active, t_next, None if state.share is None else Float(1), step.carry, pending, found),)

    start = _StepState(
        request.active,
        t0,
        # A state that never changes would have the loop recorded twice.
        None if request.offset is None else Float(request.offset),
        quadrature.start(Float),
        None if color is None else Float(0),
        request.start(Float),
    )
    (state,) = dr.while_loop((start,), lambda state: state.active, body, label="march")
    found = state.found
    if color is not None:
        # What never gathered enough weight for a colour of its own takes that of the rest.
        painted = absorbed_fraction(found.tau) - state.pending
        found.color *= dr.select(painted > 0, 1 + state.pending / dr.select(painted > 0, painted, 1), 0)
    return found


def limits(Float: type, settings: MarchSettings, until: Float | float | None) -> tuple[Float, Float]:
    """Optical depths ``(goal, end)``: whose crossing is looked for, and at which marching ends. ``Float``: array type
    of distances."""
    if until is None:
        return Float(LOG2), Float(settings.opaque)
    goal = Float(dr.detach(until))
    return goal, dr.minimum(goal, settings.opaque)


# ---- Hits ----
#
# The march through a medium whose things are met one by one: from hit to hit, in their order.
#
# A hit that absorbs the share α adds -ln(1 - α) of optical depth at its distance, all at once; the sums are those of
# ``primal``, with hits for steps. Half of the light is gone at the hit that takes it, so that a median needs no
# crossing.


@dataclass
class _Hits:
    """Which hits of a group are still to be met."""

    active: Bool
    t: list[Float]
    absorbed: list[Float]
    index: list[UInt32]
    found: MarchResult


def first_hit(t0: Float) -> LastHit:
    """Behind which the first hits are looked for: one may lie at ``t0`` itself."""
    UInt32: Any = dr.uint32_array_t(type(t0))
    return LastHit(dr.fma(dr.abs(t0), -(2.0**-22), t0 - 1e-37), UInt32(0))


def march_hits(ray: LocalRay, t0: Float, t1: Float, request: MarchRequest) -> MarchResult:
    """What ``ray`` meets of the medium's hits from the distance ``t0`` on and before ``t1``; without derivatives."""
    Float, medium, color, occlusion = type(t0), request.medium, request.color, request.occlusion
    UInt32: Any = dr.uint32_array_t(Float)
    goal, end = limits(Float, request.settings, request.until)
    hits, stop = cast("Hits", medium.hits), dr.exp(-end)

    def take(state: _Hits) -> tuple[_Hits]:
        """The first of the hits; the others move up."""
        active, found, t, index = state.active, replace(state.found), state.t[0], state.index[0]
        tau = found.tau
        if occlusion is not None:
            active = found.settle(occlusion.clear(t, tau), active)
        absorbed = dr.select(active, state.absorbed[0], 0)
        found, weight, crosses = found.absorb(active, -log1p(-absorbed), absorbed, t - t0, goal)
        found.cross(crosses, t, Float(0), t, tau)
        if color is not None:
            painter, lit = color, active & (weight > 0)
            found.color = found.color + weight * dr.if_stmt(
                (lit, index),
                lit,
                lambda lit, index: painter.shade(medium, [cast("Float", index)], ray.o + ray.d * t, ray.w, lit),
                lambda lit, index: painter.zero(),
                label="colour",
            )
            if found.color_evals is not None:
                found.color_evals = found.color_evals + dr.select(lit, 1, 0)
        if occlusion is not None:
            active = found.settle(occlusion.hidden(t, found.tau), active)
        rest = state.t[1:] + [Float(dr.inf)], state.absorbed[1:] + [Float(0)], state.index[1:] + [UInt32(0)]
        return (_Hits(active & (found.tau < end) & (rest[0][0] < dr.inf), *rest, found),)

    def group(active: Bool, last: LastHit, found: MarchResult) -> tuple[Bool, LastHit, MarchResult]:
        """The next hits, as many as are found at once."""
        near, found = hits.find_next(ray, last, t1, dr.exp(-found.tau), stop, active), replace(found)
        if found.density_evals is not None:
            found.density_evals = found.density_evals + near.evals
        farthest = LastHit(near.t[-1], near.index[-1])
        start = _Hits(active & (near.t[0] < dr.inf), near.t, near.absorbed, near.index, found)
        (state,) = dr.while_loop((start,), lambda state: state.active, take, label="hits")
        found = state.found
        active = active & (farthest.t < dr.inf) & (found.tau < end)
        return active if found.known is None else active & ~found.known, farthest, found

    start = request.active, first_hit(t0), request.start(Float)
    return dr.while_loop(start, lambda active, *_: active, group, label="groups of hits")[2]
