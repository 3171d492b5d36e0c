"""Checkpoints of torch-ngp (github.com/ashawkey/torch-ngp), in and out.

They hold a state dictionary and no sizes: those are read off the shapes, and the hash grid's resolutions
follow from ``aabb_train``. What is not in the file is an argument here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import Encoding, HashGridConfig
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceField
from nerg_mi.formats.architecture import building, check_sizes
from nerg_mi.maths.geometry import Box

from .archive import write_torch
from .occupancy import bitfield, read_occupancy
from .state_dict import (
    StateDict,
    averaged_weights,
    decimals,
    grid,
    grid_config,
    layers,
    open_checkpoint,
    origin,
    sh_degree,
    whole,
)

MARCH_STEP = 2 * math.sqrt(3) / 1024
"""torch-ngp's shortest step, at its default of 1,024 steps."""


@dataclass(frozen=True)
class Given:
    """What the user says of a checkpoint because the file does not."""

    # The space that colours were trained in.
    color_space: str = "srgb"
    # Resolution of the finest level where it is not 2048 (of gaze fields: 256) x bound.
    finest: int | None = None
    # Of the background network's sphere, in the field's units; 0 leaves the network out.
    background_radius: float | None = None


AS_TRAINED_BY_DEFAULT = Given()
"""What holds for a checkpoint that torch-ngp's own defaults have trained."""


def read_torch_ngp(
    path: str | Path, ns: ModuleType, ema: bool | None = None, given: Given = AS_TRAINED_BY_DEFAULT
) -> tuple[RadianceField, dict]:
    """The radiance field in a torch-ngp checkpoint on backend ``ns``, and what to say about its origin (JSON)."""
    whole, model = open_checkpoint(path)
    with building(path):
        averaged = averaged_weights(path, whole, model, ema)
        field = radiance_field(StateDict(Path(path), model, averaged=averaged), ns, given, whole.get("mean_density"))
    return field, origin(path, whole, "torch-ngp", bool(averaged))


def radiance_field(state: StateDict, ns: ModuleType, given: Given, mean_density: float | None = None) -> RadianceField:
    """The field that a torch-ngp state dictionary describes."""
    for name in state.names():
        if name in ("encoder.params", "sigma_net.params", "color_net.params"):
            raise NergError(
                f'"{state.path}" was trained with --tcnn or --ff, whose layout is not read: retrain without'
            )
    box, bound = _box(state)
    density, color = layers(state, "sigma_net", ns), layers(state, "color_net", ns)
    width, geometry = density.weights[0].shape[0], density.outputs - 1
    sizes = grid_config(state, "encoder", given.finest or 2048 * bound)
    config = RadianceConfig(
        sizes,
        width,
        len(density.weights) - 1,
        len(color.weights) - 1,
        geometry,
        sh_degree(state, color.inputs - geometry),
    )
    check_sizes(config.to_dict(), "networks")
    return RadianceField(
        config,
        box,
        grid(state, "encoder", sizes, ns),
        density,
        color,
        read_occupancy(state, bound, ns, mean_density),
        given.color_space,
        MARCH_STEP,
        _background(state, ns, given, config.sh_degree),
    )


def _box(state: StateDict) -> tuple[Box, float]:
    train = decimals(state["aabb_train"])
    aabb = decimals(state["aabb_infer"]) if "aabb_infer" in state else train
    bound = float(np.abs(train).max())
    if train.shape != (6,) or aabb.shape != (6,) or not bound >= 1:
        raise NergError(f'the boxes of "{state.path}", {train} and {aabb}, are not those of a bound of at least 1')
    return Box(tuple(aabb[:3].tolist()), tuple(aabb[3:].tolist()), bound), bound


def _background(state: StateDict, ns: ModuleType, given: Given, degree: int) -> Background | None:
    if "bg_net.0.weight" not in state:
        return None
    if given.background_radius is None:
        raise NergError(
            f'"{state.path}" has a background network, and torch-ngp does not store its radius: '
            "give what it was trained with, --bg-radius 32 (say), or --bg-radius 0 to leave it out"
        )
    if given.background_radius == 0:
        return None
    net, sizes = layers(state, "bg_net", ns), grid_config(state, "encoder_bg", 2048, 2)
    config = BackgroundConfig(
        float(given.background_radius), sizes, net.weights[0].shape[0], len(net.weights) - 1, degree
    )
    return Background(config, grid(state, "encoder_bg", sizes, ns), net)


def torch_ngp_state(field: RadianceField) -> dict[str, np.ndarray]:
    """State dictionary with which torch-ngp's ``NeRFNetwork(bound)`` renders ``field``.

    Raises `NergError` naming what does not fit: torch-ngp fixes the sizes of its networks and grid by the bound.
    """
    c, box = field.config, field.box
    if not isinstance(c.grid, HashGridConfig):
        raise NergError(f'this field has no torch-ngp form: its positions go through "{c.grid.kind}", not a hash grid')
    bound = box.side / 2
    expected = HashGridConfig(
        levels=c.grid.levels, features=c.grid.features, log2_rows=c.grid.log2_rows, finest=max(whole(2048 * bound), 16)
    )
    wrong = [
        words
        for fits, words in (
            (not box.contracted, "torch-ngp knows no contraction of what is around a box"),
            (
                box.center == (0, 0, 0) and bound >= 1,
                f"its unit cube must be [-b, b]^3 with b >= 1, not {box.lower} to {box.upper}",
            ),
            (
                c.grid == expected,
                f"its grid must be from 16 to {expected.finest}, not {c.grid.base} to {c.grid.finest}",
            ),
            (
                (c.grid.levels, c.grid.features, c.grid.log2_rows) == (16, 2, 19),
                "its grid must have 16 levels of 2 features and 2^19 rows",
            ),
            (
                (c.width, c.density_hidden, c.color_hidden, c.geometry, c.sh_degree) == (64, 1, 2, 15, 4),
                "its networks must be 64 wide (paper size)",
            ),
            (not c.deferred, "torch-ngp asks the colour network at every sample, and its own once a ray"),
            (c.density_scale == 1, f"its density scale must be 1, not {c.density_scale:g}"),
        )
        if not fits
    ]
    if wrong:
        raise NergError(f"this field has no torch-ngp form: {'; '.join(wrong)}")
    cube = np.array([-bound] * 3 + [bound] * 3, np.float32)
    state = {
        "aabb_train": cube,
        "aabb_infer": np.array([*box.lower, *box.upper], np.float32),
        "density_bitfield": bitfield(field.occupancy and field.occupancy.coarse, bound),
        "step_counter": np.zeros((16, 2), np.int32),
    }
    _put_grid(state, "encoder", field.grid)
    _put_layers(state, "sigma_net", field.density_net)
    _put_layers(state, "color_net", field.color_net)
    if field.background is not None:
        _put_grid(state, "encoder_bg", field.background.grid)
        _put_layers(state, "bg_net", field.background.net)
    return state


def _put_grid(state: dict, name: str, grid: Encoding) -> None:
    state[f"{name}.embeddings"] = grid.named()["table"].numpy().reshape(-1, grid.config.features)
    state[f"{name}.offsets"] = np.array(grid.config.offsets(), np.int32)


def _put_layers(state: dict, name: str, net: MLP) -> None:
    state |= {f"{name}.{i}.weight": w.numpy() for i, w in enumerate(net.weights)}


def write_torch_ngp(field: RadianceField, path: str | Path) -> None:
    """Write ``field`` as a torch-ngp checkpoint, of the form of its ``ngp.pth``: no density grid, no optimiser."""
    stats = {"loss": [], "valid_loss": [], "results": [], "checkpoints": [], "best_result": None}
    threshold = 0.0 if field.occupancy is None else field.occupancy.coarse.threshold
    write_torch(
        path,
        {
            "epoch": 0,
            "global_step": 0,
            "stats": stats,
            "mean_count": 0,
            "mean_density": threshold,
            "model": torch_ngp_state(field),
        },
    )
