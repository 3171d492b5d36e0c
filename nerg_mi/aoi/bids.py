"""Export of rays as BIDS datasets, with events of gaze and visits to areas of interest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi import __version__
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_new_folder
from nerg_mi.files.html import Summary
from nerg_mi.files.values import FilePath
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.tracking.bids import BidsEvents, write_bids
from nerg_mi.tracking.dataset import open_rays
from nerg_mi.tracking.event_settings import KINDS, EventRules
from nerg_mi.tracking.events import Events, detect_events, warn_unknown_tracking
from nerg_mi.tracking.measurement import warn_slow_sampling
from nerg_mi.tracking.rays import Rays

from .areas import AnyAreas, Areas
from .measured import AoiContext, Counting, find_area_visits
from .placed import PlacedAreas, open_placed_areas


@dataclass(frozen=True, eq=False, repr=False)
class RaysExport(Summary):
    """The written files of gaze, and the number of events by kind."""

    files: list[Path]
    events: dict[str, int]


def export_rays(
    rays: Rays | FilePath,
    output: FilePath,
    *,
    task: str = "gaze",
    title: str = "Gaze in the world",
    events: bool = True,
    aois: FilePath | AnyAreas | None = None,
    scene: FilePath | None = None,
    align: FilePath | None = None,
    rules: EventRules = EventRules(),
    progress: Progress = None,
) -> RaysExport:
    """Write rays in a format of other programs: a BIDS dataset with gaze, events and visits.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    output : path
        Folder of the BIDS dataset to write; it must not exist or be empty.
    task : str
        Label of the task in the file names: letters and digits.
    title : str
        Name of the dataset.
    events : bool
        Write fixations, saccades and other events of gaze.
    aois : Areas, path or mapping, optional
        JSON file of areas of interest (AOIs), whose visits are among the events. Default: no visits.
    scene : path, optional
        Scene (.xml) whose surfaces rays end on, for the visits. Default: rays end at their hit points.
    align : path, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.
    rules : EventRules
        Limits between the kinds of events (`nerg_mi.tracking.event_settings.EventRules`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    RaysExport
        The written files of gaze, and the number of events by kind.

    Raises
    ------
    NergError
        The folder is not empty, the rays have no times, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> _ = nerg.export_rays(rays, folder / "study", task="shopping")
    >>> len(nerg.import_rays(folder / "study", "bids")) == len(rays)
    True
    """
    if aois is None and (scene is not None or align is not None):
        raise NergError(
            f"{parameter('scene')} and {parameter('align')} are for the visits of AOIs; add {parameter('aois')}, or "
            "leave them out"
        )
    check_new_folder(output)
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading rays")
        data = open_rays(rays)
        warn_unknown_tracking(data.tracking, reporter.warn)
        parts = []
        if events:
            warn_slow_sampling(data, rules, reporter)
            detected = detect_events(data, rules)
            parts.append(_events(detected.first, detected.onset, detected.duration, detected.kind, detected))
        if aois is not None:
            reporter.progress(0.2, "finding visits")
            placed = open_placed_areas(scene, None, Areas.open(aois, "aois"), align)
            parts.append(_find_visits(data, placed, reporter))
        joined = _join(parts) if parts else None
        reporter.progress(0.4, "writing")
        files = write_bids(
            output,
            data,
            task=task,
            name=title,
            events=joined,
            event_columns=_describe(joined),
            event_rules=rules.describe() if events else None,
            provenance={"Name": "nerg_mi", "Version": __version__, "Description": "nerg rays export"},
        )
        kinds, counts = ((), ()) if joined is None else np.unique(joined.kind, return_counts=True)
        result = RaysExport(files, dict(zip(map(str, kinds), map(int, counts))))
        reporter.message(
            f"wrote {output}: {len(data):,} rays in {len(files):,} recordings"
            + "".join(f", {count:,} events of the kind {kind}" for kind, count in result.events.items())
        )
    return result


def _find_visits(rays: Rays, placed: PlacedAreas, reporter: Reporter) -> BidsEvents:
    """Visits of the AOIs, by the default rules of ``nerg stats``."""
    for note in placed.warnings:
        reporter.message(note)
    has_hits = rays.hit is not None and bool(np.isfinite(rays.hit).any())
    context = AoiContext(placed, Counting(), has_hits and not placed.environment.has_surfaces)
    return _join(
        [
            _events(visits.first, visits.start, visits.duration, np.full(len(visits), "visit"), area=name)
            for name, visits in find_area_visits(rays, context).items()
        ]
    )


def _events(
    rows: np.ndarray,
    onset: np.ndarray,
    duration: np.ndarray,
    kind: np.ndarray,
    events: Events | None = None,
    area: str = "",
) -> BidsEvents:
    """Events with the columns of all kinds."""
    unknown = np.full((len(rows), 3), np.nan)
    columns: dict[str, np.ndarray] = {"area": np.full(len(rows), area)}
    for name in ("amplitude", "peak_velocity"):
        columns[name] = unknown[:, 0] if events is None else getattr(events, name)
    point, direction = (unknown, unknown) if events is None else (events.point, events.direction)
    columns |= {f"{axis}_coordinate": point[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"direction_{axis}": direction[:, k] for k, axis in enumerate("xyz")}
    return BidsEvents(rows, onset, duration, kind, columns)


def _join(parts: Sequence[BidsEvents]) -> BidsEvents:
    if not parts:
        raise NergError(
            f"there are no areas of interest in {parameter('aois')}; add one, or leave out {parameter('aois')}"
        )
    join = lambda get: np.concatenate([get(part) for part in parts])
    return BidsEvents(
        join(lambda e: e.row),
        join(lambda e: e.onset),
        join(lambda e: e.duration),
        join(lambda e: e.kind),
        {name: join(lambda e, name=name: e.columns[name]) for name in parts[0].columns},
    )


def _describe(events: BidsEvents | None) -> dict[str, dict[str, Any]]:
    """Descriptions of the columns of events."""
    if events is None:
        return {}
    of_gaze, of_fixations = "; n/a for visits", "; n/a except for fixations and pursuits"
    levels = {**KINDS, "visit": "gaze on an area of interest"}
    present = {str(kind) for kind in np.unique(events.kind)}
    out: dict[str, dict[str, Any]] = {
        "trial_type": {
            "Description": "Kind of event.",
            "Levels": {kind: f"{text[:1].upper()}{text[1:]}." for kind, text in levels.items() if kind in present},
        },
        "area": {"Description": "Name of the area of interest of a visit."},
        "amplitude": {
            "Description": f"Angle between the first and the last direction in the world{of_gaze}.",
            "Units": "deg",
        },
        "peak_velocity": {
            "Description": f"Peak angular velocity of gaze in the world{of_gaze}, and in pauses.",
            "Units": "deg/s",
        },
    }
    for axis in "xyz":
        out[f"{axis}_coordinate"] = {
            "Description": f"Mean point of regard in the world, {axis}{of_fixations}, and without hit points.",
            "Units": "m",
        }
        out[f"direction_{axis}"] = {
            "Description": f"Mean direction of gaze in the world, {axis}{of_fixations}.",
            "Units": "arbitrary",
        }
    return out
