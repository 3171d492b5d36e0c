"""Base classes of gaze fields, the registry of their kinds, ensembles, the position-independent prior, and the support
by training data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

import drjit as dr
import numpy as np

from nerg_mi.errors import sanitize
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f
from nerg_mi.ranges import MAX_COORDINATE
from nerg_mi.tracking_kinds import TRACKING_NOTES, read_tracking

from .encoding import HashGrid, HashGridConfig
from .gaze_hits import ReaimedHits
from .mlp import MLP, namespace
from .radiance import assign_parameters

if TYPE_CHECKING:
    from typing_extensions import Self

# ---- Amount of data behind a gaze field: rays and participants ----

_MAX_COUNT = 1 << 60


@dataclass(frozen=True)
class DataSummary:
    """The amount and kind of data that a gaze field was fitted to, or that a density is estimated from.

    ``rays``: number of rays; ``people``: number of participants (None: unknown); ``images``: number of salience images;
    ``tracking``: "eye", "head", "mixed" or "unknown".
    """

    rays: int
    people: int | None = None
    images: int = 0
    tracking: str = "unknown"

    def words(self) -> str:
        """In words, such as "81,751 rays of 80 participants (directions of heads)"; "" without data."""
        rays = _count(self.rays, "ray", "rays")
        if rays and self.people:
            rays += " of " + _count(self.people, "participant", "participants")
        if rays and self.tracking in TRACKING_NOTES:
            rays += f" ({TRACKING_NOTES[self.tracking]})"
        return " and ".join(filter(None, [rays, _count(self.images, "salience image", "salience images")]))


def summarize_provenance(provenance: Mapping[str, Any]) -> DataSummary | None:
    """The amount of data in a checkpoint's ``provenance``; None if it is not recorded, as in checkpoints of other
    programs."""
    rays, people, images = (_number(provenance.get(name)) for name in ("rays", "people", "salience_views"))
    return DataSummary(rays or 0, people or None, images or 0, read_tracking(provenance)) if rays or images else None


def _number(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _MAX_COUNT else None


def _count(number: int, one: str, several: str) -> str:
    return f"{number:,} {one if number == 1 else several}" if number else ""


def tracking_suffix(provenance: Mapping[str, Any]) -> str:
    """Suffix of a title that names rays of heads, such as " (directions of heads)"; "" for gaze."""
    note = TRACKING_NOTES.get(read_tracking(provenance))
    return f" ({note})" if note else ""


# ---- Support ----
#
# The amount of training data near a position: where the rays started, in a few kilobytes.
#
# Support at p is a sum of Epanechnikov kernels over rays, Σ_i max(0, 1 - |o_i - p|² / (5R)²), with the probe radius R.
# A ray that started at p counts as one, a ray 5R away as zero. Kernels of radius R would be zero at all positions
# without a probe, although the error of a field keeps growing with the distance there. docs/explanation/accuracy.md
# measures how well kernels of 5R rank the errors.
#
# Rays are stored as cells of size R/2 with their number, mean origin and variance. The sum over a cell within the
# cut-off follows from these exactly. For a cell that the cut-off divides, squared distances are assumed to be uniformly
# distributed.

CELLS_PER_RADIUS = 2  # Cells per R
CUTOFF_RADII = 5.0  # Cut-off in radii R

_DENSE = 64  # Candidate cells for the position with the greatest support


class RaySupport:
    """Number of training rays near a position.

    ``cells`` (n, 5): mean origin (3), number of rays, and their mean squared distance from the mean; ``radius``: R;
    both in one frame. ``cutoff``: distance beyond which a ray does not count.
    """

    def __init__(self, cells: np.ndarray, radius: float):
        self.cells, self.radius = np.ascontiguousarray(cells, np.float32).reshape(-1, 5), float(radius)
        self.cutoff = CUTOFF_RADII * self.radius
        if not np.all(np.isfinite(self.cells)) or not 0 < self.radius <= MAX_COORDINATE:
            raise ValueError(f"the support of a gaze field needs finite cells and a positive radius, got {self.radius}")

    @staticmethod
    def from_origins(origins: np.ndarray, radius: float) -> RaySupport:
        """The support of rays from ``origins`` (N, 3), for probes of ``radius``."""
        origins = np.asarray(origins, np.float64).reshape(-1, 3)
        lower = origins.min(axis=0)
        index = np.floor((origins - lower) * (CELLS_PER_RADIUS / radius)).astype(np.int64)
        _, cell, count = np.unique(
            np.ravel_multi_index(index.T, index.max(axis=0) + 1), return_inverse=True, return_counts=True
        )
        mean = np.stack([np.bincount(cell, weights=x) for x in origins.T], axis=1) / count[:, None]
        variance = np.bincount(cell, weights=((origins - mean[cell]) ** 2).sum(axis=1)) / count
        return RaySupport(np.concatenate([mean, count[:, None], variance[:, None]], axis=1), radius)

    def evaluate(self, p):
        """Support at ``p`` (Array3f or Point3f, one lane): a Float of one lane, without derivatives."""
        Float: Any = dr.float32_array_t(type(p.x))
        p = dr.detach(p)
        x, y, z, count, variance = (Float(np.ascontiguousarray(column)) for column in self.cells.T)
        square = dr.square(x - p.x) + dr.square(y - p.y) + dr.square(z - p.z)
        scale = 1 / self.cutoff**2
        inside = 1 - (square + variance) * scale
        # Half width of a uniform distribution with the variance of |o - p|² in a cell with isotropic rays.
        half_width = dr.sqrt(4 * square * variance) * scale + 1e-9
        cut = dr.square(dr.maximum(inside + half_width, 0)) / (4 * half_width)
        return dr.sum(count * dr.select(inside > half_width, inside, cut))

    def find_densest_position(self) -> np.ndarray:
        """The position (3,) float64 where most rays started, by kernels of R: among the mean origins of the fullest
        cells; the first one in a tie."""
        cells = self.cells.astype(np.float64)
        best = cells[np.argsort(-cells[:, 3], kind="stable")[:_DENSE], :3]
        square = ((best[:, None] - cells[None, :, :3]) ** 2).sum(axis=-1) + cells[:, 4]
        return best[np.argmax((np.maximum(1 - square / self.radius**2, 0) * cells[:, 3]).sum(axis=1))]


MAX_SIZES = {"width": 4096, "geometry": 4096, "hidden": 64, "layers": 64, "sh_degree": 10, "prior": 4096}
"""Maximum sizes of an architecture, by name; larger networks are not trained, and their kernels do not compile."""

# ---- The common interface of gaze fields ----
#
# A gaze field is a density over the directions around an observer (1/sr): a product of two factors (`gaze_product`), a
# normalised log density (`gaze_log_density`) or any other registered `GazeHead`, or the mean of several of these
# (`GazeEnsemble`). Code outside this package does not distinguish them.
#
# Positions and directions are Dr.Jit 3-arrays of the field's backend, in the field's own frame and units; directions
# are unit vectors, and ``r_o`` points from the observer to the surface. Densities are invariant to scale.

MAX_WEIGHT = (
    1e6  # Maximum absolute weight in a file; products over the layers of a network then stay in single precision
)


class Arrays(Protocol):
    """The arrays of a checkpoint, as ``from_arrays`` of a field needs them.

    All methods raise ``ValueError`` for an array that is not finite or has the wrong shape, and ``KeyError`` for a
    missing one.
    """

    ns: ModuleType

    def get_array(self, name: str, *shape: int | None, max_value: float = MAX_WEIGHT) -> np.ndarray:
        """The float32 array ``name`` of this ``shape`` (None: any length), with absolute values up to ``max_value``."""
        ...

    def build_grid(self, config: HashGridConfig, name: str = "grid") -> HashGrid:
        """The encoding of ``config``."""
        ...

    def build_network(self, name: str, sizes: list[int], normalized: bool = False) -> MLP:
        """The network with layers of these ``sizes``; ``normalized``: with the gains and shifts of LayerNorm."""
        ...

    def get_member(self, index: int, architecture: dict) -> tuple[dict, Arrays]:
        """The validated architecture and the arrays of the member ``index`` of an ensemble."""
        ...


class GazeNetwork:
    """Base of gaze fields on one backend: a single density (`GazeHead`), or the mean of several (`GazeEnsemble`).

    Attributes
    ----------
    config : GazeHeadConfig
        Sizes and conventions.
    box : AnyBox
        The domain of the field; the encoding handles positions outside.
    ns : module
        Array types of the backend (`fields.mlp.namespace`).
    members : sequence of GazeHead
        The densities that are averaged.
    networks : int
        Number of networks that one evaluation of gaze evaluates.
    mlps : list of MLP
        The networks of all members.
    """

    kind: ClassVar[str]  # Name of the class in checkpoints
    # Maximum sizes that a checkpoint may contain, by name.
    max_sizes: ClassVar[Mapping[str, int]] = MAX_SIZES
    fixed: ClassVar[tuple[str, ...]] = ()  # Parameters that training does not change

    config: Any
    box: AnyBox
    support: RaySupport | None = None  # Number of training rays near a position, if known
    hits: ReaimedHits | None = None  # Re-aimed hits, whose density is mixed into that of the networks
    basis: DataSummary | None = None  # Total number of training rays and participants, if known

    @property
    def ns(self) -> ModuleType:
        return namespace(self.mlps[0].weights[0])

    @property
    def members(self) -> Sequence[GazeHead]:
        raise NotImplementedError

    @property
    def networks(self) -> int:
        raise NotImplementedError

    @property
    def mlps(self) -> list[MLP]:
        raise NotImplementedError

    def architecture(self) -> dict:
        """What ``from_arrays`` needs besides the arrays (JSON)."""
        raise NotImplementedError

    @classmethod
    def from_arrays(cls, architecture: dict, box: AnyBox, arrays: Arrays) -> GazeNetwork:
        """The field with this ``architecture()`` and the ``arrays`` of a checkpoint."""
        raise NotImplementedError

    def parameters(self) -> dict:
        """Arrays that gaze depends on, named as in checkpoints and ``mi.traverse``."""
        raise NotImplementedError

    def set_parameters(self, values: dict) -> None:
        """Replace arrays by name (any subset of ``parameters()``) and `pack`."""
        raise NotImplementedError

    def pack(self) -> None:
        """Update what the kernels read; call it after any change of the weights."""
        raise NotImplementedError


class GazeHeadConfig:
    """Base of the configurations of gaze fields with a single density: frozen dataclasses that a checkpoint stores as
    JSON.

    The defaults are those of a density with both factors that is normalised over the sphere.
    """

    kind: ClassVar[str]  # Name of the field's class in checkpoints
    grid: Any  # The encoding of positions
    variant: Any = "emit_capture"  # emit, capture or emit_capture: the factors of the density
    activation: Any = "log"  # Output activation that makes it a density; informative only
    # Whether ``evaluate`` divides by the integral over the observer's sphere, which it then requires.
    normalized: Any = True
    semantic: Any = ""  # Features of a radiance field that emit takes: accumulated, snapshot or none ("")
    prior: Any = 0  # Rows of the table of the position-independent prior; 0 for a field without one
    mix: Any = 0.0  # Weight of the position-independent prior
    # Whether the prior is also a factor of the density that it is mixed into, so that it cannot be replaced
    prior_factor: Any = True

    @property
    def features(self) -> int:
        """Number of features of a radiance field that emit takes."""
        return 0

    @property
    def needs_surfaces(self) -> bool:
        """Whether the field depends on the surfaces that the observer's rays meet."""
        return True

    @property
    def fills_escaped(self) -> bool:
        """Whether a direction without a surface takes the depth of the nearest directions with one; otherwise its ray
        ends on the field's box."""
        return False

    def conventions(self) -> tuple:
        """What fields must have in common for their densities to be averaged."""
        return self.kind, self.variant

    def to_dict(self) -> dict:
        """As a JSON object."""
        return {"kind": self.kind, **asdict(self), "grid": self.grid.to_dict()}  # pyright: ignore[reportArgumentType]

    @classmethod
    def from_dict(cls, d: dict) -> Self:
        """The inverse of `to_dict`."""
        return cls(**{**{k: v for k, v in d.items() if k != "kind"}, "grid": HashGridConfig.from_dict(d["grid"])})


def check_choices(config: GazeHeadConfig, **words: tuple[str, ...]) -> None:
    """Raise ``ValueError`` unless each named entry of ``config`` is one of its allowed ``words``."""
    for name, allowed in words.items():
        if getattr(config, name) not in allowed:
            raise ValueError(
                f'"{name}" of a gaze field must be one of {", ".join(filter(None, allowed))}, '
                f'got "{getattr(config, name)}"'
            )


class GazeHead(GazeNetwork):
    """Base of a gaze field with a single density: attributes are an encoding ``grid``, plain arrays ``ARRAYS`` and
    networks ``NETS``. A subclass defines how it is constructed and its ``unnormalized`` density."""

    ARRAYS: ClassVar[tuple[str, ...]] = ()
    NETS: ClassVar[tuple[str, ...]] = ()
    DRJIT_STRUCT: ClassVar[dict]

    grid: Any
    prior: Any  # Log of the position-independent prior, if the configuration has one

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        cls.DRJIT_STRUCT = dict.fromkeys(("grid", *cls.NETS, *cls.ARRAYS))

    def architecture(self) -> dict:
        return self.config.to_dict()

    @property
    def members(self) -> Sequence[Self]:
        return [self]

    @property
    def networks(self) -> int:
        return 2 if self.config.variant == "emit_capture" else 1

    @property
    def mlps(self) -> list[MLP]:
        return [getattr(self, name) for name in self.NETS]

    def parameters(self) -> dict:
        out = {f"grid.{key}": value for key, value in self.grid.named().items()}
        out |= {name: getattr(self, name) for name in self.ARRAYS}
        for name in self.NETS:
            out |= {f"{name}.{key}": value for key, value in getattr(self, name).named().items()}
        return out

    def set_parameters(self, values: dict) -> None:
        for name in self.ARRAYS:
            if name in values:
                setattr(self, name, values[name])
        assign_parameters(self, {k: v for k, v in values.items() if k not in self.ARRAYS})
        self.pack()

    def pack(self) -> None:
        for name in self.NETS:
            getattr(self, name).pack()

    def unnormalized(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool | bool = True,
        semantic: list[Float] | None = None,
        escaped: Bool | bool = False,
    ) -> tuple[Float, Float]:
        """``(emit, capture)``, whose product a normalised field divides by its integral. A missing factor is 1 and is
        not evaluated.

        ``semantic``: ``config.features`` Floats if the configuration has semantic features, else None; ``escaped``:
        mask of directions without a surface. Differentiable in the parameters, positions and directions.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define its density")

    def evaluate(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool | bool = True,
        semantic: list[Float] | None = None,
        integral: Float | None = None,
        escaped: Bool | bool = False,
    ) -> tuple[Float, Float, Float]:
        """``(gaze, emit, capture)`` in 1/sr for the observer at ``p_o`` who looks at ``p_od`` along unit ``r_o``.

        With a weight m of the position-independent prior, gaze = (1 - m) emit * capture + m prior.

        Parameters
        ----------
        active, semantic, escaped
            As for ``unnormalized``.
        integral : Float, optional
            Integral of a normalised field over the sphere at ``p_o`` (`transport.observer_gaze`), by which ``emit`` is
            divided.

        Raises
        ------
        ValueError
            For a normalised field without ``integral``.
        """
        if self.config.normalized and integral is None:
            raise ValueError(
                "this gaze field is normalised over the observer's sphere; evaluating it requires its integral"
            )
        emit, capture = self.unnormalized(p_od, p_o, r_o, active, semantic, escaped)
        if integral is not None and self.config.normalized:
            emit = emit / integral
        gaze = emit * capture
        if self.config.mix:
            gaze = (1 - self.config.mix) * gaze + self.config.mix * dr.exp(self.log_prior(r_o))
        return gaze, emit, capture

    def log_prior(self, r_o: Vector3f) -> Float:
        """Log of the position-independent prior (1/sr) in the direction ``r_o``, interpolated in the table
        ``prior``."""
        return interpolate_table(self.prior.array, self.config.prior, r_o)

    def set_prior(self, weight: float, table: np.ndarray | None = None) -> None:
        """Set the weight of the position-independent prior, and its ``table`` (`make_prior_table`) unless it is None.

        Raises ``ValueError`` for a table if the prior is a factor of the density.
        """
        if table is not None:
            if self.config.prior_factor:
                raise ValueError("the prior is a factor of this gaze field's density and cannot be replaced")
            self.prior = self.ns.TensorXf(np.asarray(table, np.float32))
        self.config = replace(self.config, mix=weight)


# ---- Registry of gaze fields by their names in checkpoints ----

Kind = TypeVar("Kind", bound=type[GazeNetwork])

_KINDS: dict[str, type[GazeNetwork]] = {}


def register(cls: Kind) -> Kind:
    """Register ``cls`` for checkpoints of the kind ``cls.kind`` (a decorator)."""
    _KINDS[cls.kind] = cls
    return cls


def kinds() -> tuple[str, ...]:
    """The registered names."""
    return tuple(_KINDS)


def build_gaze_field(architecture: dict, box: AnyBox, arrays: Arrays) -> GazeNetwork:
    """The gaze field with this ``architecture`` and the ``arrays`` of a checkpoint. Raises ``ValueError`` for an
    unknown kind."""
    # Checkpoints of the first version have no kind: there was only one.
    kind = architecture.get("kind", "product")
    if kind not in _KINDS:
        raise ValueError(f'it is a gaze field of the kind "{sanitize(kind, 40)}", which this version does not know')
    return _KINDS[kind].from_arrays(architecture, box, arrays)


def max_sizes_of(architecture: object) -> Mapping[str, int]:
    """Maximum sizes that a checkpoint with this ``architecture`` may contain; empty for an unknown kind, which is not
    built."""
    kind = architecture.get("kind", "product") if isinstance(architecture, dict) else None
    return _KINDS[kind].max_sizes if isinstance(kind, str) and kind in _KINDS else {}


# ---- The position-independent prior as a latitude-longitude table of its logarithm ----

_FLOOR = 1e-3  # Uniform fraction of the prior, which keeps its logarithm finite


def interpolate_table(table, rows: int, d):
    """Bilinear interpolation of a flat latitude-longitude ``table`` (rows x 2 rows, texel centres, +z first) along
    ``d``."""
    Float = type(d.x)
    UInt32 = dr.uint32_array_t(Float)
    step, columns = dr.pi / rows, 2 * rows
    phi = dr.atan2(d.y, d.x)
    x = dr.select(phi < 0, phi + dr.two_pi, phi) / step - 0.5
    x = dr.select(x < 0, x + columns, x)
    y = dr.clip(dr.atan2(dr.sqrt(d.x * d.x + d.y * d.y), d.z) / step - 0.5, 0, rows - 1)
    i, j = dr.minimum(UInt32(x), columns - 1), dr.minimum(UInt32(y), rows - 2)
    fx, fy = x - Float(i), y - Float(j)
    k = dr.select(i + 1 < columns, i + 1, 0)
    at = lambda column, row: dr.gather(Float, table, column + columns * row)
    return dr.lerp(dr.lerp(at(i, j), at(k, j), fx), dr.lerp(at(i, j + 1), at(k, j + 1), fx), fy)


def table_directions(rows: int) -> np.ndarray:
    """Directions (2 rows², 3) of the texels that `interpolate_table` uses."""
    theta, phi = np.meshgrid(
        (np.arange(rows) + 0.5) * np.pi / rows, (np.arange(2 * rows) + 0.5) * np.pi / rows, indexing="ij"
    )
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)


def add_prior_floor(density: np.ndarray) -> np.ndarray:
    """Replace a thousandth of a ``density`` (1/sr) by the uniform density, so that its logarithm is finite."""
    return (1 - _FLOOR) * density + _FLOOR / (4 * np.pi)


def make_prior_table(density: np.ndarray, rows: int, ns: ModuleType, directions: np.ndarray) -> np.ndarray:
    """Log table (rows, 2 rows) of a position-independent ``density`` (1/sr) in the directions
    ``table_directions(rows)``.

    A thousandth of it is uniform. Scaled so that its interpolant integrates to one over ``directions`` (N, 3), a fine
    set of equal area.
    """
    log = np.log(add_prior_floor(np.asarray(density, np.float64)))
    d = to_vector(ns.Array3f, directions)
    values = np.asarray(dr.exp(interpolate_table(ns.Float(log.astype(np.float32)), rows, d)), np.float64)
    return (log - np.log(4 * np.pi * values.mean())).reshape(rows, 2 * rows).astype(np.float32)


# ---- Ensembles ----
#
# The mean of several gaze fields is the gaze; their standard deviation estimates its uncertainty. Members are trained
# alike on bootstrap samples of the participants (bagging, Breiman 1996; deep ensembles, Lakshminarayanan et al. 2017).


@register
class GazeEnsemble(GazeNetwork):
    """The mean of ``members``: two or more fields of one kind, variant and box. Raises ``ValueError`` if they differ in
    these.

    ``config`` and ``box`` are those of the first member; ``support``: of all rays that the members' samples were drawn
    from.
    """

    DRJIT_STRUCT: ClassVar[dict] = {"_members": None}
    kind: ClassVar[str] = "ensemble"

    def __init__(self, members: Sequence[GazeHead], support: RaySupport | None = None):
        self._members, self.support = list(members), support
        if len(self.members) < 2:
            raise ValueError(f"an ensemble of gaze fields needs at least two members, got {len(self.members)}")
        if any(len(m.members) > 1 for m in self.members):
            raise ValueError("a member of an ensemble of gaze fields is an ensemble itself; give its members instead")
        if any(m.hits is not None for m in self.members):
            raise ValueError(
                "a member of an ensemble of gaze fields has re-aimed hits, which belong to the whole ensemble; train "
                "the members with reaimed_hits=False"
            )
        if any(_common(m) != _common(self.members[0]) for m in self.members):
            raise ValueError(
                "the members of an ensemble of gaze fields differ in kind, variant, output or box; train them alike"
            )
        self.config, self.box = self.members[0].config, self.members[0].box

    @property
    def members(self) -> Sequence[GazeHead]:
        return self._members

    @classmethod
    def from_arrays(cls, architecture: dict, box: AnyBox, arrays: Arrays) -> GazeEnsemble:
        members = [arrays.get_member(i, member) for i, member in enumerate(architecture["members"])]
        # Before any member is built: a file can nest ensembles without end.
        if any("members" in member for member, _ in members):
            raise ValueError("a member of its ensemble is an ensemble itself, which this version does not read")
        return cls(
            [
                density
                for member, member_arrays in members
                for density in build_gaze_field(member, box, member_arrays).members
            ]
        )

    def architecture(self) -> dict:
        return {"kind": self.kind, "members": [m.architecture() for m in self.members]}

    @property
    def networks(self) -> int:
        return sum(m.networks for m in self.members)

    @property
    def mlps(self) -> list[MLP]:
        return [net for member in self.members for net in member.mlps]

    def parameters(self) -> dict:
        return {f"{i}.{name}": value for i, m in enumerate(self.members) for name, value in m.parameters().items()}

    def set_parameters(self, values: dict) -> None:
        for i, member in enumerate(self.members):
            member.set_parameters({k.removeprefix(f"{i}."): v for k, v in values.items() if k.startswith(f"{i}.")})

    def pack(self) -> None:
        for member in self.members:
            member.pack()


def mean_over_members(values: list[tuple]) -> tuple:
    """Mean ``(gaze, emit, capture)`` over one or more members; mean gaze is not the product of the other means."""
    if len(values) == 1:
        return values[0]
    return tuple(sum(parts[1:], parts[0]) / len(values) for parts in zip(*values))


def std_over_members(values: list[tuple]) -> Float:
    """Standard deviation of gaze over the ``(gaze, emit, capture)`` of two or more members (1/sr, N - 1 degrees of
    freedom)."""
    gaze = mean_over_members(values)[0]
    variance: Any = sum(dr.square(g - gaze) for g, _, _ in values) / (len(values) - 1)
    # Where members agree, the derivative of the square root would not be finite.
    is_nonzero = variance > 1e-30
    return dr.select(is_nonzero, dr.sqrt(dr.select(is_nonzero, variance, 1)), 0)


def _common(field: GazeHead) -> tuple:
    return field.config.conventions(), tuple(field.box.lower), tuple(field.box.upper)
