"""Directions mirrored against a place: more of the gaze ends on its surfaces as it is than with an axis negated."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

Trace = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Distances (N,) along unit directions (N, 3) from origins (N, 3) to what they meet; not finite for nothing."""

DECLARED = "as declared"
"""Name of the directions without an axis negated."""

_BETTER = 0.02  # share by which a mirror must be better, besides three standard errors


def hit_shares(
    trace: Trace, origins: np.ndarray, directions: np.ndarray, to_source: np.ndarray | None = None
) -> dict[str, float]:
    """Share of the rays that end on a surface, for the directions as they are and with each of the axes negated.

    ``origins``, ``directions`` (N, 3), in the frame of ``trace``. ``to_source`` (3, 3): rotation, or mirror, to the
    axes by which mirrors are named, those of the tracking file; by default they are those of the rays. Keys:
    `DECLARED`, ``x``, ``y``, ``z``, ``x and y``, ...
    """
    R = np.eye(3) if to_source is None else to_source
    shares = {}
    for signs in sorted(itertools.product((1.0, -1.0), repeat=3), key=lambda s: -sum(s)):
        axes = " and ".join("xyz"[i] for i in range(3) if signs[i] < 0)
        turned = directions @ (R.T * signs) @ np.linalg.inv(R).T
        shares[axes or DECLARED] = float(np.mean(np.isfinite(trace(origins, turned))))
    return shares


def mirror_warning(shares: dict[str, float], count: int) -> str | None:
    """A sentence where `hit_shares` of ``count`` rays are better with one axis negated than as they are declared, by
    more than chance; None otherwise.

    Several axes negated at once are a turn, or a mirror of a turn, and are not asked here: rooms are much the same all
    around.
    """
    declared, single = shares[DECLARED], {axis: shares[axis] for axis in "xyz"}
    best = max(single, key=single.__getitem__)
    error = np.sqrt(max(declared * (1 - declared) + single[best] * (1 - single[best]), 1e-12) / max(count, 1))
    if single[best] - declared <= max(_BETTER, 3 * error):
        return None
    return (
        f"{100 * declared:.1f} % of the gaze ends on a surface, and with {best} of the directions negated "
        f"{100 * single[best]:.1f} % would: is the frame mirrored? (--hand, or the sign of {best})"
    )
