"""Small places of Gaussian splats, and rays through them."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.splats import Splats, harmonics_of
from nerg_mi.maths.geometry import Similarity
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium


def medium_of(splats: Splats, to_world: Similarity | None = None) -> SplatMedium:
    return SplatMedium(SplatArrays(splats, ns), to_world)


def stack(depths, opacities, scale=0.1, colors=None) -> Splats:
    """Balls on the z axis."""
    n = len(depths)
    centers = np.stack([np.zeros(n), np.zeros(n), np.asarray(depths, float)], axis=1)
    colors = np.full((n, 3), 0.5) if colors is None else colors
    return Splats(centers, np.full((n, 3), scale), [[1, 0, 0, 0]] * n, opacities, harmonics_of(colors))


def rays(count: int, seed: int = 0, size: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    """Origins in a cube and unit directions, float32."""
    rng = np.random.default_rng(seed)
    o, d = rng.uniform(-size, size, (count, 3)), rng.normal(size=(count, 3))
    return o.astype(np.float32), (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
