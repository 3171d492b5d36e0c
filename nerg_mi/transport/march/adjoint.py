"""Derivatives of a march, by marching again.

In the manner of path replay (Vicini et al. 2021): nothing is stored along the ray.
The primal's sums are known, so a second march that repeats its steps knows, at
step i, both what lies in front and what lies behind it. With T_i the
transmittance before the step, and M and C the weighted sums of distances and
colours, the derivative of the outputs with respect to the step's own optical
depth dτ_i, mean distance m_i (from t0 on) and colour c_i is that of

    f_i = δτ dτ_i + T_i (1 - e^{-dτ_i}) (δM m_i + δC c_i) - dτ_i (δM M_{>i} + δC C_{>i}) + δh h_i

where δ are the adjoints, M_{>i} the part of M behind the step, and h_i the step's
part in the distance at which an optical depth is reached. Nothing is divided by a
transmittance, which may be zero.

Steps keep their lengths and move with the ray's entry t0; the last one ends at t1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from nerg_mi.maths.types import Bool, Color, Float
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.painting import Painter
from nerg_mi.transport.media.protocol import Medium

from .primal import add, limits, march_primal
from .quadrature import absorbed_share
from .rules import RULES, boundaries
from .settings import MarchResult, MarchSettings
from .stepping import advance

_INPUTS = ("o", "d", "w", "t0", "t1")


def attached(medium: Medium, ray: LocalRay, t0: Float, t1: Float) -> bool:
    """Whether any derivative is to be tracked through a march."""
    return any(dr.grad_enabled(x) for x in (ray.o, ray.d, ray.w, t0, t1, *medium.parameters()))


def differentiable_march(
    operation: type[March],
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
) -> MarchResult:
    """A march as one differentiable ``operation``; the other arguments are those of ``march.march``."""
    # Every sample gets its own colour: a shared one would hand its derivative to the wrong samples.
    settings = replace(settings, color_cutoff=0.0)
    fixed = (medium, active, settings, offset, color, count, until, fine_from)
    out = dr.custom(operation, ray.o, ray.d, ray.w, t0, t1, fixed)
    result = MarchResult(*out)
    for name in ("half_slope", "enter", "enter_tau"):
        setattr(result, name, dr.detach(getattr(result, name)))
    return result


@dataclass
class _State:
    """Where a repeated march is: the primal's loop state as far as derivatives need it."""

    active: Bool
    t: Float
    share: Float
    tau: Float
    moment: Float
    lost: tuple[Float, Float]
    color: Color | None


@dataclass
class Replayed:
    """One repeated step, attached to what derivatives are asked of."""

    active: Bool
    dtau: Float
    mean: Float
    color: Color | None
    # Detached, in front of the step.
    transmittance: Float
    # Whether the crossing that is looked for lies behind the step, and whether it lies in it.
    before: Bool
    crosses: Bool
    # Distance of that crossing, where it lies in the step.
    crossing: Float


class March(dr.CustomOp):
    """A march as one node of the graph: ``march_primal`` forwards, and once more for the derivatives."""

    def eval(self, o, d, w, t0, t1, fixed):
        self.fixed = fixed
        self.inputs = (o, d, w, t0, t1)
        medium = fixed[0]
        # The medium's weights are read, not passed: tell the graph that the result depends on them.
        for parameter in medium.parameters():
            self.add_input(parameter)
        with dr.suspend_grad():
            # Symbolic also where an enclosing derivative has switched loops to evaluated ones: the
            # steps must not be stored.
            with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
                result = self._primal()
        self.result = result
        return (
            result.tau,
            result.moment,
            result.half,
            result.half_slope,
            result.enter,
            result.enter_tau,
            result.color,
            result.density_evals,
            result.color_evals,
        )

    def _primal(self) -> MarchResult:
        medium, *rest = self.fixed
        t0, t1 = self.inputs[3:]
        return march_primal(medium, LocalRay(*self.inputs), t0, t1, *rest)

    def backward(self):
        active, color = self.fixed[1], self.fixed[4]
        adjoints: Any = self.grad_out()
        d_tau, d_moment, d_half, _, _, _, d_color, _, _ = adjoints
        # Colours are there wherever a painter is.
        primal: Any = self.result
        d_half = dr.select(dr.isfinite(primal.half), d_half, 0)

        def body(state, grads):
            with dr.resume_grad():
                leaves = [dr.detach(x) for x in self.inputs]
                dr.enable_grad(leaves)
                step, state = self._replay(leaves, state)
                arriving = d_moment * step.mean
                behind = d_moment * (primal.moment - state.moment)
                if color is not None:
                    arriving += dr.dot(d_color, step.color)
                    behind += dr.dot(d_color, primal.color - state.color)
                f = step.dtau * (d_tau - behind) + step.transmittance * absorbed_share(step.dtau) * arriving
                h = dr.select(step.before, -primal.half_slope * step.dtau, dr.select(step.crosses, step.crossing, 0))
                dr.backward_from(dr.select(step.active, f + d_half * h, 0))
                grads = [g + dr.grad(x) for g, x in zip(grads, leaves)]
            return state, grads

        zeros = [dr.zeros(type(x), dr.width(x)) for x in self.inputs]
        for name, g in zip(_INPUTS, self._march_again(body, active, zeros)):
            self.set_grad_in(name, g)

    def forward(self):
        active, color = self.fixed[1], self.fixed[4]
        tangents = [self.grad_in(name) for name in _INPUTS]
        Float = type(self.inputs[3])
        primal = self.result

        def body(state, sums):
            tau_dot, moment_dot, half_dot, color_dot = sums
            with dr.resume_grad():
                leaves = [dr.detach(x) for x in self.inputs]
                dr.enable_grad(leaves)
                for leaf, tangent in zip(leaves, tangents):
                    dr.set_grad(leaf, tangent)
                step, state = self._replay(leaves, state)
                # The step's own weight, and what it adds to the sums while T_i is held fixed.
                weight = step.transmittance * absorbed_share(step.dtau)
                outputs = [step.dtau, weight * step.mean, dr.select(step.crosses, step.crossing, 0)]
                outputs += [] if color is None else [weight * step.color]
                # Keep all derivatives: an output is an interior node of others, and the weights serve again.
                dr.forward_to(outputs, flags=dr.ADFlag.ClearNone)
                own = [dr.select(step.active, dr.grad(x), 0) for x in outputs]
            # T_i falls with the optical depth in front of the step.
            moment_dot = moment_dot + own[1] - dr.select(step.active, tau_dot * dr.detach(outputs[1]), 0)
            half_dot = half_dot + own[2] - dr.select(step.crosses, tau_dot * primal.half_slope, 0)
            if color is not None:
                color_dot = color_dot + own[3] - dr.select(step.active, tau_dot * dr.detach(outputs[3]), 0)
            return state, (tau_dot + own[0], moment_dot, half_dot, color_dot)

        zero = (Float(0), Float(0), Float(0), None if color is None else color.zero())
        tau_dot, moment_dot, half_dot, color_dot = self._march_again(body, active, zero)
        nothing = Float(0)
        counts = [None if x is None else nothing for x in (primal.density_evals, primal.color_evals)]
        self.set_grad_out((tau_dot, moment_dot, half_dot, nothing, nothing, nothing, color_dot, *counts))

    def _march_again(self, body: Callable[[Any, Any], tuple[Any, Any]], active: Bool, extra: Any) -> Any:
        """Repeat the primal's steps, threading ``extra`` through ``body(state, extra)``."""
        offset, color = self.fixed[3], self.fixed[4]
        Float = type(self.inputs[3])
        start = _State(
            active,
            self.inputs[3],
            Float(1 if offset is None else offset),
            Float(0),
            Float(0),
            (Float(0), Float(0)),
            None if color is None else color.zero(),
        )
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            _, extra = dr.while_loop((start, extra), lambda state, _: state.active, body, label="march adjoint")
        return extra

    def _replay(self, leaves: list[Any], state: Any) -> tuple[Replayed, Any]:
        """The next step, attached to ``leaves`` and the medium, and the state after it."""
        medium, _, settings, _, color, _, until, fine_from = self.fixed
        primal_t0, primal_t1 = self.inputs[3:]
        Float = type(primal_t0)
        quadrature = RULES.find(settings.quadrature)
        cells = boundaries(quadrature, medium)
        goal, end = limits(Float, settings, until)
        ray = LocalRay(*self.inputs)
        active, t, delta, t_next = advance(
            medium, ray, state.t, primal_t1, state.share, settings, state.active, cells, fine_from
        )
        o, d, w, t0, t1 = leaves
        begin = t0 + (t - primal_t0)
        length = dr.select(t_next >= primal_t1, t1 - begin, delta)
        step = quadrature.step(
            medium, LocalRay(o, d, w, t0, t1), begin, length, t_next, None, active, color is not None
        )
        tau = state.tau
        dtau = dr.detach(step.dtau)
        transmittance = dr.exp(-tau)
        weight = transmittance * absorbed_share(dtau)
        mean = dr.fma(length, step.share, t - primal_t0)
        total, painted = state.color, None
        moment, lost_moment = add(state.moment, state.lost[1], weight * dr.detach(mean))
        tau_after, lost_tau = add(tau, state.lost[0], dtau)
        if color is not None:
            lit = active & (weight > 0)
            painted = dr.select(lit, step.paint(color, lit), 0)
            total = total + weight * dr.detach(painted)
        before = active & (tau_after < goal)
        crosses = active & ~before & (tau < goal)
        crossing = begin + step.crossing(dr.select(crosses, goal - tau, 0))
        replayed = Replayed(active, step.dtau, mean, painted, transmittance, before, crosses, crossing)
        after = _State(
            active & (t_next < primal_t1) & (tau_after < end),
            t_next,
            Float(1),
            tau_after,
            moment,
            (lost_tau, lost_moment),
            total,
        )
        return replayed, after

    def name(self):
        return "march"
