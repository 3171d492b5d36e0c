"""Rays from arrays and data frames, and rays as data frames.

Implements the methods of `nerg_mi.tracking.rays.Rays` that need the modules above it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.dataframes import DataFrameReader, make_dataframe
from nerg_mi.files.values import is_missing, to_names, to_numbers, to_seconds

from .rays import TRACKING, Rays, check_tracking, merge_metadata, merge_rays, merge_tracking
from .readers.base import RaysBuilder, TrackingFrame
from .readers.cells import parse_vectors

# ---- Rays from arrays ----


def from_arrays(
    origins: ArrayLike,
    directions: ArrayLike,
    *,
    times: ArrayLike,
    participants: str | ArrayLike = "participant",
    hits: ArrayLike | None = None,
    heads: ArrayLike | None = None,
    confidence: ArrayLike | None = None,
    cohorts: str | ArrayLike | None = None,
    tracking: str | None = None,
    frame: tuple[str, str, str] = ("z", "right", "m"),
    unused: Sequence[str] = (),
    read_unused: Callable[[Sequence[str]], np.ndarray] = lambda names: np.empty((0, len(names))),
) -> Rays:
    """Make rays of arrays, see `Rays.from_arrays`.

    ``frame`` are up axis, handedness and unit; ``unused`` are names of columns to report as unused, of which
    ``read_unused`` returns the complete rows.
    """
    if tracking is not None:
        check_tracking(tracking)
    t = to_seconds(times, "times")
    if t.ndim != 1 or not len(t):
        raise NergError(f"times must have the shape (N,) with at least one sample, got {t.shape}")
    count = len(t)
    vectors = {"origins": origins, "directions": directions, "hits": hits, "heads": heads}
    arrays = {name: to_numbers(value, name) for name, value in vectors.items() if value is not None}
    names = {"participants": participants} if cohorts is None else {"participants": participants, "cohorts": cohorts}
    texts = {name: value if isinstance(value, str) else to_names(value, name) for name, value in names.items()}
    if confidence is not None:
        arrays["confidence"] = to_numbers(confidence, "confidence", flags=True)
    for name, array in {**arrays, **texts}.items():
        expected = (count, 3) if name in vectors else (count,)
        if not isinstance(array, str) and array.shape != expected:
            raise NergError(f"{name} must have the shape {expected}, one row for each of the times, got {array.shape}")
    builder = RaysBuilder(TrackingFrame(*frame))
    builder.add_data_frame(list(unused), read_unused)
    cohort = texts.get("cohorts")
    builder.add(
        t,
        texts["participants"],
        arrays["origins"],
        arrays["directions"],
        rows=np.arange(1, count + 1),
        tracking=tracking or ("unknown" if heads is None else "eye"),
        confidence=arrays.get("confidence"),
        hit=arrays.get("hits"),
        head=arrays.get("heads"),
        cohort=np.full(count, cohort) if isinstance(cohort, str) else cohort,
    )
    return builder.build()


# ---- Concatenation ----


def concatenate(rays: Iterable[Rays]) -> Rays:
    """Concatenate rays, see `Rays.concatenate`."""
    parts = [rays] if isinstance(rays, Rays) else list(rays)
    if not parts:
        raise NergError("there are no rays to concatenate; pass one set or more")
    for k, part in enumerate(parts):
        if not isinstance(part, Rays):
            raise NergError(
                f"element {k} must be Rays, got {type(part).__name__}; files are read by Rays.load, arrays by "
                "Rays.from_arrays"
            )
    # The frame of rays, and the transform from it to that of an environment.
    for key, what in {"frame": "frame", "place_from_rays": "alignment to the environment (place_from_rays)"}.items():
        values = [part.metadata.get(key) for part in parts]
        if other := next((k for k, value in enumerate(values) if value != values[0]), None):
            raise NergError(
                f"element {other} has another {what} than element 0 ({values[other]} and {values[0]}); transform one "
                "of them first"
            )
    names = [name for part in parts for name in part.participants]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        shown = ", ".join(sanitize(name, 40) for name in repeated[:5]) + (", ..." if len(repeated) > 5 else "")
        warnings.warn(
            f"{shown} {'is a participant' if len(repeated) == 1 else 'are participants'} of several sets, and counted "
            "as one: rename them before if they are different participants",
            stacklevel=3,
        )
    metadata = merge_metadata([part.metadata for part in parts])
    steps = [step for part in parts for step in part.metadata.get("steps", [])]
    return merge_rays(parts, {**metadata, **({"steps": steps} if steps else {})})


# ---- Data frames ----

_NAMES, _VECTORS = ("participant", "cohort", "tracking"), ("origin", "direction", "hit", "head")
ROLES = ("time", "participant", "origin", "direction", "hit", "head", "confidence", "cohort", "tracking")
"""What columns of a data frame can contain."""

_REQUIRED = ("time", "origin", "direction")


def _read_vectors(reader: DataFrameReader, names: Sequence[Any]) -> np.ndarray:
    """Read vectors (N, 3) from three columns, or from one whose cells are sequences, mappings of axes, or text such as
    (1, 2, 3)."""
    if len(names) != 1:
        return reader.read_vectors(names)
    cells, column = reader.read_cells(names[0]), f'the column "{names[0]}"'
    texts = [cell if isinstance(cell, str) else "" for cell in cells]
    out, is_bad = parse_vectors(texts, 3)
    for k, cell in enumerate(cells):
        if isinstance(cell, Mapping) and sorted(str(axis).lower() for axis in cell) == list("xyz"):
            cell = [value for _, value in sorted(cell.items(), key=lambda item: str(item[0]).lower())]
        if not isinstance(cell, (str, Mapping)) and np.ndim(cell) == 1 and len(cell) == 3:
            out[k] = to_numbers(cell, column)
        elif not (isinstance(cell, str) or is_missing(cell)):
            is_bad[k] = True
    if is_bad.any():
        k = int(np.argmax(is_bad))
        raise NergError(
            f"a vector needs three columns, or one with three numbers in each cell; row {k} of {column} is "
            f"{sanitize(str(cells[k]), 60)!r}"
        )
    return out


def from_dataframe(
    table: Any, columns: Mapping[str, Any] | None, tracking: str | None, frame: tuple[str, str, str]
) -> Rays:
    """Make rays of a data frame, see `Rays.from_dataframe`."""
    reader = DataFrameReader(table)
    # A tuple is the name of one column with several levels, unless it is a vector.
    is_one = lambda role, names: (
        isinstance(names, str) or not isinstance(names, Iterable) or (isinstance(names, tuple) and role not in _VECTORS)
    )
    as_list = lambda role, names: [names] if is_one(role, names) else list(names)
    example = '{"origin": ["x", "y", "z"], "direction": ["dx", "dy", "dz"], "time": "t"}'
    if columns is None:
        defaults = {role: [f"{role}_{axis}" for axis in "xyz"] if role in _VECTORS else [role] for role in ROLES}
        if missing := [name for role in _REQUIRED for name in defaults[role] if name not in reader.names]:
            raise NergError(
                f'the data frame has no column "{missing[0]}"; name those that it has '
                f"({', '.join(reader.names)}), as in columns={example}"
            )
        choices = {role: names for role, names in defaults.items() if set(names) <= set(reader.names)}
    else:
        if not isinstance(columns, Mapping):
            raise NergError(f"columns must map roles to names, got {sanitize(repr(columns), 60)}; pass {example}")
        if unknown := [role for role in columns if role not in ROLES]:
            raise NergError(f'columns has no role "{unknown[0]}"; the roles are {", ".join(ROLES)}')
        choices = {role: as_list(role, names) for role, names in columns.items() if names is not None}
    if missing := [role for role in _REQUIRED if role not in choices]:
        raise NergError(f'columns lacks "{missing[0]}"; name its columns, as in columns={example}')
    for role, names in choices.items():
        if role not in _VECTORS and len(names) != 1:
            raise NergError(f"{role} needs one column, got {', '.join(map(repr, names))}")
    used = [reader.find(name) for names in choices.values() for name in names]
    repeated = next((k for k in used if used.count(k) > 1), None)
    if repeated is not None:
        raise NergError(f'the column "{reader.names[repeated]}" has two roles in columns; a column has one role')
    read = {"time": reader.read_seconds, "confidence": reader.read_numbers} | dict.fromkeys(_NAMES, reader.read_names)
    values = {
        role: _read_vectors(reader, names) if role in _VECTORS else read[role](names[0])
        for role, names in choices.items()
    }
    if tracking is None and "tracking" in values:
        kinds = np.unique(values["tracking"]).tolist()
        if unknown := [kind for kind in kinds if kind not in TRACKING]:
            column = choices["tracking"][0]
            raise NergError(
                f'the column "{column}" contains {sanitize(unknown[0], 40)!r}, but what was tracked is one of '
                f"{', '.join(TRACKING)}; correct it, or pass tracking="
            )
        tracking = merge_tracking(kinds)
    rays = from_arrays(
        values["origin"],
        values["direction"],
        times=values["time"],
        participants=values.get("participant", "participant"),
        hits=values.get("hit"),
        heads=values.get("head"),
        confidence=values.get("confidence"),
        cohorts=values.get("cohort"),
        tracking=tracking,
        frame=frame,
        unused=[name for k, name in enumerate(reader.names) if k not in used],
        read_unused=reader.read_complete_rows,
    )
    if tracking != "mixed" or not {"tracking", "participant"} <= values.keys():
        return rays
    pairs = sorted(set(zip(values["participant"].tolist(), values["tracking"].tolist())))
    by_person = {name: merge_tracking(kind for other, kind in pairs if other == name) for name in rays.persons}
    return replace(rays, metadata={**rays.metadata, "tracking_by_person": by_person})


def to_dataframe(rays: Rays, library: str | None) -> Any:
    """Return rays as a data frame, see `Rays.to_dataframe`."""
    names = {"t": "time", "person": "participant", "cohort": "cohort"}
    columns: dict[str, Any] = {}
    for name, values in rays.columns().items():
        if values.ndim == 2:
            columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
        elif name in ("person", "cohort"):
            texts = rays.persons if name == "person" else rays.cohorts
            columns[names[name]] = np.array(texts, dtype=object)[values]
        else:
            columns[names.get(name, name)] = values
    if rays.tracking != "unknown":
        kinds = rays.tracking_by_person
        columns["tracking"] = np.array([kinds.get(name, "") for name in rays.persons], object)[rays.person]
    return make_dataframe(columns, library)


# ---- Description ----


def describe_rays(rays: Rays) -> str:
    """Describe rays in one line."""
    present = len(rays.participants)
    people = f"{present} participant{'' if present == 1 else 's'}"
    span = f"t {rays.t.min():.4g} to {rays.t.max():.4g} s" if len(rays) else "no times"
    extra = [f"{name}s" for name in ("hit", "head", "cohort") if getattr(rays, name) is not None]
    heads = {"head": "directions of heads, ", "mixed": "some directions of heads, "}.get(rays.tracking, "")
    return f"<Rays: {len(rays):,} of {people}, {heads}{span}{', with ' + ', '.join(extra) if extra else ''}>"
