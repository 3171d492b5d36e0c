"""Detects gaze in the head's frame that is read as gaze in the world, by columns of the head that are not used."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import sanitize

from . import poses
from .columns import HEAD_WORDS, ROTATION_WORDS, SIDE_WORDS, find_head_positions, find_roles, split_stem
from .tables import iterate_table

_MAX_EXTENT = 0.3  # metres; eyes in the head's frame stay within it
_MAX_BLOCKS = 16  # blocks of a table in which the head's columns are read
_MIN_ROWS = 50  # rows needed for a statement about directions
_MIN_CONCENTRATION = 0.9  # length of the mean direction of gaze in the head's frame: within about 25 degrees
_MAX_CONCENTRATION = 0.6  # the same of a head that turns by more than 60 degrees
_MAX_NAMES = 3  # files named in a warning


class HeadFrameFinder:
    """Compares the rays of each source with the unused columns of its tables: origins that stay in one place while a
    position moves, and directions that stay around one axis while a rotation of the head turns.

    ``metre``: length of the unit of the files in metres.
    """

    def __init__(self, metre: float) -> None:
        self._metre = metre
        self._fixed: dict[tuple[str, ...], list[str]] = {}  # files by the sentence's parts
        self._num_sources = 0
        self._begin()

    def _begin(self) -> None:
        self._tables: list[tuple[list[str], Callable[[Sequence[str]], np.ndarray]]] = []
        self._box = np.empty((0, 3))  # lowest and highest origin
        self._direction_sum, self._num_rows = np.zeros(3), 0

    def add_table(self, unused_columns: list[str], read: Callable[[Sequence[str]], np.ndarray]) -> None:
        """Add a table of the current source; ``read`` returns the complete rows (n, C) of some of its columns."""
        self._tables.append((unused_columns, read))

    def add_rays(self, origin: np.ndarray, direction: np.ndarray | None) -> None:
        """Add the origins (n, 3) in the file and the unit directions (n, 3) of rays of the current source; None if they
        are compared with the head elsewhere."""
        if len(origin):
            box = np.vstack([self._box, origin.min(axis=0), origin.max(axis=0)])
            self._box = np.stack([box.min(axis=0), box.max(axis=0)])
        if direction is not None:
            self._direction_sum += direction.sum(axis=0)
            self._num_rows += len(direction)

    def end_source(self, name: str) -> None:
        """Compare the rays of the current source, the file ``name``, with its unused columns."""
        self._num_sources += 1
        what = self._find_moving_position() or self._find_turning_head()
        if what:
            self._fixed.setdefault(what, []).append(name)
        self._begin()

    @property
    def has_fixed_origins(self) -> bool:
        return any(what.startswith("origins") for what, *_ in self._fixed)

    def describe(self, remedy: str) -> Iterator[str]:
        """Sentences for the quality report; ``remedy`` is what combines the gaze with the head."""
        for (what, verb, *names), files in self._fixed.items():
            more = f" and {len(files) - _MAX_NAMES} more files" if len(files) > _MAX_NAMES else ""
            which = "" if len(files) == self._num_sources else f" of {', '.join(files[:_MAX_NAMES])}{more}"
            columns = ", ".join(sanitize(name, 40) for name in names)
            yield (
                f"all {what.replace(' ', which + ' ', 1)}, while {columns} {verb}: the gaze is in the head's "
                f"frame; combine it with the head's position and rotation ({remedy})"
            )

    def _find_moving_position(self) -> tuple[str, ...] | None:
        if not len(self._box) or np.ptp(self._box, axis=0).max() * self._metre > _MAX_EXTENT:
            return None
        for columns, read in self._tables:
            vectors = find_roles(columns).vectors
            for stem in find_head_positions(vectors):
                if poses.is_fixed(self._box, read(vectors[stem])):
                    place = ", ".join(f"{v:.3g}" for v in self._box.mean(axis=0) + 0.0)
                    return f"origins are {place}", "move", *vectors[stem]
        return None

    def _find_turning_head(self) -> tuple[str, ...] | None:
        length = float(np.linalg.norm(self._direction_sum)) / max(self._num_rows, 1)
        if self._num_rows < _MIN_ROWS or length < _MIN_CONCENTRATION:
            return None
        for columns, read in self._tables:
            roles = find_roles(columns)
            for stem, names in (*roles.quaternions.items(), *roles.vectors.items()):
                words = split_stem(stem)
                if words & ROTATION_WORDS and words & HEAD_WORDS and not words & SIDE_WORDS:
                    if _measure_concentration(read(names)) < _MAX_CONCENTRATION:
                        return "directions stay around one axis", "turn", *names
        return None


def read_head_columns(path: Path, names: Sequence[str]) -> np.ndarray:
    """Complete rows (n, C) of columns of numbers in the first blocks of a table."""
    blocks = iterate_table(path, names, on_bad_line=lambda line, reason: None)
    values = [block.numbers for block in itertools.islice(blocks, _MAX_BLOCKS)]
    rows = np.concatenate([*values, np.empty((0, len(names)))])
    return rows[np.isfinite(rows).all(axis=1)]


def _measure_concentration(values: np.ndarray) -> float:
    """Length of the mean of a direction that turns with the head, for quaternions (n, 4) or angles (n, 3): 1 if the
    head does not turn. A rotation about one axis leaves the direction of this axis, so that the second smallest length
    of three axes counts."""
    if not len(values):
        return 1.0
    if values.shape[1] == 4:
        rotations = poses.rotations_from_quaternions(values)
        rotations = rotations[np.isfinite(rotations).all(axis=(1, 2))]
        return float(np.sort(np.linalg.norm(rotations.mean(axis=0), axis=0))[1]) if len(rotations) else 1.0
    angles = np.radians(values) if np.abs(values).max() > 2 * np.pi else values
    return float(np.abs(np.exp(1j * angles).mean(axis=0)).min())
