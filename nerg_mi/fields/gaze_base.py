"""What gaze fields have in common: base classes, the registry of their kinds, ensembles, the table of the density that
does not depend on the position, and where training data supports them."""

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

from .encoding import Encoding, EncodingConfig, encoding_config
from .mlp import MLP, namespace
from .radiance import assign

if TYPE_CHECKING:
    from typing_extensions import Self

# ---- What a picture of gaze rests on: how many rays, of how many people ----

_MOST = 1 << 60


@dataclass(frozen=True)
class DataSummary:
    """``rays`` of ``people`` (None: not known), and ``images`` of salience, that a gaze field learnt from, or of which
    a density is made."""

    rays: int
    people: int | None = None
    images: int = 0

    def words(self) -> str:
        """All of it in words, such as "81,751 rays of 80 people"; "" for nothing."""
        rays = _count(self.rays, "ray", "rays")
        if rays and self.people:
            rays += " of " + _count(self.people, "person", "people")
        return " and ".join(filter(None, [rays, _count(self.images, "salience image", "salience images")]))


def summarize_provenance(provenance: Mapping[str, Any]) -> DataSummary | None:
    """That of a checkpoint's ``provenance``; None where it does not tell, as other programs' checkpoints do not."""
    rays, people, images = (_number(provenance.get(name)) for name in ("rays", "people", "salience_views"))
    return DataSummary(rays or 0, people or None, images or 0) if rays or images else None


def _number(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _MOST else None


def _count(number: int, one: str, several: str) -> str:
    return f"{number:,} {one if number == 1 else several}" if number else ""


# ---- Support ----
#
# How much data a gaze field rests on around a position: where the rays that it learnt from started, in a few kilobytes.
#
# Support at p is the sum over rays of Epanechnikov's kernel, Σ_i max(0, 1 - |o_i - p|² / (5R)²), R the radius of a
# probe: a ray that started at p counts as one, a ray 5R away not at all. A field knows more than its probes: kernels of
# R are zero wherever a field is asked for what it was not shown, where its error grows with the distance still. How
# well those of 5 R rank the errors: docs/explanation/accuracy.md.
#
# Rays are kept as cells of R/2 with their number, mean origin and variance. The sum over a cell within reach follows
# from these exactly. In one that the reach cuts, the squared distances are taken to be spread uniformly.

CELLS = 2  # Cells along R
REACH = 5.0  # Radii R from which a ray still counts

_DENSE = 64  # Cells that are looked at for the one with the greatest support


class RaySupport:
    """``cells`` (n, 5): mean origin (3), number of rays, and their mean squared distance from that; ``radius``: R. Both
    in one frame. ``reach``: how far away a ray still counts."""

    def __init__(self, cells: np.ndarray, radius: float):
        self.cells, self.radius = np.ascontiguousarray(cells, np.float32).reshape(-1, 5), float(radius)
        self.cutoff = REACH * self.radius
        if not np.all(np.isfinite(self.cells)) or not 0 < self.radius <= MAX_COORDINATE:
            raise ValueError(f"the support of a gaze field needs finite cells and a positive radius, got {self.radius}")

    @staticmethod
    def from_origins(origins: np.ndarray, radius: float) -> RaySupport:
        """That of rays from ``origins`` (N, 3), for probes of ``radius``."""
        origins = np.asarray(origins, np.float64).reshape(-1, 3)
        lower = origins.min(axis=0)
        index = np.floor((origins - lower) * (CELLS / radius)).astype(np.int64)
        _, cell, count = np.unique(
            np.ravel_multi_index(index.T, index.max(axis=0) + 1), return_inverse=True, return_counts=True
        )
        mean = np.stack([np.bincount(cell, weights=x) for x in origins.T], axis=1) / count[:, None]
        apart = np.bincount(cell, weights=((origins - mean[cell]) ** 2).sum(axis=1)) / count
        return RaySupport(np.concatenate([mean, count[:, None], apart[:, None]], axis=1), radius)

    def evaluate(self, p):
        """Support at ``p`` (Array3f or Point3f of one lane), a Float of one lane, without derivatives."""
        Float: Any = dr.float32_array_t(type(p.x))
        p = dr.detach(p)
        x, y, z, count, apart = (Float(np.ascontiguousarray(column)) for column in self.cells.T)
        square = dr.square(x - p.x) + dr.square(y - p.y) + dr.square(z - p.z)
        scale = 1 / self.cutoff**2
        inside = 1 - (square + apart) * scale
        # Half the width of a uniform law with the variance of |o - p|² in a cell whose rays spread alike in all
        # directions.
        reach = dr.sqrt(4 * square * apart) * scale + 1e-9
        cut = dr.square(dr.maximum(inside + reach, 0)) / (4 * reach)
        return dr.sum(count * dr.select(inside > reach, inside, cut))

    def find_densest_position(self) -> np.ndarray:
        """Where most rays started (3,) float64, by kernels of R: of the mean origins of the cells with most rays; of
        equal ones the first."""
        cells = self.cells.astype(np.float64)
        best = cells[np.argsort(-cells[:, 3], kind="stable")[:_DENSE], :3]
        square = ((best[:, None] - cells[None, :, :3]) ** 2).sum(axis=-1) + cells[:, 4]
        return best[np.argmax((np.maximum(1 - square / self.radius**2, 0) * cells[:, 3]).sum(axis=1))]


SIZE_LIMITS = {"width": 4096, "geometry": 4096, "hidden": 64, "layers": 64, "sh_degree": 10, "prior": 4096}
"""The largest whole numbers of an architecture, by name; beyond them no field is trained and no kernel compiles."""

# ---- What every gaze field answers, whatever it is made of ----
#
# A gaze field is a density over the directions around an observer (1/sr): a product of two factors (``product``), a
# normalised log density (``log_density``), or any other `GazeHead` that is registered; or the mean of several of these
# (``ensemble``). Nothing outside of this package asks which of them it has.
#
# Positions and directions are Dr.Jit 3-arrays of the field's backend, in the field's own frame and units; directions
# are unit vectors, and ``r_o`` points from the observer to the surface. Densities do not change with scale.

MAX_WEIGHT = 1e6  # No stored weight is larger; products of a network's layers then stay in single precision


class Arrays(Protocol):
    """The arrays of a checkpoint, as a field's ``from_arrays`` asks for them. Every method raises ``ValueError`` for an
    array that is not finite or does not have the shape, ``KeyError`` for one that is missing."""

    ns: ModuleType

    def array(self, name: str, *shape: int | None, max_value: float = MAX_WEIGHT) -> np.ndarray:
        """The float32 array ``name`` of that ``shape`` (None: of any length), with no value beyond ``largest``."""
        ...

    def grid(self, config: EncodingConfig, name: str = "grid") -> Encoding:
        """The encoding of ``config``."""
        ...

    def net(self, name: str, sizes: list[int], normalized: bool = False) -> MLP:
        """The network whose layers have these ``sizes``; ``normalized``: with the gains and shifts of LayerNorm."""
        ...

    def member(self, index: int, architecture: dict) -> tuple[dict, Arrays]:
        """The checked architecture and the arrays of the member ``index`` of an ensemble."""
        ...


class AnyGazeField:
    """Base of gaze fields on one backend: of one density (`GazeHead`), and of the mean of several (`GazeEnsemble`).

    ``config``: sizes and conventions; ``box``: where the field lives, positions outside of it are the encoding's to
    deal with; ``ns``: array types of the backend (``fields.mlp.namespace``); ``members``: the densities whose mean it
    is; ``networks``: how many one evaluation of gaze evaluates; ``mlps``: the networks of all members.
    """

    kind: ClassVar[str]  # The name under which a checkpoint knows the class
    # The largest whole numbers that a checkpoint may claim for its sizes, by name.
    max_sizes: ClassVar[Mapping[str, int]] = SIZE_LIMITS
    fixed: ClassVar[tuple[str, ...]] = ()  # Parameters that no training changes

    config: Any
    box: AnyBox
    support: RaySupport | None = None  # How many rays it learnt from around a position, where that is known
    basis: DataSummary | None = None  # How many rays and people it learnt from in all, where that is known

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
    def from_arrays(cls, about: dict, box: AnyBox, arrays: Arrays) -> AnyGazeField:
        """The field of ``architecture() == about`` with the ``arrays`` of a checkpoint."""
        raise NotImplementedError

    def parameters(self) -> dict:
        """Arrays that gaze depends on, by the names that checkpoints and ``mi.traverse`` give them."""
        raise NotImplementedError

    def set_parameters(self, values: dict) -> None:
        """Replace arrays by name (any subset of ``parameters()``) and `pack`."""
        raise NotImplementedError

    def pack(self) -> None:
        """Refresh what the kernels read; call after any change of the weights."""
        raise NotImplementedError


class GazeHeadConfig:
    """Base of the configuration of a gaze field that is one density: a frozen dataclass that a checkpoint keeps as
    JSON. The defaults are those of a density that is normalised over the sphere, of both factors."""

    kind: ClassVar[str]  # The name under which a checkpoint knows the field's class
    grid: Any  # The encoding of positions
    variant: Any = "emit_capture"  # emit, capture or emit_capture: which of the two factors there are
    activation: Any = "log"  # What the network's output goes through to become a density; for people, not for code
    # Whether ``evaluate`` divides by the integral over the observer's sphere, which it then must be given.
    normalized: Any = True
    semantic: Any = ""  # Which features of a radiance field emit takes: accumulated, snapshot or none ("")
    prior: Any = 0  # Rows of the table of the density that does not depend on the position; 0 for a field that has none
    mix: Any = 0.0  # The share of that density

    @property
    def features(self) -> int:
        """How many features of a radiance field emit is given."""
        return 0

    @property
    def needs_surfaces(self) -> bool:
        """Whether it matters where the observer's rays meet a surface."""
        return True

    @property
    def fills_escaped(self) -> bool:
        """Whether a direction in which no surface is met takes the depth of the nearest ones that do; otherwise it ends
        on the field's box."""
        return False

    def conventions(self) -> tuple:
        """What fields must have in common for their densities to be averaged."""
        return self.kind, self.variant

    def to_dict(self) -> dict:
        """As JSON."""
        return {"kind": self.kind, **asdict(self), "grid": self.grid.to_dict()}  # pyright: ignore[reportArgumentType]

    @classmethod
    def from_dict(cls, d: dict) -> Self:
        """The configuration of which `to_dict` was kept."""
        return cls(**{**{k: v for k, v in d.items() if k != "kind"}, "grid": encoding_config(d["grid"])})


def require_words(config: GazeHeadConfig, **words: tuple[str, ...]) -> None:
    """Raise ``ValueError`` unless each entry of ``config`` that is named is one of its ``words``."""
    for name, allowed in words.items():
        if getattr(config, name) not in allowed:
            raise ValueError(
                f'"{name}" of a gaze field must be one of {", ".join(filter(None, allowed))}, '
                f'got "{getattr(config, name)}"'
            )


class GazeHead(AnyGazeField):
    """Base of a gaze field that is one density: an encoding ``grid``, bare ``ARRAYS`` and networks ``NETS``, attributes
    of these names. A kind says how it is made and what its ``unnormalized`` density is."""

    ARRAYS: ClassVar[tuple[str, ...]] = ()
    NETS: ClassVar[tuple[str, ...]] = ()
    DRJIT_STRUCT: ClassVar[dict]

    grid: Any
    prior: Any  # Log of the density that does not depend on the position, of fields whose configuration has a ``prior``

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
        assign(self, {k: v for k, v in values.items() if k not in self.ARRAYS})
        self.pack()

    def pack(self) -> None:
        for name in ("grid", *self.NETS):
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
        """``(emit, capture)``, whose product a normalised field divides by its integral. A variant that lacks a factor
        has 1 in its place and does not evaluate it.

        ``semantic``: ``config.features`` Floats where the configuration asks for them, else None; ``escaped``: mask of
        directions in which no surface is met. Differentiable in the parameters, positions and directions.
        """
        raise NotImplementedError(f"{type(self).__name__} does not say what its density is")

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
        """``(gaze, emit, capture)`` in 1/sr of the observer at ``p_o`` attending ``p_od`` along unit ``r_o``;
        ``active``, ``semantic`` and ``escaped`` as for ``unnormalized``.

        ``integral``: of a normalised field over the sphere at ``p_o`` (``transport.observer_gaze``), by which ``emit``
        is divided; ``ValueError`` without it. With a share m of the density that does not depend on the position, gaze
        = (1 - m) emit * capture + m blind.
        """
        if self.config.normalized and integral is None:
            raise ValueError(
                "this gaze field is normalised over the observer's sphere: evaluating it needs its integral there"
            )
        emit, capture = self.unnormalized(p_od, p_o, r_o, active, semantic, escaped)
        if integral is not None and self.config.normalized:
            emit = emit / integral
        gaze = emit * capture
        if self.config.mix:
            gaze = (1 - self.config.mix) * gaze + self.config.mix * dr.exp(self.log_prior(r_o))
        return gaze, emit, capture

    def log_prior(self, r_o: Vector3f) -> Float:
        """Log of the blind density (1/sr) in direction ``r_o``, interpolated in its table, the array ``prior``."""
        return interpolate_table(self.prior.array, self.config.prior, r_o)

    def set_prior_weight(self, mix: float) -> None:
        """Let the share of the blind density be ``mix``."""
        self.config = replace(self.config, mix=mix)


# ---- The kinds of gaze fields by the names that checkpoints give them ----

Kind = TypeVar("Kind", bound=type[AnyGazeField])

_KINDS: dict[str, type[AnyGazeField]] = {}


def register(cls: Kind) -> Kind:
    """Have checkpoints of the kind ``cls.kind`` read by the class ``cls`` (a decorator)."""
    _KINDS[cls.kind] = cls
    return cls


def kinds() -> tuple[str, ...]:
    """The names that are registered."""
    return tuple(_KINDS)


def build_gaze_field(about: dict, box: AnyBox, arrays: Arrays) -> AnyGazeField:
    """The gaze field that a checkpoint describes by ``about``, of its ``arrays``. Raises ``ValueError`` for a kind that
    is not registered."""
    # Checkpoints of the first version name no kind: there was one.
    kind = about.get("kind", "product")
    if kind not in _KINDS:
        raise ValueError(f'it is a gaze field of the kind "{sanitize(kind, 40)}", which this version does not know')
    return _KINDS[kind].from_arrays(about, box, arrays)


def max_sizes_of(about: object) -> Mapping[str, int]:
    """The largest sizes that a checkpoint may claim for the gaze field that it describes by ``about``; none for a kind
    that is not registered, of which nothing is built."""
    kind = about.get("kind", "product") if isinstance(about, dict) else None
    return _KINDS[kind].max_sizes if isinstance(kind, str) and kind in _KINDS else {}


# ---- What people look at wherever they stand, the blind density, as a latitude-longitude table of its logarithm ----

_FLOOR = 1e-3  # Of the blind density that is uniform, so that its logarithm is finite


def interpolate_table(table, rows: int, d):
    """Bilinear value of a flat latitude-longitude ``table`` (rows x 2 rows, texel centres, +z first) along ``d``."""
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
    """Directions (2 rows², 3) of the texels that ``look_up`` interpolates."""
    theta, phi = np.meshgrid(
        (np.arange(rows) + 0.5) * np.pi / rows, (np.arange(2 * rows) + 0.5) * np.pi / rows, indexing="ij"
    )
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)


def make_prior_table(density: np.ndarray, rows: int, ns: ModuleType, directions: np.ndarray) -> np.ndarray:
    """Log table (rows, 2 rows) of a blind density given at ``table_directions(rows)``, 1/sr.

    A thousandth of it is uniform. Scaled so that what ``look_up`` makes of it integrates to one over ``directions`` (N,
    3), a fine set of equal area.
    """
    density = np.asarray(density, np.float64)
    log = np.log((1 - _FLOOR) * density + _FLOOR / (4 * np.pi))
    d = to_vector(ns.Array3f, directions)
    found = np.asarray(dr.exp(interpolate_table(ns.Float(log.astype(np.float32)), rows, d)), np.float64)
    return (log - np.log(4 * np.pi * found.mean())).reshape(rows, 2 * rows).astype(np.float32)


# ---- Ensembles ----
#
# Several gaze fields for one: their mean is the gaze, their spread says how far the data decides it. Members are
# trained alike on resamples of the people (bagging, Breiman 1996; deep ensembles, Lakshminarayanan et al. 2017).


@register
class GazeEnsemble(AnyGazeField):
    """``members``: two or more fields of one kind, variant and box. Raises ``ValueError`` where they differ in these.

    ``config`` and ``box`` are those of the first member; ``support``: of the rays that all members' were drawn from.
    """

    DRJIT_STRUCT: ClassVar[dict] = {"_members": None}
    kind: ClassVar[str] = "ensemble"

    def __init__(self, members: Sequence[GazeHead], support: RaySupport | None = None):
        self._members, self.support = list(members), support
        if len(self.members) < 2:
            raise ValueError(f"an ensemble of gaze fields needs at least two members, got {len(self.members)}")
        if any(len(m.members) > 1 for m in self.members):
            raise ValueError("a member of an ensemble of gaze fields is an ensemble itself; give its members instead")
        if any(_common(m) != _common(self.members[0]) for m in self.members):
            raise ValueError(
                "the members of an ensemble of gaze fields differ in kind, variant, output or box; train them alike"
            )
        self.config, self.box = self.members[0].config, self.members[0].box

    @property
    def members(self) -> Sequence[GazeHead]:
        return self._members

    @classmethod
    def from_arrays(cls, about: dict, box: AnyBox, arrays: Arrays) -> GazeEnsemble:
        members = [arrays.get_member(i, member) for i, member in enumerate(about["members"])]
        # Before any is built: a file may hold them one inside of another, without end.
        if any("members" in member for member, _ in members):
            raise ValueError("a member of its ensemble is an ensemble itself, which this version does not read")
        return cls([density for member, own in members for density in build_gaze_field(member, box, own).members])

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


def mean(found: list[tuple]) -> tuple:
    """Means of the ``(gaze, emit, capture)`` of one or more members; that of gaze is not the product of the others."""
    if len(found) == 1:
        return found[0]
    return tuple(sum(parts[1:], parts[0]) / len(found) for parts in zip(*found))


def spread(found: list[tuple]) -> Float:
    """Standard deviation of gaze over the ``(gaze, emit, capture)`` of two or more members (1/sr, N - 1 degrees of
    freedom)."""
    gaze = mean(found)[0]
    variance: Any = sum(dr.square(g - gaze) for g, _, _ in found) / (len(found) - 1)
    # Where members agree, the root's derivative would not be finite.
    apart = variance > 1e-30
    return dr.select(apart, dr.sqrt(dr.select(apart, variance, 1)), 0)


def _common(field: GazeHead) -> tuple:
    return field.config.conventions(), tuple(field.box.lower), tuple(field.box.upper)
