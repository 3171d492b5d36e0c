"""The differentiable march through a medium: primal march, forward and reverse derivatives, and the coarse pre-pass."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, cast

import drjit as dr

from nerg_mi.maths.arrays import log1p
from nerg_mi.maths.types import Bool, Color, Float

from .march_primal import (
    Hit,
    MarchRequest,
    MarchResult,
    MarchSettings,
    MarchSums,
    OcclusionQuery,
    Step,
    StepState,
    loop_hits,
    march_hits,
    march_primal,
    march_steps,
    optical_depth_limits,
    zero_sums,
)
from .medium import ColorShader, Hits, LocalRay, Medium, SampleShader
from .quadrature import absorbed_fraction
from .splat_lists import ListHit, ListSums, SplatLists, light_limits

# ---- Derivatives of a march in steps ----
#
# A variant of path replay backpropagation (Vicini et al. 2021): no sample is stored. The primal march returns its sums,
# so a second march over the same steps knows at step i what lies in front of the step and what lies behind it. With T_i
# the transmittance before step i, and M and C the weighted sums of distances and colours, the derivative of the outputs
# with respect to the step's optical depth dτ_i, its mean distance m_i (measured from t0) and its colour c_i equals the
# derivative of
#
#     f_i = δτ dτ_i + T_i (1 - e^{-dτ_i}) (δM m_i + δC c_i) - dτ_i (δM M_{>i} + δC C_{>i}) + δh h_i
#
# where δ are the adjoints, M_{>i} is the part of M behind the step, and h_i is the step's contribution to the distance
# at which a given optical depth is reached. No term divides by a transmittance, which can be zero.
#
# Steps keep their lengths and move with the entry point t0 of the ray; the last step ends at t1.

_INPUTS = ("o", "d", "w", "t0", "t1")


def march_differentiably(
    operation: type[MarchOp], ray: LocalRay, t0: Float, t1: Float, request: MarchRequest
) -> MarchResult:
    """Run ``operation`` as a differentiable custom operation."""
    # Each sample is shaded separately: a shared colour would send its gradient to the wrong samples.
    settings = replace(request.settings, color_cutoff=0.0)
    request = replace(request, settings=settings, occlusion=None)
    inputs = ray.o, ray.d, ray.w, t0, t1
    attached = tuple(name for name, value in zip(_INPUTS, inputs) if dr.grad_enabled(value))
    result = dr.custom(operation, *inputs, request, attached)
    for name in ("median_depth_slope", "crossing_start", "crossing_start_tau"):
        setattr(result, name, dr.detach(getattr(result, name)))
    return result


@dataclass(kw_only=True)
class _Replay(MarchSums):
    """The sums of the primal march that the derivative march repeats, and the rays that go on."""

    active: Bool
    color: Color


@dataclass(kw_only=True)
class _StepReplay(StepState, _Replay):
    """Loop state of the derivatives of a march in steps."""


@dataclass
class ReplayStep:
    """One repeated step, attached to the differentiable inputs."""

    active: Bool
    dtau: Float
    mean_distance: Float
    color: Color
    # Transmittance in front of the step; detached.
    transmittance: Float
    # Whether the optical depth that is searched for is reached behind the step, or inside it.
    is_before_crossing: Bool
    has_crossing: Bool
    # Distance at which it is reached, if it is reached inside the step.
    crossing_distance: Float


class MarchOp(dr.CustomOp):
    """A march as one node of the AD graph: `march_primal` for the values, a second march for the derivatives."""

    def eval(self, o, d, w, t0, t1, request, attached):
        self.request: MarchRequest = request
        self.inputs = (o, d, w, t0, t1)
        # Names of the inputs that carry derivatives.
        self.attached: tuple[str, ...] = attached
        # The medium's weights are read and not passed as inputs, so the graph has to be told about them.
        for parameter in request.medium.parameters():
            self.add_input(parameter)
        # Loops stay symbolic even if an enclosing derivative evaluates them: the steps must not be stored.
        with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            self.result = self._primal(LocalRay(*self.inputs), t0, t1, request)
        return self.result

    _primal = staticmethod(march_primal)

    def backward(self):
        color, primal = self.request.color, self.result
        adjoint: Any = self.grad_out()
        d_half = dr.select(dr.isfinite(primal.median_depth), adjoint.median_depth, 0)

        def visit(state, place, grads):
            with dr.resume_grad():
                leaves = [dr.detach(x) for x in self.inputs]
                dr.enable_grad(leaves)
                step, state = self._replay(leaves, state, place)
                arriving = adjoint.moment * step.mean_distance
                behind = adjoint.moment * (primal.moment - state.moment)
                if color is not None:
                    arriving += dr.dot(adjoint.color, step.color)
                    behind += dr.dot(adjoint.color, primal.color - state.color)
                f = step.dtau * (adjoint.tau - behind) + step.transmittance * absorbed_fraction(step.dtau) * arriving
                h = dr.select(
                    step.is_before_crossing,
                    -primal.median_depth_slope * step.dtau,
                    dr.select(step.has_crossing, step.crossing_distance, 0),
                )
                dr.backward_from(dr.select(step.active, f + d_half * h, 0))
                grads = [g + dr.grad(leaves[i]) for g, i in zip(grads, wanted)]
            return state, grads

        # Sums that nothing needs would slow down the loop.
        wanted = [_INPUTS.index(name) for name in self.attached]
        zeros = [dr.zeros(type(self.inputs[i]), dr.width(self.inputs[i])) for i in wanted]
        for name, g in zip(self.attached, self._march_again(visit, zeros)):
            self.set_grad_in(name, g)

    def forward(self):
        color, primal = self.request.color, self.result
        tangents = [self.grad_in(name) for name in _INPUTS]
        Float = type(self.inputs[3])

        def visit(state, place, dot):
            with dr.resume_grad():
                leaves = [dr.detach(x) for x in self.inputs]
                dr.enable_grad(leaves)
                for leaf, tangent in zip(leaves, tangents):
                    dr.set_grad(leaf, tangent)
                step, state = self._replay(leaves, state, place)
                # The weight of the step, and its contribution to the sums at fixed T_i.
                weight = step.transmittance * absorbed_fraction(step.dtau)
                outputs = [
                    step.dtau,
                    weight * step.mean_distance,
                    dr.select(step.has_crossing, step.crossing_distance, 0),
                ]
                outputs += [] if color is None else [weight * step.color]
                # Keep all gradients: outputs are interior nodes of other outputs, and the weights are used again.
                dr.forward_to(outputs, flags=dr.ADFlag.ClearNone)
                tangents_of_step = [dr.select(step.active, dr.grad(x), 0) for x in outputs]
            # T_i decreases with the optical depth in front of the step.
            moment = dot.moment + tangents_of_step[1] - dr.select(step.active, dot.tau * dr.detach(outputs[1]), 0)
            half = (
                dot.median_depth
                + tangents_of_step[2]
                - dr.select(step.has_crossing, dot.tau * primal.median_depth_slope, 0)
            )
            painted = dot.color
            if color is not None:
                painted = painted + tangents_of_step[3] - dr.select(step.active, dot.tau * dr.detach(outputs[3]), 0)
            return state, replace(
                dot, tau=dot.tau + tangents_of_step[0], moment=moment, median_depth=half, color=painted
            )

        self.set_grad_out(self._march_again(visit, replace(self.request.init_result(Float), median_depth=Float(0))))

    def _march_again(self, visit: Callable[..., tuple[Any, Any]], extra: Any) -> Any:
        """Repeat the primal's steps and thread ``extra`` through ``visit(state, place, extra)``."""
        f, (t0, t1) = self.request, self.inputs[3:]
        Float = type(t0)
        fraction, color = Float(1 if f.offset is None else f.offset), None if f.color is None else f.color.zero()
        start = _StepReplay(**zero_sums(Float), active=f.active, color=color, t=t0, fraction=fraction)
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            return march_steps(LocalRay(*self.inputs), t1, f, start, visit, extra, "march adjoint")[1]

    def _replay(self, leaves: list[Any], state: Any, place: Step) -> tuple[ReplayStep, Any]:
        """The step at ``place``, attached to ``leaves`` and the medium, and the state after it."""
        f, (primal_t0, primal_t1) = self.request, self.inputs[3:]
        o, d, w, t0, t1 = leaves
        begin = t0 + (place.t - primal_t0)
        length = dr.select(place.t_next >= primal_t1, t1 - begin, place.delta)
        step = place.quadrature.step(
            f.medium, LocalRay(o, d, w, t0, t1), begin, length, place.t_next, None, state.active, f.color is not None
        )
        return self._absorb(
            state,
            step.dtau,
            absorbed_fraction(dr.detach(step.dtau)),
            dr.fma(length, step.mean_fraction, place.t - primal_t0),
            step.shade,
            lambda missing: begin + step.find_crossing(missing),
        )

    def _absorb(
        self,
        state: Any,
        dtau: Float,
        absorbed: Float,
        mean: Float,
        paint: Callable[[SampleShader, Bool], Color],
        crossing: Callable[[Float], Float],
    ) -> tuple[ReplayStep, Any]:
        """Add one step to the sums of ``state``.

        Parameters
        ----------
        dtau, mean : Float
            Optical depth of the step and its mean distance from the start of the march; attached.
        absorbed : Float
            Fraction of the arriving light that the step absorbs; detached.
        paint, crossing : callable
            The colour of the step on a mask of lanes, and the distance at which a remaining optical depth is reached.
        """
        goal, end = optical_depth_limits(type(state.tau), self.request.settings, self.request.until)
        active = state.active
        after, weight, crosses = state.absorb(active, dr.detach(dtau), absorbed, dr.detach(mean), goal)
        painted = None
        if self.request.color is not None:
            lit = active & (weight > 0)
            painted = dr.select(lit, paint(self.request.color, lit), 0)
            after.color = after.color + weight * dr.detach(painted)
        after.active = active & (after.tau < end)
        before = active & (after.tau < goal)
        at = crossing(dr.select(crosses, goal - state.tau, 0))
        return ReplayStep(active, dtau, mean, painted, dr.exp(-state.tau), before, crosses, at), after

    def name(self):
        return "march"


# ---- Derivatives of a march from hit to hit ----
#
# The sums are those above, with the optical depth, distance and colour of a hit in place of those of a step. No hit is
# stored, so memory does not grow with the number of hits. Which hits a ray has, and their order, carry no gradient: a
# hit that moves past another one, or past a cut-off, makes the sums jump, and derivatives miss that jump.


class HitMarchOp(MarchOp):
    """`march_hits` as one node of the AD graph."""

    _primal = staticmethod(march_hits)

    def _march_again(self, visit: Callable[..., tuple[Any, Any]], extra: Any) -> Any:
        f, (t0, t1), ray = self.request, self.inputs[3:], LocalRay(*(dr.detach(x) for x in self.inputs))
        start = _Replay(**zero_sums(type(t0)), active=f.active, color=None if f.color is None else f.color.zero())
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            return loop_hits(ray, t0, t1, f, start, visit, extra)[1]

    def _replay(self, leaves: list[Any], state: Any, place: Hit) -> tuple[ReplayStep, Any]:
        medium, active = self.request.medium, state.active
        o, d, w, t0, t1 = leaves
        t, absorbed = cast("Hits", medium.hits).reevaluate(LocalRay(o, d, w, t0, t1), place.index, active)
        return self._absorb(
            state,
            dr.select(active, -log1p(-absorbed), 0),
            dr.select(active, dr.detach(absorbed), 0),
            t - t0,
            lambda painter, lit: painter.shade(medium, [cast("Float", place.index)], o + d * t, w, lit),
            lambda missing: t,
        )


# ---- Derivatives of a march along lists of Gaussians ----
#
# As above, with the hits, the order and the end of `SplatLists.march`. Derivatives reach the rows of the lists, one per
# Gaussian, and from there, outside of the loop, the shapes and colours of the Gaussians. A change of a ray is a change
# of its direction and a shift of the point from which distances are measured (`SplatLists.locate`).


class ListMarchOp(MarchOp):
    """`SplatLists.march` as one node of the AD graph; the lists of the request's medium are attached."""

    def eval(self, o, d, w, t0, t1, request, attached):
        self.lists: SplatLists = request.medium.hits
        self.add_input(self.lists.rows)
        return super().eval(o, d, w, t0, t1, request, attached)

    @staticmethod
    def _primal(ray: LocalRay, t0: Float, t1: Float, request: MarchRequest) -> MarchResult:
        return cast("SplatLists", request.medium.hits).march(ray, t0, t1, request)

    def _march_again(self, visit: Callable[..., tuple[Any, Any]], extra: Any) -> Any:
        f, ray, Float = self.request, LocalRay(*self.inputs), type(self.inputs[3])
        (self.offset, self.origin), self.limits = self.lists.locate(ray), light_limits(Float, f)
        color = None if f.color is None else f.color.zero()
        start = ListSums(active=f.active, light=Float(1), moment=Float(0), color=color)
        t0, t1 = (t + self.offset for t in self.inputs[3:])
        # Most entries of a list are no hits of any ray of a packet.
        skip = lambda state, hit, extra: (state, extra)
        visit_hits = lambda *args: dr.if_stmt(args, args[0].active, visit, skip, label="derivatives of a hit")
        with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            return self.lists.loop_hits(ray, t0, t1, start, visit_hits, extra)[1]

    def _replay(self, leaves: list[Any], state: Any, place: ListHit) -> tuple[ReplayStep, Any]:
        lists, active, shader = self.lists, state.active, self.request.color
        (o, d, _, t0, _), (primal_o, primal_d, _, primal_t0, _) = leaves, self.inputs
        shift = (o - primal_o) - self.offset * (d - primal_d)
        shift = shift if self.origin is None else self.origin + shift
        row = lists.gather_rows(place.rank, active)
        t, alpha, _ = lists.evaluate(row, d, shift)
        goal, stop = self.limits
        after, weight, crosses = state.absorb(place, primal_t0 + self.offset, goal, stop)
        color = None
        if shader is not None:
            color = cast("ColorShader", shader).array_type(*row[13:])
            after.color = state.color + weight * dr.detach(color)
        distance = t - self.offset
        dtau = dr.select(active, -log1p(-alpha), 0)
        before = active & (after.light > goal)
        return ReplayStep(active, dtau, distance - t0, color, state.light, before, crosses, distance), after


# ---- March ----
#
# Volume rendering along rays: the plain march, or the differentiable one if anything carries gradients, with an
# optional coarse pre-pass through empty space.


# Optical depth at which the pre-pass reports matter.
_TRACE = 1e-3


def march(
    medium: Medium,
    ray: LocalRay,
    t0: Float,
    t1: Float,
    active: Bool,
    settings: MarchSettings,
    *,
    offset: Float | None = None,
    color: SampleShader | None = None,
    count: bool = False,
    until: Float | float | None = None,
    fine_from: Float | None = None,
    occlusion: OcclusionQuery | None = None,
) -> MarchResult:
    """March ``ray`` from the distance ``t0`` to ``t1``.

    Differentiable, in forward and reverse mode, in the ray, ``t0``, ``t1``, ``until`` and the medium's parameters.

    Parameters
    ----------
    t0, t1 : Float
        Ends of the interval in scene units; both finite where there is matter.
    offset : Float, optional
        Length of the first step as a fraction of a full step, in [0, 1] (jitter). Default: a full step.
    color : SampleShader, optional
        What samples contribute to the ``color`` of the result. Default: a density-only pass.
    count : bool
        Count density and colour evaluations.
    until : Float, optional
        Optical depth at which the march ends, for a march that only searches this crossing.
    fine_from : Float, optional
        Distance up to which steps are coarse (`find_fine_start`).
    occlusion : OcclusionQuery, optional
        End as soon as the query is decided, and report it in ``decided``. Ignored if anything carries gradients.

    Raises
    ------
    NergError
        If the quadrature rule is unknown, or needs a medium of another kind.
    """
    Float = type(ray.t_near)
    active = dr.mask_t(Float)(active) & (t0 < t1)
    t0, t1 = Float(t0), Float(t1)
    request = MarchRequest(medium, active, settings, offset, color, count, until, fine_from, occlusion)
    if any(dr.grad_enabled(x) for x in (ray.o, ray.d, ray.w, t0, t1, *medium.parameters())):
        operation: type[MarchOp] = MarchOp if medium.hits is None else HitMarchOp
        # Rows have colours alone.
        if isinstance(medium.hits, SplatLists) and (color is None or isinstance(color, ColorShader)):
            seen: Any = copy(medium)
            seen.hits = medium.hits.attach()
            operation, request = ListMarchOp, replace(request, medium=seen)
        result = march_differentiably(operation, ray, t0, t1, request)
    else:
        # An enclosing derivative, such as that of the albedo of a shape, evaluates loops: each step would be a kernel.
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            if medium.hits is None:
                result = march_primal(ray, t0, t1, request)
            elif isinstance(medium.hits, SplatLists):
                result = medium.hits.march(ray, t0, t1, request)
            else:
                result = march_hits(ray, t0, t1, request)
    result.start_distance = t0
    if until is not None and dr.grad_enabled(until):
        crossed = dr.isfinite(result.median_depth)
        result.median_depth = dr.select(
            crossed,
            dr.fma(result.median_depth_slope, until - dr.detach(until), result.median_depth),
            result.median_depth,
        )
    return result


def find_fine_start(
    medium: Medium, ray: LocalRay, t0: Float, t1: Float, active: Bool, settings: MarchSettings
) -> tuple[Float, Float]:
    """Distance from which matter must be marched with fine steps, and the number of density evaluations of the search.

    A coarse density-only march searches for the first trace of matter. It can miss matter that is thinner than a coarse
    step.
    """
    coarse_settings = replace(settings, step=settings.step * settings.coarse, coarse=1.0, quadrature="constant")
    with dr.suspend_grad():
        coarse = march(medium, ray, t0, t1, active, coarse_settings, until=_TRACE, count=True)
        return dr.select(dr.isfinite(coarse.median_depth), coarse.crossing_start - coarse_settings.step, dr.inf), cast(
            "Float", coarse.density_evals
        )


def march_with_prepass(
    medium: Medium, ray: LocalRay, t0: Float, t1: Float, active: Bool, settings: MarchSettings, **options: Any
) -> MarchResult:
    """`march` with coarse steps through the empty space in front of all matter, if ``settings.coarse`` exceeds 1."""
    if settings.coarse <= 1 or medium.hits is not None:
        return march(medium, ray, t0, t1, active, settings, **options)
    fine_from, prepass_evaluations = find_fine_start(medium, ray, t0, t1, active, settings)
    result = march(medium, ray, t0, t1, active, settings, fine_from=fine_from, **options)
    if result.density_evals is not None:
        result.density_evals = result.density_evals + prepass_evaluations
    return result
