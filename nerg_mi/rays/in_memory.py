"""Rays from arrays and data frames, rays as data frames, and their data-quality report.

Implements the methods of `nerg_mi.rays.rays.Rays` that need the modules above it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.files.dataframes import DataFrameReader, make_dataframe
from nerg_mi.files.html import key_value_table

from .quality import RaysSummary, format_quality_report, make_quality_report, summarise
from .rays import Rays
from .readers.base import RaysBuilder, TrackingFrame

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
    frame: tuple[str, str, str] = ("z", "right", "m"),
    unused: Sequence[str] = (),
) -> Rays:
    """Make rays of arrays, see `Rays.from_arrays`.

    ``frame`` are up axis, handedness and unit; ``unused`` are names of columns to report as unused.
    """
    t = _as_numbers(times, "times")
    if t.ndim != 1 or not len(t):
        raise NergError(f"times must have the shape (N,) with at least one sample, got {t.shape}")
    count = len(t)
    vectors = {"origins": origins, "directions": directions, "hits": hits, "heads": heads}
    arrays = {name: _as_numbers(value, name) for name, value in vectors.items() if value is not None}
    names = {"participants": participants} if cohorts is None else {"participants": participants, "cohorts": cohorts}
    texts = {name: value if isinstance(value, str) else _as_names(value) for name, value in names.items()}
    if confidence is not None:
        arrays["confidence"] = _as_numbers(confidence, "confidence")
    for name, array in {**arrays, **texts}.items():
        expected = (count, 3) if name in vectors else (count,)
        if not isinstance(array, str) and array.shape != expected:
            raise NergError(f"{name} must have the shape {expected}, one row for each of the times, got {array.shape}")
    builder = RaysBuilder(TrackingFrame(*frame))
    builder.add_unused_columns(unused)
    cohort = texts.get("cohorts")
    builder.add(
        t,
        texts["participants"],
        arrays["origins"],
        arrays["directions"],
        rows=np.arange(1, count + 1),
        confidence=arrays.get("confidence"),
        hit=arrays.get("hits"),
        head=arrays.get("heads"),
        cohort=np.full(count, cohort) if isinstance(cohort, str) else cohort,
    )
    return builder.build()


def _as_numbers(values: ArrayLike, name: str) -> np.ndarray:
    try:
        return np.ascontiguousarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise NergError(f"{name} must be numbers, got {type(values).__name__} ({error})") from error


def _as_names(values: ArrayLike) -> np.ndarray:
    """Return names (N,) as text; None and NaN become ""."""
    array = np.asarray(values)
    if array.dtype.kind == "O":
        array = np.array(["" if v is None or v != v else str(v) for v in array.ravel()], np.str_).reshape(array.shape)
    return array.astype(np.str_)


# ---- Data frames ----

_NUMBERS, _NAMES, _VECTORS = ("time", "confidence"), ("participant", "cohort"), ("origin", "direction", "hit", "head")
ROLES = ("time", "participant", "origin", "direction", "hit", "head", "confidence", "cohort")
"""What columns of a data frame can contain."""

_REQUIRED = ("time", "origin", "direction")


def _default_columns(role: str) -> str | list[str]:
    return [f"{role}_{axis}" for axis in "xyz"] if role in _VECTORS else role


def from_dataframe(table: Any, columns: Mapping[str, Any] | None, frame: tuple[str, str, str]) -> Rays:
    """Make rays of a data frame, see `Rays.from_dataframe`."""
    reader = DataFrameReader(table)
    as_list = lambda names: [names] if isinstance(names, str) else list(names)
    example = '{"origin": ["x", "y", "z"], "direction": ["dx", "dy", "dz"], "time": "t"}'
    if columns is None:
        choices = {role: _default_columns(role) for role in ROLES}
        defaults = [name for role in _REQUIRED for name in as_list(choices[role])]
        if missing := [name for name in defaults if name not in reader.names]:
            raise NergError(
                f'the data frame has no column "{missing[0]}"; name those that it has '
                f"({', '.join(map(str, reader.names))}), as in columns={example}"
            )
        columns = {
            role: names
            for role, names in choices.items()
            if role in _REQUIRED or set(as_list(names)) <= set(reader.names)
        }
    if unknown := [role for role in columns if role not in ROLES]:
        raise NergError(f'columns has no role "{unknown[0]}"; the roles are {", ".join(ROLES)}')
    if missing := [role for role in _REQUIRED if role not in columns]:
        raise NergError(f'columns lacks "{missing[0]}"; name its columns, as in columns={example}')
    used = [name for names in columns.values() for name in as_list(names)]
    if repeated := next((name for name in used if used.count(name) > 1), None):
        raise NergError(f'the column "{repeated}" has two roles in columns; a column has one role')
    values = {}
    for role, names in columns.items():
        read = reader.read_vectors if role in _VECTORS else reader.read_names if role in _NAMES else reader.read_numbers
        values[role] = read(names)
    return from_arrays(
        values["origin"],
        values["direction"],
        times=values["time"],
        participants=values.get("participant", "participant"),
        hits=values.get("hit"),
        heads=values.get("head"),
        confidence=values.get("confidence"),
        cohorts=values.get("cohort"),
        frame=frame,
        unused=[str(name) for name in reader.names if name not in used],
    )


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
    return make_dataframe(columns, library)


# ---- Data-quality report ----


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
        return self.summary.warnings

    @cached_property
    def lines(self) -> list[tuple[str, str]]:
        """Labels and texts of all lines."""
        return [*make_quality_report(self.rays, self.summary), *self.notes]

    def __repr__(self) -> str:
        return format_quality_report(self.rays, self.summary, self.title, self.notes)

    def _repr_html_(self) -> str:
        return key_value_table(self.lines)


def check_rays(rays: Rays, title: str) -> QualityReport:
    """Make the data-quality report of rays. Raises `NergError` if there are none."""
    return QualityReport(rays, title, summarise(rays))


def describe_rays(rays: Rays) -> str:
    """Describe rays in one line."""
    present = len(rays.participants)
    people = f"{present} participant{'' if present == 1 else 's'}"
    span = f"t {rays.t.min():.4g} to {rays.t.max():.4g} s" if len(rays) else "no times"
    extra = [f"{name}s" for name in ("hit", "head", "cohort") if getattr(rays, name) is not None]
    return f"<Rays: {len(rays):,} of {people}, {span}{', with ' + ', '.join(extra) if extra else ''}>"
