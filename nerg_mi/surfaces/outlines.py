"""What of a surface is seen, cut where the outline of something passes: pieces that are seen in part are cut again.

A piece is looked at in its middle, at its corners and halfway between them. Where all of it is hidden it ends there; where it is seen in part,
and carries more of the gaze than `MIXED`, it is cut in four. Without this an outline that runs along the cuts of a face,
as those of shelves on walls do, falls between the same two rows of pieces everywhere, and loses up to a third of a
piece along all its length: what is left out does not become less as one would expect when pieces shrink, since halving
keeps the cuts parallel to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from .pieces import Pieces
from .target import Target

MIXED = 1e-6
"""Of all gaze, what a piece may have at most that is seen in part."""

WHOLE = 2e-5
"""Of all gaze, what a piece may have at most: densities narrower than a piece is are integrated too."""

CUTS = 12
"""A piece is cut so many times at most."""

# A little within the corners, for a ray at the very edge of a face may meet its neighbour.
_WITHIN = 1e-3
_CORNERS = _WITHIN + (1 - 3 * _WITHIN) * np.eye(3)
_LOOKED_AT = np.vstack([np.full((1, 3), 1 / 3), _CORNERS, 0.5 * (_CORNERS + _CORNERS[[1, 2, 0]])])


def visible_pieces(
    target: Target, pieces: Pieces, density: Callable[[Pieces], np.ndarray], total: float, batch: int
) -> Iterator[tuple[Pieces, np.ndarray]]:
    """``pieces`` that are seen, cut where outlines pass, with the gaze (P,) that each receives.

    ``density`` of pieces, in 1/sr, what hides them left out; ``total``: all gaze, which limits are shares of;
    ``batch``: pieces that are looked at together. The target is `sharp`.
    """
    for a in range(0, len(pieces), batch):
        left = pieces.part(slice(a, a + batch))
        for level in range(CUTS + 1):
            seen = _seen(target, left)
            left, seen = left.part(seen > 0), seen[seen > 0]
            if not len(left):
                break
            whole = left.solid_angle * density(left)
            most = np.where(seen < 1, MIXED, WHOLE) * total
            cut = (whole > most) & (level < CUTS)
            yield left.part(~cut), (whole * seen)[~cut]
            if not cut.any():
                break
            left = left.part(cut).quartered()


def _seen(target: Target, pieces: Pieces) -> np.ndarray:
    """Share (P,) of each that is seen: of the points at which it is looked."""
    points = np.matmul(_LOOKED_AT, pieces.relative) + pieces.eye
    count = len(_LOOKED_AT)
    seen = target.sees(pieces.eye, points.reshape(-1, 3), np.repeat(pieces.face, count))
    return seen.reshape(-1, count).mean(axis=1)
