"""Small gaze fields of every kind in files, for tests that compare rendering and evaluation."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import GazeEnsemble, make_prior_table
from nerg_mi.fields.gaze_hits import HitKernel, ReaimedHits
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions

KINDS = ("linear", "normalised", "default recipe", "re-aimed hits", "ensemble")
GRID = HashGridConfig(levels=2, log2_rows=10, base=2, finest=4)


def made(kind: str, box: Box, seed: int = 4, **options):
    """Make a field of ``kind`` with strong variation, so that evaluation errors are detected."""
    if kind in ("ensemble", "re-aimed hits"):
        members = [made("default recipe", box, s, **options) for s in (seed, seed + 1)]
        field = GazeEnsemble(members) if kind == "ensemble" else members[0]
        corners, rng = np.array([box.lower, box.upper]), np.random.default_rng(seed)
        origins, points = rng.uniform(*corners, (2, 50, 3))
        field.hits = ReaimedHits(
            origins, points, [HitKernel(0.3, 0.3 * box.side, 30.0), HitKernel(0.1, 1.5 * box.side, 8.0)]
        )
        return field
    rng = np.random.default_rng(seed)
    if kind == "default recipe":
        config = LogGazeConfig(grid=GRID, width=16, prior=16, heads=(box.lower, box.upper), mix=0.2, **options)
        prior = make_prior_table(np.exp(0.5 * rng.normal(size=512)) / 14.2, 16, ns, fibonacci_directions(1 << 14))
        field = LogGazeField.random(config, box, ns, seed, prior)
        steep = {k: 8 * v for k, v in field.parameters().items() if k in ("emit_net.2", "capture_net.2")} | {
            "escaped": ns.Float(0.4)
        }
    else:
        field = ProductHead.random(
            GazeConfig(GRID, width=16, geometry=7, sh_degree=2, normalized=kind == "normalised", **options),
            box,
            ns,
            seed,
        )
        steep = {k: 30 * v for k, v in field.parameters().items() if k in ("emit_head.0", "capture_head.0")}
    table = 2 * rng.normal(size=len(field.grid.table)).astype(np.float32)
    field.set_parameters({"grid.table": ns.Float(table), **steep})
    return field


def saved(path, kind: str, box: Box, seed: int = 4, **options):
    """Make a field of ``kind`` and write it to ``path``."""
    field = made(kind, box, seed, **options)
    save_gaze(field, path, {})
    return field
