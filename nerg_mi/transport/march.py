"""The march through a medium as one differentiable operation: its adjoint, and that of hits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import drjit as dr

from nerg_mi.maths.arrays import log1p
from nerg_mi.maths.types import Bool, Color, Float, UInt32

from .march_primal import (
    MarchRequest,
    MarchResult,
    MarchSettings,
    MarchSums,
    Occlusion,
    advance,
    first_hit,
    limits,
    march_hits,
    march_primal,
    nothing_absorbed,
)
from .medium import Hits, LastHit, LocalRay, Medium, Painter
from .quadrature import RULES, absorbed_fraction, boundaries

# ---- Derivatives of a march, by marching again ----
#
# In the manner of path replay (Vicini et al. 2021): nothing is stored along the ray.
# The primal's sums are known, so a second march that repeats its steps knows, at
# step i, both what lies in front and what lies behind it. With T_i the
# transmittance before the step, and M and C the weighted sums of distances and
# colours, the derivative of the outputs with respect to the step's own optical
# depth dτ_i, mean distance m_i (from t0 on) and colour c_i is that of
#
#     f_i = δτ dτ_i + T_i (1 - e^{-dτ_i}) (δM m_i + δC c_i) - dτ_i (δM M_{>i} + δC C_{>i}) + δh h_i
#
# where δ are the adjoints, M_{>i} the part of M behind the step, and h_i the step's
# part in the distance at which an optical depth is reached. Nothing is divided by a
# transmittance, which may be zero.
#
# Steps keep their lengths and move with the ray's entry t0; the last one ends at t1.

_INPUTS = ("o", "d", "w", "t0", "t1")


def attached(medium: Medium, ray: LocalRay, t0: Float, t1: Float) -> bool:
    """Whether any derivative is to be tracked through a march."""
    return any(dr.grad_enabled(x) for x in (ray.o, ray.d, ray.w, t0, t1, *medium.parameters()))


def differentiable_march(
    operation: type[March], ray: LocalRay, t0: Float, t1: Float, request: MarchRequest
) -> MarchResult:
    """A march as one differentiable ``operation``."""
    # Every sample gets its own colour: a shared one would hand its derivative to the wrong samples.
    settings = replace(request.settings, color_cutoff=0.0)
    request = replace(request, settings=settings, occlusion=None)
    result = dr.custom(operation, ray.o, ray.d, ray.w, t0, t1, request)
    for name in ("half_slope", "enter", "enter_tau"):
        setattr(result, name, dr.detach(getattr(result, name)))
    return result


@dataclass(kw_only=True)
class _Replay(MarchSums):
    """Where a repeated march is: the primal's loop state as far as derivatives need it."""

    active: Bool
    color: Color


@dataclass(kw_only=True)
class _ReplayedSteps(_Replay):
    """Of a march in steps; the fields are those of the primal's state."""

    t: Float
    share: Float


@dataclass(kw_only=True)
class _ReplayedHits(_Replay):
    """Of a march from hit to hit; ``index``: of the hit to come."""

    index: UInt32


@dataclass
class Replayed:
    """One repeated step, attached to what derivatives are asked of."""

    active: Bool
    dtau: Float
    mean: Float
    color: Color
    # Detached, in front of the step.
    transmittance: Float
    # Whether the crossing that is looked for lies behind the step, and whether it lies in it.
    before: Bool
    crosses: Bool
    # Distance of that crossing, where it lies in the step.
    crossing: Float


class March(dr.CustomOp):
    """A march as one node of the graph: ``march_primal`` forwards, and once more for the derivatives."""

    def eval(self, o, d, w, t0, t1, request):
        self.request: MarchRequest = request
        self.inputs = (o, d, w, t0, t1)
        # The medium's weights are read, not passed: tell the graph that the result depends on them.
        for parameter in request.medium.parameters():
            self.add_input(parameter)
        # Symbolic also where an enclosing derivative has switched loops to evaluated ones: the steps must not be
        # stored.
        with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            self.result = self._primal(LocalRay(*self.inputs), t0, t1, request)
        return self.result

    _primal = staticmethod(march_primal)

    def backward(self):
        color, primal = self.request.color, self.result
        adjoint: Any = self.grad_out()
        d_half = dr.select(dr.isfinite(primal.half), adjoint.half, 0)

        def body(state, grads):
            with dr.resume_grad():
                leaves = [dr.detach(x) for x in self.inputs]
                dr.enable_grad(leaves)
                step, state = self._replay(leaves, state)
                arriving = adjoint.moment * step.mean
                behind = adjoint.moment * (primal.moment - state.moment)
                if color is not None:
                    arriving += dr.dot(adjoint.color, step.color)
                    behind += dr.dot(adjoint.color, primal.color - state.color)
                f = step.dtau * (adjoint.tau - behind) + step.transmittance * absorbed_fraction(step.dtau) * arriving
                h = dr.select(step.before, -primal.half_slope * step.dtau, dr.select(step.crosses, step.crossing, 0))
                dr.backward_from(dr.select(step.active, f + d_half * h, 0))
                grads = [g + dr.grad(x) for g, x in zip(grads, leaves)]
            return state, grads

        zeros = [dr.zeros(type(x), dr.width(x)) for x in self.inputs]
        for name, g in zip(_INPUTS, self._march_again(body, zeros)):
            self.set_grad_in(name, g)

    def forward(self):
        color, primal = self.request.color, self.result
        tangents = [self.grad_in(name) for name in _INPUTS]
        Float = type(self.inputs[3])

        def body(state, dot):
            with dr.resume_grad():
                leaves = [dr.detach(x) for x in self.inputs]
                dr.enable_grad(leaves)
                for leaf, tangent in zip(leaves, tangents):
                    dr.set_grad(leaf, tangent)
                step, state = self._replay(leaves, state)
                # The step's own weight, and what it adds to the sums while T_i is held fixed.
                weight = step.transmittance * absorbed_fraction(step.dtau)
                outputs = [step.dtau, weight * step.mean, dr.select(step.crosses, step.crossing, 0)]
                outputs += [] if color is None else [weight * step.color]
                # Keep all derivatives: an output is an interior node of others, and the weights serve again.
                dr.forward_to(outputs, flags=dr.ADFlag.ClearNone)
                own = [dr.select(step.active, dr.grad(x), 0) for x in outputs]
            # T_i falls with the optical depth in front of the step.
            moment = dot.moment + own[1] - dr.select(step.active, dot.tau * dr.detach(outputs[1]), 0)
            half = dot.half + own[2] - dr.select(step.crosses, dot.tau * primal.half_slope, 0)
            painted = dot.color
            if color is not None:
                painted = painted + own[3] - dr.select(step.active, dot.tau * dr.detach(outputs[3]), 0)
            return state, replace(dot, tau=dot.tau + own[0], moment=moment, half=half, color=painted)

        self.set_grad_out(self._march_again(body, replace(self.request.start(Float), half=Float(0))))

    def _march_again(self, body: Callable[[Any, Any], tuple[Any, Any]], extra: Any) -> Any:
        """Repeat the primal's steps, threading ``extra`` through ``body(state, extra)``."""
        f, t0 = self.request, self.inputs[3]
        Float = type(t0)
        share, color = Float(1 if f.offset is None else f.offset), None if f.color is None else f.color.zero()
        start = _ReplayedSteps(**nothing_absorbed(Float), active=f.active, color=color, t=t0, share=share)
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            _, extra = dr.while_loop((start, extra), lambda state, _: state.active, body, label="march adjoint")
        return extra

    def _replay(self, leaves: list[Any], state: Any) -> tuple[Replayed, Any]:
        """The next step, attached to ``leaves`` and the medium, and the state after it."""
        f, (primal_t0, primal_t1) = self.request, self.inputs[3:]
        quadrature = RULES.find(f.settings.quadrature)
        cells = boundaries(quadrature, f.medium)
        ray = LocalRay(*self.inputs)
        active, t, delta, t_next = advance(
            f.medium, ray, state.t, primal_t1, state.share, f.settings, state.active, cells, f.fine_from
        )
        o, d, w, t0, t1 = leaves
        begin = t0 + (t - primal_t0)
        length = dr.select(t_next >= primal_t1, t1 - begin, delta)
        attached = LocalRay(o, d, w, t0, t1)
        step = quadrature.step(f.medium, attached, begin, length, t_next, None, active, f.color is not None)
        replayed, after = self._absorb(
            state,
            active,
            step.dtau,
            absorbed_fraction(dr.detach(step.dtau)),
            dr.fma(length, step.share, t - primal_t0),
            step.paint,
            lambda missing: begin + step.crossing(missing),
        )
        return replayed, replace(after, active=after.active & (t_next < primal_t1), t=t_next, share=type(t0)(1))

    def _absorb(
        self,
        state: Any,
        active: Bool,
        dtau: Float,
        absorbed: Float,
        mean: Float,
        paint: Callable[[Painter, Bool], Color],
        crossing: Callable[[Float], Float],
    ) -> tuple[Replayed, Any]:
        """One step, and the sums of ``state`` behind it: ``dtau`` and ``mean`` attached, ``absorbed`` detached."""
        goal, end = limits(type(state.tau), self.request.settings, self.request.until)
        after, weight, crosses = state.absorb(active, dr.detach(dtau), absorbed, dr.detach(mean), goal)
        painted = None
        if self.request.color is not None:
            lit = active & (weight > 0)
            painted = dr.select(lit, paint(self.request.color, lit), 0)
            after.color = after.color + weight * dr.detach(painted)
        after.active = active & (after.tau < end)
        before = active & (after.tau < goal)
        at = crossing(dr.select(crosses, goal - state.tau, 0))
        return Replayed(active, dtau, mean, painted, dr.exp(-state.tau), before, crosses, at), after

    def name(self):
        return "march"


# ---- Derivatives of a march from hit to hit, by finding the hits again ----
#
# The sums are those of ``adjoint``, with a hit's optical depth, its distance and its colour for a step's: nothing is
# stored along the ray, however many hits there are. Which hits there are, and their order, carry no derivatives: one
# that moves past another, or to where it is cut off, changes the sums by a jump that is not seen.


class HitMarch(March):
    """``march_hits`` as one node of the graph."""

    _primal = staticmethod(march_hits)

    def _march_again(self, body: Callable[[Any, Any], tuple[Any, Any]], extra: Any) -> Any:
        f, (t0, t1) = self.request, self.inputs[3:]
        hits, ray = cast("Hits", f.medium.hits), LocalRay(*(dr.detach(x) for x in self.inputs))
        Float = type(t0)
        UInt32: Any = dr.uint32_array_t(Float)
        end = limits(Float, f.settings, f.until)[1]

        def take(state, t, index, extra):
            """The first of the hits; the others move up."""
            state, extra = body(replace(state, index=index[0]), extra)
            t, index = t[1:] + [Float(dr.inf)], index[1:] + [UInt32(0)]
            return replace(state, active=state.active & (t[0] < dr.inf)), t, index, extra

        def group(active, last, state, extra):
            near = hits.find_next(ray, last, t1, dr.exp(-state.tau), dr.exp(-end), active)
            farthest = LastHit(near.t[-1], near.index[-1])
            state = replace(state, active=active & (near.t[0] < dr.inf))
            state, _, _, extra = dr.while_loop(
                (state, near.t, near.index, extra), lambda state, *_: state.active, take, label="hits again"
            )
            return active & (farthest.t < dr.inf) & (state.tau < end), farthest, state, extra

        color = None if f.color is None else f.color.zero()
        state = _ReplayedHits(**nothing_absorbed(Float), active=f.active, color=color, index=UInt32(0))
        first = first_hit(t0)
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            out = dr.while_loop((f.active, first, state, extra), lambda active, *_: active, group, label="hits adjoint")
        return out[3]

    def _replay(self, leaves: list[Any], state: Any) -> tuple[Replayed, Any]:
        medium, active, index = self.request.medium, state.active, state.index
        o, d, w, t0, t1 = leaves
        t, absorbed = cast("Hits", medium.hits).reevaluate(LocalRay(o, d, w, t0, t1), index, active)
        return self._absorb(
            state,
            active,
            dr.select(active, -log1p(-absorbed), 0),
            dr.select(active, dr.detach(absorbed), 0),
            t - t0,
            lambda painter, lit: painter.shade(medium, [index], o + d * t, w, lit),
            lambda missing: t,
        )


# ---- March ----
#
# Volume rendering along rays: the march through a medium, with derivatives where any are tracked.
#
# Chooses between the plain march (``primal``) and the one that can be differentiated by marching again (``adjoint``),
# and lets steps be coarse in front of all matter.


# Optical depth that counts as a first trace of matter.
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
    color: Painter | None = None,
    count: bool = False,
    until: Float | float | None = None,
    fine_from: Float | None = None,
    occlusion: Occlusion | None = None,
) -> MarchResult:
    """March ``ray`` from the distance ``t0`` to ``t1``, both in scene units and finite where there is matter.

    ``offset`` in [0, 1]: length of the first step as a share of a full one (jitter; None: a full step). ``color``: what
    samples contribute to the result's ``color``; None for a density-only pass. ``until``: optical depth at which to
    end, for a march that only looks for that crossing. ``count``: count evaluations. ``fine_from``: distance up to
    which steps are coarse. ``occlusion``: end as soon as its answer is known, unless derivatives are tracked, and say
    so in ``known``. Differentiable, in forward and in reverse mode, in the ray, ``t0``, ``t1``, ``until`` and
    the medium's parameters. Raises ``NergError`` for a quadrature rule that is not known, or that the medium does not
    suit.
    """
    Float = type(ray.t_near)
    active = dr.mask_t(Float)(active) & (t0 < t1)
    t0, t1 = Float(t0), Float(t1)
    request = MarchRequest(medium, active, settings, offset, color, count, until, fine_from, occlusion)
    if attached(medium, ray, t0, t1):
        result = differentiable_march(March if medium.hits is None else HitMarch, ray, t0, t1, request)
    else:
        result = (march_primal if medium.hits is None else march_hits)(ray, t0, t1, request)
    result.origin = t0
    if until is not None and dr.grad_enabled(until):
        crossed = dr.isfinite(result.half)
        result.half = dr.select(crossed, dr.fma(result.half_slope, until - dr.detach(until), result.half), result.half)
    return result


def fine_start(
    medium: Medium, ray: LocalRay, t0: Float, t1: Float, active: Bool, settings: MarchSettings
) -> tuple[Float, Float]:
    """Distance from which matter must be marched finely, and the density evaluations that finding it took.

    A coarse density-only march looks for the first trace of matter. What is thinner than a coarse step may be missed.
    """
    scout = replace(settings, step=settings.step * settings.coarse, coarse=1.0, quadrature="constant")
    with dr.suspend_grad():
        found = march(medium, ray, t0, t1, active, scout, until=_TRACE, count=True)
        return dr.select(dr.isfinite(found.half), found.enter - scout.step, dr.inf), cast("Float", found.density_evals)


def scouted_march(
    medium: Medium, ray: LocalRay, t0: Float, t1: Float, active: Bool, settings: MarchSettings, **options: Any
) -> MarchResult:
    """``march`` with coarse steps in front of all matter, where ``settings.coarse`` asks for them."""
    if settings.coarse <= 1 or medium.hits is not None:
        return march(medium, ray, t0, t1, active, settings, **options)
    fine_from, scouted = fine_start(medium, ray, t0, t1, active, settings)
    result = march(medium, ray, t0, t1, active, settings, fine_from=fine_from, **options)
    if result.density_evals is not None:
        result.density_evals = result.density_evals + scouted
    return result
