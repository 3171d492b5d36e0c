"""A user-defined gaze field: the attraction of a surface times the frequency of a direction."""

from dataclasses import dataclass, field
from typing import ClassVar

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import sigmoid

from .encoding import HashGrid, HashGridConfig, encode_direction
from .gaze_base import GazeHead, GazeHeadConfig, register
from .mlp import MLP


@dataclass(frozen=True)
class PlaceConfig(GazeHeadConfig):
    kind: ClassVar[str] = "place"
    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(levels=2, log2_rows=8, base=2, finest=4))
    variant: str = "emit_capture"
    width: int = 16
    prior: int = 16
    mix: float = 0.05


@register
class PlaceField(GazeHead):
    kind, NETS, ARRAYS, fixed = PlaceConfig.kind, ("emit_net", "capture_net"), ("prior",), ("prior",)

    def __init__(self, config, box, grid, emit_net, capture_net, prior):
        self.config, self.box, self.grid, self.prior = config, box, grid, prior
        self.emit_net, self.capture_net = emit_net, capture_net
        self.pack()

    @classmethod
    def random(cls, config, box, ns, seed, prior):
        rng, sizes = np.random.default_rng(seed), ([config.grid.size, config.width, 1], [9, config.width, 1])
        nets = (MLP.random(layers, ns, rng) for layers in sizes)
        return cls(config, box, HashGrid.random(config.grid, ns, rng), *nets, ns.TensorXf(np.float32(prior)))

    @classmethod
    def from_arrays(cls, architecture, box, arrays):
        config = PlaceConfig.from_dict(architecture)
        nets = (arrays.build_network(name, [n, config.width, 1]) for name, n in zip(cls.NETS, (config.grid.size, 9)))
        prior = arrays.get_array("prior", config.prior, 2 * config.prior)
        return cls(config, box, arrays.build_grid(config.grid), *nets, arrays.ns.TensorXf(prior))

    def unnormalized(self, p_od, p_o, r_o, active=True, semantic=None, escaped=False):
        one, variant = type(p_od.x)(1), self.config.variant
        emit = dr.exp(self.emit_net(self.grid(self.box.to_unit(p_od), active))[0]) if variant != "capture" else one
        return emit, sigmoid(self.capture_net(encode_direction(r_o, 3))[0]) if variant != "emit" else one
