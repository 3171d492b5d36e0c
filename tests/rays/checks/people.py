"""People made up for checks of rays."""

import numpy as np

from nerg_mi.rays.rays import FRAME, Rays
from nerg_mi.rays.readers.frames import Frame
from nerg_mi.rays.summary import summarise


def walk(hit=True, frame=None, seed=0):
    """Two minutes of somebody who walks about at eye height and looks roughly ahead, at things two metres away."""
    rng = np.random.default_rng(seed)
    n = 6000
    t = np.arange(n) * 0.02
    heading = np.cumsum(rng.normal(0, 0.05, n))
    step = 0.02 * np.stack([np.cos(heading), np.sin(heading), np.zeros(n)], axis=1)
    origin = np.cumsum(step, axis=0) + [0, 0, 1.6]
    turned = heading + rng.normal(0, 0.6, n)
    d = np.stack([np.cos(turned), np.sin(turned), rng.normal(-0.2, 0.2, n)], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    metadata = {"frame": dict(FRAME), "transform": Frame(**(frame or {})).to_rays().tolist()}
    return Rays(t, np.zeros(n), ("ann",), origin, d, np.ones(n), origin + 2 * d if hit else None, metadata)


def warnings_of(rays):
    return " | ".join(summarise(rays).warnings)
