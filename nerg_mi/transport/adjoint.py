"""Derivatives of a march, by marching again.

In the manner of path replay (Vicini et al. 2021): nothing is stored along the ray.
The primal's sums are known, so a second march that repeats its steps knows, at
step i, both what lies in front and what lies behind it. With T_i the
transmittance before the step, and M and C the weighted sums of distances and
colours, the derivative of the outputs with respect to the step's own optical
depth dτ_i, mean distance m_i and colour c_i is that of

    f_i = δτ dτ_i + T_i (1 - e^{-dτ_i}) (δM m_i + δC c_i) - dτ_i (δM M_{>i} + δC C_{>i}) + δh h_i

where δ are the adjoints, M_{>i} the part of M behind the step, and h_i the step's
part in the distance at which an optical depth is reached. Nothing is divided by a
transmittance, which may be zero.

Steps keep their lengths and move with the ray's entry t0; the last one ends at t1.
"""
from __future__ import annotations

import drjit as dr

from .march import MarchResult, advance, limits, march_primal
from .media import LocalRay
from .quadrature import absorbed_share
from .rules import rule


def attached(medium, ray, t0, t1) -> bool:
    """Whether any derivative is to be tracked through a march."""
    return any(
        dr.grad_enabled(x) for x in (ray.o, ray.d, ray.w, t0, t1, *medium.parameters())
    )


def differentiable_march(medium, ray, t0, t1, active, settings, offset, color, count, until,
                         fine_from) -> MarchResult:
    """``march_primal`` as one differentiable operation."""
    fixed = (medium, active, settings, offset, color, count, until, fine_from)
    out = dr.custom(_March, ray.o, ray.d, ray.w, t0, t1, fixed)
    result = MarchResult(*out)
    for name in ("half_slope", "enter", "enter_tau"):
        setattr(result, name, dr.detach(getattr(result, name)))
    return result


class _March(dr.CustomOp):
    def eval(self, o, d, w, t0, t1, fixed):
        self.fixed = fixed
        self.ray, self.t0, self.t1 = LocalRay(o, d, w, t0, t1), t0, t1
        medium, active, settings, offset, color, count, until, fine_from = fixed
        # The medium's weights are read, not passed: tell the graph that the result depends on them.
        for parameter in medium.parameters():
            self.add_input(parameter)
        with dr.suspend_grad():
            # Symbolic also where an enclosing derivative has switched loops to evaluated ones: the
            # steps must not be stored.
            with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
                result = march_primal(
                    medium, self.ray, t0, t1, active, settings, offset, color, count, until, fine_from
                )
        self.result = result
        return (result.tau, result.moment, result.half, result.half_slope, result.enter, result.enter_tau,
                result.color, result.density_evals, result.color_evals)

    def backward(self):
        medium, active, settings, offset, color, _, until, fine_from = self.fixed
        d_tau, d_moment, d_half, _, _, _, d_color, _, _ = self.grad_out()
        primal, ray = self.result, self.ray
        Float = type(self.t0)
        goal, end = limits(Float, settings, until)
        quadrature = rule(settings.quadrature, medium)
        d_half = dr.select(dr.isfinite(primal.half), d_half, 0)

        def body(active, t, share, tau, moment, total, grads):
            active, t, delta, t_next = advance(
                medium, ray, t, self.t1, share, settings, active, quadrature.planes, fine_from
            )
            with dr.resume_grad():
                leaves = [dr.detach(x) for x in (ray.o, ray.d, ray.w, self.t0, self.t1)]
                dr.enable_grad(leaves)
                o, d, w, t0, t1 = leaves
                begin = t0 + (t - self.t0)
                length = dr.select(t_next >= self.t1, t1 - begin, delta)
                step = quadrature.step(
                    medium, LocalRay(o, d, w, t0, t1), begin, length, t_next, None, active, color
                )
                dtau, m_i = step.dtau, dr.fma(length, step.share, begin)
                transmittance = dr.exp(-tau)
                share_i = absorbed_share(dtau)
                weight = dr.detach(transmittance * share_i)
                moment = moment + weight * dr.detach(m_i)
                arriving = d_moment * m_i
                behind = d_moment * (primal.moment - moment)
                if color is not None:
                    lit = active & (weight > settings.color_cutoff)
                    c_i = dr.select(lit, step.color(lit), 0)
                    total = total + weight * dr.detach(c_i)
                    arriving += dr.dot(d_color, c_i)
                    behind += dr.dot(d_color, primal.color - total)
                f = dtau * (d_tau - behind) + transmittance * share_i * arriving
                before = tau + dr.detach(dtau) < goal
                crosses = ~before & (tau < goal) & active
                h = dr.select(before, -primal.half_slope * dtau, 0)
                h += dr.select(crosses, begin + step.crossing(dr.select(crosses, goal - tau, 0)), 0)
                f = dr.select(active, f + d_half * h, 0)
                dr.backward_from(f)
                grads = [g + dr.grad(x) for g, x in zip(grads, leaves)]
            tau = tau + dr.detach(dtau)
            active = active & (t_next < self.t1) & (tau < end)
            return active, t_next, Float(1), tau, moment, total, grads

        start = (
            active, self.t0, Float(1 if offset is None else offset), Float(0), Float(0),
            None if color is None else dr.zeros(color),
            [dr.zeros(type(x), dr.width(x)) for x in (ray.o, ray.d, ray.w, self.t0, self.t1)],
        )
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
            *_, grads = dr.while_loop(start, lambda active, *_: active, body, label="march adjoint")
        for name, g in zip(("o", "d", "w", "t0", "t1"), grads):
            self.set_grad_in(name, g)

    def name(self):
        return "march"
