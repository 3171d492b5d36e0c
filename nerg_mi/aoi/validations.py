"""Tables of the error of eye trackers, as validations report it: accuracy and precision of participants."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np

from nerg_mi.environment.arrays import join_names
from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.values import to_name
from nerg_mi.tracking.readers.columns import PERSON_NAMES, ColumnFinder
from nerg_mi.tracking.readers.tables import explain_columns, iterate_table

MAX_ANGLE = 20.0  # degrees


@dataclass(frozen=True)
class ValidationFormat:
    """Columns of the table of a program.

    Parameters
    ----------
    program
        Name of the program.
    person
        Names of the column of participants, of which the first that exists is read.
    accuracy, precision
        Columns in degrees whose means are read, one for each eye. Precision is the standard deviation of samples over
        both axes; a table may lack it.
    """

    program: str
    person: tuple[str, ...]
    accuracy: tuple[str, ...]
    precision: tuple[str, ...]


FORMATS = (
    ValidationFormat("nerg, or by hand", (*PERSON_NAMES,), ("accuracy",), ("precision",)),
    ValidationFormat("nerg rays events", (*PERSON_NAMES,), ("accuracy",), ("std",)),
    ValidationFormat("ETDQualitizer", ("file",), ("accuracy",), ("std",)),
    ValidationFormat("glassesValidator", ("recording",), ("acc",), ("std",)),
    ValidationFormat(
        "Tobii Pro Lab",
        ("Participant name",),
        ("Average validation accuracy (degrees)",),
        ("Average validation precision SD (degrees)",),
    ),
    ValidationFormat(
        "Titta",
        ("pid",),
        ("accuracy_left_eye (deg)", "accuracy_right_eye (deg)"),
        ("SD_left_eye (deg)", "SD_right_eye (deg)"),
    ),
)
"""Formats of tables: the first whose columns exist is read, or the first that lacks its precision only."""


@dataclass(frozen=True)
class Validation:
    """Accuracy and precision in degrees from ``start``, in seconds on the recording's clock; the precision is NaN if it
    is unknown."""

    start: float
    accuracy: float
    precision: float


Validations = Mapping[str, Sequence[Validation]]
"""The validations of each participant."""


def read_validation(path: Path) -> dict[str, list[Validation]]:
    """Read a table of validations in one of `FORMATS`.

    Rows of a participant with the same ``start`` (column of seconds on the recording's clock), or all without that
    column, are averaged. Rows without accuracy are ignored. Raises `NergError` for missing columns, a missing start,
    and for values outside of 0 to 20 degrees.
    """
    values: dict[tuple[str, float], list[tuple[float, float]]] = {}
    for name, start, accuracy, precision in _read_rows(path):
        degrees = [value for value in (accuracy, precision) if not np.isnan(value)]
        if not all(0 <= value <= MAX_ANGLE for value in degrees):
            raise NergError(
                f'"{path}" has {join_names([f"{value:g}" for value in degrees])} degrees for "{sanitize(name, 40)}"; '
                f"accuracy and precision must be numbers from 0 to {MAX_ANGLE:g}"
            )
        if np.isnan(start):
            raise NergError(f'"{path}" has no start for "{sanitize(name, 40)}"; add it, or remove the column')
        if not np.isnan(accuracy):
            values.setdefault((name, start), []).append((accuracy, precision))
    if not values:
        raise NergError(f'"{path}" contains no accuracy; write the header person,accuracy,precision and one row each')
    validations: dict[str, list[Validation]] = {}
    for (name, start), rows in values.items():
        validations.setdefault(name, []).append(Validation(start, *np.mean(rows, axis=0).tolist()))
    return validations


def _read_rows(path: Path) -> Iterator[tuple[str, float, float, float]]:
    """Yield the participant, start (0 without the column), accuracy and precision of each row."""
    table = ColumnFinder(path)
    find = lambda name: table.find(re.sub("[ .]", "_", name).lower())
    present = [f for f in FORMATS if any(map(find, f.person)) and all(map(find, f.accuracy))]
    if not present:
        remedy = explain_columns(table.columns, "rename columns in its header")
        raise NergError(f'"{path}" has no columns person and accuracy, nor those of a supported program; {remedy}')
    chosen = next((f for f in present if all(map(find, f.precision))), present[0])
    person = next(name for name in map(find, chosen.person) if name is not None)
    groups = [[name for column in columns if (name := find(column))] for columns in (chosen.accuracy, chosen.precision)]
    start = find("start")
    numbers = [*groups[0], *groups[1], *([start] if start else [])]

    def refuse(line: int, reason: str) -> None:
        raise NergError(f"{path}, line {line}{reason}")

    for block in iterate_table(path, numbers, [person], on_bad_line=refuse):
        column = dict(zip(numbers, block.numbers.T))
        accuracy, precision = (_mean([column[name] for name in group], len(block.lines)) for group in groups)
        starts = column[start] if start else np.zeros(len(block.lines))
        # ETDQualitizer names files.
        texts = [PurePath(text).stem if person == "file" else text for text in block.texts[:, 0].tolist()]
        yield from zip(map(to_name, texts), starts.tolist(), accuracy.tolist(), precision.tolist())


def _mean(columns: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Return the mean of the known values in each row; NaN without one."""
    values = np.stack(columns) if columns else np.full((1, count), np.nan)
    with np.errstate(invalid="ignore"):
        return np.nansum(values, axis=0) / (~np.isnan(values)).sum(axis=0)
