"""Training data of a gaze field: targets from gaze rays and salience views, batches, splits and the prior table."""

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
from nerg_mi.fields.gaze_base import GazeHeadConfig, RaySupport, add_prior_floor, make_prior_table, table_directions
from nerg_mi.fields.kde import SphericalKde
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import AnyBox, intersect_box_numpy
from nerg_mi.maths.sphere import fibonacci_directions, sort_directions
from nerg_mi.maths.types import variant_types
from nerg_mi.photos.salience import SalienceView
from nerg_mi.probes.probes import Probes, compute_participant_weights, place_probes
from nerg_mi.rays.filters import purge, split_by_person, split_by_position
from nerg_mi.rays.rays import Rays
from nerg_mi.transport.field_medium import FieldMedium, accumulate_features, evaluate_features
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings, trace_depth
from nerg_mi.transport.observer_gaze import interpolate_nearest_depth

from .gaze_settings import MIN_MEAN_DENSITY, GazeSettings, ProbeSettings

# ---- Position-independent prior: the gaze density averaged over all positions ----

DEFAULT_PRIOR_KAPPA = 30.0  # Concentration of its kernels
PRIOR_KAPPAS = (2.0, 5.0, 10.0, 20.0, 30.0, 50.0, 100.0)
"""Candidate concentrations of the prior's kernels."""
# Maximum numbers of rays in a prior, and of a participant's rays that it predicts, while its kernels are selected
_MAX_SELECTION_RAYS, _MAX_PARTICIPANT_RAYS = 1 << 14, 512
_MAX_PRIOR_RAYS = 1 << 16  # Maximum number of rays in the prior
_VIEWS_KAPPA = 50.0  # Concentration of the kernels that smooth a prior estimated from views
_LEAF_SIZE = 16  # Points per leaf of a KD-tree. The value decides ties between equally distant directions.
_ITERATIONS = 100  # Iterations of the estimate from views
_QUADRATURE_DIRECTIONS = 1 << 16  # Directions of the quadrature that normalises the table


def check_prior_kappa(rows: int, kappa: float | None) -> None:
    """Raise `NergError` if kernels of concentration ``kappa`` are narrower than half a texel of a table of ``rows``
    rows.
    """
    if kappa is not None and kappa > (max_kappa := (2 * rows / np.pi) ** 2):
        raise NergError(
            f"the position-independent prior is stored in a table of {rows} rows, which does not resolve kernels of "
            f"concentration {kappa:g}; use a concentration of at most {max_kappa:.0f}"
        )


def make_prior_from_rays(
    rays: Rays,
    rows: int,
    geometry: Environment | None = None,
    seed: int = 0,
    weights: str = "equal",
    kappa: float | None = None,
) -> np.ndarray:
    """Estimate the position-independent prior from gaze rays by kernel density estimation.

    Parameters
    ----------
    rays : Rays
        Gaze rays, in their own frame.
    rows : int
        Rows of the table.
    geometry : Environment, optional
        Its frame is the frame of the table. Default: the frame of the rays.
    seed : int
        Seed of the subsample of rays.
    weights : str
        ``"person"`` gives each participant the same total weight; other values weight each ray equally.
    kappa : float, optional
        Concentration of each ray's kernel; see `check_prior_kappa`.

    Returns
    -------
    numpy.ndarray
        Table (rows, 2 rows) as returned by ``fields.gaze_base.make_prior_table``.
    """
    check_prior_kappa(rows, kappa)
    subset = np.random.default_rng(seed).permutation(len(rays))[:_MAX_PRIOR_RAYS]
    ray_weights = compute_participant_weights(rays)[subset] if weights == "person" else None
    kappa = DEFAULT_PRIOR_KAPPA if kappa is None else kappa
    kde = SphericalKde(rays.direction[subset], np.array([0, len(subset)]), kappa, ray_weights)
    directions = table_directions(rows)
    density = kde.evaluate(directions if geometry is None else geometry.directions_to_rays(directions))[0]
    return make_prior_table(density, rows, kde.ns, fibonacci_directions(_QUADRATURE_DIRECTIONS))


def select_prior_kappa(rays: Rays, weights: str = "equal", seed: int = 0) -> float:
    """Select the concentration of the prior's kernels by leaving out participants.

    The prior of the other participants predicts each participant; with one, the first half of the rays in time predicts
    the second. The result is the geometric mean of the best of `PRIOR_KAPPAS` and `DEFAULT_PRIOR_KAPPA`: the best one
    alone varies with the training participants more than with those who are predicted.

    Parameters
    ----------
    rays : Rays
        Training rays.
    weights : str
        Weights of the rays in the prior (`make_prior_from_rays`).
    seed : int
        Seed of the subsamples.
    """
    participants, rng = np.unique(rays.person), np.random.default_rng(seed)
    tests = [rays.person == p for p in participants] if len(participants) > 1 else [rays.t > np.median(rays.t)]
    scores = []
    for test in tests:
        if test.all() or not test.any():
            continue
        held_out = rays.direction[rng.permutation(np.flatnonzero(test))[:_MAX_PARTICIPANT_RAYS]]
        train = rays.select(np.sort(rng.permutation(np.flatnonzero(~test))[:_MAX_SELECTION_RAYS]))
        ray_weights = compute_participant_weights(train) if weights == "person" else None
        mixture = np.array([0, len(train)])
        density = [SphericalKde(train.direction, mixture, k, ray_weights).evaluate(held_out)[0] for k in PRIOR_KAPPAS]
        scores.append(np.log(add_prior_floor(np.array(density, np.float64))).mean(axis=1))
    best = PRIOR_KAPPAS[int(np.mean(scores, axis=0).argmax())] if scores else DEFAULT_PRIOR_KAPPA
    return float(np.sqrt(best * DEFAULT_PRIOR_KAPPA))


def make_prior_from_views(views: Sequence[SalienceView], rows: int) -> np.ndarray:
    """Estimate the position-independent prior from salience views, each of which covers a part of the sphere.

    Returns a table (rows, 2 rows) as ``fields.gaze_base.make_prior_table`` does.

    Notes
    -----
    The estimate b maximises the likelihood if view v samples b conditioned on its visible part. It is found with the
    minorise-maximise iteration of Hunter (2004) for the Bradley-Terry and Plackett-Luce models: b = Σ_v p_v / Σ_v 1_v /
    b(v). One additional uniform view of the whole sphere connects views that do not overlap. Directions outside every
    view take the value of the nearest direction inside one.
    """
    from scipy.spatial import KDTree

    directions = table_directions(rows)
    # Solid angles of the latitude bands, which sum to exactly 4π.
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    area = np.repeat((edges[:-1] - edges[1:]) * np.pi / rows, 2 * rows)
    density, is_visible = np.empty((len(views), len(area)), np.float32), np.empty((len(views), len(area)), bool)
    for k, view in enumerate(views):
        # Reduce the view so that its pixels are not finer than the texels.
        density[k], is_visible[k] = view.reduce(max(1, round(view.total_solid_angle / area.max()))).evaluate(directions)
    # A view that falls between the texel centres contributes nothing.
    visible_gaze = density @ area
    is_visible &= visible_gaze[:, None] > 0
    target = (density / np.maximum(visible_gaze, 1e-30)[:, None]).sum(axis=0, dtype=np.float64) + 1 / (4 * np.pi)
    prior = np.full(len(area), 1 / (4 * np.pi))
    for _ in range(_ITERATIONS):
        visible_prior = is_visible @ (prior * area)
        prior = target / (is_visible.T @ (1 / np.maximum(visible_prior, 1e-30) * (visible_prior > 0)) + 1)
        prior /= prior @ area
    is_covered = is_visible.any(axis=0)
    if is_covered.any():
        prior = prior[
            np.flatnonzero(is_covered)[KDTree(directions[is_covered], leafsize=_LEAF_SIZE).query(directions)[1]]
        ]
    kde = SphericalKde(directions, np.array([0, len(area)]), _VIEWS_KAPPA, prior * area)
    return make_prior_table(kde.evaluate(directions)[0], rows, kde.ns, fibonacci_directions(_QUADRATURE_DIRECTIONS))


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
        raise NergError(f"semantic features need a radiance field; pass one with {parameter('field')}")
    out = np.empty((len(origins), medium.feature_count), np.float16)
    with dr.suspend_grad():
        for a in range(0, len(out), FEATURE_BATCH):
            part = slice(a, a + FEATURE_BATCH)
            o, d = to_vector(mi.Point3f, origins[part]), to_vector(mi.Vector3f, directions[part])
            if kind == "snapshot":
                t = mi.Float(np.ascontiguousarray(distance[part], np.float32))
                features = evaluate_features(medium, o + d * t, mi.Bool(True))
            else:
                features = accumulate_features(
                    SceneGeometry(medium), mi.Ray3f(o, d), mi.Bool(True), default_march_settings(medium)
                )
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

    def summarize_data(self) -> dict[str, int | str]:
        """Return the numbers of ``rays``, participants (``people``) and salience views, and the ``tracking`` of
        the rays (JSON)."""
        views = {"salience_views": len(self.views)}
        if self.rays is None:
            return {"rays": 0, "people": 0, **views}
        num_participants = len(np.unique(self.rays.person))
        return {"rays": len(self.rays), "people": num_participants, **views, "tracking": self.rays.tracking}

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


# ---- Splits ----
#
# Positions and participants that are held out for testing, and positions that are held out for validation.

_VALIDATION_FRACTION = 0.12  # Fraction of the views held out for validation


@dataclass(frozen=True, eq=False)
class ValidationSplit:
    """Training and validation data of the first fit."""

    training: Supervision  # Data to train on
    validation: Supervision | None = None  # Data to validate on; None: no validation
    # Positions (T, 3) of the validation probes in the frame of the rays; None: at the views
    centres: np.ndarray | None = None
    rays_held_out: int = 0  # Rays and views excluded from the training data
    views_held_out: int = 0


def split_validation(
    supervision: Supervision, geometry: Environment, settings: GazeSettings, probes: ProbeSettings
) -> ValidationSplit:
    """Hold out zones of positions for validation, as many as ``settings.validation_zones``.

    Training data within 2R of a validation position are removed, where R is the probe radius: rays and views, or only
    views if there are no rays.

    Raises `NergError` if too little training data would remain.
    """
    rays, views = supervision.rays, supervision.views
    if not settings.validation_zones:
        return ValidationSplit(supervision)
    if rays is None:
        train, validation = split_views(views, settings.validation_zones, 2 * probes.radius, settings.seed + 1)
        return ValidationSplit(
            Supervision(None, tuple(train)),
            Supervision(None, tuple(validation)),
            views_held_out=len(views) - len(train),
        )
    split = split_by_position(
        rays,
        probes.radius,
        zones=settings.validation_zones,
        test_probes=settings.validation_probes,
        min_rays=settings.validation_min_rays or probes.min_rays,
        seed=settings.seed + 1,
    )
    far_from_test = select_far_views(
        views, geometry.points_to_field(split.test_centres), 2 * probes.radius * geometry.align.scale
    )
    return ValidationSplit(
        Supervision(rays.select(split.train), tuple(far_from_test)),
        # Validation uses all rays around the centres, because the truth is the gaze of everybody who was there.
        Supervision(rays),
        split.test_centres,
        rays_held_out=int((~split.train).sum()),
        views_held_out=len(views) - len(far_from_test),
    )


def hold_out(
    rays: Rays,
    radius: float,
    zones: int,
    positions: int,
    seed: int = 0,
    min_rays: int = 64,
    participant_fraction: float = 0.0,
) -> tuple[Rays, dict]:
    """Hold out test positions, and optionally participants.

    Parameters
    ----------
    rays : Rays
        All gaze rays.
    radius : float
        Probe radius R in metres. Rays within 2R of a test position are removed (``rays.filters``), so that no training
        probe comes within R of one.
    zones, positions : int
        Number of zones and total number of test positions.
    seed : int
        Seed of the split.
    min_rays : int
        Minimum number of rays around a test position.
    participant_fraction : float
        Fraction of the participants to hold out everywhere; the test positions are then chosen among theirs. 0 holds
        out none.

    Returns
    -------
    train : Rays
        Rays to train on.
    holdout : dict
        Description of the split (JSON), with the test ``centres`` in the frame of the rays and the names of the
        held-out participants (``people``).
    """
    is_training, names = np.ones(len(rays), bool), []
    test_rays = rays
    if participant_fraction:
        is_training, is_held_out = split_by_person(rays, test_fraction=participant_fraction, seed=seed)
        names = [rays.persons[i] for i in np.unique(rays.person[is_held_out])]
        test_rays = rays.select(is_held_out)
    split = split_by_position(test_rays, radius, zones=zones, test_probes=positions, min_rays=min_rays, seed=seed)
    train = is_training & purge(rays, split.test_centres, 2 * radius)
    holdout = {
        "centres": split.test_centres.round(6).tolist(),
        "zone": split.zone.tolist(),
        "radius": radius,
        "purged_within": 2 * radius,
        "seed": seed,
        "rays": len(rays),
        "rays_to_train": int(train.sum()),
        "rays_near_tests": int(split.test.sum()),
        "people": names,
    }
    return rays.select(train), holdout


def split_views(
    views: Sequence[SalienceView], zones: int, distance: float, seed: int = 0
) -> tuple[list[SalienceView], list[SalienceView]]:
    """Split views into ``(training, validation)``.

    An eighth of the views, in ``zones`` groups of neighbours, are held out for validation. Views within ``distance`` of
    a validation view are excluded from training.

    Raises `NergError` if too few views would remain.
    """
    centres = np.array([v.camera.center for v in views])
    rng = np.random.default_rng(seed)
    seeds = [int(rng.integers(len(views)))]
    distances = np.full(len(views), np.inf)
    while len(seeds) < min(zones, len(views)):
        distances = np.minimum(distances, np.linalg.norm(centres - centres[seeds[-1]], axis=1))
        seeds.append(int(rng.choice(np.argsort(-distances)[: max(1, len(views) // 4)])))
    group_size = max(1, round(_VALIDATION_FRACTION * len(views) / len(seeds)))
    seed_distances = np.linalg.norm(centres[:, None] - centres[seeds], axis=2)
    validation = np.unique(np.argsort(seed_distances, axis=0, kind="stable")[:group_size])
    train = select_far_views(views, centres[validation], distance)
    if len(train) < max(2, len(views) // 4):
        raise NergError(
            f"only {len(train)} of {len(views)} views remain for training; the others are validation views or "
            f"within {distance:g} of one; use fewer {parameter('validation_zones')} (0: no validation) or a "
            f"smaller {parameter('radius')}"
        )
    return train, [views[k] for k in validation]


def select_far_views(views: Sequence[SalienceView], points: np.ndarray, distance: float) -> list[SalienceView]:
    """Return the ``views`` whose camera is farther than ``distance`` from each of ``points`` (T, 3), all in one
    frame."""
    return [v for v in views if np.linalg.norm(points - v.camera.center, axis=1).min(initial=np.inf) > distance]


# ---- Surface distances along observer rays ----

SURFACE_OPACITY = 0.5  # Opacity from which a ray counts as hitting a surface; the integrator's default


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
        at = ns.UInt32(observers.astype(np.uint32))
        index = ns.UInt32((observers[:, None] * self.num_directions + directions).astype(np.uint32).ravel())
        p_o, r_o = dr.gather(ns.Array3f, self._positions, at), dr.gather(ns.Array3f, self._r_o, index)
        p_od = dr.gather(ns.Array3f, self._positions, index // self.num_directions) + r_o * dr.gather(
            ns.Float, self._distance, index
        )
        semantic = None
        if self._features:
            F = self._features
            semantic = [ns.Float(dr.gather(ns.Float16, self._semantic, index * F + k)) for k in range(F)]
        return GazeBatch(
            p_o,
            r_o,
            p_od,
            dr.gather(ns.Float, self._truth, index),
            dr.gather(ns.Bool, self._misses, index),
            self._gather_solid_angles(observers),
            semantic,
            self._solid_angle is not None,
        )

    def _gather_solid_angles(self, observers: np.ndarray) -> Any:
        full_sphere = np.full(len(observers), 4 * np.pi, np.float32)
        return self.ns.Float(full_sphere if self._solid_angle is None else self._solid_angle[observers])


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
            f"{directions:,} directions do not resolve the kernels of the rays; use a smaller {parameter('kappa')} "
            f"or more {parameter('directions')}"
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
