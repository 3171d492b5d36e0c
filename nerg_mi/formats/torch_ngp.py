"""Checkpoints of torch-ngp and of the NeRG paper's authors: networks, grids and occupancy, in and out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.fields.encoding import Encoding, HashGrid, HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, count_cascade_levels
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceField
from nerg_mi.maths.geometry import Box

from .fields import translate_build_errors, check_sizes
from .torch_files import EnumStandIn, is_tensor, read_torch, to_numpy, write_torch

# ---- The state dictionary of a torch checkpoint, and the parts of fields in it ----
#
# torch-ngp stores no sizes: those are read off the shapes, and a hash grid's resolutions follow from what is given.


# More of either than any network has that is trained.
_LEVELS, _LAYERS = 64, 64


class StateDict:
    """The tensors of a checkpoint by name, below ``prefix``; ``averaged`` replaces some of them."""

    def __init__(self, path: Path, tensors: dict, prefix: str = "", averaged: dict | None = None):
        self.path, self.prefix, self._averaged = path, prefix, averaged or {}
        self._tensors = {
            k[len(prefix) :]: v
            for k, v in tensors.items()
            if isinstance(k, str) and k.startswith(prefix) and is_tensor(v)
        }

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    def names(self) -> list[str]:
        return list(self._tensors)

    def __getitem__(self, name: str) -> np.ndarray:
        self.shape(name)
        return to_numpy(self._averaged.get(name, self._tensors[name]), self.path)

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of ``self[name]``, which is not read."""
        if name not in self._tensors:
            raise NergError(
                f'"{self.path}" lacks "{self.prefix}{name}", which its kind of checkpoint holds; copy it again'
            )
        return tuple(self._tensors[name].shape)

    def get_weights(self, name: str) -> np.ndarray:
        """``self[name]`` in fp32. Raises `NergError` when it is not finite."""
        with np.errstate(over="ignore"):  # what fp32 cannot hold is not finite
            value = self[name].astype(np.float32)
        if not np.all(np.isfinite(value)):
            raise NergError(f'"{self.prefix}{name}" in "{self.path}" is not finite: its training has diverged')
        return value

    def select(self, prefix: str) -> StateDict:
        return StateDict(self.path, self._tensors, prefix)


def open_checkpoint(path: str | Path) -> tuple[dict, dict]:
    """``(whole file, state dictionary)`` of a checkpoint, or of a bare state dictionary."""
    whole = read_torch(path)
    if not isinstance(whole, dict):
        raise NergError(f'"{path}" holds a {type(whole).__name__}, not a checkpoint')
    model = whole.get("model", whole)
    if not isinstance(model, dict) or not any(is_tensor(v) for v in model.values()):
        raise NergError(f'"{path}" holds no weights: neither a state dictionary nor one under "model"')
    return whole, model


def find_averages(path: str | Path, checkpoint: dict, model: dict, use_averages: bool | None) -> dict:
    """Moving averages by name, those of ``ema["shadow_params"]``; {} for the raw weights.

    ``wanted``: True, False, or None for averages where the file has them. torch-ngp's best checkpoint (``ngp.pth``)
    keeps its averages as the weights themselves.
    """
    ema = checkpoint.get("ema")
    shadow = ema.get("shadow_params") if isinstance(ema, dict) else None
    shadow = shadow if isinstance(shadow, list) else []
    if (not use_averages and use_averages is not None) or not shadow:
        if use_averages and not shadow:
            raise NergError(f'"{path}" holds no moving averages: import its weights with --no-ema')
        return {}
    # Buffers are not averaged; parameters come in the order of the state dictionary.
    names = [k for k in model if k.endswith((".embeddings", ".weight", ".bias"))]
    if [tuple(model[k].shape) for k in names] != [tuple(v.shape) for v in shadow]:
        raise NergError(
            f'the {len(shadow)} moving averages of "{path}" do not fit its {len(names)} weights: '
            "import these with --no-ema"
        )
    return dict(zip(names, shadow))


def describe_origin(path: str | Path, checkpoint: dict, program: str, averaged: bool) -> dict:
    counts = {k: checkpoint[k] for k in ("epoch", "global_step") if isinstance(checkpoint.get(k), int)}
    return {
        "imported_from": Path(path).name,
        "format": program,
        "weights": "moving averages" if averaged else "raw",
        **counts,
    }


def shorten_floats(values: np.ndarray) -> np.ndarray:
    """The numbers that were typed: a bound of 2.7 stands in the file as the float32 next to it."""
    return np.array([float(str(v)) for v in values.astype(np.float32).ravel()])


def to_integer_if_whole(value: float) -> int | float:
    return int(value) if value == int(value) else value


def infer_sh_degree(state: StateDict, inputs: int) -> int:
    degree = math.isqrt(max(inputs, 0))
    if degree < 1 or degree**2 != inputs:
        raise NergError(
            f'the direction encoding of "{state.path}" has {inputs} numbers, so it is not spherical harmonics'
        )
    return degree


def infer_grid_config(state: StateDict, name: str, finest: float, dimensions: int = 3) -> HashGridConfig:
    """Configuration of the hash grid ``name``, whose level sizes are compared with those stored."""
    offsets, table = (
        state[f"{name}.offsets"].astype(int).ravel()[: _LEVELS + 2].tolist(),
        state.shape(f"{name}.embeddings"),
    )
    levels, largest = len(offsets) - 1, max(np.diff(offsets), default=0)
    if not 1 <= levels <= _LEVELS or largest < 8 or len(table) != 2:
        raise NergError(
            f'the hash grid "{state.prefix}{name}" of "{state.path}" has no levels, or more than {_LEVELS}; '
            "copy it again"
        )
    config = HashGridConfig(
        levels, table[1], max(int(largest) - 1, 1).bit_length(), finest=to_integer_if_whole(finest), dimensions=dimensions
    )
    if config.offsets() != offsets:
        raise NergError(
            f'the levels of "{state.prefix}{name}" in "{state.path}" begin at rows {offsets}, which is not a grid '
            f"from 16 to {finest:g}: give its finest resolution with --finest"
        )
    return config


def build_grid(state: StateDict, name: str, config: HashGridConfig, ns: ModuleType) -> HashGrid:
    return HashGrid(config, ns.Float(state.get_weights(f"{name}.embeddings").ravel()))


def build_network(state: StateDict, name: str, ns: ModuleType) -> MLP:
    """A network of layers ``name.0.weight``, ``name.1.weight``, ... without biases."""
    found = [k for k in state.names() if k.startswith(f"{name}.")]
    names = [f"{name}.{i}.weight" for i in range(max(len(found), 1))]
    if found and set(found) != set(names):
        raise NergError(f'"{name}" in "{state.path}" has {", ".join(found)}, where layers without biases are expected')
    if len(names) > _LAYERS:
        raise NergError(f'"{name}" in "{state.path}" has {len(names)} layers, and at most {_LAYERS} are read')
    return MLP([ns.TensorXf(state.get_weights(k)) for k in names])


# ---- Occupancy ----
#
# Occupancy as torch-ngp keeps it: bits of 128^3 cells in Morton order, a cube a cascade.

_CELLS = 128


def read_occupancy(state: StateDict, bound: float, ns: ModuleType, mean_density) -> OccupancyGrid | CascadeGrid | None:
    """From the bitfield, or else from the density grid; None for a field that was trained without either."""
    levels = count_cascade_levels(bound)
    density = state["density_grid"].reshape(levels, -1) if "density_grid" in state else None
    if "density_bitfield" in state:
        bits = np.unpackbits(state["density_bitfield"], bitorder="little").astype(bool)
    elif density is not None:
        # torch-ngp's own rule, with the threshold of its command line.
        bits = density.ravel() > min(float(np.maximum(density, 0).mean()), 10)
    else:
        return None
    if bits.size != levels * _CELLS**3:
        raise NergError(
            f'"{state.path}" has {bits.size} density bits where a bound of {bound:g} has {levels} x 128^3; '
            "take another checkpoint of its training"
        )
    bits = bits.reshape(levels, -1)
    if density is not None and not bits.all():
        # The largest density that the grid calls empty: cells never seen hold -1.
        threshold = max(float(density[~bits].max()), 0.0)
    else:
        threshold = min(float(mean_density), 10.0) if isinstance(mean_density, (int, float)) else 0.0
    if not np.isfinite(threshold):
        raise NergError(f'the densities of "{state.path}" are not finite: its training has diverged')
    ordered = bits[:, morton_order()].reshape(levels, _CELLS, _CELLS, _CELLS)
    return OccupancyGrid(ordered[0], ns, threshold) if levels == 1 else CascadeGrid(ordered, bound, ns, threshold)


def morton_order(cells: int = _CELLS) -> np.ndarray:
    """Morton index of every cell of a cube, listed x fastest, then y, then z; bits of x lowest, (cells^3,)."""
    spread = np.zeros(cells, np.int64)
    for bit in range(cells.bit_length() - 1):
        spread |= (np.arange(cells) >> bit & 1) << 3 * bit
    return (spread[:, None, None] << 2 | spread[:, None] << 1 | spread).ravel()


def pack_bitfield(occupancy, bound: float) -> np.ndarray:
    """Bits of all cascades in Morton order, packed; every bit is set where nothing is known."""
    levels = count_cascade_levels(bound)
    if occupancy is None:
        bits = np.ones((levels, _CELLS, _CELLS, _CELLS), bool)
    elif isinstance(occupancy, CascadeGrid) and (occupancy.bound, occupancy.resolution) == (bound, _CELLS):
        bits = occupancy.bits
    elif isinstance(occupancy, OccupancyGrid):
        bits = np.stack([_overlapped(occupancy.bits, min(2.0**k, bound) / bound) for k in range(levels)])
    else:
        raise NergError(
            f"cascades of {occupancy.resolution}^3 cells to a bound of {occupancy.bound:g} have no torch-ngp form"
        )
    packed = np.zeros((levels, _CELLS**3), bool)
    packed[:, morton_order()] = bits.reshape(levels, -1)
    return np.packbits(packed.ravel(), bitorder="little")


def _overlapped(bits: np.ndarray, share: float) -> np.ndarray:
    """Which cells of 128^3 over the middle ``share`` of the cube overlap an occupied cell of ``bits``."""
    n = len(bits)
    edges = (np.linspace(-share, share, _CELLS + 1) + 1) / 2 * n
    first = np.clip(np.floor(edges[:-1] + 1e-9).astype(int), 0, n - 1)
    last = np.clip(np.ceil(edges[1:] - 1e-9).astype(int), 1, n)
    for axis in range(3):
        counts = np.concatenate([np.zeros_like(bits.take([0], axis), int), np.cumsum(bits, axis, dtype=int)], axis)
        bits = counts.take(last, axis) > counts.take(first, axis)
    return bits


# ---- Checkpoints of torch-ngp (github.com/ashawkey/torch-ngp), in and out ----
#
# They hold a state dictionary and no sizes: those are read off the shapes, and the hash grid's resolutions
# follow from ``aabb_train``. What is not in the file is an argument here.

MARCH_STEP = 2 * math.sqrt(3) / 1024  # torch-ngp's shortest step, at its default of 1,024 steps


@dataclass(frozen=True)
class ImportOptions:
    """What the user says of a checkpoint because the file does not."""

    # The space that colours were trained in.
    color_space: str = "srgb"
    # Resolution of the finest level where it is not 2048 (of gaze fields: 256) x bound.
    finest: int | None = None
    # Of the background network's sphere, in the field's units; 0 leaves the network out.
    background_radius: float | None = None


DEFAULT_IMPORT_OPTIONS = ImportOptions()  # what holds for a checkpoint that torch-ngp's own defaults have trained


def read_torch_ngp(
    path: str | Path, ns: ModuleType, ema: bool | None = None, options: ImportOptions = DEFAULT_IMPORT_OPTIONS
) -> tuple[RadianceField, dict]:
    """The radiance field in a torch-ngp checkpoint on backend ``ns``, and what to say about its origin (JSON)."""
    whole, model = open_checkpoint(path)
    with translate_build_errors(path):
        averaged = find_averages(path, whole, model, ema)
        field = build_radiance_field(StateDict(Path(path), model, averaged=averaged), ns, options, whole.get("mean_density"))
    return field, describe_origin(path, whole, "torch-ngp", bool(averaged))


def build_radiance_field(state: StateDict, ns: ModuleType, options: ImportOptions, mean_density: float | None = None) -> RadianceField:
    """The field that a torch-ngp state dictionary describes."""
    for name in state.names():
        if name in ("encoder.params", "sigma_net.params", "color_net.params"):
            raise NergError(
                f'"{state.path}" was trained with --tcnn or --ff, whose layout is not read: retrain without'
            )
    box, bound = _box(state)
    density, color = build_network(state, "sigma_net", ns), build_network(state, "color_net", ns)
    width, geometry = density.weights[0].shape[0], density.outputs - 1
    sizes = infer_grid_config(state, "encoder", options.finest or 2048 * bound)
    config = RadianceConfig(
        sizes,
        width,
        len(density.weights) - 1,
        len(color.weights) - 1,
        geometry,
        infer_sh_degree(state, color.inputs - geometry),
    )
    check_sizes(config.to_dict(), "networks")
    return RadianceField(
        config,
        box,
        build_grid(state, "encoder", sizes, ns),
        density,
        color,
        read_occupancy(state, bound, ns, mean_density),
        options.color_space,
        MARCH_STEP,
        _background(state, ns, options, config.sh_degree),
    )


def _box(state: StateDict) -> tuple[Box, float]:
    train = shorten_floats(state["aabb_train"])
    aabb = shorten_floats(state["aabb_infer"]) if "aabb_infer" in state else train
    bound = float(np.abs(train).max())
    if train.shape != (6,) or aabb.shape != (6,) or not bound >= 1:
        boxes = " and ".join(sanitize(repr(box.tolist()), 80) for box in (train, aabb))
        raise NergError(f'the boxes of "{state.path}", {boxes}, are not those of a bound of at least 1')
    return Box(tuple(aabb[:3].tolist()), tuple(aabb[3:].tolist()), bound), bound


def _background(state: StateDict, ns: ModuleType, given: ImportOptions, degree: int) -> Background | None:
    if "bg_net.0.weight" not in state:
        return None
    if given.background_radius is None:
        raise NergError(
            f'"{state.path}" has a background network, and torch-ngp does not store its radius: '
            "give what it was trained with, --bg-radius 32 (say), or --bg-radius 0 to leave it out"
        )
    if given.background_radius == 0:
        return None
    net, sizes = build_network(state, "bg_net", ns), infer_grid_config(state, "encoder_bg", 2048, 2)
    config = BackgroundConfig(
        float(given.background_radius), sizes, net.weights[0].shape[0], len(net.weights) - 1, degree
    )
    return Background(config, build_grid(state, "encoder_bg", sizes, ns), net)


def make_state_dict(field: RadianceField) -> dict[str, np.ndarray]:
    """State dictionary with which torch-ngp's ``NeRFNetwork(bound)`` renders ``field``.

    Raises `NergError` naming what does not fit: torch-ngp fixes the sizes of its networks and grid by the bound.
    """
    c, box = field.config, field.box
    if not isinstance(c.grid, HashGridConfig):
        raise NergError(f'this field has no torch-ngp form: its positions go through "{c.grid.kind}", not a hash grid')
    bound = box.side / 2
    expected = HashGridConfig(
        levels=c.grid.levels, features=c.grid.features, log2_rows=c.grid.log2_rows, finest=max(to_integer_if_whole(2048 * bound), 16)
    )
    wrong = [
        words
        for fits, words in (
            (not box.is_contracted, "torch-ngp knows no contraction of what is around a box"),
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
        "density_bitfield": pack_bitfield(field.occupancy and field.occupancy.coarse, bound),
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
            "model": make_state_dict(field),
        },
    )


# ---- Nerg ----
#
# Checkpoints of the paper's authors (github.com/ch-andrei/nerg-neural-gaze): a gaze field, and the NeRF it looks
# at.

_VARIANTS = {"Emit": "emit", "Capture": "capture", "EmitCapture": "emit_capture"}
_HEADS = {
    "emit_head": ("emit_head.weight", "lin_emit.weight"),
    "capture_head": ("capture_head.weight", "lin_capture.weight"),
}


def is_nerg_checkpoint(model: dict) -> bool:
    """Whether a state dictionary is one of a gaze field."""
    return "net1.lin0.weight" in model or "net1.0.weight" in model


def read_nerg(
    path: str | Path, ns: ModuleType, ema: bool | None = None, options: ImportOptions = DEFAULT_IMPORT_OPTIONS
) -> tuple[RadianceField | None, GazeField, dict]:
    """Radiance field (None where the file holds none), gaze field and origin (JSON) of a NeRG checkpoint.

    The gaze field's finest resolution is 256 x bound, whatever ``given`` says of the NeRF's. Raises `NergError`
    for the variants that read other features than the gaze field's own.
    """
    whole, model = open_checkpoint(path)
    averaged = isinstance(whole.get("ema"), dict) and bool(whole["ema"])
    if ema is False and averaged:
        raise NergError(
            f'"{path}" keeps its moving averages as its weights and nothing else: import it without --no-ema'
        )
    if ema and not averaged:
        raise NergError(f'"{path}" holds no moving averages: import its weights with --no-ema')
    state = StateDict(Path(path), model)
    with translate_build_errors(path):
        gaze = build_gaze_field(state, _variant(state, whole.get("variant")), ns)
        nerf = state.select("model_nerf.")
        field = build_radiance_field(nerf, ns, options) if nerf.names() else None
    return field, gaze, describe_origin(path, whole, "NeRG", averaged)


def _variant(state: StateDict, stored) -> str:
    emit, capture = (any(n in state for n in names) for names in _HEADS.values())
    name = stored.value if isinstance(stored, EnumStandIn) else stored
    if name is None:
        name = {(True, True): "EmitCapture", (True, False): "Emit", (False, True): "Capture"}.get((emit, capture))
    if not isinstance(name, str) or name not in _VARIANTS or any(n.startswith("attend_head.") for n in state.names()):
        said = sanitize(name, 40) if isinstance(name, str) else "unknown"
        raise NergError(
            f'"{state.path}" is of the variant {said}; {", ".join(_VARIANTS)} are read, '
            "the others need the NeRF's features along the ray or an attention block"
        )
    if any(n.startswith("capture_head.") and n != "capture_head.weight" for n in state.names()):
        raise NergError(
            f'"{state.path}" captures gaze by a mixture of von Mises-Fisher lobes; only a linear head is read'
        )
    if ("Emit" in name and not emit) or ("Capture" in name and not capture):
        raise NergError(
            f'"{state.path}" is of the variant {name} and lacks one of its heads; '
            "take another checkpoint of its training"
        )
    return _VARIANTS[name]


def build_gaze_field(state: StateDict, variant: str, ns: ModuleType) -> GazeField:
    """The gaze field that the authors' state dictionary describes."""
    bound = float(np.abs(shorten_floats(state["aabb_train"])).max())
    normalized = "net1.lin0.weight" in state
    read = _normalized if normalized else _plain
    position, direction = read(state, "net1", ns), read(state, "net2", ns)
    width, geometry = direction.outputs, position.outputs
    if position.weights[0].shape[0] != width or direction.weights[0].shape[0] != width:
        raise NergError(f'the networks of "{state.path}" are not all {width} wide; networks of one width are read')
    sizes = infer_grid_config(state, "encoder", 256 * bound)
    config = GazeConfig(
        sizes,
        variant,
        "linear",
        width,
        geometry,
        infer_sh_degree(state, direction.inputs - geometry),
        trunk="layernorm" if normalized else "linear",
    )
    check_sizes(config.to_dict(), "networks")
    heads = [_head(state, names, width, ns) for names in _HEADS.values()]
    box, table = Box((-bound,) * 3, (bound,) * 3, bound), build_grid(state, "encoder", sizes, ns)
    return GazeField(config, box, table, position, direction, *heads)


def _head(state: StateDict, names: tuple, width: int, ns: ModuleType) -> MLP:
    found = [n for n in names if n in state]
    # A head that the variant lacks is never evaluated.
    return MLP([ns.TensorXf(state.get_weights(found[0]) if found else np.zeros((1, width), np.float32))])


def _normalized(state: StateDict, name: str, ns: ModuleType) -> MLP:
    array = lambda key: ns.TensorXf(state.get_weights(f"{name}.{key}"))
    norms = [
        {"gain": array(f"layernorm{i}.weight"), "shift": array(f"layernorm{i}.bias"), "bias": array(f"lin{i}.bias")}
        for i in range(2)
    ]
    return MLP([array(f"lin{i}.weight") for i in range(2)], norms)


def _plain(state: StateDict, name: str, ns: ModuleType) -> MLP:
    # ReLU and Dropout lie between the two layers of these Sequentials.
    return MLP([ns.TensorXf(state.get_weights(f"{name}.{i}.weight")) for i in (0, 3)])
