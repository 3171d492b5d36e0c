"""Directions with an axis negated, told by the points of a place: gaze goes to what is there, a mirrored one beside it.

Rooms are closed: nearly every ray ends on a surface, negated or not. But points, as cameras triangulate them, lie on
what there is to see, and gaze passes within a fraction of a degree of one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import wilcoxon

from nerg_mi.rays.checks.head import EXCHANGES, head_frames
from nerg_mi.rays.checks.mirror import DECLARED

from .umeyama import move, scale_of

RAYS, POINTS = 400, 100_000
"""So many rays are looked at, and so many points."""

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
        # Statistic and probability.
        if wilcoxon(self.degrees[best], declared, alternative="less")[1] > _CHANCE:
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
    some = rng.permutation(len(origin))[:RAYS]
    points = points[rng.permutation(len(points))[:POINTS]]
    origin, direction = move(matrix, origin[some]), direction[some]
    turn = matrix[:3, :3] / scale_of(matrix)
    kinds = {DECLARED: direction}
    kinds |= {f"{'xyz'[k]} of the directions negated": direction * np.where(np.arange(3) == k, -1, 1) for k in range(3)}
    if head is not None:
        known = np.all(np.isfinite(head[some]), axis=1, keepdims=True)
        frames = head_frames(head[some])
        own = np.einsum("nij,nj->ni", frames, direction)
        for what, signs in EXCHANGES.items():
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
