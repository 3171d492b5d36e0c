"""The marching of the paper's code, for comparison: an implementation of its rule apart from ``transport``.

As the inference kernels of torch-ngp do it, on which the paper's code rests: at most ``steps`` samples a ray; step
dt = clamp(t·γ, diagonal/steps, diagonal/128); density and colour sampled at the step's start; α = 1 - exp(-σ dt),
w = αT; a cell of the occupancy grid that is empty is left in multiples of dt; the march ends where T < 1e-4. Depth is
Σ w_i t_i with t_i the *end* of step i, and is not divided by the opacity Σ w_i. Every sample gets a colour.

Not taken over, because they would only make it worse here: fp16 networks, the near distance of 0.2, cascades.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import drjit as dr

from ..transport.march import MarchResult

STEPS = 1024
DT_GAMMA = 1 / 128
"""The step growth that the paper's code has by default for scenes larger than its unit cube."""
STOP = 1e-4


@dataclass
class PaperResult(MarchResult):
    """As a march's result, with a depth that is the bare weighted sum."""

    @property
    def expected_depth(self):
        return self.moment


def as_in_the_paper(integrator, steps: int = STEPS, dt_gamma: float = 0.0):
    """``integrator`` (of type ``nerg``, with depth ``expected``), marching camera and observer rays by the paper's rule.

    ``steps``: to the medium's diagonal, and most samples a ray; ``dt_gamma``: growth γ of steps with distance.
    """
    extent = integrator.medium.length_scale
    # The instance's own march is replaced; observers, gaze, colour and channels stay those of the integrator.
    integrator._march = functools.partial(
        _march, integrator.medium, steps=steps, shortest=extent / steps, longest=max(extent / 128, extent / steps), dt_gamma=dt_gamma
    )
    return integrator


def _march(medium, ray, t0, t1, active, *, offset=None, color=None, count=False, steps, shortest, longest, dt_gamma) -> PaperResult:
    Float = type(ray.t_near)
    grid = medium.occupancy

    def length(t):
        return dr.clip(t * dt_gamma, shortest, longest)

    def leave(seeking, t):
        """Out of an empty cell in whole steps, at least one."""
        u, v = medium.to_unit(ray.o + ray.d * t), medium.vector_to_unit(ray.d)
        empty = seeking & (grid.empty_cells(u, seeking) > 0)
        gap = Float(dr.inf)
        for uc, vc, cells in zip((u.x, u.y, u.z), (v.x, v.y, v.z), grid.cells):
            wall = dr.floor(uc * cells) + dr.select(vc > 0, 1, 0) - uc * cells
            gap = dr.minimum(gap, dr.select(vc != 0, wall / dr.select(vc != 0, vc * cells, 1), dr.inf))
        dt = length(t)
        t = dr.select(empty, t + dt * dr.maximum(dr.ceil(gap / dt), 1), t)
        return empty & (t < t1), t

    def body(active, t, transmittance, moment, total, n):
        if grid is not None:
            _, t = dr.while_loop((active, t), lambda seeking, *_: seeking, leave, label="paper leap")
        full = active & (t < t1)
        dt = length(t)
        p = ray.o + ray.d * t
        if color is None:
            sigma = medium.density(p, full)
        else:
            sigma, features = medium.density_features(p, full)
        weight = dr.select(full, (1 - dr.exp(-sigma * dt)) * transmittance, 0)
        moment = moment + weight * (t + dt)
        if color is not None:
            total = total + weight * color(medium.color(features, p, ray.w, full))
        # The kernels test the transmittance in front of the sample, so that one more is taken.
        more = transmittance >= STOP
        transmittance, n = transmittance - weight, n + dr.select(full, 1, 0)
        t = t + dt
        return full & (t < t1) & more & (n < steps), t, transmittance, moment, total, n

    start = (
        dr.mask_t(Float)(active) & (t0 < t1), Float(t0) if offset is None else t0 + offset * length(t0), Float(1), Float(0),
        None if color is None else dr.zeros(color), Float(0),
    )  # fmt: skip
    _, _, transmittance, moment, total, n = dr.while_loop(start, lambda active, *_: active, body, label="paper march")
    tau = -dr.log(dr.maximum(transmittance, 1e-30))
    nothing = Float(0)
    evals = (n, n if color is not None else None) if count else (None, None)
    return PaperResult(tau, moment, Float(dr.inf), nothing, nothing, nothing, total, *evals)
