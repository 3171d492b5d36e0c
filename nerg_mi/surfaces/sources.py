"""Attention on surfaces from observers' gaze and from gaze samples, with quadratures over the sphere and over faces."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.environment.surface_attention import Density, attention_per_sr
from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import Float, Point3f, Vector3f, variant_types
from nerg_mi.maths.vmf import tangent_frame
from nerg_mi.tracking.filters import find_sessions
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import ObserverCache, ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance

from .laplacian import SurfaceSums, deposit, merge_sums
from .mesh import Mesh, SurfaceTarget

# ---- Cones ----
#
# Gaze is modelled as a cone, since eye trackers have an error of about a degree and the fovea covers two.
#
# A cone is a Gaussian of the two angles to the line of sight, with standard deviation σ. Convolving a density over
# directions with it uses a rule of seven directions that is exact to degree five in the tangent plane (A. H. Stroud, D.
# Secrest, "Approximate integration formulas for certain spherically symmetric regions", 1963, for the weight exp(-r²)):
# weight 1/2 at the centre and 1/12 at each of six directions at 2σ. It multiplies a spherical harmonic of degree l by
# (1 + P_l(cos 2σ)) / 2, and so preserves the integral over the sphere. For a sample, a single direction, the cone is a
# bundle of rays.

RING_DIRECTIONS = 6  # number of directions around the central one
_GOLDEN = np.pi * (3 - np.sqrt(5))


def blur_density(density: Callable[[Vector3f], Any], directions: Vector3f, sigma: float) -> Any:
    """Evaluate ``density`` along unit ``directions`` (one per lane), convolved with a cone of ``sigma`` radians."""
    import drjit as dr

    mi = variant_types()
    side, up = mi.coordinate_system(directions)
    total = 0.5 * density(directions)
    sin, cos = dr.sincos(mi.Float(2 * sigma))
    for k in range(RING_DIRECTIONS):
        angle = 2 * math.pi * k / RING_DIRECTIONS
        total += density(cos * directions + sin * (math.cos(angle) * side + math.sin(angle) * up)) / (
            2 * RING_DIRECTIONS
        )
    return total


def sample_cone(directions: np.ndarray, sigma: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Sample ``count`` unit directions of equal weight in a cone of ``sigma`` radians around each of ``directions`` (N,
    3).

    Returns (N, count, 3). Angles to the axis are stratified in shells of equal weight, and azimuths are multiples of
    the golden angle with a random offset, so that bundles are uniform and uncorrelated.
    """
    n = len(directions)
    if sigma == 0:
        return np.repeat(directions[:, None], count, axis=1)
    shell = (np.arange(count) + rng.random((n, 1))) / count
    # The radius of a two-dimensional Gaussian has a Rayleigh distribution.
    angle = np.minimum(sigma * np.sqrt(-2 * np.log1p(-shell)), np.pi)
    azimuth = 2 * np.pi * rng.random((n, 1)) + _GOLDEN * np.arange(count)
    side, up = tangent_frame(directions)
    tangent = np.cos(azimuth)[..., None] * side[:, None] + np.sin(azimuth)[..., None] * up[:, None]
    out = np.cos(angle)[..., None] * directions[:, None] + np.sin(angle)[..., None] * tangent
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


# ---- Face pieces ----
#
# Faces are subdivided into four congruent triangles until each is small as seen by the observer. Pieces are smaller
# near the observer, and their number is limited by the solid angle of the sphere. Solid angles of triangles are exact
# (A. van Oosterom and J. Strackee, "The Solid Angle of a Plane Triangle", 1983), which avoids the singular Jacobian.

MAX_LEVELS = 40  # maximum number of subdivisions of a face, to 10^-12 of its size
MAX_PIECES = 1 << 25  # maximum number of pieces per observer, five gigabytes


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of faces as seen by an observer at a position (3,): the face of each (P,), the barycentric coordinates
    of its corners (P, 3, 3), and its corners relative to the observer (P, 3, 3), in scene units."""

    observer: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    relative: np.ndarray

    def __len__(self) -> int:
        return len(self.face)

    @property
    def centroid_barycentric(self) -> np.ndarray:
        """Barycentric coordinates of the centroids, (P, 3)."""
        return self.barycentric.mean(axis=1)

    @property
    def centroids(self) -> np.ndarray:
        """Centroids in the scene, (P, 3)."""
        return self.relative.mean(axis=1) + self.observer

    @cached_property
    def solid_angle(self) -> np.ndarray:
        """Solid angles in steradians, (P,)."""
        return solid_angles(self.relative)

    def select(self, rows: np.ndarray | slice) -> Pieces:
        """Select pieces by indices or a mask."""
        return Pieces(self.observer, self.face[rows], self.barycentric[rows], self.relative[rows])

    def subdivide(self) -> Pieces:
        """Subdivide each piece into four congruent ones."""
        return Pieces(
            self.observer,
            np.repeat(self.face, 4),
            _quarter_triangles(self.barycentric),
            _quarter_triangles(self.relative),
        )


def subdivide_faces(mesh: Mesh, observer: np.ndarray, max_angle: float, faces: slice = slice(None)) -> Pieces:
    """Subdivide ``faces`` of ``mesh`` until each edge subtends at most about ``max_angle`` (radians) at the observer.

    Edges are measured from the nearest point of the bounding sphere of their piece; a piece that contains the observer
    is subdivided `MAX_LEVELS` times. Raises `NergError` for more than `MAX_PIECES` pieces.
    """
    relative = mesh.corners[faces] - observer
    number = np.arange(len(mesh.faces))[faces]
    pending = Pieces(observer, number, np.broadcast_to(np.eye(3), (len(number), 3, 3)), relative)
    finished: list[Pieces] = []
    for level in range(MAX_LEVELS + 1):
        corners = pending.relative
        middle = corners.mean(axis=1)
        radius = np.sqrt(_squared_norm(corners - middle[:, None]).max(axis=1))
        edge = np.sqrt(_squared_norm(corners - corners[:, [2, 0, 1]]).max(axis=1))
        # The negation also stops at values that are not finite.
        is_small = ~(edge > max_angle * np.maximum(np.sqrt(_squared_norm(middle)) - radius, 0))
        if level == MAX_LEVELS:
            is_small[:] = True
        finished.append(pending.select(is_small))
        if is_small.all():
            break
        if sum(map(len, finished)) + 4 * np.count_nonzero(~is_small) > MAX_PIECES:
            raise NergError(
                f"the observer at {','.join(f'{v:g}' for v in observer)} needs more than {MAX_PIECES:,} surface "
                f"pieces of {np.degrees(max_angle):g} degrees; use a larger {parameter('max_angle')}"
            )
        pending = pending.select(~is_small).subdivide()
    joined = (
        np.concatenate([getattr(part, name) for part in finished]) for name in ("face", "barycentric", "relative")
    )
    return Pieces(observer, *joined)


def _squared_norm(v: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", v, v)


def _quarter_triangles(corners: np.ndarray) -> np.ndarray:
    """Return the corners (4 P, 3, 3) of the quarters of triangles (P, 3, 3)."""
    middle = 0.5 * (corners + corners[:, [1, 2, 0]])
    (a, b, c), (ab, bc, ca) = (np.moveaxis(v, 1, 0) for v in (corners, middle))
    out = np.empty((len(corners), 4, 3, 3))
    for k, three in enumerate(((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))):
        for n, corner in enumerate(three):
            out[:, k, n] = corner
    return out.reshape(-1, 3, 3)


def solid_angles(corners: np.ndarray) -> np.ndarray:
    """Return the solid angles (P,) in steradians of triangles (P, 3, 3) seen from the origin, from either side.

    The solid angle is 0 if the origin lies in the plane of the triangle.
    """
    a, b, c = (corners[:, k] for k in range(3))
    # Normalise to avoid underflow; the result does not depend on the scale.
    unit = np.abs(corners).max(axis=(1, 2))
    scale = np.where(unit > 0, unit, 1)[:, None]
    a, b, c = a / scale, b / scale, c / scale
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dot = lambda u, v: np.einsum("ij,ij->i", u, v)
    # Differences of corners avoid cancellation for small distant triangles.
    volume = np.abs(dot(a, np.cross(b - a, c - a)))
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.where(volume > 0, 2 * np.arctan2(volume, below), 0.0)


# ---- Occlusion boundaries ----
#
# Pieces that are partly visible are subdivided further.
#
# Visibility is tested at four points of a piece and at its corners. Hidden pieces are dropped. Partly visible pieces
# with more than `MAX_PARTIAL_SHARE` of the gaze are subdivided. Without this, an occlusion boundary that is parallel to
# the subdivision, such as that of a shelf on a wall, falls between the same two rows of pieces along its whole length,
# which loses up to a third of a piece; uniform refinement keeps the boundary parallel and the loss similar.

MAX_PARTIAL_SHARE = 1e-6  # maximum share of the gaze on a partly visible piece

MAX_PIECE_SHARE = 2e-5
"""Maximum share of the gaze on a visible piece, so that densities narrower than a piece are integrated."""

MAX_CUTS = 12  # maximum number of subdivisions of a piece

# Four points spread over a piece estimate its visible fraction. The corners only detect occlusion boundaries: corners
# of a hidden side are visible where it meets a visible edge. They are inset slightly, since a ray to the edge of a face
# may hit its neighbour.
_CORNER_INSET = 1e-3
_AREA_POINTS = np.vstack([np.full((1, 3), 1 / 3), 1 / 6 + 0.5 * np.eye(3)])
_TEST_POINTS = np.vstack([_AREA_POINTS, _CORNER_INSET + (1 - 3 * _CORNER_INSET) * np.eye(3)])


def iter_visible_pieces(
    target: SurfaceTarget, pieces: Pieces, density: Callable[[Pieces], np.ndarray], total: float, batch: int
) -> Iterator[tuple[Pieces, np.ndarray]]:
    """Yield the visible pieces, subdivided at occlusion boundaries, with the gaze (P,) that each receives.

    Parameters
    ----------
    target
        Target with binary visibility.
    pieces
        Pieces to test.
    density
        Returns the gaze density of pieces in 1/sr, without occlusion.
    total
        Total gaze, to which the limits are relative.
    batch
        Number of pieces per batch.
    """
    for a in range(0, len(pieces), batch):
        pending = pieces.select(slice(a, a + batch))
        for level in range(MAX_CUTS + 1):
            is_visible = _test_visibility(target, pending)
            rows = np.flatnonzero(is_visible.any(axis=1))
            pending, is_visible = pending.select(rows), is_visible[rows]
            if not len(pending):
                break
            unoccluded = pending.solid_angle * density(pending)
            limit = np.where(is_visible.all(axis=1), MAX_PIECE_SHARE, MAX_PARTIAL_SHARE) * total
            needs_cut = (unoccluded > limit) & (level < MAX_CUTS)
            yield pending.select(~needs_cut), (unoccluded * is_visible[:, : len(_AREA_POINTS)].mean(axis=1))[~needs_cut]
            if not needs_cut.any():
                break
            pending = pending.select(needs_cut).subdivide()


def _test_visibility(target: SurfaceTarget, pieces: Pieces) -> np.ndarray:
    """Return whether each of the test points (P, 7) is visible."""
    points = np.matmul(_TEST_POINTS, pieces.relative) + pieces.observer
    count = len(_TEST_POINTS)
    return target.is_visible(pieces.observer, points.reshape(-1, 3), np.repeat(pieces.face, count)).reshape(-1, count)


# ---- Observers of a recording ----
#
# Weights of gaze samples by the time they represent, and a few observers that represent all positions.

MAX_GAP = 0.5  # maximum time in seconds that a sample represents


_MAX_CELLS = 4096
_MAX_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class WeightedObservers:
    """Observers at ``positions`` (M, 3) with ``weights`` (M,) that sum to one, and the root mean square and the 95th
    percentile of the distance between recorded positions and their observer."""

    positions: np.ndarray
    weights: np.ndarray
    rms_distance: float = 0.0
    p95_distance: float = 0.0


def ray_durations(rays: Rays, max_gap: float = MAX_GAP) -> np.ndarray:
    """Return the time (N,) in seconds that each sample represents.

    It is the time to the next sample of the same recording, at most ``max_gap``; for the last sample, the median of the
    others.
    """
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    out = np.zeros(len(rays))
    for a, b in zip(sessions.starts[:-1], sessions.starts[1:]):
        rows = order[a:b]
        step = np.clip(np.diff(rays.t[rows]), 0, max_gap)
        out[rows] = np.r_[step, np.median(step) if len(step) else 0.0]
    # Without any time step all samples get the same duration.
    return out if out.sum() > 0 else np.full(len(rays), max_gap)


def ray_weights(rays: Rays, weighting: str, max_gap: float = MAX_GAP) -> np.ndarray:
    """Return weights (N,) of samples that sum to one, by one of `WEIGHTINGS`."""
    seconds = np.ones(len(rays)) if weighting == "equal" else ray_durations(rays, max_gap)
    if weighting == "person":
        total = np.bincount(rays.person, seconds)
        seconds = seconds / np.where(total > 0, total, 1)[rays.person]
    return seconds / seconds.sum()


def cluster_observers(positions: np.ndarray, weights: np.ndarray, count: int, seed: int = 0) -> WeightedObservers:
    """Return at most ``count`` observers that represent ``positions`` (N, 3) with ``weights`` (N,).

    Weighted k-means (S. Lloyd 1982) with k-means++ initialisation (D. Arthur, S. Vassilvitskii 2007) on binned
    positions. Each centre is moved to the nearest recorded position, since the mean of two aisles lies in the shelf
    between them. An observer's weight is that of the positions nearest to it.
    """
    from scipy.spatial import KDTree

    weights = np.asarray(weights, np.float64) / np.sum(weights)
    cells, mass = _bin_positions(positions, weights)
    if len(cells) <= count:
        centers = cells
    else:
        rng = np.random.default_rng(seed)
        centers = _choose_initial_centers(cells, mass, count, rng)
        for _ in range(_MAX_ROUNDS):
            nearest = KDTree(centers).query(cells)[1]
            total = np.bincount(nearest, mass, len(centers))
            sums = np.stack([np.bincount(nearest, mass * c, len(centers)) for c in cells.T], axis=1)
            moved = np.where(total[:, None] > 0, sums / np.where(total > 0, total, 1)[:, None], centers)
            if np.allclose(moved, centers, rtol=0, atol=1e-6):
                break
            centers = moved
    # Nearest recorded positions, without duplicates.
    observers = positions[np.unique(KDTree(positions, leafsize=16, balanced_tree=False).query(centers)[1])]
    distance, nearest = KDTree(observers).query(positions)
    total = np.bincount(nearest, weights, len(observers))
    order = np.argsort(distance, kind="stable")
    p95_distance = distance[order][
        np.searchsorted(np.cumsum(weights[order]), 0.95 * weights.sum()).clip(max=len(distance) - 1)
    ]
    has_weight = total > 0
    return WeightedObservers(
        observers[has_weight],
        total[has_weight] / total.sum(),
        float(np.sqrt((weights * distance**2).sum())),
        float(p95_distance),
    )


def _bin_positions(positions: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means and weights of positions in a grid, which is coarsened until at most `_MAX_CELLS` cells are
    occupied."""
    low, size = positions.min(axis=0), float(np.ptp(positions, axis=0).max())
    step = size / 1024
    while True:
        cell = np.floor((positions - low) / step).astype(np.int64) if step > 0 else np.zeros_like(positions, np.int64)
        # Each axis has fewer than 2^20 cells, so that one key represents a cell.
        key = cell @ np.array([1 << 40, 1 << 20, 1])
        _, number = np.unique(key, return_inverse=True)
        mass = np.bincount(number, weights)
        if len(mass) <= _MAX_CELLS or step == 0:
            break
        step *= 1.5
    sums = np.stack([np.bincount(number, weights * c) for c in positions.T], axis=1)
    is_occupied = mass > 0
    return sums[is_occupied] / mass[is_occupied, None], mass[is_occupied]


def _choose_initial_centers(cells: np.ndarray, mass: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    chosen = [int(rng.choice(len(cells), p=mass / mass.sum()))]
    squared_distance = np.square(cells - cells[chosen[0]]).sum(axis=1)
    while len(chosen) < count and (mass * squared_distance).sum() > 0:
        chosen.append(int(rng.choice(len(cells), p=mass * squared_distance / (mass * squared_distance).sum())))
        squared_distance = np.minimum(squared_distance, np.square(cells - cells[chosen[-1]]).sum(axis=1))
    return cells[chosen]


# ---- Gaze samples ----
#
# A sample is cast as a bundle of rays in a cone.
#
# A single ray ends at one point of a mesh: it misses thin edges and passes through gaps. A cone with the width of the
# tracking error and the fovea distributes the sample over all surfaces in it (Martin et al., view-cone sampling, arXiv
# 2601.02721).

MAX_CASTS = 1 << 20  # maximum number of rays per launch


@dataclass(frozen=True, kw_only=True)
class RaySettings:
    """Standard deviation of the cone in radians (0: a single ray), number of rays per cone, and ``seed`` of their
    azimuths."""

    cone_sigma: float = 0.0
    rays_per_cone: int = 16
    seed: int = 0

    @property
    def rays_per_sample(self) -> int:
        """Number of rays per sample."""
        return self.rays_per_cone if self.cone_sigma > 0 else 1


@dataclass(frozen=True, eq=False)
class TrackedRays:
    """``origins`` and unit ``directions`` (N, 3) in the scene, ``weights`` (N,), and the index of the first sample
    in the recording, which seeds the cones."""

    origins: np.ndarray
    directions: np.ndarray
    weights: np.ndarray
    first_index: int = 0

    def __len__(self) -> int:
        return len(self.weights)

    def select(self, start: int, stop: int) -> TrackedRays:
        """Return the samples from ``start`` to ``stop``."""
        rows = slice(start, stop)
        return TrackedRays(self.origins[rows], self.directions[rows], self.weights[rows], self.first_index + start)


def sum_rays(target: SurfaceTarget, rays: TrackedRays, settings: RaySettings) -> SurfaceSums:
    """Sum the attention of samples on ``target``. `merge_sums` adds the results of several parts.

    The random numbers depend on the seed and the index of the first sample only, so that equal parts give equal
    results.
    """
    mesh = target.mesh
    on_faces, on_vertices = np.zeros(len(mesh.faces)), np.zeros(len(mesh.vertices))
    rng = np.random.default_rng([settings.seed, rays.first_index])
    rays_per_sample, elsewhere, escaped = settings.rays_per_sample, 0.0, 0.0
    step = max(1, MAX_CASTS // rays_per_sample)
    for a in range(0, len(rays), step):
        batch = rays.select(a, min(a + step, len(rays)))
        directions = sample_cone(batch.directions, settings.cone_sigma, rays_per_sample, rng).reshape(-1, 3)
        ends = target.trace(np.repeat(batch.origins, rays_per_sample, axis=0), directions)
        weights = np.repeat(batch.weights / rays_per_sample, rays_per_sample)
        on_surface = ends.face >= 0
        sums = deposit(
            mesh.faces, len(mesh.vertices), ends.face[on_surface], ends.barycentric[on_surface], weights[on_surface]
        )
        on_faces, on_vertices = on_faces + sums[0], on_vertices + sums[1]
        elsewhere += float(weights[ends.elsewhere].sum())
        escaped += float(weights[~on_surface & ~ends.elsewhere].sum())
    weight = float(rays.weights.sum())
    return SurfaceSums(on_faces, on_vertices, elsewhere, escaped, weight, weight, len(rays))


# ---- Quadrature over the sphere ----
#
# Directions are denser where the density is high, so that narrow densities are integrated accurately.
#
# The sphere is divided into rings of approximately square cells, which are subdivided according to the density at their
# centres, so that all directions represent about the same share. The error at occlusion boundaries then depends on the
# number of directions only, and not on the width of the density. The rings are rotated relative to the scene axes,
# since they would otherwise be parallel to the boundaries of upright objects.

CELLS = 1 << 14  # initial number of cells, 1.6 degrees wide; narrower densities may be missed
_MAX_SUBDIVISIONS = 64
# A rotation that aligns no scene axis with a ring.
_RING_ROTATION = np.linalg.qr(np.array([[0.61, -0.37, 0.42], [0.29, 0.83, -0.31], [-0.53, 0.17, 0.71]]))[0]


def sphere_quadrature(
    density: Callable[[np.ndarray], np.ndarray], count: int, cells: int = CELLS
) -> tuple[np.ndarray, np.ndarray]:
    """Return at least ``count`` unit directions (N, 3) and their solid angles (N,) in steradians, which sum to 4π.

    ``density`` maps unit directions (M, 3) to non-negative values (M,). Raises ``ValueError`` for a count below 1.
    """
    if count < 1 or cells < 1:
        raise ValueError(f"a quadrature needs at least one direction and one cell, got {count} and {cells}")
    top, bottom, turn, width = _ring_cells(cells)
    area = (top - bottom) * width
    mass = area * density(_directions_from_cylindrical(0.5 * (top + bottom), turn + 0.5 * width))
    share = mass / mass.sum() if mass.sum() > 0 else area / (4 * np.pi)
    subdivisions = np.clip(np.ceil(np.sqrt(count * share)), 1, _MAX_SUBDIVISIONS).astype(np.int64)
    directions, angles = [], []
    for n in np.unique(subdivisions):
        indices = np.flatnonzero(subdivisions == n)[:, None, None]
        fraction = (np.arange(n) + 0.5) / n
        z = bottom[indices] + (top - bottom)[indices] * fraction[:, None]
        phi = turn[indices] + width[indices] * fraction
        directions.append(_directions_from_cylindrical(*(np.ravel(v) for v in np.broadcast_arrays(z, phi))))
        angles.append(np.repeat(area[indices.ravel()] / n**2, n * n))
    return np.concatenate(directions), np.concatenate(angles)


def _ring_cells(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the upper and lower height of each cell, its first azimuth, and its width in radians."""
    rings = max(1, round(np.sqrt(np.pi * count / 4)))
    z = np.cos(np.pi * np.arange(rings + 1) / rings)
    cells_per_ring = np.maximum(1, np.rint(2 * rings * np.sin(np.pi * (np.arange(rings) + 0.5) / rings))).astype(
        np.int64
    )
    ring = np.repeat(np.arange(rings), cells_per_ring)
    number = np.arange(len(ring)) - np.repeat(np.cumsum(cells_per_ring) - cells_per_ring, cells_per_ring)
    width = 2 * np.pi / cells_per_ring[ring]
    return z[ring], z[ring + 1], number * width, width


def _directions_from_cylindrical(z: np.ndarray, phi: np.ndarray) -> np.ndarray:
    r = np.sqrt(np.maximum((1 - z) * (1 + z), 0))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1) @ _RING_ROTATION.T


# ---- Gaze of observers ----
#
# An observer at p_o with the gaze density g(ω) in 1/sr leaves on a face A the attention
#
#     ∫_A g(ω) V(y, p_o) dω(y),    dω = |cos θ| dA / |y - p_o|²
#
# (Veach 1997, section 8.2.2.2). The integral is a sum over small pieces with their exact solid angles, the density at
# their centres and their visible fractions. In a medium, or with a fall-off at occlusion boundaries, V is evaluated at
# the centre by `nerg_mi.environment.surface_attention`. The total gaze, and the parts that hit other surfaces or
# escape, are integrated over the sphere. The two quadratures use different points; their discrepancy is reported as the
# error.

BATCH_SIZE = 1 << 18  # number of pieces per launch
FACES_PER_BATCH = 1 << 16  # number of faces per subdivision batch


@dataclass(frozen=True, kw_only=True)
class GazeSumSettings:
    """Maximum angle of a piece in radians, standard deviation of the gaze cone in radians (0: none), and approximate
    number of ``directions`` over the sphere."""

    max_angle: float = 0.035
    cone_sigma: float = 0.0
    directions: int = 1 << 16


@dataclass(frozen=True, eq=False)
class SurfaceObserver:
    """An observer at ``center`` (one lane): ``density`` at surface points, as `nerg_mi.environment.surface_attention`
    needs it, and density along directions."""

    center: Point3f
    density: Density
    density_along: Callable[[Vector3f], Any]


MakeObserver = Callable[[np.ndarray], SurfaceObserver]  # maps a position (3,) to an observer


def observers_from_field(gaze: GazeFieldInstance, geometry: SceneGeometry, settings: ObserverSettings) -> MakeObserver:
    """Return a function that creates observers whose gaze is the field ``gaze``, traced with ``settings``."""

    def make(eye: np.ndarray) -> SurfaceObserver:
        center = _opaque_point(eye)
        # A new cache per observer, since observers are not reused and a common cache would grow.
        observed = gaze.for_observers([center], geometry, settings, ObserverCache())
        return SurfaceObserver(
            center,
            lambda p_od, p_o, r_o, active: observed.evaluate(p_od, p_o, r_o, active)[0],
            lambda directions: observed.evaluate_along(center, directions),
        )

    return make


def sum_gaze(
    target: SurfaceTarget,
    make_observer: MakeObserver,
    positions: np.ndarray,
    weights: Sequence[float] | np.ndarray,
    settings: GazeSumSettings,
) -> SurfaceSums:
    """Sum the attention of weighted observers on ``target``. `merge_sums` adds the results of several parts."""
    none = SurfaceSums.zeros(len(target.mesh.faces), len(target.mesh.vertices))
    with dr.suspend_grad():
        return merge_sums(
            [
                none,
                *(
                    _sum_one_observer(target, make_observer(eye), float(w), eye, settings)
                    for eye, w in zip(positions, weights)
                ),
            ]
        )


def _sum_one_observer(
    target: SurfaceTarget, observer: SurfaceObserver, weight: float, position: np.ndarray, settings: GazeSumSettings
) -> SurfaceSums:
    mesh, position = target.mesh, np.asarray(position, np.float64)
    density = cone_density_along(observer, settings.cone_sigma)
    directions, angles = sphere_quadrature(density, settings.directions)
    share = weight * angles * density(directions)
    ends = target.trace(np.broadcast_to(position, directions.shape), directions)
    total, escaped = float(share.sum()), float(share[(ends.face < 0) & ~ends.elsewhere].sum())
    on_faces, on_vertices = np.zeros(len(mesh.faces)), np.zeros(len(mesh.vertices))
    for a in range(0, len(mesh.faces), FACES_PER_BATCH):
        pieces = subdivide_faces(mesh, position, settings.max_angle, slice(a, a + FACES_PER_BATCH))
        for batch, received in _iter_received_gaze(
            target, observer, pieces, total / weight if weight else 0.0, settings.cone_sigma
        ):
            sums = deposit(mesh.faces, len(mesh.vertices), batch.face, batch.centroid_barycentric, weight * received)
            on_faces, on_vertices = on_faces + sums[0], on_vertices + sums[1]
    return SurfaceSums(on_faces, on_vertices, float(share[ends.elsewhere].sum()), escaped, total, weight, 1)


def _iter_received_gaze(
    target: SurfaceTarget, observer: SurfaceObserver, pieces: Pieces, total: float, cone: float
) -> Iterator[tuple[Pieces, np.ndarray]]:
    """Yield pieces, possibly subdivided, with the gaze (P,) that each receives."""
    density = cone_density(observer, cone)
    if target.has_binary_visibility:
        yield from iter_visible_pieces(
            target, pieces, lambda batch: _unoccluded_density(observer, density, batch), total, BATCH_SIZE
        )
        return
    for a in range(0, len(pieces), BATCH_SIZE):
        # Most surfaces are occluded, and evaluating gaze is more expensive than tracing.
        batch = pieces.select(slice(a, a + BATCH_SIZE))
        batch = batch.select(_occluded_density(target, observer, unit_density, batch) > 0)
        if len(batch):
            yield batch, batch.solid_angle * _occluded_density(target, observer, density, batch)


def _occluded_density(target: SurfaceTarget, observer: SurfaceObserver, density: Density, pieces: Pieces) -> np.ndarray:
    normals = target.mesh.normals[pieces.face]
    return occluded_density(
        target.geometry, observer, density, pieces.centroids, normals, target.falloff, target.settings
    )


def unoccluded_density(
    observer: SurfaceObserver, density: Density, points: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Return the gaze density (N,) of an observer at ``points`` (N, 3), along unit ``directions`` (N, 3), in 1/sr,
    without occlusion."""
    mi = variant_types()
    r_o, p_od = to_vector(mi.Vector3f, directions), to_vector(mi.Point3f, points)
    p_o = observer.center + dr.zeros(mi.Point3f, len(points))
    return _to_array(density(p_od, p_o, r_o, dr.full(mi.Bool, True, len(points))), len(points))


def cone_density(observer: SurfaceObserver, cone_sigma: float) -> Density:
    """Return the density of an observer, convolved with a cone; a standard deviation of 0 returns the density
    itself."""
    if cone_sigma == 0:
        return observer.density
    return lambda p_od, p_o, r_o, active: blur_density(observer.density_along, r_o, cone_sigma)


def _unoccluded_density(observer: SurfaceObserver, density: Density, pieces: Pieces) -> np.ndarray:
    middle = pieces.relative.mean(axis=1)
    return unoccluded_density(
        observer, density, pieces.centroids, middle / np.linalg.norm(middle, axis=1, keepdims=True)
    )


def occluded_density(
    geometry: SceneGeometry,
    observer: SurfaceObserver,
    density: Density,
    points: np.ndarray,
    normals: np.ndarray,
    falloff: float,
    settings: ObserverSettings,
    penetration: Float | float = 0.0,
) -> np.ndarray:
    """Return the gaze density (N,) of an observer at surface ``points`` with ``normals`` (N, 3), in 1/sr, after
    occlusion.

    ``penetration`` and ``falloff`` are as in `nerg_mi.environment.surface_attention`.
    """
    mi = variant_types()
    p_o, p = observer.center + dr.zeros(mi.Point3f, len(points)), to_vector(mi.Point3f, points)
    n = to_vector(mi.Vector3f, normals)
    return _to_array(
        attention_per_sr(geometry, density, p_o, p, n, falloff, settings, True, penetration=penetration), len(points)
    )


def unit_density(p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
    """Constant density of 1, whose value after occlusion is the visibility."""
    return type(r_o.x)(1)


def _to_array(values: Any, count: int) -> np.ndarray:
    """Convert kernel values to float64 (count,), also if they are a single constant."""
    return np.broadcast_to(np.array(values, np.float64), (count,))


def cone_density_along(observer: SurfaceObserver, cone_sigma: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of unit directions (N, 3) that evaluates the density of an observer, convolved with a cone."""
    mi = variant_types()
    along = (
        observer.density_along
        if cone_sigma == 0
        else lambda directions: blur_density(observer.density_along, directions, cone_sigma)
    )
    return lambda d: _to_array(along(to_vector(mi.Vector3f, d)), len(d))


def _opaque_point(position: np.ndarray) -> Point3f:
    mi = variant_types()
    center = mi.Point3f(np.asarray(position, np.float64).tolist())
    # A literal position would compile a new kernel for each observer.
    dr.make_opaque(center)
    return center
