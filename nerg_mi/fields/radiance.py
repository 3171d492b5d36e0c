"""Radiance fields: density and colour networks, deferred shading, and the background."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.arrays import sigmoid
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Bool, Float
from nerg_mi.ranges import MAX_COORDINATE, POSITIVE_VALUES

from .encoding import HashGrid, HashGridConfig, encode_direction
from .mlp import MLP, namespace
from .occupancy import CascadeGrid, OccupancyGrid, RefinedGrid
from .voxels import VoxelGrid

if TYPE_CHECKING:
    from typing_extensions import Self

EMPTY = (
    "is empty: no cell of its occupancy has density, because its training was too short or did not converge; "
    f"train it longer with {parameter('steps')} or {parameter('minutes')}"
)
"""What an empty radiance field is, as the end of a sentence."""

# ---- Background ----
#
# Colour behind the scene, on a surrounding sphere: torch-ngp's background network.
#
# The ray's far intersection with the sphere, as two angles, passes a small 2-D hash grid; its features and the
# harmonics of the direction pass a small network to a colour (``NeRFNetwork.background`` in torch-ngp).


class GridConfig:
    """Base of frozen dataclasses of sizes with an encoding ``grid``, stored in checkpoints as JSON objects."""

    grid: HashGridConfig

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "grid": self.grid.to_dict()}  # pyright: ignore[reportArgumentType] it is a dataclass

    @classmethod
    def from_dict(cls, d: dict[str, Any]) -> Self:
        """The inverse of ``to_dict``. Raises ``KeyError``, ``TypeError`` or ``ValueError`` for invalid data."""
        return cls(**{**d, "grid": HashGridConfig.from_dict(d["grid"])})


@dataclass(frozen=True)
class BackgroundConfig(GridConfig):
    """Sizes of a background. The defaults are torch-ngp's. Raises ``ValueError`` for invalid sizes."""

    radius: float  # Radius of the sphere about the field's origin, in the field's units
    # The encoding of both angles.
    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(levels=4, dimensions=2))
    width: int = 64  # Neurons of each hidden layer
    hidden: int = 1  # Hidden layers
    sh_degree: int = 4  # Degree of the encoding of directions

    def __post_init__(self):
        if not 0 < self.radius <= MAX_COORDINATE:
            raise ValueError(f"the radius of a background must be positive and finite, got {self.radius}")
        if self.grid.dimensions != 2 or min(self.width, self.hidden) < 1:
            raise ValueError(f"a background needs a grid of 2 dimensions and sizes of at least 1, got {self}")

    @property
    def sizes(self) -> list[int]:
        """Sizes of the network's layers, [inputs, ..., 3]."""
        return [self.sh_degree**2 + self.grid.size] + [self.width] * self.hidden + [3]


class Background:
    """Colour (0..1, in the colour space of its radiance field) behind the field.

    Raises ``ValueError`` for parts that do not match ``config``.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"grid": None, "net": None}

    def __init__(self, config: BackgroundConfig, grid: HashGrid, net: MLP):
        grid.check_config(config.grid)
        net.check_sizes(config.sizes, "background_net")
        self.config, self.grid, self.net = config, grid, net

    @staticmethod
    def random(config: BackgroundConfig, ns: ModuleType, seed: int = 0) -> Background:
        """An untrained background; equal seeds give equal weights."""
        rng = np.random.default_rng(seed)
        return Background(config, HashGrid.random(config.grid, ns, rng), MLP.random(config.sizes, ns, rng))

    def coordinates(self, o, d) -> list:
        """[2 θ / π - 1, φ / π] where the ray ``o + t d`` (unit ``d``) leaves the sphere; θ from +y, φ from +x to +z."""
        b = dr.dot(o, d)
        # A ray that misses the sphere takes the sphere's point nearest to its own nearest point.
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


# ---- Inputs and outputs of the colour network ----
#
# For each sample of a ray, c(g, d) = sigmoid(color_net(Y(d), g)). A deferred field evaluates it once per ray:
#
#     C = α c(ḡ, d),   ḡ = Σ_i w_i g_i / α,   α = Σ_i w_i,   c(g, d) = sigmoid(l + color_net(Y(d), l, g_4..))
#
# with l = logit(g_1..3) and the weights w_i of volume rendering, after Hedman et al. 2021 ("Baking Neural Radiance
# Fields for Real-Time View Synthesis", section 3): the first three features are a diffuse colour in 0..1, composited
# like any colour, to which the network adds the view-dependent part. Hedman et al. add colours; here their logits are
# added, so that the sum stays in 0..1.

_MARGIN = 1e-3  # Margin of a diffuse colour from 0 and 1 before its logit


def point_features(outputs: list[Float], deferred: bool) -> list[Float]:
    """Features of points, from the ``outputs`` of the density net behind the log density. For a deferred field the
    first three become its diffuse colour in 0..1."""
    return [*(sigmoid(x) for x in outputs[:3]), *outputs[3:]] if deferred else outputs


def mean_features(sums: list[Float], opacity: Float) -> list[Float]:
    """Mean features Σ w g / α of rays, from their composited features ``sums`` Σ w g and their ``opacity`` α; 0 for
    rays of opacity 0."""
    # The derivative contains the square, which must stay finite.
    per = 1 / dr.maximum(opacity, 1e-12)
    return [s * per for s in sums]


def color_network_inputs(features: list[Float], deferred: bool) -> list[Float]:
    """Inputs of the colour net behind the encoded direction, from ``features`` (`point_features`, or `mean_features` of
    rays if ``deferred``). For a ``deferred`` field, the diffuse colour is replaced by its logits."""
    if not deferred:
        return features
    # Not clipped: clipping would have no gradient at black and white.
    inside = [dr.fma(1 - 2 * _MARGIN, f, _MARGIN) for f in features[:3]]
    return [*(dr.log(x / (1 - x)) for x in inside), *features[3:]]


def decode_color(outputs: list[Float], inputs: list[Float], deferred: bool) -> list[Float]:
    """Colour of points or, for a deferred field, of rays.

    Parameters
    ----------
    outputs
        The 3 outputs of the colour net, before the sigmoid.
    inputs
        Inputs of the colour net behind the direction, as `color_network_inputs` returns them. Only used if
        ``deferred``: the first three are the logits of the diffuse colour, to which the outputs are added.
    deferred
        Whether the field is deferred (`RadianceConfig.deferred`).

    Returns
    -------
    list of Float
        Red, green and blue in 0..1, in the colour space of the training: sRGB or linear, as the field's ``color_space``
        states.
    """
    return [sigmoid(c + x) for c, x in zip(outputs, inputs)] if deferred else [sigmoid(c) for c in outputs]


# ---- Radiance ----
#
# The radiance field: density and view-dependent colour at a point.
#
#     (h, g) = density_net(encoding(p)),   σ(p) = density_scale · exp(h),   c(p, d) = sigmoid(color_net(Y(d), g))
#
# with the spherical harmonics Y of the direction: NeRF (Mildenhall et al. 2020, section 3) in the architecture of
# instant-ngp (Müller et al. 2022, section 5.4), as torch-ngp and the paper use it.

_MAX_LOG_DENSITY = 30.0  # exp(30) is 1e13 per unit: opaque at any scale, and far below the overflow of fp32 (exp(88))


@dataclass(frozen=True)
class RadianceConfig(GridConfig):
    """Sizes of the networks. The defaults are the paper's. Raises ``ValueError`` for invalid sizes."""

    grid: HashGridConfig = field(default_factory=HashGridConfig)  # The encoding of positions
    width: int = 64  # Neurons of each hidden layer
    density_hidden: int = 1  # Hidden layers of the density net
    color_hidden: int = 2  # Hidden layers of the colour net
    geometry: int = 15  # Features passed from the density net to the colour net
    sh_degree: int = 4  # Degree of the encoding of directions, which has sh_degree**2 numbers
    density_scale: float = 1.0  # Density in 1/unit for an output of 0 of the density net
    # Whether the colour net is evaluated once per ray, on the composited features, of which three are a colour.
    deferred: bool = False

    def __post_init__(self):
        if min(self.width, self.density_hidden, self.color_hidden, self.geometry, self.sh_degree) < 1:
            raise ValueError(f"every size of a radiance field must be at least 1, got {self}")
        if self.density_scale not in POSITIVE_VALUES:
            raise ValueError(f"density_scale must be positive and finite, got {self.density_scale}")
        if not isinstance(self.deferred, bool):
            raise ValueError(f"deferred must be true or false, got {self.deferred!r}")
        if self.deferred and self.geometry < 3:
            raise ValueError(
                f"a deferred field needs at least 3 geometry features, its diffuse colour; got {self.geometry}"
            )

    @property
    def density_sizes(self) -> list[int]:
        """Sizes of the density net's layers, [inputs, ..., outputs]: the first output is the log density."""
        return [self.grid.size] + [self.width] * self.density_hidden + [1 + self.geometry]

    @property
    def color_sizes(self) -> list[int]:
        """Sizes of the colour net's layers, [inputs, ..., 3]."""
        return [self.sh_degree**2 + self.geometry] + [self.width] * self.color_hidden + [3]

    def to_dict(self) -> dict[str, Any]:
        """The JSON object for a checkpoint. ``deferred`` is only written if true, so that releases without deferred
        fields can read other fields."""
        out = super().to_dict()
        if not self.deferred:
            del out["deferred"]
        return out


def assign_parameters(field, values: dict) -> None:
    """Replace parameters of a field by name, each by one of the same shape. Raises ``ValueError`` for unknown names and
    other shapes."""
    parameters = field.parameters()
    for name, value in values.items():
        if name not in parameters:
            raise ValueError(f'this field has no parameter "{name}"; it has {", ".join(parameters)}')
        if value.shape != parameters[name].shape:
            raise ValueError(
                f'"{name}" has the shape {parameters[name].shape}, not that of the new value, {value.shape}'
            )
    for name, value in values.items():
        owner, part = name.split(".", 1)
        getattr(field, owner).replace(part, value)


def density_from_log(h, scale: float):
    """Density from the first output of the density net, clamped well below the overflow of fp32."""
    return scale * dr.exp(dr.minimum(h, _MAX_LOG_DENSITY))


class RadianceNetwork:
    """Density (1/unit) and colour at points of ``box``.

    Raises ``ValueError`` for parts that do not match ``config``.

    Parameters
    ----------
    occupancy : OccupancyGrid or RefinedGrid or CascadeGrid, optional
        Cells whose density may exceed the grid's threshold. Default: the whole box is marched.
    color_space : str
        ``"srgb"`` or ``"linear"``: the space of the training, in which samples are composited.
    march_step : float, optional
        Step length of the training, in the field's units.
    background : Background, optional
        Colour behind the field: a ray shows C + (1 - α) background(o, d) in ``color_space``.
    march_growth : float
        Minimum step of the training as a fraction of the distance, for a contracted box.

    Attributes
    ----------
    voxels : VoxelGrid or None
        Densities of a compiled field (`fields.compilation.compile_density`), which are evaluated in place of the
        networks, of whose outputs only the features are then used. None for a field that is not compiled.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {
        "grid": None,
        "density_net": None,
        "color_net": None,
        "_head": None,
        "occupancy": None,
        "background": None,
        "voxels": None,
    }

    def __init__(
        self,
        config: RadianceConfig,
        box: AnyBox,
        grid: HashGrid,
        density_net: MLP,
        color_net: MLP,
        occupancy: OccupancyGrid | RefinedGrid | CascadeGrid | None = None,
        color_space: str = "srgb",
        march_step: float | None = None,
        background: Background | None = None,
        march_growth: float = 0.0,
    ):
        if color_space not in ("srgb", "linear"):
            raise ValueError(f'color_space must be "srgb" or "linear", got "{color_space}"')
        grid.check_config(config.grid)
        density_net.check_sizes(config.density_sizes, "density_net")
        color_net.check_sizes(config.color_sizes, "color_net")
        self.config, self.box, self.color_space = config, box, color_space
        self.grid, self.density_net, self.color_net = grid, density_net, color_net
        self.march_step, self.background = march_step, background
        self.march_growth = march_growth
        self.occupancy: OccupancyGrid | RefinedGrid | CascadeGrid | None = None
        self.voxels: VoxelGrid | None = None
        self.pack()
        self.occupancy = occupancy

    @staticmethod
    def random(config: RadianceConfig, box: AnyBox, ns: ModuleType, seed: int = 0, **kwargs) -> RadianceNetwork:
        """An untrained field of backend ``ns``; equal seeds give equal weights."""
        rng = np.random.default_rng(seed)
        return RadianceNetwork(
            config,
            box,
            HashGrid.random(config.grid, ns, rng),
            MLP.random(config.density_sizes, ns, rng),
            MLP.random(config.color_sizes, ns, rng),
            **kwargs,
        )

    def parameters(self) -> dict:
        """Trainable arrays by name, as in checkpoints and ``mi.traverse``."""
        owners = ["grid", "density_net", "color_net"]
        if self.background is not None:
            owners += ["background_grid", "background_net"]
        if self.voxels is not None:
            owners += ["voxels"]
        return {f"{name}.{key}": value for name in owners for key, value in getattr(self, name).named().items()}

    @property
    def mlps(self) -> list[MLP]:
        """All of its networks."""
        nets = [self.density_net, self._head, self.color_net]
        return nets if self.background is None else [*nets, self.background.net]

    @property
    def ns(self) -> ModuleType:
        """Array types of the field's backend; see `fields.mlp.namespace`."""
        return namespace(self.density_net.weights[0])

    @property
    def background_grid(self) -> HashGrid | None:
        """The encoding of the background, named like its parameters."""
        return self.background.grid if self.background is not None else None

    @property
    def background_net(self) -> MLP | None:
        """The network of the background, named like its parameters."""
        return self.background.net if self.background is not None else None

    def set_parameters(self, values: dict) -> None:
        """Replace arrays by name (any subset of ``parameters()``) and repack the networks."""
        assign_parameters(self, values)
        if any(not name.startswith("voxels.") for name in values):
            self.pack()

    def pack(self) -> None:
        """Update what the kernels read; call it after any change of the weights.

        A refined occupancy grid is replaced by the grid that it refines, and voxels are discarded: both are only valid
        for the weights that they were computed from.
        """
        self.voxels = None
        if self.occupancy is not None:
            self.occupancy = self.occupancy.coarse
        self.density_net.pack()
        self.color_net.pack()
        # Depth passes need one output of the last layer, not 1 + geometry of them.
        last = self.density_net.weights[-1]
        self._head = MLP(self.density_net.weights[:-1] + [last[0:1, :]])
        self._head.has_constant_weights = self.density_net.has_constant_weights
        self._head.pack()
        if self.background is not None:
            self.background.net.pack()

    def kernel_parameters(self) -> list:
        """The arrays that evaluations read: the encoding's and the packed networks, attached to ``parameters()``."""
        networks = [self.grid.table, self.density_net.buffer, self.color_net.buffer, self._head.buffer]
        return networks if self.voxels is None else [*networks, *self.voxels.kernel_parameters()]

    @property
    def is_empty(self) -> bool:
        """Whether no cell of its occupancy has density, as after a few steps of training."""
        return self.occupancy is not None and self.occupancy.occupied_fraction == 0

    def require_density(self, name: str) -> None:
        """Raise `NergError` for an empty field; ``name`` is its name in the message."""
        if self.is_empty:
            raise NergError(f"{name} {EMPTY}")

    def density(self, p, active: Bool | bool = True):
        """Density in 1/unit at ``p`` (Array3f, the field's units); 0 outside the box."""
        inside, u = active & self.box.contains(p), self.box.to_unit(p)
        if self.voxels is None:
            h = self.log_density(u, inside)
        else:
            h, inside = self.voxels.evaluate(u, inside)
        return dr.select(inside, self._density(h, p), 0)

    def log_density(self, u, active: Bool | bool = True):
        """First output of the density net at ``u`` (Array3f in the unit cube), also of a compiled field."""
        return self._head(self.grid(u, active))[0]

    def _density(self, h, p):
        """Density (1/unit) at ``p`` for the first output ``h`` of the density net."""
        return self.box.density_from_encoded(density_from_log(h, self.config.density_scale), p)

    def density_features(self, p, active: Bool | bool = True):
        """Density (1/unit) at ``p`` and the ``geometry`` features (list of Floats) that ``color`` needs."""
        inside = active & self.box.contains(p)
        h = self.density_net(self.grid(self.box.to_unit(p), inside))
        if self.voxels is not None:
            return self.density(p, active), point_features(h[1:], self.config.deferred)
        return dr.select(inside, self._density(h[0], p), 0), point_features(h[1:], self.config.deferred)

    def color(self, features: list, d):
        """Colour (Array3f in ``color_space``, 0..1) of a point with ``features``, seen along unit ``d``.

        For a deferred field also the colour of an opaque ray along ``d`` with these mean features (`mean_features`).
        """
        inputs = color_network_inputs(features, self.config.deferred)
        rgb = self.color_net(encode_direction(d, self.config.sh_degree) + inputs)
        return type(d)(*decode_color(rgb, inputs, self.config.deferred))
