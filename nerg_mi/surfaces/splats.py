"""Attention on Gaussian splats from observers and gaze samples, splat areas, and smoothing."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy import sparse

from nerg_mi.fields.splats import Splats, quaternions_to_matrices
from nerg_mi.maths.arrays import copy_aligned, to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.march_primal import DEFAULT_HITS_STOP
from nerg_mi.transport.medium import LastHit, LocalRay
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.splat_medium import MAX_ALPHA, SplatArrays, SplatHits

from .laplacian import SurfaceSums
from .sources import (
    MakeObserver,
    RaySettings,
    SurfaceObserver,
    TrackedRays,
    cone_density,
    cone_density_along,
    occluded_density,
    sample_cone,
    sphere_quadrature,
    unit_density,
    unoccluded_density,
)

# ---- Splat hits ----
#
# Gaussians on rays, in order, as NumPy arrays, so that sums are bitwise reproducible.
#
# A kernel that accumulates on the Gaussians would add in the order of its threads. Therefore kernels only find hits,
# some at a time as in the march (`nerg_mi.transport.march_primal`), and transmittance is accumulated in float64.


@dataclass(frozen=True, eq=False)
class HitGroup:
    """The next hits of M rays, nearest first, K at most.

    Parameters
    ----------
    rows
        Indices of the rays, (M,).
    index
        Gaussian of each hit in the order of the file, (M, K).
    transmittance
        Transmittance before each hit, (M, K).
    alpha
        Opacity of each hit, (M, K); 0 if there is no hit.
    remaining
        Transmittance after the last hit, (M,).
    has_escaped
        Whether the ray has no further hits, (M,).
    """

    rows: np.ndarray
    index: np.ndarray
    transmittance: np.ndarray
    alpha: np.ndarray
    remaining: np.ndarray
    has_escaped: np.ndarray


def iter_hit_groups(
    arrays: SplatArrays,
    origins: np.ndarray,
    directions: np.ndarray,
    max_distance: np.ndarray | None = None,
    min_transmittance: float = DEFAULT_HITS_STOP,
) -> Generator[HitGroup, np.ndarray | None, None]:
    """Yield the hits of rays with ``origins`` and unit ``directions`` (N, 3), in the frame of ``arrays``.

    Rays end at ``max_distance`` (N,) and when their transmittance falls to ``min_transmittance``. Use `send` to pass
    the rows of the last group that should continue.
    """
    hits = SplatHits(arrays)
    rows, ends = (
        np.arange(len(origins)),
        np.full(len(origins), np.inf) if max_distance is None else np.asarray(max_distance),
    )
    light, last, last_index = np.ones(len(origins)), np.full(len(origins), -1e-37), np.zeros(len(origins), np.int64)
    while len(rows):
        t, absorbed, index = _next_hits(
            hits, origins[rows], directions[rows], (last, last_index), ends[rows], light, min_transmittance
        )
        is_hit = np.isfinite(t)
        absorbed = np.where(is_hit, absorbed, 0.0)
        after = light[:, None] * np.cumprod(1 - absorbed, axis=1)
        arriving = np.concatenate([light[:, None], after[:, :-1]], axis=1)
        left = after[:, -1]
        is_active = is_hit[:, -1] & (left > min_transmittance)
        # A group also ends when the transmittance is too low.
        through = ~is_active & (left > min_transmittance)
        requested_rows = yield HitGroup(rows, np.where(is_hit, index, -1), arriving, absorbed, left, through)
        if requested_rows is not None:
            is_active &= np.isin(rows, requested_rows)
        rows, light, last, last_index = rows[is_active], left[is_active], t[is_active, -1], index[is_active, -1]


def _next_hits(hits, origins, directions, after, before, light, stop) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, opacity and index (M, K) of the next hits; distances are infinite without a hit."""
    mi = variant_types()
    o, d = to_vector(mi.Point3f, origins), to_vector(mi.Vector3f, directions)
    count = len(origins)
    to_float = lambda values: mi.Float(copy_aligned(values).ravel())
    ray = LocalRay(o, d, d, mi.Float(0), mi.Float(dr.inf))
    last = LastHit(to_float(after[0]), mi.UInt32(copy_aligned(after[1], np.uint32).ravel()))
    with dr.suspend_grad():
        hit_mask = hits.find_next(
            ray, last, to_float(before), to_float(light), dr.opaque(mi.Float, stop), dr.full(mi.Bool, True, count)
        )
        dr.eval(hit_mask.t, hit_mask.absorbed, hit_mask.index)
    stacked = lambda values, kind: np.stack([np.array(v).astype(kind) for v in values], axis=1)
    return (stacked(hit_mask.t, np.float64), stacked(hit_mask.absorbed, np.float64), stacked(hit_mask.index, np.int64))


# ---- Splat areas ----
#
# Effective area of each Gaussian, seen from either side.
#
# Parallel rays on a surface of Gaussians, with one ray per unit area, leave A_i = ∫ T_i α_i dA on each of them. These
# areas sum to the area of an opaque surface, for any overlap. With α_i = o_i exp(-r² / 2),
#
#     A_i = 2π σ_1 σ_2 o_i (1 - exp(-e² / 2)) E[T_i]
#
# with the two largest standard deviations, the cut-off e in units of them, and the mean transmittance over the profile
# of the Gaussian. The mean is estimated from a few rays around the shortest axis. They are tilted, since along the axis
# the order of Gaussians in one plane would be that of their indices. They start in front of the Gaussian by the
# tolerance with which a point behind a surface counts as visible, so that closer surfaces do not reduce the area.

RAYS_PER_SIDE = 8  # number of rays per side of a Gaussian
MIN_VISIBLE_FRACTION = 0.05  # minimum visible fraction of the area of a side
TILT = np.radians(25)  # tilt of the rays
_BATCH_SIZE = 1 << 17
# R2 sequence (plastic number): multiples fill a square uniformly.
_PLASTIC_STEPS = 0.7548776662466927, 0.5698402909980532
_GOLDEN = np.pi * (3 - np.sqrt(5))


def shortest_axes(splats: Splats) -> np.ndarray:
    """Return the unit shortest axis (N, 3) of each Gaussian, float64."""
    return np.take_along_axis(splats.axes(), splats.scales.argmin(axis=1)[:, None, None], axis=2)[..., 0]


def visible_sides(directions: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the side (N,) of Gaussians with shortest ``axes`` that is seen along ``directions`` (N, 3): 0 along the
    axis, 1 against it."""
    return (np.einsum("ij,ij->i", directions, axes) <= 0).astype(np.int64)


def unoccluded_areas(splats: Splats, extent: float) -> np.ndarray:
    """Return the areas (N,) of unoccluded Gaussians, in square scene units."""
    scales = np.sort(splats.scales.astype(np.float64), axis=1)
    opacity = np.minimum(splats.opacities.astype(np.float64), MAX_ALPHA)
    return 2 * np.pi * scales[:, 1] * scales[:, 2] * opacity * -np.expm1(-(extent**2) / 2)


def compute_splat_areas(splats: Splats, arrays: SplatArrays, tolerance: float) -> np.ndarray:
    """Return the areas (2, N) of both sides of ``splats``, in square scene units.

    ``arrays`` hold the same splats. ``tolerance``: distance behind a surface within which a point is not occluded by
    it.
    """
    lights = np.zeros((2, len(splats)))
    axes, sigma = splats.axes(), splats.scales.astype(np.float64)
    order = np.argsort(sigma, axis=1, kind="stable")
    take = lambda k: (
        np.take_along_axis(axes, order[:, k, None, None], axis=2)[..., 0],
        np.take_along_axis(sigma, order[:, k, None], axis=1),
    )
    (normal, thin), (first, a), (second, b) = (take(k) for k in range(3))
    radius = np.sqrt(-2 * np.log1p(-(np.arange(RAYS_PER_SIDE) + 0.5) / RAYS_PER_SIDE))
    turn = _GOLDEN * np.arange(RAYS_PER_SIDE)
    away = np.minimum(radius, arrays.extent) * np.array([np.cos(turn), np.sin(turn)])
    step = _BATCH_SIZE // RAYS_PER_SIDE
    for start in range(0, len(splats), step):
        part = slice(start, start + step)
        offset = (a * first)[part, None] * away[0][:, None] + (b * second)[part, None] * away[1][:, None]
        # Azimuths are independent of the positions, to avoid a systematic order in a plane.
        azimuth = (
            2
            * np.pi
            * np.modf(
                np.arange(len(splats))[part, None] * _PLASTIC_STEPS[0] + np.arange(RAYS_PER_SIDE) * _PLASTIC_STEPS[1]
            )[0]
        )
        tilt = np.sin(TILT) * np.stack([np.cos(azimuth), np.sin(azimuth)])[..., None]
        tangential = first[part, None] * tilt[0] + second[part, None] * tilt[1]
        # The peak of a tilted ray lies in the plane that is conjugate to it with respect to the covariance.
        peak_shift = (thin**2 / a)[part] * tilt[0, ..., 0] * away[0] + (thin**2 / b)[part] * tilt[1, ..., 0] * away[1]
        distance = (thin[part] + tolerance)[:, None] / np.cos(TILT)
        for side, sign in enumerate((1.0, -1.0)):
            d = sign * np.cos(TILT) * normal[part, None] + tangential
            peak = (
                splats.centers[part, None] + offset - sign * (peak_shift / np.cos(TILT))[..., None] * normal[part, None]
            )
            o = peak - distance * d
            light = _trace_light(arrays, o.reshape(-1, 3), d.reshape(-1, 3), np.repeat(distance, RAYS_PER_SIDE), start)
            lights[side, part] = light.reshape(-1, RAYS_PER_SIDE).mean(axis=1)
    return unoccluded_areas(splats, arrays.extent) * lights


def _trace_light(arrays: SplatArrays, o: np.ndarray, d: np.ndarray, distance: np.ndarray, start: int) -> np.ndarray:
    """Return the transmittance (R,) at the target Gaussian of each ray, `RAYS_PER_SIDE` rays per Gaussian from index
    ``start`` on.

    ``distance`` (R,) is the distance to the peak of the target.
    """
    target, light = start + np.arange(len(o)) // RAYS_PER_SIDE, np.zeros(len(o))
    # Extend slightly behind the peak, so that it is found.
    groups = iter_hit_groups(arrays, o, d, distance * 1.01 + 1e-5 * (np.abs(o).max(axis=1) + distance))
    try:
        group = next(groups)
        while True:
            is_target = group.index == target[group.rows, None]
            has_target = is_target.any(axis=1)
            light[group.rows[has_target]] = group.transmittance[has_target, is_target[has_target].argmax(axis=1)]
            group = groups.send(group.rows[~has_target])
    except StopIteration:
        return light


# ---- Gaze samples on splats ----
#
# A sample leaves on each Gaussian its contribution to an image, T_i α_i: the transmittance times the opacity.
# Contributions and the escaped part sum to one. They are assigned to one of the two sides of a Gaussian
# (`visible_sides`).
#
# Attention per area is this contribution divided by the area of the Gaussian (`compute_splat_areas`): a Gaussian of a
# surface with the ray density D receives D ∫ T_i α_i dA, whatever surrounds it.

NUM_DIRECTIONS = 1 << 14  # approximate number of directions for the total gaze of an observer
MAX_CASTS = 1 << 17  # maximum number of rays per launch, with about a dozen hits each


def sum_rays_on_splats(arrays: SplatArrays, axes: np.ndarray, rays: TrackedRays, settings: RaySettings) -> SurfaceSums:
    """Sum the attention of samples, in the frame of ``arrays``, on the Gaussians.

    Parameters
    ----------
    arrays
        Gaussians.
    axes
        Shortest axes, (N, 3).
    rays
        Gaze samples.
    settings
        Settings of the cones.

    Returns
    -------
    SurfaceSums
        The face sums (2 N,) are those of sides 0, then of sides 1; there are no vertex sums. The remaining
        transmittance where a march ends, at most 1e-4 of a ray, is unaccounted for. Random numbers depend on the seed
        and the index of the first sample only.
    """
    count = len(axes)
    rng = np.random.default_rng([settings.seed, rays.first_index])
    rays_per_sample, shares, escaped = settings.rays_per_sample, np.zeros(2 * count), 0.0
    step = max(1, MAX_CASTS // rays_per_sample)
    for a in range(0, len(rays), step):
        batch = rays.select(a, min(a + step, len(rays)))
        directions = sample_cone(batch.directions, settings.cone_sigma, rays_per_sample, rng).reshape(-1, 3)
        weights = np.repeat(batch.weights / rays_per_sample, rays_per_sample)
        for group in iter_hit_groups(arrays, np.repeat(batch.origins, rays_per_sample, axis=0), directions):
            ray, hit = np.nonzero(group.index >= 0)
            gaussian, rows = group.index[ray, hit], group.rows[ray]
            side = visible_sides(directions[rows], axes[gaussian])
            share = weights[rows] * group.transmittance[ray, hit] * group.alpha[ray, hit]
            shares += np.bincount(side * count + gaussian, share, 2 * count)
            escaped += float((weights[group.rows] * group.remaining)[group.has_escaped].sum())
    weight = float(rays.weights.sum())
    return SurfaceSums(shares, np.zeros(0), 0.0, escaped, weight, weight, len(rays))


def integrate_gaze(
    arrays: SplatArrays, observer: SurfaceObserver, position: np.ndarray, cone_sigma: float = 0.0
) -> tuple[float, float]:
    """Return the integral of an observer's gaze over the sphere, and the part that meets no Gaussian.

    The observer is at a position (3,) in the frame of ``arrays``; the cone is as in `GazeSumSettings`.
    """
    density = cone_density_along(observer, cone_sigma)
    with dr.suspend_grad():
        directions, angles = sphere_quadrature(density, NUM_DIRECTIONS)
        share, escaped = angles * density(directions), 0.0
        for group in iter_hit_groups(arrays, np.broadcast_to(position, directions.shape), directions):
            escaped += float((share[group.rows] * group.remaining)[group.has_escaped].sum())
    return float(share.sum()), escaped


# ---- Smoothing on splats ----
#
# Attention is exchanged between neighbouring sides of Gaussians, in n equal steps of the standard deviation e = s / √n,
# at least `MIN_STEP_FRACTION` of the typical spacing:
#
#     u'_i = u_i + Σ_j w_ij (u_j / A_j - u_i / A_i),    w_ij = K_ij A_i A_j / max(S_i, S_j),    S_i = Σ_k K_ik A_k,
#
# with the areas A and K_ij = exp(-|c_i - c_j|² / 2e²), a kernel integral (cf. Belkin, Sun, Wang 2009, "Constructing
# Laplace operator from point clouds in R^d"). Since w_ij = w_ji, the total is conserved and a constant density stays
# constant; since the row sums are at most A_i, amounts stay non-negative.
#
# K_ij is 0 unless both sides belong to one surface: they are at most `KERNEL_CUTOFF` e apart, face the same direction
# (`MIN_NORMAL_COSINE`), and each lies in the plane of the other, within `MAX_PLANE_SINE` of their distance and the
# visibility tolerance. Attention therefore does not cross wide gaps, thin boards or edges. Hidden sides keep their
# attention.
#
# Gaussians closer than half a step that face the same direction form one cell with a common density.

MIN_NORMAL_COSINE = np.cos(np.radians(30))  # minimum cosine between the normals of neighbours
MAX_PLANE_SINE = np.sin(np.radians(15))  # maximum sine of the angle of a neighbour to the plane
MAX_STEPS = 100  # maximum number of steps if kernels are fully covered
MAX_BORDER_STEPS = 400  # maximum number of steps if many Gaussians lie at borders
MIN_STEP_FRACTION = 0.7  # minimum standard deviation of a step, relative to the square root of a Gaussian's area
KERNEL_CUTOFF = 3.0  # cut-off of the kernel in standard deviations


class SplatSmoother:
    """Smooths attention on the sides of N Gaussians with standard deviation ``length`` along the surface.

    Lengths are in scene units. ``steps`` is the number of steps.

    Parameters
    ----------
    centers, axes
        Centres and shortest axes, (N, 3) each.
    areas
        Areas of the sides, (2, N), as from `compute_splat_areas`.
    hidden_area
        Area (N,) up to which a side counts as hidden.
    length
        Standard deviation of the smoothing.
    tolerance
        Distance between points that belong to one surface.
    """

    def __init__(
        self,
        centers: np.ndarray,
        axes: np.ndarray,
        areas: np.ndarray,
        hidden_area: np.ndarray,
        length: float,
        tolerance: float,
    ):
        if not (np.isfinite(length) and length > 0):
            raise ValueError(f"smoothing needs a positive length, got {length}")
        self._sides = np.flatnonzero((areas > hidden_area).ravel())
        count = len(axes)
        which, sign = self._sides % count, np.where(self._sides < count, -1.0, 1.0)
        area = areas.ravel()[self._sides]
        spacing = _weighted_median(np.sqrt(area), area) if len(area) else length
        step = min(max(MIN_STEP_FRACTION * spacing, length / np.sqrt(MAX_STEPS)), length)
        step = length / np.sqrt(max(1, np.floor((length / step) ** 2)))
        # Normals of surfaces, which point to where they are seen from.
        normals, positions = sign[:, None] * axes[which], np.asarray(centers, np.float64)[which]
        cells, self._cell = _make_cells(positions, normals, step / 2)
        self._area = np.bincount(self._cell, area, cells)
        mean = lambda rows: np.stack(
            [np.bincount(self._cell, area * c, cells).astype(np.float64) for c in rows.T], axis=1
        )
        cell_positions, normal = mean(positions) / self._area[:, None], mean(normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        self._share, self.steps = area / self._area[self._cell], 1
        i, j, square = _find_neighbours(cell_positions, normal, KERNEL_CUTOFF * step, tolerance)
        kernel = np.exp(-0.5 * square / step**2)
        row_sums = np.bincount(i, kernel * self._area[j], cells)
        weight = kernel * self._area[i] * self._area[j] / np.maximum(row_sums[i], row_sums[j])
        # The variance of one step is computed from its weights: with discrete cells and a cut-off kernel it is not
        # that of the Gaussian.
        variance = float((weight * square).sum() / 2 / self._area.sum()) if cells else 0.0
        stays = self._area - np.bincount(i, np.where(i == j, 0, weight), cells)
        flow = np.where(i == j, stays[i], weight) / self._area[j]
        self._flow = sparse.csr_array((flow, (i, j)), (cells, cells))
        if variance > 0:
            self.steps = min(max(1, round(length**2 / variance)), MAX_BORDER_STEPS)

    def __call__(self, amounts: np.ndarray) -> np.ndarray:
        """Smooth the amounts (2, N) on the sides; their sum is conserved."""
        out = np.array(amounts, np.float64)
        flat = out.reshape(-1)
        heat = np.bincount(self._cell, flat[self._sides], len(self._area))
        for _ in range(self.steps):
            heat = self._flow @ heat
        flat[self._sides] = heat[self._cell] * self._share
        return out


def _make_cells(positions: np.ndarray, normals: np.ndarray, size: float) -> tuple[int, np.ndarray]:
    """Return the number of cells of edge ``size`` and similar normals, and the cell of each row."""
    key = np.concatenate([np.floor(positions / size), np.rint(2 * normals)], axis=1).astype(np.int64)
    if not len(key):
        return 0, np.zeros(0, np.int64)
    order = np.lexsort(key.T)
    first = np.r_[True, (np.diff(key[order], axis=0) != 0).any(axis=1)]
    cell = np.empty(len(key), np.int64)
    cell[order] = np.cumsum(first) - 1
    return int(first.sum()), cell


def _find_neighbours(
    positions: np.ndarray, normal: np.ndarray, max_distance: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ``(i, j, squared distance)`` of neighbouring cells of one surface, in both orders and including each
    cell itself."""
    from scipy.spatial import KDTree

    index = np.arange(len(positions))
    if not len(positions):
        return index, index, np.zeros(0)
    pairs = KDTree(positions).query_pairs(max_distance, output_type="ndarray")
    i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    offset = positions[j] - positions[i]
    square = np.einsum("ij,ij->i", offset, offset)
    max_height = MAX_PLANE_SINE * np.sqrt(square) + tolerance
    in_plane = lambda k: np.abs(np.einsum("ij,ij->i", offset, normal[k])) <= max_height
    is_neighbour = (np.einsum("ij,ij->i", normal[i], normal[j]) >= MIN_NORMAL_COSINE) & in_plane(i) & in_plane(j)
    i, j, square = i[is_neighbour], j[is_neighbour], square[is_neighbour]
    return np.r_[i, j, index], np.r_[j, i, index], np.r_[square, square, np.zeros(len(index))]


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


# ---- Gaze of observers on splats ----
#
# A ray of direction ω meets a Gaussian with centre c and covariance Σ at its peak. For parallel rays the peaks form the
# plane through c with normal Σ⁻¹ω, so the Gaussian acts as a surface in that plane: a flat Gaussian as its disk, an
# isotropic one as a disk that faces the observer. From an observer at p_o with gaze density g(ω) in 1/sr it receives,
# per area,
#
#     g(ω) V(c, p_o) C(ω) / |c - p_o|²,    C(ω) = |Σ^{-1/2} ω| min σ,    ω = (c - p_o) / |c - p_o|
#
# This is the density of `nerg_mi.environment.surface_attention` at the centre, with the projected area relative to the
# largest one (C) in place of a cosine. V is the visibility of a point that lies before the centre by the thickness of
# the Gaussian. The densities can be rendered as colours: they are blended by transmittance.

BATCH_SIZE = 1 << 18  # number of Gaussians per launch


def splat_densities(
    splats: Splats,
    geometry: SceneGeometry,
    make_observer: MakeObserver,
    positions: np.ndarray,
    weights: np.ndarray,
    settings: ObserverSettings,
    cone_sigma: float = 0.0,
    falloff: float = 0.0,
) -> np.ndarray:
    """Return the gaze (2, N), float64, that each side of ``splats`` receives from weighted observers, per square scene
    unit.

    Within its own width of an observer, a Gaussian receives the value at that distance.

    Parameters
    ----------
    splats
        Gaussians.
    geometry
        Occluders, including the splats, in the frame of the splats.
    make_observer
        Creates the observer at a position.
    positions, weights
        Positions (M, 3) and weights (M,) of the observers.
    settings
        Settings of an observer's rays.
    cone_sigma
        Standard deviation of the gaze cone in radians.
    falloff
        Softness of occlusion boundaries.
    """
    out, index, axes = np.zeros((2, len(splats))), np.arange(len(splats)), shortest_axes(splats)
    with dr.suspend_grad():
        for eye, weight in zip(np.asarray(positions, np.float64), weights):
            density = float(weight) * _observer_density(
                splats, geometry, make_observer(eye), eye, settings, cone_sigma, falloff
            )
            out[visible_sides(splats.centers - eye, axes), index] += density
    return out


def _observer_density(
    splats: Splats,
    geometry: SceneGeometry,
    observer: SurfaceObserver,
    position: np.ndarray,
    settings: ObserverSettings,
    cone: float,
    falloff: float,
) -> np.ndarray:
    out = np.zeros(len(splats))
    for a in range(0, len(splats), BATCH_SIZE):
        part = slice(a, a + BATCH_SIZE)
        centers, scales = splats.centers[part].astype(np.float64), splats.scales[part].astype(np.float64)
        facing, normals, depth = _projected_profile(
            centers - position, quaternions_to_matrices(splats.rotations[part]), scales
        )
        half_thickness = variant_types().Float(copy_aligned(depth))
        visibility = occluded_density(
            geometry, observer, unit_density, centers, normals, falloff, settings, half_thickness
        )
        rows = np.flatnonzero(visibility > 0)
        # Most surfaces are occluded, and evaluating gaze is more expensive than tracing.
        if len(rows):
            to_centers = centers[rows] - position
            directions = to_centers / np.linalg.norm(to_centers, axis=1, keepdims=True)
            gaze = unoccluded_density(observer, cone_density(observer, cone), centers[rows], directions)
            out[a + rows] = visibility[rows] * facing[rows] * gaze
    return out


def _projected_profile(
    to_centers: np.ndarray, axes: np.ndarray, scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return C(ω) / distance² (N,), unit normals (N, 3) and the standard deviation along them (N,) of Gaussians at
    offsets (N, 3) from an observer."""
    distance = np.linalg.norm(to_centers, axis=1)
    w = to_centers / np.where(distance > 0, distance, 1)[:, None]
    local = np.einsum("nji,nj->ni", axes, w)
    min_scale, max_scale = scales.min(axis=1), scales.max(axis=1)
    # Relative to the smallest standard deviation, to avoid overflow for thin Gaussians.
    once = local * (min_scale[:, None] / scales)
    twice = once * (min_scale[:, None] / scales)
    area = np.linalg.norm(once, axis=1)
    length = np.linalg.norm(twice, axis=1)
    normal = twice / np.where(length > 0, length, 1)[:, None]
    depth = np.linalg.norm(normal * scales, axis=1)
    normals = -np.einsum("nij,nj->ni", axes, normal)
    distance_clamped = np.maximum(distance, max_scale)
    return np.where(length > 0, area / distance_clamped**2, 0.0), normals, depth
