"""The settings of an integrator, read back so that another one can be made of them."""

from __future__ import annotations

import numpy as np


def parameters(integrator) -> dict:
    """The parameters of an integrator of type ``nerg``, read back by the names of its manual page."""
    names = ("occlusion", "radiance", "jitter")
    march = ("step", "dt_gamma", "stop", "color_cutoff", "quadrature", "coarse", "refined")
    out = {n: getattr(integrator, n) for n in names} | {n: getattr(integrator.settings, n) for n in march}
    observer = integrator.observer_settings
    seen = ("depth", "surface_opacity", "visibility", "tolerance", "map_height", "directions", "integral_tolerance")
    return out | {
        "falloff": float(integrator.falloff[0]),
        **{n: getattr(observer, n) for n in seen},
        "background": np.array(integrator.background, float).ravel().tolist(),
    }


def extent(integrator) -> float | None:
    """Where the Gaussians of its field are cut off, in standard deviations; None where its field is none of these."""
    medium = integrator.medium
    return None if medium is None or medium.hits is None else medium.arrays.extent
