"""What a gaze field is trained on: rays and views as targets on surfaces, batches, splits and the blind density."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeHeadConfig, RaySupport, make_prior_table, table_directions
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import AnyBox, intersect_box_numpy
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.types import variant_types
from nerg_mi.photos.salience import SalienceView
from nerg_mi.probes.kde import SphericalKde
from nerg_mi.probes.probes import Probes, compute_participant_weights, place_probes
from nerg_mi.rays.filters import purge, split_by_person, split_by_position
from nerg_mi.rays.rays import Rays
from nerg_mi.transport.field_medium import FieldMedium, accumulate_features, evaluate_features
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings, trace_depth
from nerg_mi.transport.observer_gaze import interpolate_nearest_depth

from .gaze_settings import MIN_MEAN_DENSITY, GazeSettings, ProbeSettings
from .geometry import DEFAULT_DEPTH, TrainingGeometry

# ---- The blind density that a log-density gaze field begins with: what people look at wherever they stand ----

_MOST_RAYS = 1 << 16  # Rays that it is made of at most
_VIEWS_KAPPA = 50.0  # Concentration of the kernels that smooth the density of views
_LEAF = 16  # Points in a leaf of a KD-tree, which decides between directions that are equally far
_ROUNDS = 100  # Rounds of the iteration that puts it together from them
_SCALED_OVER = 1 << 16  # Directions over which the table is scaled to integrate to one


def check_prior_kappa(rows: int, kappa: float) -> None:
    """Raise `NergError` where kernels of this concentration are narrower than half a texel of a table of ``rows``."""
    if kappa > (most := (2 * rows / np.pi) ** 2):
        raise NergError(
            f"the blind density is kept in a table of {rows} rows, between which kernels of a concentration of "
            f"{kappa:g} vanish; let it be at most {most:.0f}"
        )


def make_prior_from_rays(
    rays: Rays, rows: int, geometry: TrainingGeometry | None = None, seed: int = 0, weights: str = "equal", kappa: float = 10.0
) -> np.ndarray:
    """``fields.gaze_base.make_prior_table`` (rows, 2 rows) of where ``rays`` go, in the frame of ``place`` (None:
    that of the rays). ``weights``: with ``person`` all people count alike, however many rays are theirs; ``kappa``:
    concentration of the kernel of each ray; see `check_kernels`."""
    check_prior_kappa(rows, kappa)
    which = np.random.default_rng(seed).permutation(len(rays))[:_MOST_RAYS]
    each = compute_participant_weights(rays)[which] if weights == "person" else None
    kde = SphericalKde(rays.direction[which], np.array([0, len(which)]), kappa, each)
    directions = table_directions(rows)
    density = kde.evaluate(directions if geometry is None else geometry.directions_to_rays(directions))[0]
    return make_prior_table(density, rows, kde.ns, fibonacci_directions(_SCALED_OVER))


def make_prior_from_views(views: Sequence[SalienceView], rows: int) -> np.ndarray:
    """``fields.gaze_base.make_prior_table`` (rows, 2 rows) of what is looked at wherever the camera stands, of which
    each of ``views`` shows a part.

    The density b of greatest likelihood when view v sees b given its part, found by Hunter's (2004) iteration for
    choices among a few: b = Σ_v p_v / Σ_v 1_v / b(v). One more view, of the whole sphere, is uniform: it links those
    that share nothing. What no view shows is looked at as what lies next to it is.
    """
    from scipy.spatial import KDTree

    directions = table_directions(rows)
    # Of the rows' bands, not of the texels' centres: they sum to 4π.
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    area = np.repeat((edges[:-1] - edges[1:]) * np.pi / rows, 2 * rows)
    density, known = np.empty((len(views), len(area)), np.float32), np.empty((len(views), len(area)), bool)
    for k, view in enumerate(views):
        # Texels are coarse: a view's pixels should not be finer than they are.
        density[k], known[k] = view.reduce(max(1, round(view.total_solid_angle / area.max()))).evaluate(directions)
    # What lies between the texels' centres is not seen.
    found = density @ area
    known &= found[:, None] > 0
    target = (density / np.maximum(found, 1e-30)[:, None]).sum(axis=0, dtype=np.float64) + 1 / (4 * np.pi)
    blind = np.full(len(area), 1 / (4 * np.pi))
    for _ in range(_ROUNDS):
        share = known @ (blind * area)
        blind = target / (known.T @ (1 / np.maximum(share, 1e-30) * (share > 0)) + 1)
        blind /= blind @ area
    shown = known.any(axis=0)
    if shown.any():
        blind = blind[np.flatnonzero(shown)[KDTree(directions[shown], leafsize=_LEAF).query(directions)[1]]]
    kde = SphericalKde(directions, np.array([0, len(area)]), _VIEWS_KAPPA, blind * area)
    return make_prior_table(kde.evaluate(directions)[0], rows, kde.ns, fibonacci_directions(_SCALED_OVER))


def compute_observer_bounds(positions: np.ndarray, box: AnyBox) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Corners of the box of observers at ``positions`` (N, 3), of some extent along each axis of ``box``."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    return tuple(low.tolist()), tuple(np.maximum(high, low + 1e-3 * box.side).tolist())


# ---- Semantics ----
#
# What a gaze field takes over from a radiance field: its features along the observers' rays, the paper's semantic
# variants.

FEATURE_BATCH = 1 << 18  # Rays whose features are computed in one launch


def compute_semantic_features(
    geometry: TrainingGeometry, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray, kind: str
) -> np.ndarray:
    """Features (N, F), float16, of what rays see: ``accumulated`` along them, or the ``snapshot`` at ``distance`` (N,).

    ``origins``, ``directions`` (N, 3) in the frame of ``place``, unit. `NergError` for a place that is no radiance
    field.
    """
    mi = variant_types()
    medium = geometry.medium
    if not isinstance(medium, FieldMedium):
        raise NergError("semantic features are those of a radiance field; give one with --field")
    out = np.empty((len(origins), medium.feature_count), np.float16)
    with dr.suspend_grad():
        for a in range(0, len(out), FEATURE_BATCH):
            part = slice(a, a + FEATURE_BATCH)
            o, d = to_vector(mi.Point3f, origins[part]), to_vector(mi.Vector3f, directions[part])
            if kind == "snapshot":
                t = mi.Float(np.ascontiguousarray(distance[part], np.float32))
                found = evaluate_features(medium, o + d * t, mi.Bool(True))
            else:
                found = accumulate_features(SceneGeometry(medium), mi.Ray3f(o, d), mi.Bool(True), default_march_settings(medium))
            # At once: each by itself would march, or evaluate the network, again.
            dr.eval(found)
            out[part] = np.stack([np.array(f) for f in found], axis=-1)
    return out


# ---- What a gaze field learns from: rays of attention, salience images, or both ----


@dataclass(frozen=True, eq=False)
class Supervision:
    """Rays and views, of which one may be missing."""

    rays: Rays | None = None  # Rays of attention, in a frame of their own in metres; None: views alone
    views: tuple[SalienceView, ...] = ()  # Salience images, in the gaze field's frame

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views))
        if self.rays is None and not self.views:
            raise ValueError("a gaze field learns from rays, from views or from both, and there is neither")

    def compute_digest(self) -> dict[str, str | None]:
        """SHA-256 of what a training takes from ``rays`` and from ``views`` (JSON); None for what there is none of."""
        views = [a for v in self.views for a in (v.camera.to_world, v.gaze_fraction, v.solid_angle)]
        return {
            "rays": None if self.rays is None else digest_rays(self.rays),
            "views": _sha256(views) if views else None,
        }

    def count_data(self) -> dict[str, int]:
        """How many ``rays`` of how many ``people``, and how many salience images there are (JSON)."""
        rays = self.rays
        people = 0 if rays is None else len(np.unique(rays.person))
        return {"rays": 0 if rays is None else len(rays), "people": people, "salience_views": len(self.views)}

    def make_support(self, radius: float, geometry: TrainingGeometry) -> RaySupport | None:
        """Rays that start around a position in the frame of ``place``, for probes of ``radius`` metres; None
        without rays."""
        if self.rays is None:
            return None
        return RaySupport.from_origins(geometry.points_to_field(self.rays.origin), radius * geometry.align.scale)


def digest_rays(rays: Rays) -> str:
    """SHA-256 of what a training takes from ``rays``."""
    return _sha256([rays.person, rays.origin, rays.direction])


def _sha256(arrays: list[np.ndarray]) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


# ---- Splits ----
#
# What a training does not learn from: positions and people that a test holds out, and what a validation watches.

_WATCHED = 0.12  # Share of the views that a validation watches


@dataclass(frozen=True, eq=False)
class ValidationSplit:
    """What the first of a training's fits learns from, and what it is scored on."""

    training: Supervision  # What is learnt from
    validation: Supervision | None = None  # What is scored; None: nothing is watched
    centres: np.ndarray | None = None  # Where its rays are scored (T, 3), in their frame; None: at its views
    rays_held_out: int = 0  # Rays and views that are not learnt from
    views_held_out: int = 0


def split_validation(
    supervision: Supervision, geometry: TrainingGeometry, settings: GazeSettings, probes: ProbeSettings
) -> ValidationSplit:
    """Zones of positions that are watched, where ``settings`` ask for any, purged by 2R: of rays, or of views where
    there are no rays. No view within 2R of a position that is watched is learnt from.

    Raises `NergError` where too little would be left to learn from.
    """
    rays, views = supervision.rays, supervision.views
    if not settings.zones:
        return ValidationSplit(supervision)
    if rays is None:
        learn, watched = split_views(views, settings.zones, 2 * probes.radius, settings.seed + 1)
        return ValidationSplit(
            Supervision(None, tuple(learn)), Supervision(None, tuple(watched)), views_held_out=len(views) - len(learn)
        )
    split = split_by_position(
        rays,
        probes.radius,
        zones=settings.zones,
        test_probes=settings.validation_probes,
        min_rays=settings.validation_min_rays or probes.min_rays,
        seed=settings.seed + 1,
    )
    kept = select_far_views(views, geometry.points_to_field(split.test_centres), 2 * probes.radius * geometry.align.scale)
    return ValidationSplit(
        Supervision(rays.select(split.train), tuple(kept)),
        # All rays around the centres: what is scored is what people there really looked at.
        Supervision(rays),
        split.test_centres,
        rays_held_out=int((~split.train).sum()),
        views_held_out=len(views) - len(kept),
    )


def hold_out(
    rays: Rays, radius: float, zones: int, positions: int, seed: int = 0, min_rays: int = 64, participant_fraction: float = 0.0
) -> tuple[Rays, dict]:
    """Rays to train on, when ``positions`` test positions in ``zones`` zones are held out; and an account of it (JSON).

    Every ray within 2 ``radius`` metres of a test position is left out (``rays.filters``), so that no probe of training
    comes within ``radius`` of one. With a share of ``people`` these are left out everywhere, and the test positions are
    theirs. The account holds the test ``centres`` in the rays' frame, and the names of the ``people`` left out.
    """
    known, names = np.ones(len(rays), bool), []
    looked_at = rays
    if participant_fraction:
        known, unseen = split_by_person(rays, test_fraction=participant_fraction, seed=seed)
        names = [rays.persons[i] for i in np.unique(rays.person[unseen])]
        looked_at = rays.select(unseen)
    split = split_by_position(looked_at, radius, zones=zones, test_probes=positions, min_rays=min_rays, seed=seed)
    train = known & purge(rays, split.test_centres, 2 * radius)
    account = {
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
    return rays.select(train), account


def split_views(
    views: Sequence[SalienceView], zones: int, distance: float, seed: int = 0
) -> tuple[list[SalienceView], list[SalienceView]]:
    """``(learn, watched)``: ``zones`` groups of neighbouring views, an eighth of all, are watched, and no other within
    ``distance`` of one is learnt from.

    Raises `NergError` when too few are left.
    """
    centres = np.array([v.camera.center for v in views])
    rng = np.random.default_rng(seed)
    chosen = [int(rng.integers(len(views)))]
    apart = np.full(len(views), np.inf)
    while len(chosen) < min(zones, len(views)):
        apart = np.minimum(apart, np.linalg.norm(centres - centres[chosen[-1]], axis=1))
        chosen.append(int(rng.choice(np.argsort(-apart)[: max(1, len(views) // 4)])))
    each = max(1, round(_WATCHED * len(views) / len(chosen)))
    near = np.linalg.norm(centres[:, None] - centres[chosen], axis=2)
    watched = np.unique(np.argsort(near, axis=0, kind="stable")[:each])
    learn = select_far_views(views, centres[watched], distance)
    if len(learn) < max(2, len(views) // 4):
        raise NergError(
            f"{len(learn)} of {len(views)} views are left to train on, the others are watched or within "
            f"{distance:g} of one that is; choose fewer --zones (0: none), or a smaller --radius"
        )
    return learn, [views[k] for k in watched]


def select_far_views(views: Sequence[SalienceView], points: np.ndarray, distance: float) -> list[SalienceView]:
    """Those of ``views`` whose camera is farther than ``distance`` from each of ``points`` (T, 3), all in one frame."""
    return [v for v in views if np.linalg.norm(points - v.camera.center, axis=1).min(initial=np.inf) > distance]


# ---- Where observers in a place meet surfaces ----

SURFACE_OPACITY = 0.5  # Opacity from which on a ray has met a surface; the integrator's default


def compute_surface_distances(
    geometry: TrainingGeometry, positions: np.ndarray, directions: np.ndarray, depth: str = "median", fill_misses: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (P, D) from ``positions`` (P, 3) along unit ``directions`` (P, D, 3) to the surface that each meets,
    float32, and which meet none, (P, D) bool; all in the frame and units of the place.

    ``depth``: kind of depth that is the surface (``transport.depth``). Without any geometry everything is ``NOWHERE``
    away and nothing counts as escaped. A direction that meets no surface ends where it leaves the place's box (or after
    the box's diagonal, where it never enters): it still needs a p_od at which the field is evaluated. With ``fill`` it
    ends at the depth of the directions of its position nearest to it that do meet one: where the geometry has holes.
    """
    P, D = directions.shape[:2]
    if geometry.medium is None:
        return np.full((P, D), DEFAULT_DEPTH, np.float32), np.zeros((P, D), bool)
    origins = np.repeat(np.asarray(positions, np.float64), D, axis=0)
    flat = np.asarray(directions, np.float64).reshape(-1, 3)
    distance, opacity = trace_depth(geometry.medium, origins, flat, kind=depth)
    escaped = opacity < SURFACE_OPACITY
    distance[escaped] = compute_box_exit(geometry.box, origins[escaped], flat[escaped])
    distance, escaped = distance.reshape(P, D), escaped.reshape(P, D)
    if fill_misses:
        for p in np.flatnonzero(escaped.any(axis=1) & ~escaped.all(axis=1)):
            met = ~escaped[p]
            distance[p, escaped[p]] = interpolate_nearest_depth(directions[p, met], distance[p, met], directions[p, escaped[p]])
    return distance, escaped


def compute_box_exit(box: AnyBox, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (N,) at which rays leave ``box``; its diagonal for rays that never enter it."""
    near, far = intersect_box_numpy(origins, directions, box.lower, box.upper)
    return np.where((far > 0) & (near <= far) & np.isfinite(far), far, box.diagonal)


# ---- Targets ----
#
# Targets of a gaze field: observers, directions around each, the true densities there and the surfaces that they meet.
#
# Rays become targets by way of probes (``ray_targets``), views directly (``view_targets``). The place is frozen while
# gaze is trained and each observer keeps its directions, so every depth is traced once, before the training.


@dataclass(frozen=True)
class TargetRequirements:
    """What a kind of gaze field is shown besides directions, densities and distances."""

    semantic: str = ""  # Features of a radiance field (`fields.gaze_product.SEMANTICS`); "": none
    fill_misses: bool = False  # Whether directions that meet no surface end at the depth of those around them, not on the box
    prior_rows: int = 0  # Rows of the table of the blind density that the field begins with; 0: it needs none

    @staticmethod
    def from_config(config: GazeHeadConfig) -> TargetRequirements:
        """What a field of the configuration ``config`` needs."""
        return TargetRequirements(config.semantic, config.fills_escaped, config.prior)


@dataclass(frozen=True, eq=False)
class GazeTargets:
    """P observers with D directions each, parts of equal solid angle, in the field's frame and units; float32."""

    positions: np.ndarray  # Positions (P, 3) of the observers, p_o
    directions: np.ndarray  # Unit directions (P, D, 3), r_o
    truth: np.ndarray  # True densities (P, D), 1/sr
    distance: np.ndarray  # Distances (P, D) from p_o to p_od
    misses: np.ndarray  # Where no surface was met (P, D), bool
    # Features (P, D, F) of a radiance field, float16, for a gaze field that wants them.
    semantic: np.ndarray | None = None
    # Table of the log of the density of all rays whatever their position (`fields.gaze_base.make_prior_table`).
    prior_table: np.ndarray | None = None
    # The same observers in other directions, for the epoch that is given, where each epoch has its own.
    resample: Callable[[int], GazeTargets] | None = None
    # Corners of the box of observers that capture's encoding spans; None: that of the positions.
    observer_bounds: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # Solid angle (P,), sr, of which the D directions are parts and over which the truth integrates to one; None: 4π.
    solid_angle: np.ndarray | None = None

    @property
    def miss_fraction(self) -> float:
        """Share of the directions that meet no surface."""
        return float(self.misses.mean())

    @property
    def miss_gaze_fraction(self) -> float:
        """Share of the true gaze that goes where no surface is."""
        gaze = self.truth if self.solid_angle is None else self.truth * self.solid_angle[:, None]
        return float((gaze * self.misses).sum() / gaze.sum())


def make_observer_targets(
    positions: np.ndarray,
    directions: np.ndarray,
    truth: np.ndarray,
    geometry: TrainingGeometry,
    depth: str = "median",
    requirements: TargetRequirements | None = None,
) -> GazeTargets:
    """Targets of observers (P, 3) whose density in ``directions`` (P, D, 3) is ``truth`` (P, D), all in the frame of
    ``place``, with the surfaces that they see there; ``depth``: kind of depth that is the surface.

    Raises `NergError` where ``needs`` asks for features of a place that is no radiance field.
    """
    requirements = requirements or TargetRequirements()
    distance, escaped = compute_surface_distances(geometry, positions, directions, depth, requirements.fill_misses)
    features = None
    if requirements.semantic:
        origins = np.repeat(positions, directions.shape[1], axis=0)
        features = compute_semantic_features(geometry, origins, directions.reshape(-1, 3), distance.ravel(), requirements.semantic)
        features = features.reshape(*directions.shape[:2], -1)
    narrow = lambda v: v.astype(np.float32, copy=False)
    return GazeTargets(narrow(positions), narrow(directions), narrow(truth), distance, escaped, features)


def concatenate_targets(a: GazeTargets, b: GazeTargets) -> GazeTargets:
    """The observers of both, with as many directions each; the blind density is that of ``a``."""
    rows = lambda name: np.concatenate([getattr(a, name), getattr(b, name)])
    out: dict[str, Any] = {k: rows(k) for k in ("positions", "directions", "truth", "distance", "misses")}
    extent = [np.full(len(t.truth), 4 * np.pi, np.float32) if t.solid_angle is None else t.solid_angle for t in (a, b)]
    semantic = None if a.semantic is None else rows("semantic")
    renew, of_a, of_b = None, a.resample, b.resample
    if of_a is not None and of_b is not None:
        renew = lambda epoch: concatenate_targets(of_a(epoch), of_b(epoch))
    return GazeTargets(**out, semantic=semantic, prior_table=a.prior_table, resample=renew, solid_angle=np.concatenate(extent))


# ---- Targets as arrays of a backend, and the batches that are gathered from them ----

_WHOLE = 1 - 1e-6  # Below 4π by more than this share, directions are those of a view


@dataclass(frozen=True)
class GazeBatch:
    """B observers with D directions each, flat: value b * D + d is observer b in direction d."""

    p_o: Any  # Observers (Array3f, B lanes)
    r_o: Any  # Directions (Array3f, B * D lanes), unit
    p_od: Any  # What they end at (Array3f, B * D lanes)
    truth: Any  # True densities (Float, B * D lanes), 1/sr
    misses: Any  # Where no surface is met (Bool, B * D lanes)
    solid_angle: Any  # Solid angle in sr (Float, B lanes) that the directions of an observer are equal parts of
    semantic: list | None = None  # Features of a radiance field (F Floats, B * D lanes); None without any
    has_views: bool = False  # Whether some of the observers are views, who are known in part

    def integrate(self, density: Any) -> Any:
        """Integral (Float, B lanes) of the ``density`` (Float, B * D lanes, 1/sr) of each observer over its extent."""
        directions = dr.width(density) // dr.width(self.solid_angle)
        return dr.block_sum(density, directions) * (self.solid_angle / directions)

    def condition_on_view(self, density: Any, truth: Any = None) -> Any:
        """Densities of observers that are views, given the view: what else is looked at is not known there. Others
        stay. The result has the integral that ``truth`` has in the same directions, else one."""
        if not self.has_views:
            return density
        inside = self.integrate(dr.maximum(density, 0))
        # A density of zeros has no scale to be taken out.
        scaled = (self.solid_angle < 4 * np.pi * _WHOLE) & (inside > MIN_MEAN_DENSITY)
        whole = 1 if truth is None else self.integrate(truth)
        factor = dr.select(scaled, whole / dr.select(scaled, inside, 1), 1)
        return density * dr.repeat(factor, dr.width(density) // dr.width(self.solid_angle))


class TargetArrays:
    """``targets`` as arrays of the backend ``ns``: ``count`` observers with ``directions`` each. Raises `NergError`
    without any observer."""

    def __init__(self, targets: GazeTargets, ns: ModuleType):
        self.ns, self.num_observers, self.num_directions = ns, *targets.truth.shape
        if self.num_observers == 0:
            raise NergError("there are no probes to train on")
        flat = lambda v: ns.Float(np.ascontiguousarray(v, np.float32).ravel())
        self._extent = None if targets.solid_angle is None else np.asarray(targets.solid_angle, np.float32)
        self._positions, self._r_o = flat(targets.positions), flat(targets.directions)
        self._truth, self._distance = flat(targets.truth), flat(targets.distance)
        self._escaped = ns.Bool(np.ascontiguousarray(targets.misses).ravel())
        self._features = 0 if targets.semantic is None else targets.semantic.shape[-1]
        if self._features:
            self._semantic = ns.Float16(np.ascontiguousarray(targets.semantic).ravel())

    def gather_batch(self, observers: np.ndarray, directions: np.ndarray) -> GazeBatch:
        """The ``observers`` (B,) in ``directions`` (B, D), indices of each observer's own."""
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
            dr.gather(ns.Bool, self._escaped, index),
            self._solid_angles(observers),
            semantic,
            self._extent is not None,
        )

    def _solid_angles(self, observers: np.ndarray) -> Any:
        whole = np.full(len(observers), 4 * np.pi, np.float32)
        return self.ns.Float(whole if self._extent is None else self._extent[observers])


# ---- Ray targets ----
#
# From rays to probes to targets: around each probe directions of equal area, under a rotation of its own, so that
# together the probes see what one set leaves out.


def make_probes(rays: Rays, settings: ProbeSettings, queries: np.ndarray | None = None, seed: int = 0) -> Probes:
    """Probes on ``rays``, at ``queries`` (P, 3) metres where given, else as ``settings`` places them.

    Raises `NergError` when none holds enough rays.
    """
    return place_probes(
        rays,
        settings.radius,
        placement=settings.placement,
        count=settings.count,
        spacing=settings.spacing,
        queries=queries,
        max_rays=settings.cap,
        min_rays=min(settings.min_rays, settings.cap),
        kappa_rule=settings.kappa_rule,
        kappa=settings.kappa,
        weights=settings.weights,
        seed=seed,
    )


def make_targets_from_probes(
    probes: Probes,
    geometry: TrainingGeometry,
    directions: int,
    depth: str = "median",
    requirements: TargetRequirements | None = None,
    seed: int | tuple[int, ...] = 0,
) -> GazeTargets:
    """Targets of ``probes`` in as many ``directions`` each; ``depth``: kind of depth that is the surface; ``seed``: of
    the rotations. Raises `NergError` where all kernels are so narrow that they vanish between the directions."""
    turned = make_rotated_directions(directions, len(probes), np.random.default_rng(seed))
    truth = probes.density(turned)
    if not truth.any():
        raise NergError(
            f"the kernels of all rays vanish between {directions:,} directions; give a smaller --kappa, or more "
            "--directions"
        )
    return make_observer_targets(
        geometry.points_to_field(probes.positions), geometry.directions_to_field(turned), truth, geometry, depth, requirements
    )


def make_targets_from_rays(
    rays: Rays,
    geometry: TrainingGeometry,
    settings: ProbeSettings,
    requirements: TargetRequirements | None = None,
    queries: np.ndarray | None = None,
    seed: int = 0,
) -> GazeTargets:
    """Targets of the probes on ``rays``, at ``queries`` (P, 3) metres where given. With ``settings.fresh`` they can
    ``renew`` their directions. Raises `NergError` when no probe holds enough rays."""
    requirements = requirements or TargetRequirements()
    probes = make_probes(rays, settings, queries, seed)
    turned = lambda seed: make_targets_from_probes(probes, geometry, settings.directions, settings.depth, requirements, seed)
    targets = turned(seed)
    if settings.fresh:
        targets = replace(targets, resample=lambda epoch: turned((seed, epoch)))
    if requirements.prior_rows:
        blind = make_prior_from_rays(rays, requirements.prior_rows, geometry, seed, settings.weights, settings.mix_kappa)
        targets = replace(targets, prior_table=blind)
    return targets


def make_rotated_directions(count: int, sets: int, rng: np.random.Generator) -> np.ndarray:
    """``sets`` Fibonacci sets of ``count`` directions, each turned by a uniform random rotation, (sets, count, 3)."""
    # Unit quaternions from normal numbers are uniform rotations (Shoemake 1992); the first is the real part.
    rotation = Rotation.from_quat(np.roll(rng.normal(size=(sets, 4)), -1, axis=1)).as_matrix()
    return np.einsum("dj,pij->pdi", fibonacci_directions(count), rotation)


# ---- View targets ----
#
# From salience images to targets: each view is an observer at the camera's centre who is known in part.
#
# What a view says holds within its frustum alone. Its directions are of equal area there, its truth is the density
# given that the picture is looked at, and what is trained is the field's density given the same: normalised over the
# view, not over the sphere. How much is looked outside of a picture, views say together: each surface is in many of
# them.

_PER_PIXEL = 4  # Directions a pixel of a view, so that hardly any is left out


def make_targets_from_views(
    views: Sequence[SalienceView],
    geometry: TrainingGeometry,
    settings: ProbeSettings,
    requirements: TargetRequirements | None = None,
    seed: int = 0,
) -> GazeTargets:
    """Targets of ``views`` in the frame of ``place``.

    ``settings.directions`` directions a view, each with the density of the pixel that it lies in; pixels are joined
    until each has some four. With ``settings.fresh`` the targets can ``renew`` their directions.
    """
    requirements, count = requirements or TargetRequirements(), settings.directions
    small = [v.reduce(max(1, count // _PER_PIXEL)) for v in views]

    def drawn(seed: int | tuple[int, int]) -> GazeTargets:
        rng = np.random.default_rng(seed)
        directions, truth = np.empty((len(views), count, 3)), np.empty((len(views), count))
        for k, view in enumerate(small):
            directions[k], pixels = view.sample(count, rng)
            truth[k] = view.density.ravel()[pixels]
        extent = np.array([v.total_solid_angle for v in views])
        truth /= truth.mean(axis=1, keepdims=True) * extent[:, None]
        positions = np.array([v.camera.center for v in views])
        targets = make_observer_targets(positions, directions, truth, geometry, settings.depth, requirements)
        return replace(targets, solid_angle=extent.astype(np.float32))

    targets = drawn(seed)
    if settings.fresh:
        targets = replace(targets, resample=lambda epoch: drawn((seed, epoch)))
    return replace(targets, prior_table=make_prior_from_views(views, requirements.prior_rows)) if requirements.prior_rows else targets
