"""Data frames of pandas, polars and Arrow: tables of results as data frames, and the columns of a user's data frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np

from nerg_mi.errors import NergError

from . import html
from .values import fold_name, to_names, to_numbers, to_seconds

LIBRARIES = ("pandas", "polars", "pyarrow")
"""Libraries of data frames, in the order of preference."""


def choose_library(library: str | None) -> str:
    """Return the library of data frames to use: ``library``, or the first of `LIBRARIES` that is installed.

    Raises `NergError` for another library, and if it is not installed.
    """
    if library is not None and library not in LIBRARIES:
        raise NergError(f'library must be one of {", ".join(LIBRARIES)}, got "{library}"')
    installed = [name for name in LIBRARIES if find_spec(name) is not None]
    if library is None and installed:
        return installed[0]
    if library not in installed:
        needed = library or LIBRARIES[0]
        raise NergError(f'a data frame needs {needed}, which is not installed; run "pip install {needed}"')
    return library


def make_dataframe(columns: Mapping[str, Any], library: str | None = None) -> Any:
    """Make a data frame.

    Parameters
    ----------
    columns : mapping of str to sequence
        Values of each column: arrays (N,), or lists in which None is a missing value.
    library : str, optional
        ``pandas``, ``polars`` or ``pyarrow``. Default: the first of these that is installed.

    Returns
    -------
    pandas.DataFrame, polars.DataFrame or pyarrow.Table
        The data frame.

    Raises
    ------
    NergError
        The library is unknown or not installed.
    """
    library = choose_library(library)
    module: Any = import_module(library)
    if library == "pandas":
        return module.DataFrame(dict(columns))
    if library == "polars":
        # Integers and numbers with a fraction may occur in one column of a table.
        return module.DataFrame(dict(columns), strict=False)
    return module.table(dict(columns))


def rows_to_dataframe(rows: Sequence[Mapping[str, Any]], library: str | None = None) -> Any:
    """Make a data frame of ``rows``, whose columns are all keys in order of first appearance; absent values are
    missing. Arguments and errors as for `make_dataframe`."""
    names = dict.fromkeys(key for row in rows for key in row)
    return make_dataframe({name: [row.get(name) for row in rows] for name in names}, library)


class ResultTables:
    """Base class of results that consist of tables, which are attributes with a sequence of rows.

    `TABLES` are the names of the tables; the first one with rows is the main table.
    """

    TABLES: ClassVar[tuple[str, ...]] = ()

    def to_dataframe(self, table: str | None = None, library: str | None = None) -> Any:
        """Return a table as a data frame.

        Parameters
        ----------
        table : str, optional
            Name of the table, an attribute of this object. Default: the main table.
        library : str, optional
            ``pandas``, ``polars`` or ``pyarrow``. Default: the first of these that is installed.

        Returns
        -------
        data frame
            One row per row of the table; limits of intervals are columns of their own.

        Raises
        ------
        NergError
            There is no such table, or the library is not installed.
        """
        name = table or self._main_table()
        if name not in self.TABLES:
            raise NergError(f'there is no table "{name}"; the tables are {", ".join(self.TABLES)}')
        return rows_to_dataframe(getattr(self, name), library)

    def _main_table(self) -> str:
        return next((name for name in self.TABLES if len(getattr(self, name))), self.TABLES[0])

    def __repr__(self) -> str:
        counts = [f"{name} {len(getattr(self, name)):,}" for name in self.TABLES if len(getattr(self, name))]
        return f"<{type(self).__name__}: {', '.join(counts) or 'no'} rows>"

    def _repr_html_(self) -> str:
        """The main table, for notebooks."""
        return rows_to_html(getattr(self, self._main_table()))


_MAX_SHOWN_ROWS = 60


def rows_to_html(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return an HTML table of the first ``rows``, for notebooks; columns without values are left out."""
    shown = rows[:_MAX_SHOWN_ROWS]
    names = [name for name in dict.fromkeys(key for row in shown for key in row) if _has_values(shown, name)]
    numeric = [i for i, name in enumerate(names) if any(isinstance(row.get(name), float) for row in rows)]
    cells = [[_format_cell(row.get(name)) for name in names] for row in shown]
    note = f"{len(rows):,} rows, of which {_MAX_SHOWN_ROWS} are shown" if len(rows) > _MAX_SHOWN_ROWS else None
    return html.markup([html.table(names, cells, numeric), html.paragraph(note) if note else None])


def _has_values(rows: Sequence[Mapping[str, Any]], name: str) -> bool:
    return any(row.get(name) not in (None, "") for row in rows)


def _format_cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.4g}"
    return value if isinstance(value, (str, int)) or value is None else str(value)


class DataFrameReader:
    """The columns of a data frame of pandas, polars, Arrow or another library that narwhals supports, as arrays.

    A column is named by its name or, if the names have several levels, by a tuple or by its parts joined by "_". Names
    are compared by their folded form (`nerg_mi.files.values.fold_name`).

    Parameters
    ----------
    frame : data frame
        The data frame.

    Raises
    ------
    NergError
        narwhals does not support ``frame``.
    """

    def __init__(self, frame: Any) -> None:
        self._index: list[Any] = []  # names of the index of pandas, which is no column
        if hasattr(frame, "iloc") and hasattr(frame, "columns"):
            # pandas allows repeated names and tuples, which narwhals refuses even in unused columns.
            self._labels, self._get = list(frame.columns), lambda k: frame.iloc[:, k]
            self._index = list(getattr(frame.index, "names", ()))
        elif hasattr(frame, "column_names") and hasattr(frame, "combine_chunks"):
            # So does Arrow.
            self._labels, self._get = list(frame.column_names), frame.column
        else:
            table = self._open(frame)
            self._labels, self._get = list(table.columns), lambda k: table[table.columns[k]].to_native()
        self.names: list[str] = [_format_label(label) for label in self._labels]

    @staticmethod
    def _open(frame: Any) -> Any:
        import narwhals  # it takes a tenth of a second

        try:
            table: Any = narwhals.from_native(frame)
        except TypeError as error:
            raise NergError(
                f"expected a data frame of pandas, polars or Arrow, got {type(frame).__name__}; arrays are read by "
                "Rays.from_arrays, and files by import_rays"
            ) from error
        # A lazy frame has no values yet.
        return table.collect() if hasattr(table, "collect") else table

    def find(self, name: Any) -> int:
        """Return the index of a column. Raises `NergError` if there is none, or more than one."""
        matches = [k for k, label in enumerate(self._labels) if _is_same(label, name)]
        if not matches:
            text = fold_name(_format_label(name))
            matches = [k for k, label in enumerate(self.names) if fold_name(label) == text]
        if not matches:
            is_index = any(_is_same(label, name) for label in self._index)
            raise NergError(
                f'the data frame has no column "{_format_label(name)}"; '
                + (
                    "its index has this name: use reset_index()"
                    if is_index
                    else f"it has {', '.join(self.names) or 'none'}"
                )
            )
        if len(matches) > 1:
            raise NergError(
                f'the data frame has {len(matches)} columns called "{_format_label(name)}"; rename all but one'
            )
        return matches[0]

    def _column(self, name: Any) -> tuple[Any, str]:
        """Return a column, and how messages name it."""
        k = self.find(name)
        return self._get(k), f'the column "{self.names[k]}"'

    def read_numbers(self, name: Any) -> np.ndarray:
        """Return the numbers (N,) of a column as float64, NaN where they are missing; truth values are 0 and 1.

        Raises `NergError` if there is no such column, and for values that are not numbers.
        """
        return to_numbers(*self._column(name), flags=True)

    def read_seconds(self, name: Any) -> np.ndarray:
        """Return the times (N,) of a column in seconds, see `nerg_mi.files.values.to_seconds`."""
        return to_seconds(*self._column(name))

    def read_cells(self, name: Any) -> list[Any]:
        """Return the cells of a column as objects. Raises `NergError` if there is no such column."""
        column = self._column(name)[0]
        convert = next(getattr(column, k) for k in ("to_pylist", "to_list", "tolist") if hasattr(column, k))
        return list(convert())

    def read_vectors(self, names: Any) -> np.ndarray:
        """Return three columns as an array (N, 3). Raises `NergError` as `read_numbers`, for truth values, and for
        another number of columns."""
        names = [names] if isinstance(names, str) else list(names)
        if len(names) != 3:
            raise NergError(f"a vector needs three columns, got {', '.join(map(repr, names))}")
        return np.stack([to_numbers(*self._column(name)) for name in names], axis=1)

    def read_complete_rows(self, names: Sequence[str]) -> np.ndarray:
        """Return the rows (n, C) in which all of these columns have numbers; none if a column has other values, or its
        name is repeated."""
        try:
            rows = np.stack([self.read_numbers(name) for name in names], axis=1)
        except NergError:
            # Whether a column has numbers is what is asked.
            return np.empty((0, len(names)))
        return rows[np.isfinite(rows).all(axis=1)]

    def read_names(self, name: Any) -> np.ndarray:
        """Return the names (N,) of a column, "" where they are missing, see `nerg_mi.files.values.to_names`."""
        return to_names(*self._column(name))


def _format_label(label: Any) -> str:
    """Return the name of a column as text; levels are joined by "_"."""
    return "_".join(str(part) for part in label if str(part)) if isinstance(label, tuple) else str(label)


def _is_same(label: Any, name: Any) -> bool:
    """Whether two names of columns are equal; 1 and True are not."""
    return type(label) is type(name) and bool(label == name)
