"""Fixations, saccades and other events of gaze samples in the world, from the motion of gaze and head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths import vmf

from .event_settings import FIXATIONS, KINDS, MAX_STEP, EventRules
from .filters import MAX_PAUSE, estimate_interval, group_by_person
from .rays import TRACKING, Rays

# ---- Fixations ----
#
# `label_fixations` is their one definition: events by velocities of gaze and head, which extend I-VT, or I-DT of
# Salvucci and Goldberg (2000), on directions in the world frame. Angles are in degrees, times in seconds.


def detect_fixations_idt(
    rays: Rays, dispersion: float = 3.0, min_duration: float = 0.1, gap: float = MAX_STEP
) -> np.ndarray:
    """Detect fixations by dispersion (I-DT): a window of ``min_duration`` seconds with a dispersion of at most
    ``dispersion`` degrees grows as long as this holds; otherwise the window starts one ray later.

    Dispersion is the horizontal plus the vertical range (max - min) of the directions, in the tangent plane of the
    sphere at the window's first direction (azimuthal equidistant projection, horizontal and vertical axes). A pause
    longer than ``gap`` ends a fixation. Returns the number of the fixation of each ray, by participant and time, or -1,
    (N,) int64.
    """
    require_gaze(rays)
    _require_positive(dispersion=dispersion, min_duration=min_duration, gap=gap)
    order, starts = group_by_person(rays)
    t, d = rays.t[order], rays.direction[order]
    bounds = np.flatnonzero(np.r_[True, np.diff(t) > gap])
    bounds = np.union1d(bounds, starts)
    label = np.full(len(t), -1, np.int64)
    number = 0
    for a, b in zip(bounds[:-1], bounds[1:]):
        # The last ray of the shortest window from each start; b if too little time is left.
        full = np.searchsorted(t[a:b], t[a:b] + min_duration - 1e-9) + a
        start, possible = a, _find_window_starts(d[a:b], full - a, b - a, dispersion)
        for s in np.flatnonzero(possible) + a:
            if s < start:
                continue
            start = _grow_window(d, s, full[s - a] + 1, b, dispersion)
            label[s:start] = number
            number += 1
    out = np.empty_like(label)
    out[order] = label
    return out


def require_gaze(rays: Rays) -> None:
    """Raise `NergError` for directions of heads, whose fixations and saccades are no eye movements."""
    if rays.tracking in ("head", "mixed"):
        raise NergError(
            f"eye movements are detected in gaze, but these rays are {TRACKING[rays.tracking]}; use rays of an eye "
            "tracker, or leave out their fixations and events"
        )


def warn_unknown_tracking(tracking: str, warn: Callable[[str], Any]) -> None:
    """Call ``warn`` with a sentence if eye movements are detected in rays of the ``tracking`` "unknown"."""
    if tracking == "unknown":
        warn(
            "the rays do not state whether they are gaze or directions of heads, and are taken as gaze: import them "
            'again, or state it in Python (rays.with_tracking("eye"))'
        )


def label_fixations(
    rays: Rays, rules: EventRules | None = None, dispersion: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Label the fixations of rays, by the one definition of all exports, figures and reports.

    Fixations are the events of `detect_events` whose kind is one of `FIXATIONS`; with a ``dispersion`` in degrees those
    of `detect_fixations_idt`. `EventRules.describe` returns the definition and its parameters.

    Returns
    -------
    label : ndarray of shape (N,), int64
        Number of the fixation of each ray, by participant and time; -1: none.
    kinds : ndarray of shape (F,)
        Kinds of the fixations, of `FIXATIONS`.
    """
    rules = rules or EventRules()
    if dispersion is not None:
        label = detect_fixations_idt(rays, dispersion, rules.min_fixation, rules.max_step)
        return label, np.full(label.max(initial=-1) + 1, FIXATIONS[0])
    events = detect_events(rays, rules)
    mask = np.isin(events.kind, FIXATIONS)
    order, _ = group_by_person(rays)
    position = np.empty(len(rays), np.int64)
    position[order] = np.arange(len(rays))
    run, sample = expand_runs(np.stack([position[events.first[mask]], position[events.last[mask]]], axis=1), 1)
    label = np.full(len(rays), -1, np.int64)
    label[order[sample]] = run
    return label, events.kind[mask]


def describe_slow_sampling(rays: Rays, rules: EventRules) -> str:
    """Return that samples are too far apart for fixations by ``rules``, as part of a sentence; "" if they are not."""
    order, _ = group_by_person(rays)
    interval = estimate_interval(np.diff(rays.t[order])[np.diff(rays.person[order]) == 0])
    if not interval > rules.max_step * (1 - 1e-6):
        return ""
    return f"samples are {interval:.3g} s apart, and intervals above {rules.max_step:g} s end fixations"


def explain_missing_fixations(rays: Rays, rules: EventRules, dispersion: float | None = None) -> str:
    """Return that ``rays`` have no fixation by these limits, with the reason and the remedy."""
    if slow := describe_slow_sampling(rays, rules):
        return f"no fixation was detected; {slow}: raise {parameter('max_step')}"
    name, limit = "velocity_threshold", f"below {rules.velocity_threshold:g} degrees per second"
    if dispersion is not None:
        name, limit = "dispersion_threshold", f"within {dispersion:g} degrees"
    return (
        f"no fixation was detected; gaze never stays {limit} for {rules.min_fixation:g} s: raise {parameter(name)}, or "
        f"lower {parameter('min_fixation')}"
    )


def average_fixations(
    rays: Rays, label: np.ndarray, rules: EventRules | None = None, dispersion: float | None = None
) -> tuple[Rays, np.ndarray]:
    """Average the rays of each fixation.

    Returns F rays, with the mid time and the mean origin, direction, confidence, hit point and head (of those that are
    finite) of the rays with the same number in ``label`` (N,; -1: none), and the durations (F,) in seconds. Raises
    `NergError` if there is no fixation, by the limits of `label_fixations`.
    """
    rows = np.flatnonzero(label >= 0)
    if not rows.size:
        raise NergError(explain_missing_fixations(rays, rules or EventRules(), dispersion))
    _, index, number = np.unique(label[rows], return_index=True, return_inverse=True)
    n = np.bincount(number).astype(np.float64)
    mean = lambda v: np.stack([np.bincount(number, weights=c) for c in v[rows].T], axis=1) / n[:, None]
    direction = mean(rays.direction)
    first, last = np.full(len(n), np.inf), np.full(len(n), -np.inf)
    np.minimum.at(first, number, rays.t[rows])
    np.maximum.at(last, number, rays.t[rows])
    hit = None if rays.hit is None else _nanmean_by_group(rays.hit[rows], number)
    head = None if rays.head is None else _nanmean_by_group(rays.head[rows], number)
    if head is not None:
        head /= np.linalg.norm(head, axis=1, keepdims=True)
    fixations = replace(
        rays.select(rows[index]),
        t=0.5 * (first + last),
        origin=mean(rays.origin),
        hit=hit,
        head=head,
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        confidence=np.clip(np.bincount(number, weights=rays.confidence[rows]) / n, 0.0, 1.0),
    )
    return fixations, last - first


def _nanmean_by_group(values: np.ndarray, number: np.ndarray, count: int = 0) -> np.ndarray:
    """Means (F, C) of the finite rows of ``values`` (N, C) per ``number`` (N,); NaN for groups without finite rows.
    ``count`` is the least F."""
    is_finite = np.isfinite(values).all(axis=1)
    weight = np.bincount(number, weights=is_finite.astype(float), minlength=count)
    sums = np.stack(
        [np.bincount(number, weights=np.where(is_finite, c, 0.0), minlength=count) for c in values.T], axis=1
    )
    with np.errstate(invalid="ignore"):
        return sums / weight[:, None]


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles in degrees between unit vectors."""
    return np.degrees(2.0 * np.arcsin(np.minimum(1.0, np.sqrt(0.5 * vmf.one_minus_cosine(a, b)))))


def _project_to_plane(d: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Horizontal and vertical angles (..., 2) in degrees of directions (..., 3) from ``first`` (..., 3), in the
    azimuthal equidistant projection."""
    level = np.hypot(first[..., 0], first[..., 1])
    steep = level < 1e-9  # a vertical direction has no horizontal axis of its own
    side = np.stack(
        [np.where(steep, 1.0, first[..., 1]), np.where(steep, 0.0, -first[..., 0]), np.zeros_like(level)], axis=-1
    )
    side = side / np.where(steep, 1.0, level)[..., None]
    upright = np.cross(side, first)
    dot = lambda u: np.sum(d * u, axis=-1)
    x, y, z = dot(side), dot(upright), dot(first)
    r = np.hypot(x, y)
    scale = np.where(r > 1e-12, np.degrees(np.arctan2(r, z)) / np.maximum(r, 1e-12), np.degrees(1.0))
    return np.stack([x * scale, y * scale], axis=-1)


def _find_window_starts(d: np.ndarray, full: np.ndarray, n: int, dispersion: float) -> np.ndarray:
    """Mask (n,) bool of starts whose window of minimum duration passes the threshold. Tests all starts at once, since
    most of them fail."""
    out = full < n
    starts = np.flatnonzero(out)
    if not starts.size:
        return out
    width = int((full[starts] - starts).max()) + 1
    for block in np.array_split(starts, max(1, starts.size * width >> 20)):
        at = np.minimum(block[:, None] + np.arange(width), full[block][:, None])
        plane = _project_to_plane(d[at], d[block][:, None, :])
        out[block] = np.ptp(plane, axis=1).sum(axis=1) <= dispersion
    return out


def _grow_window(d: np.ndarray, start: int, end: int, limit: int, dispersion: float) -> int:
    """End of the largest window from ``start`` that passes the threshold, at least ``end``."""
    step = 32
    while True:
        upto = min(end + step, limit)
        plane = _project_to_plane(d[start:upto], d[start])
        spread = (np.maximum.accumulate(plane) - np.minimum.accumulate(plane)).sum(axis=1)
        exceeding = np.flatnonzero(spread > dispersion)
        if exceeding.size:
            return start + int(exceeding[0])
        if upto == limit:
            return limit
        end, step = upto, 4 * step


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise NergError(f"{name} must be positive, got {value}")


# ---- Events: fixations, pursuit, saccades and pauses ----
#
# Gaze moves in the world by the eye in the head and by the head. Both velocities together tell what happens, as for
# people who watch 360-degree videos (Agtzidis, Startsev and Dorr 2019) and who walk (Kothari et al. 2020): gaze rests
# in the world although the eye turns in the head (vestibulo-ocular reflex), is carried along by the head, or jumps.

_CODES = {name: code for code, name in enumerate(KINDS)}
_MIN_STRAIGHTNESS = 0.5  # of a pursuit: its net angle relative to the sum of its steps
_MIN_HIT_FRACTION = 0.5  # of the samples of a run, for a fixed point
_MIN_POINT_DISTANCE = 0.1  # metres between an eye and a fixed point
_MIN_MISSING = 2  # samples in a blink: a single one is missing for many reasons


@dataclass(frozen=True, eq=False)
class Events:
    """E events by participant and time. Consecutive ones share a sample: the last of one is the first of the next."""

    first: np.ndarray  # (E,) index of the ray with which the event begins
    last: np.ndarray  # (E,) index of the ray with which it ends
    kind: np.ndarray  # (E,) names, of `KINDS`
    onset: np.ndarray  # (E,) seconds on the clock of the rays
    duration: np.ndarray  # (E,) seconds
    amplitude: np.ndarray  # (E,) degrees between the first and the last direction in the world
    peak_velocity: np.ndarray  # (E,) degrees per second of gaze in the world; NaN for pauses
    direction: np.ndarray  # (E, 3) mean direction of fixations and pursuits, unit; NaN for others
    point: np.ndarray  # (E, 3) mean hit point of fixations and pursuits, metres; NaN if unknown, and for others

    def __len__(self) -> int:
        return len(self.first)

    def count(self) -> dict[str, int]:
        """The number of events by kind, of kinds with any."""
        return {kind: n for kind in KINDS if (n := int(np.count_nonzero(self.kind == kind)))}


@dataclass(frozen=True, eq=False)
class Velocities:
    """Angular velocities between consecutive rays in ``order``, by participant and time: N - 1 steps."""

    order: np.ndarray  # (N,) indices of rays
    step: np.ndarray  # (N - 1,) seconds; NaN between participants
    gaze: np.ndarray  # (N - 1,) degrees per second of gaze in the world; NaN where no time passes
    head: np.ndarray  # (N - 1,) of the head in the world; NaN if unknown
    eye: np.ndarray  # (N - 1,) of gaze in the head; NaN if the head is unknown


def measure_velocities(rays: Rays) -> Velocities:
    """Measure the velocities of gaze in the world, of the head, and of gaze in the head.

    The rotation of the head between two samples is the smallest one between its directions: its roll is not recorded.
    """
    order, step, gaze = _measure_steps(rays)
    if rays.head is None:
        unknown = np.full(len(step), np.nan)
        return Velocities(order, step, gaze, unknown, unknown)
    d, h = rays.direction[order], rays.head[order].astype(np.float64)
    step_or_nan = np.where(step > 0, step, np.nan)
    carried = _rotate_between(h[:-1], h[1:], d[:-1])
    with np.errstate(invalid="ignore"):
        return Velocities(
            order, step, gaze, _angles(h[1:], h[:-1]) / step_or_nan, _angles(d[1:], carried) / step_or_nan
        )


def _measure_steps(rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order, steps and velocities of gaze, as in `Velocities`."""
    order, _ = group_by_person(rays)
    step = np.where(np.diff(rays.person[order]) == 0, np.diff(rays.t[order]), np.nan)
    d = rays.direction[order]
    return order, step, _angles(d[1:], d[:-1]) / np.where(step > 0, step, np.nan)


def _rotate_between(a: np.ndarray, b: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate ``v`` (N, 3) by the smallest rotations from unit vectors ``a`` to ``b`` (N, 3)."""
    dot = lambda x, y: np.einsum("ij,ij->i", x, y)[:, None]
    middle = a + b
    with np.errstate(invalid="ignore", divide="ignore"):
        rotated = v - middle * dot(middle, v) / (1 + dot(a, b)) + 2 * b * dot(a, v)
        return rotated / np.linalg.norm(rotated, axis=1, keepdims=True)


def angles_about(direction: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Azimuth and elevation (N, 2) in degrees (Fick angles) of unit directions (N, 3), as seen by somebody who faces
    ``ahead`` (N, 3) with the head upright (z up). Both are 0 for ``ahead`` itself."""
    level = np.hypot(ahead[:, 0], ahead[:, 1])
    is_steep = level < 1e-9  # a vertical direction has no horizontal axis of its own
    x, y = (np.where(is_steep, steep, v / np.where(is_steep, 1.0, level)) for steep, v in zip((0, 1), ahead.T))
    right = np.stack([y, -x, np.zeros_like(x)], axis=1)
    up = np.cross(right, ahead)
    r, u, f = (np.einsum("ij,ij->i", direction, axis) for axis in (right, up, ahead))
    return np.degrees(np.stack([np.arctan2(r, f), np.arctan2(u, np.hypot(r, f))], axis=1))


def detect_events(rays: Rays, rules: EventRules | None = None) -> Events:
    """Divide the samples of each participant into events by the velocities of gaze and head.

    Steps between samples are fast or slow, by ``rules.velocity_threshold``. A run of fast steps, and slow ones between
    them for up to ``rules.merge_gap``, is a saccade or visual scanning.
    A run of slow steps is a fixation or pursuit, if it lasts ``rules.min_fixation``: a pursuit if gaze drifts steadily
    away both from its mean direction and, where hit points are known, from their mean, which is fixed also for somebody
    who walks past. Shorter slow runs are no event. A step longer than ``rules.max_step`` is a pause if samples are
    missing, by the sampling interval of the recording. One longer than a minute separates recordings.
    """
    require_gaze(rays)
    rules = rules or EventRules()
    v = measure_velocities(rays)
    with np.errstate(invalid="ignore"):
        is_joined = (v.step > 0) & (v.step <= rules.max_step)
        is_fast = is_joined & (v.gaze > rules.velocity_threshold)
        missing = _count_missing(v.step)
        is_pause = (v.step > rules.max_step) & (v.step <= MAX_PAUSE) & (missing > 0)
        is_blink = is_pause & (v.step <= rules.max_blink) & (missing >= _MIN_MISSING)
    is_fast = _fill_interruptions(is_fast, is_joined, rays.t[v.order], rules.merge_gap)
    fast, slow = _find_runs(is_fast), _find_runs(is_joined & ~is_fast)
    slow = _select_long(slow, rays.t[v.order], rules.min_fixation)
    pauses = np.flatnonzero(is_pause)
    peak_eye = _peak(v.eye, fast)
    slow_kinds, direction, point = _classify_slow(rays, v, slow, rules)
    runs = np.concatenate([fast, slow, np.stack([pauses, pauses + 1], axis=1)])
    codes = np.concatenate(
        [
            np.where(
                np.isnan(peak_eye) | (peak_eye > rules.eye_velocity), _CODES["saccade"], _CODES["visual_scanning"]
            ),
            slow_kinds,
            np.where(is_blink[pauses], _CODES["blink"], _CODES["loss"]),
        ]
    ).astype(np.int64)
    peak = np.concatenate([_peak(v.gaze, fast), _peak(v.gaze, slow), np.full(len(pauses), np.nan)])
    unknown = lambda n: np.full((n, 3), np.nan)
    direction, point = (np.concatenate([unknown(len(fast)), m, unknown(len(pauses))]) for m in (direction, point))
    by_time = np.argsort(runs[:, 0], kind="stable")
    runs, first, last = runs[by_time], v.order[runs[by_time, 0]], v.order[runs[by_time, 1]]
    return Events(
        first,
        last,
        np.array(list(KINDS))[codes[by_time]],
        rays.t[first],
        rays.t[last] - rays.t[first],
        _angles(rays.direction[first], rays.direction[last]),
        peak[by_time],
        direction[by_time],
        point[by_time],
    )


def _count_missing(step: np.ndarray) -> np.ndarray:
    """Number (N - 1,) of samples that are missing in each step in seconds, by the sampling interval of its recording.
    Recordings are separated by NaN, and by pauses longer than `MAX_PAUSE`."""
    bounds = np.r_[0, np.flatnonzero(~(step <= MAX_PAUSE)) + 1, len(step)]
    intervals = [estimate_interval(step[a:b][step[a:b] <= MAX_PAUSE]) for a, b in zip(bounds[:-1], bounds[1:])]
    return np.rint(step / np.repeat(intervals, np.diff(bounds))) - 1


def _find_runs(mask: np.ndarray) -> np.ndarray:
    """Runs (R, 2) of true steps: their first sample, and their last sample, which follows the last step."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(np.int8)))
    return edges.reshape(-1, 2)


def _fill_interruptions(is_fast: np.ndarray, is_joined: np.ndarray, t: np.ndarray, max_gap: float) -> np.ndarray:
    """Mark slow runs of at most ``max_gap`` seconds between fast steps as fast, such as repeated samples."""
    runs = _find_runs(is_joined & ~is_fast)
    around = np.r_[False, is_fast, False]
    is_short = around[runs[:, 0]] & around[runs[:, 1] + 1] & (t[runs[:, 1]] - t[runs[:, 0]] <= max_gap + 1e-9)
    filled = is_fast.copy()
    filled[expand_runs(runs[is_short], 0)[1]] = True
    return filled


def _select_long(runs: np.ndarray, t: np.ndarray, min_duration: float) -> np.ndarray:
    """Those of ``runs`` that last at least ``min_duration`` seconds."""
    return runs[t[runs[:, 1]] - t[runs[:, 0]] >= min_duration - 1e-9]


def _peak(values: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Maximum (R,) of the finite ``values`` of steps in each of the ``runs``; NaN without any."""
    out = np.full(len(runs), -np.inf)
    run, step = expand_runs(runs, 0)
    np.fmax.at(out, run, values[step])
    return np.where(np.isinf(out), np.nan, out)


def expand_runs(runs: np.ndarray, extra: int) -> tuple[np.ndarray, np.ndarray]:
    """Number of the run, and index, of all steps (``extra`` 0) or samples (1) of ``runs``."""
    count = runs[:, 1] - runs[:, 0] + extra
    run = np.repeat(np.arange(len(runs)), count)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(count) - count, count) + runs[run, 0]


def _classify_slow(
    rays: Rays, v: Velocities, runs: np.ndarray, rules: EventRules
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Codes (R,) of runs of slow steps, and their mean directions and hit points (R, 3)."""
    run, sample = expand_runs(runs, 1)
    rows, count = v.order[sample], len(runs)
    mean = lambda values: _nanmean_by_group(values, run, count)
    d, o = rays.direction[rows], rays.origin[rows]
    direction = mean(d)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    speed, is_steady = _measure_drift(angles_about(d, direction[run]), rays.t[rows], run, runs, rules)
    point = np.full((count, 3), np.nan)
    if rays.hit is not None:
        hit = rays.hit[rows]
        point = mean(hit)
        share = mean(np.isfinite(hit).all(axis=1, keepdims=True).astype(float))[:, 0]
        to_point = point[run] - o
        distance = np.linalg.norm(to_point, axis=1)
        is_near = np.bincount(run, weights=~(distance > _MIN_POINT_DISTANCE), minlength=count) > 0
        has_point = (share >= _MIN_HIT_FRACTION) & ~is_near
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead = np.where(has_point[run, None], to_point / distance[:, None], d)
        of_point, is_steady_about = _measure_drift(angles_about(d, ahead), rays.t[rows], run, runs, rules)
        is_steady &= ~has_point | is_steady_about
        speed = np.where(has_point, np.minimum(speed, of_point), speed)
    codes = np.full(count, _CODES["fixation"])
    _, step = expand_runs(runs, 0)
    step_run = np.repeat(np.arange(count), runs[:, 1] - runs[:, 0])
    with np.errstate(invalid="ignore"):
        codes[_nanmean_by_group(v.head[step, None], step_run, count)[:, 0] > rules.head_velocity] = _CODES[
            "vor_fixation"
        ]
    codes[is_steady & (speed > rules.pursuit_velocity)] = _CODES["smooth_pursuit"]
    return codes, direction, point


def _measure_drift(
    angles: np.ndarray, t: np.ndarray, run: np.ndarray, runs: np.ndarray, rules: EventRules
) -> tuple[np.ndarray, np.ndarray]:
    """Speed (R,) of the linear drift of ``angles`` (n, 2) in degrees per second, and whether it is steady and long
    enough for a pursuit, (R,) bool."""
    count = len(runs)
    total = lambda values: np.bincount(run, weights=values, minlength=count)
    n = np.maximum(total(np.ones(len(run))), 1)
    t = t - (total(t) / n)[run]
    variance = total(t * t)
    slopes = np.stack([total(t * a) / np.where(variance > 0, variance, 1) for a in angles.T], axis=1)
    speed = np.hypot(*slopes.T)
    steps = np.hypot(*np.diff(angles, axis=0).T) * (np.diff(run) == 0) if len(run) else np.zeros(0)
    path = np.bincount(run[1:], weights=steps, minlength=count)
    first = np.cumsum(np.r_[0, np.bincount(run, minlength=count)])
    duration = t[first[1:] - 1] - t[first[:-1]] if count else np.zeros(0)
    net = speed * duration
    return speed, (net >= rules.pursuit_angle) & (net >= _MIN_STRAIGHTNESS * path)
