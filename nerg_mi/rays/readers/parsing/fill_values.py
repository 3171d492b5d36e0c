"""Vectors whose components are all one fill value, as 0, 0, 0 or -1, -1, -1 where a program had nothing to write."""

from __future__ import annotations

import numpy as np

_FILLS = np.array(
    [
        *(0.0, -1.0, *(sign * 10.0**k - sign for k in range(2, 7) for sign in (1, -1))),
        *(limit for bits in (16, 32) for limit in (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1, 2.0**bits - 1)),
    ]
)
_LIMIT = 1e30  # of floats that are lengths or directions; a fill beyond is the largest of its type, however rounded
_APART = 0.1  # metres between a fill value and the nearest place of a person who was never there
_AIMED = np.cos(np.radians(2.0))  # of a ray that points at its hit point


def fill_values(v: np.ndarray) -> np.ndarray:
    """The fill value of vectors (..., C), (...); NaN of those that are none."""
    first = v[..., 0]
    is_fill = np.isin(first, _FILLS) | (np.isfinite(first) & (np.abs(first) > _LIMIT))
    return np.where((v == v[..., :1]).all(axis=-1) & is_fill, first, np.nan)


def is_filled_angles(angles: np.ndarray) -> np.ndarray:
    """Whether angles (n, C) of a head or of gaze, in degrees or radians, are one fill value, (n,) bool; 0 and -1 may be
    true."""
    return np.abs(fill_values(angles)) > 90


def is_aimed(origin: np.ndarray, direction: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Whether rays (n, 3) point at their hit points, to 2 degrees, (n,) bool."""
    way = hit - origin
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", way, direction) / np.linalg.norm(way, axis=1) / np.linalg.norm(direction, axis=1)
    return cosine > _AIMED


class FilledOrigins:
    """Finds origins of one source that are fill values, block by block.

    A place at exactly 0, 0, 0 may be true: somebody sits there, or a track begins there. It is a fill value where it is
    repeated and the same person is otherwise never within 0.1 m of it. ``metre``: of a unit of length.
    """

    def __init__(self, metre: float) -> None:
        self._apart = _APART / metre
        self._last: dict[int, np.ndarray] = {}  # the last place of each person that is none
        self._count: dict[tuple[int, float], int] = {}
        self.undecided: dict[int, int] = {}
        """Rows of a person that were let through since no other place was known yet, and turned out to be filled."""

    def find(self, origin: np.ndarray, person: np.ndarray) -> np.ndarray:
        """Which rows (n,) bool are filled, of origins (n, 3) and numbers of persons (n,)."""
        fill = fill_values(origin)
        filled, out = np.isfinite(fill), np.zeros(len(fill), bool)
        good = np.flatnonzero(np.isfinite(origin).all(axis=1) & ~filled)
        if filled.any():
            order = np.argsort(person, kind="stable")
            codes, starts = np.unique(person[order], return_index=True)
            for code, rows in zip(codes.tolist(), np.split(order, starts[1:])):
                if filled[rows].any():
                    out[rows] = self._find_of(code, origin[rows], fill[rows])
        if len(good):
            codes, at = np.unique(person[good][::-1], return_index=True)
            self._last.update(zip(codes.tolist(), origin[good[::-1][at]]))
        return out

    def _find_of(self, code: int, origin: np.ndarray, fill: np.ndarray) -> np.ndarray:
        others = origin[np.isnan(fill) & np.isfinite(origin).all(axis=1)]
        if code in self._last:
            others = np.vstack([others, self._last[code]])
        out = np.zeros(len(fill), bool)
        for value in np.unique(fill[np.isfinite(fill)]).tolist():
            before = self._count.get((code, value), 0)
            count = self._count[code, value] = before + int(np.count_nonzero(fill == value))
            if len(others) and count > 1 and np.linalg.norm(others - value, axis=1).min() > self._apart:
                out |= fill == value
                if before and code not in self._last:
                    self.undecided[code] = before
        return out
