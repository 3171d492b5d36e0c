"""The gaze field of the paper: how much a surface attracts, and how much attention an observer gives.

Equation 1 of "Neural Radiance and Gaze Fields for Visual Attention Modeling in 3D Environments": G(p_od, p_o) =
F_e(p_od, -r_o) * sigmoid(F_c(p_o, r_o)), with r_o the unit direction from the observer p_o to the surface p_od that the
observer sees. F_e and F_c share a trunk with the NeRF's architecture (hash grid, two small networks) and differ in
their last layer. G is a density over directions around the observer, in 1/sr.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from types import ModuleType
from typing import ClassVar

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import log1p, sigmoid
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Bool

from .encoding import HashGrid, HashGridConfig, encode_direction
from .gaze_base import Arrays, GazeHead, GazeHeadConfig, check_choices, register
from .mlp import MLP

VARIANTS = ("emit", "capture", "emit_capture")
ACTIVATIONS = ("softplus", "exp", "linear")
TRUNKS = ("relu", "layernorm", "linear")
SEMANTICS = ("", "accumulated", "snapshot")


def softplus(x):
    """log(1 + exp(x)) without overflow; its gradient is the sigmoid."""
    # max(x, 0) + log(1 + exp(-|x|)), with a derivative of 1/2 at 0.
    return 0.5 * (x + dr.abs(x)) + log1p(dr.exp(-dr.abs(x)))


def activate(x, activation: str):
    """Output of the emit head, a density in 1/sr: non-negative unless ``activation`` is linear."""
    if activation == "softplus":
        return softplus(x)
    if activation == "exp":
        return dr.exp(dr.minimum(x, 30.0))
    return x


@dataclass(frozen=True)
class GazeConfig(GazeHeadConfig):
    """Variant, output activation and sizes. The defaults are the paper's (the configuration of its NeRF).

    With ``semantic``, emit takes the ``geometry`` features of a radiance field instead of those of its own grid:
    ``accumulated`` along the observer's ray by volume rendering, or as a ``snapshot`` at p_od (the semantic variants of
    the paper). With ``semantic_own`` it takes the sum of both (the fine-tuned variant). Capture has no semantic
    features.
    """

    kind: ClassVar[str] = "product"

    # The encoding of positions, over the field's box.
    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(finest=512))
    # emit: depends on the surface only; capture: on the observer only, through a sigmoid; emit_capture: the product.
    variant: str = "emit_capture"
    # Of the emit head: softplus and exp give densities; linear is the paper's and can be negative.
    activation: str = "softplus"
    width: int = 64  # Neurons of each hidden layer
    geometry: int = 15  # Features passed from the position net to the direction net
    sh_degree: int = 4  # Degrees of the spherical harmonics of directions
    # Factor of the output of emit: the level of an untrained field, and of one with strong weight decay.
    emit_scale: float = 1.0
    # relu: a ReLU behind the direction net; layernorm: normalised layer inputs, biases, and a ReLU behind the position
    # net, too (the default of the paper's code); linear: no ReLU behind either (its other option).
    trunk: str = "relu"
    semantic: str = ""  # Features of a radiance field that emit takes: accumulated, snapshot or none
    semantic_own: bool = False  # Add them to the field's own features instead of replacing these
    # Divide by the integral over the observer's sphere, so that the density integrates to one for any weights.
    normalized: bool = False

    def __post_init__(self):
        check_choices(self, variant=VARIANTS, activation=ACTIVATIONS, trunk=TRUNKS, semantic=SEMANTICS)
        if self.semantic and self.variant == "capture":
            raise ValueError(
                "semantic features are inputs of emit, which a gaze field of the variant capture does not have"
            )
        if self.semantic_own and not self.semantic:
            raise ValueError("semantic_own adds the field's own features to semantic ones; set semantic, too")
        if self.semantic and self.normalized:
            raise ValueError("a gaze field with semantic features cannot be normalised over the sphere")
        if not 0 < self.emit_scale < float("inf"):
            raise ValueError(f"the scale of the emit head must be positive and finite, got {self.emit_scale}")
        if min(self.width, self.geometry, self.sh_degree) < 1:
            raise ValueError(f"every size of a gaze field must be at least 1, got {self}")

    @property
    def features(self) -> int:
        return self.geometry if self.semantic else 0

    def conventions(self) -> tuple:
        return self.kind, self.variant, self.activation, self.normalized, self.semantic, self.geometry

    @property
    def position_sizes(self) -> list[int]:
        return [self.grid.size, self.width, self.geometry]

    @property
    def direction_sizes(self) -> list[int]:
        return [self.sh_degree**2 + self.geometry, self.width, self.width]

    def to_dict(self) -> dict:
        """As a JSON object, without the kind, which the first checkpoints do not have."""
        return {**asdict(self), "grid": self.grid.to_dict()}


@register
class ProductHead(GazeHead):
    """Gaze density (1/sr) of an observer who looks at a surface.

    Positions are in the field's units inside ``box`` (outside, the features of the grid are 0).
    """

    kind: ClassVar[str] = GazeConfig.kind
    NETS: ClassVar[tuple[str, ...]] = ("position_net", "direction_net", "emit_head", "capture_head")

    def __init__(
        self,
        config: GazeConfig,
        box: AnyBox,
        grid: HashGrid,
        position_net: MLP,
        direction_net: MLP,
        emit_head: MLP,
        capture_head: MLP,
    ):
        grid.check_config(config.grid)
        nets = (position_net, direction_net, emit_head, capture_head)
        for net, (name, sizes) in zip(nets, self._sizes(config).items()):
            net.check_sizes(sizes, name, self._is_normalized(config, name))
        self.config, self.box, self.grid = config, box, grid
        self.position_net, self.direction_net = position_net, direction_net
        self.emit_head, self.capture_head = emit_head, capture_head
        self.pack()

    @staticmethod
    def _sizes(config: GazeConfig) -> dict[str, list[int]]:
        """Layer sizes of each network."""
        head = [config.width, 1]
        return dict(zip(ProductHead.NETS, (config.position_sizes, config.direction_sizes, head, head)))

    @staticmethod
    def _is_normalized(config: GazeConfig, name: str) -> bool:
        return config.trunk == "layernorm" and not name.endswith("head")

    @staticmethod
    def random(config: GazeConfig, box: AnyBox, ns: ModuleType, seed: int = 0) -> ProductHead:
        """An untrained field of backend ``ns``; equal seeds give equal weights."""
        rng = np.random.default_rng(seed)
        grid = HashGrid.random(config.grid, ns, rng)
        is_normalized = ProductHead._is_normalized
        nets = {
            name: MLP.random(sizes, ns, rng, is_normalized(config, name))
            for name, sizes in ProductHead._sizes(config).items()
        }
        return ProductHead(config, box, grid, **nets)

    @classmethod
    def from_arrays(cls, architecture: dict, box: AnyBox, arrays: Arrays) -> ProductHead:
        config = GazeConfig.from_dict(architecture)
        nets = {
            name: arrays.build_network(name, sizes, cls._is_normalized(config, name))
            for name, sizes in cls._sizes(config).items()
        }
        return cls(config, box, arrays.build_grid(config.grid), **nets)

    def _trunk(self, p, d, active, semantic=None):
        if semantic is not None and not self.config.semantic_own:
            geometry = semantic
        else:
            geometry = self.position_net(self.grid(self.box.to_unit(p), active))
            if self.config.trunk == "layernorm":
                geometry = [dr.maximum(g, 0) for g in geometry]
            if semantic is not None:
                geometry = [g + s for g, s in zip(geometry, semantic)]
        hidden = self.direction_net(encode_direction(d, self.config.sh_degree) + geometry)
        return hidden if self.config.trunk == "linear" else [dr.maximum(h, 0) for h in hidden]

    def emit(self, p_od, r_o, active: Bool | bool = True, semantic=None):
        """F_e(p_od, -r_o) after its activation, in 1/sr.

        ``r_o``: unit, from observer to surface; ``semantic``: list of ``geometry`` features for a field with semantic
        features.
        """
        c = self.config
        if (0 if semantic is None else len(semantic)) != c.features:
            raise ValueError(
                f"this gaze field takes {c.features or 'no'} semantic features, got "
                f"{'none' if semantic is None else len(semantic)}"
            )
        return activate(self.emit_head(self._trunk(p_od, -r_o, active, semantic))[0], c.activation) * c.emit_scale

    def capture(self, p_o, r_o, active: Bool | bool = True):
        """sigmoid(F_c(p_o, r_o)), the probability that the observer perceives what is emitted."""
        return sigmoid(self.capture_head(self._trunk(p_o, r_o, active))[0])

    def unnormalized(self, p_od, p_o, r_o, active: Bool | bool = True, semantic=None, escaped: Bool | bool = False):
        """``(emit, capture)``, whose product a normalised field divides by its integral; ``escaped`` is not used.

        A missing factor is 1 and is not evaluated. ``semantic``: see `emit`.
        """
        one = type(p_od.x)(1)
        emit = one if self.config.variant == "capture" else self.emit(p_od, r_o, active, semantic)
        return emit, one if self.config.variant == "emit" else self.capture(p_o, r_o, active)
