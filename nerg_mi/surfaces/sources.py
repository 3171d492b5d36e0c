"""What leaves attention on a surface: the gaze of observers and tracked rays, each as a cone, with the quadrature
over the sphere and over faces."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import Float, Point3f, Vector3f, variant_types
from nerg_mi.maths.vmf import tangent_frame
from nerg_mi.probes.surface_attention import Density, attention_per_sr
from nerg_mi.rays.filters import find_sessions
from nerg_mi.rays.rays import Rays
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import ObserverCache, ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance

from .laplacian import SurfaceSums, deposit, merge_sums
from .mesh import Mesh, SurfaceTarget

# ---- Cones ----
#
# Gaze as a cone in place of a line: trackers err by about a degree, and the fovea sees two.
#
# A cone is a Gaussian of the angles to both sides of the line of sight, of standard deviation σ each. Of a density over
# directions it is the convolution by a rule of seven directions that is exact to the fifth degree in the tangent plane
# (A. H. Stroud, D. Secrest, "Approximate integration formulas for certain spherically symmetric regions", 1963, for the
# weight exp(-r²)): half in the middle, a twelfth in each of six at 2σ around it. It turns a spherical harmonic of
# degree l into itself times (1 + P_l(cos 2σ)) / 2, and so keeps the integral over the sphere. Of a ray, which is a
# point among directions, it is a bundle of rays, each of which ends at what it meets itself.

RING = 6  # directions around the middle one
_GOLDEN = np.pi * (3 - np.sqrt(5))


def blur_density(density: Callable[[Vector3f], Any], directions: Vector3f, sigma: float) -> Any:
    """``density`` along ``directions`` (unit, a lane each), seen through a cone of ``sigma`` radian."""
    import drjit as dr

    mi = variant_types()
    side, up = mi.coordinate_system(directions)
    found = 0.5 * density(directions)
    sin, cos = dr.sincos(mi.Float(2 * sigma))
    for k in range(RING):
        turn = 2 * math.pi * k / RING
        found += density(cos * directions + sin * (math.cos(turn) * side + math.sin(turn) * up)) / (2 * RING)
    return found


def sample_cone(directions: np.ndarray, sigma: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` unit directions (N, count, 3) of equal weight in a cone of ``sigma`` radian around each of
    ``directions`` (N, 3).

    Their angles from the middle are one in each of as many shells of equal weight, their turns steps of the golden
    angle from one that is drawn: bundles are spread evenly, and all of them together without any pattern.
    """
    n = len(directions)
    if sigma == 0:
        return np.repeat(directions[:, None], count, axis=1)
    shell = (np.arange(count) + rng.random((n, 1))) / count
    # The angle of a Gaussian of two dimensions is Rayleigh's.
    angle = np.minimum(sigma * np.sqrt(-2 * np.log1p(-shell)), np.pi)
    turn = 2 * np.pi * rng.random((n, 1)) + _GOLDEN * np.arange(count)
    side, up = tangent_frame(directions)
    around = np.cos(turn)[..., None] * side[:, None] + np.sin(turn)[..., None] * up[:, None]
    out = np.cos(angle)[..., None] * directions[:, None] + np.sin(angle)[..., None] * around
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


# ---- Pieces of faces that are small as an observer sees them, with their exact solid angles ----
#
# A face is cut into four congruent ones until each is seen under a small angle, however near the observer stands:
# pieces are many where they are near, and about as many in all wherever that is, since the sphere around an observer
# has room for so many of them only. The solid angle of a triangle is that of A. van Oosterom and J. Strackee, "The
# Solid Angle of a Plane Triangle" (1983); no Jacobian has to be evaluated where it is steep.

MAX_LEVELS = 40  # a face is cut in four so many times at most: to 10^-12 of its size
MOST_PIECES = 1 << 25  # pieces of a mesh at most, as one observer sees it: five gigabytes


@dataclass(frozen=True, eq=False)
class Pieces:
    """Parts of faces as ``eye`` (3,) sees them: ``face`` (P,) that each lies in; ``cut`` (P, 3, 3), of each of its
    corners the barycentric coordinates there; ``relative`` (P, 3, 3), its corners from the eye in scene units."""

    observer: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    relative: np.ndarray

    def __len__(self) -> int:
        return len(self.face)

    @property
    def centroid_barycentric(self) -> np.ndarray:
        """Barycentric coordinates (P, 3) of the centroids."""
        return self.barycentric.mean(axis=1)

    @property
    def centroids(self) -> np.ndarray:
        """Centroids (P, 3) in the scene."""
        return self.relative.mean(axis=1) + self.observer

    @cached_property
    def solid_angle(self) -> np.ndarray:
        """Solid angles (P,) under which the eye sees them, in steradian."""
        return solid_angles(self.relative)

    def select(self, rows: np.ndarray | slice) -> Pieces:
        """Those numbered, or marked, by ``rows``."""
        return Pieces(self.observer, self.face[rows], self.barycentric[rows], self.relative[rows])

    def quartered(self) -> Pieces:
        """Each cut into four congruent ones, one after the other."""
        return Pieces(self.observer, np.repeat(self.face, 4), _quarters(self.barycentric), _quarters(self.relative))


def pieces_of(mesh: Mesh, eye: np.ndarray, angle: float, faces: slice = slice(None)) -> Pieces:
    """The ``faces`` of ``mesh``, cut into pieces none of whose edges is seen from ``eye`` (3,) under more than about
    ``angle`` (radian).

    An edge counts as seen from the nearest point of the ball around its piece; a piece that holds the eye itself is cut
    `LEVELS` times. Raises `NergError` for more than `MOST_PIECES` pieces.
    """
    relative = mesh.corners[faces] - eye
    number = np.arange(len(mesh.faces))[faces]
    left = Pieces(eye, number, np.broadcast_to(np.eye(3), (len(number), 3, 3)), relative)
    found: list[Pieces] = []
    for level in range(MAX_LEVELS + 1):
        here = left.relative
        middle = here.mean(axis=1)
        radius = np.sqrt(_square(here - middle[:, None]).max(axis=1))
        edge = np.sqrt(_square(here - here[:, [2, 0, 1]]).max(axis=1))
        # Not "<=": what is not finite is cut no further.
        small = ~(edge > angle * np.maximum(np.sqrt(_square(middle)) - radius, 0))
        if level == MAX_LEVELS:
            small[:] = True
        found.append(left.select(small))
        if small.all():
            break
        if sum(map(len, found)) + 4 * np.count_nonzero(~small) > MOST_PIECES:
            raise NergError(
                f"the observer at {','.join(f'{v:g}' for v in eye)} sees the surfaces in more than "
                f"{MOST_PIECES:,} pieces of "
                f"{np.degrees(angle):g} degrees; give a larger --angle"
            )
        left = left.select(~small).quartered()
    joined = (np.concatenate([getattr(part, name) for part in found]) for name in ("face", "cut", "relative"))
    return Pieces(eye, *joined)


def _square(v: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", v, v)


def _quarters(corners: np.ndarray) -> np.ndarray:
    """Corners (4 P, 3, 3) of the quarters of triangles (P, 3, 3)."""
    middle = 0.5 * (corners + corners[:, [1, 2, 0]])
    (a, b, c), (ab, bc, ca) = (np.moveaxis(v, 1, 0) for v in (corners, middle))
    out = np.empty((len(corners), 4, 3, 3))
    for k, three in enumerate(((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))):
        for n, corner in enumerate(three):
            out[:, k, n] = corner
    return out.reshape(-1, 3, 3)


def solid_angles(corners: np.ndarray) -> np.ndarray:
    """Solid angle (P,), in steradian, of triangles (P, 3, 3) seen from the origin, from either side.

    Of one in whose plane the origin lies it is 0, also where it lies in the triangle.
    """
    a, b, c = (corners[:, k] for k in range(3))
    # The ratio is free of the scale, and products of tiny lengths are not.
    unit = np.abs(corners).max(axis=(1, 2))
    scale = np.where(unit > 0, unit, 1)[:, None]
    a, b, c = a / scale, b / scale, c / scale
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dot = lambda u, v: np.einsum("ij,ij->i", u, v)
    # Of differences: corners that are far away compared with their distance from each other lose no digits.
    volume = np.abs(dot(a, np.cross(b - a, c - a)))
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.where(volume > 0, 2 * np.arctan2(volume, below), 0.0)


# ---- Outlines ----
#
# What of a surface is seen, cut where the outline of something passes: pieces that are seen in part are cut again.
#
# A piece is looked at in four points and at its corners. Where all of it is hidden it ends there; where it is seen in
# part, and carries more of the gaze than `MIXED`, it is cut in four. Without this an outline that runs along the cuts
# of a face, as those of shelves on walls do, falls between the same two rows of pieces everywhere, and loses up to a
# third of a piece along all its length; halving the pieces keeps the cuts parallel to it, and the loss often as large.

MIXED = 1e-6  # of all gaze, what a piece may have at most that is seen in part

WHOLE = 2e-5
"""Of all gaze, what a piece may have at most: densities narrower than a piece is are integrated too."""

CUTS = 12  # a piece is cut so many times at most

# Four points spread over a piece tell which share of it is seen. Its corners tell whether an outline passes, and
# nothing else: those of a hidden side reach into sight wherever it meets an edge that is seen. They are looked at a
# little within, for a ray at the very edge of a face may meet its neighbour.
_WITHIN = 1e-3
_SPREAD = np.vstack([np.full((1, 3), 1 / 3), 1 / 6 + 0.5 * np.eye(3)])
_LOOKED_AT = np.vstack([_SPREAD, _WITHIN + (1 - 3 * _WITHIN) * np.eye(3)])


def visible_pieces(
    target: SurfaceTarget, pieces: Pieces, density: Callable[[Pieces], np.ndarray], total: float, batch: int
) -> Iterator[tuple[Pieces, np.ndarray]]:
    """``pieces`` that are seen, cut where outlines pass, with the gaze (P,) that each receives.

    ``density`` of pieces, in 1/sr, what hides them left out; ``total``: all gaze, which limits are shares of;
    ``batch``: pieces that are looked at together. The target is `sharp`.
    """
    for a in range(0, len(pieces), batch):
        left = pieces.select(slice(a, a + batch))
        for level in range(CUTS + 1):
            seen = _seen(target, left)
            rows = np.flatnonzero(seen.any(axis=1))
            left, seen = left.select(rows), seen[rows]
            if not len(left):
                break
            whole = left.solid_angle * density(left)
            most = np.where(seen.all(axis=1), WHOLE, MIXED) * total
            cut = (whole > most) & (level < CUTS)
            yield left.part(~cut), (whole * seen[:, : len(_SPREAD)].mean(axis=1))[~cut]
            if not cut.any():
                break
            left = left.part(cut).quartered()


def _seen(target: SurfaceTarget, pieces: Pieces) -> np.ndarray:
    """Whether each of the points (P, 7) is seen at which pieces are looked at."""
    points = np.matmul(_LOOKED_AT, pieces.relative) + pieces.observer
    count = len(_LOOKED_AT)
    return target.is_visible(pieces.observer, points.reshape(-1, 3), np.repeat(pieces.face, count)).reshape(-1, count)


# ---- Population ----
#
# Where people were, by how long: the time of each tracked ray, and a few observers that stand for all of them.

MAX_GAP = 0.5  # seconds that a ray stands for at most: nobody knows where people were while they were not tracked

WEIGHTINGS = ("time", "person", "equal")
"""Whom rays count by: each by its time; so that all people count alike; each alike."""

_CELLS = 4096
_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class WeightedObservers:
    """Observers at ``positions`` (M, 3), places where somebody was, with ``weights`` (M,) that add up to one. ``mean``
    and ``farthest``: distance from there of where people were, the root of its mean square and 95 % of it."""

    positions: np.ndarray
    weights: np.ndarray
    rms_distance: float = 0.0
    p95_distance: float = 0.0


def ray_durations(rays: Rays, gap: float = MAX_GAP) -> np.ndarray:
    """Seconds (N,) that each ray stands for: until the next one of the same person and recording, and ``gap`` at most;
    of the last of a recording the median of the others in it."""
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    out = np.zeros(len(rays))
    for a, b in zip(sessions.starts[:-1], sessions.starts[1:]):
        rows = order[a:b]
        step = np.clip(np.diff(rays.t[rows]), 0, gap)
        out[rows] = np.r_[step, np.median(step) if len(step) else 0.0]
    # One ray alone, or many at one time, tell no length.
    return out if out.sum() > 0 else np.full(len(rays), gap)


def ray_weights(rays: Rays, by: str, gap: float = MAX_GAP) -> np.ndarray:
    """Weights (N,) of ``rays`` that add up to one, by one of `WEIGHTS`."""
    seconds = np.ones(len(rays)) if by == "equal" else ray_durations(rays, gap)
    if by == "person":
        each = np.bincount(rays.person, seconds)
        seconds = seconds / np.where(each > 0, each, 1)[rays.person]
    return seconds / seconds.sum()


def cluster_observers(positions: np.ndarray, weights: np.ndarray, count: int, seed: int = 0) -> WeightedObservers:
    """At most ``count`` observers that stand for people who were at ``positions`` (N, 3) by ``weights`` (N,).

    Weighted k-means (S. Lloyd 1982) from starts that are drawn far apart (k-means++, D. Arthur, S. Vassilvitskii 2007),
    on cells of positions; every centre is then moved to the nearest place where somebody was, since the mean of two
    aisles lies in the shelf between them. An observer has the weight of all who are nearest to them.
    """
    from scipy.spatial import KDTree

    weights = np.asarray(weights, np.float64) / np.sum(weights)
    place, mass = _cells(positions, weights)
    if len(place) <= count:
        centers = place
    else:
        rng = np.random.default_rng(seed)
        centers = _spread(place, mass, count, rng)
        for _ in range(_ROUNDS):
            near = KDTree(centers).query(place)[1]
            total = np.bincount(near, mass, len(centers))
            sums = np.stack([np.bincount(near, mass * c, len(centers)) for c in place.T], axis=1)
            moved = np.where(total[:, None] > 0, sums / np.where(total > 0, total, 1)[:, None], centers)
            if np.allclose(moved, centers, rtol=0, atol=1e-6):
                break
            centers = moved
    # The nearest of people's positions, each once.
    standing = positions[np.unique(KDTree(positions, leafsize=16, balanced_tree=False).query(centers)[1])]
    apart, near = KDTree(standing).query(positions)
    total = np.bincount(near, weights, len(standing))
    order = np.argsort(apart, kind="stable")
    far = apart[order][np.searchsorted(np.cumsum(weights[order]), 0.95 * weights.sum()).clip(max=len(apart) - 1)]
    kept = total > 0
    return WeightedObservers(
        standing[kept], total[kept] / total.sum(), float(np.sqrt((weights * apart**2).sum())), float(far)
    )


def _cells(positions: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and weights of positions in a grid that grows coarser until it holds some thousand of them."""
    low, size = positions.min(axis=0), float(np.ptp(positions, axis=0).max())
    step = size / 1024
    while True:
        cell = np.floor((positions - low) / step).astype(np.int64) if step > 0 else np.zeros_like(positions, np.int64)
        # Of each axis there are fewer than 2^20 cells: one number sorts faster than three.
        key = cell @ np.array([1 << 40, 1 << 20, 1])
        _, number = np.unique(key, return_inverse=True)
        mass = np.bincount(number, weights)
        if len(mass) <= _CELLS or step == 0:
            break
        step *= 1.5
    sums = np.stack([np.bincount(number, weights * c) for c in positions.T], axis=1)
    known = mass > 0
    return sums[known] / mass[known, None], mass[known]


def _spread(place: np.ndarray, mass: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    chosen = [int(rng.choice(len(place), p=mass / mass.sum()))]
    square = np.square(place - place[chosen[0]]).sum(axis=1)
    while len(chosen) < count and (mass * square).sum() > 0:
        chosen.append(int(rng.choice(len(place), p=mass * square / (mass * square).sum())))
        square = np.minimum(square, np.square(place - place[chosen[-1]]).sum(axis=1))
    return place[chosen]


# ---- Ray source ----
#
# What tracked rays leave on a surface: each as a bundle of rays in a cone, in place of a line without width.
#
# A line ends at one point of a mesh: a thin edge loses it, and a gap lets all of it through. A cone as wide as the
# tracker errs and the fovea sees is divided among what it meets (Martin et al., view-cone sampling, arXiv 2601.02721).

CASTS = 1 << 20  # rays that are cast in one launch


@dataclass(frozen=True, kw_only=True)
class RaySettings:
    """``cone``: its standard deviation in radian, 0 for a line; ``bundle``: rays of each; ``seed`` of their turns."""

    cone_sigma: float = 0.0
    rays_per_cone: int = 16
    seed: int = 0

    @property
    def casts(self) -> int:
        """Rays cast for each tracked one."""
        return self.rays_per_cone if self.cone_sigma > 0 else 1


@dataclass(frozen=True, eq=False)
class TrackedRays:
    """``origins``, unit ``directions`` (N, 3) in the scene and ``weights`` (N,); ``first``: the number of the first one
    among all rays, with which the draws of the bundles begin."""

    origins: np.ndarray
    directions: np.ndarray
    weights: np.ndarray
    first_index: int = 0

    def __len__(self) -> int:
        return len(self.weights)

    def select(self, start: int, stop: int) -> TrackedRays:
        """The rays from ``start`` up to ``stop``."""
        rows = slice(start, stop)
        return TrackedRays(self.origins[rows], self.directions[rows], self.weights[rows], self.first_index + start)


def sum_rays(target: SurfaceTarget, rays: TrackedRays, settings: RaySettings) -> SurfaceSums:
    """What ``rays`` leave on ``target``: partial sums, which `visits.merge` adds up to those of more rays.

    The draws depend on the seed and on ``rays.first`` alone, so that parts that are cut alike give the same everywhere.
    """
    mesh = target.mesh
    on_faces, on_vertices = np.zeros(len(mesh.faces)), np.zeros(len(mesh.vertices))
    rng = np.random.default_rng([settings.seed, rays.first_index])
    each, elsewhere, escaped = settings.casts, 0.0, 0.0
    step = max(1, CASTS // each)
    for a in range(0, len(rays), step):
        some = rays.select(a, min(a + step, len(rays)))
        directions = sample_cone(some.directions, settings.cone_sigma, each, rng).reshape(-1, 3)
        ends = target.trace(np.repeat(some.origins, each, axis=0), directions)
        weights = np.repeat(some.weights / each, each)
        on = ends.face >= 0
        found = deposit(mesh.faces, len(mesh.vertices), ends.face[on], ends.barycentric[on], weights[on])
        on_faces, on_vertices = on_faces + found[0], on_vertices + found[1]
        elsewhere += float(weights[ends.elsewhere].sum())
        escaped += float(weights[~on & ~ends.elsewhere].sum())
    weight = float(rays.weights.sum())
    return SurfaceSums(on_faces, on_vertices, elsewhere, escaped, weight, weight, len(rays))


# ---- Sphere rule ----
#
# Directions over the sphere, many where there is much to see: a sum over them integrates narrow densities too.
#
# Rings of cells that are about as wide as high are cut again by what a density has in their middles, so that all
# directions stand for about as much of it. What a part of the sphere with an outline receives has then an error that
# falls with their number alone, and not with how narrow the density is. The rings lie askew in the scene: along its
# axes they would be parallel to the outlines of upright things, which would fall between the same two directions
# everywhere.

CELLS = 1 << 14  # cells of the first cut, 1.6 degrees wide: narrower densities may be missed
_FINEST = 64
# Any turn that makes no axis of the scene lie along a ring.
_ASKEW = np.linalg.qr(np.array([[0.61, -0.37, 0.42], [0.29, 0.83, -0.31], [-0.53, 0.17, 0.71]]))[0]


def sphere_rule(
    density: Callable[[np.ndarray], np.ndarray], count: int, cells: int = CELLS
) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` unit directions (N, 3), some more, and the solid angle (N,) of each in steradian, 4π together.

    ``density`` of unit directions (M, 3) gives values (M,), not negative. Raises ``ValueError`` for no directions.
    """
    if count < 1 or cells < 1:
        raise ValueError(f"a rule has a direction and a cell at least, got {count} and {cells}")
    top, bottom, turn, width = _cells_sphere_rule(cells)
    area = (top - bottom) * width
    mass = area * density(_directions(0.5 * (top + bottom), turn + 0.5 * width))
    share = mass / mass.sum() if mass.sum() > 0 else area / (4 * np.pi)
    parts = np.clip(np.ceil(np.sqrt(count * share)), 1, _FINEST).astype(np.int64)
    directions, angles = [], []
    for n in np.unique(parts):
        of = np.flatnonzero(parts == n)[:, None, None]
        at = (np.arange(n) + 0.5) / n
        z = bottom[of] + (top - bottom)[of] * at[:, None]
        phi = turn[of] + width[of] * at
        directions.append(_directions(*(np.ravel(v) for v in np.broadcast_arrays(z, phi))))
        angles.append(np.repeat(area[of.ravel()] / n**2, n * n))
    return np.concatenate(directions), np.concatenate(angles)


def _cells_sphere_rule(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Heights of the upper and the lower edge of each cell, its first azimuth, and how many radian it spans."""
    rings = max(1, round(np.sqrt(np.pi * count / 4)))
    z = np.cos(np.pi * np.arange(rings + 1) / rings)
    around = np.maximum(1, np.rint(2 * rings * np.sin(np.pi * (np.arange(rings) + 0.5) / rings))).astype(np.int64)
    ring = np.repeat(np.arange(rings), around)
    number = np.arange(len(ring)) - np.repeat(np.cumsum(around) - around, around)
    width = 2 * np.pi / around[ring]
    return z[ring], z[ring + 1], number * width, width


def _directions(z: np.ndarray, phi: np.ndarray) -> np.ndarray:
    r = np.sqrt(np.maximum((1 - z) * (1 + z), 0))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1) @ _ASKEW.T


# ---- What the gaze of observers leaves on a surface, after occlusion ----
#
# An observer at p_o looks into the direction ω with the density g(ω), in 1/sr. On a face A they leave
#
#     ∫_A g(ω) V(y, p_o) dω(y),    dω = |cos θ| dA / |y - p_o|²
#
# (Veach 1997, section 8.2.2.2), summed over pieces that are small as seen from p_o, each of which counts with its exact
# solid angle (`pieces`), with g at its centre, and with the share of it that is seen, for which it is cut where
# outlines pass (`outlines`). In a medium, or with a fall-off behind outlines, V is that of
# `nerg_mi.probes.surface_attention.attended` at the centre. Over the sphere of the same observer directions
# (`sphere_rule`) tell what g adds up to and how much of it meets something else, or nothing. Both sums use other
# points, and what they lack of each other is the error that is told.

BATCH = 1 << 18  # pieces in one launch
FACES_PER_BATCH = 1 << 16  # faces that are cut into pieces together


@dataclass(frozen=True, kw_only=True)
class GazeSumSettings:
    """``angle``: radian under which an observer sees a piece at most; ``cone``: standard deviation in radian of the
    cone that gaze is seen through, 0 for none; ``directions`` over the sphere, about."""

    max_angle: float = 0.035
    cone_sigma: float = 0.0
    directions: int = 1 << 16


@dataclass(frozen=True, eq=False)
class SurfaceObserver:
    """An observer at ``center`` (one lane): their ``density`` where they see a surface, as
    `nerg_mi.probes.surface_attention` wants it, and ``along`` directions, whatever is met there."""

    center: Point3f
    density: Density
    along: Callable[[Vector3f], Any]


MakeObserver = Callable[[np.ndarray], SurfaceObserver]  # of an observer's position (3,)


def observers_from_field(gaze: GazeFieldInstance, geometry: SceneGeometry, settings: ObserverSettings) -> MakeObserver:
    """Observers whose gaze is the field ``gaze`` in ``place``, traced with ``settings``."""

    def make(eye: np.ndarray) -> SurfaceObserver:
        center = _center(eye)
        # Nobody is asked for twice, and what is known of all of them would fill the memory.
        observed = gaze.for_observers([center], geometry, settings, ObserverCache())
        return SurfaceObserver(
            center,
            lambda p_od, p_o, r_o, active: observed.evaluate(p_od, p_o, r_o, active)[0],
            lambda directions: observed.along(center, directions),
        )

    return make


def sum_gaze(
    target: SurfaceTarget,
    make_observer: MakeObserver,
    eyes: np.ndarray,
    weights: Sequence[float] | np.ndarray,
    settings: GazeSumSettings,
) -> SurfaceSums:
    """What observers at ``eyes`` (M, 3), who count by ``weights`` (M,), leave on ``target``: partial sums, which
    `merge` adds up to those of more observers."""
    none = SurfaceSums.zeros(len(target.mesh.faces), len(target.mesh.vertices))
    with dr.suspend_grad():
        return merge_sums([none, *(_of_one(target, make_observer(eye), float(w), eye, settings) for eye, w in zip(eyes, weights))])


def _of_one(
    target: SurfaceTarget, looker: SurfaceObserver, weight: float, eye: np.ndarray, settings: GazeSumSettings
) -> SurfaceSums:
    mesh, eye = target.mesh, np.asarray(eye, np.float64)
    everywhere = along_through(looker, settings.cone_sigma)
    directions, angles = sphere_rule(everywhere, settings.directions)
    share = weight * angles * everywhere(directions)
    ends = target.trace(np.broadcast_to(eye, directions.shape), directions)
    total, escaped = float(share.sum()), float(share[(ends.face < 0) & ~ends.elsewhere].sum())
    on_faces, on_vertices = np.zeros(len(mesh.faces)), np.zeros(len(mesh.vertices))
    for a in range(0, len(mesh.faces), FACES_PER_BATCH):
        pieces = pieces_of(mesh, eye, settings.max_angle, slice(a, a + FACES_PER_BATCH))
        for some, received in _received(target, looker, pieces, total / weight if weight else 0.0, settings.cone_sigma):
            found = deposit(mesh.faces, len(mesh.vertices), some.face, some.centroid_barycentric, weight * received)
            on_faces, on_vertices = on_faces + found[0], on_vertices + found[1]
    return SurfaceSums(on_faces, on_vertices, float(share[ends.elsewhere].sum()), escaped, total, weight, 1)


def _received(
    target: SurfaceTarget, looker: SurfaceObserver, pieces: Pieces, total: float, cone: float
) -> Iterator[tuple[Pieces, np.ndarray]]:
    """Pieces, some of which may be cut again, and the gaze (P,) that each receives."""
    density = density_through(looker, cone)
    if target.has_binary_visibility:
        yield from visible_pieces(target, pieces, lambda some: _of_pieces(looker, density, some), total, BATCH)
        return
    for a in range(0, len(pieces), BATCH):
        # Most of a place is hidden from wherever one stands, and gaze costs more than rays.
        some = pieces.select(slice(a, a + BATCH))
        some = some.select(_of_seen(target, looker, unit_density, some) > 0)
        if len(some):
            yield some, some.solid_angle * _of_seen(target, looker, density, some)


def _of_seen(target: SurfaceTarget, looker: SurfaceObserver, density: Density, pieces: Pieces) -> np.ndarray:
    normals = target.mesh.normals[pieces.face]
    return after_occlusion(target.geometry, looker, density, pieces.centroids, normals, target.falloff, target.settings)


def unhidden(looker: SurfaceObserver, density: Density, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """``density`` (N,) of ``looker`` at ``points`` (N, 3), along unit ``directions`` (N, 3), in 1/sr, whatever may
    stand between."""
    mi = variant_types()
    r_o, p_od = to_vector(mi.Vector3f, directions), to_vector(mi.Point3f, points)
    p_o = looker.center + dr.zeros(mi.Point3f, len(points))
    return _rows(density(p_od, p_o, r_o, dr.full(mi.Bool, True, len(points))), len(points))


def density_through(looker: SurfaceObserver, cone: float) -> Density:
    """The density of ``looker`` seen through a cone of standard deviation ``cone`` in radian; 0: itself."""
    if cone == 0:
        return looker.density
    return lambda p_od, p_o, r_o, active: blur_density(looker.along, r_o, cone)


def _of_pieces(looker: SurfaceObserver, density: Density, pieces: Pieces) -> np.ndarray:
    middle = pieces.relative.mean(axis=1)
    return unhidden(looker, density, pieces.centroids, middle / np.linalg.norm(middle, axis=1, keepdims=True))


def after_occlusion(
    place: SceneGeometry,
    looker: SurfaceObserver,
    density: Density,
    points: np.ndarray,
    normals: np.ndarray,
    falloff: float,
    settings: ObserverSettings,
    penetration: Float | float = 0.0,
) -> np.ndarray:
    """``density`` (N,) of ``looker`` after occlusion by what may be a medium, at ``points`` on surfaces with
    ``normals`` (N, 3), in 1/sr; ``penetration`` as of `nerg_mi.probes.surface_attention.attended`."""
    mi = variant_types()
    p_o, p = looker.center + dr.zeros(mi.Point3f, len(points)), to_vector(mi.Point3f, points)
    n = to_vector(mi.Vector3f, normals)
    return _rows(attention_per_sr(place, density, p_o, p, n, falloff, settings, True, penetration=penetration), len(points))


def unit_density(p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
    """A density of 1, of which occlusion leaves the visibility."""
    return type(r_o.x)(1)


def _rows(values: Any, count: int) -> np.ndarray:
    """What a kernel gives, (count,) float64, also where it is one constant."""
    return np.broadcast_to(np.array(values, np.float64), (count,))


def along_through(looker: SurfaceObserver, cone: float) -> Callable[[np.ndarray], np.ndarray]:
    """The density (N,) of ``looker`` in unit directions (N, 3), seen through a cone as `density_through` has it."""
    mi = variant_types()
    along = looker.along if cone == 0 else lambda directions: blur_density(looker.along, directions, cone)
    return lambda d: _rows(along(to_vector(mi.Vector3f, d)), len(d))


def _center(eye: np.ndarray) -> Point3f:
    mi = variant_types()
    center = mi.Point3f(np.asarray(eye, np.float64).tolist())
    # A position that is a constant of the kernel would be compiled anew for every observer.
    dr.make_opaque(center)
    return center
