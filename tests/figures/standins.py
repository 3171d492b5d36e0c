"""Fields for the demo without trained fields of the store: the store's walls and furniture in random
colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np

BOX = ((-0.1, -0.1, -0.1), (8.1, 6.1, 3.1))
CELLS = 64


def solid_cells() -> np.ndarray:
    """Cells (z, y, x), bool, of walls or furniture: 13 cm wide, on the unit cube of the store's box."""
    from nerg_mi.scenes.store import layout

    from nerg_mi.maths.geometry import Box

    box = Box(*BOX)
    axis = (np.arange(CELLS) + 0.5) / CELLS
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    p = (np.stack([x, y, z], axis=-1) - 0.5) * box.side + np.array(box.center)
    bits = np.any((p < 0) | (p > layout.ROOM), axis=-1)
    for low, high in layout.build_store().solids:
        bits |= np.all((p > low) & (p < high), axis=-1)
    return bits


def write_standins(folder: Path) -> dict[str, str]:
    """Write a radiance and a gaze field into ``folder``; returns the scene's defaults that name them."""
    import mitsuba as mi

    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.fields.occupancy import OccupancyGrid
    from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
    from nerg_mi.formats.fields import save_gaze, save_radiance
    from nerg_mi.maths.geometry import Box

    ns, box = namespace(mi.variant()), Box(*BOX)
    grid = HashGridConfig(levels=4, log2_rows=12, base=4, finest=24)
    config = RadianceConfig(grid=grid, width=16, color_hidden=1, density_scale=100.0)
    occupancy = OccupancyGrid(solid_cells(), ns, 1.0)
    radiance = RadianceNetwork.random(config, box, ns, 1, occupancy=occupancy, march_step=0.05)
    gaze = ProductHead.random(GazeConfig(grid=grid, width=16), box, ns, 2)
    for field in (radiance, gaze):
        table = field.parameters()["grid.table"]
        field.set_parameters({"grid.table": table * float(1 / np.abs(table.numpy()).max())})
    paths = {"field": folder / "store.safetensors", "gaze": folder / "shoppers.safetensors"}
    save_radiance(radiance, paths["field"], {"made": "random"})
    save_gaze(gaze, paths["gaze"], {"made": "random", "rays": 4_321, "people": 12})
    return {name: str(path) for name, path in paths.items()}
