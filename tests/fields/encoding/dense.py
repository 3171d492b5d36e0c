"""A dense grid of features: a position encoding other than the hash grid."""

from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import Encoding, EncodingConfig


@dataclass(frozen=True)
class DenseConfig(EncodingConfig):
    kind, max_sizes, dimensions = "dense_of_the_tests", {"finest": 64, "size": 16}, 3
    finest: int = 8
    size: int = 4

    def parameter_shapes(self):
        return {"values": (self.size, (self.finest + 1) ** 3)}

    def describe(self):
        return f"{self.size} x {self.finest}^3"


class DenseGrid(Encoding):
    DRJIT_STRUCT: ClassVar = {"values": None}

    def __init__(self, config, values, mode=dr.ReduceMode.Auto):
        self.config, self.values, self.mode = config, values, mode

    @classmethod
    def random(cls, config, ns, rng):
        return cls(config, ns.TensorXf(rng.uniform(-0.1, 0.1, config.parameter_shapes()["values"]).astype(np.float32)))

    def __call__(self, p, active=True):
        n, Float, inside = self.config.finest, type(p.x), active & dr.all((p >= 0) & (p <= 1))
        cell = [dr.minimum(dr.uint32_array_t(Float)(dr.clip(c, 0, 1) * n), n - 1) for c in p]
        out = [Float(0)] * self.config.size
        for corner in product((0, 1), repeat=3):
            x, y, z = (c + k for c, k in zip(cell, corner))
            weights = [1 - dr.abs(c * n - Float(v)) for c, v in zip(p, (x, y, z))]
            for f in range(len(out)):
                row = x + (n + 1) * (y + (n + 1) * (z + (n + 1) * f))
                value = dr.gather(Float, self.values.array, row, inside, mode=self.mode)
                out[f] = out[f] + weights[0] * weights[1] * weights[2] * value
        return [dr.select(inside, v, 0) for v in out]
