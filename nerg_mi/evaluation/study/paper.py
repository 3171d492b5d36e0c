"""The marching of the paper's code, for comparison: an implementation of its rule apart from ``transport``.

As the inference kernels of torch-ngp do it, on which the paper's code rests: at most ``steps`` samples a ray; step
dt = clamp(t·γ, diagonal/steps, diagonal/128); density and colour sampled at the step's start; α = 1 - exp(-σ dt),
w = αT; a cell of the occupancy grid that is empty is left in multiples of dt; the march ends where T < 1e-4. Depth is
Σ w_i t_i with t_i the *end* of step i, and is not divided by the opacity Σ w_i. Every sample gets a colour. The
observer's ray towards p_d is marched likewise, and its depth compared with the distance.

Not taken over, because they would only make it worse here: fp16 networks, the near distance of 0.2, cascades, a
comparison tolerance of 1e-5 (ours is the study's), gaze without a surface, and a sign of the shadow that shows what is
hidden. A normalised gaze field is divided by the integral that ``nerg`` finds: the paper has none.
"""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr

from nerg_mi.maths.color import composite_to_linear
from nerg_mi.transport import observer
from nerg_mi.transport.field_medium import color_painter
from nerg_mi.transport.geometry import Place
from nerg_mi.transport.observer import visibility

STEPS = 1024
DT_GAMMA = 1 / 128
"""The step growth that the paper's code has by default for scenes larger than its unit cube."""
STOP = 1e-4


def as_in_the_paper(integrator, sensor, tolerance: float, steps: int = STEPS, dt_gamma: float = 0.0):
    """An integrator with the field, gaze, observer and AOVs of ``integrator`` (of type ``nerg``) that marches by the
    paper's rule.

    ``sensor``: the camera, which is the observer where there is no other; ``tolerance`` of visibility in scene units;
    ``steps``: to the medium's diagonal, and most samples a ray; ``dt_gamma``: growth γ of steps with distance.
    Its AOVs are depth, opacity, visibility, gaze and the three counts.
    """
    import mitsuba as mi

    return _integrator_class(mi.variant())(integrator, sensor, tolerance, steps, dt_gamma)


@functools.cache
def _integrator_class(variant: str):
    """The class for a variant; Mitsuba's must not be derived from when this module is imported."""
    import mitsuba as mi

    class PaperIntegrator(mi.SamplingIntegrator):
        def __init__(self, like, sensor, tolerance, steps, dt_gamma):
            super().__init__(mi.Properties())
            self._like, self._sensor, self._tolerance = like, sensor, tolerance
            extent = like.medium.length_scale
            self._march = functools.partial(
                march,
                like.medium,
                steps=steps,
                shortest=extent / steps,
                longest=max(extent / 128, extent / steps),
                dt_gamma=dt_gamma,
            )

        def aov_names(self):
            return self._like.aov_names()

        def sample(self, scene, sampler, ray, medium=None, active=True):
            like, names = self._like, self._like.aovs
            painter, active = None, mi.Bool(active)
            if like.radiance and like.medium.has_color:
                spectral = like.medium.color_space == "spectrum"
                painter = color_painter(like.medium, mi.Spectrum if spectral else mi.Color3f)
            local = like.medium.local(ray.o, ray.d)
            t0, t1 = dr.maximum(local.t_near, 0), dr.minimum(local.t_far, ray.maxt)
            alpha, depth, total, n = self._march(local, t0, t1, active, painter)
            surface = alpha >= like.observer_settings.surface_opacity
            out = {
                "depth": depth,
                "opacity": alpha,
                "density_evals": n,
                "color_evals": mi.Float(0) if painter is None else n,
            }
            if painter is not None and like.medium.deferred:
                out["color_evals"] = dr.select(alpha > 0, mi.Float(1), 0)
            if {"visibility", "gaze"} & set(names):
                out["density_evals"] = n + self._look(ray.o + ray.d * depth, surface, out, "gaze" in names)
            L = mi.Spectrum(0)
            if like.radiance:
                L = (1 - alpha) * like.background
                if painter is not None:
                    color = painter.color(like.medium, total, alpha, local, active)
                    L += composite_to_linear(color, alpha, like.medium.color_space)
            return L, alpha > 0, [out[name] for name in names]

        def _look(self, p_d, surface, out, gaze):
            """Visibility, gaze and their count into ``out``; returns the density evaluations made."""
            like = self._like
            p_o = observer.center(self._sensor if like.observer is None else like.observer)
            distance = dr.norm(p_d - p_o)
            r_o = (p_d - p_o) / (distance + 1e-6)
            local = like.medium.local(p_o, r_o)
            alpha, depth, _, n = self._march(local, dr.maximum(local.t_near, 0), local.t_far, surface, None)
            d_o = dr.select(alpha >= like.observer_settings.surface_opacity, depth, distance)
            seen = dr.select(surface, visibility(distance, d_o, like.falloff, self._tolerance), 0)
            out["visibility"] = seen
            if gaze:
                place, attended = Place(like.medium), surface & (seen > 0)
                observed = like.gaze.at([p_o], place, like.observer_settings, like.cache)
                density = observed.evaluate(p_o + r_o * d_o, p_o, r_o, attended)[0]
                out["gaze"] = dr.select(attended, density * seen, 0)
                out["gaze_evals"] = dr.select(surface, mi.Float(like.gaze.field.networks), 0.0)
            return n

    return PaperIntegrator


def _whole_cells(occupancy: Any) -> Any:
    """The grid that is as fine as the paper's, which knows no parts of cells; None where there is none."""
    return None if occupancy is None else occupancy.coarse


def march(medium, ray, t0, t1, active, painter, *, steps, shortest, longest, dt_gamma):
    """``(opacity, depth, sum of what samples contribute, samples)`` of ``ray`` (`LocalRay`) between ``t0`` and ``t1``.

    ``painter``: what samples contribute (``medium.Painter``), or None for a density-only pass.
    """
    Float = type(ray.t_near)
    grid = _whole_cells(medium.occupancy)

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
        if painter is None:
            sigma, features = medium.density(p, full), None
        else:
            sigma, features = medium.density_features(p, full)
        weight = dr.select(full, (1 - dr.exp(-sigma * dt)) * transmittance, 0)
        moment = moment + weight * (t + dt)
        if painter is not None:
            total = total + weight * painter.paint(medium, features, p, ray.w, full)
        # The kernels test the transmittance in front of the sample, so that one more is taken.
        more = transmittance >= STOP
        transmittance, n = transmittance - weight, n + dr.select(full, 1, 0)
        t = t + dt
        return full & (t < t1) & more & (n < steps), t, transmittance, moment, total, n

    start = (
        dr.mask_t(Float)(active) & (t0 < t1),
        Float(t0),
        Float(1),
        Float(0),
        None if painter is None else painter.zero(),
        Float(0),
    )
    _, _, transmittance, moment, total, n = dr.while_loop(start, lambda active, *_: active, body, label="paper march")
    return 1 - transmittance, moment, total, n
