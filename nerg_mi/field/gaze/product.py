"""The gaze field: how much a surface attracts, and how much an observer gives.

Equation 1 of "Neural Radiance and Gaze Fields for Visual Attention Modeling in
3D Environments": G(p_od, p_o) = F_e(p_od, -r_o) * sigmoid(F_c(p_o, r_o)), with
r_o the unit direction from the observer p_o to the surface p_od that the
observer sees. F_e and F_c share a trunk of the NeRF's shape (hash grid, two
small networks) and differ in their last layer. G is a density over directions
around the observer, in 1/sr.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from types import ModuleType

import drjit as dr
import numpy as np

from nerg_mi.field.backend import namespace
from nerg_mi.field.encoding.harmonics import encode_direction
from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.encoding.protocol import Encoding, EncodingConfig
from nerg_mi.field.encoding.registry import encoding_config, random_encoding
from nerg_mi.field.mlp import MLP
from nerg_mi.field.radiance import assign, sigmoid
from nerg_mi.maths.box import Box
from nerg_mi.maths.elementary import log1p

VARIANTS = ("emit", "capture", "emit_capture")
ACTIVATIONS = ("softplus", "exp", "linear")
TRUNKS = ("relu", "layernorm", "linear")
SEMANTICS = ("", "accumulated", "snapshot")


def softplus(x):
    """log(1 + exp(x)) without overflow; the gradient is the sigmoid."""
    # max(x, 0) + log(1 + exp(-|x|)), with a derivative of 1/2 at 0.
    return 0.5 * (x + dr.abs(x)) + log1p(dr.exp(-dr.abs(x)))


def activate(x, activation: str):
    """The emit head's output, a density in 1/sr: non-negative unless ``activation`` is linear."""
    if activation == "softplus":
        return softplus(x)
    if activation == "exp":
        return dr.exp(dr.minimum(x, 30.0))
    return x


@dataclass(frozen=True)
class GazeConfig:
    """Variant, output activation and sizes. The defaults are the paper's (its NeRF's configuration).

    ``variant``: ``emit`` (a property of the surface alone), ``capture`` (the observer alone,
    sigmoid output) or ``emit_capture`` (their product). ``activation`` of the emit head:
    ``softplus`` and ``exp`` give densities, ``linear`` is the paper's and may be negative. ``emit_scale`` multiplies
    its output: what the untrained field comes to, and what weight decay draws a field towards.

    ``trunk``: ``relu`` hands what the direction net returns to the heads through a ReLU; ``layernorm`` normalises the
    inputs of every layer, adds biases, and puts a ReLU behind the position net too (what the paper's authors train by
    default); ``linear`` has no ReLU behind either net (their other choice).

    ``normalized``: the density is divided by its integral over the observer's sphere wherever it is evaluated, so that
    it integrates to one whatever the weights are.

    ``semantic``: what emit knows of the surface besides, or (without ``semantic_own``) instead of, the field's own
    grid: the ``geometry`` features of a radiance field, ``accumulated`` along the observer's ray by volume rendering
    or as a ``snapshot`` at p_od (the paper's semantic variants; ``semantic_own``, a sum of both, is their fine-tuned
    one). Capture has none.
    """

    grid: EncodingConfig = field(default_factory=lambda: HashGridConfig(finest=512))
    variant: str = "emit_capture"
    activation: str = "softplus"
    width: int = 64
    geometry: int = 15
    sh_degree: int = 4
    emit_scale: float = 1.0
    trunk: str = "relu"
    semantic: str = ""
    semantic_own: bool = False
    normalized: bool = False

    def __post_init__(self):
        if self.semantic not in SEMANTICS:
            raise ValueError(
                f'the semantics of a gaze field must be one of {", ".join(SEMANTICS[1:])} or none, got "{self.semantic}"'
            )
        if self.semantic and self.variant == "capture":
            raise ValueError("a gaze field of the variant capture has no emit that semantic features could go to")
        if self.semantic_own and not self.semantic:
            raise ValueError("semantic_own adds a field's own features to semantic ones; say which those are")
        if self.semantic and self.normalized:
            raise ValueError(
                "a gaze field with semantic features cannot be normalised over the sphere: their integral is not kept"
            )
        if self.trunk not in TRUNKS:
            raise ValueError(f'the trunk of a gaze field must be one of {", ".join(TRUNKS)}, got "{self.trunk}"')
        if not 0 < self.emit_scale < float("inf"):
            raise ValueError(f"the scale of the emit head must be positive and finite, got {self.emit_scale}")
        if self.variant not in VARIANTS:
            raise ValueError(f'the gaze variant must be one of {", ".join(VARIANTS)}, got "{self.variant}"')
        if self.activation not in ACTIVATIONS:
            raise ValueError(f'the activation must be one of {", ".join(ACTIVATIONS)}, got "{self.activation}"')
        if min(self.width, self.geometry, self.sh_degree) < 1:
            raise ValueError(f"every size of a gaze field must be at least 1, got {self}")

    @property
    def position_sizes(self) -> list[int]:
        return [self.grid.size, self.width, self.geometry]

    @property
    def direction_sizes(self) -> list[int]:
        return [self.sh_degree**2 + self.geometry, self.width, self.width]

    def to_dict(self) -> dict:
        return {**asdict(self), "grid": self.grid.to_dict()}

    @staticmethod
    def from_dict(d: dict) -> GazeConfig:
        return GazeConfig(**{**d, "grid": encoding_config(d["grid"])})


class GazeField:
    """Gaze density (1/sr) of an observer attending a surface.

    Positions are in the field's units inside ``box`` (outside of it the grid's features are 0).
    """

    DRJIT_STRUCT = {"grid": None, "position_net": None, "direction_net": None, "emit_head": None, "capture_head": None}
    _NETS = ("position_net", "direction_net", "emit_head", "capture_head")

    def __init__(
        self,
        config: GazeConfig,
        box: Box,
        grid: Encoding,
        position_net: MLP,
        direction_net: MLP,
        emit_head: MLP,
        capture_head: MLP,
    ):
        grid.require(config.grid)
        for name, net, sizes in (
            ("position_net", position_net, config.position_sizes),
            ("direction_net", direction_net, config.direction_sizes),
            ("emit_head", emit_head, [config.width, 1]),
            ("capture_head", capture_head, [config.width, 1]),
        ):
            net.require(sizes, name, self._is_normalized(config, name))
        self.config, self.box, self.grid = config, box, grid
        self.position_net, self.direction_net = position_net, direction_net
        self.emit_head, self.capture_head = emit_head, capture_head
        # How many rays it learnt from around a position (``support.RaySupport``), where that is known.
        self.support = None
        self.pack()

    @staticmethod
    def _is_normalized(config: GazeConfig, name: str) -> bool:
        return config.trunk == "layernorm" and not name.endswith("head")

    @staticmethod
    def random(config: GazeConfig, box: Box, ns: ModuleType, seed: int = 0) -> GazeField:
        """An untrained field of backend ``ns``; equal seeds give equal weights."""
        rng, normalized = np.random.default_rng(seed), config.trunk == "layernorm"
        return GazeField(
            config,
            box,
            random_encoding(config.grid, ns, rng),
            MLP.random(config.position_sizes, ns, rng, normalized),
            MLP.random(config.direction_sizes, ns, rng, normalized),
            MLP.random([config.width, 1], ns, rng),
            MLP.random([config.width, 1], ns, rng),
        )

    def parameters(self) -> dict:
        """Trainable arrays by name, as checkpoints and ``mi.traverse`` spell them."""
        return {
            f"{name}.{key}": value
            for name in ("grid", *self._NETS)
            for key, value in getattr(self, name).named().items()
        }

    @property
    def ns(self) -> ModuleType:
        """Array types of the field's backend; see ``field.backend.namespace``."""
        return namespace(self.emit_head.weights[0])

    def set_parameters(self, values: dict) -> None:
        """Replace arrays by name (any subset of ``parameters()``) and repack the networks."""
        assign(self, values)
        self.pack()

    def pack(self) -> None:
        """Refresh what the kernels read; call after any change of the weights."""
        for name in ("grid", *self._NETS):
            getattr(self, name).pack()

    def _trunk(self, p, d, active, semantic=None):
        geometry = semantic
        if semantic is None or self.config.semantic_own:
            geometry = self.position_net(self.grid(self.box.to_unit(p), active))
            if self.config.trunk == "layernorm":
                geometry = [dr.maximum(g, 0) for g in geometry]
        if semantic is not None and self.config.semantic_own:
            geometry = [g + s for g, s in zip(geometry, semantic)]
        hidden = self.direction_net(encode_direction(d, self.config.sh_degree) + geometry)
        return hidden if self.config.trunk == "linear" else [dr.maximum(h, 0) for h in hidden]

    def emit(self, p_od, r_o, active=True, semantic=None):
        """F_e(p_od, -r_o) after its activation, in 1/sr. ``r_o``: unit, from observer to surface. ``semantic``: list of
        ``geometry`` features, for a field whose configuration asks for them."""
        c = self.config
        if (semantic is None) == bool(c.semantic) or (semantic is not None and len(semantic) != c.geometry):
            raise ValueError(
                f"this gaze field takes {c.geometry if c.semantic else 'no'} semantic features, got "
                f"{'none' if semantic is None else len(semantic)}"
            )
        return activate(self.emit_head(self._trunk(p_od, -r_o, active, semantic))[0], c.activation) * c.emit_scale

    def capture(self, p_o, r_o, active=True):
        """sigmoid(F_c(p_o, r_o)), the probability that what is emitted is perceived."""
        return sigmoid(self.capture_head(self._trunk(p_o, r_o, active))[0])

    def unnormalized(self, p_od, p_o, r_o, active=True, semantic=None, escaped=False):
        """``(emit, capture)``, whose product a normalised field divides by its integral; ``escaped`` makes no
        difference.

        A variant that lacks a part has 1 in its place and does not evaluate it. ``semantic``: see ``emit``.
        """
        one = type(p_od.x)(1)
        emit = one if self.config.variant == "capture" else self.emit(p_od, r_o, active, semantic)
        return emit, one if self.config.variant == "emit" else self.capture(p_o, r_o, active)

    def evaluate(self, p_od, p_o, r_o, active=True, semantic=None, integral=None, escaped=False):
        """``(gaze, emit, capture)`` of the observer at ``p_o`` attending ``p_od`` along unit ``r_o``; ``escaped`` makes
        no difference.

        ``semantic``: see ``emit``. ``integral``: of a normalised field over the sphere at ``p_o``
        (``transport.observer.integral``), by which ``emit`` is divided; ``ValueError`` without it.
        """
        emit, capture = self.unnormalized(p_od, p_o, r_o, active, semantic)
        if self.config.normalized:
            if integral is None:
                raise ValueError(
                    "this gaze field is normalised over the observer's sphere: evaluating it needs its integral there"
                )
            emit = emit / integral
        return emit * capture, emit, capture
