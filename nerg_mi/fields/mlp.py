"""Multilayer perceptrons: Dr.Jit's neural networks, or unrolled with constant weights; and the array types of a
backend."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import drjit.nn as nn
import numpy as np

from nerg_mi.errors import NergError

# ---- Array types of one backend ----
#
# A field belongs to one backend (LLVM or CUDA): its weights are arrays of that backend. Types derive from arguments and
# not from the current Mitsuba variant, so the code works across changes of the variant.


def namespace(source: str | dr.ArrayBase | type[dr.ArrayBase] | None) -> ModuleType:
    """Module with the differentiable array types of a backend: ``drjit.llvm.ad`` or ``drjit.cuda.ad``.

    ``source``: the name of a Mitsuba variant (``"llvm_ad_rgb"``; None if none is active), ``"llvm"``, ``"cuda"``, or
    any JIT array or array type. Raises ``NergError`` for scalar variants, which have no JIT arrays, and for None.
    """
    if source is None or isinstance(source, str):
        name = source or "none"
    else:
        backend = dr.backend_v(source)
        name = {dr.JitBackend.LLVM: "llvm", dr.JitBackend.CUDA: "cuda"}.get(backend, str(backend))
    if name.startswith("llvm"):
        import drjit.llvm.ad as ns
    elif name.startswith("cuda"):
        import drjit.cuda.ad as ns
    else:
        raise NergError(
            f'fields need a JIT variant such as "llvm_ad_rgb" or "cuda_ad_rgb", not "{name}"; '
            "select one with mi.set_variant()"
        )
    return ns


def is_cuda(ns: ModuleType) -> bool:
    """Whether ``ns`` is the CUDA backend, where networks run in fp16."""
    return ns.__name__.startswith("drjit.cuda")


# ---- A network with constant weights ----
#
# Dr.Jit's cooperative vectors keep the sums of a layer in memory while they read its weights, which on CPUs takes two
# to three times as long as the products themselves. With literal weights in the kernel the sums stay in registers.
# Products and their order are the same, so results are bit-identical. The cost is compilation: some seconds for each
# kernel and each set of weights.

# A recording of ``dr.freeze`` would be replayed with the weights of the first image. Only a recorder that compares the
# `Constants` of all networks, and traces again when one changed, allows them.


class Constants:
    """Weights of a network as numbers. Other weights are another object."""

    __slots__ = ("layers",)

    def __init__(self, weights: Sequence[Any]):
        self.layers: list[list[list[float]]] = [w.numpy().tolist() for w in weights]


_may_record = ContextVar("may_record", default=False)


@contextmanager
def allow_recorded_constants() -> Iterator[None]:
    """Evaluate networks with constant weights while ``dr.freeze`` records, too."""
    token = _may_record.set(True)
    try:
        yield
    finally:
        _may_record.reset(token)


_MAX_INLINE_PRODUCTS = 2048
"""Number of products above which a network becomes a separate function of the kernel: compile time grows more than
linearly with the length of a function."""


def evaluate_with_constants(layers: Sequence[Sequence[Sequence[float]]], x: list) -> list:
    """Outputs (list of Floats) at ``x`` (list of Floats) of a ReLU network of ``layers``: weights [output][input]."""
    if sum(len(layer) * len(layer[0]) for layer in layers) <= _MAX_INLINE_PRODUCTS:
        return _evaluate_layers(layers, x)
    Float = type(x[0])
    UInt32 = dr.uint32_array_t(Float)
    target = UInt32(0)
    # A function that is known to be the only target is inlined.
    dr.make_opaque(target)
    zero_outputs = lambda *x: (Float(0),) * len(layers[-1])
    return list(dr.switch(target, [lambda *x: tuple(_evaluate_layers(layers, list(x))), zero_outputs], *x))


def _evaluate_layers(layers: Sequence[Sequence[Sequence[float]]], x: list) -> list:
    for i, layer in enumerate(layers):
        sums = []
        for row in layer:
            total = x[0] * row[0]
            for value, weight in zip(x[1:], row[1:]):
                total = dr.fma(value, weight, total)
            sums.append(total if i + 1 == len(layers) else dr.maximum(total, 0))
        x = sums
    return x


# ---- Small fully connected networks, inside kernels or as matrix products ----
#
# Two execution modes share one set of weights: cooperative vectors (one fused kernel, best for rendering) and matrix
# products (``X @ W^T`` on whole batches, best for training: on the LLVM backend their weight gradient is several times
# cheaper than the atomically accumulated outer products of cooperative vectors).

_NORM_EPSILON = 1e-5  # torch's LayerNorm (Ba et al. 2016) adds it to the variance


class MLP:
    """ReLU network; the last layer is linear. Raises ``ValueError`` for layers with inconsistent shapes.

    Parameters
    ----------
    weights : list of TensorXf
        One tensor (outputs, inputs) per layer, in fp32. On CUDA cooperative vectors use fp16, as the hardware's matrix
        units require; on LLVM fp16 is slower than fp32 and is not used.
    norms : list of dict, optional
        For each layer ``{"gain", "shift", "bias"}``, TensorXf of shapes (inputs,), (inputs,) and (outputs,): inputs
        pass torch's LayerNorm (with gain and shift) first, and the bias is added to the output.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"weights": list, "norms": None, "_views": None, "buffer": None}

    def __init__(self, weights: list, norms: list | None = None):
        self.weights = list(weights)
        self.norms: list[dict[str, Any]] | None = None if norms is None else [dict(n) for n in norms]
        self._views: Any = None
        self.buffer = None  # Packed weights of all layers, which kernels read; attached to ``weights``
        # Whether kernels contain the weights as literals instead (`evaluate_with_constants`), and these as numbers.
        self.has_constant_weights = False
        self._constants: Constants | None = None
        for first, second in zip(self.weights, self.weights[1:]):
            if first.shape[0] != second.shape[1]:
                raise ValueError(
                    f"the layers of this network have inconsistent shapes: {[w.shape for w in self.weights]}"
                )
        for w, norm in zip(self.weights, self.norms or []):
            shapes = {k: tuple(v.shape) for k, v in norm.items()}
            expected = {"gain": (w.shape[1],), "shift": (w.shape[1],), "bias": (w.shape[0],)}
            if shapes != expected:
                raise ValueError(f"a normalised layer of shape {w.shape} needs {expected}, got {shapes}")

    @staticmethod
    def random(sizes: list[int], ns: ModuleType, rng: np.random.Generator, normalized: bool = False) -> MLP:
        """Kaiming-uniform weights (as torch's Linear) for layer ``sizes`` [inputs, ..., outputs]."""
        weights, norms = [], []
        for fan_in, fan_out in zip(sizes, sizes[1:]):
            bound = 1 / np.sqrt(fan_in)
            weights.append(ns.TensorXf(rng.uniform(-bound, bound, (fan_out, fan_in)).astype(np.float32)))
            if normalized:
                norms.append(
                    {
                        "gain": dr.ones(ns.TensorXf, (fan_in,)),
                        "shift": dr.zeros(ns.TensorXf, (fan_in,)),
                        "bias": ns.TensorXf(rng.uniform(-bound, bound, fan_out).astype(np.float32)),
                    }
                )
        return MLP(weights, norms or None)

    def check_sizes(self, sizes: list[int], name: str, normalized: bool = False) -> None:
        """Raise ``ValueError`` unless layers have ``sizes`` [inputs, ..., outputs] and the given normalisation."""
        shapes, expected = [tuple(w.shape) for w in self.weights], [(o, i) for i, o in zip(sizes, sizes[1:])]
        if shapes != expected:
            raise ValueError(f'"{name}" has layers of shapes {shapes}, but its architecture needs {expected}')
        if normalized != (self.norms is not None):
            raise ValueError(
                f'"{name}" {"lacks" if normalized else "has"} layer normalisation, unlike its architecture'
            )

    def named(self) -> dict:
        """Arrays by name: weights ``"0"``, ``"1"``, ...; ``"0.gain"``, ``"0.shift"``, ``"0.bias"`` of normalised
        layers."""
        out = {}
        for i, w in enumerate(self.weights):
            out[str(i)] = w
            if self.norms is not None:
                out |= {f"{i}.{k}": v for k, v in self.norms[i].items()}
        return out

    def replace(self, name: str, value) -> None:
        """Replace the array ``name`` by ``value``; takes effect with `pack`."""
        layer, _, part = name.partition(".")
        if part and self.norms is not None:
            self.norms[int(layer)][part] = value
        else:
            self.weights[int(layer)] = value

    @property
    def inputs(self) -> int:
        """Number of inputs of the first layer."""
        return self.weights[0].shape[1]

    @property
    def outputs(self) -> int:
        """Number of outputs of the last layer."""
        return self.weights[-1].shape[0]

    def pack(self) -> None:
        """Update what the kernels read after a change of ``weights``; gradients flow through."""
        self._constants = None
        ns = namespace(self.weights[0])
        weights = self.weights
        if self.norms is not None:
            # Gain and shift are folded into the next product: W (g x + s) + b = (W g) x + (W s + b).
            folded = [_fold_norm(w, norm) for w, norm in zip(weights, self.norms)]
            weights = [array for pair in folded for array in pair]
        weights = [ns.TensorXf16(w) if is_cuda(ns) else w for w in weights]
        packed: Any = nn.pack(*weights, layout="training")
        self._views = [packed] if len(weights) == 1 else list(packed)
        self.buffer = self._views[0].buffer

    def __call__(self, x: list) -> list:
        """Outputs (list of Floats) at inputs ``x`` (list of Floats), as cooperative vectors."""
        if self._views is None:
            self.pack()
        ns = namespace(self.weights[0])
        half = is_cuda(ns)
        # Cooperative vectors do not sum the gradients of a broadcast lane.
        width = max(dr.width(c) for c in x)
        x = [c + dr.zeros(ns.Float, width) if dr.width(c) < width else c for c in x]
        # Not on CUDA, with layer normalisation, in recordings of others, or with gradients.
        if self.has_constant_weights and not (
            half
            or self.norms is not None
            or (dr.flag(dr.JitFlag.FreezingScope) and not _may_record.get())
            or dr.grad_enabled(self.weights, x)
        ):
            return evaluate_with_constants(self.get_constants().layers, x)
        if self.norms is not None:
            return self._evaluate_normalized(x, ns, half)
        views: Any = self._views
        v = nn.CoopVec(*([ns.Float16(c) for c in x] if half else x))
        for i, view in enumerate(views):
            v = nn.matvec(view, v)
            if i + 1 < len(views):
                v = dr.maximum(v, 0)
        out = list(v)
        return [ns.Float(c) for c in out] if half else out

    def get_constants(self) -> Constants:
        """The weights as numbers. They are read on the first call, which must not be recorded."""
        if self._constants is None:
            self._constants = Constants(self.weights)
        return self._constants

    def _evaluate_normalized(self, x: list, ns: ModuleType, half: bool) -> list:
        for i in range(len(self.weights)):
            if i > 0:
                x = [dr.maximum(c, 0) for c in x]
            mean = sum(x) / len(x)
            x = [c - mean for c in x]
            scale = dr.rsqrt(sum(c * c for c in x) / len(x) + _NORM_EPSILON)
            v = nn.CoopVec(*[ns.Float16(c * scale) if half else c * scale for c in x])
            x = [ns.Float(c) if half else c for c in nn.matvec(self._views[2 * i], v, self._views[2 * i + 1])]
        return x

    def tensor(self, x: Any) -> Any:
        """Outputs (N, outputs) at inputs ``x`` (N, inputs), both TensorXf, as matrix products.

        Without layer normalisation ``x`` may have further columns, which are ignored.

        One point per row: Dr.Jit's matrix products are fastest with the inputs of a point adjacent in memory, by up to
        a factor of two in the derivatives.
        """
        for i, w in enumerate(self.weights):
            if self.norms is None:
                x = _products(x, _append_zeros(w, x.shape[1]))
            else:
                x = x - dr.reshape(type(x), dr.mean(x, axis=1), (-1, 1))
                x = x * dr.reshape(type(x), dr.rsqrt(dr.mean(x * x, axis=1) + _NORM_EPSILON), (-1, 1))
                w, bias = _fold_norm(w, self.norms[i])
                x = _products(x, w) + bias
            if i + 1 < len(self.weights):
                x = dr.maximum(x, 0)
        return x


def _products(x: Any, w: Any) -> Any:
    return dr.matmul(x, w, Bt=True)


def _append_zeros(w: Any, inputs: int) -> Any:
    """Weights ``w`` of a layer with zeros for further ``inputs``."""
    rows, columns = w.shape
    if inputs == columns:
        return w
    UInt32 = dr.uint32_array_t(w.array)
    index = dr.arange(UInt32, rows * inputs)
    column = index % inputs
    source = index // inputs * columns + column
    padded = dr.gather(type(w.array), w.array, source, column < columns, mode=dr.ReduceMode.Permute)
    return type(w)(padded, (rows, inputs))


def _fold_norm(w, norm: dict[str, Any]) -> tuple:
    """Weights and bias of a layer with the gain and shift of its inputs folded in."""
    return w * norm["gain"], norm["bias"] + dr.sum(w * norm["shift"], axis=1)


# ---- Rows of a batch as a matrix, and back ----


def stack(rows: list, ns):
    """Stack rows (Floats of one length, or constants) to a TensorXf (N, columns).

    Columns of zeros follow up to a multiple of eight, which Dr.Jit stores at once.
    """
    return dr.custom(_Stack, [*rows, *[ns.Float(0)] * (-len(rows) % 8)], ns)


def unstack(x, ns) -> list:
    """Split a TensorXf (N, columns) into its columns as Floats."""
    return dr.custom(_Unstack, x, ns)


class _Stack(dr.CustomOp):
    """Dr.Jit's own derivative would load one number at a time, and that of `_Unstack` add one atomically."""

    def eval(self, rows, ns):
        self.ns = ns
        return _join(rows, ns)

    def forward(self):
        self.set_grad_out(_join(self.grad_in("rows"), self.ns))

    def backward(self):
        self.set_grad_in("rows", _split(self.grad_out(), self.ns))

    def name(self):
        return "stack of rows"


class _Unstack(dr.CustomOp):
    """Inverse of `_Stack`."""

    def eval(self, x, ns):
        self.ns = ns
        return _split(x, ns)

    def forward(self):
        self.set_grad_out(_split(self.grad_in("x"), self.ns))

    def backward(self):
        self.set_grad_in("x", _join(self.grad_out(), self.ns))

    def name(self):
        return "columns of a matrix"


def _join(rows: Any, ns):
    columns = ns.ArrayXf(rows)
    # Dr.Jit aborts if it stores several numbers at once of which one awaits additions.
    dr.eval([x for x in columns if x.state == dr.VarState.Dirty])
    flat = dr.ravel(columns, order="F")
    return ns.TensorXf(flat, (dr.width(flat) // len(rows), len(rows)))


def _split(x, ns) -> list:
    width, rows = x.shape
    return list(dr.gather(ns.ArrayXf, x.array, dr.arange(ns.UInt32, width), shape=(rows, width)))


def set_constant_weights(field: Any, enabled: bool = True) -> None:
    """Evaluate the networks of ``field`` (its ``mlps``; of an ensemble all members') with weights as literals of the
    kernel.

    Applies on CPUs, without gradients, without layer normalisation, and in ``dr.freeze`` only if a `Recorder` calls it;
    other evaluations are unchanged. New weights require a new compilation.
    """
    for net in field.mlps:
        net.has_constant_weights = enabled
