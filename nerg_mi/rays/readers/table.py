"""Rays of tables through a column map: a direction of its own, or a head's pose, or both."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays

from .builder import RaysBuilder
from .frames import to_rays_frame
from .parsing import poses
from .parsing.column_map import ColumnMap
from .parsing.tables import iterate_table

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
    forward: str | None = None,
    degrees: bool = True,
    person_from: str = "column",
    min_confidence: float = 0.0,
    tick: float = 1.0,
    valid: dict[str, Sequence[str]] | None = None,
    skip_bad_lines: bool = False,
    **about: object,
) -> Rays:
    """Rays of CSV or Parquet tables through a column map.

    ``up``, ``handedness`` and ``units`` declare the tables' frame; rays come out
    right-handed, z up, in metres, and the transform is recorded. Directions need
    not be unit. Where the map has a head's pose (``xyzw``, ``wxyz``, ``ypr``,
    ``matrix``), ``direction`` and ``eye`` are in the head's frame, and without a
    ``direction`` the ray is where the head points: along ``forward``, an axis of
    its frame (default: :func:`nerg_mi.rays.readers.parsing.poses.default_forward`). Angles
    are in degrees unless ``degrees`` is false; how they turn is said at
    :func:`nerg_mi.rays.readers.parsing.poses.rotations_from_angles`.

    ``person_from``: ``column`` (the map's ``person``) or ``filename``. Rows with
    a confidence below ``min_confidence`` are dropped; so are rows where a column
    of ``valid`` does not hold one of its words (upper and lower case are one).
    ``tick``: seconds in one unit of the time column; without one, in one row.
    ``skip_bad_lines``: see `RaysBuilder`. ``about``: further metadata. Raises `NergError` for missing columns, cells
    that are no numbers, or when no ray is left.
    """
    columns = ColumnMap.parse(columns) if isinstance(columns, str) else columns
    if person_from not in ("column", "filename"):
        raise NergError(f'person_from is "{person_from}"; it is "column" or "filename"')
    by_file = person_from == "filename" or columns.person is None
    forward = forward or poses.default_forward(up, handedness)
    ahead = poses.axis(forward, "forward")
    vectors = [c for c in (columns.origin, columns.direction, columns.eye, columns.hit) if c]
    pose = getattr(columns, columns.pose) if columns.pose else ()
    numbers = [*(name for v in vectors for name in v), *pose, *(c for c in (columns.t, columns.confidence) if c)]
    texts = [*([] if by_file else [columns.person]), *([columns.cohort] if columns.cohort else []), *(valid or {})]

    frame = {"up": up, "handedness": handedness, "units": units}
    builder = RaysBuilder(
        transform=to_rays_frame(**frame),
        skip_bad_lines=skip_bad_lines,
        columns=str(columns),
        source_frame=frame,
        tick=tick,
        min_confidence=min_confidence,
        **({"forward": forward} if columns.pose else {}),
        **({"degrees": degrees} if columns.ypr else {}),
        **about,
    )
    for path in map(Path, paths):
        builder.source(path)
        rows = 0
        for block in iterate_table(path, numbers, texts, on_bad=builder.on_bad):
            value = dict(zip(numbers, block.numbers.T))
            word = dict(zip(texts, block.texts.T))
            vector = lambda names: np.stack([value[c] for c in names], axis=1)
            n = len(block.lines)
            t = value[columns.t] if columns.t else np.arange(rows, rows + n, dtype=np.float64)
            rows += n
            confidence = value[columns.confidence] if columns.confidence else np.ones(n)
            origin = vector(columns.origin) if columns.origin else None
            direction = vector(columns.direction) if columns.direction else None
            if columns.pose:
                turn, place = _pose(columns.pose, vector(pose), up, forward, degrees)
                origin = place if origin is None else origin
                if columns.eye:
                    origin = origin + np.einsum("nij,nj->ni", turn, vector(columns.eye))
                direction = turn @ ahead if direction is None else np.einsum("nij,nj->ni", turn, direction)
            drop = {f"confidence below {min_confidence:g}": confidence < min_confidence}
            for name, words in (valid or {}).items():
                drop[f"{name} is not {' or '.join(words)}"] = ~np.isin(
                    np.char.lower(word[name]), [w.lower() for w in words]
                )
            builder.add(
                t * tick,
                person_from_filename(path) if by_file else word[columns.person],
                origin,
                direction,
                rows=block.lines,
                confidence=confidence,
                hit=vector(columns.hit) if columns.hit else None,
                cohort=word[columns.cohort] if columns.cohort else None,
                drop=drop,
            )
    return builder.build()


def _pose(kind: str, values: np.ndarray, up: str, forward: str, degrees: bool) -> tuple[np.ndarray, np.ndarray | None]:
    if kind == "matrix":
        return poses.rotations_from_matrices(values)
    if kind == "ypr":
        return poses.rotations_from_angles(values, up, forward, degrees), None
    return poses.rotations_from_quaternions(values, kind), None
