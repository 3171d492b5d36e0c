"""The primal march through a medium: settings, steps, optical depth and moments, discrete hits, and occlusion
queries."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr

from nerg_mi.maths.arrays import kahan_add, log1p, quotient
from nerg_mi.maths.types import Bool, Color, Float, UInt32

from .medium import Hits, LastHit, LocalRay, Medium, Occupancy, SampleShader, VoxelCells
from .quadrature import RULES, QuadratureRule, absorbed_fraction, cells_for_rule, shade_point

if TYPE_CHECKING:
    from typing_extensions import Self

# ---- Occlusion ----
#
# Whether a surface lies in front of a given distance: a query that a march can often answer before its end.
#
# A ray from the observer towards a point is decided as soon as it reaches the point with almost no absorption, or
# absorbs enough for a surface well in front of the point. What follows, in most cases the surface itself, cannot change
# the answer and is not evaluated.

_HALF = math.log(2)


@dataclass(frozen=True)
class OcclusionQuery:
    """Occlusion query of a ray: is there a surface in front of ``clear_distance``, or even in front of
    ``hidden_distance``?

    Distances are in scene units. The query applies to depths at which half of a ray's opacity is reached, for surfaces
    of at least ``surface_opacity``. Both answers are exact: a ray that has absorbed less than half of
    ``surface_opacity`` has not reached half of the opacity of a surface; once the transmittance is below 1/2, half of
    all further absorption lies behind.
    """

    clear_distance: Float
    hidden_distance: Float
    surface_opacity: float

    def is_clear(self, t: Float, tau: Float) -> Bool:
        """Whether no surface lies in front of ``clear_distance``, given the optical depth ``tau`` up to the distance
        ``t``."""
        return (t >= self.clear_distance) & (tau < _optical_depth(0.5 * self.surface_opacity))

    def is_hidden(self, t: Float, tau: Float) -> Bool:
        """Whether a surface lies in front of ``hidden_distance``, given the optical depth ``tau`` up to the distance
        ``t``."""
        return (t < self.hidden_distance) & (tau > max(_HALF, _optical_depth(self.surface_opacity)))


def _optical_depth(opacity: float) -> float:
    return -math.log1p(-opacity) if opacity < 1 else math.inf


# ---- Settings and result of a march ----

DEFAULT_HITS_STOP = 1e-4
"""Transmittance at which the rasteriser of Gaussian splats stops (Kerbl et al. 2023)."""


SEPARATE_COLOR_CUTOFF = 0.1
"""Default colour cut-off of a medium whose density takes much less time than its colour: a compiled field."""


@dataclass(frozen=True)
class MarchSettings:
    """Settings of a march; lengths in scene units. The defaults are those of the integrator ``nerg``."""

    # Step length.
    step: float
    # Minimum step as a fraction of the distance travelled (cone stepping of instant-ngp); 0: uniform steps.
    dt_gamma: float = 0.0
    # Transmittance below which the march ends.
    stop: float = 1e-7
    # Samples are gathered until their weight exceeds this value; the last one's colour then stands for all of them.
    color_cutoff: float = 1e-3
    # Name of the quadrature rule, one of `quadrature.RULES`.
    quadrature: str = "constant"
    # Factor by which steps in front of all matter are longer; 1: no pre-pass.
    coarse: float = 1.0
    # Whether the refined occupancy grid is used, if the medium has one.
    refined: bool = True
    # Maximum step of a rule whose steps end at voxel boundaries. `step`, `dt_gamma`, `coarse` and the length of the
    # first step do not apply to such a rule.
    cell_step: float = math.inf

    @property
    def max_optical_depth(self) -> float:
        """Optical depth at which the march ends."""
        return -math.log(self.stop) if self.stop > 0 else math.inf


def default_step(medium: Medium | None) -> float:
    """Default step length in scene units: the medium's own, or 1/1024 of its diagonal; 1 without a medium."""
    if medium is None:
        return 1.0
    return medium.default_step or medium.length_scale / 1024


def default_dt_gamma(medium: Medium | None) -> float:
    """Default of `MarchSettings.dt_gamma`: the medium's own."""
    return MarchSettings.dt_gamma if medium is None else medium.default_dt_gamma


def default_stop(medium: Medium | None) -> float:
    """Default of `MarchSettings.stop`; media of discrete hits use the value of 3DGS renderers and trainers."""
    return MarchSettings.stop if medium is None or medium.hits is None else DEFAULT_HITS_STOP


def default_color_cutoff(medium: Medium | None) -> float:
    """Default of `MarchSettings.color_cutoff`: higher for a medium whose colour takes most of the time."""
    return SEPARATE_COLOR_CUTOFF if medium is not None and medium.is_density_separate else MarchSettings.color_cutoff


@dataclass(kw_only=True)
class MarchSums:
    """Sums over the matter along a ray up to the current point, with compensated rounding errors (`kahan_add`)."""

    # Optical depth.
    tau: Float
    # Sum of the absorption distances, weighted by the absorbed fraction. Distances are measured from the start of the
    # march: far from the origin of the ray, sums of full distances would lose their last digits.
    moment: Float
    # Compensations of both sums.
    tau_compensation: Float
    moment_compensation: Float

    def absorb(
        self, active: Bool, dtau: Float, absorbed: Float, distance: Float, goal: Float
    ) -> tuple[Self, Float, Bool]:
        """Add matter of optical depth ``dtau`` and return ``(sums, weight, crosses)``.

        Parameters
        ----------
        absorbed : Float
            Fraction of the arriving light that the matter absorbs; 0 on inactive lanes.
        distance : Float
            Mean distance of that absorption from the start of the march; 0 on inactive lanes.
        goal : Float
            Optical depth whose crossing is searched for.

        Returns
        -------
        weight : Float
            Fraction of the ray's light that the matter absorbs.
        crosses : Bool
            Whether ``goal`` is reached in it.
        """
        weight = dr.exp(-self.tau) * absorbed
        moment, moment_compensation = kahan_add(self.moment, self.moment_compensation, weight * distance)
        # Compare with the sum that the next step starts from: a goal between it and a plain sum would be crossed by no
        # step.
        tau, tau_compensation = kahan_add(self.tau, self.tau_compensation, dtau)
        after = replace(
            self, tau=tau, moment=moment, tau_compensation=tau_compensation, moment_compensation=moment_compensation
        )
        return after, weight, active & (self.tau < goal) & (tau >= goal)


def zero_sums(Float: type) -> dict[str, Any]:
    """The fields of `MarchSums` at the start of a march."""
    return {name: Float(0) for name in ("tau", "moment", "tau_compensation", "moment_compensation")}


@dataclass(kw_only=True)
class MarchResult(MarchSums):
    """The result of a march, per ray. Distances are in scene units, measured from the origin of the ray."""

    # Distance at which the transmittance falls below 1/2, or at which the requested optical depth is reached; infinite
    # if it is not reached.
    median_depth: Float
    # Derivative of `median_depth` with respect to that optical depth; detached.
    median_depth_slope: Float
    # Start of the step with the crossing, and the optical depth there; detached.
    crossing_start: Float
    crossing_start_tau: Float
    # Sum of the colours, weighted by the absorbed fraction; None without a shader.
    color: Color = None
    # Numbers of evaluations; None unless counted.
    density_evals: Float | None = None
    color_evals: Float | None = None
    # Rays on which the march ended early because the occlusion query was decided; None without a query.
    decided: Bool | None = None
    # Distance at which the march began.
    start_distance: Float | float = 0

    def record_crossing(
        self, crosses: Bool, half: Float, slope: Float, enter: Float, crossing_start_tau: Float
    ) -> None:
        """Record where the searched optical depth is reached, on the rays that reach it."""
        self.median_depth = dr.select(crosses, half, self.median_depth)
        self.median_depth_slope = dr.select(crosses, slope, self.median_depth_slope)
        self.crossing_start = dr.select(crosses, enter, self.crossing_start)
        self.crossing_start_tau = dr.select(crosses, crossing_start_tau, self.crossing_start_tau)

    def record_decided(self, answered: Bool, active: Bool) -> Bool:
        """Record on which ``active`` rays the occlusion query is decided, and return the rays that continue."""
        answered = active & answered
        self.decided = answered if self.decided is None else self.decided | answered
        return active & ~answered

    def add_evaluations(self, other: MarchResult) -> None:
        """Add the density evaluations of another march, if they are counted."""
        if self.density_evals is not None and other.density_evals is not None:
            self.density_evals = self.density_evals + other.density_evals

    @property
    def opacity(self) -> Float:
        """1 - transmittance."""
        return absorbed_fraction(self.tau)

    @property
    def expected_depth(self) -> Float:
        """Mean distance of absorption; 0 without absorption."""
        alpha = self.opacity
        some = alpha > 0
        return dr.select(some, self.start_distance + quotient(self.moment, dr.select(some, alpha, 1)), 0)


# ---- Stepping ----
#
# Begin and end of the next step, and the skipping of empty space.


# Minimum step as a fraction of the distance: four spacings of single precision.
_SPACING = 2.0**-21


def next_step(
    medium: Medium,
    ray: LocalRay,
    t: Float,
    t1: Float,
    fraction: Float,
    settings: MarchSettings,
    active: Bool,
    cells: VoxelCells | None = None,
    fine_from: Float | None = None,
) -> tuple[Bool, Float, Float, Float]:
    """The next step at or behind the distance ``t``: ``(active, t, delta, t_next)``, i.e. its start, length and end.

    Parameters
    ----------
    t1 : Float
        End of the march.
    fraction : Float
        Length of the step as a fraction of a full one.
    cells : VoxelCells, optional
        End the step where the ray leaves a voxel.
    fine_from : Float, optional
        Distance up to which steps are coarse.

    Notes
    -----
    `t_next` always exceeds ``t``.
    """
    if cells is not None:
        # Strides through empty cells are short enough not to pass over matter in a neighbouring cell.
        stride = min(settings.step, 0.5 * cells.min_edge, settings.cell_step)
        settings, fine_from = replace(settings, step=stride, dt_gamma=0.0), None
    grid = medium.occupancy
    if grid is not None:
        grid = grid if settings.refined else grid.coarse
        t, fraction = skip_empty_cells(medium, grid, ray, t, t1, fraction, settings, active, fine_from)
        active = active & (t < t1)
    if cells is None:
        t_next = t + step_length(t, settings, fine_from) * fraction
    else:
        # Rounding can place a boundary that was just reached in front of t; the march must still advance.
        min_t_next = t + dr.maximum(t * _SPACING, settings.step * _SPACING)
        t_next = dr.maximum(dr.minimum(cells.next_boundary(ray, t), t + settings.cell_step), min_t_next)
    # The last step ends at t1.
    t_next = dr.minimum(t_next, t1)
    # The length of a step is the rounded change of t, so that steps leave no gaps and no overlaps.
    return active, t, t_next - t, t_next


def step_length(t: Float, settings: MarchSettings, fine_from: Float | None = None) -> Float:
    """Length of the step that starts at the distance ``t``; ``fine_from``: distance up to which steps are coarse."""
    # A step must change t, so it spans at least a few floating-point spacings.
    step = dr.maximum(t * max(settings.dt_gamma, _SPACING), settings.step)
    if fine_from is None:
        return step
    return dr.select(t + step * settings.coarse <= fine_from, step * settings.coarse, step)


def skip_empty_cells(
    medium: Medium,
    grid: Occupancy,
    ray: LocalRay,
    t: Float,
    t1: Float,
    fraction: Float,
    settings: MarchSettings,
    active: Bool,
    fine_from: Float | None,
) -> tuple[Float, Float]:
    """Skip whole steps whose midpoints lie in empty cells of ``grid``, the occupancy of the medium.

    Returns
    -------
    t : Float
        Start of the first step whose midpoint lies in an occupied cell, or a distance of at least ``t1``.
    fraction : Float
        Length of that step as a fraction of a full one.
    """
    o, d = medium.to_unit(ray.o), medium.vector_to_unit(ray.d)
    # Cells per distance and their inverse along each axis: divisions would take most of the time of a skip.
    rates = [c * n for c, n in zip((d.x, d.y, d.z), grid.cells)]
    inverses = [dr.select(rate != 0, dr.rcp(dr.select(rate != 0, rate, 1)), 0) for rate in rates]

    def body(seeking, t, share):
        full = step_length(t, settings, fine_from)
        step = full * share
        middle = t + 0.5 * dr.minimum(step, t1 - t)
        u = o + d * middle
        k = grid.distance_to_occupied(u, seeking)
        # All cells at a chessboard distance below k are empty: a box of 2k - 1 cells.
        radius = type(t)(k) - 1
        gap = type(t)(dr.inf)
        for c, n, rate, inverse in zip((u.x, u.y, u.z), grid.cells, rates, inverses):
            low = dr.floor(c * n) - radius
            wall = dr.select(rate > 0, dr.fma(2, radius, low) + 1, low) - c * n
            gap = dr.minimum(gap, dr.select(rate != 0, wall * inverse, dr.inf))
        # Skip every step whose midpoint certainly lies in that box. The midpoint of the next step is half a step behind
        # the end of this one; at least this step is skipped.
        num_skipped = dr.maximum(dr.floor((middle + gap - t - step) / full + 0.5), 0)
        jump = seeking & (k > 0)
        landing = t + step + num_skipped * full
        if fine_from is not None:
            # Coarse steps end where fine ones begin.
            landing = dr.select(t < fine_from, dr.minimum(landing, dr.maximum(fine_from, t + step)), landing)
        t = dr.select(jump, landing, t)
        share = dr.select(jump, 1, share)
        return jump & (t < t1), t, share

    _, t, fraction = dr.while_loop((active, t, fraction), lambda seeking, *_: seeking, body, label="skip")
    return t, fraction


# ---- Primal march ----
#
# Opacity, depth and colour along rays, without derivatives.
#
# Optical depth accumulates in log space, so that the opacity -expm1(-τ) has full precision for any optical depth. Steps
# with their midpoint in an empty cell of the occupancy grid are skipped without an evaluation; the march ends behind
# opaque surfaces.

LOG2 = 0.6931471805599453


@dataclass
class MarchRequest:
    """The arguments of `march.march`, for all rays."""

    medium: Medium
    active: Bool
    settings: MarchSettings
    offset: Float | None
    color: SampleShader | None
    count: bool
    until: Float | float | None
    fine_from: Float | None
    occlusion: OcclusionQuery | None

    def init_result(self, Float: type) -> MarchResult:
        """The result of a march before its first step; ``Float``: array type of distances."""
        counted = self.count and self.color is not None
        return MarchResult(
            **zero_sums(Float),
            median_depth=Float(dr.inf),
            median_depth_slope=Float(0),
            crossing_start=Float(0),
            crossing_start_tau=Float(0),
            color=None if self.color is None else self.color.zero(),
            density_evals=Float(0) if self.count else None,
            color_evals=Float(0) if counted else None,
            decided=None if self.occlusion is None else dr.mask_t(Float)(False),
        )


@dataclass(kw_only=True)
class StepState:
    """Loop state of a march in steps, to which marches add what they sum up."""

    active: Bool
    # Start of the next step.
    t: Float
    # Its length as a fraction of a full one; None: always 1. A state variable that never changes would be traced twice.
    fraction: Float | None


@dataclass(frozen=True)
class Step:
    """Start, length and end of a step, with the rule and the voxels that it uses."""

    t: Float
    delta: Float
    t_next: Float
    quadrature: QuadratureRule


_StateT = TypeVar("_StateT", bound=StepState)


def march_steps(
    ray: LocalRay,
    t1: Float,
    request: MarchRequest,
    start: _StateT,
    visit: Callable[..., tuple[_StateT, Any]],
    extra: Any = None,
    label: str = "march",
) -> tuple[_StateT, Any]:
    """Loop over the steps of ``ray`` up to ``t1``, of the march and of its derivatives.

    Parameters
    ----------
    start : StepState
        State before the first step.
    visit : callable
        Processes a step: ``visit(state, step, extra)`` returns the state, on whose ``active`` lanes the march goes on,
        and ``extra``.
    extra : Any
        Further loop variables.
    """
    # Functional loops rather than @dr.syntax: variables of the closure (fields, settings) stay out of the loop state,
    # which would otherwise carry the weight arrays of a field.
    medium, settings = request.medium, request.settings
    quadrature = RULES.find(settings.quadrature)
    cells, one = cells_for_rule(quadrature, medium), type(t1)(1)

    def body(state: _StateT, extra: Any) -> tuple[_StateT, Any]:
        fraction = one if state.fraction is None else state.fraction
        active, t, delta, t_next = next_step(
            medium, ray, state.t, t1, fraction, settings, state.active, cells, request.fine_from
        )
        state, extra = visit(replace(state, active=active), Step(t, delta, t_next, quadrature), extra)
        fraction = None if state.fraction is None else one
        return replace(state, active=state.active & (t_next < t1), t=t_next, fraction=fraction), extra

    return dr.while_loop((start, extra), lambda state, _: state.active, body, label=label)


@dataclass(kw_only=True)
class _PrimalState(StepState):
    """Loop state of `march_primal`."""

    # What the next step reuses of the previous one.
    carry: Any
    # Weight of the samples that have not been shaded yet; None without a shader.
    pending: Any
    result: MarchResult
    # Samples to shade behind the march; None if each one is shaded in its step.
    deferred: Any


_MAX_DEFERRED = 9  # Samples of a ray that can be shaded behind the march


def count_deferred(medium: Medium, color_cutoff: float) -> int:
    """Maximum number of samples of a ray if they are shaded behind the march; 0 if each one is shaded in its step.

    Each sample but the last gathers a weight above ``color_cutoff``, and all weights add up to at most 1.
    """
    if not medium.is_density_separate or color_cutoff * (_MAX_DEFERRED + 1) < 1:
        return 0
    return math.ceil(1 / color_cutoff) - 1


@dataclass
class _DeferredSamples:
    """Samples of rays whose colour takes much more time than their density.

    Neighbouring rays reach their surfaces in different steps. Shaded in its step, a sample takes the time of a packet
    of samples; behind the march, the first samples of all rays are shaded together, then the second ones, and so on.
    """

    count: UInt32
    distance: list[Float]
    weight: list[Float]

    @staticmethod
    def zero(Float: type, size: int) -> _DeferredSamples:
        UInt32: Any = dr.uint32_array_t(Float)
        return _DeferredSamples(UInt32(0), [Float(0)] * size, [Float(0)] * size)

    def add(self, active: Bool, distance: Float, weight: Float) -> _DeferredSamples:
        """Add a sample to ``active`` rays."""
        here = [active & (self.count == k) for k in range(len(self.weight))]
        return _DeferredSamples(
            self.count + dr.select(active, 1, 0),
            [dr.select(now, distance, d) for now, d in zip(here, self.distance)],
            [dr.select(now, weight, w) for now, w in zip(here, self.weight)],
        )

    def shade(self, medium: Medium, ray: LocalRay, shader: SampleShader) -> Color:
        """Weighted sum of the contributions of all samples."""

        def body(k: UInt32, total: Color) -> tuple[UInt32, Color]:
            lit = k < self.count
            pick = lambda values: cast("Float", sum(dr.select(k == i, v, 0) for i, v in enumerate(values)))
            color = shade_point(medium, ray, pick(self.distance), shader, lit)
            return k + 1, total + dr.select(lit, pick(self.weight) * color, 0)

        first = dr.zeros(type(self.count), dr.width(self.count))
        return dr.while_loop((first, shader.zero()), lambda k, _: k < self.count, body, label="colours")[1]


def march_primal(ray: LocalRay, t0: Float, t1: Float, request: MarchRequest) -> MarchResult:
    """March ``ray`` in steps from ``t0`` to ``t1``."""
    Float, medium, settings = type(t0), request.medium, request.settings
    color, occlusion = request.color, request.occlusion
    goal, end = optical_depth_limits(Float, settings, request.until)

    num_deferred = 0 if color is None else count_deferred(medium, settings.color_cutoff)

    def visit(state: _PrimalState, step: Step, _: None) -> tuple[_PrimalState, None]:
        active, t, delta, t_next = state.active, step.t, step.delta, step.t_next
        result, tau, pending, deferred = replace(state.result), state.result.tau, state.pending, state.deferred
        if occlusion is not None:
            active = result.record_decided(occlusion.is_clear(t, tau), active)
        matter = step.quadrature.step(medium, ray, t, delta, t_next, state.carry, active, color is not None)
        distance = dr.fma(delta, matter.mean_fraction, t - t0)
        result, weight, crosses = result.absorb(active, matter.dtau, absorbed_fraction(matter.dtau), distance, goal)
        slope = delta / dr.select(crosses, matter.dtau, 1)
        result.record_crossing(crosses, t + matter.find_crossing(goal - tau), slope, t, tau)
        if color is not None:
            shader = color
            pending = pending + weight
            shaded = active & (pending > settings.color_cutoff)
            if deferred is None:
                contribution = dr.if_stmt(
                    (shaded,), shaded, lambda lit: matter.shade(shader, lit), lambda lit: shader.zero(), label="colour"
                )
                result.color = result.color + pending * contribution
            else:
                deferred = deferred.add(shaded, matter.color_distance, pending)
            pending = dr.select(shaded, 0, pending)
            if result.color_evals is not None:
                result.color_evals = result.color_evals + dr.select(shaded, 1, 0)
        if result.density_evals is not None:
            result.density_evals = result.density_evals + matter.evals
        if occlusion is not None:
            active = result.record_decided(occlusion.is_hidden(t_next, result.tau), active)
        active = active & (result.tau < end)
        carry = matter.carry
        return replace(state, active=active, carry=carry, pending=pending, result=result, deferred=deferred), None

    start = _PrimalState(
        active=request.active,
        t=t0,
        fraction=None if request.offset is None else Float(request.offset),
        carry=RULES.find(settings.quadrature).init_carry(Float),
        pending=None if color is None else Float(0),
        result=request.init_result(Float),
        deferred=_DeferredSamples.zero(Float, num_deferred) if num_deferred else None,
    )
    state, _ = march_steps(ray, t1, request, start, visit)
    result = state.result
    if color is not None:
        if state.deferred is not None:
            result.color = state.deferred.shade(medium, ray, color)
        # Samples whose total weight stayed below the cut-off take the mean colour of the others.
        shaded_weight = absorbed_fraction(result.tau) - state.pending
        result.color *= dr.select(
            shaded_weight > 0, 1 + state.pending / dr.select(shaded_weight > 0, shaded_weight, 1), 0
        )
    return result


def optical_depth_limits(Float: type, settings: MarchSettings, until: Float | float | None) -> tuple[Float, Float]:
    """Optical depths ``(goal, end)``: the crossing that is searched for, and the end of the march. ``Float``: array
    type of distances."""
    if until is None:
        return Float(LOG2), Float(settings.max_optical_depth)
    goal = Float(dr.detach(until))
    return goal, dr.minimum(goal, settings.max_optical_depth)


# ---- Hits ----
#
# The march through a medium of discrete hits, from hit to hit in depth order.
#
# A hit that absorbs the fraction α adds -ln(1 - α) of optical depth at its distance. The sums are those of the march in
# steps. The median is the distance of the hit at which the transmittance falls below 1/2.


@dataclass
class Hit:
    """A hit of each ray: its distance, the fraction of the arriving light that it absorbs, and its element."""

    t: Float
    absorbed: Float
    index: UInt32


@dataclass
class _PrimalHits:
    """Loop state of `march_hits`."""

    active: Bool
    result: MarchResult

    @property
    def tau(self) -> Float:
        """Optical depth so far."""
        return self.result.tau


def loop_hits(
    ray: LocalRay, t0: Float, t1: Float, request: MarchRequest, start: Any, visit: Callable[..., Any], extra: Any
) -> tuple[Any, Any, Float | None]:
    """Loop over the hits of ``ray`` from ``t0`` to ``t1``, of the march and of its derivatives.

    ``visit(state, hit, extra)`` processes a hit and returns the state, on whose ``active`` lanes the march goes on, and
    ``extra``. Returns both at the end, and the number of density evaluations if it is counted.
    """
    Float, hits = type(t0), cast("Hits", request.medium.hits)
    UInt32: Any = dr.uint32_array_t(Float)
    stop = dr.exp(-optical_depth_limits(Float, request.settings, request.until)[1])

    def take(here: Bool, group: list[Hit], state: Any, extra: Any) -> tuple[Bool, list[Hit], Any, Any]:
        """Process the first hit of the group and shift the others."""
        state, extra = visit(replace(state, active=here), group[0], extra)
        group = [*group[1:], Hit(Float(dr.inf), Float(0), UInt32(0))]
        return state.active & (group[0].t < dr.inf), group, state, extra

    def find_group(last: LastHit, state: Any, extra: Any, evals: Any) -> tuple[LastHit, Any, Any, Any]:
        """Find the next group of hits and process it."""
        near = hits.find_next(ray, last, t1, dr.exp(-state.tau), stop, state.active)
        last = LastHit(near.t[-1], near.index[-1])
        group = list(map(Hit, near.t, near.absorbed, near.index))
        first = state.active & (near.t[0] < dr.inf), group, state, extra
        _, _, state, extra = dr.while_loop(first, lambda here, *_: here, take, label="hits")
        evals = None if evals is None else evals + near.evals
        return last, replace(state, active=state.active & (last.t < dr.inf)), extra, evals

    # A hit at t0 itself is included.
    before = LastHit(dr.fma(dr.abs(t0), -(2.0**-22), t0 - 1e-37), UInt32(0))
    first = before, start, extra, Float(0) if request.count else None
    return dr.while_loop(first, lambda last, state, *_: state.active, find_group, label="groups of hits")[1:]


def march_hits(ray: LocalRay, t0: Float, t1: Float, request: MarchRequest) -> MarchResult:
    """March ``ray`` through the hits of the medium from ``t0`` to ``t1``, without derivatives."""
    Float, medium, color, occlusion = type(t0), request.medium, request.color, request.occlusion
    goal, end = optical_depth_limits(Float, request.settings, request.until)

    def visit(state: _PrimalHits, hit: Hit, _: None) -> tuple[_PrimalHits, None]:
        active, result, t, tau = state.active, replace(state.result), hit.t, state.tau
        if occlusion is not None:
            active = result.record_decided(occlusion.is_clear(t, tau), active)
        absorbed = dr.select(active, hit.absorbed, 0)
        result, weight, crosses = result.absorb(active, -log1p(-absorbed), absorbed, t - t0, goal)
        result.record_crossing(crosses, t, Float(0), t, tau)
        if color is not None:
            painter, lit = color, active & (weight > 0)
            result.color = result.color + weight * dr.if_stmt(
                (lit, hit.index),
                lit,
                lambda lit, index: painter.shade(medium, [cast("Float", index)], ray.o + ray.d * t, ray.w, lit),
                lambda lit, index: painter.zero(),
                label="colour",
            )
            if result.color_evals is not None:
                result.color_evals = result.color_evals + dr.select(lit, 1, 0)
        if occlusion is not None:
            active = result.record_decided(occlusion.is_hidden(t, result.tau), active)
        return _PrimalHits(active & (result.tau < end), result), None

    start = _PrimalHits(request.active, request.init_result(Float))
    state, _, density_evals = loop_hits(ray, t0, t1, request, start, visit, None)
    return replace(state.result, density_evals=density_evals)
