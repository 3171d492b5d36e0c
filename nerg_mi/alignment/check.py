"""Plausibility check of rays in a scene, and the record of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.formats.alignments import Alignment
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.transforms import similarity_scale, transform_points
from nerg_mi.tracking.direction_checks import compute_hit_fractions, describe_mirroring
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SURFACE_OPACITY, SceneGeometry, trace_depth
from nerg_mi.transport.medium import Medium

from .constraints import AlignmentFit
from .profile import LEVEL

# ---- Check ----
#
# Run before every training and evaluation, so that a wrong alignment is reported before time is spent.

NUM_RAYS, NUM_HEADS = 2048, 256  # number of rays and of heads that are traced
IMPOSSIBLE_ESCAPED = 0.98  # share of gaze without a surface above which the alignment is certainly wrong
DOUBTFUL = {"escaped": 0.3, "inside": 0.1, "below": 0.1}
"""Shares above which the alignment is doubtful: gaze without a surface, heads inside solids, heads below the floor."""

# A head is inside a solid if this fraction of directions meets a surface within this distance in metres.
_TIGHT_DISTANCE, _TIGHT_FRACTION, _NUM_DIRECTIONS = 0.06, 0.8, 16


@dataclass(frozen=True)
class AlignmentCheck:
    """Shares, from 0 to 1, that indicate a wrong alignment.

    ``escaped``: gaze that meets no surface; ``inside``: heads inside solids; ``below``: heads below the floor;
    ``mirrored``: a message if more gaze ends on surfaces with an axis negated, else None.
    """

    escaped: float
    inside: float
    below: float
    mirrored: str | None = None

    @property
    def is_impossible(self) -> bool:
        """Whether (nearly) all gaze meets no surface."""
        return self.escaped > IMPOSSIBLE_ESCAPED

    def list_warnings(self) -> list[str]:
        """Return a short message for each doubtful share."""
        messages = {
            "escaped": f"{100 * self.escaped:.0f} % of the gaze meets no surface",
            "inside": f"{100 * self.inside:.0f} % of the heads are inside solid objects",
            "below": f"{100 * self.below:.0f} % of the heads are below the floor",
        }
        warnings = [text for name, text in messages.items() if getattr(self, name) > DOUBTFUL[name]]
        return [*warnings, self.mirrored] if self.mirrored else warnings


def check_alignment(geometry: Medium | SceneGeometry, rays: Rays, align: Similarity, seed: int = 0) -> AlignmentCheck:
    """Trace a sample of ``rays``, and directions around a sample of heads, in a scene; ``align`` maps the rays to
    the scene."""
    subset = np.random.default_rng(seed).permutation(len(rays))[:NUM_RAYS]
    if not len(subset):
        return AlignmentCheck(0.0, 0.0, 0.0)
    rotation = align.matrix[:3, :3] / align.scale
    origin, direction = transform_points(align.matrix, rays.origin[subset]), rays.direction[subset] @ rotation.T
    _, opacity = trace_depth(geometry, origin, direction)
    heads = origin[:NUM_HEADS]
    directions = np.concatenate(
        [rotation @ [[0, 0], [0, 0], [-1, 1]], fibonacci_directions(_NUM_DIRECTIONS).T], axis=1
    ).T
    depth, is_hit = trace_depth(geometry, np.repeat(heads, len(directions), 0), np.tile(directions, (len(heads), 1)))
    depth, is_hit = depth.reshape(len(heads), -1), is_hit.reshape(len(heads), -1) >= SURFACE_OPACITY
    tight_fraction = (is_hit & (depth < _TIGHT_DISTANCE * align.scale))[:, 2:].mean(axis=1)
    # A surface above and none below: the surface above is the floor.
    below = ~is_hit[:, 0] & is_hit[:, 1]
    escaped = float((opacity < SURFACE_OPACITY).mean())
    mirrored = None
    # Some gaze leaves through windows, so mirrored axes are tested only if the share is doubtful.
    if escaped > DOUBTFUL["escaped"]:

        def trace(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
            depth, opacity = trace_depth(geometry, origins, directions)
            return np.where(opacity >= SURFACE_OPACITY, depth, np.inf)

        mirrored = describe_mirroring(compute_hit_fractions(trace, origin, direction, rotation.T), len(origin))
    return AlignmentCheck(escaped, float((tight_fraction >= _TIGHT_FRACTION).mean()), float(below.mean()), mirrored)


# ---- Record of a fit ----


def record_fit(kind: str, fit: AlignmentFit, files: Mapping[str, Any], forced: bool) -> Alignment:
    """Return the record of a fit by evidence of that ``kind``."""
    residuals = {
        "count": len(fit.residuals_cm),
        **_percentiles(fit.residuals_cm, "cm"),
        **_percentiles(fit.residuals_deg, "degrees"),
    }
    return Alignment(fit.matrix, {"kind": kind, **fit.metadata}, residuals, _uncertainty(fit), dict(files), forced)


def _percentiles(values: np.ndarray, unit: str) -> dict[str, float | None]:
    finite = values[np.isfinite(values)]
    percentile = lambda percent: float(np.percentile(finite, percent)) if len(finite) else None
    return {f"median_{unit}": percentile(50), f"p95_{unit}": percentile(95)}


def _uncertainty(fit: AlignmentFit) -> dict[str, Any] | None:
    if (interval := fit.interval) is not None:
        turn, scale = list(interval.turn), list(interval.scale)
        return {"level": LEVEL, "turn_degrees": turn, "scale": scale, "shift_cm": 100 * interval.shift}
    covariance = fit.covariance
    if covariance is None or not np.isfinite(covariance).all():
        return None
    part = lambda a, b: float(np.sqrt(max(np.trace(covariance[a:b, a:b]), 0.0)))
    return {
        "cm": 100 * part(3, 6) / similarity_scale(fit.matrix),
        "degrees": float(np.degrees(part(0, 3))),
        "scale_percent": 100 * part(6, 7),
    }
