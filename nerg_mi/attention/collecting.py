"""Collecting rays from sources: dropping what cannot be used, with an account of it."""
from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any, Sequence

import numpy as np

from .rays import FRAME, Rays


def file_sha256(path: str | os.PathLike) -> str:
    """Hex digest of a file's bytes."""
    digest = hashlib.sha256()
    with open(path, "rb") as source:
        while block := source.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _ranges(rows: np.ndarray) -> list[list[int]]:
    """Sorted row numbers as inclusive [first, last] runs: blinks come in runs,
    so that every dropped row can be named in little space."""
    if not rows.size:
        return []
    rows = np.unique(rows)
    cuts = np.flatnonzero(np.diff(rows) > 1)
    first = rows[np.r_[0, cuts + 1]]
    last = rows[np.r_[cuts, rows.size - 1]]
    return [[int(a), int(b)] for a, b in zip(first, last)]


class RaysBuilder:
    """Collects rays source by source, drops what cannot be used, and keeps the
    account: how many rows of which source were dropped, and why.

    ``about`` goes into the metadata as it is (preset, tick, column map, ...).
    """

    def __init__(self, *, transform: np.ndarray | None = None, **about: Any) -> None:
        self._transform = np.eye(4) if transform is None else np.asarray(transform, dtype=np.float64)
        self._about = about
        self._parts: list[tuple[np.ndarray, ...]] = []
        self._has_hit: list[bool] = []
        self._sources: list[dict[str, Any]] = []
        self._dropped: list[dict[str, Any]] = []
        self._rows_read = 0

    def source(self, path: Path) -> None:
        """Begin a file; only its name is recorded, with its checksum."""
        self._sources.append({"file": path.name, "sha256": file_sha256(path)})

    def add(
        self,
        t: np.ndarray,
        person: Sequence[str] | np.ndarray | str,
        origin: np.ndarray,
        direction: np.ndarray,
        *,
        rows: np.ndarray,
        confidence: np.ndarray | None = None,
        hit: np.ndarray | None = None,
        drop: dict[str, np.ndarray] | None = None,
    ) -> None:
        """Add n rows in the source's frame; directions need not be unit.

        ``rows`` (n,): 1-based rows of the source. ``drop``: further reasons,
        each with its mask (n,). A row counts under the first reason it meets.
        """
        n = len(t)
        person = np.broadcast_to(np.asarray(person, dtype=str), (n,))
        length = np.linalg.norm(direction, axis=1)
        confidence = np.ones(n) if confidence is None else np.asarray(confidence, dtype=np.float64)
        reasons = {
            "time is missing": ~np.isfinite(t),
            "origin is missing": ~np.isfinite(origin).all(axis=1),
            "direction is missing": ~np.isfinite(length),
            "direction is zero": length == 0,
            "confidence is missing or outside [0, 1]": ~((confidence >= 0) & (confidence <= 1)),
            **(drop or {}),
        }
        keep = np.ones(n, dtype=bool)
        for reason, mask in reasons.items():
            gone = keep & mask
            if gone.any():
                self._drop(reason, np.asarray(rows)[gone])
                keep &= ~mask
        self._rows_read += n
        self._has_hit.append(hit is not None)
        R, shift = self._transform[:3, :3], self._transform[:3, 3]
        scale = np.cbrt(abs(np.linalg.det(R)))
        self._parts.append(
            (
                np.asarray(t, dtype=np.float64)[keep],
                person[keep],
                origin[keep] @ R.T + shift,
                (direction[keep] / length[keep, None]) @ (R / scale).T,
                confidence[keep],
                np.full((keep.sum(), 3), np.nan) if hit is None else hit[keep] @ R.T + shift,
            )
        )

    def _drop(self, reason: str, rows: np.ndarray) -> None:
        name = self._sources[-1]["file"] if self._sources else ""
        for entry in self._dropped:
            if entry["reason"] == reason and entry["file"] == name:
                entry["count"] += int(rows.size)
                entry["rows"] += _ranges(rows)
                return
        self._dropped.append({"reason": reason, "file": name, "count": int(rows.size), "rows": _ranges(rows)})

    def build(self) -> Rays:
        """The rays collected. Raises ``ValueError`` when none is left."""
        columns = [np.concatenate(c) for c in zip(*self._parts)] if self._parts else []
        if not columns or not len(columns[0]):
            why = "; ".join(f"{d['count']} rows: {d['reason']}" for d in self._dropped[:4]) or "the files hold no rows"
            raise ValueError(f"no ray is left of {self._rows_read} rows ({why}); check the column map and the preset")
        t, names, origin, direction, confidence, hit = columns
        persons, codes = np.unique(names, return_inverse=True)
        metadata = {
            "frame": dict(FRAME),
            "transform": self._transform.tolist(),
            "sources": self._sources,
            "rows_read": self._rows_read,
            "dropped": self._dropped,
            **self._about,
        }
        return Rays(t, codes, tuple(persons), origin, direction, confidence, hit if any(self._has_hit) else None, metadata)
