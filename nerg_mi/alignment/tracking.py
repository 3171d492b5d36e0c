"""Alignment from tracking alone: the first guess, the scores of heads, gaze and hit points, and mirrored axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy import fft
from scipy.stats import wilcoxon

from nerg_mi.errors import NergError
from nerg_mi.rays.direction_checks import DECLARED, AXIS_SWAPS, compute_head_frames
from nerg_mi.rays.rays import Rays

from .constraints import AlignmentFit, AlignmentTarget, PlaceSurface, Progress
from .icp import AtZero, GazeEnds, HeadHeight, RefinedAlignment, Score, groups_of, refine
from .similarity import ALL, MIRROR, transform_points, similarity_scale, upright_basis

# ---- Flips ----
#
# Directions with an axis negated, told by the points of a place: gaze goes to what is there, a mirrored one beside it.
#
# Rooms are closed: nearly every ray ends on a surface, negated or not. But points, as cameras triangulate them, lie on
# what there is to see, and gaze passes within a fraction of a degree of one.

MAX_RAYS, POINTS = 400, 100_000  # So many rays are looked at, and so many points

# A flip is told where it is so much better at the median, and better in more rays than chance would have it.
_BETTER, _CHANCE = 0.75, 1e-4
_FEWEST = 30


@dataclass(frozen=True, eq=False)
class Flips:
    """``degrees``: by the name of what is negated, the angle (N,) from each ray to the nearest point."""

    degrees: dict[str, np.ndarray]

    def warning(self) -> str | None:
        """A sentence where gaze is nearer to the points with an axis negated than `DECLARED`; None elsewhere."""
        declared = self.degrees[DECLARED]
        if len(declared) < _FEWEST:
            return None
        best = min(self.degrees, key=lambda name: float(np.median(self.degrees[name])))
        there, here = float(np.median(self.degrees[best])), float(np.median(declared))
        if best == DECLARED or there > _BETTER * here:
            return None
        _, chance = wilcoxon(self.degrees[best], declared, alternative="less")
        if cast("float", chance) > _CHANCE:
            return None
        return (
            f"the gaze passes {here:.2g} degrees from the nearest point of the place (median), and {there:.2g} with "
            f"{best}: check the axes of the directions at the import (--hand, --forward, or a sign in --map)"
        )


def compare_flips(
    points: np.ndarray, matrix: np.ndarray, origin: np.ndarray, direction: np.ndarray, head: np.ndarray | None = None
) -> Flips:
    """How near gaze comes to ``points`` (M, 3) of a place, as it is and with an axis negated.

    ``matrix``: similarity (4, 4) from the tracking to the place; ``origin``, ``direction`` (N, 3), unit, and ``head``
    (N, 3), where heads point or None where nobody knows, of the tracking, z up. Negated are the axes of the tracking,
    and, where heads are known, left and right or up and down in the head. Rays and points beyond `RAYS` and `POINTS`
    are left out, at random.
    """
    rng = np.random.default_rng(0)
    some = rng.permutation(len(origin))[:MAX_RAYS]
    points = points[rng.permutation(len(points))[:POINTS]]
    origin, direction = transform_points(matrix, origin[some]), direction[some]
    turn = matrix[:3, :3] / similarity_scale(matrix)
    kinds = {DECLARED: direction}
    kinds |= {f"{'xyz'[k]} of the directions negated": direction * np.where(np.arange(3) == k, -1, 1) for k in range(3)}
    if head is not None:
        known = np.all(np.isfinite(head[some]), axis=1, keepdims=True)
        frames = compute_head_frames(head[some])
        own = np.einsum("nij,nj->ni", frames, direction)
        for what, signs in AXIS_SWAPS.items():
            mirrored = np.einsum("nij,ni->nj", frames, own * signs)
            kinds[f"{what} of the eyes exchanged"] = np.where(known, mirrored, direction)
    turned = np.stack([kind @ turn.T for kind in kinds.values()], axis=1)
    found = np.empty(turned.shape[:2])
    for k, (eye, ways) in enumerate(zip(origin, turned)):
        to = points - eye
        to = to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-12)
        # By the chord: the arc of a cosine loses small angles.
        nearest = to[np.argmax(to @ ways.T, axis=0)]
        found[k] = np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(nearest - ways, axis=1) / 2, 1)))
    return Flips(dict(zip(kinds, found.T)))


# ---- Search ----
#
# Where tracking lies in a place, from nothing but the tracking, where up and the floor are known: the first guess.
#
# For every turn about the vertical and every scale, all shifts at once: hit points are counted on the place's lattice
# and correlated, by fast Fourier transforms level by level, with how near its surfaces are; heads likewise with free
# space.

NEAR = 0.25  # Metres within which a hit point counts as on a surface, at this stage
_TURNS, _CELLS, _KEPT = 36, 48, 16
_MOST = 4000


@dataclass(frozen=True, eq=False)
class Guess:
    """``matrix`` (4, 4) from the tracking to the place, and its score, 1 where all is well."""

    matrix: np.ndarray
    score: float


def scale_range(surface: PlaceSurface, points: np.ndarray) -> np.ndarray:
    """Scales to be tried for ``points`` (N, 3) that lie on surfaces: from what lets them fill the place, down to a
    third of it, since people may have walked in a part of it; in steps of eight percent."""
    size = lambda p: float(np.linalg.norm(np.subtract(*np.percentile(p, [98, 2], axis=0))[:2]))
    most = 1.25 * size(surface.points) / max(size(points), 1e-9)
    return most / 1.08 ** np.arange(15)


def search_placements(
    surface: PlaceSurface,
    hits: np.ndarray,
    free: np.ndarray,
    scales: Sequence[float] | np.ndarray,
    floor_heights: tuple[float, float],
    turns: int = _TURNS,
    max_guesses: int = _KEPT,
) -> list[Guess]:
    """The best guesses, best first.

    ``hits`` (N, 3), which may be none, and ``free`` (M, 3), heads and what gaze passes, in the frame of the tracking;
    ``floor``: its height there and in the place.
    """
    rng = np.random.default_rng(0)
    some = lambda p: p[rng.permutation(len(p))[:_MOST]]
    hits, free = some(hits), some(free)
    found: list[Guess] = []
    low, high = surface.distance.lower, surface.distance.upper
    for scale in scales:
        maps = _Maps(surface, low, high, scale)
        for angle in 2 * np.pi * np.arange(turns) / turns:
            found += maps.best(hits, free, angle, floor_heights)
    found.sort(key=lambda g: -g.score)
    return _apart(found, max_guesses, 0.05 * surface.diagonal)


class _Maps:
    """A place on a coarse lattice, for one scale: what a point of either kind is worth in each cell."""

    def __init__(self, surface: PlaceSurface, low: np.ndarray, high: np.ndarray, scale: float):
        self.scale, self.low = scale, low
        self.cell = float(np.max((high - low)[:2])) / _CELLS
        self.shape = np.maximum(np.ceil((high - low) / self.cell).astype(int), 1)
        nodes = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1)
        nodes = low + self.cell * (nodes.reshape(-1, 3) + 0.5)
        wide = max(NEAR * scale, 0.7 * self.cell)
        on = np.exp(-0.5 * (surface.distance.interpolate(nodes) / wide) ** 2)
        open_ = np.exp(-0.5 * (surface.blocked.interpolate(nodes) / wide) ** 2)
        # Twice as wide, so that what leaves it on one side does not come in on the other.
        next_length: Any = fft.next_fast_len  # the stubs know no result
        self.size = [next_length(2 * int(n), real=True) for n in self.shape[:2]]
        levels = lambda v: np.asarray(fft.rfft2(_by_level(v.reshape(self.shape)), self.size, axes=(1, 2)))
        self.on, self.open = levels(on), levels(open_)

    def best(self, hits: np.ndarray, free: np.ndarray, angle: float, floor: tuple[float, float]) -> list[Guess]:
        """The best shifts of a turn."""
        cos, sin = np.cos(angle), np.sin(angle)
        turn = self.scale * np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        lift = floor[1] - self.scale * floor[0]
        corner = None
        total = np.zeros(self.size)
        for points, maps in ((hits, self.on), (free, self.open)):
            if not len(points):
                continue
            moved = points @ turn.T + (0, 0, lift)
            if corner is None:
                corner = np.percentile(np.concatenate([moved, free @ turn.T + (0, 0, lift)])[:, :2], 1, axis=0)
            total += self._correlation(moved, corner, maps)
        assert corner is not None
        parts = (len(hits) > 0) + (len(free) > 0)
        out = []
        for _ in range(2):
            at = np.array(np.unravel_index(int(np.argmax(total)), total.shape))
            score = float(total[tuple(at)]) / parts
            shift = np.where(at > np.array(self.size) // 2, at - self.size, at) * self.cell
            matrix = np.eye(4)
            matrix[:3, :3] = turn
            matrix[:3, 3] = *(self.low[:2] + shift - corner), lift
            out.append(Guess(matrix, score))
            # The next one is another one.
            rows, columns = ((at[a] + np.arange(-3, 4)) % self.size[a] for a in (0, 1))
            total[np.ix_(rows, columns)] = -1
        return out

    def _correlation(self, moved: np.ndarray, corner: np.ndarray, maps: np.ndarray) -> np.ndarray:
        """Mean worth of points for every shift of ``corner`` to a cell."""
        index = np.floor((moved - (*corner, self.low[2])) / self.cell).astype(int)
        # Beyond the lattice, and in cells that wrap around, nothing is worth anything.
        inside = ((index >= (0, 0, 0)) & (index < (*self.shape[:2], self.shape[2]))).all(axis=1)
        flat = np.ravel_multi_index(tuple(index[inside].T), self.shape)
        count = np.bincount(flat, minlength=int(np.prod(self.shape))).reshape(self.shape)
        spectrum = np.asarray(fft.rfft2(_by_level(count), self.size, axes=(1, 2)))
        joint = np.einsum("zxy,zxy->xy", np.conj(spectrum), maps)
        return np.asarray(fft.irfft2(joint, self.size)) / max(len(moved), 1)


def _by_level(values: np.ndarray) -> np.ndarray:
    """(nx, ny, nz) as (nz, nx, ny); single precision is enough for a guess."""
    return np.ascontiguousarray(np.moveaxis(values, 2, 0), np.float32)


def is_close(a: np.ndarray, b: np.ndarray, distance: float) -> bool:
    """Whether two similarities (4, 4) are of the same placement: within a ``distance`` in the place, and a fifth of
    turn and scale."""
    turned = np.linalg.norm(a[:3, :3] - b[:3, :3]) < 0.2 * np.linalg.norm(b[:3, :3])
    return bool(turned and np.linalg.norm(a[:3, 3] - b[:3, 3]) < distance)


def _apart(found: list[Guess], count: int, distance: float) -> list[Guess]:
    """The first ``count`` that are not close to a better one."""
    out: list[Guess] = []
    for guess in found:
        if not any(is_close(guess.matrix, o.matrix, distance) for o in out):
            out.append(guess)
        if len(out) == count:
            break
    return out


# ---- Tracking ----
#
# Alignment from the tracking alone: heads in free space above the floor, gaze that ends on surfaces, hit points on
# them.

MAX_SAMPLES = 4000  # Rays that are looked at, evenly chosen over people
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
    initial: np.ndarray | None = None

    kind = "tracking"

    def fit(self, target: AlignmentTarget, progress: Progress) -> AlignmentFit:
        """The best placement. Raises `NergError` where the rays leave it open."""
        some = _sample(self.rays)
        if self.initial is not None:
            progress(0.5, "refining")
            coarse = _refined(some, target, target.to_z_up @ self.initial, 3.0, 30)
            return self._fit_of(_refined(some, target, coarse.matrix, 1.0, 60), some, target, [], None)
        if not target.is_upright:
            raise NergError(
                "from the tracking alone only its turn about the vertical is looked for: say which way is up in the "
                "place (--up), or give other evidence (--pairs, --twin, --cameras)"
            )
        if target.tracking_floor is None:
            raise NergError("from the tracking alone the height of its floor must be known; give it with --floor")
        if target.scale is None and not len(some.hits):
            raise NergError(
                "rays without hit points do not tell how large the place is: give --scale (1 where the place is in "
                "metres), or other evidence (--pairs)"
            )
        progress(0.1, "looking for the place of the tracking")
        proper = _searched(some, target)
        if not len(some.hits):
            # Free space has room for many placements, mirrored ones too: heads cannot tell them apart.
            return self._fit_of(proper[0], some, target, [], None)
        progress(0.55, "looking for the place of the mirrored tracking")
        mirrored = _searched(some.mirrored(), target)
        doubts = []
        for other in proper[1:]:
            alike = is_close(proper[0].matrix, other.matrix, 0.05 * target.surface.diagonal)
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

    def _fit_of(
        self, best: RefinedAlignment, some: _Sample, target: AlignmentTarget, doubts: list[str], mirrored: str | None
    ) -> AlignmentFit:
        surface, s = target.surface, similarity_scale(best.matrix)
        points = some.hits if len(some.hits) else some.heads
        grid = surface.distance if len(some.hits) else surface.blocked
        off = grid.interpolate(transform_points(best.matrix, points)) / s
        degrees = np.zeros(0)
        if len(some.hits):
            way = np.linalg.norm(some.hits - some.hit_heads, axis=1)
            degrees = np.degrees(np.arctan2(off, np.maximum(way, 1e-6)))
        inside = surface.blocked.interpolate(transform_points(best.matrix, some.heads)) / s
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
        return AlignmentFit(
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
        moved = {k: transform_points(MIRROR, getattr(self, k)) for k in ("heads", "directions", "hits", "passed")}
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

    def scores(self, target: AlignmentTarget) -> list[Score]:
        """What is known of them in the place; free space is not, where the place is bare points."""
        surface = target.surface
        out: list[Score] = [HeadHeight(target.place_level, self.heads, self.group)] if target.is_upright else []
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
    kept = np.sort(rng.permutation(len(rays))[:MAX_SAMPLES])
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


def _searched(some: _Sample, target: AlignmentTarget) -> list[RefinedAlignment]:
    """The best placements, best first."""
    assert target.tracking_floor is not None
    surface, floor = target.surface, (target.tracking_floor, target.place_level)
    free = np.concatenate([some.heads, some.passed]) if surface.bounded else some.heads
    scales = np.array([target.scale]) if target.scale is not None else scale_range(surface, some.hits)
    guesses: list[Guess] = search_placements(surface, some.hits, free, scales, floor)
    few = some.few(_FEW)
    found = [_refined(few, target, g.matrix, 4.0, 12) for g in guesses]
    found = [_refined(few, target, f.matrix, 1.5, 20) for f in sorted(found, key=lambda f: f.cost)[:6]]
    last = [_refined(some, target, f.matrix, 1.0, 30) for f in sorted(found, key=lambda f: f.cost)[:2]]
    return sorted(last, key=lambda f: f.cost)


def _refined(some: _Sample, target: AlignmentTarget, base: np.ndarray, wide: float, most: int) -> RefinedAlignment:
    center = transform_points(base, np.median(some.heads, axis=0))
    if target.is_upright and target.tracking_floor is not None:
        center[2] = target.place_level
    basis = upright_basis(target.tracking_floor is not None) if target.is_upright else ALL
    if target.scale is not None:
        basis = basis[:, :-1]
    return refine(some.scores(target), base, center, basis, wide, most)
