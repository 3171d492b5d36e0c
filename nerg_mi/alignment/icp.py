"""The similarity that agrees best with several scores near a start (iterative closest points among them), and how
well it is determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError

from .constraints import (
    AlignmentFit,
    AlignmentTarget,
    DistanceGrid,
    PlaceSurface,
    Progress,
    angles_between,
    mirror_sentence,
    pair_covariance,
    surface_of_points,
    downsample,
)
from .similarity import ALL, MIRROR, Chart, fit_similarity, transform_points, similarity_scale, upright_basis

# ---- Scores ----
#
# How well a similarity agrees with what tracking says about a place, each as residuals with their derivatives.
#
# People's heads are in free space; they are above the floor, by about the height of a person; gaze goes through free
# space and ends on surfaces, at its hit points where these are known. Residuals are lengths in units of the tracking
# (metres of people), so that a smaller place is no better than a larger one; their derivatives are with respect to the
# numbers of a chart (`Chart`). Another score is another class with these methods.

NEAR, FAR, STEPS = 0.3, 12.0, 32
"""Gaze without a hit point ends between so many metres; at so many places along it a surface is looked for."""

STANDS = 0.9, 2.05
"""Metres above the floor between which a head is plausible: of somebody who sits, and of somebody tall."""


class Score(Protocol):
    """A property that a right alignment has."""

    @property
    def name(self) -> str:
        """What it is about, in a few words."""
        ...

    @property
    def scale(self) -> float:
        """Residuals beyond this many metres count less and less: strays of the tracker, holes of the place."""
        ...

    @property
    def group(self) -> np.ndarray:
        """(N,) whose each residual is: those of a group are not independent of each other."""
        ...

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (N,) in metres, 0 where all is well, of the similarity ``chart.matrix(q)``, and their derivatives
        (N, k) with respect to ``q``."""
        ...


@dataclass(frozen=True, eq=False)
class AtZero:
    """Points (N, 3) are where a distance of the place is 0: hit points on its surface (`PlaceSurface.distance`), heads
    and what gaze passes in its free space (`PlaceSurface.blocked`)."""

    grid: DistanceGrid
    points: np.ndarray
    group: np.ndarray
    name: str
    scale: float = 0.1

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _of_grid(self.grid, self.points, chart, q)


@dataclass(frozen=True, eq=False)
class GazeEnds:
    """Gaze from ``origins`` along unit ``directions`` (N, 3), whose hit points are not known, comes upon a surface."""

    surface: PlaceSurface
    origins: np.ndarray
    directions: np.ndarray
    group: np.ndarray
    scale: float = 0.5
    name: str = "gaze ends on surfaces"

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        along = np.geomspace(NEAR, FAR, STEPS)
        points = self.origins[:, None] + along[:, None] * self.directions[:, None]
        distance = self.surface.distance.interpolate(chart.transform(q, points.reshape(-1, 3))).reshape(len(points), STEPS)
        # Between two places a ray may come nearer by half of the way from one to the other.
        reach = 0.5 * np.gradient(along) * chart.scale(q)
        nearest = np.argmin(distance - reach, axis=1)
        each = np.arange(len(points))
        # The derivative of a least value is that of the value that is least.
        r, by = _of_grid(self.surface.distance, points[each, nearest], chart, q)
        r = r - 0.5 * np.gradient(along)[nearest]
        return np.maximum(r, 0), by * (r > 0)[:, None]


@dataclass(frozen=True, eq=False)
class HeadHeight:
    """Heads (N, 3) are above the floor at the height ``floor`` of the place, z up, as people's are."""

    floor: float
    points: np.ndarray
    group: np.ndarray
    scale: float = 0.2
    name: str = "heads above the floor"

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved, s = chart.transform(q, self.points), chart.scale(q)
        height = (moved[:, 2] - self.floor) / s
        up = np.broadcast_to([0.0, 0.0, 1.0], moved.shape)
        slope = chart.pulled(q, moved, up) / s - height[:, None] * chart.basis[6]
        low, high = STANDS
        sign = np.where(height < low, -1.0, np.where(height > high, 1.0, 0.0))
        return np.maximum(np.maximum(low - height, height - high), 0), sign[:, None] * slope


def _of_grid(grid: DistanceGrid, points: np.ndarray, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances in units of the tracking of ``points`` (N, 3) of its frame, and their derivatives."""
    moved, s = chart.transform(q, points), chart.scale(q)
    value, slope = grid.with_slope(moved)
    return value / s, (chart.pulled(q, moved, slope) - value[:, None] * chart.basis[6]) / s


# ---- The similarity that agrees best with several scores, near one that is given, and how well it is determined ----

_FEW = 10


@dataclass(frozen=True, eq=False)
class RefinedAlignment:
    """``matrix`` (4, 4); ``cost``: the robust mean over all scores, 0 where all is well, below 1; ``covariance`` (7, 7)
    of rotation vector, translation and logarithm of the scale about the chart's ``center``."""

    matrix: np.ndarray
    cost: float
    covariance: np.ndarray
    center: np.ndarray


def refine(
    scores: Sequence[Score], base: np.ndarray, center: np.ndarray, basis: np.ndarray, scale_factor: float = 1.0, max_evaluations: int = 60
) -> RefinedAlignment:
    """Minimise the robust residuals of ``scores`` by Gauss-Newton steps in a trust region (SciPy's least_squares with a
    Cauchy loss), from the similarity ``base`` (4, 4) on.

    Each score has the same weight, however many residuals it has. ``center``, ``basis``: of the chart; ``wide``: factor
    of the scores' own scales, larger for a first, coarse fit; ``most``: evaluations.
    """
    chart = Chart(base, center, basis)
    weight = [1 / (scale_factor * s.scale * np.sqrt(max(len(s.group), 1))) for s in scores]

    def stacked(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = [s.residuals(chart, q) for s in scores]
        return (
            np.concatenate([w * r for w, (r, _) in zip(weight, parts)]),
            np.concatenate([w * by for w, (_, by) in zip(weight, parts)]),
        )

    # SciPy's loss is of each residual, of which those of a score count less the more there are of them.
    counts = np.concatenate([np.full(len(s.group), len(s.group), float) for s in scores])

    def weighed(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # log(1 + z) as a square, whose root has derivatives where z > 0: z = r^2 in units of a score's scale.
        r, by = stacked(q)
        z = r * r * counts
        factor = np.sqrt(np.where(z > 1e-12, np.log1p(z) / np.maximum(z, 1e-300), 1.0))
        slope = np.where(z > 1e-12, 1 / ((1 + z) * np.maximum(factor, 1e-150)), 1.0)
        return r * factor, by * slope[:, None]

    q = np.zeros(chart.size)
    if len(counts):
        last: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def at(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            key = q.tobytes()
            if key not in last:
                last.clear()
                last[key] = weighed(q)
            return last[key]

        derivatives: Any = lambda q: at(q)[1]
        q = least_squares(lambda q: at(q)[0], q, derivatives, x_scale="jac", max_nfev=max_evaluations).x
    r, by = stacked(q)
    z = r * r * counts
    group = np.concatenate([s.group for s in scores])
    covariance = _sandwich(r, by, 1 / (1 + z), group)
    return RefinedAlignment(
        chart.matrix(q), float(np.sum(np.log1p(z) / counts)), chart.basis @ covariance @ chart.basis.T, center
    )


def _sandwich(r: np.ndarray, by: np.ndarray, weight: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of the parameters where residuals of a group may depend on each other: H^-1 (sum of g g') H^-1,
    g the gradient of a group (K.-Y. Liang, S. Zeger: Longitudinal data analysis using generalized linear models,
    1986)."""
    hessian = (by * weight[:, None]).T @ by
    gradient = by * (weight * r)[:, None]
    _, where = np.unique(group, return_inverse=True)
    where = where.reshape(-1)
    sums = np.stack([np.bincount(where, g) for g in gradient.T], axis=1)
    count = len(sums)
    inverse = np.linalg.pinv(hessian, hermitian=True)
    return inverse @ (sums.T @ sums) @ inverse * (count / max(count - 1, 1))


def groups_of(person: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(N,) numbers of groups that are taken for independent: people, or, of few people, ten seconds of each."""
    if len(np.unique(person)) >= _FEW:
        return person.astype(np.int64)
    blocks = np.floor((t - t.min(initial=np.inf)) / 10).astype(np.int64) if len(t) else np.zeros(0, np.int64)
    return person.astype(np.int64) * (int(blocks.max(initial=0)) + 1) + blocks


# ---- Icp ----
#
# Alignment from a twin: a mesh, or points on surfaces, in the tracking's frame, against the surface of the place.
#
# First all turns (and mirrors) on a lattice of rotations, judged by both distance fields at once, since a twin that
# shrinks onto a single spot of the place would lie on its surface too; then iterated closest points with scale (P.
# Besl, N. McKay, 1992; scale after T. Zinsser et al., 2005), in both directions for the same reason, trimmed of what
# only one of them has (D. Chetverikov et al., 2002); and at last steps on the place's distance field (`refine`).

_TURNS, _COARSE, _FINE = 1000, 150, 2000
_SCALES = np.exp(np.linspace(-0.25, 0.25, 5))
_STARTS, _LAST = 30, 3
# Share of the points of either side that the other one is taken to have too.
_OVERLAP = 0.8
# At the end points farther from the surface than this share of the place's size count less and less.
_NEAR = 0.005
_FAR = 0.04
# A mirrored twin is told where it fits so much better; a rival of another placement where it fits almost as well.
_CLEAR, _RIVAL = 0.8, 1.15


@dataclass(frozen=True, eq=False)
class Twin:
    """``points`` (N, 3) on surfaces, in the frame of the tracking; ``source``: whose they are, for messages."""

    points: np.ndarray
    source: str = "the twin"

    kind = "twin"

    def fit(self, target: AlignmentTarget, progress: Progress) -> AlignmentFit:
        """The best placement. Raises `NergError` for a twin of too few points."""
        twin, place = _even(self.points, self.source), target.surface
        found: dict[bool, list[_Placed]] = {}
        for flip in (False, True):
            progress(0.1 + 0.4 * flip, "placing the mirrored twin" if flip else "placing the twin")
            found[flip] = _placed(transform_points(MIRROR, twin) if flip else twin, place, target)
        best = found[False][0]
        s = similarity_scale(best.matrix)
        x, y, forth = _closest(twin, place.points, KDTree(place.points), KDTree(twin), best.matrix, _OVERLAP)
        basis = upright_basis(False) if target.is_upright else ALL
        off = _nearest(KDTree(place.points), transform_points(best.matrix, twin))[0] / s
        kept = np.sort(off)[: int(_OVERLAP * len(off))]
        notes = [
            f"{len(twin):,} points of the twin; {_OVERLAP:.0%} of them lie within {100 * kept[-1]:.2g} cm",
            *_unit(s),
        ]
        mirrored = None
        if found[True][0].cost < _CLEAR * best.cost:
            flipped = found[True][0].cost / similarity_scale(found[True][0].matrix)
            mirrored = mirror_sentence("the twin fits", flipped, best.cost / s)
        about = {"points": len(twin), "overlap": _OVERLAP, "mean_cm": 100 * best.cost / s}
        covariance = pair_covariance(x[forth], y[forth], best.matrix, basis)
        return AlignmentFit(
            target.to_place(best.matrix),
            100 * kept,
            angles_between(transform_points(best.matrix, x.mean(axis=0)), transform_points(best.matrix, x[forth]), y[forth]),
            covariance,
            mirrored,
            twin,
            None,
            about,
            notes,
            _rivals(found[False], place.diagonal),
        )


@dataclass(frozen=True, eq=False)
class _Placed:
    """A placement, and its mean distance in units of the place."""

    matrix: np.ndarray
    cost: float


def _even(points: np.ndarray, source: str) -> np.ndarray:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise NergError(f"{source} has {len(points)} usable points, and 100 or more are needed to place it")
    size = np.linalg.norm(np.ptp(points, axis=0))
    if not size > 0:
        raise NergError(f"all points of {source} are one; give a mesh or points on surfaces")
    return downsample(points, float(size) / 250)


def _placed(twin: np.ndarray, place: PlaceSurface, target: AlignmentTarget) -> list[_Placed]:
    """The best placements of the points ``twin``, best first."""
    own = surface_of_points(twin, 1 << 19).distance
    rng = np.random.default_rng(0)
    few = lambda p, n: p[rng.permutation(len(p))[:n]]
    x, y = few(twin, _COARSE), few(place.points, _COARSE)
    x0, y0 = twin.mean(axis=0), place.points.mean(axis=0)
    spread = lambda p, p0: float(np.sqrt(np.mean(np.sum((p - p0) ** 2, axis=1))))
    ratio = spread(place.points, y0) / spread(twin, x0)
    scales = ratio * _SCALES if target.scale is None else np.array([target.scale])
    wide = 0.06 * place.diagonal
    starts = []
    for turn in _turns(target.is_upright):
        # All scales at once.
        moved = scales[:, None, None] * ((x - x0) @ turn.T) + y0
        back = ((y - y0) @ turn) / scales[:, None, None] + x0
        forth = place.distance.interpolate(moved.reshape(-1, 3)).reshape(len(scales), -1)
        away = own.interpolate(back.reshape(-1, 3)).reshape(len(scales), -1) * scales[:, None]
        near = np.exp(-0.5 * (forth / wide) ** 2).mean(axis=1) + np.exp(-0.5 * (away / wide) ** 2).mean(axis=1)
        starts += [(n, s, turn) for n, s in zip(near.tolist(), scales)]
    starts.sort(key=lambda g: -g[0])
    found = []
    x, y = few(twin, 500), few(place.points, 500)
    for _, s, turn in starts[:_STARTS]:
        matrix = np.eye(4)
        matrix[:3, :3] = s * turn
        matrix[:3, 3] = y0 - s * turn @ x0
        found.append(_icp(x, y, matrix, target, 15))
    found.sort(key=lambda f: f.cost / similarity_scale(f.matrix))
    x, y = few(twin, _FINE), few(place.points, 2 * _FINE)
    last = [_settled(x, y, f.matrix, place, own, target) for f in _different(found, place.diagonal)[:_LAST]]
    return sorted(last, key=lambda f: f.cost / similarity_scale(f.matrix))


def _turns(upright: bool) -> list[np.ndarray]:
    if upright:
        return [Rotation.from_rotvec([0, 0, a]).as_matrix() for a in 2 * np.pi * np.arange(60) / 60]
    return list(Rotation.from_quat(np.random.default_rng(0).normal(size=(_TURNS, 4))).as_matrix())


def _icp(x: np.ndarray, y: np.ndarray, matrix: np.ndarray, target: AlignmentTarget, most: int) -> _Placed:
    tree, own = KDTree(y), KDTree(x)
    cost = np.inf
    for k in range(most):
        # More is taken for common as the two come together.
        share = 0.6 + (_OVERLAP - 0.6) * min(1.0, 2 * k / most)
        a, b, _ = _closest(x, y, tree, own, matrix, share)
        matrix = fit_similarity(a, b, upright=target.is_upright, scale=target.scale)
        now = float(np.mean(np.linalg.norm(transform_points(matrix, a) - b, axis=1)))
        if 2 * k > most and abs(cost - now) < 1e-5 * max(now, 1e-300):
            break
        cost = now
    return _Placed(matrix, cost)


def _settled(
    x: np.ndarray, y: np.ndarray, matrix: np.ndarray, place: PlaceSurface, twin: DistanceGrid, target: AlignmentTarget
) -> _Placed:
    """Closest points slide along surfaces by small steps; the distance field has the slope that leads there at once.

    The mean distance is that of both fields (``twin``: that of the twin), with what is far counted as no farther than
    it has to be to tell that it is.
    """
    matrix = _icp(x, y, matrix, target, 8).matrix
    near = _NEAR * place.diagonal / similarity_scale(matrix)
    basis = upright_basis(False) if target.is_upright else ALL
    basis = basis if target.scale is None else basis[:, :-1]
    center, own = transform_points(matrix, x).mean(axis=0), np.arange(len(x))
    on_surface = AtZero(place.distance, x, own, "points of the twin on surfaces", near)
    for wide in (3.0, 1.0):
        matrix = refine([on_surface], matrix, center, basis, wide, 30).matrix
    s, most = similarity_scale(matrix), _FAR * place.diagonal
    forth = np.minimum(place.distance.interpolate(transform_points(matrix, x)), most)
    back = np.minimum(twin.interpolate(transform_points(np.linalg.inv(matrix), y)) * s, most)
    return _Placed(matrix, float(0.5 * (forth.mean() + back.mean())))


def _closest(
    x: np.ndarray, y: np.ndarray, tree: KDTree, own: KDTree, matrix: np.ndarray, share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of ``x`` and of ``y`` that belong together, (M, 3) each, nearest from either side, without those that are
    farthest apart; and which were found from the side of ``x``, (M,) bool."""
    forth, at = _nearest(tree, transform_points(matrix, x))
    back, of = _nearest(own, transform_points(np.linalg.inv(matrix), y))
    back = back * similarity_scale(matrix)
    a = np.flatnonzero(forth <= np.quantile(forth, share))
    b = np.flatnonzero(back <= np.quantile(back, share))
    side = np.arange(len(a) + len(b)) < len(a)
    return np.concatenate([x[a], x[of[b]]]), np.concatenate([y[at[a]], y[b]]), side


def _nearest(tree: KDTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance, index = tree.query(points)
    return np.asarray(distance), np.asarray(index)


def _different(found: list[_Placed], size: float) -> list[_Placed]:
    out: list[_Placed] = []
    for f in found:
        if all(_apart(f, o, size) for o in out):
            out.append(f)
    return out


def _apart(a: _Placed, b: _Placed, size: float) -> bool:
    turned = a.matrix[:3, :3] / similarity_scale(a.matrix) @ (b.matrix[:3, :3] / similarity_scale(b.matrix)).T
    angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
    return bool(angle > 10 or abs(np.log(similarity_scale(a.matrix) / similarity_scale(b.matrix))) > 0.1)


def _rivals(found: list[_Placed], size: float) -> list[str]:
    best = found[0]
    each = lambda f: f.cost / similarity_scale(f.matrix)
    for other in found[1:]:
        if _apart(best, other, size) and each(other) < _RIVAL * each(best):
            return [
                f"another placement fits almost as well ({100 * each(other):.2g} cm, the best {100 * each(best):.2g} "
                "cm): the place may look alike from two sides; settle it with three picked points (--pairs)"
            ]
    return []


def _unit(scale: float) -> list[str]:
    """What a scale that is a unit of length means."""
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254), ("feet", 0.3048)):
        if abs(np.log(scale / factor)) < 0.02:
            return [f"the scale is {scale:.4g}: the twin is in {unit} where the place is in metres"]
    return []
