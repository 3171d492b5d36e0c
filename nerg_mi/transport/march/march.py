"""Volume rendering along rays: the march through a medium, with derivatives where any are tracked.

Chooses between the plain march (``primal``) and the one that can be differentiated by marching again (``adjoint``), and
lets steps be coarse in front of all matter.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr

from nerg_mi.maths.types import Bool, Float
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.painting import Painter
from nerg_mi.transport.media.protocol import Medium

from .adjoint import March, attached, differentiable_march
from .hit_adjoint import HitMarch
from .hits import march_hits
from .occlusion import Occlusion
from .primal import march_primal
from .settings import MarchResult, MarchSettings

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
    until: Float | None = None,
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
    arguments = (Float(t0), Float(t1), active, settings, offset, color, count, until, fine_from)
    if medium.hits is not None:
        if attached(medium, ray, t0, t1):
            result = differentiable_march(HitMarch, medium, ray, *arguments)
        else:
            result = march_hits(medium, medium.hits, ray, *arguments[:4], color, count, until, occlusion)
    elif attached(medium, ray, t0, t1):
        result = differentiable_march(March, medium, ray, *arguments)
    else:
        result = march_primal(medium, ray, *arguments, occlusion)
    result.origin = arguments[0]
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
        return dr.select(dr.isfinite(found.half), found.enter - scout.step, dr.inf), found.density_evals


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
