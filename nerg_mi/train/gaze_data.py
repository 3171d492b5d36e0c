"""Training data of a gaze field: gaze rays and salience views, their targets and batches."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.environment.environment import DEFAULT_DEPTH, Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeHeadConfig, RaySupport
from nerg_mi.maths.arrays import copy_aligned, to_vector
from nerg_mi.maths.geometry import AnyBox, intersect_box_numpy
from nerg_mi.maths.sphere import fibonacci_directions, sort_directions
from nerg_mi.maths.types import variant_types
from nerg_mi.photos.salience import SalienceView
from nerg_mi.tracking.event_settings import read_fixations
from nerg_mi.tracking.probes import Probes, place_probes
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.field_medium import FieldMedium, features_for_observer
from nerg_mi.transport.geometry import SURFACE_OPACITY, SceneGeometry, default_march_settings, trace_depth
from nerg_mi.transport.observer_gaze import interpolate_nearest_depth

from .gaze_settings import MIN_MEAN_DENSITY, ProbeSettings
from .prior import make_prior_from_rays, make_prior_from_views


def compute_observer_bounds(positions: np.ndarray, box: AnyBox) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the corners of the bounding box of observer ``positions`` (N, 3).

    Each side is at least a thousandth of the side of ``box``.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    return tuple(low.tolist()), tuple(np.maximum(high, low + 1e-3 * box.side).tolist())


# ---- Semantic features ----
#
# Features of a radiance field along the observers' rays, for the semantic variants of the paper.

FEATURE_BATCH = 1 << 18  # Rays per kernel launch


def compute_semantic_features(
    geometry: Environment, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray, kind: str
) -> np.ndarray:
    """Evaluate the features of a radiance field along rays.

    Parameters
    ----------
    geometry : Environment
        Training geometry; must be a radiance field.
    origins, directions : numpy.ndarray
        Ray origins and unit directions (N, 3) in the frame of ``geometry``.
    distance : numpy.ndarray
        Distances (N,) to the surface points, used by ``"snapshot"``.
    kind : str
        ``"accumulated"`` composites the features along each ray; ``"snapshot"`` evaluates them at ``distance``.

    Returns
    -------
    numpy.ndarray
        Features (N, F), float16.

    Raises
    ------
    NergError
        If the geometry is not a radiance field.
    """
    mi = variant_types()
    medium = geometry.medium
    if not isinstance(medium, FieldMedium):
        raise NergError(f"semantic features need a radiance field; pass one with {parameter('environment')}")
    out = np.empty((len(origins), medium.feature_count), np.float16)
    scene, march = SceneGeometry(medium), default_march_settings(medium)
    with dr.suspend_grad():
        for a in range(0, len(out), FEATURE_BATCH):
            part = slice(a, a + FEATURE_BATCH)
            o, d = to_vector(mi.Point3f, origins[part]), to_vector(mi.Vector3f, directions[part])
            p = o + d * mi.Float(copy_aligned(distance[part]))
            features = features_for_observer(kind, scene, p, o, d, mi.Bool(True), march) or []
            # Evaluate all features in one kernel; separate evaluations would repeat the march or the network.
            dr.eval(features)
            out[part] = np.stack([np.array(f) for f in features], axis=-1)
    return out


# ---- Supervision: gaze rays, salience views, or both ----


@dataclass(frozen=True, eq=False)
class Supervision:
    """Gaze rays and salience views to train on. One of the two may be missing."""

    rays: Rays | None = None  # Gaze rays in their own frame, in metres; None: train on views only
    views: tuple[SalienceView, ...] = ()  # Salience views in the frame of the gaze field

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views))
        if self.rays is None and not self.views:
            raise ValueError("the supervision of a gaze field must have rays or views; it has neither")

    def compute_digest(self) -> dict[str, str | None]:
        """Return the SHA-256 of the data that a training reads from ``rays`` and ``views`` (JSON). A missing source is
        None.
        """
        views = [a for v in self.views for a in (v.camera.to_world, v.gaze_fraction, v.solid_angle)]
        return {
            "rays": None if self.rays is None else digest_rays(self.rays),
            "views": _hash_arrays(views) if views else None,
        }

    def summarize_data(self) -> dict[str, Any]:
        """Return the numbers of ``rays``, participants (``people``) and salience views, and the ``tracking`` and the
        definition of the ``fixations`` of the rays (JSON)."""
        views = {"salience_views": len(self.views)}
        if self.rays is None:
            return {"rays": 0, "people": 0, **views}
        num_participants = len(np.unique(self.rays.person))
        counts = {"rays": len(self.rays), "people": num_participants, **views}
        return {**counts, "tracking": self.rays.tracking, **read_fixations(self.rays.metadata)}

    def make_support(self, radius: float, geometry: Environment) -> RaySupport | None:
        """Return the local ray count as a function of position in the frame of ``geometry``, for probes of ``radius``
        metres.

        Returns None without rays.
        """
        if self.rays is None:
            return None
        return RaySupport.from_origins(geometry.points_to_field(self.rays.origin), radius * geometry.align.scale)


def digest_rays(rays: Rays) -> str:
    """Return the SHA-256 of the data that a training reads from ``rays``."""
    return _hash_arrays([rays.person, rays.origin, rays.direction])


def _hash_arrays(arrays: list[np.ndarray]) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


# ---- Surface distances along observer rays ----


def compute_surface_distances(
    geometry: Environment,
    positions: np.ndarray,
    directions: np.ndarray,
    depth: str = "median",
    fill_misses: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Trace the distance to the first surface along rays from observer positions.

    Parameters
    ----------
    geometry : Environment
        Training geometry. Without any surfaces, each distance is ``DEFAULT_DEPTH`` and no ray counts as a miss.
    positions : numpy.ndarray
        Observer positions (P, 3), in the frame and units of ``geometry``.
    directions : numpy.ndarray
        Unit directions (P, D, 3).
    depth : str
        Depth estimator (``transport.depth``).
    fill_misses : bool
        If True, a miss takes the depth of the nearest directions of its observer that hit a surface. Use this if the
        geometry has holes.

    Returns
    -------
    distance : numpy.ndarray
        Distances (P, D), float32. A miss ends where its ray leaves the box of the geometry, or after the box's diagonal
        if the ray never enters it, because the field still needs a point at which to be evaluated.
    misses : numpy.ndarray
        Mask (P, D) of the rays that hit no surface.
    """
    P, D = directions.shape[:2]
    if geometry.medium is None or not P:
        return np.full((P, D), DEFAULT_DEPTH, np.float32), np.zeros((P, D), bool)
    # Rays that are traced together should traverse similar parts of the scene. The directions of the observers are
    # mostly rotated copies of one set, which have one order.
    order = sort_directions(directions[0])
    traced = trace_depth(
        geometry.medium,
        np.repeat(np.asarray(positions, np.float32), D, axis=0),
        np.asarray(directions, np.float32)[:, order].reshape(-1, 3),
        kind=depth,
    )
    distance, opacity = np.empty((2, P, D), np.float32)
    distance[:, order], opacity[:, order] = (values.reshape(P, D) for values in traced)
    misses = opacity < SURFACE_OPACITY
    origins = np.asarray(positions, np.float64)[np.nonzero(misses)[0]]
    distance[misses] = compute_box_exit(geometry.box, origins, np.asarray(directions, np.float64)[misses])
    if fill_misses:
        for p in np.flatnonzero(misses.any(axis=1) & ~misses.all(axis=1)):
            is_hit = ~misses[p]
            distance[p, misses[p]] = interpolate_nearest_depth(
                directions[p, is_hit], distance[p, is_hit], directions[p, misses[p]]
            )
    return distance, misses


def find_hit_points(rays: Rays, geometry: Environment, depth: str = "median") -> np.ndarray | None:
    """Find the points that ``rays`` hit: the recorded ones, otherwise those on the surfaces of ``geometry``.

    Returns points (N, 3) in metres in the frame of the rays, NaN for a ray without one; None if no surface is known.
    ``depth`` is a depth estimator (``transport.depth``).
    """
    if rays.hit is not None and np.isfinite(rays.hit).any():
        return rays.hit
    if geometry.medium is None:
        return None
    origins, directions = geometry.points_to_field(rays.origin), geometry.directions_to_field(rays.direction)
    distance, misses = compute_surface_distances(geometry, origins, directions[:, None], depth)
    distance[misses] = np.nan
    return rays.origin + rays.direction * (distance / geometry.align.scale)


def compute_box_exit(box: AnyBox, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distance (N,) at which each ray leaves ``box``; the box's diagonal for rays that never enter it."""
    near, far = intersect_box_numpy(origins, directions, box.lower, box.upper)
    return np.where((far > 0) & (near <= far) & np.isfinite(far), far, box.diagonal)


# ---- Targets ----
#
# Targets of a gaze field: observers, directions around each of them, the true densities in these directions, and the
# surfaces that the directions hit.
#
# Rays become targets through probes (``make_targets_from_rays``), views directly (``make_targets_from_views``). The
# geometry is fixed during gaze training and each observer keeps its directions, so all depths are traced once, before
# training.


@dataclass(frozen=True)
class TargetRequirements:
    """Data that a kind of gaze field needs in addition to directions, densities and distances."""

    semantic: str = ""  # Kind of radiance-field features (`fields.gaze_product.SEMANTICS`); "": none
    fill_misses: bool = False  # Whether a miss takes the depth of neighbouring directions instead of ending on the box
    prior_rows: int = 0  # Rows of the table of the position-independent prior; 0: the field has no prior

    @staticmethod
    def from_config(config: GazeHeadConfig) -> TargetRequirements:
        """Return the requirements of a field with configuration ``config``."""
        return TargetRequirements(config.semantic, config.fills_escaped, config.prior)


@dataclass(frozen=True, eq=False)
class GazeTargets:
    """Training targets of P observers with D directions each.

    The directions of an observer represent equal solid angles. All values are float32, in the frame and units of the
    field.
    """

    positions: np.ndarray  # Observer positions p_o (P, 3)
    directions: np.ndarray  # Unit directions r_o (P, D, 3)
    truth: np.ndarray  # True densities (P, D), 1/sr
    distance: np.ndarray  # Distances (P, D) from p_o to the surface points p_od
    misses: np.ndarray  # Mask (P, D) of directions that hit no surface
    # Features (P, D, F) of a radiance field, float16; None if the field uses none.
    semantic: np.ndarray | None = None
    # Table of the log of the position-independent prior (`fields.gaze_base.make_prior_table`).
    prior_table: np.ndarray | None = None
    # Returns targets of the same observers in new directions for a given epoch, if each epoch has its own directions.
    resample: Callable[[int], GazeTargets] | None = None
    # Corners of the observer bounds that capture's encoding spans; None: the bounds of the positions.
    observer_bounds: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # Solid angle (P,) in sr that the D directions cover and over which the truth integrates to one; None: 4π.
    solid_angle: np.ndarray | None = None

    @property
    def miss_fraction(self) -> float:
        """Fraction of the directions that hit no surface."""
        return float(self.misses.mean())

    @property
    def miss_gaze_fraction(self) -> float:
        """Fraction of the true gaze in directions that hit no surface."""
        gaze = self.truth if self.solid_angle is None else self.truth * self.solid_angle[:, None]
        return float((gaze * self.misses).sum() / gaze.sum())


def make_observer_targets(
    positions: np.ndarray,
    directions: np.ndarray,
    truth: np.ndarray,
    geometry: Environment,
    depth: str = "median",
    requirements: TargetRequirements | None = None,
) -> GazeTargets:
    """Make targets of observers with known gaze densities.

    Parameters
    ----------
    positions : numpy.ndarray
        Observer positions (P, 3) in the frame of ``geometry``.
    directions : numpy.ndarray
        Unit directions (P, D, 3).
    truth : numpy.ndarray
        Densities (P, D) in 1/sr.
    geometry : Environment
        Geometry in which the surface distances are traced.
    depth : str
        Depth estimator (``transport.depth``).
    requirements : TargetRequirements, optional
        Additional data that the field needs.

    Raises
    ------
    NergError
        If ``requirements`` asks for features and the geometry is not a radiance field.
    """
    requirements = requirements or TargetRequirements()
    distance, misses = compute_surface_distances(geometry, positions, directions, depth, requirements.fill_misses)
    features = None
    if requirements.semantic:
        origins = np.repeat(positions, directions.shape[1], axis=0)
        features = compute_semantic_features(
            geometry, origins, directions.reshape(-1, 3), distance.ravel(), requirements.semantic
        )
        features = features.reshape(*directions.shape[:2], -1)
    to_float32 = lambda v: v.astype(np.float32, copy=False)
    return GazeTargets(to_float32(positions), to_float32(directions), to_float32(truth), distance, misses, features)


def concatenate_targets(a: GazeTargets, b: GazeTargets) -> GazeTargets:
    """Concatenate the observers of two targets with the same number of directions. The prior table is that of ``a``."""
    rows = lambda name: np.concatenate([getattr(a, name), getattr(b, name)])
    out: dict[str, Any] = {k: rows(k) for k in ("positions", "directions", "truth", "distance", "misses")}
    solid_angle = [
        np.full(len(t.truth), 4 * np.pi, np.float32) if t.solid_angle is None else t.solid_angle for t in (a, b)
    ]
    semantic = None if a.semantic is None else rows("semantic")
    resample, resample_a, resample_b = None, a.resample, b.resample
    if resample_a is not None and resample_b is not None:
        resample = lambda epoch: concatenate_targets(resample_a(epoch), resample_b(epoch))
    return GazeTargets(
        **out, semantic=semantic, prior_table=a.prior_table, resample=resample, solid_angle=np.concatenate(solid_angle)
    )


# ---- Targets as Dr.Jit arrays, and batches gathered from them ----

_FULL_SPHERE = 1 - 1e-6  # Solid angles below this fraction of 4π belong to a view


@dataclass(frozen=True)
class GazeBatch:
    """B observers with D directions each, flattened: value b * D + d is observer b in direction d."""

    p_o: Any  # Observers (Array3f, B lanes)
    r_o: Any  # Directions (Array3f, B * D lanes), unit
    p_od: Any  # Surface points (Array3f, B * D lanes)
    truth: Any  # True densities (Float, B * D lanes), 1/sr
    misses: Any  # Directions that hit no surface (Bool, B * D lanes)
    solid_angle: Any  # Solid angle in sr (Float, B lanes) that the directions of an observer cover
    semantic: list | None = None  # Features of a radiance field (F Floats, B * D lanes); None if there are none
    has_views: bool = False  # Whether some observers are views, whose gaze is known only within a frustum

    def integrate(self, density: Any) -> Any:
        """Integrate ``density`` (Float, B * D lanes, 1/sr) over the solid angle of each observer; returns Float, B
        lanes.
        """
        directions = dr.width(density) // dr.width(self.solid_angle)
        return dr.block_sum(density, directions) * (self.solid_angle / directions)

    def condition_on_view(self, density: Any, truth: Any = None) -> Any:
        """Condition the densities of view observers on their view. Densities of other observers are unchanged.

        Gaze outside the view is unknown, so the density is scaled to the integral that ``truth`` has in the same
        directions, or to one without ``truth``.
        """
        if not self.has_views:
            return density
        inside = self.integrate(dr.maximum(density, 0))
        # A density of zeros cannot be normalised.
        is_view = (self.solid_angle < 4 * np.pi * _FULL_SPHERE) & (inside > MIN_MEAN_DENSITY)
        target = 1 if truth is None else self.integrate(truth)
        factor = dr.select(is_view, target / dr.select(is_view, inside, 1), 1)
        return density * dr.repeat(factor, dr.width(density) // dr.width(self.solid_angle))


class TargetArrays:
    """Targets as arrays of the Dr.Jit backend ``ns``.

    Attributes
    ----------
    num_observers, num_directions : int
        Number of observers, and of directions per observer.

    Raises
    ------
    NergError
        If there are no observers.
    """

    def __init__(self, targets: GazeTargets, ns: ModuleType):
        self.ns, self.num_observers, self.num_directions = ns, *targets.truth.shape
        if self.num_observers == 0:
            raise NergError(f"there are no probes to train on; use more rays or a larger {parameter('radius')}")
        flat = lambda v: ns.Float(np.ascontiguousarray(v, np.float32).ravel())
        self._solid_angle = None if targets.solid_angle is None else np.asarray(targets.solid_angle, np.float32)
        self._positions, self._r_o = flat(targets.positions), flat(targets.directions)
        self._truth, self._distance = flat(targets.truth), flat(targets.distance)
        self._misses = ns.Bool(np.ascontiguousarray(targets.misses).ravel())
        self._features = 0 if targets.semantic is None else targets.semantic.shape[-1]
        if self._features:
            self._semantic = ns.Float16(np.ascontiguousarray(targets.semantic).ravel())

    def gather_batch(self, observers: np.ndarray, directions: np.ndarray) -> GazeBatch:
        """Gather a batch of ``observers`` (B,) in ``directions`` (B, D), which are indices into each observer's
        directions.
        """
        ns = self.ns
        at = ns.UInt32(copy_aligned(observers, np.uint32))
        index = ns.UInt32(copy_aligned((observers[:, None] * self.num_directions + directions).ravel(), np.uint32))
        p_o, r_o = dr.gather(ns.Array3f, self._positions, at), dr.gather(ns.Array3f, self._r_o, index)
        p_od = dr.gather(ns.Array3f, self._positions, index // self.num_directions) + r_o * dr.gather(
            ns.Float, self._distance, index
        )
        semantic = None
        if self._features:
            F = self._features
            semantic = [ns.Float(dr.gather(ns.Float16, self._semantic, index * F + k)) for k in range(F)]
        solid_angle = np.full(len(observers), 4 * np.pi) if self._solid_angle is None else self._solid_angle[observers]
        return GazeBatch(
            p_o,
            r_o,
            p_od,
            dr.gather(ns.Float, self._truth, index),
            dr.gather(ns.Bool, self._misses, index),
            ns.Float(copy_aligned(solid_angle)),
            semantic,
            self._solid_angle is not None,
        )


# ---- Targets from gaze rays ----
#
# The directions of each probe are of equal area and have their own random rotation, so that all probes together sample
# the sphere more densely than one set of directions.


def make_probes(rays: Rays, settings: ProbeSettings, queries: np.ndarray | None = None, seed: int = 0) -> Probes:
    """Make probes from ``rays``: at ``queries`` (P, 3) in metres if given, otherwise where ``settings`` places them.

    Raises `NergError` if no probe holds enough rays.
    """
    return place_probes(
        rays,
        settings.radius,
        placement=settings.placement,
        count=settings.probes,
        spacing=settings.spacing,
        queries=queries,
        max_rays=settings.max_rays,
        min_rays=min(settings.min_rays, settings.max_rays),
        kappa_rule=settings.kappa_rule,
        kappa=settings.kappa,
        weights=settings.ray_weights,
        seed=seed,
    )


def make_targets_from_probes(
    probes: Probes,
    geometry: Environment,
    directions: int,
    depth: str = "median",
    requirements: TargetRequirements | None = None,
    seed: int | tuple[int, ...] = 0,
) -> GazeTargets:
    """Make targets of ``probes`` with ``directions`` randomly rotated directions each.

    ``depth`` is the depth estimator, ``seed`` the seed of the rotations. Raises `NergError` if the kernels are too
    narrow for the number of directions.
    """
    rotated = make_rotated_directions(directions, len(probes), np.random.default_rng(seed))
    truth = probes.density(rotated)
    if not truth.any():
        raise NergError(
            f"{directions:,} directions do not resolve the kernels of the rays; use a recipe with a smaller kappa or "
            f"more {parameter('directions')}"
        )
    return make_observer_targets(
        geometry.points_to_field(probes.positions),
        geometry.directions_to_field(rotated),
        truth,
        geometry,
        depth,
        requirements,
    )


def make_targets_from_rays(
    rays: Rays,
    geometry: Environment,
    settings: ProbeSettings,
    requirements: TargetRequirements | None = None,
    queries: np.ndarray | None = None,
    seed: int = 0,
) -> GazeTargets:
    """Make targets of the probes on ``rays``, at ``queries`` (P, 3) in metres if given.

    With ``settings.resample_directions`` the targets can ``resample`` their directions. Raises `NergError` if no
    probe holds enough rays.
    """
    requirements = requirements or TargetRequirements()
    probes = make_probes(rays, settings, queries, seed)
    make_with_seed = lambda seed: make_targets_from_probes(
        probes, geometry, settings.directions, settings.depth, requirements, seed
    )
    targets = make_with_seed(seed)
    if settings.resample_directions:
        targets = replace(targets, resample=lambda epoch: make_with_seed((seed, epoch)))
    if requirements.prior_rows:
        prior_table = make_prior_from_rays(
            rays, requirements.prior_rows, geometry, seed, settings.ray_weights, settings.prior_kappa
        )
        targets = replace(targets, prior_table=prior_table)
    return targets


def make_rotated_directions(count: int, sets: int, rng: np.random.Generator) -> np.ndarray:
    """Return ``sets`` Fibonacci sets of ``count`` unit directions, each with a uniform random rotation (sets, count,
    3).
    """
    # Normalised Gaussian quaternions are uniform rotations (Shoemake 1992). The first number is the real part.
    rotation = Rotation.from_quat(np.roll(rng.normal(size=(sets, 4)), -1, axis=1)).as_matrix()
    return fibonacci_directions(count) @ rotation.transpose(0, 2, 1)


# ---- Targets from salience views ----
#
# Each view is an observer at the camera centre whose gaze is known only within the view frustum.
#
# The directions of a view cover its frustum with equal areas, and the truth is the density conditioned on looking into
# the picture. The field is conditioned in the same way: it is normalised over the view, not over the sphere. How much
# gaze falls outside a picture follows from the overlap of the views.

_DIRECTIONS_PER_PIXEL = 4  # Directions per pixel of a view, so that hardly any pixel is left out


def make_targets_from_views(
    views: Sequence[SalienceView],
    geometry: Environment,
    settings: ProbeSettings,
    requirements: TargetRequirements | None = None,
    seed: int = 0,
) -> GazeTargets:
    """Make targets of ``views`` in the frame of ``geometry``.

    Each view has ``settings.directions`` directions, each with the density of its pixel. The views are reduced until
    each pixel has about four directions. With ``settings.resample_directions`` the targets can ``resample`` their
    directions.
    """
    requirements, count = requirements or TargetRequirements(), settings.directions
    reduced_views = [v.reduce(max(1, count // _DIRECTIONS_PER_PIXEL)) for v in views]

    def make_with_seed(seed: int | tuple[int, int]) -> GazeTargets:
        rng = np.random.default_rng(seed)
        directions, truth = np.empty((len(views), count, 3)), np.empty((len(views), count))
        for k, view in enumerate(reduced_views):
            directions[k], pixels = view.sample(count, rng)
            truth[k] = view.density.ravel()[pixels]
        solid_angle = np.array([v.total_solid_angle for v in views])
        truth /= truth.mean(axis=1, keepdims=True) * solid_angle[:, None]
        positions = np.array([v.camera.center for v in views])
        targets = make_observer_targets(positions, directions, truth, geometry, settings.depth, requirements)
        return replace(targets, solid_angle=solid_angle.astype(np.float32))

    targets = make_with_seed(seed)
    if settings.resample_directions:
        targets = replace(targets, resample=lambda epoch: make_with_seed((seed, epoch)))
    return (
        replace(targets, prior_table=make_prior_from_views(views, requirements.prior_rows))
        if requirements.prior_rows
        else targets
    )
