"""The gaze field as a log density that is normalised over the observer's sphere.

gaze(p_o, r_o) = (1 - m) emit(p_od, -r_o, log |p_od - p_o|) * sigmoid(F_c(p_o, r_o)) / Z(p_o) + m prior(r_o)

Z(p_o) is the integral of the product over all directions, so that gaze integrates to one for any weights: a softmax
over the sphere. ``prior`` is the position-independent density of gaze directions, m its weight; re-aimed hits
(:mod:`nerg_mi.fields.gaze_hits`) may be mixed in as well. The factors are those
of :mod:`nerg_mi.fields.gaze_product`, but emit and capture have separate networks: one over the surfaces, the other
over the positions of observers. Fields of earlier versions have the prior as a third factor of the product.
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
from nerg_mi.ranges import LENGTHS, MAX_COORDINATE

from .encoding import HashGrid, HashGridConfig, encode_direction
from .gaze_base import MAX_SIZES, Arrays, GazeHead, GazeHeadConfig, check_choices, register
from .gaze_product import VARIANTS
from .mlp import MLP

GEOMETRIES = ("surface", "none")
MISS_MODES = ("constant", "nearest")
_MAX_LOGIT = 30.0  # Larger logits overflow float32 as densities
_MAX_LOG_PRIOR = 80.0  # Largest absolute logarithm of the prior, for the same reason
_MIN_DISTANCE = 1e-3  # Minimum distance of a surface as a fraction of the box: its logarithm is an input of emit


@dataclass(frozen=True)
class LogGazeConfig(GazeHeadConfig):
    """Sizes and conventions."""

    kind: ClassVar[str] = "log_density"

    # Encoding of emit, over the field's box; coarse levels generalise to unvisited positions.
    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(levels=3, log2_rows=14, base=2, finest=8))
    variant: str = "emit_capture"  # As in `GazeConfig`
    width: int = 64  # Neurons of each hidden layer, in both networks
    layers: int = 2  # Hidden layers of both networks
    sh_degree: int = 4  # Degrees of the spherical harmonics of directions
    # Corners of the bounding box of observers, over which capture encodes positions; others are clamped to it.
    heads: tuple = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    mix: float = 0.0  # Weight m of the position-independent prior
    # Whether the prior is also a factor of the product; checkpoints without this entry were trained so.
    prior_factor: bool = True
    prior: int = 64  # Rows of the prior's latitude-longitude table
    # surface, or none without a known geometry: p_od is then ``reach`` away from p_o in every direction.
    geometry: str = "surface"
    # emit in directions without a surface: a trained constant, or (for a geometry with holes, such as one of hit
    # points) emit at the depth of the nearest directions with a surface.
    escaped: str = "constant"
    reach: float = 2.0  # Distance of p_od without a known geometry, in the field's units

    def to_dict(self) -> dict:
        """As a JSON object. Fields of earlier versions, which have the prior as a factor, lack this entry."""
        entries = super().to_dict()
        return {k: v for k, v in entries.items() if k != "prior_factor" or not v}

    def __post_init__(self):
        object.__setattr__(self, "heads", tuple(tuple(float(x) for x in corner) for corner in self.heads))
        check_choices(self, variant=VARIANTS, geometry=GEOMETRIES, escaped=MISS_MODES)
        if min(self.width, self.layers, self.sh_degree) < 1 or self.prior < 2 or self.reach not in LENGTHS:
            raise ValueError(f"every size of a gaze field must be positive, got {self}")
        if not 0 <= self.mix <= 1:
            raise ValueError(f"the weight of the position-independent prior must lie in [0, 1], got {self.mix}")
        if np.shape(self.heads) != (2, 3) or not np.all(np.abs(self.heads) <= MAX_COORDINATE):
            raise ValueError(f"the bounding box of observers needs two finite corners, got {self.heads}")

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
    """A normalised gaze density.

    Positions are in the field's units inside ``box``; ``prior``: table (rows, 2 rows) of the log of the
    position-independent prior, rows from +z to -z, columns by azimuth, at texel centres.
    """

    kind: ClassVar[str] = LogGazeConfig.kind
    # Its "geometry" is a word, not a size.
    max_sizes: ClassVar[Mapping[str, int]] = {k: v for k, v in MAX_SIZES.items() if k != "geometry"}
    NETS: ClassVar[tuple[str, ...]] = ("emit_net", "capture_net")
    ARRAYS: ClassVar[tuple[str, ...]] = ("escaped", "prior")
    fixed: ClassVar[tuple[str, ...]] = ("prior",)

    def __init__(
        self, config: LogGazeConfig, box: AnyBox, grid: HashGrid, emit_net: MLP, capture_net: MLP, escaped, prior
    ):
        grid.check_config(config.grid)
        emit_net.check_sizes(config.emit_sizes, "emit_net")
        capture_net.check_sizes(config.capture_sizes, "capture_net")
        if tuple(prior.shape) != (config.prior, 2 * config.prior) or dr.width(escaped) != 1:
            raise ValueError(
                f"the prior needs a table of {config.prior} x {2 * config.prior} and one logit of escaped rays, "
                f"got {tuple(prior.shape)} and {dr.width(escaped)}"
            )
        self.config, self.box, self.grid = config, box, grid
        self.emit_net, self.capture_net, self.escaped, self.prior = emit_net, capture_net, escaped, prior
        self.pack()

    @staticmethod
    def random(
        config: LogGazeConfig, box: AnyBox, ns: ModuleType, seed: int = 0, prior: np.ndarray | None = None
    ) -> LogGazeField:
        """An untrained field of backend ``ns``; equal seeds give equal weights. ``prior``: a `make_prior_table`;
        default: uniform."""
        rng = np.random.default_rng(seed)
        if prior is None:
            prior = np.full((config.prior, 2 * config.prior), -np.log(4 * np.pi))
        return LogGazeField(
            config,
            box,
            HashGrid.random(config.grid, ns, rng),
            MLP.random(config.emit_sizes, ns, rng),
            MLP.random(config.capture_sizes, ns, rng),
            ns.Float(0.0),
            ns.TensorXf(np.asarray(prior, np.float32)),
        )

    @classmethod
    def from_arrays(cls, architecture: dict, box: AnyBox, arrays: Arrays) -> LogGazeField:
        config = LogGazeConfig.from_dict(architecture)
        return cls(
            config,
            box,
            arrays.build_grid(config.grid),
            arrays.build_network("emit_net", config.emit_sizes),
            arrays.build_network("capture_net", config.capture_sizes),
            arrays.ns.Float(arrays.get_array("escaped", 1)),
            arrays.ns.TensorXf(arrays.get_array("prior", config.prior, 2 * config.prior, max_value=_MAX_LOG_PRIOR)),
        )

    def log_base(self, r_o):
        """Log of the density that the factors multiply: the prior, or 1."""
        return self.log_prior(r_o) if self.config.prior_factor else dr.zeros(type(r_o.x), dr.width(r_o))

    def emit_inputs(self, p_od, p_o, r_o, active: Bool | bool = True) -> list:
        """Inputs of the emit network (list of Floats): a bias, the log distance, the direction, the encoded
        position."""
        Float = type(p_od.x)
        if self.config.geometry == "none":
            p_od = p_o + r_o * self.config.reach
        # The maximum before the logarithm: the derivative at zero would not be finite.
        log_distance = 0.5 * dr.log(dr.maximum(dr.squared_norm(p_od - p_o), (_MIN_DISTANCE * self.box.side) ** 2))
        return [
            Float(1),
            log_distance,
            *encode_direction(-r_o, self.config.sh_degree),
            *self.grid(self.box.to_unit(p_od), active),
        ]

    def capture_position(self, p_o) -> list:
        """The observer's position as inputs of the capture network: coordinates in the bounding box of observers and
        first harmonics."""
        low, high = np.array(self.config.heads)
        scale = 2 / max((high - low).max(), 1e-6)
        u = [dr.clip((c - l) * scale - 1, -1, (h - l) * scale - 1) for c, l, h in zip(p_o, low.tolist(), high.tolist())]
        return u + [f(c * (dr.pi / 2)) for f in (dr.sin, dr.cos) for c in u]

    def capture_inputs(self, position: list, r_o) -> list:
        """Inputs of the capture network for the output of `capture_position` and a direction."""
        return [type(r_o.x)(1), *encode_direction(r_o, self.config.sh_degree), *position]

    def capture(self, p_o, r_o, active: Bool | bool = True):
        """sigmoid(F_c(p_o, r_o))."""
        return sigmoid(self.capture_net(self.capture_inputs(self.capture_position(p_o), r_o))[0])

    def unnormalized(self, p_od, p_o, r_o, active: Bool | bool = True, semantic=None, escaped: Bool | bool = False):
        """``(emit, capture)``, whose product has the integral ``Z``; emit contains the prior if it is a factor.

        ``escaped``: mask of directions without a surface; ``semantic`` is not used.
        """
        c, one = self.config, type(p_od.x)(1)
        logit = self.log_base(r_o)
        if c.variant != "capture":
            emit = self.emit_net(self.emit_inputs(p_od, p_o, r_o, active))[0]
            logit += emit if c.fills_escaped else dr.select(escaped, self.escaped, emit)
        return dr.exp(dr.minimum(logit, _MAX_LOGIT)), one if c.variant == "emit" else self.capture(p_o, r_o, active)
