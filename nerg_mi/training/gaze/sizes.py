"""Architectures of a gaze field that is a product (equation 1), by one word, and the scale that they begin with."""

from __future__ import annotations

import math

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig

# (levels, log2 rows, base and finest resolution, width, geometry features). "paper" has the paper's sizes, 10.6 million
# entries; "small" is what generalises to positions that nobody trained on, and stores in 0.4 MB as fp16.
_SIZES = {"small": (8, 14, 4, 128, 64, 15), "paper": (16, 19, 16, 512, 64, 15)}
SIZES = tuple(_SIZES)


def sized_gaze_config(size: str = "small", variant: str = "emit_capture", activation: str = "softplus") -> GazeConfig:
    """Architecture of a ``size``: ``small`` or ``paper``. Raises `NergError` for another word."""
    if size not in _SIZES:
        raise NergError(f'size must be one of {", ".join(_SIZES)}, got "{size}"')
    levels, rows, base, finest, width, geometry = _SIZES[size]
    grid = HashGridConfig(levels=levels, log2_rows=rows, base=base, finest=finest)
    return GazeConfig(
        grid=grid,
        variant=variant,
        activation=activation,
        width=width,
        geometry=geometry,
        emit_scale=uniform_scale(variant, activation),
    )


def uniform_scale(variant: str, activation: str) -> float:
    """The ``emit_scale`` with which weights of zero are the uniform density, 1/(4π).

    Networks without biases fall to zero under weight decay. Were that a density of another integral, they would have to
    spend weight on the scale alone, and do: fields that must fight for it follow their probes much less well.
    """
    at_zero = {"softplus": math.log(2.0), "exp": 1.0}.get(activation)
    if at_zero is None:
        return 1.0
    return 1 / (4 * math.pi * at_zero * (0.5 if variant == "emit_capture" else 1.0))
