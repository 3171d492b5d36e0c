"""Volume rendering of one ray: opacity, depth and colour by marching a medium.

Steps lie at midpoint-sampled constant density (see ``quadrature``); optical depth
accumulates in log space, so opacity is -expm1(-τ) to full precision however thin
the medium. Steps whose midpoint lies in an empty cell of the medium's occupancy
grid are leapt over without an evaluation; marching ends behind opaque surfaces.
Derivatives come from ``adjoint``, which marches again instead of storing samples.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr

from .quadrature import absorbed_share, mean_depth_share

LOG2 = 0.6931471805599453


@dataclass(frozen=True)
class MarchSettings:
    """Controls of a march; lengths in scene units.

    ``step``: step length; ``dt_gamma``: steps are at least this share of the distance
    travelled (instant-ngp's cone stepping; 0: uniform); ``stop``: transmittance below which
    what lies behind is left out; ``color_cutoff``: samples of less weight get no colour.
    """

    step: float
    dt_gamma: float = 0.0
    stop: float = 1e-6
    color_cutoff: float = 1e-4

    @property
    def opaque(self) -> float:
        """Optical depth at which marching stops."""
        return -math.log(self.stop) if self.stop > 0 else math.inf


@dataclass
class MarchResult:
    """What a march gathered along each ray.

    ``tau``: optical depth; ``moment``: weighted sum of distances; ``half``: distance at which
    transmittance crosses 1/2 (infinite where it does not), or the optical depth ``until``;
    ``half_slope``: change of ``half`` with that optical depth, detached; ``color``: weighted sum of
    colours (None when no colour was asked for); ``density_evals``, ``color_evals``: evaluations made
    (None unless counted).
    """

    tau: object
    moment: object
    half: object
    half_slope: object
    color: object = None
    density_evals: object = None
    color_evals: object = None

    @property
    def opacity(self):
        return absorbed_share(self.tau)

    @property
    def expected_depth(self):
        """Mean distance of absorption, 0 where nothing absorbs."""
        alpha = self.opacity
        some = alpha > 0
        return dr.select(some, self.moment / dr.select(some, alpha, 1), 0)


def march(medium, ray, t0, t1, active, settings: MarchSettings, *, offset=None, color=None,
          count: bool = False, until=None) -> MarchResult:
    """March ``ray`` (``media.LocalRay``) from ``t0`` to ``t1``.

    ``offset`` in [0, 1): length of the first step as a share of a full one (jitter; None: a full
    step). ``color``: array type of the medium's colour, or None for a density-only pass. ``until``:
    optical depth at which to end, for a march that only looks for that crossing. ``count``: count
    evaluations. Differentiable in the ray, ``t0``, ``t1``, ``until`` and the medium's parameters.
    """
    from .adjoint import attached, differentiable_march

    Float = type(ray.t_near)
    active = dr.mask_t(Float)(active) & (t0 < t1)
    arguments = (Float(t0), Float(t1), active, settings, offset, color, count, until)
    if attached(medium, ray, t0, t1):
        result = differentiable_march(medium, ray, *arguments)
    else:
        result = march_primal(medium, ray, *arguments)
    if until is not None and dr.grad_enabled(until):
        crossed = dr.isfinite(result.half)
        result.half = dr.select(crossed, dr.fma(result.half_slope, until - dr.detach(until), result.half), result.half)
    return result


def march_primal(medium, ray, t0, t1, active, settings, offset, color, count, until) -> MarchResult:
    """The march itself, without derivatives."""
    Float = type(t0)
    goal, end = limits(Float, settings, until)

    # The loops are functional rather than @dr.syntax: what they close over (fields, settings) stays
    # out of the loop state, where a field's weight arrays would be carried along lane by lane.
    def body(active, t, share, tau, moment, half, slope, total, n, m):
        active, t, delta, t_next = advance(medium, ray, t, t1, share, settings, active)
        p = ray.o + ray.d * (t + 0.5 * delta)
        sigma, features = (
            (medium.density(p, active), []) if color is None else medium.density_features(p, active)
        )
        dtau = dr.select(active, sigma * delta, 0)
        weight = dr.exp(-tau) * absorbed_share(dtau)
        moment = dr.fma(weight, dr.fma(delta, mean_depth_share(dtau), t), moment)
        crosses = active & (tau < goal) & (tau + dtau >= goal)
        inverse = delta / dr.select(crosses, dtau, 1)
        half = dr.select(crosses, dr.fma(goal - tau, inverse, t), half)
        slope = dr.select(crosses, inverse, slope)

        if color is not None:
            lit = active & (weight > settings.color_cutoff)
            total = total + weight * dr.if_stmt(
                (features, p), lit,
                lambda features, p: color(medium.color(features, p, ray.w, lit)),
                lambda features, p: dr.zeros(color),
                label="colour",
            )
            if count:
                m = m + dr.select(lit, 1, 0)
        if count:
            n = n + dr.select(active, 1, 0)

        tau = tau + dtau
        active = active & (t_next < t1) & (tau < end)
        return active, t_next, Float(1), tau, moment, half, slope, total, n, m

    start = (
        active, t0, Float(1 if offset is None else offset), Float(0), Float(0), Float(dr.inf), Float(0),
        None if color is None else dr.zeros(color), Float(0) if count else None,
        Float(0) if count and color is not None else None,
    )
    state = dr.while_loop(start, lambda active, *_: active, body, label="march")
    return MarchResult(*state[3:])


def limits(Float, settings: MarchSettings, until):
    """Optical depths ``(goal, end)``: whose crossing is looked for, and at which marching ends."""
    if until is None:
        return Float(LOG2), Float(settings.opaque)
    goal = Float(dr.detach(until))
    return goal, dr.minimum(goal, settings.opaque)


def advance(medium, ray, t, t1, share, settings, active):
    """The next step to evaluate: ``(active, t, delta, t_next)``, from ``t`` on, ``delta`` long."""
    if medium.occupancy is not None:
        t, share = _leap(medium, ray, t, t1, share, settings, active)
        active = active & (t < t1)
    # The last step ends at the exit; a step too short to move t ends the march.
    delta = dr.minimum(step_length(t, settings) * share, t1 - t)
    t_next = dr.minimum(t + delta, t1)
    return active & (t_next > t), t, delta, t_next


def step_length(t, settings: MarchSettings):
    """Length of the step that starts at ``t``."""
    if settings.dt_gamma == 0:
        return type(t)(settings.step)
    return dr.maximum(t * settings.dt_gamma, settings.step)


def _leap(medium, ray, t, t1, share, settings, active):
    """Advance ``t`` by whole steps to the first whose midpoint lies in an occupied cell."""
    grid = medium.occupancy
    cell = 1 / grid.resolution
    o, d = medium.to_unit(ray.o), ray.d / medium.unit_length()

    def body(seeking, t, share):
        step = step_length(t, settings) * share
        middle = t + 0.5 * dr.minimum(step, t1 - t)
        u = o + d * middle
        k = grid.empty_cells(u, seeking)
        # The cells at chessboard distance < k around this one are empty: a box of 2k - 1 cells.
        reach = (type(t)(k) - 1) * cell
        gap = type(t)(dr.inf)
        for uc, dc in zip((u.x, u.y, u.z), (d.x, d.y, d.z)):
            low = dr.floor(uc * grid.resolution) * cell - reach
            wall = dr.select(dc > 0, low + 2 * reach + cell, low) - uc
            gap = dr.minimum(gap, dr.select(dc != 0, wall / dr.select(dc != 0, dc, 1), dr.inf))
        # Every step whose midpoint is certainly in that box is passed over. The next one's midpoint is
        # half a step beyond this step's end; at least this step itself is passed.
        full = step_length(t, settings)
        whole = dr.maximum(dr.floor((middle + gap - t - step) / full + 0.5), 0)
        jump = seeking & (k > 0)
        t = dr.select(jump, t + step + whole * full, t)
        share = dr.select(jump, 1, share)
        return jump & (t < t1), t, share

    _, t, share = dr.while_loop((active, t, share), lambda seeking, *_: seeking, body, label="leap")
    return t, share
