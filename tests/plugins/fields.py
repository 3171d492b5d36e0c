"""Small fields, written to files, for the tests of the plugins."""

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import save_gaze, save_radiance
from nerg_mi.maths.geometry import Box

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = Box((-1, -1, -1), (1, 1, 1))


def radiance(path, density_scale=2.0, seed=0, occupancy=None, geometry=7, deferred=False, **kwargs):
    field = RadianceNetwork.random(
        RadianceConfig(GRID, 16, geometry=geometry, sh_degree=2, density_scale=density_scale, deferred=deferred),
        BOX,
        ns,
        seed,
        occupancy=occupancy,
        march_step=0.1,
        **kwargs,
    )
    table = np.random.default_rng(seed).normal(size=len(field.grid.table)).astype(np.float32)
    field.set_parameters({"grid.table": ns.Float(table)})
    save_radiance(field, path, {"test": seed})
    return field


def gaze(path, variant="emit_capture", seed=1, **kwargs):
    field = ProductHead.random(GazeConfig(GRID, variant, width=16, geometry=7, sh_degree=2, **kwargs), BOX, ns, seed)
    table = 2 * np.random.default_rng(seed).normal(size=len(field.grid.table)).astype(np.float32)
    field.set_parameters({"grid.table": ns.Float(table)})
    save_gaze(field, path, {"test": seed})
    return field
