"""Weights of fields as the arrays of a checkpoint: checked on their way in and on their way out.

Weights may be stored in fp16 (half the size); they are fp32 once loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import Encoding, EncodingConfig, encoding_of
from nerg_mi.fields.gaze_base import LARGEST, limits_of
from nerg_mi.fields.mlp import MLP, aligned

from .architecture import check_sizes


def stored(parameters: Mapping[str, Any], half: bool) -> dict[str, np.ndarray]:
    """The Dr.Jit arrays ``parameters`` for a file, in fp16 if ``half``. Raises `NergError` for what is not finite, or
    beyond `LARGEST`."""
    out = {}
    for name, value in parameters.items():
        value = value.numpy()
        with np.errstate(over="ignore"):  # what exceeds fp16 is refused below, by name
            out[name] = value.astype(np.float16 if half else np.float32)
        if not np.all(np.abs(value) <= LARGEST):
            raise NergError(
                f'the weight array "{name}" is not finite, or beyond {LARGEST:g}, so that the training has diverged; '
                "train with a lower learning rate"
            )
        if not np.all(np.isfinite(out[name])):
            raise NergError(f'the weight array "{name}" exceeds what fp16 can hold; leave out --half')
    return out


class StoredArrays:
    """The arrays of a checkpoint by name, as parts of fields on the backend ``ns``.

    All methods raise ``KeyError`` for an array that is not there and ``ValueError`` for one that does not fit.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], ns: ModuleType):
        self._tensors, self.ns = tensors, ns

    def raw(self, name: str) -> np.ndarray:
        """The array ``name`` as it is stored."""
        return self._tensors[name]

    def array(self, name: str, *shape: int | None, largest: float = LARGEST) -> np.ndarray:
        """The array ``name`` in fp32, aligned, where it has the ``shape`` (None: of any length) and no value beyond
        ``largest``."""
        found = self._tensors[name].shape
        if len(found) != len(shape) or any(want not in (None, have) for want, have in zip(shape, found)):
            needed = " x ".join("any" if n is None else str(n) for n in shape)
            raise ValueError(f'the weight array "{name}" has the shape {found} where its configuration needs {needed}')
        with np.errstate(over="ignore"):  # what fp32 cannot hold is not finite
            value = aligned(self._tensors[name])
        if not np.all(np.isfinite(value)):
            raise ValueError(f'the weight array "{name}" is not finite')
        if np.abs(value).max(initial=0) > largest:
            raise ValueError(f'the weight array "{name}" holds values beyond {largest:g}, as no training makes them')
        return value

    def grid(self, config: EncodingConfig, name: str = "grid") -> Encoding:
        """The encoding ``name`` of ``config``."""
        arrays = {f"{name}.{key}": self._dr(f"{name}.{key}", *shape) for key, shape in config.shapes().items()}
        return encoding_of(config, arrays, name)

    def net(self, name: str, sizes: list[int], normalized: bool = False) -> MLP:
        """The network ``name`` whose layers have these ``sizes``; ``normalized``: with LayerNorm's gains and shifts."""
        tensor = lambda key, *shape: self.ns.TensorXf(self.array(f"{name}.{key}", *shape))
        layers, norms = list(enumerate(zip(sizes, sizes[1:]))), None
        if normalized:
            norms = [
                {"gain": tensor(f"{i}.gain", n), "shift": tensor(f"{i}.shift", n), "bias": tensor(f"{i}.bias", m)}
                for i, (n, m) in layers
            ]
        return MLP([tensor(i, m, n) for i, (n, m) in layers], norms)

    def member(self, index: int, about: dict[str, Any]) -> tuple[dict[str, Any], StoredArrays]:
        """The checked architecture, and the arrays, of the member ``index`` of an ensemble."""
        own = {k.removeprefix(f"{index}."): v for k, v in self._tensors.items() if k.startswith(f"{index}.")}
        return check_sizes(about, most=limits_of(about)), StoredArrays(own, self.ns)

    def _dr(self, name: str, *shape: int) -> Any:
        value = self.array(name, *shape)
        return self.ns.Float(value) if len(shape) == 1 else self.ns.TensorXf(value)
