"""Fields of random weights, and rays, that are asked through torch."""

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceField
from nerg_mi.maths.geometry import Box

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = Box((-1, -1, -1), (1, 1, 1))
RNG = np.random.default_rng(0)


def varied(field):
    field.set_parameters({"grid.table": ns.Float(RNG.normal(size=len(field.grid.table)).astype(np.float32))})
    return field


def radiance(background=False, deferred=False):
    behind = Background.random(
        BackgroundConfig(3.0, HashGridConfig(levels=2, log2_rows=8, base=4, finest=16, dimensions=2), 16), ns
    )
    return varied(
        RadianceField.random(
            RadianceConfig(GRID, width=16, geometry=7, deferred=deferred),
            BOX,
            ns,
            background=behind if background else None,
        )
    )


def rays(torch, n=200):
    p = RNG.uniform(-1.05, 1.05, (n, 3)).astype(np.float32)
    d = RNG.normal(size=(n, 3))
    return torch.tensor(p), torch.tensor((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32))
