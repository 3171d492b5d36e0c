"""Events of gaze and data quality of recordings, as tables."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.dataframes import make_dataframe
from nerg_mi.files.html import Summary
from nerg_mi.files.tables import add_notes, unescape_formula, write_csv
from nerg_mi.files.values import FilePath, find_names, to_path
from nerg_mi.progress import Progress, Reporter, open_reporter

from .dataset import open_rays
from .event_settings import FIXATIONS, EventRules
from .events import Events, describe_slow_sampling, detect_events, warn_unknown_tracking
from .quality import GazeTarget, RecordingQuality, measure_recordings
from .rays import Rays
from .readers.columns import open_named_table

_VECTORS = ("direction", "point")
_COLUMNS = ["participant", "onset", "duration", "kind", "amplitude", "peak_velocity"]
_COLUMNS += [f"{name}_{axis}" for name in _VECTORS for axis in "xyz"]
_NO_QUALITY = {"rms_s2s": "no fixations", "std": "no fixations", "accuracy": "no targets with samples"}


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredEvents(Summary):
    """Events of gaze, and the data quality of each recording.

    Attributes
    ----------
    events : Events
        The events.
    participants : list of str
        Participant of each event.
    quality : list of RecordingQuality
        Data quality of each recording.
    rules : EventRules
        Limits between the kinds of events.
    """

    events: Events
    participants: list[str]
    quality: list[RecordingQuality]
    rules: EventRules

    def to_dataframe(self, library: str | None = None) -> Any:
        """Return a data frame with one event per row: seconds, degrees, and metres in the frame of rays."""
        columns: dict[str, Any] = {name: getattr(self.events, name, None) for name in _COLUMNS[:6]}
        columns["participant"] = np.array(self.participants, object)
        for name in _VECTORS:
            columns |= {f"{name}_{axis}": getattr(self.events, name)[:, k] for k, axis in enumerate("xyz")}
        return make_dataframe(columns, library)

    def quality_to_dataframe(self, library: str | None = None) -> Any:
        """Return a data frame with the data quality of one recording per row."""
        names = [f.name for f in fields(RecordingQuality)]
        return make_dataframe({name: [getattr(row, name) for row in self.quality] for name in names}, library)

    def save(self, path: FilePath, quality: FilePath | None = None) -> None:
        """Write the events to a table ``path`` (.csv), and the data quality of each recording to ``quality`` (.csv).

        Both state the definition of events, and why a value is missing.
        """
        for output in (path, *([] if quality is None else [quality])):
            check_writable(output, ".csv")
        definition = self.rules.describe()
        write_csv(to_path(path), self._iterate_rows(definition), [*_COLUMNS, *definition, "note"])
        if quality is not None:
            rows = [asdict(recording) | definition for recording in self.quality]
            add_notes(rows, lambda row, column: (column, _NO_QUALITY.get(column, "fewer than two times")))
            write_csv(to_path(quality), rows)

    def _iterate_rows(self, definition: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        events = self.events
        values = np.column_stack(
            [events.onset, events.duration, events.amplitude, events.peak_velocity, events.direction, events.point]
        )
        names = [name for name in _COLUMNS if name not in ("participant", "kind")]
        for participant, kind, row in zip(self.participants, events.kind.tolist(), values.tolist()):
            event = {"participant": participant, "kind": kind, **dict(zip(names, row)), **definition}
            add_notes([event], _explain_missing)
            yield event


def _explain_missing(row: Mapping[str, Any], column: str) -> tuple[str, str]:
    """Return the name of a missing value of an event, and why it is missing."""
    if column == "peak_velocity":
        return column, "there are no samples in a pause"
    name = column.removesuffix("_x").removesuffix("_y").removesuffix("_z")
    if row["kind"] in (*FIXATIONS, "smooth_pursuit"):
        return name, "no hit points"
    return name, "of fixations and pursuits only"


def measure_events(
    rays: Rays | FilePath,
    *,
    targets: Sequence[GazeTarget] | FilePath | None = None,
    rules: EventRules = EventRules(),
    progress: Progress = None,
) -> MeasuredEvents:
    """Detect fixations, saccades, pursuits and pauses, and measure data quality, per recording.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    targets : sequence of GazeTarget or path, optional
        CSV file of points that participants looked at, for the accuracy: columns start,end (seconds), x,y,z (metres, in
        the frame of the rays) and optionally person. Default: no accuracy.
    rules : EventRules
        Limits between the kinds of events (`nerg_mi.tracking.event_settings.EventRules`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    MeasuredEvents
        The events and the data quality, with methods ``to_dataframe`` and ``save`` (.csv).

    Raises
    ------
    NergError
        The targets are not a table of points and times, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> result = nerg.measure_events(rays)
    >>> [recording.participant for recording in result.quality]
    ['Ada', 'Bob']
    """
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading rays")
        data = open_rays(rays)
        points = read_targets(targets, data.persons) if isinstance(targets, (str, os.PathLike)) else targets or ()
        reporter.progress(0.2, "detecting events")
        warn_unknown_tracking(data.tracking, reporter.warn)
        warn_slow_sampling(data, rules, reporter)
        events = detect_events(data, rules)
        participants = [data.persons[person] for person in data.person[events.first].tolist()]
        result = MeasuredEvents(events, participants, measure_recordings(data, points, events), rules)
        for kind, count in events.count().items():
            mask = events.kind == kind
            reporter.message(
                f"{count:,} {kind}: {events.duration[mask].sum():,.1f} s, median "
                f"{np.median(events.duration[mask]):.3f} s, {np.median(events.amplitude[mask]):.1f} degrees"
            )
        reporter.message(_format_quality(result.quality))
    return result


def read_targets(file: FilePath, participants: Sequence[str]) -> list[GazeTarget]:
    """Read targets from the columns start, end, x, y, z and optionally person (or participant) of a CSV file.

    Raises `NergError` for a table without these columns, for missing numbers, and for an unknown participant.
    """
    path, targets = to_path(file), []
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


def warn_slow_sampling(rays: Rays, rules: EventRules, reporter: Reporter) -> None:
    """Warn of rays whose samples are too far apart for fixations by the rules."""
    if slow := describe_slow_sampling(rays, rules):
        reporter.warn(
            f"{slow}: raise {parameter('max_step')}; saccades, which last 0.02 to 0.1 s, and blinks are not resolved"
        )


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
