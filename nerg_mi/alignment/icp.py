"""Alignment from a twin: a mesh, or points on surfaces, in the tracking's frame, against the surface of the place.

First all turns (and mirrors) on a lattice of rotations, judged by both distance fields at once, since a twin that
shrinks onto a single spot of the place would lie on its surface too; then iterated closest points with scale (P. Besl,
N. McKay, 1992; scale after T. Zinsser et al., 2005), in both directions for the same reason, trimmed of what only one
of them has (D. Chetverikov et al., 2002); and at last steps on the place's distance field (`refine`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError

from .chart import ALL, upright_basis
from .evidence import Fit, Progress, Target, angles, pair_covariance
from .grid import DistanceGrid
from .refine import refine
from .scores import AtZero
from .surface import PlaceSurface, surface_of_points, thinned
from .umeyama import MIRROR, fit_similarity, move, scale_of

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

    def fit(self, target: Target, progress: Progress) -> Fit:
        """The best placement. Raises `NergError` for a twin of too few points."""
        place = target.surface
        twin = _even(self.points, self.source)
        found: dict[bool, list[_Placed]] = {}
        for flip in (False, True):
            progress(0.1 + 0.4 * flip, "placing the mirrored twin" if flip else "placing the twin")
            found[flip] = _placed(move(MIRROR, twin) if flip else twin, place, target)
        best = found[False][0]
        s = scale_of(best.matrix)
        x, y, forth = _closest(twin, place.points, KDTree(place.points), KDTree(twin), best.matrix, _OVERLAP)
        basis = upright_basis(False) if target.upright else ALL
        off = _nearest(KDTree(place.points), move(best.matrix, twin))[0] / s
        kept = np.sort(off)[: int(_OVERLAP * len(off))]
        notes = [
            f"{len(twin):,} points of the twin; {_OVERLAP:.0%} of them lie within {100 * kept[-1]:.2g} cm",
            *_unit(s),
        ]
        mirrored = None
        if found[True][0].cost < _CLEAR * best.cost:
            flipped = found[True][0].cost / scale_of(found[True][0].matrix)
            mirrored = (
                f"with the x axis negated the twin fits to {100 * flipped:.3g} cm, as it is to "
                f"{100 * best.cost / s:.3g} cm only"
            )
        about = {"points": len(twin), "overlap": _OVERLAP, "mean_cm": 100 * best.cost / s}
        covariance = pair_covariance(x[forth], y[forth], best.matrix, basis)
        return Fit(
            target.to_place(best.matrix),
            100 * kept,
            angles(move(best.matrix, x.mean(axis=0)), move(best.matrix, x[forth]), y[forth]),
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
    return thinned(points, float(size) / 250)


def _placed(twin: np.ndarray, place: PlaceSurface, target: Target) -> list[_Placed]:
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
    for turn in _turns(target.upright):
        # All scales at once.
        moved = scales[:, None, None] * ((x - x0) @ turn.T) + y0
        back = ((y - y0) @ turn) / scales[:, None, None] + x0
        forth = place.distance.at(moved.reshape(-1, 3)).reshape(len(scales), -1)
        away = own.at(back.reshape(-1, 3)).reshape(len(scales), -1) * scales[:, None]
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
    found.sort(key=lambda f: f.cost / scale_of(f.matrix))
    x, y = few(twin, _FINE), few(place.points, 2 * _FINE)
    last = [_settled(x, y, f.matrix, place, own, target) for f in _different(found, place.diagonal)[:_LAST]]
    return sorted(last, key=lambda f: f.cost / scale_of(f.matrix))


def _turns(upright: bool) -> list[np.ndarray]:
    if upright:
        return [Rotation.from_rotvec([0, 0, a]).as_matrix() for a in 2 * np.pi * np.arange(60) / 60]
    return list(Rotation.from_quat(np.random.default_rng(0).normal(size=(_TURNS, 4))).as_matrix())


def _icp(x: np.ndarray, y: np.ndarray, matrix: np.ndarray, target: Target, most: int) -> _Placed:
    tree, own = KDTree(y), KDTree(x)
    cost = np.inf
    for k in range(most):
        # More is taken for common as the two come together.
        share = 0.6 + (_OVERLAP - 0.6) * min(1.0, 2 * k / most)
        a, b, _ = _closest(x, y, tree, own, matrix, share)
        matrix = fit_similarity(a, b, upright=target.upright, scale=target.scale)
        now = float(np.mean(np.linalg.norm(move(matrix, a) - b, axis=1)))
        if 2 * k > most and abs(cost - now) < 1e-5 * max(now, 1e-300):
            break
        cost = now
    return _Placed(matrix, cost)


def _settled(
    x: np.ndarray, y: np.ndarray, matrix: np.ndarray, place: PlaceSurface, twin: DistanceGrid, target: Target
) -> _Placed:
    """Closest points slide along surfaces by small steps; the distance field has the slope that leads there at once.

    The mean distance is that of both fields (``twin``: that of the twin), with what is far counted as no farther than
    it has to be to tell that it is.
    """
    matrix = _icp(x, y, matrix, target, 8).matrix
    near = _NEAR * place.diagonal / scale_of(matrix)
    basis = upright_basis(False) if target.upright else ALL
    basis = basis if target.scale is None else basis[:, :-1]
    center, own = move(matrix, x).mean(axis=0), np.arange(len(x))
    on_surface = AtZero(place.distance, x, own, "points of the twin on surfaces", near)
    for wide in (3.0, 1.0):
        matrix = refine([on_surface], matrix, center, basis, wide, 30).matrix
    s, most = scale_of(matrix), _FAR * place.diagonal
    forth = np.minimum(place.distance.at(move(matrix, x)), most)
    back = np.minimum(twin.at(move(np.linalg.inv(matrix), y)) * s, most)
    return _Placed(matrix, float(0.5 * (forth.mean() + back.mean())))


def _closest(
    x: np.ndarray, y: np.ndarray, tree: KDTree, own: KDTree, matrix: np.ndarray, share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of ``x`` and of ``y`` that belong together, (M, 3) each, nearest from either side, without those that are
    farthest apart; and which were found from the side of ``x``, (M,) bool."""
    forth, at = _nearest(tree, move(matrix, x))
    back, of = _nearest(own, move(np.linalg.inv(matrix), y))
    back = back * scale_of(matrix)
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
    turned = a.matrix[:3, :3] / scale_of(a.matrix) @ (b.matrix[:3, :3] / scale_of(b.matrix)).T
    angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
    return bool(angle > 10 or abs(np.log(scale_of(a.matrix) / scale_of(b.matrix))) > 0.1)


def _rivals(found: list[_Placed], size: float) -> list[str]:
    best = found[0]
    each = lambda f: f.cost / scale_of(f.matrix)
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
