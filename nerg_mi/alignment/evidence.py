"""What an alignment is found from: one file a kind, each a class that fulfils `Evidence`.

Another kind is another such file, and a line where the job chooses among them (`nerg_mi.jobs.alignment`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from nerg_mi.errors import NergError

from .chart import Chart
from .surface import PlaceSurface, PlaceTraces, surface_of_points, surface_of_traces
from .umeyama import move

Progress = Callable[[float, str], None]
"""Told of a share of the work that is done, and of what is being done."""


@dataclass(frozen=True, eq=False)
class Target:
    """The place that tracking is aligned with, and what is known beforehand.

    ``traces``: what rays found of it, or ``points`` (N, 3) on its surfaces; neither where only its frame is needed.
    ``turn``: (4, 4) rotation from its frame to one in which z is up; ``upright``: whether that is known, so that the
    tracking's z stays up; ``floor``: height of the floor in the tracking, metres, None where it is not known;
    ``place_floor``: that of the place, along its up, None: to be found; ``scale``: units of the place a unit of the
    tracking, None: to be found.
    """

    traces: PlaceTraces | None = None
    points: np.ndarray | None = None
    turn: np.ndarray = field(default_factory=lambda: np.eye(4))
    upright: bool = True
    floor: float | None = 0.0
    place_floor: float | None = None
    scale: float | None = None

    @cached_property
    def surface(self) -> PlaceSurface:
        """Its surface, z up. Raises `NergError` where no place was given."""
        if self.traces is not None:
            return surface_of_traces(self.traces.moved(self.turn))
        if self.points is not None:
            return surface_of_points(move(self.turn, self.points))
        raise NergError(
            "this evidence needs the place itself: give --field FILE, --scene FILE or --surface FILE (a mesh or points)"
        )

    @property
    def place_level(self) -> float:
        """Height of the place's floor, z up."""
        return self.surface.floor() if self.place_floor is None else self.place_floor

    def to_place(self, matrix: np.ndarray) -> np.ndarray:
        """A similarity that leads to the place turned z up, as one that leads to the place."""
        return np.linalg.inv(self.turn) @ matrix


@dataclass(frozen=True, eq=False)
class Fit:
    """An alignment that was found.

    ``matrix``: (4, 4) from the tracking to the place. ``centimetres`` (N,) and ``degrees`` (M,): residuals, in metres
    of the tracking times 100, and as angles; ``covariance`` (7, 7) of rotation vector, translation (place's units) and
    logarithm of the scale, None where it is not known; ``mirrored``: a sentence where a mirrored frame fits better;
    ``points``: of the tracking (N, 3), to be drawn; ``targets``: where those belong in the place, (N, 3) or None;
    ``about``: what else is recorded (JSON); ``notes``: what is told; ``doubts``: what is told as a warning.
    """

    matrix: np.ndarray
    centimetres: np.ndarray
    degrees: np.ndarray
    covariance: np.ndarray | None = None
    mirrored: str | None = None
    points: np.ndarray | None = None
    targets: np.ndarray | None = None
    about: dict[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    doubts: Sequence[str] = ()


class Evidence(Protocol):
    """One kind of evidence for an alignment."""

    @property
    def kind(self) -> str:
        """Its name, as alignment.json has it."""
        ...

    def fit(self, target: Target, progress: Progress) -> Fit:
        """The similarity from the tracking to the place of ``target``. Raises `NergError` where the evidence leaves it
        open, saying what would settle it."""
        ...


def angles(viewpoint: np.ndarray, at: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Angles in degrees (N,) between points ``at`` and ``to``, both (N, 3), as seen from ``viewpoint``, (3,) or (N, 3);
    those nearer than a millionth of the farthest are left out."""
    a, b = at - viewpoint, to - viewpoint
    length = np.minimum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    seen = length > 1e-6 * max(float(length.max(initial=0)), 1e-300)
    a, b = a[seen], b[seen]
    # By both products: the arc of a cosine loses small angles.
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


def pair_covariance(source: np.ndarray, target: np.ndarray, matrix: np.ndarray, basis: np.ndarray) -> np.ndarray | None:
    """Covariance (7, 7) of a least-squares fit of points to points, from its normal equations, about the points' mean;
    None where there are no more points than numbers to be found."""
    chart = Chart(matrix, move(matrix, source).mean(axis=0), basis)
    start = np.zeros(chart.size)
    moved = chart.moved(start, source)
    by = np.concatenate([chart.pulled(start, moved, np.broadcast_to(e, moved.shape)) for e in np.eye(3)])
    free = by.shape[0] - chart.size
    if free < 1:
        return None
    variance = float(np.sum((moved - target) ** 2)) / free
    return basis @ (np.linalg.pinv(by.T @ by, hermitian=True) * variance) @ basis.T
