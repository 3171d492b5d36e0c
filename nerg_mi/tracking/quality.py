"""Data-quality report of a set of rays: its figures, the warnings of all checks, and both as lines of text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, clean_text
from nerg_mi.files.html import key_value_table
from nerg_mi.files.safe_read import sanitize
from nerg_mi.files.values import FilePath, to_name
from nerg_mi.progress import Progress, open_reporter

from .checks import RECORDING_CHECKS, RayStatistics
from .dataset import RayDataset, open_recordings
from .direction_checks import DIRECTION_CHECKS
from .event_settings import FIXATIONS, read_fixations
from .events import Events, angles_about, detect_events, expand_runs
from .filters import argsort_by_person_time, estimate_interval, find_sessions
from .rays import TRACKING, Rays

# ---- The list of checks, and the warnings of all of them ----

CHECKS = (*RECORDING_CHECKS, *DIRECTION_CHECKS)  # In the order of the quality report


def find_warnings(stats: RayStatistics) -> list[str]:
    """Run all `CHECKS`: sentences about implausible data, each with the likely mistake and its remedy."""
    return [warning for check in CHECKS for warning in check.run(stats)]


def format_check_table() -> str:
    """Format the checks as a table in Markdown, for the manual."""
    rows = ["| check | detects |", "|---|---|"]
    return "\n".join([*rows, *(f"| {check.name} | {check.description} |" for check in CHECKS)]) + "\n"


# ---- Figures of a set of rays ----

_BLOCK = 1 << 18  # Rays processed at a time, to bound the memory of a summary
MAX_GAP = 1.0  # seconds; a longer interval between samples does not count as recorded time


@dataclass(frozen=True)
class RaysSummary:
    """Figures from :func:`summarise`, in the common frame of rays."""

    rays: int
    persons: int
    duration: float  # recorded seconds of all participants, without gaps longer than `MAX_GAP`
    sampling_rate: float  # Hz, within recordings without gaps; NaN if no participant has two times
    box_low: np.ndarray  # (3,) bounding box of the origins, metres
    box_high: np.ndarray
    eye_height: np.ndarray  # (3,) 5th, 50th and 95th percentile of the origins' heights, metres
    speed_p95: float  # 95th percentile of the origins' speeds, m/s; NaN if unknown
    hit_fraction: float  # of rays with a hit point
    hit_distance: float  # median distance of the hit points, metres; NaN without hit points
    duplicates: int  # rays with the participant and time of another ray
    rows_read: int  # by the import
    dropped: dict[str, int]  # rows by reason
    cohorts: dict[str, int]  # rays by cohort
    warnings: tuple[str, ...]  # of `CHECKS`


def summarise(rays: Rays) -> RaysSummary:
    """Compute the figures and warnings of rays. Raises `NergError` for an empty set."""
    if len(rays) == 0:
        raise NergError("there are no rays to summarise; relax the selection")
    order = argsort_by_person_time(rays)
    step, speed = _measure_steps(rays, order)
    duplicates, has_steps = int(np.count_nonzero(step == 0)), bool(step.size)
    positive = step[step > 0]
    median_step = float(np.median(positive)) if positive.size else float("nan")
    del positive
    is_recorded = (step > 0) & (step <= MAX_GAP)
    if not is_recorded.all():
        step, speed = step[is_recorded], speed[is_recorded]
    speed /= step
    speed_p95 = float(np.percentile(speed, 95, overwrite_input=True)) if speed.size else float("nan")
    del speed
    rate = 1.0 / (estimate_interval(step) if step.size else median_step)

    num_hits, distance = _measure_hits(rays)
    height = np.percentile(rays.origin[:, 2], [5, 50, 95])
    low, high = rays.origin.min(axis=0), rays.origin.max(axis=0)
    stats = RayStatistics(rays, height, high - low, speed_p95, median_step if has_steps else None, order)
    return RaysSummary(
        rays=len(rays),
        persons=int(np.count_nonzero(np.bincount(rays.person))),
        duration=float(step.sum()),
        sampling_rate=rate,
        box_low=low,
        box_high=high,
        eye_height=height,
        speed_p95=speed_p95,
        hit_fraction=num_hits / len(rays),
        hit_distance=distance,
        duplicates=duplicates,
        rows_read=int(rays.metadata.get("rows_read", len(rays))),
        dropped=_count_dropped(rays.metadata),
        cohorts={name: int(np.count_nonzero(rays.cohort == k)) for k, name in enumerate(rays.cohorts)},
        warnings=tuple(find_warnings(stats)),
    )


def _measure_steps(rays: Rays, order: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Intervals and distances between successive rays of each participant, in ``order`` (None: as stored)."""
    step, distance = np.empty((2, max(0, len(rays) - 1)))
    count = 0
    for a in range(0, len(step), _BLOCK):
        rows = slice(a, a + _BLOCK + 1)
        rows = rows if order is None else order[rows]
        same = np.diff(rays.person[rows]) == 0
        block = slice(count, count := count + np.count_nonzero(same))
        step[block] = np.diff(rays.t[rows])[same]
        displacement = np.diff(rays.origin[rows], axis=0)[same]
        distance[block] = np.sqrt(np.einsum("ij,ij->i", displacement, displacement))
    return step[:count], distance[:count]


def _count_dropped(metadata: dict[str, Any]) -> dict[str, int]:
    """Number of rows that the import dropped, by reason."""
    total: dict[str, int] = {}
    for entry in metadata.get("dropped", []):
        total[entry["reason"]] = total.get(entry["reason"], 0) + entry["count"]
    return total


def _measure_hits(rays: Rays) -> tuple[int, float]:
    """Number of hit points, and their median distance (NaN without hit points)."""
    if rays.hit is None:
        return 0, float("nan")
    distance, count = np.empty(len(rays)), 0
    for a in range(0, len(rays), _BLOCK):
        to_hit = rays.hit[a : a + _BLOCK] - rays.origin[a : a + _BLOCK]
        lengths = np.sqrt(np.einsum("ij,ij->i", to_hit, to_hit))
        lengths = lengths[np.isfinite(lengths)]
        distance[count : count + len(lengths)] = lengths
        count += len(lengths)
    return count, float(np.median(distance[:count], overwrite_input=True)) if count else float("nan")


# ---- Quality report as text ----

WARNING_LABEL = "warning"  # Label of the lines about implausible data
_MAX_NAMES = 8  # participants or columns listed
_MAX_RUNS = 3  # runs of dropped lines listed


def make_quality_report(rays: Rays, summary: RaysSummary) -> list[tuple[str, str]]:
    """Labels and texts of the lines of the quality report. Texts contain names from files."""
    s = summary
    format_vector = lambda v: " ".join(f"{x:.2f}" for x in v)
    present = [rays.persons[p] for p in np.flatnonzero(np.bincount(rays.person))]
    lines = [
        ("samples", f"{s.rays:,} of {s.rows_read:,} rows"),
        ("tracking", TRACKING[rays.tracking]),
        (
            "participants",
            f"{s.persons}: {', '.join(present[:_MAX_NAMES])}{', ...' if len(present) > _MAX_NAMES else ''}",
        ),
    ]
    if s.cohorts:
        lines.append(("cohorts", ", ".join(f"{name} {count:,}" for name, count in s.cohorts.items())))
    lines.append(("recorded time", _format_recorded_time(s)))
    for reason, count in s.dropped.items():
        percent = 100 * count / max(s.rows_read, 1)
        lines.append(("dropped", f"{count:,} ({percent:.1f} %): {reason}; {_format_dropped_lines(rays, reason)}"))
    for what, count in rays.metadata.get("missing", {}).items():
        lines.append(("missing", f"{count:,} {what}"))
    if rays.metadata.get("decimal") == ",":
        lines.append(("decimal sign", "comma"))
    if rays.metadata.get("passes_midnight"):
        lines.append(("times", "times of day without a date, which continue past midnight"))
    unused = rays.metadata.get("unused_columns", [])
    if unused:
        suffix = f" and {len(unused) - _MAX_NAMES} more" if len(unused) > _MAX_NAMES else ""
        lines.append(("unused columns", f"{', '.join(unused[:_MAX_NAMES])}{suffix}"))
    for step in rays.metadata.get("steps", []):
        name = f"{step['step']} {step.get('side', '')}".strip()
        (definition,) = read_fixations({"steps": [step]}).values() or ({},)
        text = "".join(f", {key} {value}" for key, value in definition.items())
        lines.append(("step", f"{name}: {step['kept']:,} of {step['of']:,} rays kept{text}"))
    source = rays.metadata.get("source_frame")
    if source:
        lines.append(("source frame", f"{source['up']} up, {source['handedness']}-handed, {source['units']}"))
    low, median, high = s.eye_height
    lines += [
        ("origins", f"{format_vector(s.box_low)} to {format_vector(s.box_high)} m (right-handed, z up)"),
        ("eye height", f"{median:.2f} m (5 to 95 %: {low:.2f} to {high:.2f})"),
        ("speed", f"95 % below {s.speed_p95:.2f} m/s" if np.isfinite(s.speed_p95) else "unknown; see recorded time"),
    ]
    if s.hit_fraction:
        percent = 100 * s.hit_fraction
        lines.append(("hit points", f"in {percent:.1f} % of the samples, median distance {s.hit_distance:.2f} m"))
    if s.duplicates:
        lines.append(("duplicates", f"{s.duplicates:,} samples have the participant and time of another"))
    return lines + [(WARNING_LABEL, warning) for warning in s.warnings]


@dataclass(frozen=True, eq=False, repr=False)
class QualityReport:
    """Data-quality report of rays: figures, and warnings about implausible data.

    Attributes
    ----------
    rays : Rays
        The rays; for a large dataset a sample.
    title : str
        Title of the report.
    summary : RaysSummary
        The figures.
    notes : tuple of (str, str)
        Further lines of the report of a dataset: labels and texts.
    """

    rays: Rays
    title: str
    summary: RaysSummary
    notes: tuple[tuple[str, str], ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about implausible data, each with the likely mistake and its remedy."""
        return tuple(map(clean_text, self.summary.warnings))

    @cached_property
    def lines(self) -> list[tuple[str, str]]:
        """Labels and texts of all lines."""
        return [(label, clean_text(text)) for label, text in make_quality_report(self.rays, self.summary)] + [
            *self.notes
        ]

    def to_text(self) -> str:
        """Return the report as a table, with warnings at the end, for a reporter, which spells the parameters."""
        from rich.console import Console
        from rich.markup import escape
        from rich.table import Table

        # Names from files must not be interpreted as markup or as terminal control characters.
        safe = lambda text: escape(sanitize(text, 10_000))
        table = Table(show_header=False, box=None, title=safe(self.title), title_justify="left")
        lines = [*make_quality_report(self.rays, self.summary), *self.notes]
        for name, text in sorted(lines, key=lambda line: line[0] == WARNING_LABEL):
            table.add_row(f"[bold]{name}[/bold]" if name == WARNING_LABEL else name, safe(text))
        # Without styles, which are control characters: messages contain none.
        console = Console(color_system=None)
        with console.capture() as capture:
            console.print(table)
        return capture.get().removesuffix("\n")

    def __repr__(self) -> str:
        return clean_text(self.to_text())

    def _repr_html_(self) -> str:
        return key_value_table(self.lines)


def check_rays(rays: Rays | FilePath, *, progress: Progress = None) -> QualityReport:
    """Make the data-quality report of recordings: figures, dropped rows, and warnings about implausible data.

    Parameters
    ----------
    rays : Rays or path
        Recordings, their file, or a dataset of one environment.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    QualityReport
        The report, which prints as a table; its ``warnings`` are sentences, its ``summary`` has the figures.

    Raises
    ------
    NergError
        There are no rays, or the dataset has several environments.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> report = nerg.check_rays(rays)
    >>> report.summary.persons, dict(report.lines)["participants"]
    (2, '2: Ada, Bob')
    """
    reports = check_environments(rays, progress=progress)
    if len(reports) > 1:
        titles = ", ".join(report.title for report in reports)
        raise NergError(f'"{rays}" contains {len(reports)} environments ({titles}); check one of them')
    return reports[0]


def check_environments(rays: Rays | FilePath, *, progress: Progress = None) -> list[QualityReport]:
    """Report rays, participants, duration, rate, dropped rows, extent, eye height, and implausible data.

    A dataset gets one report for each environment. For very large data some numbers are estimated from a sample; the
    report says which.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    list of QualityReport
        The reports, as of `check_rays`.

    Raises
    ------
    NergError
        There are no rays.
    """
    title = "rays" if isinstance(rays, Rays) else str(rays)
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, f"reading {Path(title).name}")
        data = open_recordings(rays)
        if isinstance(data, Rays):
            return [QualityReport(data, title, summarise(data))]
        titles = {place: title if len(data.places) == 1 else f"{title}: {place}" for place in data.places}
        return [summarise_dataset(data.select_place(place), shown) for place, shown in titles.items()]


def _format_recorded_time(s: RaysSummary) -> str:
    if not np.isfinite(s.sampling_rate):
        return "unknown: no participant has samples at two times"
    if s.duration == 0:
        return (
            f"none: all intervals between samples of a participant exceed {MAX_GAP:g} s "
            f"(sampling rate {s.sampling_rate:.4g} Hz)"
        )
    return f"{s.duration:,.1f} s, sampling rate {s.sampling_rate:.4g} Hz"


def _format_dropped_lines(rays: Rays, reason: str) -> str:
    """The first lines with this reason; the metadata of the file list all of them."""
    entries = [d for d in rays.metadata.get("dropped", []) if d["reason"] == reason and d.get("rows")]
    if not entries:
        return "lines not listed"
    runs = entries[0]["rows"]
    text = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in runs[:_MAX_RUNS])
    suffix = f" and of {len(entries) - 1} more" if len(entries) > 1 else ""
    return f"lines {text}{', ...' if len(runs) > _MAX_RUNS else ''} of {entries[0].get('file', '')}{suffix}"


# ---- Quality report of a dataset: exact counts from its manifests, and the remaining figures from a sample ----

MAX_SAMPLED_RAYS = 1 << 20  # Maximum number of rays for figures that the manifests do not contain
_SAMPLE_RUNS = 64


def summarise_dataset(dataset: RayDataset, title: str, max_rays: int = MAX_SAMPLED_RAYS) -> QualityReport:
    """Make the report of a dataset of one environment, with its rays or a sample.

    Of more than ``max_rays`` rays, 64 runs of neighbours are sampled. Heights, speed, sampling rate, distances of hit
    points and warnings are those of the sample. All counts, the bounding box and the recorded time are those of the
    whole dataset; participants, cohorts and rows are those of all its sources. Raises `NergError` as
    `RayDataset.sample` does.
    """
    parts = [part for _, part in dataset.parts]
    count = len(dataset)
    rays = dataset.sample(max_rays, runs=_SAMPLE_RUNS)
    sample_summary = summarise(rays)
    dataset_summary = replace(
        sample_summary,
        rays=count,
        persons=len(dataset.persons),
        duration=sum(part.recorded for part in parts),
        box_low=np.min([part.low for part in parts], axis=0),
        box_high=np.max([part.high for part in parts], axis=0),
        hit_fraction=sum(part.hits for part in parts) / count,
        duplicates=sum(part.duplicates for part in parts),
        rows_read=max(count, dataset.metadata["rows_read"]),
        dropped=_count_dropped(dataset.metadata),
        cohorts=dataset.cohorts,
    )
    lines = [("dataset", _format_extent(dataset))]
    if len(rays) < count:
        which = f"{len(rays):,} rays in {_SAMPLE_RUNS} runs"
        lines.append(("subsample", f"eye height, speed, sampling rate, distances and warnings are those of {which}"))
    return QualityReport(rays, title, dataset_summary, tuple(lines))


def _format_extent(dataset: RayDataset) -> str:
    days = dataset.days
    day_range = days[0] if len(days) == 1 else f"{len(days)} from {days[0]} to {days[-1]}"
    format_count = lambda items, what: f"{len(items):,} {what}{'' if len(items) == 1 else 's'}"
    return (
        f"{format_count(dataset.sources, 'source')} in {format_count(dataset.parts, 'part')} "
        f"({dataset.bytes / 1e6:,.1f} MB), place {', '.join(dataset.places)}, day {day_range}"
    )


# ---- Data quality of each recording ----
#
# Accuracy, precision (RMS-S2S, STD), data loss and effective frequency as ETDQualitizer defines them (Niehorster et al.
# 2026), with Fick angles about the target or the mean direction of a fixation, which is straight ahead.


@dataclass(frozen=True)
class GazeTarget:
    """A point that participants looked at from ``start`` to ``end``. Raises `NergError` if it ends before it starts."""

    start: float  # seconds on the clock of the rays
    end: float
    point: tuple[float, float, float]  # metres, in the frame of rays
    participant: str | None = None  # None: all participants

    def __post_init__(self) -> None:
        if not self.end > self.start:
            raise NergError(f"a target must end after it starts, got {self.start:g} to {self.end:g} s")
        if self.participant is not None:
            object.__setattr__(self, "participant", to_name(self.participant))


@dataclass(frozen=True)
class RecordingQuality:
    """Data quality of one recording of a participant."""

    participant: str
    start: float  # seconds on the clock of the rays
    duration: float  # seconds, up to the end of the last sample
    samples: int  # valid ones: the import dropped the others
    frequency: float  # Hz, from the median interval; NaN for fewer than two times
    effective_frequency: float  # Hz: samples by duration
    data_loss: float  # percent of the samples at ``frequency`` that are missing
    fixations: int  # of which the precision is the median
    rms_s2s: float  # degrees: root mean square of the angles between successive samples of a fixation
    std: float  # degrees: standard deviation of the samples of a fixation
    targets: int  # targets with samples
    accuracy: float  # degrees: mean over targets of the angle from the target to the mean gaze; NaN without targets


def measure_recordings(
    rays: Rays, targets: Sequence[GazeTarget] = (), events: Events | None = None
) -> list[RecordingQuality]:
    """Measure the data quality of each recording (`nerg_mi.tracking.filters.find_sessions`).

    Precision is the median over fixations and vestibulo-ocular fixations of ``events`` (default: `detect_events`), and
    includes what the eye and the head move during these. Angles are those of gaze in the world.
    """
    events = detect_events(rays) if events is None else events
    sessions = find_sessions(rays)
    rows_of = [np.arange(len(rays))[sessions.rows(slice(a, b))] for a, b in zip(sessions.starts, sessions.starts[1:])]
    session_of = np.empty(len(rays), np.int64)
    for k, rows in enumerate(rows_of):
        session_of[rows] = k
    is_fixation = np.isin(events.kind, FIXATIONS)
    precision = _measure_precision(rays, events, is_fixation)
    fixation_session = session_of[events.first[is_fixation]]
    out = []
    for k, (rows, person) in enumerate(zip(rows_of, sessions.person.tolist())):
        name = rays.persons[person]
        t = np.sort(rays.t[rows])
        interval = estimate_interval(np.diff(t))
        duration = float(t[-1] - t[0] + interval) if interval > 0 else float("nan")
        of_fixations = precision[fixation_session == k]
        medians = np.median(of_fixations, axis=0) if len(of_fixations) else np.full(2, np.nan)
        offsets = [
            offset
            for target in targets
            if target.participant in (None, name) and (offset := _measure_accuracy(rays, rows, target)) is not None
        ]
        out.append(
            RecordingQuality(
                participant=name,
                start=float(t[0]),
                duration=duration,
                samples=len(rows),
                frequency=1 / interval if interval > 0 else float("nan"),
                effective_frequency=len(rows) / duration,
                data_loss=_compute_data_loss(t, interval, duration),
                fixations=len(of_fixations),
                rms_s2s=float(medians[0]),
                std=float(medians[1]),
                targets=len(offsets),
                accuracy=float(np.mean(offsets)) if offsets else float("nan"),
            )
        )
    return out


def _compute_data_loss(t: np.ndarray, interval: float, duration: float) -> float:
    """Percent of the samples every ``interval`` seconds that the sorted times ``t`` lack, without rounding noise; NaN
    for an unknown ``duration``."""
    if not duration > 0:
        return float("nan")
    loss = 1 - len(t) * interval / duration
    # The interval is the difference of two times, each rounded.
    noise = 4 * np.spacing(np.abs(t[[0, -1]]).max()) / interval
    return 100 * loss if loss > noise else 0.0


def _measure_precision(rays: Rays, events: Events, mask: np.ndarray) -> np.ndarray:
    """RMS-S2S and STD (F, 2) in degrees of the events in ``mask`` (E,), about their mean directions."""
    order = argsort_by_person_time(rays)
    order = np.arange(len(rays)) if order is None else order
    position = np.empty(len(rays), np.int64)
    position[order] = np.arange(len(rays))
    run, sample = expand_runs(np.stack([position[events.first[mask]], position[events.last[mask]]], axis=1), 1)
    angles = angles_about(rays.direction[order[sample]], events.direction[mask][run])
    count = int(mask.sum())
    mean = lambda values, group: np.bincount(group, values, count) / np.bincount(group, minlength=count)
    is_step = np.diff(run) == 0
    steps = np.sum(np.diff(angles, axis=0)[is_step] ** 2, axis=1)
    deviations = angles - np.stack([mean(column, run) for column in angles.T], axis=1)[run]
    return _drop_noise(
        np.sqrt(np.stack([mean(steps, run[1:][is_step]), mean(np.sum(deviations**2, axis=1), run)], axis=1))
    )


def _measure_accuracy(rays: Rays, rows: np.ndarray, target: GazeTarget) -> float | None:
    """Angle in degrees from the target to the mean gaze, each as seen from the eye; None without samples."""
    rows = rows[(rays.t[rows] >= target.start) & (rays.t[rows] <= target.end)]
    to_target = np.asarray(target.point) - rays.origin[rows]
    distance = np.linalg.norm(to_target, axis=1, keepdims=True)
    if not len(rows) or not (distance > 0).all():
        return None
    azimuth, elevation = np.radians(angles_about(rays.direction[rows], to_target / distance)).T
    right, up, ahead = (
        v.mean() for v in (np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth))
    )
    return float(_drop_noise(np.degrees(np.arctan2(np.hypot(right, up), ahead))))


def _drop_noise(degrees: np.ndarray) -> np.ndarray:
    """Angles with 0 in place of those that the rounding of unit vectors explains."""
    return np.where(np.abs(degrees) < 1e-12, 0.0, degrees)
