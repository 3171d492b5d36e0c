"""Import and export of checkpoints of torch-ngp and of the authors of the NeRG paper: networks, grids and occupancy.

- torch-ngp (``ngp_ep*.pth``, ``ngp.pth``, a bare state dictionary): hash grid, both networks, the density bitfield
  of all cascades (or the density grid, where there is no bitfield), background network, ``aabb_infer``. Not read:
  ``--tcnn`` and ``--ff`` backbones, align_corners grids, networks with biases. A tiled or smoothstep grid has the
  shapes of a hashed linear one and cannot be distinguished from it.
- NeRG (``nerg_ep*.pth``): the gaze field (LayerNorm networks or plain ones) and the NeRF in the same file; variants
  Emit, Capture, EmitCapture. Not read: Semantic and Attend variants, von Mises-Fisher heads.

Files are read by ``torch.load(weights_only=True)``, after their pickle is checked against a list of permitted
classes and functions; anything else is refused by name. Files older than torch 1.6, with a pickle protocol other
than 2, or compressed afterwards are refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.fields.encoding import HashGrid, HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, count_cascade_levels
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceNetwork
from nerg_mi.files.html import Summary
from nerg_mi.maths.geometry import Box

from .fields import check_sizes, translate_build_errors
from .torch_files import EnumStandIn, is_tensor, read_torch, to_numpy, write_torch

# ---- State dictionaries, and the parts of fields in them ----
#
# torch-ngp does not store sizes. They are inferred from the shapes; the resolutions of a hash grid follow from the
# bound.

# Limits above those of any trained network.
_MAX_LEVELS, _MAX_LAYERS = 64, 64


class StateDict:
    """The tensors of a checkpoint whose names start with ``prefix``; ``averaged`` replaces some of them."""

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
        """Return the shape of ``self[name]`` without reading it."""
        if name not in self._tensors:
            raise NergError(
                f'"{self.path}" lacks "{self.prefix}{name}", which this kind of checkpoint contains; copy it again'
            )
        return tuple(self._tensors[name].shape)

    def get_weights(self, name: str) -> np.ndarray:
        """Return ``self[name]`` as fp32. Raises `NergError` if it is not finite."""
        with np.errstate(over="ignore"):  # values beyond fp32 become infinite
            value = self[name].astype(np.float32)
        if not np.all(np.isfinite(value)):
            raise NergError(f'"{self.prefix}{name}" in "{self.path}" is not finite: its training has diverged')
        return value

    def select(self, prefix: str) -> StateDict:
        return StateDict(self.path, self._tensors, prefix)


def open_checkpoint(path: str | Path) -> tuple[dict, dict]:
    """Return ``(complete file, state dictionary)`` of a checkpoint, or of a bare state dictionary."""
    checkpoint = read_torch(path)
    if not isinstance(checkpoint, dict):
        raise NergError(f'"{path}" contains a {type(checkpoint).__name__}, not a checkpoint')
    model = checkpoint.get("model", checkpoint)
    if not isinstance(model, dict) or not any(is_tensor(v) for v in model.values()):
        raise NergError(f'"{path}" contains no weights: neither a state dictionary nor one under "model"')
    return checkpoint, model


def find_averages(path: str | Path, checkpoint: dict, model: dict, use_averages: bool | None) -> dict:
    """Return the moving averages ``ema["shadow_params"]`` by name; {} to use the raw weights.

    ``use_averages``: True, False, or None to use averages if the file contains them. torch-ngp's best checkpoint
    (``ngp.pth``) stores its averages in place of the weights.
    """
    ema = checkpoint.get("ema")
    shadow = ema.get("shadow_params") if isinstance(ema, dict) else None
    shadow = shadow if isinstance(shadow, list) else []
    if (not use_averages and use_averages is not None) or not shadow:
        if use_averages and not shadow:
            raise NergError(f'"{path}" contains no moving averages: import its weights with {parameter("ema", False)}')
        return {}
    # Buffers are not averaged; parameters are in the order of the state dictionary.
    names = [k for k in model if k.endswith((".embeddings", ".weight", ".bias"))]
    if [tuple(model[k].shape) for k in names] != [tuple(v.shape) for v in shadow]:
        raise NergError(
            f'the {len(shadow)} moving averages of "{path}" do not match its {len(names)} weights: import the '
            f"weights with {parameter('ema', False)}"
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
    """Return the shortest decimals that round to the float32 ``values``: a bound of 2.7 is stored as the nearest
    float32.
    """
    return np.array([float(str(v)) for v in values.astype(np.float32).ravel()])


def to_integer_if_whole(value: float) -> int | float:
    return int(value) if value == int(value) else value


def infer_sh_degree(state: StateDict, inputs: int) -> int:
    degree = math.isqrt(max(inputs, 0))
    if degree < 1 or degree**2 != inputs:
        raise NergError(
            f'the direction encoding of "{state.path}" has {inputs} numbers, which does not match spherical harmonics'
        )
    return degree


def infer_grid_config(state: StateDict, name: str, finest: float, dimensions: int = 3) -> HashGridConfig:
    """Infer the configuration of the hash grid ``name``, and compare its level sizes with the stored ones."""
    offsets, table = (
        state[f"{name}.offsets"].astype(int).ravel()[: _MAX_LEVELS + 2].tolist(),
        state.shape(f"{name}.embeddings"),
    )
    levels, largest = len(offsets) - 1, max(np.diff(offsets), default=0)
    if not 1 <= levels <= _MAX_LEVELS or largest < 8 or len(table) != 2:
        raise NergError(
            f'the hash grid "{state.prefix}{name}" of "{state.path}" has no levels, or more than {_MAX_LEVELS}; '
            "copy it again"
        )
    config = HashGridConfig(
        levels,
        table[1],
        max(int(largest) - 1, 1).bit_length(),
        finest=to_integer_if_whole(finest),
        dimensions=dimensions,
    )
    if config.offsets() != offsets:
        raise NergError(
            f'the levels of "{state.prefix}{name}" in "{state.path}" start at rows {offsets}, which does not match '
            f"a grid from 16 to {finest:g}: set its finest resolution with {parameter('finest_resolution')}"
        )
    return config


def build_grid(state: StateDict, name: str, config: HashGridConfig, ns: ModuleType) -> HashGrid:
    return HashGrid(config, ns.Float(state.get_weights(f"{name}.embeddings").ravel()))


def build_network(state: StateDict, name: str, ns: ModuleType) -> MLP:
    """Build a network from layers ``name.0.weight``, ``name.1.weight``, ... without biases."""
    stored_names = [k for k in state.names() if k.startswith(f"{name}.")]
    names = [f"{name}.{i}.weight" for i in range(max(len(stored_names), 1))]
    if stored_names and set(stored_names) != set(names):
        raise NergError(
            f'"{name}" in "{state.path}" has {", ".join(stored_names)}, but only layers without biases are supported'
        )
    if len(names) > _MAX_LAYERS:
        raise NergError(f'"{name}" in "{state.path}" has {len(names)} layers; the limit is {_MAX_LAYERS}')
    return MLP([ns.TensorXf(state.get_weights(k)) for k in names])


# ---- Occupancy in torch-ngp: bits of 128^3 cells in Morton order, one cube per cascade ----

_CELLS = 128


def read_occupancy(state: StateDict, bound: float, ns: ModuleType, mean_density) -> OccupancyGrid | CascadeGrid | None:
    """Read the occupancy from the bitfield, or otherwise from the density grid; None if the field has neither."""
    levels = count_cascade_levels(bound)
    density = state["density_grid"].reshape(levels, -1) if "density_grid" in state else None
    if "density_bitfield" in state:
        bits = np.unpackbits(state["density_bitfield"], bitorder="little").astype(bool)
    elif density is not None:
        # The rule of torch-ngp with its default threshold.
        bits = density.ravel() > min(float(np.maximum(density, 0).mean()), 10)
    else:
        return None
    if bits.size != levels * _CELLS**3:
        raise NergError(
            f'"{state.path}" has {bits.size} density bits, but a bound of {bound:g} needs {levels} x 128^3; '
            "use another checkpoint of the training"
        )
    bits = bits.reshape(levels, -1)
    if density is not None and not bits.all():
        # The largest density of an empty cell; cells that were never seen contain -1.
        threshold = max(float(density[~bits].max()), 0.0)
    else:
        threshold = min(float(mean_density), 10.0) if isinstance(mean_density, (int, float)) else 0.0
    if not np.isfinite(threshold):
        raise NergError(f'the densities of "{state.path}" are not finite: its training has diverged')
    ordered = bits[:, morton_order()].reshape(levels, _CELLS, _CELLS, _CELLS)
    return OccupancyGrid(ordered[0], ns, threshold) if levels == 1 else CascadeGrid(ordered, bound, ns, threshold)


def morton_order(cells: int = _CELLS) -> np.ndarray:
    """Return the Morton index of each cell of a cube, (cells^3,), with x varying fastest, then y, then z; x has
    the lowest bits.
    """
    spread = np.zeros(cells, np.int64)
    for bit in range(cells.bit_length() - 1):
        spread |= (np.arange(cells) >> bit & 1) << 3 * bit
    return (spread[:, None, None] << 2 | spread[:, None] << 1 | spread).ravel()


def pack_bitfield(occupancy, bound: float) -> np.ndarray:
    """Pack the bits of all cascades in Morton order. All bits are set if there is no occupancy."""
    levels = count_cascade_levels(bound)
    if occupancy is None:
        bits = np.ones((levels, _CELLS, _CELLS, _CELLS), bool)
    elif isinstance(occupancy, CascadeGrid) and (occupancy.bound, occupancy.resolution) == (bound, _CELLS):
        bits = occupancy.bits
    elif isinstance(occupancy, OccupancyGrid):
        bits = np.stack([_overlap_cells(occupancy.bits, min(2.0**k, bound) / bound) for k in range(levels)])
    else:
        raise NergError(
            f"torch-ngp cannot represent cascades of {occupancy.resolution}^3 cells with a bound of {occupancy.bound:g}"
        )
    packed = np.zeros((levels, _CELLS**3), bool)
    packed[:, morton_order()] = bits.reshape(levels, -1)
    return np.packbits(packed.ravel(), bitorder="little")


def _overlap_cells(bits: np.ndarray, fraction: float) -> np.ndarray:
    """Return which of 128^3 cells over the central ``fraction`` of the cube overlap an occupied cell of ``bits``."""
    n = len(bits)
    edges = (np.linspace(-fraction, fraction, _CELLS + 1) + 1) / 2 * n
    first = np.clip(np.floor(edges[:-1] + 1e-9).astype(int), 0, n - 1)
    last = np.clip(np.ceil(edges[1:] - 1e-9).astype(int), 1, n)
    for axis in range(3):
        counts = np.concatenate([np.zeros_like(bits.take([0], axis), int), np.cumsum(bits, axis, dtype=int)], axis)
        bits = counts.take(last, axis) > counts.take(first, axis)
    return bits


# ---- Checkpoints of torch-ngp (github.com/ashawkey/torch-ngp) ----
#
# They contain a state dictionary, but no sizes. These are inferred from the shapes, and the resolutions of the hash
# grid from ``aabb_train``. Other values that the file lacks are parameters.

MARCH_STEP = 2 * math.sqrt(3) / 1024  # minimum step of torch-ngp with its default of 1,024 steps


@dataclass(frozen=True)
class ImportOptions:
    """Values that a checkpoint does not contain."""

    # Colour space of the training.
    color_space: str = "srgb"
    # Resolution of the finest level, if it is not 2048 x bound (gaze fields: 256 x bound).
    finest: int | None = None
    # Radius of the sphere of the background network, in the units of the field; 0 ignores the network.
    background_radius: float | None = None


DEFAULT_IMPORT_OPTIONS = ImportOptions()  # for checkpoints that were trained with the defaults of torch-ngp


def read_torch_ngp(
    path: str | Path, ns: ModuleType, ema: bool | None = None, options: ImportOptions = DEFAULT_IMPORT_OPTIONS
) -> tuple[RadianceNetwork, dict]:
    """Read the radiance field in a torch-ngp checkpoint on the backend ``ns``, and its provenance (JSON).

    ``ema``: whether to use moving averages; None uses them if the file contains them.
    """
    checkpoint, model = open_checkpoint(path)
    with translate_build_errors(path):
        averaged = find_averages(path, checkpoint, model, ema)
        field = build_radiance_field(
            StateDict(Path(path), model, averaged=averaged), ns, options, checkpoint.get("mean_density")
        )
    return field, describe_origin(path, checkpoint, "torch-ngp", bool(averaged))


def build_radiance_field(
    state: StateDict, ns: ModuleType, options: ImportOptions, mean_density: float | None = None
) -> RadianceNetwork:
    """Build the field of a torch-ngp state dictionary."""
    for name in state.names():
        if name in ("encoder.params", "sigma_net.params", "color_net.params"):
            raise NergError(
                f'"{state.path}" was trained with the option tcnn or ff, whose layout is not supported: train '
                "it without them"
            )
    box, bound = _read_box(state)
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
    return RadianceNetwork(
        config,
        box,
        build_grid(state, "encoder", sizes, ns),
        density,
        color,
        read_occupancy(state, bound, ns, mean_density),
        options.color_space,
        MARCH_STEP,
        _build_background(state, ns, options, config.sh_degree),
    )


def _read_box(state: StateDict) -> tuple[Box, float]:
    train = shorten_floats(state["aabb_train"])
    aabb = shorten_floats(state["aabb_infer"]) if "aabb_infer" in state else train
    bound = float(np.abs(train).max())
    if train.shape != (6,) or aabb.shape != (6,) or not bound >= 1:
        boxes = " and ".join(sanitize(repr(box.tolist()), 80) for box in (train, aabb))
        raise NergError(f'the boxes of "{state.path}", {boxes}, do not match a bound of at least 1')
    return Box(tuple(aabb[:3].tolist()), tuple(aabb[3:].tolist()), bound), bound


def _build_background(state: StateDict, ns: ModuleType, options: ImportOptions, degree: int) -> Background | None:
    if "bg_net.0.weight" not in state:
        return None
    if options.background_radius is None:
        raise NergError(
            f'"{state.path}" has a background network, and torch-ngp does not store its radius: set the radius of '
            f"the training, such as {parameter('bg_radius', 32)}, or {parameter('bg_radius', 0)} to ignore the "
            "background"
        )
    if options.background_radius == 0:
        return None
    net, sizes = build_network(state, "bg_net", ns), infer_grid_config(state, "encoder_bg", 2048, 2)
    config = BackgroundConfig(
        float(options.background_radius), sizes, net.weights[0].shape[0], len(net.weights) - 1, degree
    )
    return Background(config, build_grid(state, "encoder_bg", sizes, ns), net)


def make_state_dict(field: RadianceNetwork) -> dict[str, np.ndarray]:
    """Make a state dictionary with which torch-ngp's ``NeRFNetwork(bound)`` renders ``field``.

    Raises `NergError` with the reasons if torch-ngp cannot represent the field: the bound determines the sizes of its
    networks and its grid.
    """
    c, box = field.config, field.box
    if not isinstance(c.grid, HashGridConfig):
        raise NergError(f'torch-ngp cannot represent this field: its encoding is "{c.grid.kind}", not a hash grid')
    bound = box.side / 2
    expected = HashGridConfig(
        levels=c.grid.levels,
        features=c.grid.features,
        log2_rows=c.grid.log2_rows,
        finest=max(to_integer_if_whole(2048 * bound), 16),
    )
    mismatches = [
        reason
        for is_supported, reason in (
            (not box.is_contracted, "torch-ngp does not support contraction outside of the box"),
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
            (not c.deferred, "torch-ngp evaluates the colour network at each sample, this field once per ray"),
            (c.density_scale == 1, f"its density scale must be 1, not {c.density_scale:g}"),
        )
        if not is_supported
    ]
    if mismatches:
        raise NergError(f"torch-ngp cannot represent this field: {'; '.join(mismatches)}")
    cube = np.array([-bound] * 3 + [bound] * 3, np.float32)
    state = {
        "aabb_train": cube,
        "aabb_infer": np.array([*box.lower, *box.upper], np.float32),
        "density_bitfield": pack_bitfield(field.occupancy and field.occupancy.coarse, bound),
        "step_counter": np.zeros((16, 2), np.int32),
    }
    _store_grid(state, "encoder", field.grid)
    _store_layers(state, "sigma_net", field.density_net)
    _store_layers(state, "color_net", field.color_net)
    if field.background is not None:
        _store_grid(state, "encoder_bg", field.background.grid)
        _store_layers(state, "bg_net", field.background.net)
    return state


def _store_grid(state: dict, name: str, grid: HashGrid) -> None:
    state[f"{name}.embeddings"] = grid.named()["table"].numpy().reshape(-1, grid.config.features)
    state[f"{name}.offsets"] = np.array(grid.config.offsets(), np.int32)


def _store_layers(state: dict, name: str, net: MLP) -> None:
    state |= {f"{name}.{i}.weight": w.numpy() for i, w in enumerate(net.weights)}


@dataclass(frozen=True, eq=False, repr=False)
class TorchNgpModel(Summary):
    """The networks of a radiance field as a checkpoint of torch-ngp: ``state`` has the arrays by name."""

    state: dict[str, np.ndarray]
    mean_density: float

    def save(self, path: str | Path) -> None:
        """Write the checkpoint (.pth) in the form of torch-ngp's ``ngp.pth``, without density grid and optimiser."""
        stats = {"loss": [], "valid_loss": [], "results": [], "checkpoints": [], "best_result": None}
        head = {"epoch": 0, "global_step": 0, "stats": stats, "mean_count": 0}
        write_torch(path, {**head, "mean_density": self.mean_density, "model": self.state})


def make_torch_ngp(field: RadianceNetwork) -> TorchNgpModel:
    """Return ``field`` in the layout of torch-ngp. Raises `NergError` if its grid or networks do not fit."""
    return TorchNgpModel(make_state_dict(field), 0.0 if field.occupancy is None else field.occupancy.coarse.threshold)


# ---- Checkpoints of the NeRG authors (github.com/ch-andrei/nerg-neural-gaze): a gaze field and its NeRF ----

_VARIANTS = {"Emit": "emit", "Capture": "capture", "EmitCapture": "emit_capture"}
_HEADS = {
    "emit_head": ("emit_head.weight", "lin_emit.weight"),
    "capture_head": ("capture_head.weight", "lin_capture.weight"),
}


def is_nerg_checkpoint(model: dict) -> bool:
    """Return whether a state dictionary is that of a gaze field."""
    return "net1.lin0.weight" in model or "net1.0.weight" in model


def read_nerg(
    path: str | Path, ns: ModuleType, ema: bool | None = None, options: ImportOptions = DEFAULT_IMPORT_OPTIONS
) -> tuple[RadianceNetwork | None, ProductHead, dict]:
    """Read a NeRG checkpoint: radiance field (None if the file has none), gaze field, and provenance (JSON).

    The finest resolution of the gaze field is always 256 x bound; ``options`` apply to the NeRF. Raises `NergError` for
    the variants that use features of other networks.
    """
    checkpoint, model = open_checkpoint(path)
    averaged = isinstance(checkpoint.get("ema"), dict) and bool(checkpoint["ema"])
    if ema is False and averaged:
        raise NergError(f'"{path}" stores only the moving averages: import it without {parameter("ema", False)}')
    if ema and not averaged:
        raise NergError(f'"{path}" contains no moving averages: import its weights with {parameter("ema", False)}')
    state = StateDict(Path(path), model)
    with translate_build_errors(path):
        gaze = build_gaze_field(state, _read_variant(state, checkpoint.get("variant")), ns)
        nerf = state.select("model_nerf.")
        field = build_radiance_field(nerf, ns, options) if nerf.names() else None
    return field, gaze, describe_origin(path, checkpoint, "NeRG", averaged)


def _read_variant(state: StateDict, stored) -> str:
    emit, capture = (any(n in state for n in names) for names in _HEADS.values())
    name = stored.value if isinstance(stored, EnumStandIn) else stored
    if name is None:
        name = {(True, True): "EmitCapture", (True, False): "Emit", (False, True): "Capture"}.get((emit, capture))
    if not isinstance(name, str) or name not in _VARIANTS or any(n.startswith("attend_head.") for n in state.names()):
        shown = sanitize(name, 40) if isinstance(name, str) else "unknown"
        raise NergError(
            f'"{state.path}" has the variant {shown}; {", ".join(_VARIANTS)} are supported, '
            "the others need features of the NeRF along the ray or an attention block"
        )
    if any(n.startswith("capture_head.") and n != "capture_head.weight" for n in state.names()):
        raise NergError(
            f'"{state.path}" has a capture head with a mixture of von Mises-Fisher lobes; only a linear head is '
            "supported"
        )
    if ("Emit" in name and not emit) or ("Capture" in name and not capture):
        raise NergError(
            f'"{state.path}" has the variant {name} but lacks one of its heads; use another checkpoint of the training'
        )
    return _VARIANTS[name]


def build_gaze_field(state: StateDict, variant: str, ns: ModuleType) -> ProductHead:
    """Build the gaze field of a state dictionary of the authors."""
    bound = float(np.abs(shorten_floats(state["aabb_train"])).max())
    normalized = "net1.lin0.weight" in state
    build = _build_normalized_network if normalized else _build_plain_network
    position, direction = build(state, "net1", ns), build(state, "net2", ns)
    width, geometry = direction.outputs, position.outputs
    if position.weights[0].shape[0] != width or direction.weights[0].shape[0] != width:
        raise NergError(
            f'the networks of "{state.path}" do not all have the width {width}; networks of different widths are not '
            "supported"
        )
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
    heads = [_build_head(state, names, width, ns) for names in _HEADS.values()]
    box, table = Box((-bound,) * 3, (bound,) * 3, bound), build_grid(state, "encoder", sizes, ns)
    return ProductHead(config, box, table, position, direction, *heads)


def _build_head(state: StateDict, names: tuple, width: int, ns: ModuleType) -> MLP:
    present = [n for n in names if n in state]
    # A head that the variant lacks is not evaluated.
    return MLP([ns.TensorXf(state.get_weights(present[0]) if present else np.zeros((1, width), np.float32))])


def _build_normalized_network(state: StateDict, name: str, ns: ModuleType) -> MLP:
    array = lambda key: ns.TensorXf(state.get_weights(f"{name}.{key}"))
    norms = [
        {"gain": array(f"layernorm{i}.weight"), "shift": array(f"layernorm{i}.bias"), "bias": array(f"lin{i}.bias")}
        for i in range(2)
    ]
    return MLP([array(f"lin{i}.weight") for i in range(2)], norms)


def _build_plain_network(state: StateDict, name: str, ns: ModuleType) -> MLP:
    # ReLU and Dropout are between the two layers of these Sequentials.
    return MLP([ns.TensorXf(state.get_weights(f"{name}.{i}.weight")) for i in (0, 3)])
