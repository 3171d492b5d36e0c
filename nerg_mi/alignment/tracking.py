"""Alignment from tracking alone: initial search, scores of heads, gaze and hit points, and mirrored axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy import fft
from scipy.stats import wilcoxon

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.transforms import similarity_scale, transform_points
from nerg_mi.tracking.direction_checks import AXIS_SWAPS, DECLARED, compute_head_frames
from nerg_mi.tracking.rays import Rays

from .constraints import AlignmentFit, AlignmentTarget, ProgressCallback, SceneSurface
from .icp import GazeEnds, HeadHeight, RefinedAlignment, Score, ZeroDistance, independent_groups, refine
from .profile import Profile, evaluate_by_group, make_profile
from .similarity import MIRROR, vertical_rotation

# ---- Flipped axes ----
#
# Detects directions with a negated axis by the points of a scene: gaze is directed at objects, mirrored gaze is not.
#
# Rooms are closed, so nearly every ray meets a surface, flipped or not. But triangulated points lie on visible
# features, and gaze passes within a fraction of a degree of one.

MAX_RAYS, MAX_POINTS = 400, 100_000  # maximum numbers of rays and of points

# A flip is reported below this ratio of median angles and this p-value.
_FLIP_RATIO, _FLIP_P_VALUE = 0.75, 1e-4
_MIN_FLIP_RAYS = 30


@dataclass(frozen=True, eq=False)
class AxisFlips:
    """Angles in degrees (N,) from each ray to the scene point nearest in angle, by the name of the flip or none."""

    degrees: dict[str, np.ndarray]

    def warning(self) -> str | None:
        """Return a message if gaze is closer to the points with a flip than as declared, else None."""
        declared = self.degrees[DECLARED]
        if len(declared) < _MIN_FLIP_RAYS:
            return None
        best = min(self.degrees, key=lambda name: float(np.median(self.degrees[name])))
        best_median, declared_median = float(np.median(self.degrees[best])), float(np.median(declared))
        if best == DECLARED or best_median > _FLIP_RATIO * declared_median:
            return None
        _, p_value = wilcoxon(self.degrees[best], declared, alternative="less")
        if cast("float", p_value) > _FLIP_P_VALUE:
            return None
        return (
            f"the gaze passes {declared_median:.2g} degrees from the nearest point of the scene (median), but "
            f"{best_median:.2g} with {best}: check the axes of the directions at the import "
            f"({parameter('handedness')}, {parameter('forward')}, or a sign in {parameter('columns')})"
        )


def compare_flips(
    points: np.ndarray, matrix: np.ndarray, origin: np.ndarray, direction: np.ndarray, head: np.ndarray | None = None
) -> AxisFlips:
    """Measure how close gaze comes to the points of a scene, as declared and with an axis negated.

    Axes of the tracking are negated and, if head directions are known, left and right or up and down in the head.

    Parameters
    ----------
    points
        Points of the scene, (M, 3).
    matrix
        Similarity (4, 4) from the tracking to the scene.
    origin, direction, head
        Origins, unit gaze directions and head directions (N, 3) of the tracking, z up; ``head`` is None if unknown.
    """
    rng = np.random.default_rng(0)
    subset = rng.permutation(len(origin))[:MAX_RAYS]
    points = points[rng.permutation(len(points))[:MAX_POINTS]]
    origin, direction = transform_points(matrix, origin[subset]), direction[subset]
    rotation = matrix[:3, :3] / similarity_scale(matrix)
    variants = {DECLARED: direction}
    variants |= {
        f"{'xyz'[k]} of the directions negated": direction * np.where(np.arange(3) == k, -1, 1) for k in range(3)
    }
    if head is not None:
        is_known = np.all(np.isfinite(head[subset]), axis=1, keepdims=True)
        frames = compute_head_frames(head[subset])
        local = np.einsum("nij,nj->ni", frames, direction)
        for what, signs in AXIS_SWAPS.items():
            mirrored = np.einsum("nij,ni->nj", frames, local * signs)
            variants[f"{what} of the eyes exchanged"] = np.where(is_known, mirrored, direction)
    rotated = np.stack([kind @ rotation.T for kind in variants.values()], axis=1)
    angles = np.empty(rotated.shape[:2])
    for k, (eye, directions) in enumerate(zip(origin, rotated)):
        to_points = points - eye
        to_points = to_points / np.maximum(np.linalg.norm(to_points, axis=1, keepdims=True), 1e-12)
        # The chord is accurate for small angles; arccos is not.
        nearest = to_points[np.argmax(to_points @ directions.T, axis=0)]
        angles[k] = np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(nearest - directions, axis=1) / 2, 1)))
    return AxisFlips(dict(zip(variants, angles.T)))


# ---- Search ----
#
# Initial placement from the tracking alone, for known up direction and floor.
#
# For every rotation about the vertical axis and every scale, all shifts are scored at once: hit points are binned on a
# lattice and correlated, by fast Fourier transforms per level, with the proximity to surfaces, and heads with the
# proximity to free space.

HIT_DISTANCE = 0.25  # tolerance in metres of hit points on surfaces during the search
_TURNS = 2 * np.pi * np.arange(36) / 36
_NUM_CELLS, _MAX_GUESSES = 48, 16
_MAX_SEARCH_POINTS = 4000


@dataclass(frozen=True, eq=False)
class Guess:
    """A similarity (4, 4) from the tracking to the scene, with its score (1 is best)."""

    matrix: np.ndarray
    score: float


def candidate_scales(surface: SceneSurface, points: np.ndarray, count: int = 15) -> np.ndarray:
    """Return candidate scales for ``points`` (N, 3) on surfaces.

    They range from the scale at which the points fill the scene down to a third of it, in ``count`` steps of eight
    percent, since participants may have visited only a part of the scene.
    """
    size = lambda p: float(np.linalg.norm(np.subtract(*np.percentile(p, [98, 2], axis=0))[:2]))
    max_scale = 1.25 * size(surface.points) / max(size(points), 1e-9)
    return max_scale / 1.08 ** np.arange(count)


def search_placements(
    surface: SceneSurface,
    hits: np.ndarray,
    free_points: np.ndarray,
    scales: Sequence[float] | np.ndarray,
    floor_heights: tuple[float, float],
    turns: Sequence[float] | np.ndarray = _TURNS,
    max_guesses: int = _MAX_GUESSES,
) -> list[Guess]:
    """Return the best placements, best first.

    Parameters
    ----------
    surface
        Surface of the scene.
    hits, free_points
        Hit points (N, 3), possibly none, and points in free space (M, 3), in the frame of the tracking.
    scales
        Candidate scales.
    floor_heights
        Height of the floor in the tracking and in the scene.
    turns
        Candidate rotations about the vertical axis, in radians.
    max_guesses
        Maximum number of results.
    """
    rng = np.random.default_rng(0)
    draw = lambda p: p[rng.permutation(len(p))[:_MAX_SEARCH_POINTS]]
    hits, free_points = draw(hits), draw(free_points)
    guesses: list[Guess] = []
    low, high = surface.distance.lower, surface.distance.upper
    for scale in scales:
        maps = _CorrelationMaps(surface, low, high, scale)
        for angle in turns:
            guesses += maps.best(hits, free_points, angle, floor_heights)
    guesses.sort(key=lambda g: -g.score)
    return _distinct_guesses(guesses, max_guesses, 0.05 * surface.diagonal)


class _CorrelationMaps:
    """Scores of surface points and free points on a coarse lattice, for one scale."""

    def __init__(self, surface: SceneSurface, low: np.ndarray, high: np.ndarray, scale: float):
        self.scale, self.low = scale, low
        self.cell = float(np.max((high - low)[:2])) / _NUM_CELLS
        self.shape = np.maximum(np.ceil((high - low) / self.cell).astype(int), 1)
        nodes = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1)
        nodes = low + self.cell * (nodes.reshape(-1, 3) + 0.5)
        width = max(HIT_DISTANCE * scale, 0.7 * self.cell)
        surface_score = np.exp(-0.5 * (surface.distance.interpolate(nodes) / width) ** 2)
        free_score = np.exp(-0.5 * (surface.free_space_distance.interpolate(nodes) / width) ** 2)
        # Zero padding prevents wrap-around.
        next_length: Any = fft.next_fast_len  # the stubs know no result
        self.size = [next_length(2 * int(n), real=True) for n in self.shape[:2]]
        levels = lambda v: np.asarray(fft.rfft2(_levels_first(v.reshape(self.shape)), self.size, axes=(1, 2)))
        self.surface_maps, self.free_maps = levels(surface_score), levels(free_score)

    def best(self, hits: np.ndarray, free: np.ndarray, angle: float, floor: tuple[float, float]) -> list[Guess]:
        """Return the best shifts for one rotation."""
        rotation = self.scale * vertical_rotation(angle)
        offset_z = floor[1] - self.scale * floor[0]
        corner = None
        total = np.zeros(self.size)
        for points, maps in ((hits, self.surface_maps), (free, self.free_maps)):
            if not len(points):
                continue
            moved = points @ rotation.T + (0, 0, offset_z)
            if corner is None:
                corner = np.percentile(np.concatenate([moved, free @ rotation.T + (0, 0, offset_z)])[:, :2], 1, axis=0)
            total += self._correlation(moved, corner, maps)
        assert corner is not None
        parts = (len(hits) > 0) + (len(free) > 0)
        out = []
        for _ in range(2):
            index = np.array(np.unravel_index(int(np.argmax(total)), total.shape))
            score = float(total[tuple(index)]) / parts
            shift = np.where(index > np.array(self.size) // 2, index - self.size, index) * self.cell
            matrix = np.eye(4)
            matrix[:3, :3] = rotation
            matrix[:3, 3] = *(self.low[:2] + shift - corner), offset_z
            out.append(Guess(matrix, score))
            # Suppress the neighbourhood, so that the next maximum is a different placement.
            rows, columns = ((index[a] + np.arange(-3, 4)) % self.size[a] for a in (0, 1))
            total[np.ix_(rows, columns)] = -1
        return out

    def _correlation(self, moved: np.ndarray, corner: np.ndarray, maps: np.ndarray) -> np.ndarray:
        """Return the mean score of the points for every shift."""
        index = np.floor((moved - (*corner, self.low[2])) / self.cell).astype(int)
        # Points outside the lattice score 0.
        inside = ((index >= (0, 0, 0)) & (index < (*self.shape[:2], self.shape[2]))).all(axis=1)
        flat = np.ravel_multi_index(tuple(index[inside].T), self.shape)
        count = np.bincount(flat, minlength=int(np.prod(self.shape))).reshape(self.shape)
        spectrum = np.asarray(fft.rfft2(_levels_first(count), self.size, axes=(1, 2)))
        joint = np.einsum("zxy,zxy->xy", np.conj(spectrum), maps)
        return np.asarray(fft.irfft2(joint, self.size)) / max(len(moved), 1)


def _levels_first(values: np.ndarray) -> np.ndarray:
    """Reorder (nx, ny, nz) to (nz, nx, ny) in single precision."""
    return np.ascontiguousarray(np.moveaxis(values, 2, 0), np.float32)


def is_close(a: np.ndarray, b: np.ndarray, distance: float) -> bool:
    """Return whether two similarities (4, 4) are the same placement.

    Their translations differ by less than ``distance``, and their 3 x 3 parts, rotation and scale together, by less
    than 20 % of that of ``b`` in the Frobenius norm.
    """
    is_same_rotation = np.linalg.norm(a[:3, :3] - b[:3, :3]) < 0.2 * np.linalg.norm(b[:3, :3])
    return bool(is_same_rotation and np.linalg.norm(a[:3, 3] - b[:3, 3]) < distance)


def _distinct_guesses(guesses: list[Guess], count: int, distance: float) -> list[Guess]:
    """Return the first ``count`` guesses that are not close to a better one."""
    out: list[Guess] = []
    for guess in guesses:
        if not any(is_close(guess.matrix, o.matrix, distance) for o in out):
            out.append(guess)
        if len(out) == count:
            break
    return out


# ---- Tracking ----
#
# Alignment from the tracking alone: heads are in free space above the floor, gaze ends on surfaces, hit points lie on
# surfaces.

MAX_SAMPLES = 4000  # maximum number of samples
_NUM_COARSE, _NUM_PROFILED = 400, 600
# Number of candidate scales, down to a tenth, for heads, which visit a small part of a scene.
_NUM_HEAD_SCALES = 30
# Stride of the samples without hit points, which are expensive and carry little information.
_GAZE_STRIDE = 5
# Fractions of the path to a hit point that are tested for free space; the last part may graze the surface.
_FREE_FRACTIONS = 0.4, 0.8
# Distances in metres along gaze without a hit point that are tested for free space.
_FREE_LENGTHS = 0.2, 0.4
# Cost ratio below which a mirrored tracking is reported, and below which another placement is reported.
_MIRROR_RATIO, _RIVAL_RATIO = 0.75, 1.15


@dataclass(frozen=True, eq=False)
class Tracking:
    """Gaze samples, z up, in metres, and an initial similarity (4, 4) to refine; None: search for it.

    ``seed``: that of the resamples of an interval.
    """

    rays: Rays
    initial: np.ndarray | None = None
    seed: int = 0

    kind = "tracking"

    def fit(self, target: AlignmentTarget, progress: ProgressCallback) -> AlignmentFit:
        """Find the best placement. Raises `NergError` if the samples do not determine it."""
        sample = _draw_sample(self.rays)
        if self.initial is not None:
            progress(0.5, "refining")
            initial = target.constrain(target.to_z_up @ self.initial, sample.heads)
            coarse = _refine_sample(sample, target, initial, 3.0, 30)
            best = _refine_sample(sample, target, coarse.matrix, 1.0, 60)
            profile = None if len(sample.hits) else profile_sample(sample, target, best.matrix, [])
            return self._make_fit(best, sample, target, [], None, profile)
        if not target.is_upright:
            raise NergError(
                "an alignment from the tracking alone needs the up direction of the scene: give "
                f"{parameter('up')}, or other evidence ({parameter('pairs')}, {parameter('tracking_surface')}, "
                f"{parameter('tracking_cameras')})"
            )
        if target.tracking_floor is None:
            raise NergError(
                "an alignment from the tracking alone needs the height of the floor in the tracking; give it with "
                f"{parameter('floor_height')}"
            )
        if target.scale is None and target.turn is None and not len(sample.hits):
            raise NergError(
                f"samples without hit points do not determine turn and scale: give {parameter('scale')} (1 if the "
                f"scene is in metres), {parameter('turn')}, or other evidence ({parameter('pairs')})"
            )
        progress(0.1, "searching the placement of the tracking")
        placements, starts = _search_and_refine(sample, target)
        if not len(sample.hits):
            # Heads alone do not distinguish a placement from its mirror image.
            progress(0.5, "profiling the turn, the scale and the shift")
            best, profile = _profile_and_improve(sample, target, placements[0], starts)
            return self._make_fit(best, sample, target, [], None, profile)
        progress(0.55, "searching the placement of the mirrored tracking")
        mirrored, _ = _search_and_refine(sample.mirrored(), target)
        warnings = []
        for other in placements[1:]:
            is_same = is_close(placements[0].matrix, other.matrix, 0.05 * target.surface.diagonal)
            if not is_same and other.cost < _RIVAL_RATIO * placements[0].cost:
                warnings.append(
                    f"another placement agrees almost as well (cost {other.cost:.3f}, the best "
                    f"{placements[0].cost:.3f}): the scene may be symmetric; use picked points "
                    f"({parameter('pairs')}) to decide"
                )
                break
        mirror_warning = None
        if mirrored[0].cost < _MIRROR_RATIO * placements[0].cost:
            mirror_warning = (
                f"the tracking agrees better with the scene if an axis is negated (cost {mirrored[0].cost:.3f}) "
                "than as "
                f"it is (cost {placements[0].cost:.3f})"
            )
        return self._make_fit(placements[0], sample, target, warnings, mirror_warning, None)

    def _make_fit(
        self,
        best: RefinedAlignment,
        sample: _Sample,
        target: AlignmentTarget,
        warnings: list[str],
        mirrored: str | None,
        profile: Profile | None,
    ) -> AlignmentFit:
        surface, scale = target.surface, similarity_scale(best.matrix)
        # Heads and gaze have residuals of zero for many placements, so that only those of hit points are reported.
        distance, degrees = np.zeros(0), np.zeros(0)
        if len(sample.hits):
            distance = surface.distance.interpolate(transform_points(best.matrix, sample.hits)) / scale
            length = np.linalg.norm(sample.hits - sample.hit_heads, axis=1)
            degrees = np.degrees(np.arctan2(distance, np.maximum(length, 1e-6)))
        interval = None if profile is None else profile.find_interval(sample.heads, seed=self.seed)
        solid_depth = surface.free_space_distance.interpolate(transform_points(best.matrix, sample.heads)) / scale
        metadata = {
            "rays": len(self.rays),
            "sampled_rays": len(sample.heads),
            "hits": len(sample.hits),
            "cost": best.cost,
            "heads_in_solids": float((solid_depth > 0.1).mean()),
        }
        notes = [
            f"{len(sample.heads):,} heads, of which {100 * (solid_depth > 0.1).mean():.1f} % are more than 10 cm "
            "inside solid "
            f"objects; {len(sample.hits):,} hit points"
        ]
        if interval is not None:
            notes.append(f"without hit points: {interval.describe()}; mirroring is not detected, so check the figure")
        return AlignmentFit(
            target.to_scene_frame(best.matrix),
            100 * distance,
            degrees,
            # Heads can move in free space at no cost, which derivatives do not show.
            best.covariance if len(sample.hits) else None,
            mirrored,
            sample.hits if len(sample.hits) else sample.heads,
            None,
            metadata,
            notes,
            warnings,
            interval,
        )


@dataclass(frozen=True, eq=False)
class _Sample:
    """A subset of the samples.

    ``heads``, ``directions`` (N, 3) and ``group`` (N,); ``hits`` (M, 3) with the index of their heads (M,); points in
    free space on the gaze paths, (K, 3), with the index of their heads (K,).
    """

    heads: np.ndarray
    directions: np.ndarray
    group: np.ndarray
    hits: np.ndarray
    hit_head_index: np.ndarray
    free_points: np.ndarray
    free_head_index: np.ndarray

    @property
    def hit_heads(self) -> np.ndarray:
        """Head position of each hit point, (M, 3)."""
        return self.heads[self.hit_head_index]

    def mirrored(self) -> _Sample:
        """Return the mirrored sample."""
        moved = {k: transform_points(MIRROR, getattr(self, k)) for k in ("heads", "directions", "hits", "free_points")}
        return replace(self, **moved)

    def subsample(self, count: int) -> _Sample:
        """Return about ``count`` of the heads with their points."""
        chosen = np.arange(0, len(self.heads), max(1, len(self.heads) // count))
        new_index = np.full(len(self.heads), -1)
        new_index[chosen] = np.arange(len(chosen))
        has_hit_head, has_head = new_index[self.hit_head_index] >= 0, new_index[self.free_head_index] >= 0
        return _Sample(
            self.heads[chosen],
            self.directions[chosen],
            self.group[chosen],
            self.hits[has_hit_head],
            new_index[self.hit_head_index[has_hit_head]],
            self.free_points[has_head],
            new_index[self.free_head_index[has_head]],
        )

    def scores(self, target: AlignmentTarget) -> list[Score]:
        """Return the scores of the sample; those of free space are omitted if it is unknown."""
        surface = target.surface
        out: list[Score] = [HeadHeight(target.floor_height, self.heads, self.group)] if target.is_upright else []
        if len(self.hits):
            out.append(
                ZeroDistance(surface.distance, self.hits, self.group[self.hit_head_index], "hit points on surfaces")
            )
        else:
            stride = slice(None, None, _GAZE_STRIDE)
            out.append(GazeEnds(surface, self.heads[stride], self.directions[stride], self.group[stride]))
        if surface.has_free_space:
            out.append(ZeroDistance(surface.free_space_distance, self.heads, self.group, "heads in free space"))
            out.append(
                ZeroDistance(
                    surface.free_space_distance,
                    self.free_points,
                    self.group[self.free_head_index],
                    "gaze through free space",
                )
            )
        return out


def _draw_sample(rays: Rays) -> _Sample:
    if not len(rays):
        raise NergError("there are no gaze samples to align; give a file with samples")
    rng = np.random.default_rng(0)
    # A uniform subset preserves the participants' recorded time and the frequency of outliers.
    chosen = np.sort(rng.permutation(len(rays))[:MAX_SAMPLES])
    heads, directions = rays.origin[chosen], rays.direction[chosen]
    group = independent_groups(rays.person[chosen], rays.t[chosen])
    has_hit = np.zeros(len(chosen), bool) if rays.hit is None else np.isfinite(rays.hit[chosen]).all(axis=1)
    hit_rows = np.flatnonzero(has_hit)
    hits = np.zeros((0, 3)) if rays.hit is None else rays.hit[chosen][has_hit]
    to_hit = hits - heads[hit_rows]
    miss_rows = np.flatnonzero(~has_hit)
    free_points = [heads[hit_rows] + a * to_hit for a in _FREE_FRACTIONS] + [
        heads[miss_rows] + a * directions[miss_rows] for a in _FREE_LENGTHS
    ]
    free_head_index = np.concatenate([hit_rows] * len(_FREE_FRACTIONS) + [miss_rows] * len(_FREE_LENGTHS))
    return _Sample(heads, directions, group, hits, hit_rows, np.concatenate(free_points), free_head_index)


def _search_and_refine(sample: _Sample, target: AlignmentTarget) -> tuple[list[RefinedAlignment], list[np.ndarray]]:
    """Return the best placements, best first, and the candidates (4, 4) from which they were refined."""
    guesses = _find_candidates(sample, target)
    subsample = sample.subsample(_NUM_COARSE)
    placements = [_refine_sample(subsample, target, m, 4.0, 12) for m in guesses[:_MAX_GUESSES]]
    placements = [
        _refine_sample(subsample, target, f.matrix, 1.5, 20) for f in sorted(placements, key=lambda f: f.cost)[:6]
    ]
    final = [_refine_sample(sample, target, f.matrix, 1.0, 30) for f in sorted(placements, key=lambda f: f.cost)[:2]]
    return sorted(final, key=lambda f: f.cost), [*(f.matrix for f in placements), *guesses]


def _find_candidates(sample: _Sample, target: AlignmentTarget) -> list[np.ndarray]:
    """Return candidate placements (4, 4), best first."""
    assert target.tracking_floor is not None
    surface, floor = target.surface, (target.tracking_floor, target.floor_height)
    free = np.concatenate([sample.heads, sample.free_points]) if surface.has_free_space else sample.heads
    turns = _TURNS if target.turn is None else np.array([target.turn])
    if target.scale is not None:
        scales = np.array([target.scale])
    elif len(sample.hits):
        scales = candidate_scales(surface, sample.hits)
    else:
        scales = candidate_scales(surface, sample.heads, _NUM_HEAD_SCALES)
    if target.shift is None:
        count = _MAX_GUESSES if len(sample.hits) else 2 * len(turns) * len(scales)
        return [g.matrix for g in search_placements(surface, sample.hits, free, scales, floor, turns, count)]
    matrices = np.tile(np.eye(4), (len(turns) * len(scales), 1, 1))
    matrices[:, :3, :3] = [scale * vertical_rotation(turn) for scale in scales for turn in turns]
    matrices[:, :3, 3] = target.shift
    scores = sample.subsample(_NUM_COARSE // 4).scores(target)
    return list(matrices[np.argsort([evaluate_by_group(scores, m).sum() for m in matrices])])


def _fixes_floor(target: AlignmentTarget) -> bool:
    return target.is_upright and target.tracking_floor is not None


def _find_center(sample: _Sample, target: AlignmentTarget) -> np.ndarray:
    """Return the centre (3,) of the heads, on the floor if its height is known."""
    center = np.median(sample.heads, axis=0)
    if _fixes_floor(target):
        center[2] = target.tracking_floor
    return center


def _refine_sample(
    sample: _Sample, target: AlignmentTarget, base: np.ndarray, scale_factor: float, max_evaluations: int
) -> RefinedAlignment:
    center = transform_points(base, _find_center(sample, target))
    return refine(
        sample.scores(target), target.parametrize(base, center, _fixes_floor(target)), scale_factor, max_evaluations
    )


def profile_sample(sample: _Sample, target: AlignmentTarget, best: np.ndarray, starts: list[np.ndarray]) -> Profile:
    """Profile the objective of a part of the sample about ``best``; without ``starts``, only near it."""
    subsample = sample.subsample(_NUM_PROFILED)
    center = _find_center(subsample, target)
    return make_profile(subsample.scores(target), best, starts, target, center, _fixes_floor(target))


def _profile_and_improve(
    sample: _Sample, target: AlignmentTarget, best: RefinedAlignment, starts: list[np.ndarray]
) -> tuple[RefinedAlignment, Profile]:
    """Profile the objective about ``best``, and return the better of it and the smallest minimum of the profile."""
    profile = profile_sample(sample, target, best.matrix, starts)
    other = _refine_sample(sample, target, profile.matrices[int(np.argmin(profile.costs.sum(axis=1)))], 1.0, 30)
    if other.cost >= best.cost:
        return best, profile
    scores = sample.subsample(_NUM_PROFILED).scores(target)
    return other, profile.with_result(other.matrix, evaluate_by_group(scores, other.matrix))
