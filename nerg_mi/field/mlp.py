"""Small fully connected networks, evaluated inside kernels or as tensor products.

Two execution modes share one set of weights: cooperative vectors (one fused
kernel, best for rendering) and tensor products (``W @ X`` on whole batches,
whose weight gradient on the LLVM backend is several times cheaper than the
atomically accumulated outer products of cooperative vectors; best for training).
"""
from __future__ import annotations

from types import ModuleType

import drjit as dr
import drjit.nn as nn
import numpy as np

from .backend import is_cuda, namespace


class MLP:
    """ReLU network without biases; the last layer is linear.

    ``weights``: one TensorXf of shape (outputs, inputs) a layer, in fp32. On
    CUDA the cooperative-vector path converts them to fp16, which the hardware's
    matrix units require; on LLVM fp16 is slower than fp32 and is not used.
    """

    DRJIT_STRUCT = {"weights": list}

    def __init__(self, weights: list):
        self.weights = list(weights)
        self._views = None
        # What the kernels read: the packed weights of all layers, attached to ``weights``.
        self.buffer = None
        for first, second in zip(self.weights, self.weights[1:]):
            if first.shape[0] != second.shape[1]:
                raise ValueError(
                    f"layers of this network do not fit together: shapes {[w.shape for w in self.weights]}"
                )

    @staticmethod
    def random(sizes: list[int], ns: ModuleType, rng: np.random.Generator) -> MLP:
        """Kaiming-uniform weights (as torch's Linear) for layer ``sizes`` [inputs, ..., outputs]."""
        weights = []
        for fan_in, fan_out in zip(sizes, sizes[1:]):
            bound = 1 / np.sqrt(fan_in)
            weights.append(ns.TensorXf(rng.uniform(-bound, bound, (fan_out, fan_in)).astype(np.float32)))
        return MLP(weights)

    def require(self, sizes: list[int], name: str) -> None:
        """Raise ``ValueError`` unless the layers have ``sizes`` [inputs, ..., outputs]."""
        shapes, expected = [tuple(w.shape) for w in self.weights], [(o, i) for i, o in zip(sizes, sizes[1:])]
        if shapes != expected:
            raise ValueError(f'"{name}" has layers of shapes {shapes} where its architecture needs {expected}')

    @property
    def inputs(self) -> int:
        return self.weights[0].shape[1]

    @property
    def outputs(self) -> int:
        return self.weights[-1].shape[0]

    def pack(self) -> None:
        """Refresh what the kernels read after a change of ``weights``; gradients flow through."""
        ns = namespace(self.weights[0])
        weights = [ns.TensorXf16(w) if is_cuda(ns) else w for w in self.weights]
        packed = nn.pack(*weights, layout="training")
        self._views = [packed] if len(weights) == 1 else list(packed)
        self.buffer = self._views[0].buffer

    def __call__(self, x: list) -> list:
        """Outputs (list of Floats) at inputs ``x`` (list of Floats), as cooperative vectors."""
        if self._views is None:
            self.pack()
        ns = namespace(self.weights[0])
        half = is_cuda(ns)
        # Cooperative vectors do not sum the derivatives of a lane that is shared by all the others.
        width = max(dr.width(c) for c in x)
        x = [c + dr.zeros(ns.Float, width) if dr.width(c) < width else c for c in x]
        v = nn.CoopVec(*([ns.Float16(c) for c in x] if half else x))
        for i, view in enumerate(self._views):
            v = nn.matvec(view, v)
            if i + 1 < len(self._views):
                v = dr.maximum(v, 0)
        out = list(v)
        return [ns.Float(c) for c in out] if half else out

    def tensor(self, x):
        """Outputs (outputs, N) at inputs ``x`` (inputs, N), both TensorXf, as tensor products."""
        for i, w in enumerate(self.weights):
            x = w @ x
            if i + 1 < len(self.weights):
                x = dr.maximum(x, 0)
        return x
