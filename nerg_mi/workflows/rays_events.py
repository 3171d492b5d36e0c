"""Events of gaze and data quality of recordings, as tables."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.tables import add_notes, unescape_formula, write_csv
from nerg_mi.files.values import find_names
from nerg_mi.options import EventOptions
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.event_settings import FIXATIONS
from nerg_mi.rays.events import Events, detect_events, warn_unknown_tracking
from nerg_mi.rays.filters import estimate_interval
from nerg_mi.rays.quality import GazeTarget, RecordingQuality, measure_recordings
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.columns import open_named_table

from .rays_commands import RaysEventsOptions


@dataclass(frozen=True, eq=False)
class EventsResult:
    """Events, and the data quality of each recording."""

    events: Events
    quality: list[RecordingQuality]


def measure_events(
    rays: Rays | str | os.PathLike, options: RaysEventsOptions | None = None, reporter: Reporter = SILENT
) -> EventsResult:
    """Detect the events of ``rays`` (or of their file or dataset), and measure the data quality of each recording.

    Raises `NergError` for targets that are not a table of points and times.
    """
    options = options or RaysEventsOptions()
    if options.quality is not None:
        check_writable(options.quality, ".csv")
    reporter.progress(0.0, "reading rays")
    data = rays if isinstance(rays, Rays) else load_rays(rays)
    targets = [] if options.targets is None else read_targets(options.targets, data.persons)
    reporter.progress(0.2, "detecting events")
    warn_unknown_tracking(data.tracking, reporter.warn)
    warn_slow_sampling(data, options, reporter)
    events = detect_events(data, options.event_rules())
    result = EventsResult(events, measure_recordings(data, targets, events))
    for kind, count in events.count().items():
        mask = events.kind == kind
        reporter.message(f"{count:,} {kind}: {events.duration[mask].sum():,.1f} s, median {_median(events, mask)}")
    reporter.message(_format_quality(result.quality))
    if options.quality is not None:
        definition = options.event_rules().describe()
        rows = [asdict(recording) | definition for recording in result.quality]
        add_notes(rows, lambda row, column: (column, _NO_QUALITY.get(column, "fewer than two times")))
        write_csv(options.quality, rows)
        reporter.message(f"wrote {options.quality}")
    return result


def write_events(rays: Path, output: Path, options: RaysEventsOptions, reporter: Reporter) -> None:
    """Call `measure_events` and write the events to a table."""
    check_writable(output, ".csv")
    data = load_rays(rays)
    result = measure_events(data, options, reporter)
    definition = options.event_rules().describe()
    write_csv(output, _iterate_rows(data, result.events, definition), [*_COLUMNS, *definition, "note"])
    reporter.message(f"wrote {output}")


_VECTORS = ("direction", "point")
_COLUMNS = ["participant", "onset", "duration", "kind", "amplitude", "peak_velocity"]
_COLUMNS += [f"{name}_{axis}" for name in _VECTORS for axis in "xyz"]


_NO_QUALITY = {"rms_s2s": "no fixations", "std": "no fixations", "accuracy": "no targets with samples"}


def _explain_missing(row: Mapping[str, Any], column: str) -> tuple[str, str]:
    """Return the name of a missing value of an event, and why it is missing."""
    if column == "peak_velocity":
        return column, "there are no samples in a pause"
    name = column.removesuffix("_x").removesuffix("_y").removesuffix("_z")
    if row["kind"] in (*FIXATIONS, "smooth_pursuit"):
        return name, "no hit points"
    return name, "of fixations and pursuits only"


def _iterate_rows(rays: Rays, events: Events, definition: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Rows of the table: seconds, degrees, metres in the frame of rays, and the definition of events."""
    values = np.column_stack(
        [events.onset, events.duration, events.amplitude, events.peak_velocity, events.direction, events.point]
    )
    names = [name for name in _COLUMNS if name not in ("participant", "kind")]
    persons = rays.person[events.first].tolist()
    for person, kind, row in zip(persons, events.kind.tolist(), values.tolist()):
        event = {"participant": rays.persons[person], "kind": kind, **dict(zip(names, row)), **definition}
        add_notes([event], _explain_missing)
        yield event


def read_targets(path: Path, participants: Sequence[str]) -> list[GazeTarget]:
    """Read targets from the columns start, end, x, y, z and optionally person (or participant) of a CSV file.

    Raises `NergError` for a table without these columns, for missing numbers, and for an unknown participant.
    """
    targets = []
    for block in open_named_table(path, ("start", "end", "x", "y", "z"), ["person"], optional=["person"])[1]:
        for row, words, line in zip(block.numbers.tolist(), block.texts.tolist(), block.lines.tolist()):
            name = unescape_formula(words[0]) if words and words[0] else None
            if not np.isfinite(row).all():
                raise NergError(f"{path}, line {line}: a target needs start, end, x, y and z; complete or remove it")
            try:
                name = None if name is None else participants[find_names([name], participants, "person")[0]]
                targets.append(GazeTarget(row[0], row[1], (row[2], row[3], row[4]), name))
            except NergError as error:
                raise NergError(f"{path}, line {line}: {error}; correct it") from error
    if not targets:
        raise NergError(f"{path} has no targets; add rows, or leave out {parameter('targets')}")
    return targets


def warn_slow_sampling(rays: Rays, options: EventOptions, reporter: Reporter) -> None:
    """Warn of rays whose intervals are mostly pauses by the options."""
    steps = np.diff(rays.t)[np.diff(rays.person) == 0]
    interval = estimate_interval(steps)
    longest = options.event_rules().max_step
    if interval > longest * (1 - 1e-6):
        reporter.warn(
            f"samples are {interval:.3g} s apart, and intervals above {longest:g} s are pauses: raise "
            f"{parameter('max_step')}; saccades, which last 0.02 to 0.1 s, are not resolved"
        )


def _median(events: Events, mask: np.ndarray) -> str:
    return f"{np.median(events.duration[mask]):.3f} s, {np.median(events.amplitude[mask]):.1f} degrees"


def _format_quality(quality: Sequence[RecordingQuality]) -> str:
    """Medians over recordings, in one line."""

    def median(name: str) -> str:
        values = np.array([getattr(recording, name) for recording in quality], float)
        values = values[np.isfinite(values)]
        return f"{np.median(values):.3g}" if len(values) else "unknown"

    accuracy = "" if not any(q.targets for q in quality) else f", accuracy {median('accuracy')} degrees"
    return (
        f"median of {len(quality):,} recordings: data loss {median('data_loss')} %, "
        f"{median('effective_frequency')} of {median('frequency')} Hz, RMS-S2S {median('rms_s2s')} and STD "
        f"{median('std')} degrees{accuracy}"
    )
