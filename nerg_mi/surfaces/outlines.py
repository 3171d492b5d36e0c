"""What of a surface is seen, cut where the outline of something passes: pieces that are seen in part are cut again.

A piece is looked at in four points and at its corners. Where all of it is hidden it ends there; where it is seen in
part, and carries more of the gaze than `MIXED`, it is cut in four. Without this an outline that runs along the cuts of
a face, as those of shelves on walls do, falls between the same two rows of pieces everywhere, and loses up to a third
of a piece along all its length; halving the pieces keeps the cuts parallel to it, and the loss often as large.
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

# Four points spread over a piece tell which share of it is seen. Its corners tell whether an outline passes, and
# nothing else: those of a hidden side reach into sight wherever it meets an edge that is seen. They are looked at a
# little within, for a ray at the very edge of a face may meet its neighbour.
_WITHIN = 1e-3
_SPREAD = np.vstack([np.full((1, 3), 1 / 3), 1 / 6 + 0.5 * np.eye(3)])
_LOOKED_AT = np.vstack([_SPREAD, _WITHIN + (1 - 3 * _WITHIN) * np.eye(3)])


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
            rows = np.flatnonzero(seen.any(axis=1))
            left, seen = left.part(rows), seen[rows]
            if not len(left):
                break
            whole = left.solid_angle * density(left)
            most = np.where(seen.all(axis=1), WHOLE, MIXED) * total
            cut = (whole > most) & (level < CUTS)
            yield left.part(~cut), (whole * seen[:, : len(_SPREAD)].mean(axis=1))[~cut]
            if not cut.any():
                break
            left = left.part(cut).quartered()


def _seen(target: Target, pieces: Pieces) -> np.ndarray:
    """Whether each of the points (P, 7) is seen at which pieces are looked at."""
    points = np.matmul(_LOOKED_AT, pieces.relative) + pieces.eye
    count = len(_LOOKED_AT)
    return target.sees(pieces.eye, points.reshape(-1, 3), np.repeat(pieces.face, count)).reshape(-1, count)
