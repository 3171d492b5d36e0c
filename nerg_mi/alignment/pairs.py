"""Alignment from points that somebody picked in both frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain, read_json, size_of
from nerg_mi.rays.readers.parsing.tables import iterate_table, table_columns

from .chart import ALL, upright_basis
from .evidence import Fit, Progress, Target, angles, pair_covariance
from .umeyama import MIRROR, check_points, errors, fit_similarity, in_plane, leave_one_out, move

PAIRS_BYTES = 4 << 20
"""A file of pairs may have so many bytes; nobody picks so many points."""

_COLUMNS = ("x", "y", "z", "place_x", "place_y", "place_z")
_SHAPE = (
    'CSV with the columns x,y,z (tracking, metres) and place_x,place_y,place_z, or JSON [{"tracking": [x, y, z], '
    '"place": [x, y, z]}, ...]'
)
# A mirrored frame is told where it fits so much better.
_CLEAR = 0.5


@dataclass(frozen=True, eq=False)
class Pairs:
    """``tracking`` and ``place``: (N, 3) the same points in both frames; ``source``: whose they are, for messages;
    ``names``: of the points, or none."""

    tracking: np.ndarray
    place: np.ndarray
    source: str = "the pairs"
    names: tuple[str, ...] = ()

    kind = "pairs"

    def fit(self, target: Target, progress: Progress) -> Fit:
        """Umeyama's solution. Raises `NergError` for points that are too few or degenerate."""
        x, y = self.tracking, move(target.turn, self.place)
        check_points(x, y, self.source, upright=target.upright)
        options: dict[str, Any] = {"upright": target.upright, "scale": target.scale}
        matrix = fit_similarity(x, y, **options)
        off, left_out = errors(matrix, x, y), leave_one_out(x, y, **options)
        flipped = move(MIRROR, x)
        turned = fit_similarity(flipped, y, **options)
        notes = [self._describe(off, left_out)]
        mirrored = None
        if not target.upright and in_plane(x):
            notes.append("the points lie in a plane, so that they do not tell a mirrored frame; add one off the plane")
        elif _rms(errors(turned, flipped, y)) < _CLEAR * _rms(off):
            mirrored = (
                f"with the x axis negated the pairs meet to {100 * _rms(errors(turned, flipped, y)):.3g} cm, as they "
                f"are to {100 * _rms(off):.3g} cm only"
            )
        basis = upright_basis(False) if target.upright else ALL
        if target.scale is not None:
            basis = basis[:, :-1]
        known = left_out[np.isfinite(left_out)]
        about = {"pairs": len(x), "leave_one_out_cm": {"median": _cm(known, 50), "largest": _cm(known, 100)}}
        return Fit(
            target.to_place(matrix),
            100 * off,
            angles(y.mean(axis=0), move(matrix, x), y),
            pair_covariance(x, y, matrix, basis),
            mirrored,
            x,
            self.place,
            about,
            notes,
            self._doubts(off, left_out),
        )

    def _describe(self, off: np.ndarray, left_out: np.ndarray) -> str:
        known = left_out[np.isfinite(left_out)]
        left = (
            f"; each from the others: {100 * np.median(known):.2g} cm (median), {100 * known.max():.2g} cm (worst)"
            if len(known)
            else "; too few to tell one from the others"
        )
        return (
            f"{len(off)} pairs, off by {100 * np.median(off):.2g} cm (median), {100 * off.max():.2g} cm (worst){left}"
        )

    def _doubts(self, off: np.ndarray, left_out: np.ndarray) -> list[str]:
        """The pair that was picked wrong, where one stands out."""
        known = np.where(np.isfinite(left_out), left_out, 0)
        worst = int(np.argmax(known))
        rest = np.delete(off, worst)
        if len(off) < 5 or not known[worst] > 0.05:
            return []
        x, y = np.delete(self.tracking, worst, 0), np.delete(self.place, worst, 0)
        without = errors(fit_similarity(x, y), x, y)
        if not np.median(without) < 0.25 * np.median(rest):
            return []
        name = f' ("{plain(self.names[worst], 60)}")' if self.names else ""
        return [
            f"pair {worst + 1}{name} is {100 * known[worst]:.0f} cm from where the others put it, and they agree to "
            f"{100 * np.median(without):.2g} cm without it: was it picked wrong?"
        ]


def read_pairs(path: Path) -> Pairs:
    """The pairs in a CSV or JSON file. Raises `NergError` for a file that holds none."""
    source = f'the file "{path}"'
    size_of(path, "file of pairs", PAIRS_BYTES)
    tracking, place, names = _read_json(path) if path.suffix.lower() == ".json" else _read_csv(path)
    if not len(tracking):
        raise NergError(f"{source} holds no pairs of points; it is {_SHAPE}")
    return Pairs(tracking, place, source, names)


def _read_csv(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    columns = table_columns(path)
    missing = [name for name in _COLUMNS if name not in columns]
    if missing:
        raise NergError(f'the file of pairs "{path}" has no column {", ".join(missing)}; it is {_SHAPE}')
    texts = ["name"] if "name" in columns else []
    blocks = list(iterate_table(path, _COLUMNS, texts))
    if not blocks:
        return np.zeros((0, 3)), np.zeros((0, 3)), ()
    numbers = np.concatenate([b.numbers for b in blocks])
    names = tuple(str(t[0]) for b in blocks for t in b.texts) if texts else ()
    return numbers[:, :3], numbers[:, 3:], names


def _read_json(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    rows: Any = read_json(path, "file of pairs", PAIRS_BYTES)
    rows = rows.get("pairs") if isinstance(rows, dict) else rows
    try:
        points = [np.array([[float(v) for v in row[k]] for row in rows]) for k in ("tracking", "place")]
        if rows and any(p.shape != (len(rows), 3) for p in points):
            raise ValueError("a point has three coordinates")
        names = tuple(str(row.get("name", "")) for row in rows)
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, OverflowError) as error:
        raise NergError(f'the file of pairs "{path}" cannot be used ({plain(error)}); it is {_SHAPE}') from error
    return points[0].reshape(-1, 3), points[1].reshape(-1, 3), names if any(names) else ()


def _rms(off: np.ndarray) -> float:
    return float(np.sqrt(np.mean(off**2)))


def _cm(off: np.ndarray, percent: float) -> float | None:
    return float(100 * np.percentile(off, percent)) if len(off) else None
