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
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_new_folder
from nerg_mi.formats.areas import read_areas
from nerg_mi.rays import events as detection
from nerg_mi.rays.bids import BidsEvents, write_bids
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.statistics.visits import Visits

from .base import SILENT, Reporter, select_backend
from .rays_commands import RaysExportOptions


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
    """Write ``rays`` (or their file or dataset) to the folder ``output`` as a BIDS dataset, with fixations and visits.

    Raises `NergError` for a folder that is not empty, and for rays without times.
    """
    options = options or RaysExportOptions()
    check_new_folder(output)
    reporter.progress(0.0, "reading rays")
    data = rays if isinstance(rays, Rays) else load_rays(rays)
    parts = [] if options.fixations == "none" else [_find_fixations(data, options.fixations)]
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
        event_columns=_describe(events, options),
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


def _find_fixations(rays: Rays, detector: str) -> BidsEvents:
    """Fixations, with the mean point of regard and the mean direction."""
    detect = detection.detect_fixations_ivt if detector == "ivt" else detection.detect_fixations_idt
    label = detect(rays)
    if not (label >= 0).any():
        return _events(rays, np.zeros(0, np.int64), np.zeros(0), np.zeros(0), "fixation")
    means, duration = detection.average_fixations(rays, label)
    rows = np.flatnonzero(label >= 0)
    rows = rows[np.lexsort((rays.t[rows], label[rows]))]
    first = rows[np.unique(label[rows], return_index=True)[1]]
    return _events(rays, first, means.t - 0.5 * duration, duration, "fixation", means)


def _find_visits(rays: Rays, options: RaysExportOptions, reporter: Reporter) -> BidsEvents:
    """Visits of the AOIs, by the default rules of ``nerg stats``."""
    assert options.aois is not None
    counting = CountOptions(aois=options.aois, align=options.align, mode=options.mode)
    scene = load_aoi_scene(options.scene, None, None, read_areas(options.aois), counting, select_backend(options.mode))
    for note in scene.warnings:
        reporter.message(note)
    has_hits = rays.hit is not None and bool(np.isfinite(rays.hit).any())
    context = scene.make_context(scene.gaze_scene.geometry is None and has_hits, ())
    return _join([_visit_events(rays, name, visits) for name, visits in find_area_visits(rays, context).items()])


def _visit_events(rays: Rays, name: str, visits: Visits) -> BidsEvents:
    return _events(rays, visits.first, visits.start, visits.duration, "visit", area=name)


def _events(
    rays: Rays,
    rows: np.ndarray,
    onset: np.ndarray,
    duration: np.ndarray,
    kind: str,
    means: Rays | None = None,
    area: str = "",
) -> BidsEvents:
    """Events of one ``kind`` with the columns of all kinds."""
    unknown = np.full((len(rows), 3), np.nan)
    point = unknown if means is None or means.hit is None else means.hit
    direction = unknown if means is None else means.direction
    columns: dict[str, np.ndarray] = {"area": np.full(len(rows), area)}
    columns |= {f"{axis}_coordinate": point[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"direction_{axis}": direction[:, k] for k, axis in enumerate("xyz")}
    return BidsEvents(rows, onset, duration, np.full(len(rows), kind), columns)


def _join(parts: Sequence[BidsEvents]) -> BidsEvents:
    if not parts:
        raise NergError("there are no areas of interest in the file of --aois; add one, or leave out --aois")
    join = lambda get: np.concatenate([get(part) for part in parts])
    return BidsEvents(
        join(lambda e: e.row),
        join(lambda e: e.onset),
        join(lambda e: e.duration),
        join(lambda e: e.kind),
        {name: join(lambda e, name=name: e.columns[name]) for name in parts[0].columns},
    )


def _describe(events: BidsEvents | None, options: RaysExportOptions) -> dict[str, dict[str, Any]]:
    """Descriptions of the columns of events."""
    if events is None:
        return {}
    detectors = {"ivt": "velocity below 100 degrees per second (I-VT)", "idt": "dispersion below 3 degrees (I-DT)"}
    levels = {"visit": "Gaze on an area of interest."}
    if options.fixations != "none":
        levels["fixation"] = f"Gaze in the world rests: {detectors[options.fixations]}."
    out: dict[str, dict[str, Any]] = {
        "trial_type": {"Description": "Kind of event.", "Levels": levels},
        "area": {"Description": "Name of the area of interest of a visit."},
    }
    for axis in "xyz":
        out[f"{axis}_coordinate"] = {"Description": f"Mean point of regard in the world, {axis}.", "Units": "m"}
        out[f"direction_{axis}"] = {
            "Description": f"Mean direction of gaze in the world, {axis}.",
            "Units": "arbitrary",
        }
    return out
