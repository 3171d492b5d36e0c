"""Attention on Gaussian splats: from observers and from tracked rays, the area that each stands for, and smoothing."""

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
    after_occlusion,
    along_through,
    sample_cone,
    density_through,
    sphere_rule,
    unhidden,
    unit_density,
)

# ---- Splat hits ----
#
# The Gaussians that rays meet, hit by hit, as arrays of NumPy: sums of them are the same to the bit each time.
#
# A kernel that added to the Gaussians itself would add in whatever order its threads arrive. So it only finds hits,
# some at a time, as the march does (`nerg_mi.transport.march_primal`), and the light that is left is followed in
# float64.


@dataclass(frozen=True, eq=False)
class HitGroup:
    """The next hits of the rays numbered ``rows`` (M,), nearest first, K at most: ``index`` (M, K) of the Gaussians in
    the order of the file, ``arriving`` and ``absorbed`` (M, K), the light that reaches each and the share of it that it
    takes, which is 0 where there is no hit. ``left`` (M,): light behind the last; ``through`` (M,): nothing is met of
    it any more."""

    rows: np.ndarray
    index: np.ndarray
    arriving: np.ndarray
    alpha: np.ndarray
    remaining: np.ndarray
    through: np.ndarray


def groups_of_hits(
    arrays: SplatArrays,
    origins: np.ndarray,
    directions: np.ndarray,
    before: np.ndarray | None = None,
    stop: float = DEFAULT_HITS_STOP,
) -> Generator[HitGroup, np.ndarray | None, None]:
    """What rays with ``origins`` (N, 3) and unit ``directions`` (N, 3), in the frame of ``arrays``, meet of them.

    Up to the distances ``before`` (N,), everywhere without them, and until no more than ``stop`` of the light is left.
    Who has seen enough of a ray may `send` the rows that go on, a part of those of the last group.
    """
    hits, order = SplatHits(arrays), np.array(arrays.order).astype(np.int64)
    rows, ends = np.arange(len(origins)), np.full(len(origins), np.inf) if before is None else np.asarray(before)
    light, last, thing = np.ones(len(origins)), np.full(len(origins), -1e-37), np.zeros(len(origins), np.int64)
    while len(rows):
        t, absorbed, place = _next(hits, origins[rows], directions[rows], (last, thing), ends[rows], light, stop)
        met = np.isfinite(t)
        absorbed = np.where(met, absorbed, 0.0)
        after = light[:, None] * np.cumprod(1 - absorbed, axis=1)
        arriving = np.concatenate([light[:, None], after[:, :-1]], axis=1)
        left = after[:, -1]
        more = met[:, -1] & (left > stop)
        # A group is cut short where no light is left, too.
        through = ~more & (left > stop)
        index = np.where(met, order[np.where(met, place, 0)], -1)
        wanted = yield HitGroup(rows, index, arriving, absorbed, left, through)
        if wanted is not None:
            more &= np.isin(rows, wanted)
        rows, light, last, thing = rows[more], left[more], t[more, -1], place[more, -1]


def _next(hits, origins, directions, after, before, light, stop) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, share and place in the tree (M, K) of the next hits; distances are infinite where there are none."""
    mi = variant_types()
    o, d = to_vector(mi.Point3f, origins), to_vector(mi.Vector3f, directions)
    count = len(origins)
    given = lambda values: mi.Float(copy_aligned(values).ravel())
    ray = LocalRay(o, d, d, mi.Float(0), mi.Float(dr.inf))
    last = LastHit(given(after[0]), mi.UInt32(copy_aligned(after[1], np.uint32).ravel()))
    with dr.suspend_grad():
        found = hits.find_next(
            ray, last, given(before), given(light), dr.opaque(mi.Float, stop), dr.full(mi.Bool, True, count)
        )
        dr.eval(found.t, found.absorbed, found.index)
    stacked = lambda values, kind: np.stack([np.array(v).astype(kind) for v in values], axis=1)
    return stacked(found.t, np.float64), stacked(found.absorbed, np.float64), stacked(found.index, np.int64)


# ---- The area that each Gaussian takes of the surface it is a part of, seen from either of its sides ----
#
# Parallel rays that fall on a surface of Gaussians, one to a unit of area, leave A_i = ∫ T_i α_i dA on each of them:
# areas that add up to the surface's where it is opaque, however many overlap. With α_i = o_i exp(-r² / 2) that is
#
#     A_i = 2π σ_1 σ_2 o_i (1 - exp(-e² / 2)) E[T_i]
#
# for the two longest standard deviations, the cut-off at e of them, and the mean of the light that reaches the Gaussian
# over its own profile, which a few rays around the shortest axis tell: not along it, for the order of Gaussians in one
# plane would then be that of their numbers. They start as far before it as a point may lie
# behind a surface and still be seen: a place that stands before it hides it, and takes nothing of its area.

RAYS_PER_SIDE = 8  # to a side of a Gaussian
MIN_VISIBLE_FRACTION = 0.05  # of its whole area: a side of which less is seen counts as hidden
TILT = np.radians(25)  # of the rays
_BATCH = 1 << 17
# Multiples of both together fill a square evenly (the plastic number).
_SPREAD = 0.7548776662466927, 0.5698402909980532
_GOLDEN = np.pi * (3 - np.sqrt(5))


def shortest_axes(splats: Splats) -> np.ndarray:
    """The unit shortest axis (N, 3) of each Gaussian, float64."""
    return np.take_along_axis(splats.axes(), splats.scales.argmin(axis=1)[:, None, None], axis=2)[..., 0]


def sides_of(directions: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Which side (N,) of Gaussians with the shortest ``axes`` is seen along ``directions`` (N, 3 each): 0 along the
    axis, 1 against it."""
    return (np.einsum("ij,ij->i", directions, axes) <= 0).astype(np.int64)


def unoccluded_areas(splats: Splats, extent: float) -> np.ndarray:
    """Areas (N,) of Gaussians that nothing hides, in square scene units."""
    scales = np.sort(splats.scales.astype(np.float64), axis=1)
    opacity = np.minimum(splats.opacities.astype(np.float64), MAX_ALPHA)
    return 2 * np.pi * scales[:, 1] * scales[:, 2] * opacity * -np.expm1(-(extent**2) / 2)


def compute_splat_areas(splats: Splats, arrays: SplatArrays, tolerance: float) -> np.ndarray:
    """Areas (2, N) in square scene units of the sides (`sides_of`) of ``splats``, which ``arrays`` hold. ``tolerance``:
    how far a point may lie behind a surface that is not hidden by it."""
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
    step = _BATCH // RAYS_PER_SIDE
    for start in range(0, len(splats), step):
        part = slice(start, start + step)
        on = (a * first)[part, None] * away[0][:, None] + (b * second)[part, None] * away[1][:, None]
        # Which way each leans has nothing to do with where its point lies, or all of a plane would come too early.
        lean = 2 * np.pi * np.modf(np.arange(len(splats))[part, None] * _SPREAD[0] + np.arange(RAYS_PER_SIDE) * _SPREAD[1])[0]
        tilt = np.sin(TILT) * np.stack([np.cos(lean), np.sin(lean)])[..., None]
        aside = first[part, None] * tilt[0] + second[part, None] * tilt[1]
        # Where the peaks of rays lie that lean so: in the plane that the Gaussian's own measure calls upright to them.
        over = (thin**2 / a)[part] * tilt[0, ..., 0] * away[0] + (thin**2 / b)[part] * tilt[1, ..., 0] * away[1]
        before = (thin[part] + tolerance)[:, None] / np.cos(TILT)
        for side, sign in enumerate((1.0, -1.0)):
            d = sign * np.cos(TILT) * normal[part, None] + aside
            peak = splats.centers[part, None] + on - sign * (over / np.cos(TILT))[..., None] * normal[part, None]
            o = peak - before * d
            found = _light(arrays, o.reshape(-1, 3), d.reshape(-1, 3), np.repeat(before, RAYS_PER_SIDE), start)
            lights[side, part] = found.reshape(-1, RAYS_PER_SIDE).mean(axis=1)
    return unoccluded_areas(splats, arrays.extent) * lights


def _light(arrays: SplatArrays, o: np.ndarray, d: np.ndarray, distance: np.ndarray, start: int) -> np.ndarray:
    """Light (R,) that reaches, along each ray, the Gaussian that it is aimed at: `RAYS` to each, from number ``start``
    on, whose peaks lie at ``distance`` (R,)."""
    own, found = start + np.arange(len(o)) // RAYS_PER_SIDE, np.zeros(len(o))
    # A little behind the peak, which is found once more.
    groups = groups_of_hits(arrays, o, d, distance * 1.01 + 1e-5 * (np.abs(o).max(axis=1) + distance))
    try:
        group = next(groups)
        while True:
            met = group.index == own[group.rows, None]
            here = met.any(axis=1)
            found[group.rows[here]] = group.arriving[here, met[here].argmax(axis=1)]
            group = groups.send(group.rows[~here])
    except StopIteration:
        return found


# ---- What tracked rays leave on Gaussian splats, and how much gaze meets none ----
#
# A ray leaves on each Gaussian that it meets what it would contribute to a picture, T_i α_i: the light that reaches it
# times the share that it takes. All of them and what goes through add up to one. It comes to one of the two sides of
# the Gaussian (`splats.sides_of`).
#
# Gaze per area is that share by the area that a Gaussian takes of what is seen (`splat_areas`): of rays that fall on a
# surface with the density D, a Gaussian receives D ∫ T_i α_i dA, whatever else is around.

NUM_DIRECTIONS = 1 << 14  # in which an observer's gaze is looked at, about
CASTS = 1 << 17  # rays that are cast in one launch: each brings a dozen hits


def sum_rays_on_splats(arrays: SplatArrays, axes: np.ndarray, rays: TrackedRays, settings: RaySettings) -> SurfaceSums:
    """What ``rays``, in the frame of ``arrays``, leave on the Gaussians: partial sums, whose ``face`` (2 N,) are the
    shares on their sides 0, then on their sides 1, and whose ``vertex`` is empty.

    ``axes`` (N, 3): their shortest axes. ``escaped`` is the light that meets nothing more; what is left where a march
    ends is unaccounted for: 1e-4 of a ray at most. The draws depend on the seed and on ``rays.first`` alone.
    """
    count = len(axes)
    rng = np.random.default_rng([settings.seed, rays.first_index])
    each, shares, escaped = settings.casts, np.zeros(2 * count), 0.0
    step = max(1, CASTS // each)
    for a in range(0, len(rays), step):
        some = rays.select(a, min(a + step, len(rays)))
        directions = sample_cone(some.directions, settings.cone_sigma, each, rng).reshape(-1, 3)
        weights = np.repeat(some.weights / each, each)
        for group in groups_of_hits(arrays, np.repeat(some.origins, each, axis=0), directions):
            ray, hit = np.nonzero(group.index >= 0)
            thing, rows = group.index[ray, hit], group.rows[ray]
            side = sides_of(directions[rows], axes[thing])
            share = weights[rows] * group.arriving[ray, hit] * group.alpha[ray, hit]
            shares += np.bincount(side * count + thing, share, 2 * count)
            escaped += float((weights[group.rows] * group.remaining)[group.through].sum())
    weight = float(rays.weights.sum())
    return SurfaceSums(shares, np.zeros(0), 0.0, escaped, weight, weight, len(rays))


def integrate_gaze(
    arrays: SplatArrays, observer: SurfaceObserver, position: np.ndarray, cone: float = 0.0
) -> tuple[float, float]:
    """What the gaze of ``looker``, an observer at ``eye`` (3,) in the frame of ``arrays``, adds up to over the sphere,
    and how much of it meets no Gaussian: what comes through, as of rays. ``cone``: as of `sources.GazeSumSettings`.
    """
    density = along_through(observer, cone)
    with dr.suspend_grad():
        directions, angles = sphere_rule(density, NUM_DIRECTIONS)
        share, escaped = angles * density(directions), 0.0
        for group in groups_of_hits(arrays, np.broadcast_to(position, directions.shape), directions):
            escaped += float((share[group.rows] * group.remaining)[group.through].sum())
    return float(share.sum()), escaped


# ---- Splat smoothing ----
#
# Smoothing of attention along the surfaces of Gaussian splats: from neighbour to neighbour, never through the air.
#
# Gaussians have no edges that heat could flow over (`smoothing`). What lies on a side of one of them moves in n equal
# steps of the standard deviation e = s / √n, no less than `CLOSE` of what Gaussians are usually apart, to sides near
# it:
#
#     u'_i = u_i + Σ_j w_ij (u_j / A_j - u_i / A_i),    w_ij = K_ij A_i A_j / max(S_i, S_j),    S_i = Σ_k K_ik A_k,
#
# with their areas A and K_ij = exp(-|c_i - c_j|² / 2e²): an integral with that kernel over what is there (cf. Belkin,
# Sun, Wang 2009, "Constructing Laplace operator from point clouds in R^d"). Since w_ij = w_ji, nothing is lost and a
# density that is the same everywhere stays so; since its sums are A_i at most, no amount becomes negative.
#
# K_ij is 0 unless both are sides of one surface: they are no farther than 3 e apart, face the same way (`FACING`), and
# each lies in the other's plane, to `RISE` of their distance and to the tolerance with which a point counts as seen. So
# nothing comes through a gap that is wider than 3 e sin `RISE` and the tolerance, and neither from one face of a board
# to the other nor around an edge. Sides that are hidden, and what is on them, stay as they are.
#
# Gaussians closer than half a step, which face the same way, are one cell, whose density all of them have.

FACING = np.cos(np.radians(30))  # cosine between the normals of neighbours at least
RISE = np.sin(np.radians(15))  # sine of the angle at which a neighbour may lie out of the plane
MAX_STEPS = 100  # steps at most, where all of a kernel's reach is covered
MAX_BORDER_STEPS = 400  # steps at most, where many Gaussians lie at borders
CLOSE = 0.7  # standard deviation of a step at least, as a share of the edge of a square of a Gaussian's area
REACH = 3.0  # standard deviations of a step after which it is cut off


class SplatSmoother:
    """Smoothing by ``length``, the standard deviation s along the surface, of what lies on sides of N Gaussians.

    They have ``centers`` and shortest ``axes`` (N, 3); the ``areas`` (2, N) of their sides (`splat_areas`), of which
    those are hidden that are no larger than ``hidden`` (N,). ``tolerance``: how far apart two ideas of one surface may
    be. All in scene units. ``steps``: that are taken."""

    def __init__(
        self,
        centers: np.ndarray,
        axes: np.ndarray,
        areas: np.ndarray,
        hidden: np.ndarray,
        length: float,
        tolerance: float,
    ):
        if not (np.isfinite(length) and length > 0):
            raise ValueError(f"smoothing needs a positive length, got {length}")
        self._sides = np.flatnonzero((areas > hidden).ravel())
        count = len(axes)
        which, sign = self._sides % count, np.where(self._sides < count, -1.0, 1.0)
        area = areas.ravel()[self._sides]
        apart = _weighted_median(np.sqrt(area), area) if len(area) else length
        step = min(max(CLOSE * apart, length / np.sqrt(MAX_STEPS)), length)
        step = length / np.sqrt(max(1, np.floor((length / step) ** 2)))
        # Normals of surfaces, which point to where they are seen from.
        normals, places = sign[:, None] * axes[which], np.asarray(centers, np.float64)[which]
        cells, self._cell = _cells(places, normals, step / 2)
        self._area = np.bincount(self._cell, area, cells)
        mean = lambda rows: np.stack(
            [np.bincount(self._cell, area * c, cells).astype(np.float64) for c in rows.T], axis=1
        )
        place, normal = mean(places) / self._area[:, None], mean(normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        self._share, self.steps = area / self._area[self._cell], 1
        i, j, square = _neighbours(place, normal, REACH * step, tolerance)
        kernel = np.exp(-0.5 * square / step**2)
        near = np.bincount(i, kernel * self._area[j], cells)
        weight = kernel * self._area[i] * self._area[j] / np.maximum(near[i], near[j])
        # By a step's own variance, for cells are apart, and the kernel is cut off.
        variance = float((weight * square).sum() / 2 / self._area.sum()) if cells else 0.0
        stays = self._area - np.bincount(i, np.where(i == j, 0, weight), cells)
        flow = np.where(i == j, stays[i], weight) / self._area[j]
        self._flow = sparse.csr_array((flow, (i, j)), (cells, cells))
        if variance > 0:
            self.steps = min(max(1, round(length**2 / variance)), MAX_BORDER_STEPS)

    def __call__(self, amounts: np.ndarray) -> np.ndarray:
        """The amounts (2, N) on the sides after smoothing; their sum stays."""
        out = np.array(amounts, np.float64)
        flat = out.reshape(-1)
        heat = np.bincount(self._cell, flat[self._sides], len(self._area))
        for _ in range(self.steps):
            heat = self._flow @ heat
        flat[self._sides] = heat[self._cell] * self._share
        return out


def _cells(places: np.ndarray, normals: np.ndarray, size: float) -> tuple[int, np.ndarray]:
    """How many cells of the edge ``size`` and of alike normals there are, and the number of each row's."""
    key = np.concatenate([np.floor(places / size), np.rint(2 * normals)], axis=1).astype(np.int64)
    if not len(key):
        return 0, np.zeros(0, np.int64)
    order = np.lexsort(key.T)
    first = np.r_[True, (np.diff(key[order], axis=0) != 0).any(axis=1)]
    found = np.empty(len(key), np.int64)
    found[order] = np.cumsum(first) - 1
    return int(first.sum()), found


def _neighbours(
    place: np.ndarray, normal: np.ndarray, reach: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(i, j, square of the distance)`` of cells of one surface, in both orders, each with itself too."""
    from scipy.spatial import KDTree

    own = np.arange(len(place))
    if not len(place):
        return own, own, np.zeros(0)
    pairs = KDTree(place).query_pairs(reach, output_type="ndarray")
    i, j = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    apart = place[j] - place[i]
    square = np.einsum("ij,ij->i", apart, apart)
    most = RISE * np.sqrt(square) + tolerance
    level = lambda k: np.abs(np.einsum("ij,ij->i", apart, normal[k])) <= most
    alike = (np.einsum("ij,ij->i", normal[i], normal[j]) >= FACING) & level(i) & level(j)
    i, j, square = i[alike], j[alike], square[alike]
    return np.r_[i, j, own], np.r_[j, i, own], np.r_[square, square, np.zeros(len(own))]


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


# ---- Splats ----
#
# What the gaze of observers leaves on Gaussian splats, after occlusion: a density per area for each of them.
#
# Rays of direction ω meet a Gaussian with centre c and covariance Σ where they are nearest to c by its own measure,
# which for parallel rays is the plane through c with the normal Σ⁻¹ω: as seen from there, the Gaussian is a surface in
# that plane. A flat one is its own disk from wherever it is seen, a ball a disk that faces the observer. Of an observer
# at p_o who looks with the density g(ω), in 1/sr, it receives
#
#     g(ω) V(c, p_o) C(ω) / |c - p_o|²,    C(ω) = |Σ^{-1/2} ω| min σ,    ω = (c - p_o) / |c - p_o|,
#
# per area: the density of `nerg_mi.probes.surface_attention` at the centre, with the area under which the Gaussian is
# seen, as a share of the largest under which it can be seen (C), in place of a cosine. V is the visibility of
# `nerg_mi.probes.surface_attention.attended`, of a point that lies before the centre by the thickness of the Gaussian
# too. Such densities are colours: rendered in place of them, they mix by the light that reaches the eye.

BATCH_SIZE = 1 << 18  # Gaussians in one launch


def splat_densities(
    splats: Splats,
    geometry: SceneGeometry,
    make_observer: MakeObserver,
    eyes: np.ndarray,
    weights: np.ndarray,
    settings: ObserverSettings,
    cone: float = 0.0,
    falloff: float = 0.0,
) -> np.ndarray:
    """Gaze (2, N), float64, that each side of ``splats`` receives per square scene unit from observers at ``eyes``
    (M, 3) who count by ``weights`` (M,): a sum over them. Sides are those of `splats.sides_of`.

    ``place``: what hides, the splats themselves among it, in their frame, traced with ``settings``; ``cone``: standard
    deviation in radian of the cone that gaze is seen through, ``falloff`` as of the integrator. From within its own
    width a Gaussian receives what it does from as far as it is wide.
    """
    out, every, axes = np.zeros((2, len(splats))), np.arange(len(splats)), shortest_axes(splats)
    with dr.suspend_grad():
        for eye, weight in zip(np.asarray(eyes, np.float64), weights):
            found = float(weight) * _of_one(splats, geometry, make_observer(eye), eye, settings, cone, falloff)
            out[sides_of(splats.centers - eye, axes), every] += found
    return out


def _of_one(
    splats: Splats,
    place: SceneGeometry,
    looker: SurfaceObserver,
    eye: np.ndarray,
    settings: ObserverSettings,
    cone: float,
    falloff: float,
) -> np.ndarray:
    out = np.zeros(len(splats))
    for a in range(0, len(splats), BATCH_SIZE):
        part = slice(a, a + BATCH_SIZE)
        centers, scales = splats.centers[part].astype(np.float64), splats.scales[part].astype(np.float64)
        facing, normals, depth = _facing(centers - eye, quaternions_to_matrices(splats.rotations[part]), scales)
        before = variant_types().Float(copy_aligned(depth))
        seen = after_occlusion(place, looker, unit_density, centers, normals, falloff, settings, before)
        rows = np.flatnonzero(seen > 0)
        # Most of a place is hidden from wherever one stands, and gaze costs more than rays.
        if len(rows):
            to = centers[rows] - eye
            directions = to / np.linalg.norm(to, axis=1, keepdims=True)
            gaze = unhidden(looker, density_through(looker, cone), centers[rows], directions)
            out[a + rows] = seen[rows] * facing[rows] * gaze
    return out


def _facing(to: np.ndarray, axes: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(C(ω) / distance² (N,), the unit normals (N, 3) of what is seen, and its standard deviation along them (N,))``
    of Gaussians that lie ``to`` (N, 3) of an eye."""
    distance = np.linalg.norm(to, axis=1)
    w = to / np.where(distance > 0, distance, 1)[:, None]
    own = np.einsum("nji,nj->ni", axes, w)
    least, widest = scales.min(axis=1), scales.max(axis=1)
    # In units of the least deviation, so that squares of thin ones stay finite.
    once = own * (least[:, None] / scales)
    twice = once * (least[:, None] / scales)
    area = np.linalg.norm(once, axis=1)
    length = np.linalg.norm(twice, axis=1)
    across = twice / np.where(length > 0, length, 1)[:, None]
    depth = np.linalg.norm(across * scales, axis=1)
    normals = -np.einsum("nij,nj->ni", axes, across)
    near = np.maximum(distance, widest)
    return np.where(length > 0, area / near**2, 0.0), normals, depth
