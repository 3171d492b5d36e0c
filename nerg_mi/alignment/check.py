"""Whether rays lie in a place as people's do: asked of every training and evaluation, before time is spent on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.checks.mirror import hit_shares, mirror_warning
from nerg_mi.rays.rays import Rays
from nerg_mi.transport.media.protocol import Medium
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import trace_depth

from .umeyama import move

RAYS, HEADS = 2048, 256
"""So many rays, and heads, are asked about."""

NOTHING = 0.98
"""Where more of the gaze than this meets no surface, the alignment is certainly wrong."""

DOUBTFUL = {"escaped": 0.3, "inside": 0.1, "below": 0.1}
"""Shares from which on it is doubtful: of gaze that meets nothing, of heads inside of something and below the floor."""

_SURFACE_OPACITY = 0.5
# A head is inside of something where most directions end within so many metres.
_TIGHT, _MOSTLY, _DIRECTIONS = 0.06, 0.8, 16


@dataclass(frozen=True)
class Check:
    """Shares, from 0 to 1: ``escaped`` of the gaze, which meets no surface; ``inside`` of the heads, which are in
    something solid; ``below`` of the heads, which are below the floor. ``mirrored``: a sentence where more of the gaze
    ends on surfaces with an axis negated."""

    escaped: float
    inside: float
    below: float
    mirrored: str | None = None

    @property
    def impossible(self) -> bool:
        """Whether (nearly) all the gaze meets nothing."""
        return self.escaped > NOTHING

    def doubts(self) -> list[str]:
        """What is doubtful, in a few words each."""
        said = {
            "escaped": f"{100 * self.escaped:.0f} % of the gaze meets no surface",
            "inside": f"{100 * self.inside:.0f} % of the heads are inside of something solid",
            "below": f"{100 * self.below:.0f} % of the heads are below the floor",
        }
        found = [text for name, text in said.items() if getattr(self, name) > DOUBTFUL[name]]
        return [*found, self.mirrored] if self.mirrored else found


def check_alignment(subject: Medium | Place, rays: Rays, align: Similarity, seed: int = 0) -> Check:
    """Trace some of ``rays``, which ``align`` carries into the place ``subject``, and directions all
    around some heads."""
    some = np.random.default_rng(seed).permutation(len(rays))[:RAYS]
    if not len(some):
        return Check(0.0, 0.0, 0.0)
    turn = align.matrix[:3, :3] / align.scale
    origin, direction = move(align.matrix, rays.origin[some]), rays.direction[some] @ turn.T
    _, opacity = trace_depth(subject, origin, direction)
    heads = origin[:HEADS]
    around = np.concatenate([turn @ [[0, 0], [0, 0], [-1, 1]], fibonacci_directions(_DIRECTIONS).T], axis=1).T
    depth, met = trace_depth(subject, np.repeat(heads, len(around), 0), np.tile(around, (len(heads), 1)))
    depth, met = depth.reshape(len(heads), -1), met.reshape(len(heads), -1) >= _SURFACE_OPACITY
    tight = (met & (depth < _TIGHT * align.scale))[:, 2:].mean(axis=1)
    # Something is above, and nothing below: what is above is the floor.
    below = ~met[:, 0] & met[:, 1]
    escaped = float((opacity < _SURFACE_OPACITY).mean())
    mirrored = None
    # People look out of windows too: a mirror is asked for only where something is wrong.
    if escaped > DOUBTFUL["escaped"]:

        def trace(at: np.ndarray, along: np.ndarray) -> np.ndarray:
            depth, met = trace_depth(subject, at, along)
            return np.where(met >= _SURFACE_OPACITY, depth, np.inf)

        mirrored = mirror_warning(hit_shares(trace, origin, direction, turn.T), len(origin))
    return Check(escaped, float((tight >= _MOSTLY).mean()), float(below.mean()), mirrored)
