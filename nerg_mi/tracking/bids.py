"""Writing of rays as a BIDS dataset: gaze in the world as eye tracking (BIDS 1.11), with events.

Rays are in the frame of an environment. Of the coordinate systems of BIDS, gaze-on-screen and eye-in-head do not apply,
and gaze-in-world is about to be defined as gaze in the picture of a scene camera (bids-specification issue 2474). So
``SampleCoordinateSystem`` is ``custom``, for which BIDS requires a description by further metadata: these are
``SampleCoordinateSystemDescription`` in words, and ``WorldCoordinateSystem`` with the axes. The columns and this key
are a proposal of this package. Earlier versions wrote the same columns as gaze-in-world, and
:mod:`nerg_mi.tracking.readers.bids` reads both.
"""

from __future__ import annotations

import gzip
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.atomic import create_folder_atomically, write_bytes, write_text
from nerg_mi.files.tables import write_json

from .event_settings import read_fixations
from .filters import estimate_interval, find_sessions
from .rays import TRACKING, Rays
from .readers.bids import (
    CONFIDENCE,
    CUSTOM,
    DESCRIPTION,
    DIRECTION,
    GROUP,
    HEAD,
    ORIGIN,
    POINT,
    SOURCE_NAME,
    TIME,
    TRACKING_KEY,
    WORLD,
)

VERSION = "1.11.1"
_BLOCK = 1 << 16  # rows formatted at a time
# Formats: times exactly (a float64 has 17 digits), lengths to a tenth of a micrometre, directions to 1e-8.
_EXACT, _LENGTH, _UNIT = "%r", "%.7f", "%.8f"
_EYES = {"left": "left", "right": "right"}


@dataclass(frozen=True, eq=False)
class BidsEvents:
    """E events of gaze, in any order: fixations, visits and so on."""

    row: np.ndarray  # (E,) index of the ray with which the event begins
    onset: np.ndarray  # (E,) seconds on the clock of the rays
    duration: np.ndarray  # (E,) seconds
    kind: np.ndarray  # (E,) names, as "fixation" or "visit"
    columns: Mapping[str, np.ndarray]  # further columns (E,): numbers (NaN: n/a) or names ("": n/a)


def write_bids(
    folder: str | os.PathLike,
    rays: Rays,
    *,
    task: str = "gaze",
    name: str = "Gaze in the world",
    events: BidsEvents | None = None,
    event_columns: Mapping[str, Mapping[str, Any]] | None = None,
    event_rules: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write ``rays`` as the BIDS dataset ``folder``, which must not exist or be empty; returns the files of gaze.

    Each recording of a participant (`nerg_mi.tracking.filters.find_sessions`) and of a cohort is a run. The order of
    the rays of a participant and all their columns are kept.

    Parameters
    ----------
    task, name
        Label of the task, and name of the dataset.
    events
        Events, written next to the gaze (``*_physioevents.tsv.gz``).
    event_columns
        Descriptions of the events' kinds (``trial_type``) and further columns, as BIDS objects.
    event_rules
        How the events were detected, with all parameters.
    provenance
        Entry of ``GeneratedBy``.

    Raises
    ------
    NergError
        For a label with other characters than letters and digits, for rays without two times of a participant, and for
        a folder that is not empty, and for directions of heads.
    """
    if not re.fullmatch("[0-9a-zA-Z]+", task):
        raise NergError(
            f'the label of a task is made of letters and digits, not "{sanitize(task, 40)}"; change {parameter("task")}'
        )
    if rays.tracking in ("head", "mixed"):
        raise NergError(
            f"BIDS describes eye tracking, but these rays are {TRACKING[rays.tracking]}; export those of eyes; "
            "heads are written as .parquet (Rays.save) or as a data frame (to_dataframe)"
        )
    events = events if events is not None and len(events.row) else None  # BIDS has no metadata of missing files
    runs = _split_runs(rays)
    rate = _find_rate(rays, [rows for rows, *_ in runs])
    labels = _make_labels(rays.persons)
    columns = _list_columns(rays)
    with create_folder_atomically(folder) as root:
        files = []
        generated = {} if provenance is None else {"GeneratedBy": [dict(provenance)]}
        write_json(root / DESCRIPTION, {"Name": name, "BIDSVersion": VERSION, "DatasetType": "raw", **generated})
        write_text(root / "README", _README)
        _write_participants(root, rays, labels)
        write_json(root / f"task-{task}_physio.json", _describe_gaze(rays, task, columns))
        if events is not None:
            write_json(
                root / f"task-{task}_physioevents.json",
                _describe_events(events, event_columns or {}, event_rules, task),
            )
        run_of_row = np.empty(len(rays), np.int64)
        for k, (rows, *_) in enumerate(runs):
            run_of_row[rows] = k
        for k, (rows, person, number) in enumerate(runs):
            stem = f"sub-{labels[person]}_task-{task}{f'_run-{number}' if number else ''}_recording-eye1"
            place = root / f"sub-{labels[person]}" / "beh"
            path = place / f"{stem}_physio.tsv.gz"
            _write_table(path, _stack(rays, rows, columns), [fmt for _, fmt in columns.values()])
            sidecar = {"SamplingFrequency": _measure_rate(rays.t[rows]) or rate, "StartTime": 0}
            if rays.cohort is not None:
                sidecar["Cohort"] = rays.cohorts[rays.cohort[rows[0]]]
            write_json(place / f"{stem}_physio.json", sidecar)
            if events is not None:
                _write_events(place / f"{stem}_physioevents.tsv.gz", events, run_of_row[events.row] == k)
            files.append(path.relative_to(root))
    return [Path(folder) / path for path in files]


# ---- Division into files ----


def _split_runs(rays: Rays) -> list[tuple[np.ndarray, int, int]]:
    """Rows of each recording, its participant, and its number from 1 (0: the only one of the participant)."""
    if not len(rays):
        raise NergError("there are no rays to export; relax the selection")
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    cuts = sessions.starts[1:-1]
    if rays.cohort is not None:
        cuts = np.union1d(cuts, np.flatnonzero(np.diff(rays.cohort[order])) + 1)
    parts = np.split(order, cuts)
    persons = [int(rays.person[rows[0]]) for rows in parts]
    counts, runs = dict.fromkeys(persons, 0), []
    for rows, person in zip(parts, persons):
        counts[person] += 1
        runs.append((rows, person, counts[person] if persons.count(person) > 1 else 0))
    return runs


def _measure_rate(t: np.ndarray) -> float | None:
    """Samples per second; None if no time increases."""
    interval = estimate_interval(np.diff(t))
    return float(f"{1 / interval:.6g}") if interval > 0 else None


def _find_rate(rays: Rays, runs: Sequence[np.ndarray]) -> float:
    rates = [rate for rows in runs if (rate := _measure_rate(rays.t[rows])) is not None]
    if not rates:
        raise NergError("no participant has rays at two times, but BIDS needs a sampling frequency; set the times")
    return float(np.median(rates))


def _make_labels(names: Sequence[str]) -> list[str]:
    """Different labels of participants: their letters and digits, numbered where these are equal or missing."""
    taken: set[str] = set()
    labels = []
    for name in names:
        base = re.sub("[^0-9a-zA-Z]", "", name.removeprefix("sub-")) or "participant"
        label, k = base, 1
        while label.lower() in taken:  # file systems may ignore case
            k += 1
            label = f"{base}x{k}"
        taken.add(label.lower())
        labels.append(label)
    return labels


# ---- Tables ----


def _list_columns(rays: Rays) -> dict[str, tuple[Any, str]]:
    """Columns of the gaze tables in their order: the array (N,) and the format of each."""
    n = len(rays)
    point = np.full((n, 3), np.nan) if rays.hit is None else rays.hit
    columns: dict[str, tuple[Any, str]] = {TIME: (rays.t, _EXACT)}
    groups = [(POINT, point, _LENGTH), (ORIGIN, rays.origin, _LENGTH), (DIRECTION, rays.direction, _UNIT)]
    groups += [] if rays.head is None else [(HEAD, rays.head, _UNIT)]
    for names, values, fmt in groups:
        columns.update({name: (values[:, k], fmt) for k, name in enumerate(names)})
    return columns | {CONFIDENCE: (rays.confidence, "%.9g")}


def _stack(rays: Rays, rows: np.ndarray, columns: Mapping[str, tuple[Any, str]]) -> Iterable[list[list[float]]]:
    """Rows of a table block by block."""
    for a in range(0, len(rows), _BLOCK):
        block = rows[a : a + _BLOCK]
        yield np.stack([np.asarray(values[block], np.float64) for values, _ in columns.values()], axis=1).tolist()


def _write_table(path: Path, blocks: Iterable[Sequence[Sequence[Any]]], formats: Sequence[str]) -> None:
    """Write a table without a header, compressed, in which NaN becomes n/a."""
    fmt = "\t".join(formats) + "\n"
    parts = []
    for rows in blocks:
        text = "".join([fmt % tuple(row) for row in rows])
        # The same bytes for the same rays: no time in the header of gzip.
        parts.append(gzip.compress(text.replace("nan", "n/a").encode(), 6, mtime=0))
    write_bytes(path, *parts)


def _write_events(path: Path, events: BidsEvents, mask: np.ndarray) -> None:
    rows = np.flatnonzero(mask)
    rows = rows[np.lexsort((events.row[rows], events.onset[rows]))]
    if not len(rows):
        return
    columns = [events.onset, events.duration, events.kind, *events.columns.values()]
    formats = [_EXACT, "%.6f", *("%s" if c.dtype.kind == "U" else "%.6f" for c in columns[2:])]
    clean = lambda c: [sanitize(v, 200) or "n/a" for v in c[rows].tolist()] if c.dtype.kind == "U" else c[rows].tolist()
    _write_table(path, [list(zip(*map(clean, columns)))], formats)


def _write_participants(root: Path, rays: Rays, labels: Sequence[str]) -> None:
    present = np.flatnonzero(np.bincount(rays.person, minlength=len(labels))).tolist()
    header, rows = ["participant_id", SOURCE_NAME], [[f"sub-{labels[p]}", rays.persons[p]] for p in present]
    description: dict[str, Any] = {
        SOURCE_NAME: {"Description": "Name or pseudonym of the participant in the exported gaze samples."}
    }
    if rays.cohort is not None:
        groups = [sorted({rays.cohorts[c] for c in np.unique(rays.cohort[rays.person == p])}) for p in present]
        header.append(GROUP)
        rows = [[*row, "; ".join(names)] for row, names in zip(rows, groups)]
        description[GROUP] = {"Description": "Cohorts of the participant; that of a recording is its key Cohort."}
    cell = lambda text: re.sub(r"\s", " ", text).strip() or "n/a"
    lines = ["\t".join(map(cell, row)) for row in (header, *rows)]
    write_text(root / "participants.tsv", "\n".join(lines) + "\n")
    write_json(root / "participants.json", description)


# ---- Descriptions ----

_README = """Gaze in the world
=================

Gaze samples as rays in one frame of the environment: for each sample the position of the eye (origin), the unit
direction of gaze, and the point of regard (x, y, z_coordinate) where it is known.

BIDS 1.11 has no coordinate system for such rays, so that it is "custom". The columns origin_*, direction_*, head_* and
confidence, z_coordinate, and the key WorldCoordinateSystem of the JSON files are a proposal, written by nerg_mi and
described in its manual.
"""

_SYSTEM = (
    "Frame of the environment (room), which does not move with the head, the eyes or a scene camera; its axes are in "
    "WorldCoordinateSystem. A sample is a ray from the eye at origin_x, origin_y, origin_z along the unit vector "
    "direction_x, direction_y, direction_z; x_coordinate, y_coordinate, z_coordinate are the point in {units} where it "
    "meets a surface. They are not pixels of a screen or of a picture."
)


def _describe_gaze(rays: Rays, task: str, columns: Iterable[str]) -> dict[str, Any]:
    """Metadata that all recordings share."""
    frame = rays.metadata["frame"]
    world: dict[str, Any] = {
        "UpAxis": frame["up"],
        "Handedness": frame["handedness"],
        "FloorHeight": "n/a" if rays.metadata.get("floor") == "unknown" else 0,
        "Description": "Frame of all positions and directions. FloorHeight is the height of the floor on the up axis, "
        "and EnvironmentFromWorld a 4x4 matrix from this frame to that of a model of the environment.",
    }
    if "place_from_rays" in rays.metadata:
        world["EnvironmentFromWorld"] = rays.metadata["place_from_rays"]
    describe = lambda text, axis, units: {"Description": f"{text}, {axis} component.", "Units": units}
    of_groups = {
        POINT: ("Point of regard in the world: where the gaze meets a surface", frame["units"]),
        ORIGIN: ("Position of the eye, or of the point between the eyes, in the world", frame["units"]),
        DIRECTION: ("Unit vector of the gaze in the world", "arbitrary"),
        HEAD: ("Unit vector of the head's forward axis in the world", "arbitrary"),
    }
    described = {
        name: describe(text, axis, units)
        for names, (text, units) in of_groups.items()
        for axis, name in zip("xyz", names)
    }
    described[TIME] = {"Description": "Time on the clock of the recording.", "Units": "s"}
    described[CONFIDENCE] = {"Description": "Confidence of the sample, from 0 to 1.", "Units": "arbitrary"}
    return {
        "TaskName": task,
        "PhysioType": "eyetrack",
        "RecordedEye": _EYES.get(str(rays.metadata.get("eye")), "cyclopean"),
        TRACKING_KEY: rays.tracking,
        **{name.capitalize(): definition for name, definition in read_fixations(rays.metadata).items()},
        "SampleCoordinateSystem": CUSTOM,
        "SampleCoordinateSystemDescription": _SYSTEM.format(units=frame["units"]),
        WORLD: world,
        "Columns": list(columns),
        **{name: described[name] for name in columns},
    }


def _describe_events(
    events: BidsEvents, descriptions: Mapping[str, Mapping[str, Any]], rules: Mapping[str, Any] | None, task: str
) -> dict[str, Any]:
    names = ["onset", "duration", "trial_type", *events.columns]
    return {
        "TaskName": task,
        "Description": "Events detected in the gaze samples.",
        **({} if rules is None else {"Detection": dict(rules)}),
        "OnsetSource": TIME,
        "Columns": names,
        "onset": {"Description": "Time of the first sample of the event.", "Units": "s"},
        "duration": {"Description": "Duration of the event.", "Units": "s"},
        **{name: dict(descriptions[name]) for name in names if name in descriptions},
    }
