"""Export of rays to formats of other programs: BIDS datasets."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi import __version__
from nerg_mi.aoi.measured import find_area_visits
from nerg_mi.aoi.options import CountOptions
from nerg_mi.aoi.predicted import load_aoi_scene
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_new_folder
from nerg_mi.formats.areas import read_areas
from nerg_mi.measures.visits import Visits
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.bids import BidsEvents, write_bids
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.event_settings import KINDS
from nerg_mi.rays.events import Events, detect_events, warn_unknown_tracking
from nerg_mi.rays.rays import Rays

from .base import select_backend
from .rays_commands import RaysExportOptions
from .rays_events import warn_slow_sampling


@dataclass(frozen=True, eq=False)
class RaysExport:
    """The written files of gaze, and the number of events by kind."""

    files: list[Path]
    events: dict[str, int]


def export_rays(
    rays: Rays | str | os.PathLike,
    output: str | os.PathLike,
    options: RaysExportOptions | None = None,
    reporter: Reporter = SILENT,
) -> RaysExport:
    """Write ``rays`` (or their file or dataset) to the folder ``output`` as a BIDS dataset, with events and visits.

    Raises `NergError` for a folder that is not empty, and for rays without times.
    """
    options = options or RaysExportOptions()
    check_new_folder(output)
    reporter.progress(0.0, "reading rays")
    data = rays if isinstance(rays, Rays) else load_rays(rays)
    warn_unknown_tracking(data.tracking, reporter.warn)
    parts = [_find_events(data, options, reporter)] if options.events else []
    if options.aois is not None:
        reporter.progress(0.2, "finding visits")
        parts.append(_find_visits(data, options, reporter))
    events = _join(parts) if parts else None
    reporter.progress(0.4, "writing")
    provenance: dict[str, Any] = {"Name": "nerg_mi", "Version": __version__, "Description": "nerg rays export"}
    files = write_bids(
        output,
        data,
        task=options.task,
        name=options.title,
        events=events,
        event_columns=_describe(events),
        event_rules=options.event_rules().describe() if options.events else None,
        provenance=provenance,
    )
    kinds, counts = ((), ()) if events is None else np.unique(events.kind, return_counts=True)
    result = RaysExport(files, dict(zip(map(str, kinds), map(int, counts))))
    reporter.message(
        f"wrote {output}: {len(data):,} rays in {len(files):,} recordings"
        + "".join(f", {count:,} events of the kind {kind}" for kind, count in result.events.items())
    )
    return result


# ---- Events ----


def _find_events(rays: Rays, options: RaysExportOptions, reporter: Reporter) -> BidsEvents:
    """Events of gaze, with their mean directions and points of regard."""
    events = detect_events(rays, options.event_rules())
    warn_slow_sampling(rays, options, reporter)
    return _events(events.first, events.onset, events.duration, events.kind, events)


def _find_visits(rays: Rays, options: RaysExportOptions, reporter: Reporter) -> BidsEvents:
    """Visits of the AOIs, by the default rules of ``nerg stats``."""
    assert options.aois is not None
    counting = CountOptions(aois=options.aois, align=options.align, mode=options.mode)
    scene = load_aoi_scene(options.scene, None, None, read_areas(options.aois), counting, select_backend(options.mode))
    for note in scene.warnings:
        reporter.message(note)
    has_hits = rays.hit is not None and bool(np.isfinite(rays.hit).any())
    context = scene.make_context(scene.gaze_scene.geometry is None and has_hits, ())
    return _join([_visit_events(name, visits) for name, visits in find_area_visits(rays, context).items()])


def _visit_events(name: str, visits: Visits) -> BidsEvents:
    return _events(visits.first, visits.start, visits.duration, np.full(len(visits), "visit"), area=name)


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
            f"there are no areas of interest in the file of {parameter('aois')}; add one, or leave out "
            f"{parameter('aois')}"
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
