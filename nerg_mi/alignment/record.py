"""``alignment.json``: a similarity with what it was found from, how well it fits, and how well it is determined.

Whatever takes an alignment (``--align``) reads this file, and as well a plain JSON list of the four rows of the matrix.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain, read_json
from nerg_mi.files.tables import write_json
from nerg_mi.maths.geometry import Similarity

from .evidence import Fit
from .umeyama import scale_of

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
    def of_fit(cls, kind: str, fit: Fit, files: Mapping[str, Any], forced: bool) -> Alignment:
        """What is recorded of a fit."""
        residuals = {"count": len(fit.centimetres), **_spread(fit.centimetres, "cm"), **_spread(fit.degrees, "degrees")}
        return cls(fit.matrix, {"kind": kind, **fit.about}, residuals, _uncertainty(fit), dict(files), forced)

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        about = {
            "kind": KIND,
            "version": VERSION,
            "from": "tracking",
            "to": "place",
            "matrix": self.matrix.tolist(),
            "scale": scale_of(self.matrix),
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
                f'the alignment "{path}" has the version {plain(version, 40)}, and up to {VERSION} is read; '
                "update nerg_mi"
            )
        found = found["matrix"]
    try:
        return Similarity(np.array([[float(x) for x in row] for row in found]))
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise NergError(
            f'{option} needs a JSON file with the 4 rows of a similarity from {frames}; "{path}": {plain(error)}'
        ) from error


def _spread(values: np.ndarray, unit: str) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    at = lambda percent: float(np.percentile(known, percent)) if len(known) else None
    return {f"median_{unit}": at(50), f"p95_{unit}": at(95)}


def _uncertainty(fit: Fit) -> dict[str, float] | None:
    covariance = fit.covariance
    if covariance is None or not np.isfinite(covariance).all():
        return None
    part = lambda a, b: float(np.sqrt(max(np.trace(covariance[a:b, a:b]), 0.0)))
    return {
        "cm": 100 * part(3, 6) / scale_of(fit.matrix),
        "degrees": float(np.degrees(part(0, 3))),
        "scale_percent": 100 * part(6, 7),
    }
