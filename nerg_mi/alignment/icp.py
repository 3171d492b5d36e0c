"""Refinement of a similarity by robust least squares over several scores, including iterative closest points, with
its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.transforms import similarity_scale, transform_points

from .constraints import (
    AlignmentFit,
    AlignmentTarget,
    DistanceGrid,
    ProgressCallback,
    SceneSurface,
    angles_between,
    describe_mirror,
    downsample,
    pair_covariance,
    surface_from_points,
)
from .similarity import MIRROR, LocalSimilarity, fit_similarity, vertical_rotation

# ---- Scores ----
#
# Each score measures how well a similarity agrees with one property of the tracking, as residuals with derivatives.
#
# Heads are in free space, at a plausible height above the floor. Gaze passes through free space and ends on surfaces,
# at its hit points if they are known. Residuals are lengths in units of the tracking, so that a smaller scene is not
# favoured. Derivatives are with respect to the parameters of a `LocalSimilarity`. A new score is another class with
# these methods.

MIN_GAZE_LENGTH, MAX_GAZE_LENGTH, GAZE_STEPS = 0.3, 12.0, 32
"""Range of the length of gaze without a hit point, in metres, and the number of positions tested along it. In scenes
with a longer diagonal, the diagonal is the maximum."""

HEAD_HEIGHT_RANGE = 0.9, 2.05
"""Plausible heights of a head above the floor in metres, from sitting to tall standing persons."""


class Score(Protocol):
    """A property of a correct alignment."""

    @property
    def name(self) -> str:
        """Short description."""
        ...

    @property
    def scale(self) -> float:
        """Scale of the robust loss in metres; larger residuals have decreasing influence."""
        ...

    @property
    def group(self) -> np.ndarray:
        """Group of each residual, (N,). Residuals of a group may be correlated."""
        ...

    def residuals(self, chart: LocalSimilarity, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N,) in metres, 0 for a perfect fit, of the similarity ``chart.matrix(q)``, and their
        derivatives (N, k) with respect to ``q``."""
        ...


@dataclass(frozen=True, eq=False)
class ZeroDistance:
    """Points (N, 3) should have distance 0: hit points to surfaces, heads and gaze paths to free space."""

    grid: DistanceGrid
    points: np.ndarray
    group: np.ndarray
    name: str
    scale: float = 0.1

    def residuals(self, chart: LocalSimilarity, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _grid_residuals(self.grid, self.points, chart, q)


@dataclass(frozen=True, eq=False)
class GazeEnds:
    """Gaze without hit points, from ``origins`` along unit ``directions`` (N, 3), should meet a surface."""

    surface: SceneSurface
    origins: np.ndarray
    directions: np.ndarray
    group: np.ndarray
    # Gaze leaves through windows and holes of a reconstruction, by which it passes surfaces at a metre or so.
    scale: float = 2.0
    name: str = "gaze ends on surfaces"

    def residuals(self, chart: LocalSimilarity, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        max_length = max(MAX_GAZE_LENGTH, self.surface.diagonal / similarity_scale(chart.base))
        lengths = np.geomspace(MIN_GAZE_LENGTH, max_length, GAZE_STEPS)
        points = self.origins[:, None] + lengths[:, None] * self.directions[:, None]
        distance = self.surface.distance.interpolate(chart.transform(q, points.reshape(-1, 3))).reshape(
            len(points), GAZE_STEPS
        )
        # Between two positions, a ray may come closer by half of their distance.
        slack = 0.5 * np.gradient(lengths) * chart.scale(q)
        nearest = np.argmin(distance - slack, axis=1)
        rows = np.arange(len(points))
        # The derivative of a minimum is that of the smallest value.
        r, jacobian = _grid_residuals(self.surface.distance, points[rows, nearest], chart, q)
        r = r - 0.5 * np.gradient(lengths)[nearest]
        return np.maximum(r, 0), jacobian * (r > 0)[:, None]


@dataclass(frozen=True, eq=False)
class HeadHeight:
    """Heads (N, 3) should be at a plausible height above the floor."""

    floor: float
    points: np.ndarray
    group: np.ndarray
    scale: float = 0.2
    name: str = "heads above the floor"

    def residuals(self, chart: LocalSimilarity, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved, s = chart.transform(q, self.points), chart.scale(q)
        height = (moved[:, 2] - self.floor) / s
        up = np.broadcast_to([0.0, 0.0, 1.0], moved.shape)
        slope = chart.gradient(q, moved, up) / s - height[:, None] * chart.basis[6]
        low, high = HEAD_HEIGHT_RANGE
        sign = np.where(height < low, -1.0, np.where(height > high, 1.0, 0.0))
        return np.maximum(np.maximum(low - height, height - high), 0), sign[:, None] * slope


def _grid_residuals(
    grid: DistanceGrid, points: np.ndarray, chart: LocalSimilarity, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances of ``points`` (N, 3) in units of the tracking, and their derivatives."""
    moved, s = chart.transform(q, points), chart.scale(q)
    value, slope = grid.interpolate_with_gradient(moved)
    return value / s, (chart.gradient(q, moved, slope) - value[:, None] * chart.basis[6]) / s


# ---- Refinement ----

_MIN_PARTICIPANTS = 10


@dataclass(frozen=True, eq=False)
class RefinedAlignment:
    """Refined similarity.

    ``matrix`` (4, 4); ``cost``: robust mean over all scores, 0 for a perfect fit; ``covariance`` (7, 7) of rotation
    vector, translation and logarithm of the scale about ``center``.
    """

    matrix: np.ndarray
    cost: float
    covariance: np.ndarray
    center: np.ndarray


def refine(
    scores: Sequence[Score], chart: LocalSimilarity, scale_factor: float = 1.0, max_evaluations: int = 60
) -> RefinedAlignment:
    """Minimise the robust residuals of ``scores`` by Gauss-Newton steps in a trust region (SciPy's least_squares,
    Cauchy loss).

    Parameters
    ----------
    scores
        Scores; each has the same total weight.
    chart
        Similarities near the initial one.
    scale_factor
        Factor of the scores' scales, larger for a coarse fit.
    max_evaluations
        Maximum number of evaluations.
    """
    weight = [1 / (scale_factor * s.scale * np.sqrt(max(len(s.group), 1))) for s in scores]

    def stack_residuals(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = [s.residuals(chart, q) for s in scores]
        return (
            np.concatenate([w * r for w, (r, _) in zip(weight, parts)]),
            np.concatenate([w * jacobian for w, (_, jacobian) in zip(weight, parts)]),
        )

    # The weights divide by the number of residuals of a score; the loss needs the unweighted squares.
    counts = np.concatenate([np.full(len(s.group), len(s.group), float) for s in scores])

    def robust_residuals(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The Cauchy loss log(1 + z) as the square of a residual, with z = r^2 in units of a score's scale.
        r, jacobian = stack_residuals(q)
        z = r * r * counts
        factor = np.sqrt(np.where(z > 1e-12, np.log1p(z) / np.maximum(z, 1e-300), 1.0))
        slope = np.where(z > 1e-12, 1 / ((1 + z) * np.maximum(factor, 1e-150)), 1.0)
        return r * factor, jacobian * slope[:, None]

    q = np.zeros(chart.size)
    if len(counts) and chart.size:
        cache: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def evaluate(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            key = q.tobytes()
            if key not in cache:
                cache.clear()
                cache[key] = robust_residuals(q)
            return cache[key]

        derivatives: Any = lambda q: evaluate(q)[1]
        q = least_squares(lambda q: evaluate(q)[0], q, derivatives, x_scale="jac", max_nfev=max_evaluations).x
    r, jacobian = stack_residuals(q)
    z = r * r * counts
    group = np.concatenate([s.group for s in scores])
    covariance = _sandwich_covariance(r, jacobian, 1 / (1 + z), group)
    return RefinedAlignment(
        chart.matrix(q), float(np.sum(np.log1p(z) / counts)), chart.basis @ covariance @ chart.basis.T, chart.center
    )


def _sandwich_covariance(r: np.ndarray, jacobian: np.ndarray, weight: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the cluster-robust (sandwich) covariance (k, k) of the parameters: H^-1 (sum of g g') H^-1, with g the
    gradient of a group.

    Reference: K.-Y. Liang, S. Zeger, Longitudinal data analysis using generalized linear models, 1986.
    """
    if not jacobian.shape[1]:
        return np.zeros((0, 0))
    hessian = (jacobian * weight[:, None]).T @ jacobian
    gradient = jacobian * (weight * r)[:, None]
    _, where = np.unique(group, return_inverse=True)
    where = where.reshape(-1)
    sums = np.stack([np.bincount(where, g) for g in gradient.T], axis=1)
    count = len(sums)
    inverse = np.linalg.pinv(hessian, hermitian=True)
    return inverse @ (sums.T @ sums) @ inverse * (count / max(count - 1, 1))


def independent_groups(person: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return group numbers (N,) of samples that are treated as independent: participants or, for few participants,
    blocks of ten seconds."""
    if len(np.unique(person)) >= _MIN_PARTICIPANTS:
        return person.astype(np.int64)
    blocks = np.floor((t - t.min(initial=np.inf)) / 10).astype(np.int64) if len(t) else np.zeros(0, np.int64)
    return person.astype(np.int64) * (int(blocks.max(initial=0)) + 1) + blocks


# ---- Iterative closest points ----
#
# Alignment from a twin: a mesh, or points on surfaces, in the frame of the tracking, aligned with the surface of the
# scene.
#
# The search starts from a set of rotations (and mirrored ones), scored by both distance fields, since a twin that
# shrinks to a single point of the scene would lie on its surface. The best starts are refined by iterative closest
# points with scale (P. Besl, N. McKay, 1992; T. Zinsser et al., 2005) in both directions, trimmed of points without a
# counterpart (D. Chetverikov et al., 2002), and finally on the distance field of the scene (`refine`).

_NUM_ROTATIONS, _COARSE_POINTS, _FINE_POINTS = 1000, 150, 2000
_SCALES = np.exp(np.linspace(-0.25, 0.25, 5))
_NUM_STARTS, _NUM_FINAL = 30, 3
# Assumed fraction of the points with a counterpart.
_OVERLAP = 0.8
# Scale of the robust loss, and maximum distance in the cost, relative to the size of the scene.
_NEAR_FRACTION = 0.005
_FAR_FRACTION = 0.04
# Cost ratio below which a mirrored twin is reported, and below which another placement is reported.
_MIRROR_RATIO, _RIVAL_RATIO = 0.8, 1.15


@dataclass(frozen=True, eq=False)
class Twin:
    """Points (N, 3) on surfaces in the frame of the tracking; ``source`` names them in messages."""

    points: np.ndarray
    source: str = "the twin"

    kind = "twin"

    def fit(self, target: AlignmentTarget, progress: ProgressCallback) -> AlignmentFit:
        """Find the best placement. Raises `NergError` for too few points."""
        twin, surface = _downsample_evenly(self.points, self.source), target.surface
        placements: dict[bool, list[_Placement]] = {}
        for flip in (False, True):
            progress(0.1 + 0.4 * flip, "placing the mirrored twin" if flip else "placing the twin")
            placements[flip] = _find_placements(transform_points(MIRROR, twin) if flip else twin, surface, target)
        best = placements[False][0]
        scale = similarity_scale(best.matrix)
        x, y, is_forward = _closest_pairs(
            twin, surface.points, KDTree(surface.points), KDTree(twin), best.matrix, _OVERLAP
        )
        distance = _query_tree(KDTree(surface.points), transform_points(best.matrix, twin))[0] / scale
        residuals = np.sort(distance)[: int(_OVERLAP * len(distance))]
        notes = [
            f"{len(twin):,} points of the twin; {_OVERLAP:.0%} are within {100 * residuals[-1]:.2g} cm",
            *_describe_scale(scale),
        ]
        mirrored = None
        if placements[True][0].cost < _MIRROR_RATIO * best.cost:
            flipped = placements[True][0].cost / similarity_scale(placements[True][0].matrix)
            mirrored = describe_mirror("the twin fits the scene", flipped, best.cost / scale)
        metadata = {"points": len(twin), "overlap": _OVERLAP, "mean_cm": 100 * best.cost / scale}
        chart = target.parametrize(best.matrix, transform_points(best.matrix, x[is_forward]).mean(axis=0))
        covariance = pair_covariance(x[is_forward], y[is_forward], chart)
        return AlignmentFit(
            target.to_scene_frame(best.matrix),
            100 * residuals,
            angles_between(
                transform_points(best.matrix, x.mean(axis=0)),
                transform_points(best.matrix, x[is_forward]),
                y[is_forward],
            ),
            covariance,
            mirrored,
            twin,
            None,
            metadata,
            notes,
            _warn_rivals(placements[False], surface.diagonal),
        )


@dataclass(frozen=True, eq=False)
class _Placement:
    """A similarity and its mean distance in scene units."""

    matrix: np.ndarray
    cost: float


def _downsample_evenly(points: np.ndarray, source: str) -> np.ndarray:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise NergError(f"{source} has {len(points)} usable points, but an alignment needs at least 100")
    size = np.linalg.norm(np.ptp(points, axis=0))
    if not size > 0:
        raise NergError(f"all points of {source} coincide; give a mesh or points on surfaces")
    return downsample(points, float(size) / 250)


def _find_placements(twin: np.ndarray, surface: SceneSurface, target: AlignmentTarget) -> list[_Placement]:
    """Return the best placements of the points ``twin``, best first."""
    twin_distance = surface_from_points(twin, 1 << 19).distance
    rng = np.random.default_rng(0)
    draw = lambda p, n: p[rng.permutation(len(p))[:n]]
    x, y = draw(twin, _COARSE_POINTS), draw(surface.points, _COARSE_POINTS)
    x0, y0 = twin.mean(axis=0), surface.points.mean(axis=0)
    spread = lambda p, p0: float(np.sqrt(np.mean(np.sum((p - p0) ** 2, axis=1))))
    ratio = spread(surface.points, y0) / spread(twin, x0)
    scales = ratio * _SCALES if target.scale is None else np.array([target.scale])
    width = 0.06 * surface.diagonal
    starts = []
    for turn in _candidate_rotations(target):
        # All scales at once.
        moved = scales[:, None, None] * ((x - x0) @ turn.T) + y0
        back = ((y - y0) @ turn) / scales[:, None, None] + x0
        forward = surface.distance.interpolate(moved.reshape(-1, 3)).reshape(len(scales), -1)
        backward = twin_distance.interpolate(back.reshape(-1, 3)).reshape(len(scales), -1) * scales[:, None]
        score = np.exp(-0.5 * (forward / width) ** 2).mean(axis=1) + np.exp(-0.5 * (backward / width) ** 2).mean(axis=1)
        starts += [(n, s, turn) for n, s in zip(score.tolist(), scales)]
    starts.sort(key=lambda g: -g[0])
    placements = []
    x, y = draw(twin, 500), draw(surface.points, 500)
    for _, s, turn in starts[:_NUM_STARTS]:
        matrix = np.eye(4)
        matrix[:3, :3] = s * turn
        matrix[:3, 3] = y0 - s * turn @ x0 if target.shift is None else target.shift
        placements.append(_icp(x, y, matrix, target, 15))
    placements.sort(key=lambda f: f.cost / similarity_scale(f.matrix))
    x, y = draw(twin, _FINE_POINTS), draw(surface.points, 2 * _FINE_POINTS)
    final = [
        _refine_placement(x, y, f.matrix, surface, twin_distance, target)
        for f in _distinct_placements(placements, surface.diagonal)[:_NUM_FINAL]
    ]
    return sorted(final, key=lambda f: f.cost / similarity_scale(f.matrix))


def _candidate_rotations(target: AlignmentTarget) -> list[np.ndarray]:
    if target.turn is not None:
        return [vertical_rotation(target.turn)]
    if target.is_upright:
        return [Rotation.from_rotvec([0, 0, a]).as_matrix() for a in 2 * np.pi * np.arange(60) / 60]
    return list(Rotation.from_quat(np.random.default_rng(0).normal(size=(_NUM_ROTATIONS, 4))).as_matrix())


def _icp(x: np.ndarray, y: np.ndarray, matrix: np.ndarray, target: AlignmentTarget, max_iterations: int) -> _Placement:
    tree, source_tree = KDTree(y), KDTree(x)
    cost = np.inf
    for k in range(max_iterations):
        # Increase the assumed overlap as the fit improves.
        fraction = 0.6 + (_OVERLAP - 0.6) * min(1.0, 2 * k / max_iterations)
        a, b, _ = _closest_pairs(x, y, tree, source_tree, matrix, fraction)
        matrix = fit_similarity(a, b, **target.constraints)
        new_cost = float(np.mean(np.linalg.norm(transform_points(matrix, a) - b, axis=1)))
        if 2 * k > max_iterations and abs(cost - new_cost) < 1e-5 * max(new_cost, 1e-300):
            break
        cost = new_cost
    return _Placement(matrix, cost)


def _refine_placement(
    x: np.ndarray, y: np.ndarray, matrix: np.ndarray, surface: SceneSurface, twin: DistanceGrid, target: AlignmentTarget
) -> _Placement:
    """Refine a placement by closest points, then on the distance field, whose gradient converges faster along surfaces.

    The cost is the mean distance in both directions, with large distances clipped.
    """
    matrix = _icp(x, y, matrix, target, 8).matrix
    near_distance = _NEAR_FRACTION * surface.diagonal / similarity_scale(matrix)
    center, index = transform_points(matrix, x).mean(axis=0), np.arange(len(x))
    on_surface = ZeroDistance(surface.distance, x, index, "points of the twin on surfaces", near_distance)
    for factor in (3.0, 1.0):
        matrix = refine([on_surface], target.parametrize(matrix, center), factor, 30).matrix
    s, max_distance = similarity_scale(matrix), _FAR_FRACTION * surface.diagonal
    forward = np.minimum(surface.distance.interpolate(transform_points(matrix, x)), max_distance)
    backward = np.minimum(twin.interpolate(transform_points(np.linalg.inv(matrix), y)) * s, max_distance)
    return _Placement(matrix, float(0.5 * (forward.mean() + backward.mean())))


def _closest_pairs(
    x: np.ndarray, y: np.ndarray, tree: KDTree, source_tree: KDTree, matrix: np.ndarray, fraction: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return closest pairs in both directions, (M, 3) each, without the most distant ones, and whether each pair was
    found from ``x``, (M,) bool."""
    forward, target_index = _query_tree(tree, transform_points(matrix, x))
    backward, source_index = _query_tree(source_tree, transform_points(np.linalg.inv(matrix), y))
    backward = backward * similarity_scale(matrix)
    a = np.flatnonzero(forward <= np.quantile(forward, fraction))
    b = np.flatnonzero(backward <= np.quantile(backward, fraction))
    is_forward = np.arange(len(a) + len(b)) < len(a)
    return np.concatenate([x[a], x[source_index[b]]]), np.concatenate([y[target_index[a]], y[b]]), is_forward


def _query_tree(tree: KDTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance, index = tree.query(points)
    return np.asarray(distance), np.asarray(index)


def _distinct_placements(placements: list[_Placement], size: float) -> list[_Placement]:
    out: list[_Placement] = []
    for f in placements:
        if all(_is_distinct(f, o, size) for o in out):
            out.append(f)
    return out


def _is_distinct(a: _Placement, b: _Placement, size: float) -> bool:
    relative_rotation = (
        a.matrix[:3, :3] / similarity_scale(a.matrix) @ (b.matrix[:3, :3] / similarity_scale(b.matrix)).T
    )
    angle = np.degrees(np.arccos(np.clip((np.trace(relative_rotation) - 1) / 2, -1, 1)))
    return bool(angle > 10 or abs(np.log(similarity_scale(a.matrix) / similarity_scale(b.matrix))) > 0.1)


def _warn_rivals(placements: list[_Placement], size: float) -> list[str]:
    best = placements[0]
    mean_distance = lambda f: f.cost / similarity_scale(f.matrix)
    for other in placements[1:]:
        if _is_distinct(best, other, size) and mean_distance(other) < _RIVAL_RATIO * mean_distance(best):
            return [
                f"another placement fits almost as well ({100 * mean_distance(other):.2g} cm, the best "
                f"{100 * mean_distance(best):.2g} cm): the scene may be symmetric; use three picked points "
                f"({parameter('pairs')}) to decide"
            ]
    return []


def _describe_scale(scale: float) -> list[str]:
    """Explain a scale that corresponds to a unit of length."""
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254), ("feet", 0.3048)):
        if abs(np.log(scale / factor)) < 0.02:
            return [f"the scale is {scale:.4g}: the twin is in {unit} and the scene in metres"]
    return []
