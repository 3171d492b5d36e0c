"""How much of what photos show lies beyond the part of a place that its field resolves best."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.photos.images import View

from .preview import Preview


def share_beyond(views: list[View], render: Callable[[View], Preview], core: Box, every: int = 1) -> float:
    """Share of the pixels of ``views`` (every ``every``-th, from ``every // 2`` on) that show what lies outside of
    ``core``, or nothing, by the depths that ``render`` finds for them."""
    outside = []
    for view in views:
        seen = render(view)
        d = pixel_directions(view.camera.intrinsics)[every // 2 :: every, every // 2 :: every]
        p = view.camera.center + seen.depth[..., None] * (d @ view.camera.to_world[:3, :3].T)
        inside = (seen.opacity > 0.5) & np.all((p >= core.lower) & (p <= core.upper), axis=-1)
        outside.append(~inside.ravel())
    return float(np.mean(np.concatenate(outside)))
