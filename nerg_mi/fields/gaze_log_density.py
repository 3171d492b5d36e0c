"""The gaze field as a log density that is normalised over the observer's sphere.

gaze(p_o, r_o) = (1 - m) emit(p_od, -r_o, log |p_od - p_o|) * sigmoid(F_c(p_o, r_o)) * blind(r_o) / Z(p_o) + m
blind(r_o)

Z(p_o) is the integral of the product over all directions, so that gaze integrates to one whatever the weights are: a
softmax over the sphere. ``blind`` is the density of where people look whatever their position; m its share. What the
factors mean is as in :mod:`nerg_mi.fields.gaze_product`, but emit and capture have networks of their own: the one lives
where the surfaces are, the other where people's heads were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import ClassVar

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import sigmoid
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Bool
from nerg_mi.ranges import MAX_COORDINATE, LENGTHS

from .encoding import Encoding, EncodingConfig, HashGridConfig, encode_direction, random_encoding
from .gaze_base import SIZE_LIMITS, Arrays, GazeHead, GazeHeadConfig, register, require_words
from .gaze_product import VARIANTS
from .mlp import MLP

GEOMETRIES = ("surface", "none")
ESCAPES = ("constant", "nearest")
_HIGHEST = 30.0  # Logits beyond this leave float32 as densities
_LARGEST_LOG = 80.0  # Logarithms of the blind density beyond this do so, too
_NEAREST = 1e-3  # A surface nearer than this share of the box counts as this far: the logarithm is an input of emit


@dataclass(frozen=True)
class LogGazeConfig(GazeHeadConfig):
    """Sizes and conventions."""

    kind: ClassVar[str] = "log_density"

    # Of emit, over the field's box; coarse levels generalise to positions where nobody stood.
    grid: EncodingConfig = field(default_factory=lambda: HashGridConfig(levels=3, log2_rows=14, base=2, finest=8))
    variant: str = "emit_capture"  # As in ``GazeConfig``
    width: int = 64  # Of both networks' hidden layers
    layers: int = 2  # Hidden layers of both networks
    sh_degree: int = 4  # Degrees of spherical harmonics of directions
    # Corners of the box of observers that capture's encoding spans; positions beyond count as its nearest point.
    heads: tuple = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    mix: float = 0.0  # The share m of the blind density
    prior: int = 64  # Rows of the blind density's latitude-longitude table
    # surface, or none where no geometry was known: p_od then is ``reach`` from p_o whatever is there.
    geometry: str = "surface"
    # What emit is where the observer meets no surface: a learnt constant, or (where the geometry has holes, as one made
    # of hit points has) emit at the depth of the nearest directions that do.
    escaped: str = "constant"
    reach: float = 2.0  # Distance of p_od where no geometry was known, in the field's units

    def __post_init__(self):
        object.__setattr__(self, "heads", tuple(tuple(float(x) for x in corner) for corner in self.heads))
        require_words(self, variant=VARIANTS, geometry=GEOMETRIES, escaped=ESCAPES)
        if min(self.width, self.layers, self.sh_degree) < 1 or self.prior < 2 or self.reach not in LENGTHS:
            raise ValueError(f"every size of a gaze field must be positive, got {self}")
        if not 0 <= self.mix <= 1:
            raise ValueError(f"the share of the blind density must lie in [0, 1], got {self.mix}")
        if np.shape(self.heads) != (2, 3) or not np.all(np.abs(self.heads) <= MAX_COORDINATE):
            raise ValueError(f"the box of heads needs two finite corners, got {self.heads}")

    @property
    def needs_surfaces(self) -> bool:
        return self.geometry != "none"

    @property
    def fills_escaped(self) -> bool:
        return self.escaped == "nearest"

    def conventions(self) -> tuple:
        return self.kind, self.variant, self.geometry, self.escaped, self.reach

    @property
    def emit_sizes(self) -> list[int]:
        return [self.grid.size + self.sh_degree**2 + 2, *[self.width] * self.layers, 1]

    @property
    def capture_sizes(self) -> list[int]:
        return [9 + self.sh_degree**2 + 1, *[self.width] * self.layers, 1]


@register
class LogGazeField(GazeHead):
    """A normalised gaze density. Positions are in the field's units inside ``box``; ``prior``: table (rows, 2 rows) of
    the log of the blind density, rows from +z to -z, columns by azimuth, at texel centres."""

    kind: ClassVar[str] = LogGazeConfig.kind
    # Its "geometry" is a word.
    max_sizes: ClassVar[Mapping[str, int]] = {k: v for k, v in SIZE_LIMITS.items() if k != "geometry"}
    NETS: ClassVar[tuple[str, ...]] = ("emit_net", "capture_net")
    ARRAYS: ClassVar[tuple[str, ...]] = ("escaped", "prior")
    fixed: ClassVar[tuple[str, ...]] = ("prior",)

    def __init__(
        self, config: LogGazeConfig, box: AnyBox, grid: Encoding, emit_net: MLP, capture_net: MLP, escaped, prior
    ):
        grid.require(config.grid)
        emit_net.require(config.emit_sizes, "emit_net")
        capture_net.require(config.capture_sizes, "capture_net")
        if tuple(prior.shape) != (config.prior, 2 * config.prior) or dr.width(escaped) != 1:
            raise ValueError(
                f"the blind density needs a table of {config.prior} x {2 * config.prior} and one escaped logit, "
                f"got {tuple(prior.shape)} and {dr.width(escaped)}"
            )
        self.config, self.box, self.grid = config, box, grid
        self.emit_net, self.capture_net, self.escaped, self.prior = emit_net, capture_net, escaped, prior
        self.pack()

    @staticmethod
    def random(
        config: LogGazeConfig, box: AnyBox, ns: ModuleType, seed: int = 0, prior: np.ndarray | None = None
    ) -> LogGazeField:
        """An untrained field of backend ``ns``; equal seeds give equal weights. ``prior``: a ``make_prior_table``;
        uniform."""
        rng = np.random.default_rng(seed)
        if prior is None:
            prior = np.full((config.prior, 2 * config.prior), -np.log(4 * np.pi))
        return LogGazeField(
            config,
            box,
            random_encoding(config.grid, ns, rng),
            MLP.random(config.emit_sizes, ns, rng),
            MLP.random(config.capture_sizes, ns, rng),
            ns.Float(0.0),
            ns.TensorXf(np.asarray(prior, np.float32)),
        )

    @classmethod
    def from_arrays(cls, about: dict, box: AnyBox, arrays: Arrays) -> LogGazeField:
        config = LogGazeConfig.from_dict(about)
        return cls(
            config,
            box,
            arrays.build_grid(config.build_grid),
            arrays.net("emit_net", config.emit_sizes),
            arrays.net("capture_net", config.capture_sizes),
            arrays.ns.Float(arrays.array("escaped", 1)),
            arrays.ns.TensorXf(arrays.array("prior", config.prior, 2 * config.prior, max_value=_LARGEST_LOG)),
        )

    def emit_inputs(self, p_od, p_o, r_o, active: Bool | bool = True) -> list:
        """What emit's network is given (list of Floats): a bias, the log of the distance, the direction, the place."""
        Float = type(p_od.x)
        if self.config.geometry == "none":
            p_od = p_o + r_o * self.config.reach
        # The maximum before the logarithm: its derivative at zero would not be finite.
        log_distance = 0.5 * dr.log(dr.maximum(dr.squared_norm(p_od - p_o), (_NEAREST * self.box.side) ** 2))
        return [
            Float(1),
            log_distance,
            *encode_direction(-r_o, self.config.sh_degree),
            *self.grid(self.box.to_unit(p_od), active),
        ]

    def capture_position(self, p_o) -> list:
        """What capture's network is given of the observer's position: its coordinates in the box of heads and first
        waves."""
        low, high = np.array(self.config.heads)
        scale = 2 / max((high - low).max(), 1e-6)
        u = [dr.clip((c - l) * scale - 1, -1, (h - l) * scale - 1) for c, l, h in zip(p_o, low.tolist(), high.tolist())]
        return u + [f(c * (dr.pi / 2)) for f in (dr.sin, dr.cos) for c in u]

    def capture_inputs(self, position: list, r_o) -> list:
        """What capture's network is given, for ``capture_position`` and a direction."""
        return [type(r_o.x)(1), *encode_direction(r_o, self.config.sh_degree), *position]

    def capture(self, p_o, r_o, active: Bool | bool = True):
        """sigmoid(F_c(p_o, r_o))."""
        return sigmoid(self.capture_net(self.capture_inputs(self.capture_position(p_o), r_o))[0])

    def unnormalized(self, p_od, p_o, r_o, active: Bool | bool = True, semantic=None, escaped: Bool | bool = False):
        """``(emit * blind, capture)``: the product of both is what ``Z`` is the integral of. ``escaped``: mask of
        directions in which no surface is met. There are no ``semantic`` features."""
        c, one = self.config, type(p_od.x)(1)
        logit = self.log_prior(r_o)
        if c.variant != "capture":
            emit = self.emit_net(self.emit_inputs(p_od, p_o, r_o, active))[0]
            logit += emit if c.fills_escaped else dr.select(escaped, self.escaped, emit)
        return dr.exp(dr.minimum(logit, _HIGHEST)), one if c.variant == "emit" else self.capture(p_o, r_o, active)
