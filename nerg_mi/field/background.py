"""Colour behind everything, on a sphere around the scene: torch-ngp's background network.

The ray's far intersection with the sphere, as two angles, goes through a small 2-D hash grid; its features
and the harmonics of the direction go through a small network to a colour (``NeRFNetwork.background`` there).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.ranges import FARTHEST

from .backend import namespace
from .encoding.harmonics import encode_direction
from .encoding.hashgrid import HashGridConfig
from .encoding.protocol import Encoding, EncodingConfig
from .encoding.registry import encoding_config, random_encoding
from .mlp import MLP


@dataclass(frozen=True)
class BackgroundConfig:
    """Sizes of a background. The defaults are torch-ngp's. Raises ``ValueError`` for sizes that none has."""

    # Of the sphere about the field's origin, in the field's units.
    radius: float
    # The encoding of the two angles.
    grid: EncodingConfig = field(default_factory=lambda: HashGridConfig(levels=4, dimensions=2))
    # Neurons of every hidden layer.
    width: int = 64
    # Hidden layers.
    hidden: int = 1
    # Degree of the encoding of directions.
    sh_degree: int = 4

    def __post_init__(self):
        if not 0 < self.radius <= FARTHEST:
            raise ValueError(f"the radius of a background must be positive and finite, got {self.radius}")
        if self.grid.dimensions != 2 or min(self.width, self.hidden) < 1:
            raise ValueError(f"a background needs a grid of 2 dimensions and sizes of at least 1, got {self}")

    @property
    def sizes(self) -> list[int]:
        """Sizes of the network's layers, [inputs, ..., 3]."""
        return [self.sh_degree**2 + self.grid.size] + [self.width] * self.hidden + [3]

    def to_dict(self) -> dict[str, Any]:
        """The JSON object that stands in a checkpoint."""
        return {**asdict(self), "grid": self.grid.to_dict()}

    @staticmethod
    def from_dict(d: dict[str, Any]) -> BackgroundConfig:
        """The configuration that ``to_dict`` made ``d`` of. Raises ``KeyError``, ``TypeError`` or ``ValueError``."""
        return BackgroundConfig(**{**d, "grid": encoding_config(d["grid"])})


class Background:
    """Colour (0..1, in the colour space of its radiance field) that rays meet behind the field.

    Raises ``ValueError`` for parts that are not those of ``config``.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"grid": None, "net": None}

    def __init__(self, config: BackgroundConfig, grid: Encoding, net: MLP):
        grid.require(config.grid)
        net.require(config.sizes, "background_net")
        self.config, self.grid, self.net = config, grid, net

    @staticmethod
    def random(config: BackgroundConfig, ns: ModuleType, seed: int = 0) -> Background:
        """An untrained background; equal seeds give equal weights."""
        rng = np.random.default_rng(seed)
        return Background(config, random_encoding(config.grid, ns, rng), MLP.random(config.sizes, ns, rng))

    def coordinates(self, o, d) -> list:
        """[2 θ / π - 1, φ / π] where the ray ``o + t d`` (unit ``d``) leaves the sphere; θ from +y, φ from +x to +z."""
        b = dr.dot(o, d)
        # A ray that misses the sphere takes the point of it nearest to its own nearest point.
        inside = dr.maximum(b * b - dr.squared_norm(o) + self.config.radius**2, 0)
        p = o + d * (dr.sqrt(inside) - b)
        theta = dr.atan2(dr.sqrt(p.x * p.x + p.z * p.z), p.y)
        return [2 / dr.pi * theta - 1, dr.atan2(p.z, p.x) / dr.pi]

    def __call__(self, o, d):
        """Colour (Array3f like ``d``) of rays from ``o`` along unit ``d``, in the field's own coordinates."""
        ns = namespace(d)
        square = ns.Array2f(*[dr.clip(0.5 * c + 0.5, 0, 1) for c in self.coordinates(o, d)])
        # torch-ngp puts the direction first.
        rgb = self.net(encode_direction(d, self.config.sh_degree) + self.grid(square))
        return type(d)(*[dr.fma(0.5, dr.tanh(0.5 * c), 0.5) for c in rgb])
