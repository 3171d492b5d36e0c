"""Error of the eye tracker in measures of areas: disturbed samples, extrapolation to no error, and areas too small."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from nerg_mi.environment.arrays import join_names
from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.values import to_name
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import open_named_table

from .estimates import estimate_ratios
from .placed import PlacedAreas
from .settings import TrackerError, VisitRules
from .tables import MEASURES_BY_NAME, NO_INTERVAL, Measure, MinParticipantsFilter, Participants, Row
from .visits import VisitSums, make_timeline

# ---- Disturbed samples ----
#
# A recorded direction is the true one turned by an offset, constant in a session, and by noise of its own. Both are
# normally distributed in two dimensions. *Accuracy* is the mean angle of the offset, sqrt(pi / 2) times its standard
# deviation along an axis; *precision* is the root mean square angle of the noise, sqrt(2) times that deviation.

OFFSET_SCALE, NOISE_SCALE = np.sqrt(2 / np.pi), np.sqrt(1 / 2)
LEVELS = (1, 2)
"""Variances of the added error, in units of the tracker's."""

MAX_ANGLE = 20.0  # degrees


def read_validation(path: Path) -> dict[str, tuple[float, float]]:
    """Read accuracy and precision in degrees by participant from a table of validations.

    Its columns are person, accuracy, and precision or ``std``, as in the table of data quality of `nerg rays events`.
    Several rows of a participant are averaged, and rows without accuracy are ignored; an unknown precision is NaN.
    Raises `NergError` for missing columns and for values outside of 0 to 20 degrees.
    """
    values: dict[str, list[list[float]]] = {}
    present, blocks = open_named_table(
        path, ("accuracy", "precision", "std"), ("person",), optional=("precision", "std")
    )
    columns = [present.index(name) for name in ("accuracy", *[n for n in ("precision", "std") if n in present][:1])]
    for block in blocks:
        for row, (text,) in zip(block.numbers[:, columns].tolist(), block.texts.tolist()):
            if not all(0 <= value <= MAX_ANGLE for value in row if not np.isnan(value)):
                raise NergError(
                    f'"{path}" has {join_names([f"{value:g}" for value in row])} degrees for "{sanitize(text, 40)}"; '
                    f"accuracy and precision must be numbers from 0 to {MAX_ANGLE:g}"
                )
            if not np.isnan(row[0]):
                values.setdefault(to_name(text), []).append([*row, np.nan][:2])
    if not values:
        raise NergError(f'"{path}" contains no accuracy; write the header person,accuracy,precision and one row each')
    means = {name: np.mean(rows, axis=0).tolist() for name, rows in values.items()}
    return {name: (accuracy, precision) for name, (accuracy, precision) in means.items()}


@dataclass(frozen=True)
class Disturbance:
    """Adds the error of the tracker to samples again.

    Parameters
    ----------
    error
        Accuracy, precision and the number of draws.
    by_participant
        Accuracy and precision in degrees of single participants, which replace those of ``error``.
    """

    error: TrackerError
    by_participant: Mapping[str, tuple[float, float]]

    @property
    def mean_accuracy(self) -> float:
        """Accuracy in degrees, averaged over the participants of the table."""
        values = [accuracy for accuracy, _ in self.by_participant.values()]
        return float(np.mean(values)) if values else self.error.accuracy

    def draw(self, rays: Rays, rules: VisitRules) -> Iterator[Rays]:
        """Yield the samples with an added error: all draws of the first of `LEVELS`, then those of the second.

        ``rays`` are whole sessions, sorted by participant and time. The draws of a session depend on its participant
        and its start only, so that any partition of the data gives the same ones.
        """
        session = make_timeline(rays.person, rays.t, rules).session
        starts = np.flatnonzero(np.diff(session, prepend=-1))
        ends = np.r_[starts[1:], len(session)]
        usual = (self.error.accuracy, self.error.precision)
        for level in LEVELS:
            for draw in range(self.error.draws):
                angles = np.empty((len(rays), 2))
                for start, end in zip(starts.tolist(), ends.tolist()):
                    name = rays.persons[rays.person[start]]
                    accuracy, precision = np.radians(self.by_participant.get(name, usual))
                    precision = np.radians(self.error.precision) if np.isnan(precision) else precision
                    # Both levels use the same numbers, so that less noise remains in their difference.
                    rng = np.random.default_rng((zlib.crc32(name.encode()), abs(hash(float(rays.t[start]))), draw))
                    offset = OFFSET_SCALE * accuracy * rng.standard_normal(2)
                    noise = NOISE_SCALE * precision * rng.standard_normal((end - start, 2))
                    angles[start:end] = np.sqrt(level) * (offset + noise)
                yield replace(rays, direction=turn_directions(rays.direction, angles))


def turn_directions(directions: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Turn unit ``directions`` (N, 3) by ``angles`` (N, 2) in radians, to the right and up; the z axis is up.

    The turn is along the great circle in the direction of the two angles, by their length.
    """
    right = np.cross(directions, (0.0, 0.0, 1.0))
    length = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(length > 1e-6, right / np.maximum(length, 1e-6), (1.0, 0.0, 0.0))
    upward = np.cross(right, directions)
    angle = np.linalg.norm(angles, axis=1, keepdims=True)
    tangent = angles[:, :1] * right + angles[:, 1:] * upward
    return np.cos(angle) * directions + np.sinc(angle / np.pi) * tangent


# ---- Extrapolation to no error ----
#
# Simulation extrapolation (Cook and Stefanski 1994): the mean f(v) of a measure over draws with added error of variance
# v, in units of the tracker's, continues to v = -1, where no error is left. Through v = 0, 1 and 2 passes a parabola
# with f(-1) = 3 f(0) - 3 f(1) + f(2). The offsets of participants are independent, so that an interval over
# participants contains the error of their trackers.

CORRECTED_MEASURES = ("share", "dwell", "hit_ratio", "time_to_first_visit")


def tracker_rows(
    areas: Sequence[str], sums: VisitSums, draws: int, suppression: MinParticipantsFilter, *, resamples: int, seed: int
) -> list[Row]:
    """Return a row for each cell, area and corrected measure of ``sums``, which contain the draws.

    ``recorded`` is the value of the samples, ``disturbed`` the mean of those with the error added once more, and
    ``corrected``, with ``low`` and ``high``, is extrapolated to no error.
    """
    recorded = sums.select_draw(0)
    disturbed = [sums.select_draw(draw) for draw in range(1, len(LEVELS) * draws + 1)]
    rows: list[Row] = []
    for cell in recorded.cells:
        people = [Participants.from_sums(s, cell, has_visibility=False) for s in (recorded, *disturbed)]
        for name in CORRECTED_MEASURES:
            measure = MEASURES_BY_NAME[name]
            values = np.stack([_influence(measure, p) for p in people])
            first, once, twice = values[0], values[1 : draws + 1].mean(axis=0), values[draws + 1 :].mean(axis=0)
            extrapolated = 3 * first - 3 * once + twice
            is_known = np.isfinite(extrapolated).all(axis=0)
            estimate = estimate_ratios(
                np.where(is_known, extrapolated, 0.0),
                np.ones_like(extrapolated),
                resamples=resamples,
                seed=seed,
                upper_limit=measure.upper_limit,
            )
            columns = {"recorded": first.mean(axis=0), "disturbed": once.mean(axis=0)}
            columns["corrected"] = np.clip(estimate.value, 0.0, measure.upper_limit)
            columns |= {"low": estimate.low, "high": estimate.high}
            for a, area in enumerate(areas):
                row: Row = {"cell": cell.dimension, "value": cell.value, "aoi": area, "measure": name}
                is_allowed = suppression.admit(len(first))
                row["participants"] = len(first) if is_allowed else None
                for key, column in columns.items():
                    is_shown = is_allowed and np.isfinite(column[a]) and (is_known[a] or key == "recorded")
                    row[key] = float(column[a]) if is_shown else None
                row["note"] = _explain_row(row, is_allowed, suppression)
                rows.append(row)
    return rows


def _influence(measure: Measure, people: Participants) -> np.ndarray:
    """Return values (P, A) whose mean over participants is the measure, with the spread of its linearised error."""
    pair = measure.numerator_denominator(people)
    assert pair is not None
    x, y = pair
    total = y.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(total > 0, x.sum(axis=0) / total, np.nan)
        return value + (x - value * y) * len(x) / total


def _explain_row(row: Row, is_allowed: bool, suppression: MinParticipantsFilter) -> str:
    if not is_allowed:
        return suppression.reason
    if row["recorded"] is None:
        return f"no {MEASURES_BY_NAME[row['measure']].population}"
    if row["corrected"] is None:
        return "undefined with added error"
    return "" if row["low"] is not None and row["high"] is not None else NO_INTERVAL


# ---- Areas that are too small ----

_MAX_OBSERVERS = 256
_NUM_POINTS = 64


def resolution_rows(placed: PlacedAreas, observers: np.ndarray, accuracy: float) -> list[Row]:
    """Return areas and pairs of areas that a tracker of ``accuracy`` degrees cannot tell apart.

    Parameters
    ----------
    placed
        The areas.
    observers
        Positions (M, 3) from which they were looked at, in the scene.
    accuracy
        Mean angle of the tracker's offset in degrees.

    Returns
    -------
    list of dict
        A row for each area whose smaller ``extent`` in degrees, and for each pair of areas whose ``extent``, the
        distance of their centres, is below twice the accuracy: medians over the observers.
    """
    eyes = observers[:: max(1, -(-len(observers) // _MAX_OBSERVERS))]
    points = [np.asarray(aoi.sample_points(_NUM_POINTS)[0], float) for aoi in placed.aois]
    names = [name for name, members in zip(placed.areas.names, placed.members) if len(members) == 1]
    of_areas = [points[members[0]] for members in placed.members if len(members) == 1]
    if not len(eyes) or not of_areas:
        return []
    centers = np.stack([_to_directions(p, eyes).mean(axis=0) for p in of_areas])
    centers /= np.linalg.norm(centers, axis=2, keepdims=True)
    rows: list[Row] = []
    add = lambda name, neighbour, extent: rows.append(
        {"aoi": name, "neighbour": neighbour, "extent": float(extent), "limit": 2.0 * accuracy}
    )
    for name, p, center in zip(names, of_areas, centers):
        if (extent := np.median(_smaller_extent(_to_directions(p, eyes), center))) < 2 * accuracy:
            add(name, "", extent)
    for (a, first), (b, second) in combinations(enumerate(centers), 2):
        cosine = np.clip((first * second).sum(axis=1), -1, 1)
        if (distance := np.median(np.degrees(np.arccos(cosine)))) < 2 * accuracy:
            add(names[a], names[b], distance)
    return rows


def _to_directions(points: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Return the unit directions (P, M, 3) from M ``eyes`` to P ``points``."""
    towards = points[:, None] - eyes[None]
    return towards / np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-12)


def _smaller_extent(directions: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the smaller extent (M,) in degrees of ``directions`` (P, M, 3) around the unit directions ``center``
    (M, 3), along the principal axes in their tangent plane."""
    tangent = directions - (directions * center).sum(axis=2, keepdims=True) * center
    axes = np.linalg.eigh(np.einsum("pmi,pmj->mij", tangent, tangent))[1][:, :, 1]  # the first one is the centre
    along = np.einsum("pmi,mi->pm", tangent, axes)
    return np.degrees(np.ptp(np.arcsin(np.clip(along, -1, 1)), axis=0))
