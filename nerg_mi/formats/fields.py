"""Radiance and gaze fields in and out of checkpoint files.

Weights may be stored in fp16 (half the size); they are fp32 once loaded.
"""
from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np

from ..field.box import Box
from ..field.gaze import GazeConfig, GazeField
from ..field.hashgrid import HashGrid
from ..field.mlp import MLP
from ..field.occupancy import OccupancyGrid
from ..field.radiance import RadianceConfig, RadianceField
from .checkpoint import read_checkpoint, write_checkpoint


def _dump(parameters: dict, half: bool) -> dict[str, np.ndarray]:
    return {k: np.asarray(v.numpy(), np.float16 if half else np.float32) for k, v in parameters.items()}


def _net(tensors: dict, name: str, layers: int, ns: ModuleType, path) -> MLP:
    weights = []
    for i in range(layers):
        key = f"{name}.{i}"
        if key not in tensors:
            raise ValueError(f'the checkpoint "{path}" lacks the weights "{key}" that its architecture names')
        weights.append(ns.TensorXf(tensors[key].astype(np.float32)))
    return MLP(weights)


def _check_shapes(net: MLP, sizes: list[int], name: str, path) -> MLP:
    shapes = [tuple(w.shape) for w in net.weights]
    expected = [(o, i) for i, o in zip(sizes, sizes[1:])]
    if shapes != expected:
        raise ValueError(f'"{name}" in "{path}" has layers {shapes} where its architecture needs {expected}')
    return net


def save_radiance(field: RadianceField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``; ``provenance`` (JSON) says what it was trained on and with."""
    tensors = _dump(field.parameters(), half)
    metadata = {
        "architecture": field.config.to_dict(),
        "box": field.box.to_dict(),
        "color_space": field.color_space,
        "march_step": field.march_step,
        "units": {"length": "scene unit", "density": "1 / scene unit"},
        "provenance": provenance,
    }
    if field.occupancy is not None:
        tensors["occupancy.bits"] = field.occupancy.packed()
        metadata["occupancy"] = {"resolution": field.occupancy.resolution, "threshold": field.occupancy.threshold}
    write_checkpoint(path, "radiance", tensors, metadata)


def load_radiance(path: str | Path, ns: ModuleType) -> tuple[RadianceField, dict]:
    """The field in ``path`` on backend ``ns`` (see ``field.backend.namespace``), and its metadata."""
    tensors, meta = read_checkpoint(path, "radiance")
    config = RadianceConfig.from_dict(meta["architecture"])
    occupancy = None
    if "occupancy" in meta:
        occupancy = OccupancyGrid.from_packed(tensors["occupancy.bits"], meta["occupancy"]["resolution"], ns,
                                              meta["occupancy"]["threshold"])
    nets = {}
    for name, sizes in (("density_net", config.density_sizes), ("color_net", config.color_sizes)):
        nets[name] = _check_shapes(_net(tensors, name, len(sizes) - 1, ns, path), sizes, name, path)
    field = RadianceField(
        config, Box(**meta["box"]), HashGrid(config.grid, ns.Float(tensors["grid.table"].astype(np.float32))),
        nets["density_net"], nets["color_net"], occupancy, meta["color_space"], meta["march_step"],
    )
    return field, meta


def save_gaze(field: GazeField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``; ``provenance`` (JSON) says what it was trained on and with."""
    metadata = {
        "architecture": field.config.to_dict(),
        "box": field.box.to_dict(),
        "units": {"length": "scene unit", "gaze": "1 / steradian"},
        "provenance": provenance,
    }
    write_checkpoint(path, "gaze", _dump(field.parameters(), half), metadata)


def load_gaze(path: str | Path, ns: ModuleType) -> tuple[GazeField, dict]:
    """The gaze field in ``path`` on backend ``ns``, and its metadata."""
    tensors, meta = read_checkpoint(path, "gaze")
    config = GazeConfig.from_dict(meta["architecture"])
    sizes = {
        "position_net": config.position_sizes, "direction_net": config.direction_sizes,
        "emit_head": [config.width, 1], "capture_head": [config.width, 1],
    }
    nets = {k: _check_shapes(_net(tensors, k, len(s) - 1, ns, path), s, k, path) for k, s in sizes.items()}
    grid = HashGrid(config.grid, ns.Float(tensors["grid.table"].astype(np.float32)))
    return GazeField(config, Box(**meta["box"]), grid, **nets), meta
