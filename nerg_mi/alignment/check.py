"""Whether rays lie in a place as people's do, and ``alignment.json``, the record of an alignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import write_json
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.direction_checks import compute_hit_fractions, describe_mirroring
from nerg_mi.rays.rays import Rays
from nerg_mi.transport.geometry import SceneGeometry, trace_depth
from nerg_mi.transport.medium import Medium

from .constraints import AlignmentFit
from .similarity import transform_points, similarity_scale

# ---- Check ----
#
# Whether rays lie in a place as people's do: asked of every training and evaluation, before time is spent on it.

NUM_RAYS, NUM_HEADS = 2048, 256  # So many rays, and heads, are asked about
IMPOSSIBLE_ESCAPED = 0.98  # Where more of the gaze than this meets no surface, the alignment is certainly wrong
DOUBTFUL = {"escaped": 0.3, "inside": 0.1, "below": 0.1}
"""Shares from which on it is doubtful: of gaze that meets nothing, of heads inside of something and below the floor."""

_SURFACE_OPACITY = 0.5
# A head is inside of something where most directions end within so many metres.
_TIGHT, _MOSTLY, _DIRECTIONS = 0.06, 0.8, 16


@dataclass(frozen=True)
class AlignmentCheck:
    """Shares, from 0 to 1: ``escaped`` of the gaze, which meets no surface; ``inside`` of the heads, which are in
    something solid; ``below`` of the heads, which are below the floor. ``mirrored``: a sentence where more of the gaze
    ends on surfaces with an axis negated."""

    escaped: float
    inside: float
    below: float
    mirrored: str | None = None

    @property
    def is_impossible(self) -> bool:
        """Whether (nearly) all the gaze meets nothing."""
        return self.escaped > IMPOSSIBLE_ESCAPED

    def list_warnings(self) -> list[str]:
        """What is doubtful, in a few words each."""
        said = {
            "escaped": f"{100 * self.escaped:.0f} % of the gaze meets no surface",
            "inside": f"{100 * self.inside:.0f} % of the heads are inside of something solid",
            "below": f"{100 * self.below:.0f} % of the heads are below the floor",
        }
        found = [text for name, text in said.items() if getattr(self, name) > DOUBTFUL[name]]
        return [*found, self.mirrored] if self.mirrored else found


def check_alignment(geometry: Medium | SceneGeometry, rays: Rays, align: Similarity, seed: int = 0) -> AlignmentCheck:
    """Trace some of ``rays``, which ``align`` carries into the place ``subject``, and directions all
    around some heads."""
    some = np.random.default_rng(seed).permutation(len(rays))[:NUM_RAYS]
    if not len(some):
        return AlignmentCheck(0.0, 0.0, 0.0)
    turn = align.matrix[:3, :3] / align.scale
    origin, direction = transform_points(align.matrix, rays.origin[some]), rays.direction[some] @ turn.T
    _, opacity = trace_depth(geometry, origin, direction)
    heads = origin[:NUM_HEADS]
    around = np.concatenate([turn @ [[0, 0], [0, 0], [-1, 1]], fibonacci_directions(_DIRECTIONS).T], axis=1).T
    depth, met = trace_depth(geometry, np.repeat(heads, len(around), 0), np.tile(around, (len(heads), 1)))
    depth, met = depth.reshape(len(heads), -1), met.reshape(len(heads), -1) >= _SURFACE_OPACITY
    tight = (met & (depth < _TIGHT * align.scale))[:, 2:].mean(axis=1)
    # Something is above, and nothing below: what is above is the floor.
    below = ~met[:, 0] & met[:, 1]
    escaped = float((opacity < _SURFACE_OPACITY).mean())
    mirrored = None
    # People look out of windows too: a mirror is asked for only where something is wrong.
    if escaped > DOUBTFUL["escaped"]:

        def trace(at: np.ndarray, along: np.ndarray) -> np.ndarray:
            depth, met = trace_depth(geometry, at, along)
            return np.where(met >= _SURFACE_OPACITY, depth, np.inf)

        mirrored = describe_mirroring(compute_hit_fractions(trace, origin, direction, turn.T), len(origin))
    return AlignmentCheck(escaped, float((tight >= _MOSTLY).mean()), float(below.mean()), mirrored)


# ---- Record ----
#
# ``alignment.json``: a similarity with what it was found from, how well it fits, and how well it is determined.
#
# Whatever takes an alignment (``--align``) reads this file, and as well a plain JSON list of the four rows of the
# matrix.

KIND, VERSION = "alignment", 1

_BYTES = 4 << 20


@dataclass(frozen=True, eq=False)
class Alignment:
    """``matrix`` (4, 4) from the tracking (z up, metres) to the place; ``evidence``: its kind and figures;
    ``residuals``: median and 95 % in centimetres and degrees; ``uncertainty``: one standard deviation of position (cm),
    rotation (degrees) and scale (percent), None where it is not known; ``files``: names and checksums of what it was
    found from; ``forced``: written though it was to be refused. All but the matrix are JSON."""

    matrix: np.ndarray
    evidence: dict[str, Any]
    residuals: dict[str, Any]
    uncertainty: dict[str, float] | None
    files: dict[str, Any] = field(default_factory=dict)
    forced: bool = False

    @classmethod
    def from_fit(cls, kind: str, fit: AlignmentFit, files: Mapping[str, Any], forced: bool) -> Alignment:
        """What is recorded of a fit."""
        residuals = {"count": len(fit.residuals_cm), **_spread(fit.residuals_cm, "cm"), **_spread(fit.residuals_deg, "degrees")}
        return cls(fit.matrix, {"kind": kind, **fit.metadata}, residuals, _uncertainty(fit), dict(files), forced)

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        about = {
            "kind": KIND,
            "version": VERSION,
            "from": "tracking",
            "to": "place",
            "matrix": self.matrix.tolist(),
            "scale": similarity_scale(self.matrix),
            "evidence": self.evidence,
            "residuals": self.residuals,
            "uncertainty": self.uncertainty,
            "files": self.files,
            "forced": self.forced,
        }
        write_json(path, about, allow_nan=False)


def read_similarity(path: Path, option: str, frames: str) -> Similarity:
    """The similarity in the JSON file ``path``, an alignment or four rows, which was given by ``option`` and leads from
    and to what ``frames`` says ("rays to field"). Raises `NergError` for a file that holds none."""
    found: Any = read_json(path, f"similarity of {option}", _BYTES)
    if isinstance(found, dict):
        if found.get("kind") != KIND or "matrix" not in found:
            raise NergError(
                f'{option} needs a JSON file with the 4 rows of a similarity from {frames}; "{path}": it is neither '
                'that nor what "nerg align" writes'
            )
        version = found.get("version")
        if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= VERSION:
            raise NergError(
                f'the alignment "{path}" has the version {sanitize(version, 40)}, and up to {VERSION} is read; '
                "update nerg_mi"
            )
        found = found["matrix"]
    try:
        return Similarity(np.array([[float(x) for x in row] for row in found]))
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise NergError(
            f'{option} needs a JSON file with the 4 rows of a similarity from {frames}; "{path}": {sanitize(error)}'
        ) from error


def _spread(values: np.ndarray, unit: str) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    at = lambda percent: float(np.percentile(known, percent)) if len(known) else None
    return {f"median_{unit}": at(50), f"p95_{unit}": at(95)}


def _uncertainty(fit: AlignmentFit) -> dict[str, float] | None:
    covariance = fit.covariance
    if covariance is None or not np.isfinite(covariance).all():
        return None
    part = lambda a, b: float(np.sqrt(max(np.trace(covariance[a:b, a:b]), 0.0)))
    return {
        "cm": 100 * part(3, 6) / similarity_scale(fit.matrix),
        "degrees": float(np.degrees(part(0, 3))),
        "scale_percent": 100 * part(6, 7),
    }
