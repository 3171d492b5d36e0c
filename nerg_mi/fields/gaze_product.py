"""The gaze field: how much a surface attracts, and how much an observer gives.

Equation 1 of "Neural Radiance and Gaze Fields for Visual Attention Modeling in 3D Environments": G(p_od, p_o) =
F_e(p_od, -r_o) * sigmoid(F_c(p_o, r_o)), with r_o the unit direction from the observer p_o to the surface p_od that the
observer sees. F_e and F_c share a trunk of the NeRF's shape (hash grid, two small networks) and differ in their last
layer. G is a density over directions around the observer, in 1/sr.
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

from .encoding import Encoding, EncodingConfig, HashGridConfig, encode_direction, random_encoding
from .gaze_base import Arrays, GazeHead, GazeHeadConfig, register, require_words
from .mlp import MLP

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
class GazeConfig(GazeHeadConfig):
    """Variant, output activation and sizes. The defaults are the paper's (its NeRF's configuration).

    With ``semantic`` emit is given the ``geometry`` features of a radiance field, ``accumulated`` along the observer's
    ray by volume rendering or as a ``snapshot`` at p_od, in place of those of the field's own grid (the semantic
    variants of the paper); with ``semantic_own`` too, the sum of both (its fine-tuned one). Capture has none.
    """

    kind: ClassVar[str] = "product"

    # The encoding of positions, over the field's box.
    grid: EncodingConfig = field(default_factory=lambda: HashGridConfig(finest=512))
    # emit: of the surface alone; capture: of the observer alone, through a sigmoid; emit_capture: their product.
    variant: str = "emit_capture"
    # Of the emit head: softplus and exp give densities, linear is the paper's and may be negative.
    activation: str = "softplus"
    width: int = 64  # Of the hidden layers
    geometry: int = 15  # Features that the position net hands to the direction net
    sh_degree: int = 4  # Degrees of spherical harmonics of directions
    # Multiplies what emit returns: what the untrained field comes to, and what weight decay draws a field towards.
    emit_scale: float = 1.0
    # relu: a ReLU behind the direction net; layernorm: every layer's inputs normalised, biases, and a ReLU behind the
    # position net too (what the paper's authors train by default); linear: a ReLU behind neither (their other choice).
    trunk: str = "relu"
    semantic: str = ""  # Features of a radiance field that emit is given: accumulated, snapshot or none
    semantic_own: bool = False  # Added to the field's own features, in place of taking their place
    # Divide by the integral over the observer's sphere, so that the density integrates to one whatever the weights are.
    normalized: bool = False

    def __post_init__(self):
        require_words(self, variant=VARIANTS, activation=ACTIVATIONS, trunk=TRUNKS, semantic=SEMANTICS)
        if self.semantic and self.variant == "capture":
            raise ValueError("a gaze field of the variant capture has no emit that semantic features could go to")
        if self.semantic_own and not self.semantic:
            raise ValueError("semantic_own adds a field's own features to semantic ones; say which those are")
        if self.semantic and self.normalized:
            raise ValueError(
                "a gaze field with semantic features cannot be normalised over the sphere: their integral is not kept"
            )
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
        """As JSON, without the kind, which the first checkpoints did not name."""
        return {**asdict(self), "grid": self.grid.to_dict()}


@register
class GazeField(GazeHead):
    """Gaze density (1/sr) of an observer attending a surface.

    Positions are in the field's units inside ``box`` (outside of it the grid's features are 0).
    """

    kind: ClassVar[str] = GazeConfig.kind
    NETS: ClassVar[tuple[str, ...]] = ("position_net", "direction_net", "emit_head", "capture_head")

    def __init__(
        self,
        config: GazeConfig,
        box: AnyBox,
        grid: Encoding,
        position_net: MLP,
        direction_net: MLP,
        emit_head: MLP,
        capture_head: MLP,
    ):
        grid.require(config.grid)
        nets = (position_net, direction_net, emit_head, capture_head)
        for net, (name, sizes) in zip(nets, self._sizes(config).items()):
            net.require(sizes, name, self._is_normalized(config, name))
        self.config, self.box, self.grid = config, box, grid
        self.position_net, self.direction_net = position_net, direction_net
        self.emit_head, self.capture_head = emit_head, capture_head
        self.pack()

    @staticmethod
    def _sizes(config: GazeConfig) -> dict[str, list[int]]:
        """Sizes of the layers of each network."""
        head = [config.width, 1]
        return dict(zip(GazeField.NETS, (config.position_sizes, config.direction_sizes, head, head)))

    @staticmethod
    def _is_normalized(config: GazeConfig, name: str) -> bool:
        return config.trunk == "layernorm" and not name.endswith("head")

    @staticmethod
    def random(config: GazeConfig, box: AnyBox, ns: ModuleType, seed: int = 0) -> GazeField:
        """An untrained field of backend ``ns``; equal seeds give equal weights."""
        rng = np.random.default_rng(seed)
        grid = random_encoding(config.grid, ns, rng)
        is_normalized = GazeField._is_normalized
        nets = {
            name: MLP.random(sizes, ns, rng, is_normalized(config, name))
            for name, sizes in GazeField._sizes(config).items()
        }
        return GazeField(config, box, grid, **nets)

    @classmethod
    def from_arrays(cls, about: dict, box: AnyBox, arrays: Arrays) -> GazeField:
        config = GazeConfig.from_dict(about)
        nets = {
            name: arrays.build_network(name, sizes, cls._is_normalized(config, name))
            for name, sizes in cls._sizes(config).items()
        }
        return cls(config, box, arrays.build_grid(config.build_grid), **nets)

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
        """F_e(p_od, -r_o) after its activation, in 1/sr. ``r_o``: unit, from observer to surface. ``semantic``: list of
        ``geometry`` features, for a field whose configuration asks for them."""
        c = self.config
        if (0 if semantic is None else len(semantic)) != c.features:
            raise ValueError(
                f"this gaze field takes {c.features or 'no'} semantic features, got "
                f"{'none' if semantic is None else len(semantic)}"
            )
        return activate(self.emit_head(self._trunk(p_od, -r_o, active, semantic))[0], c.activation) * c.emit_scale

    def capture(self, p_o, r_o, active: Bool | bool = True):
        """sigmoid(F_c(p_o, r_o)), the probability that what is emitted is perceived."""
        return sigmoid(self.capture_head(self._trunk(p_o, r_o, active))[0])

    def unnormalized(self, p_od, p_o, r_o, active: Bool | bool = True, semantic=None, escaped: Bool | bool = False):
        """``(emit, capture)``, whose product a normalised field divides by its integral; ``escaped`` is not used.

        A variant that lacks a part has 1 in its place and does not evaluate it. ``semantic``: see ``emit``.
        """
        one = type(p_od.x)(1)
        emit = one if self.config.variant == "capture" else self.emit(p_od, r_o, active, semantic)
        return emit, one if self.config.variant == "emit" else self.capture(p_o, r_o, active)
