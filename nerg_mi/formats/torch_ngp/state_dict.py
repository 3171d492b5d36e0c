"""The state dictionary of a torch checkpoint, and the parts of fields in it.

torch-ngp stores no sizes: those are read off the shapes, and a hash grid's resolutions follow from what is given.
"""

from __future__ import annotations

import math
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGrid, HashGridConfig
from nerg_mi.fields.mlp import MLP

from .archive import is_tensor, read_torch, to_numpy

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

    def weights(self, name: str) -> np.ndarray:
        """``self[name]`` in fp32. Raises `NergError` when it is not finite."""
        with np.errstate(over="ignore"):  # what fp32 cannot hold is not finite
            value = self[name].astype(np.float32)
        if not np.all(np.isfinite(value)):
            raise NergError(f'"{self.prefix}{name}" in "{self.path}" is not finite: its training has diverged')
        return value

    def below(self, prefix: str) -> StateDict:
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


def averaged_weights(path: str | Path, whole: dict, model: dict, wanted: bool | None) -> dict:
    """Moving averages by name, those of ``ema["shadow_params"]``; {} for the raw weights.

    ``wanted``: True, False, or None for averages where the file has them. torch-ngp's best checkpoint (``ngp.pth``)
    keeps its averages as the weights themselves.
    """
    ema = whole.get("ema")
    shadow = ema.get("shadow_params") if isinstance(ema, dict) else None
    shadow = shadow if isinstance(shadow, list) else []
    if (not wanted and wanted is not None) or not shadow:
        if wanted and not shadow:
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


def origin(path: str | Path, whole: dict, program: str, averaged: bool) -> dict:
    counts = {k: whole[k] for k in ("epoch", "global_step") if isinstance(whole.get(k), int)}
    return {
        "imported_from": Path(path).name,
        "format": program,
        "weights": "moving averages" if averaged else "raw",
        **counts,
    }


def decimals(values: np.ndarray) -> np.ndarray:
    """The numbers that were typed: a bound of 2.7 stands in the file as the float32 next to it."""
    return np.array([float(str(v)) for v in values.astype(np.float32).ravel()])


def whole(value: float) -> int | float:
    return int(value) if value == int(value) else value


def sh_degree(state: StateDict, inputs: int) -> int:
    degree = math.isqrt(max(inputs, 0))
    if degree < 1 or degree**2 != inputs:
        raise NergError(
            f'the direction encoding of "{state.path}" has {inputs} numbers, so it is not spherical harmonics'
        )
    return degree


def grid_config(state: StateDict, name: str, finest: float, dimensions: int = 3) -> HashGridConfig:
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
        levels, table[1], max(int(largest) - 1, 1).bit_length(), finest=whole(finest), dimensions=dimensions
    )
    if config.offsets() != offsets:
        raise NergError(
            f'the levels of "{state.prefix}{name}" in "{state.path}" begin at rows {offsets}, which is not a grid '
            f"from 16 to {finest:g}: give its finest resolution with --finest"
        )
    return config


def grid(state: StateDict, name: str, config: HashGridConfig, ns: ModuleType) -> HashGrid:
    return HashGrid(config, ns.Float(state.weights(f"{name}.embeddings").ravel()))


def layers(state: StateDict, name: str, ns: ModuleType) -> MLP:
    """A network of layers ``name.0.weight``, ``name.1.weight``, ... without biases."""
    found = [k for k in state.names() if k.startswith(f"{name}.")]
    names = [f"{name}.{i}.weight" for i in range(max(len(found), 1))]
    if found and set(found) != set(names):
        raise NergError(f'"{name}" in "{state.path}" has {", ".join(found)}, where layers without biases are expected')
    if len(names) > _LAYERS:
        raise NergError(f'"{name}" in "{state.path}" has {len(names)} layers, and at most {_LAYERS} are read')
    return MLP([ns.TensorXf(state.weights(k)) for k in names])
