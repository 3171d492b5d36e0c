"""``alignment.json``: the record of an alignment, and what is read where a similarity is needed."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files import html
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.schema import NUMBER, Items, check_json
from nerg_mi.files.tables import write_json
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import check_rigid_transforms, similarity_scale

# ---- Uncertainty of an alignment by samples without hit points ----

MAX_TURN, MAX_SCALE, MAX_SHIFT = 10.0, 1.1, 1.0
"""Maximum widths of the intervals of a determined alignment: degrees, ratio of the scales, and metres between head
positions."""


@dataclass(frozen=True)
class Interval:
    """What the samples leave open about an alignment.

    ``turn``: smallest and largest rotation about the vertical axis in degrees, relative to the result; ``scale``:
    smallest and largest scale; ``shift``: largest distance in metres (median over the heads) between the head positions
    of the result and those of another placement that fits.
    """

    turn: tuple[float, float]
    scale: tuple[float, float]
    shift: float

    def describe(self) -> str:
        """Return the interval in words."""
        return (
            f"turns from {self.turn[0]:+.3g} to {self.turn[1]:+.3g} degrees about the result, scales from "
            f"{self.scale[0]:.3g} to {self.scale[1]:.3g}, and heads {self.shift:.2g} m from it agree with the samples "
            "about equally well"
        )

    def rejection_reason(self) -> str:
        """Return what is not determined, with a remedy, or an empty string."""
        names = []
        if self.turn[1] - self.turn[0] > MAX_TURN:
            names.append("turn")
        if self.scale[1] > MAX_SCALE * self.scale[0]:
            names.append("scale")
        if self.shift > MAX_SHIFT:
            names.append("shift")
        if not names:
            return ""
        remedies = ", ".join(parameter(name) for name in names)
        return (
            f"the samples do not determine the {' and the '.join(names)}: {self.describe()}; give {remedies} if "
            f"you know the value, picked points ({parameter('pairs')}), or samples with hit points"
        )


# ---- Record ----
#
# ``alignment.json`` stores a similarity with its evidence, residuals and uncertainty. Options that take an alignment
# (``--align``) read this file, or a JSON list of the four rows of the matrix.

KIND, VERSION = "alignment", 1

_MAX_BYTES = 4 << 20
_ROWS, _ENDS = Items(Items(NUMBER, 4, 4), 4, 4), Items(NUMBER, 2, 2)
_UNCERTAINTY = {"turn_degrees": _ENDS, "scale": _ENDS, "shift_cm": NUMBER}
_RECORD = {"evidence": dict, "residuals": dict, "files?": dict, "forced?": bool}


@dataclass(frozen=True, eq=False, repr=False)
class Alignment:
    """An alignment and its record. All fields except the matrix are JSON values.

    Parameters
    ----------
    matrix
        Similarity (4, 4) from the tracking frame (z up, metres) to the scene.
    evidence
        Kind of evidence and its figures.
    residuals
        Median and 95th percentile in centimetres and degrees.
    uncertainty
        Standard deviation of position (cm), rotation (degrees) and scale (percent), or the `Interval` of samples
        without hit points; None if unknown.
    files
        Names and checksums of the input files.
    forced
        Whether it was written in spite of a failed check.

    Examples
    --------
    >>> import nerg_mi as nerg, numpy as np
    >>> turned = nerg.Alignment(np.diag([-2.0, -2, 2, 1]), {"kind": "matrix"}, {}, None)
    >>> turned.save(folder / "alignment.json")
    >>> nerg.Alignment.load(folder / "alignment.json")
    <Alignment: matrix, scale 2>
    """

    matrix: np.ndarray
    evidence: dict[str, Any]
    residuals: dict[str, Any]
    uncertainty: dict[str, Any] | None
    files: dict[str, Any] = field(default_factory=dict)
    forced: bool = False

    @classmethod
    def load(cls, path: FilePath) -> Alignment:
        """Load an alignment that `save` or ``nerg align`` has written, or the JSON list of the four rows of a matrix.

        Raises `NergError` for another file.
        """
        path = to_path(path)
        similarity, record = _read_record(path, "an alignment", "rays to scene")
        if not record:
            return cls(similarity.matrix, {"kind": "matrix"}, {}, None)
        try:
            check_json(record, _RECORD, "alignment")
            uncertainty = record.get("uncertainty")
            if uncertainty is not None:
                check_json(uncertainty, dict, "uncertainty")
        except ValueError as error:
            raise NergError(f'the alignment "{path}" is damaged: {sanitize(error)}; run "nerg align" again') from error
        details = (record["evidence"], record["residuals"], uncertainty, record.get("files", {}))
        return cls(similarity.matrix, *details, record.get("forced", False))

    @property
    def scale(self) -> float:
        """Scene units per metre of the tracking."""
        return similarity_scale(self.matrix)

    def _repr_html_(self) -> str:
        facts = {"evidence": self.evidence, "residuals": self.residuals, "uncertainty": self.uncertainty or {}}
        rows = [(f"{group}: {name.replace('_', ' ')}", str(v)) for group, d in facts.items() for name, v in d.items()]
        matrix = "\n".join("  ".join(f"{x:.6g}" for x in row) for row in self.matrix.tolist())
        return html.key_value_table([("scale", f"{self.scale:.6g}"), ("matrix", html.element("pre", matrix)), *rows])

    def __repr__(self) -> str:
        residual = self.residuals.get("median_cm")
        fit = "" if residual is None else f", median residual {residual:.3g} cm"
        return f"<Alignment: {self.evidence.get('kind', 'matrix')}, scale {self.scale:.4g}{fit}>"

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        data = {
            "kind": KIND,
            "version": VERSION,
            "from": "tracking",
            "to": "place",
            "matrix": self.matrix.tolist(),
            "scale": self.scale,
            "evidence": self.evidence,
            "residuals": self.residuals,
            "uncertainty": self.uncertainty,
            "files": self.files,
            "forced": self.forced,
        }
        write_json(path, data, allow_nan=False)


AnySimilarity: TypeAlias = Alignment | Similarity | ArrayLike
"""A similarity transform in memory: an alignment, or a matrix (4, 4)."""


def open_similarity(
    align: Any, frames: str, on_doubt: Callable[[str], None] = lambda reason: None, name: str = "align"
) -> Similarity:
    """Return the similarity of the parameter ``name``: a file as for `read_similarity`, a `Similarity`, a matrix (4, 4)
    or an object that has one as ``matrix``."""
    if isinstance(align, (str, os.PathLike)):
        return read_similarity(Path(align), parameter(name), frames, on_doubt)
    if isinstance(align, Similarity):
        return align
    matrix = getattr(align, "matrix", align)
    return Similarity(check_rigid_transforms(matrix, f'"{name}"', may_scale=True, shape=(4, 4)))


def read_similarity(
    path: Path, option: str, frames: str, on_doubt: Callable[[str], None] = lambda reason: None
) -> Similarity:
    """Read a similarity from a JSON file, an alignment or four rows.

    Parameters
    ----------
    path
        JSON file.
    option
        Option that named the file, for messages.
    frames
        Source and target frame, such as "rays to field", for messages.
    on_doubt
        Called with a message if the evidence of the alignment did not determine it.

    Raises
    ------
    NergError
        If the file does not contain a similarity.
    """
    similarity, record = _read_record(path, option, frames)
    _report_doubt(record.get("uncertainty"), path, on_doubt)
    return similarity


def _read_record(path: Path, option: str, frames: str) -> tuple[Similarity, dict[str, Any]]:
    """Read the similarity of a file, and its record; {} for four rows. Arguments and errors as `read_similarity`."""
    data: Any = read_json(path, f"similarity of {option}", _MAX_BYTES)
    record: dict[str, Any] = {}
    if isinstance(data, dict):
        if data.get("kind") != KIND or "matrix" not in data:
            raise NergError(
                f'{option} needs a JSON file with the 4 rows of a similarity from {frames}; "{path}" is neither '
                'that nor an output of "nerg align"'
            )
        version = data.get("version")
        if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= VERSION:
            raise NergError(
                f'the alignment "{path}" has version {sanitize(version, 40)}, but at most {VERSION} is supported; '
                "update nerg_mi"
            )
        record, data = data, data["matrix"]
    try:
        return Similarity(np.array(check_json(data, _ROWS, "matrix"), np.float64)), record
    except ValueError as error:
        raise NergError(
            f'{option} needs a JSON file with the 4 rows of a similarity from {frames}; "{path}": {sanitize(error)}'
        ) from error


def _report_doubt(uncertainty: Any, path: Path, on_doubt: Callable[[str], None]) -> None:
    if not isinstance(uncertainty, dict) or "turn_degrees" not in uncertainty:
        return
    try:
        check_json(uncertainty, _UNCERTAINTY, "uncertainty")
        turn, scale = (tuple(uncertainty[k]) for k in ("turn_degrees", "scale"))
        reason = Interval(turn, scale, uncertainty["shift_cm"] / 100).rejection_reason()
    except ValueError as error:
        raise NergError(
            f'the uncertainty in "{path}" is not an interval of "nerg align" ({sanitize(error)}); run it again'
        ) from error
    if reason:
        on_doubt(f'in "{path}", {reason}, and run "nerg align" again')
