"""Checkpoints of the paper's authors (github.com/ch-andrei/nerg-neural-gaze): a gaze field, and the NeRF it looks
at."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.safe_read import plain
from nerg_mi.formats.architecture import building, check_sizes
from nerg_mi.maths.geometry import Box

from .archive import NamedValue
from .fields import AS_TRAINED_BY_DEFAULT, Given, radiance_field
from .state_dict import StateDict, decimals, grid, grid_config, open_checkpoint, origin, sh_degree

_VARIANTS = {"Emit": "emit", "Capture": "capture", "EmitCapture": "emit_capture"}
_HEADS = {
    "emit_head": ("emit_head.weight", "lin_emit.weight"),
    "capture_head": ("capture_head.weight", "lin_capture.weight"),
}


def is_nerg(model: dict) -> bool:
    """Whether a state dictionary is one of a gaze field."""
    return "net1.lin0.weight" in model or "net1.0.weight" in model


def read_nerg(
    path: str | Path, ns: ModuleType, ema: bool | None = None, given: Given = AS_TRAINED_BY_DEFAULT
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
    with building(path):
        gaze = gaze_field(state, _variant(state, whole.get("variant")), ns)
        nerf = state.below("model_nerf.")
        field = radiance_field(nerf, ns, given) if nerf.names() else None
    return field, gaze, origin(path, whole, "NeRG", averaged)


def _variant(state: StateDict, stored) -> str:
    emit, capture = (any(n in state for n in names) for names in _HEADS.values())
    name = stored.value if isinstance(stored, NamedValue) else stored
    if name is None:
        name = {(True, True): "EmitCapture", (True, False): "Emit", (False, True): "Capture"}.get((emit, capture))
    if not isinstance(name, str) or name not in _VARIANTS or any(n.startswith("attend_head.") for n in state.names()):
        said = plain(name, 40) if isinstance(name, str) else "unknown"
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


def gaze_field(state: StateDict, variant: str, ns: ModuleType) -> GazeField:
    """The gaze field that the authors' state dictionary describes."""
    bound = float(np.abs(decimals(state["aabb_train"])).max())
    normalized = "net1.lin0.weight" in state
    read = _normalized if normalized else _plain
    position, direction = read(state, "net1", ns), read(state, "net2", ns)
    width, geometry = direction.outputs, position.outputs
    if position.weights[0].shape[0] != width or direction.weights[0].shape[0] != width:
        raise NergError(f'the networks of "{state.path}" are not all {width} wide; networks of one width are read')
    sizes = grid_config(state, "encoder", 256 * bound)
    config = GazeConfig(
        sizes,
        variant,
        "linear",
        width,
        geometry,
        sh_degree(state, direction.inputs - geometry),
        trunk="layernorm" if normalized else "linear",
    )
    check_sizes(config.to_dict(), "networks")
    heads = [_head(state, names, width, ns) for names in _HEADS.values()]
    box, table = Box((-bound,) * 3, (bound,) * 3, bound), grid(state, "encoder", sizes, ns)
    return GazeField(config, box, table, position, direction, *heads)


def _head(state: StateDict, names: tuple, width: int, ns: ModuleType) -> MLP:
    found = [n for n in names if n in state]
    # A head that the variant lacks is never evaluated.
    return MLP([ns.TensorXf(state.weights(found[0]) if found else np.zeros((1, width), np.float32))])


def _normalized(state: StateDict, name: str, ns: ModuleType) -> MLP:
    array = lambda key: ns.TensorXf(state.weights(f"{name}.{key}"))
    norms = [
        {"gain": array(f"layernorm{i}.weight"), "shift": array(f"layernorm{i}.bias"), "bias": array(f"lin{i}.bias")}
        for i in range(2)
    ]
    return MLP([array(f"lin{i}.weight") for i in range(2)], norms)


def _plain(state: StateDict, name: str, ns: ModuleType) -> MLP:
    # ReLU and Dropout lie between the two layers of these Sequentials.
    return MLP([ns.TensorXf(state.weights(f"{name}.{i}.weight")) for i in (0, 3)])
