"""Error of the eye tracker in measures of areas: disturbed samples, extrapolation to no error, and areas too small."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from nerg_mi.environment.sampler import DirectionQuery
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.values import to_name
from nerg_mi.progress import Reporter
from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.events import label_fixations
from nerg_mi.tracking.rays import Rays

from .estimates import estimate_ratios
from .placed import PlacedAreas
from .settings import TrackerError, VisitRules
from .tables import MEASURES_BY_NAME, NO_INTERVAL, MinParticipantsFilter, Participants, Row
from .validations import Validation, Validations
from .visits import Cell, make_timeline

# ---- Disturbed samples ----
#
# A recorded direction is the true one turned by an offset, constant in a session, by another one, constant in a
# fixation, and by noise of its own. All are normally distributed in two dimensions. *Accuracy* is the mean angle of
# both offsets, sqrt(pi / 2) times their standard deviation along an axis; *precision* is the root mean square angle of
# the noise, sqrt(2) times that deviation.

OFFSET_SCALE, NOISE_SCALE = np.sqrt(2 / np.pi), np.sqrt(1 / 2)
LEVELS = (1, 2)
"""Variances of the added error, in units of the tracker's."""

_RING_DIRECTIONS = 6  # number of directions around the central one


@dataclass(frozen=True)
class Disturbance:
    """Adds the error of the tracker to samples again.

    Parameters
    ----------
    error
        Accuracy, precision and the number of draws.
    by_participant
        Validations of single participants, whose accuracy and precision replace those of ``error``.
    """

    error: TrackerError
    by_participant: Validations

    @property
    def mean_accuracy(self) -> float:
        """Accuracy in degrees, averaged over the participants of the table."""
        return float(np.mean([accuracy for accuracy, _ in self._errors()]))

    @property
    def sigma(self) -> float:
        """Standard deviation along an axis, in radians, of the error of a sample of any participant."""
        accuracy, precision = np.radians(self._errors()).T
        return float(np.sqrt(np.mean((OFFSET_SCALE * accuracy) ** 2 + (NOISE_SCALE * precision) ** 2)))

    def check_participants(self, names: Iterable[str], reporter: Reporter) -> None:
        """Report which participants of a recording no table of validations has. Raises `NergError` if it has none."""
        tracked = sorted(map(to_name, names))
        missing = [name for name in tracked if name not in self.by_participant]
        if not self.by_participant or not missing:
            return
        if len(missing) == len(tracked):
            theirs, ours = (", ".join(sanitize(n, 40) for n in part[:5]) for part in ([*self.by_participant], tracked))
            raise NergError(
                f"no participant of the recording is in the table of {parameter('validation')}, which has {theirs}; "
                f"the recording has {ours}: write these names into the table"
            )
        reporter.warn(
            f'{len(missing):,} participants, such as "{sanitize(missing[0], 40)}", are not in the table of '
            f"{parameter('validation')}; their accuracy is taken as {self.error.accuracy:g} and their precision as "
            f"{self.error.precision:g} degrees"
        )

    def _errors(self) -> list[tuple[float, float]]:
        """Return accuracy and precision of all validations, or those of ``error`` without any."""
        rows = [self._fill(v) for validations in self.by_participant.values() for v in validations]
        return rows or [(self.error.accuracy, self.error.precision)]

    def _fill(self, validation: Validation) -> tuple[float, float]:
        precision = validation.precision
        return validation.accuracy, self.error.precision if np.isnan(precision) else precision

    def _find_error(self, participant: str, start: float) -> tuple[float, float]:
        """Return accuracy and precision in degrees of a session, by the validation nearest to its ``start``."""
        validations = self.by_participant.get(participant)
        if not validations:
            return self.error.accuracy, self.error.precision
        return self._fill(min(validations, key=lambda v: abs(v.start - start)))

    def draw(self, rays: Rays, rules: VisitRules) -> Iterator[Rays]:
        """Yield the samples with an added error: all draws of the first of `LEVELS`, then those of the second.

        ``rays`` are whole sessions, sorted by participant and time. The draws of a session depend on its participant
        and its start only, so that any partition of the data gives the same ones.
        """
        session = make_timeline(rays.person, rays.t, rules).session
        starts = np.flatnonzero(np.diff(session, prepend=-1))
        ends = np.r_[starts[1:], len(session)]
        part = self.error.fixation_part
        first = find_first_of_fixation(rays) if part > 0 else np.arange(len(rays))
        for level in LEVELS:
            for draw in range(self.error.draws):
                angles = np.empty((len(rays), 2))
                for start, end in zip(starts.tolist(), ends.tolist()):
                    name, time = rays.persons[rays.person[start]], float(rays.t[start])
                    accuracy, precision = np.radians(self._find_error(name, time))
                    # Both levels use the same numbers, so that less noise remains in their difference.
                    rng = np.random.default_rng((zlib.crc32(name.encode()), abs(hash(time)), draw))
                    offset = np.sqrt(1 - part) * rng.standard_normal(2)
                    noise = NOISE_SCALE * precision * rng.standard_normal((end - start, 2))
                    if part > 0:
                        row = np.maximum(first[start:end], start) - start
                        offset = offset + np.sqrt(part) * rng.standard_normal((end - start, 2))[row]
                    angles[start:end] = np.sqrt(level) * (OFFSET_SCALE * accuracy * offset + noise)
                yield replace(rays, direction=turn_directions(rays.direction, angles))


def find_first_of_fixation(rays: Rays) -> np.ndarray:
    """Return the index (N,) of the first sample of the fixation that each sample belongs to, by the default limits,
    its own outside of fixations. ``rays`` are sorted by participant and time."""
    label, _ = label_fixations(rays)
    rows = np.flatnonzero(label >= 0)
    _, index, number = np.unique(label[rows], return_index=True, return_inverse=True)
    first = np.arange(len(rays))
    first[rows] = rows[index][number]
    return first


def describe_tracker_fixations(error: TrackerError) -> dict[str, Any]:
    """Return ``{"tracker_fixations": definition}`` if an offset changes between fixations, as settings record it."""
    return {"tracker_fixations": EventRules().describe()} if error.fixation_part > 0 else {}


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


def disturb_query(query: DirectionQuery, sigma: float) -> DirectionQuery:
    """Return a query of the gaze density (3 M, N) of M ensemble members without an added error, and with one of each of
    `LEVELS`, whose unit is the standard deviation ``sigma`` along an axis in radians.

    The density is convolved with the error by a rule of seven directions, as in `nerg_mi.surfaces.sources`.
    """

    def query_levels(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        gaze, depth = query(directions)
        densities = [gaze]
        for level in LEVELS:
            ring = np.zeros_like(gaze)
            for k in range(_RING_DIRECTIONS):
                azimuth = 2 * np.pi * k / _RING_DIRECTIONS
                angles = 2 * sigma * np.sqrt(level) * np.array([np.cos(azimuth), np.sin(azimuth)])
                ring += query(turn_directions(directions, np.broadcast_to(angles, (len(directions), 2))))[0]
            densities.append(gaze / 2 + ring / (2 * _RING_DIRECTIONS))
        return np.concatenate(densities), depth

    return query_levels


# ---- Extrapolation to no error ----
#
# Simulation extrapolation (Cook and Stefanski 1994): the mean f(v) of a measure over draws with added error of variance
# v, in units of the tracker's, continues to v = -1, where no error is left. Through v = 0, 1 and 2 passes a parabola
# with f(-1) = 3 f(0) - 3 f(1) + f(2). The offsets of participants are independent, so that an interval over
# participants contains the error of their trackers.

CORRECTED_MEASURES = ("share", "dwell", "hit_ratio", "time_to_first_visit")


def tracker_rows(
    areas: Sequence[str],
    people: Mapping[Cell, Mapping[str, Sequence[Participants]]],
    suppression: MinParticipantsFilter,
    *,
    resamples: int,
    seed: int,
) -> list[Row]:
    """Return a row for each cell, area, source and corrected measure.

    ``people`` are the participants of each cell and source without an added error, then those of all draws of each of
    `LEVELS`. ``recorded`` is the value without an added error, ``disturbed`` the mean of those with the error added
    once more, and ``corrected``, with ``low`` and ``high``, is extrapolated to no error.
    """
    rows: list[Row] = []
    for cell, source, draws in ((c, s, draws) for c, sources in people.items() for s, draws in sources.items()):
        for measure in (MEASURES_BY_NAME[name] for name in CORRECTED_MEASURES):
            pairs = [pair for pair in map(measure.numerator_denominator, draws) if pair is not None]
            if not pairs:  # a gaze field has no time course
                continue
            values = np.stack([_influence(x, y) for x, y in pairs])
            first, (once, twice) = values[0], (v.mean(axis=0) for v in np.split(values[1:], len(LEVELS)))
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
                row: Row = {"cell": cell.dimension, "value": cell.value, "aoi": area, "source": source}
                is_allowed = suppression.admit(len(first))
                row |= {"measure": measure.name, "participants": len(first) if is_allowed else None}
                for key, column in columns.items():
                    is_shown = is_allowed and np.isfinite(column[a]) and (is_known[a] or key == "recorded")
                    row[key] = float(column[a]) if is_shown else None
                row["note"] = _explain_row(row, is_allowed, suppression)
                rows.append(row)
    return rows


def _influence(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return values (P, A) whose mean over participants is the ratio of the sums of ``x`` and ``y`` (P, A), with the
    spread of its linearised error."""
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
