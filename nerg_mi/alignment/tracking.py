"""Alignment from the tracking alone: heads in free space above the floor, gaze that ends on surfaces, hit points on
them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays

from .chart import ALL, upright_basis
from .evidence import Fit, Progress, Target
from .refine import Refined, groups_of, refine
from .scores import AtZero, GazeEnds, HeadHeight, Score
from .search import Guess, close, scale_range, search
from .surface import PlaceSurface
from .umeyama import MIRROR, move, scale_of

MOST = 4000
"""Rays that are looked at, evenly chosen over people."""

_FEW = 400
# Gaze without hit points is looked along for one of so many rays: it tells little, and takes long.
_SPARED = 5
# Of the way to a hit point; the last tenth may graze what it ends on.
_ALONG = 0.4, 0.8
# Gaze without a hit point is free for so many metres.
_ARM = 0.2, 0.4
# A mirrored tracking is told where it is so much better, and a rival placement where it is almost as good.
_CLEAR, _RIVAL = 0.75, 1.15


@dataclass(frozen=True, eq=False)
class Tracking:
    """``rays`` of attention, z up, metres; ``start``: a similarity (4, 4) to the place that is refined, None: it is
    looked for."""

    rays: Rays
    start: np.ndarray | None = None

    kind = "tracking"

    def fit(self, target: Target, progress: Progress) -> Fit:
        """The best placement. Raises `NergError` where the rays leave it open."""
        surface = target.surface
        some = _sample(self.rays)
        if self.start is not None:
            progress(0.5, "refining")
            coarse = _refined(some, surface, target, target.turn @ self.start, 3.0, 30)
            return self._fit_of(_refined(some, surface, target, coarse.matrix, 1.0, 60), some, target, [], None)
        if not target.upright:
            raise NergError(
                "from the tracking alone only its turn about the vertical is looked for: say which way is up in the "
                "place (--up), or give other evidence (--pairs, --twin, --cameras)"
            )
        if target.floor is None:
            raise NergError("from the tracking alone the height of its floor must be known; give it with --floor")
        if target.scale is None and not len(some.hits):
            raise NergError(
                "rays without hit points do not tell how large the place is: give --scale (1 where the place is in "
                "metres), or other evidence (--pairs)"
            )
        progress(0.1, "looking for the place of the tracking")
        proper = _searched(some, surface, target)
        if not len(some.hits):
            # Free space has room for many placements, mirrored ones too: heads cannot tell them apart.
            return self._fit_of(proper[0], some, target, [], None)
        progress(0.55, "looking for the place of the mirrored tracking")
        mirrored = _searched(some.mirrored(), surface, target)
        doubts = []
        for other in proper[1:]:
            alike = close(proper[0].matrix, other.matrix, 0.05 * surface.diagonal)
            if not alike and other.cost < _RIVAL * proper[0].cost:
                doubts.append(
                    f"another placement agrees almost as well (cost {other.cost:.3f}, the best {proper[0].cost:.3f}): "
                    "the place may look alike from two sides; settle it with picked points (--pairs)"
                )
                break
        sentence = None
        if mirrored[0].cost < _CLEAR * proper[0].cost:
            sentence = (
                f"with an axis of the tracking negated it agrees with the place (cost {mirrored[0].cost:.3f}), and as "
                f"it is it does not (cost {proper[0].cost:.3f})"
            )
        return self._fit_of(proper[0], some, target, doubts, sentence)

    def _fit_of(self, best: Refined, some: _Sample, target: Target, doubts: list[str], mirrored: str | None) -> Fit:
        surface, s = target.surface, scale_of(best.matrix)
        points = some.hits if len(some.hits) else some.heads
        grid = surface.distance if len(some.hits) else surface.blocked
        off = grid.at(move(best.matrix, points)) / s
        degrees = np.zeros(0)
        if len(some.hits):
            way = np.linalg.norm(some.hits - some.hit_heads, axis=1)
            degrees = np.degrees(np.arctan2(off, np.maximum(way, 1e-6)))
        inside = surface.blocked.at(move(best.matrix, some.heads)) / s
        about = {
            "rays": len(self.rays),
            "looked_at": len(some.heads),
            "hits": len(some.hits),
            "cost": best.cost,
            "heads_in_solids": float((inside > 0.1).mean()),
        }
        notes = [
            f"{len(some.heads):,} heads, of which {100 * (inside > 0.1).mean():.1f} % are more than 10 cm inside of "
            f"something; {len(some.hits):,} hit points"
        ]
        if not len(some.hits):
            doubts = [*doubts, "without hit points only heads tell: look at the picture before you trust it"]
        return Fit(
            target.to_place(best.matrix),
            100 * off,
            degrees,
            # Heads alone may be moved about in free space at no cost, of which derivatives know nothing.
            best.covariance if len(some.hits) else None,
            mirrored,
            points,
            None,
            about,
            notes,
            doubts,
        )


@dataclass(frozen=True, eq=False)
class _Sample:
    """Some of the rays: ``heads`` (N, 3) with their ``directions`` and ``group`` (N,), the ``hits`` (M, 3) that the
    heads ``at`` (M,) look at, and points (K, 3) that the gaze of the heads ``of`` (K,) ``passed``."""

    heads: np.ndarray
    directions: np.ndarray
    group: np.ndarray
    hits: np.ndarray
    at: np.ndarray
    passed: np.ndarray
    of: np.ndarray

    @property
    def hit_heads(self) -> np.ndarray:
        """Where each hit point was looked at from, (M, 3)."""
        return self.heads[self.at]

    def mirrored(self) -> _Sample:
        """The same in a mirror."""
        moved = {k: move(MIRROR, getattr(self, k)) for k in ("heads", "directions", "hits", "passed")}
        return replace(self, **moved)

    def few(self, count: int) -> _Sample:
        """Fewer of them."""
        kept = np.arange(0, len(self.heads), max(1, len(self.heads) // count))
        new = np.full(len(self.heads), -1)
        new[kept] = np.arange(len(kept))
        hit, way = new[self.at] >= 0, new[self.of] >= 0
        return _Sample(
            self.heads[kept],
            self.directions[kept],
            self.group[kept],
            self.hits[hit],
            new[self.at[hit]],
            self.passed[way],
            new[self.of[way]],
        )

    def scores(self, surface: PlaceSurface, target: Target) -> list[Score]:
        """What is known of them in the place; free space is not, where the place is bare points."""
        out: list[Score] = [HeadHeight(target.place_level, self.heads, self.group)] if target.upright else []
        if len(self.hits):
            out.append(AtZero(surface.distance, self.hits, self.group[self.at], "hit points on surfaces"))
        else:
            some = slice(None, None, _SPARED)
            out.append(GazeEnds(surface, self.heads[some], self.directions[some], self.group[some]))
        if surface.bounded:
            out.append(AtZero(surface.blocked, self.heads, self.group, "heads in free space"))
            out.append(AtZero(surface.blocked, self.passed, self.group[self.of], "gaze through free space"))
        return out


def _sample(rays: Rays) -> _Sample:
    if not len(rays):
        raise NergError("there are no rays to align; give a file that holds some")
    rng = np.random.default_rng(0)
    # Everybody counts as much as they were there, and strays of the tracker are chosen as seldom as they are.
    kept = np.sort(rng.permutation(len(rays))[:MOST])
    heads, directions = rays.origin[kept], rays.direction[kept]
    group = groups_of(rays.person[kept], rays.t[kept])
    known = np.zeros(len(kept), bool) if rays.hit is None else np.isfinite(rays.hit[kept]).all(axis=1)
    at = np.flatnonzero(known)
    hits = np.zeros((0, 3)) if rays.hit is None else rays.hit[kept][known]
    way = hits - heads[at]
    arm = np.flatnonzero(~known)
    passed = [heads[at] + a * way for a in _ALONG] + [heads[arm] + a * directions[arm] for a in _ARM]
    of = np.concatenate([at] * len(_ALONG) + [arm] * len(_ARM))
    return _Sample(heads, directions, group, hits, at, np.concatenate(passed), of)


def _searched(some: _Sample, surface: PlaceSurface, target: Target) -> list[Refined]:
    """The best placements, best first."""
    assert target.floor is not None
    floor = (target.floor, target.place_level)
    free = np.concatenate([some.heads, some.passed]) if surface.bounded else some.heads
    scales = np.array([target.scale]) if target.scale is not None else scale_range(surface, some.hits)
    guesses: list[Guess] = search(surface, some.hits, free, scales, floor)
    few = some.few(_FEW)
    found = [_refined(few, surface, target, g.matrix, 4.0, 12) for g in guesses]
    found = [_refined(few, surface, target, f.matrix, 1.5, 20) for f in sorted(found, key=lambda f: f.cost)[:6]]
    last = [_refined(some, surface, target, f.matrix, 1.0, 30) for f in sorted(found, key=lambda f: f.cost)[:2]]
    return sorted(last, key=lambda f: f.cost)


def _refined(some: _Sample, surface: PlaceSurface, target: Target, base: np.ndarray, wide: float, most: int) -> Refined:
    center = move(base, np.median(some.heads, axis=0))
    if target.upright and target.floor is not None:
        center[2] = target.place_level
    basis = upright_basis(target.floor is not None) if target.upright else ALL
    if target.scale is not None:
        basis = basis[:, :-1]
    return refine(some.scores(surface, target), base, center, basis, wide, most)
