"""From tracking files to rays: column maps, and presets for known recordings.

A preset knows a recording's columns, frame and validity marks. Each is a
function of files; :data:`PRESETS` names them for the command line.
"""
from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Sequence

import numpy as np

from ..formats.ray_tables import ColumnMap, iterate_table
from .collecting import RaysBuilder
from .frames import to_rays_frame
from .rays import Rays
from .skeleton import rays_from_skeleton

Paths = Sequence[str | os.PathLike]


def person_from_filename(path: str | os.PathLike) -> str:
    """The file's name without its endings (``anna.csv.gz`` is ``anna``)."""
    return Path(path).name.split(".")[0]


def rays_from_table(
    paths: Paths,
    columns: ColumnMap | str,
    *,
    up: str = "z",
    handedness: str = "right",
    units: str = "m",
    person_from: str = "column",
    min_confidence: float = 0.0,
    tick: float = 1.0,
) -> Rays:
    """Rays of CSV or Parquet tables through a column map.

    ``up``, ``handedness`` and ``units`` declare the tables' frame; rays come out
    right-handed, z up, in metres, and the transform is recorded. Directions need
    not be unit. ``person_from``: ``column`` (the map's ``person``) or
    ``filename``. Rows with a confidence below ``min_confidence`` are dropped.
    ``tick``: seconds in one unit of the time column; without one, in one row.
    Raises ``ValueError`` for missing columns, cells that are no numbers, or when
    no ray is left.
    """
    columns = ColumnMap.parse(columns) if isinstance(columns, str) else columns
    if person_from not in ("column", "filename"):
        raise ValueError(f'person_from is "{person_from}"; it is "column" or "filename"')
    by_file = person_from == "filename" or columns.person is None
    scalars = [c for c in (columns.t, columns.confidence) if c]
    numbers = [*columns.origin, *columns.direction, *(columns.hit or ()), *scalars]
    texts = [] if by_file else [columns.person]

    builder = RaysBuilder(
        transform=to_rays_frame(up=up, handedness=handedness, units=units),
        columns=str(columns), source_frame={"up": up, "handedness": handedness, "units": units},
        tick=tick, min_confidence=min_confidence,
    )  # fmt: skip
    for path in map(Path, paths):
        builder.source(path)
        rows = 0
        for block in iterate_table(path, numbers, texts):
            value = dict(zip(numbers, block.numbers.T))
            vector = lambda names: np.stack([value[c] for c in names], axis=1)
            n = len(block.lines)
            t = value[columns.t] if columns.t else np.arange(rows, rows + n, dtype=np.float64)
            rows += n
            confidence = value[columns.confidence] if columns.confidence else np.ones(n)
            builder.add(
                t * tick,
                person_from_filename(path) if by_file else block.texts[:, 0],
                vector(columns.origin),
                vector(columns.direction),
                rows=block.lines,
                confidence=confidence,
                hit=vector(columns.hit) if columns.hit else None,
                drop={f"confidence below {min_confidence:g}": confidence < min_confidence},
            )
    return builder.build()


def vr_supermarket(paths: Paths, *, min_openness: float = 0.5) -> Rays:
    """Eye gaze of people in a VR supermarket, one gzip CSV a person, 50 Hz.

    Recorded with "Fixation-based Self-calibration for Eye Tracking in VR
    Headsets" (github: ryuryu0226). ``ctw_ij`` is camera-to-world in Unity's
    world (y up, left-handed, metres), whose camera looks along minus column 2;
    ``ray`` and ``eye`` are in the camera frame with +z forward, so with R, t of
    that matrix: direction = R (rx, ry, -rz), origin = t + R (ex, ey, -ez).
    ``xc, yc, zc`` is where the combined gaze met the shop.

    A row is kept when both eyes are open by more than ``min_openness``; the
    smaller openness becomes the confidence. A missing hit is NaN. The person is
    ``userN`` of the file name. Rays come out mirrored to (x, z, y): right-handed
    with z up.
    """
    matrix = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
    names = [*matrix, "ray_x", "ray_y", "ray_z", "eye_x", "eye_y", "eye_z", "xc", "yc", "zc", "opennessl", "opennessr", "time"]
    frame = {"up": "y", "handedness": "left", "units": "m"}
    builder = RaysBuilder(
        transform=to_rays_frame(**frame), preset="vr_supermarket", source_frame=frame, min_openness=min_openness
    )
    for path in map(Path, paths):
        builder.source(path)
        user = re.search(r"user\d+", path.name)
        for values, _, lines in iterate_table(path, names):
            pose = values[:, :12].reshape(-1, 3, 4)
            flip = np.array([1.0, 1.0, -1.0])  # +z forward to the camera of the matrix
            rotate = lambda v: np.einsum("nij,nj->ni", pose[:, :, :3], v * flip)
            openness = np.minimum(values[:, 21], values[:, 22])
            builder.add(
                values[:, 23],
                user.group() if user else person_from_filename(path),
                pose[:, :, 3] + rotate(values[:, 15:18]),
                rotate(values[:, 12:15]),
                rows=lines,
                confidence=np.clip(openness, 0.0, 1.0),
                hit=values[:, 18:21],
                drop={f"an eye is closed (openness at most {min_openness:g})": openness <= min_openness},
            )
    return builder.build()


@dataclass(frozen=True)
class Preset:
    """A known recording: ``read(paths, **options)`` returns its rays."""

    summary: str
    read: Callable[..., Rays]
    options: tuple[str, ...] = ()


PRESETS = {
    "skeleton22": Preset("22-keypoint skeletons, id|time|[66 floats], metres, z up: ears to nose", rays_from_skeleton, ("tick",)),
    "vr_supermarket": Preset("VR supermarket eye gaze, one CSV a person (Unity frame)", vr_supermarket),
}


def preset(name: str) -> Preset:
    """The preset of this name. Raises ``ValueError`` naming those there are."""
    if name not in PRESETS:
        raise ValueError(f'there is no preset "{name}"; choose {" or ".join(PRESETS)}, or give a column map')
    return PRESETS[name]
