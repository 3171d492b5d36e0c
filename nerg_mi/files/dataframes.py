"""Data frames of pandas, polars and Arrow: tables of results as data frames, and the columns of a user's data frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np

from nerg_mi.errors import NergError

from . import html

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
        rows = getattr(self, self._main_table())
        names = list(dict.fromkeys(key for row in rows[:_MAX_SHOWN_ROWS] for key in row))
        # Columns without any value say nothing.
        names = [name for name in names if any(row.get(name) not in (None, "") for row in rows[:_MAX_SHOWN_ROWS])]
        numeric = [i for i, name in enumerate(names) if any(isinstance(row.get(name), float) for row in rows)]
        cells = [[_format_cell(row.get(name)) for name in names] for row in rows[:_MAX_SHOWN_ROWS]]
        note = f"{len(rows):,} rows, of which {_MAX_SHOWN_ROWS} are shown" if len(rows) > _MAX_SHOWN_ROWS else None
        return html.markup([html.table(names, cells, numeric), html.paragraph(note) if note else None])


_MAX_SHOWN_ROWS = 60


def _format_cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.4g}"
    return value if isinstance(value, (str, int)) or value is None else str(value)


class DataFrameReader:
    """The columns of a data frame of pandas, polars, Arrow or another library that narwhals supports, as arrays.

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
        import narwhals  # it takes a tenth of a second

        try:
            table: Any = narwhals.from_native(frame)
        except TypeError as error:
            raise NergError(
                f"expected a data frame of pandas, polars or Arrow, got {type(frame).__name__}; arrays are read by "
                "Rays.from_arrays, and files by import_rays"
            ) from error
        # A lazy frame has no values yet.
        self._table: Any = table.collect() if hasattr(table, "collect") else table
        self.names: list[str] = list(self._table.columns)

    def __len__(self) -> int:
        return len(self._table)

    def _column(self, name: str) -> Any:
        if name not in self.names:
            raise NergError(f'the data frame has no column "{name}"; it has {", ".join(map(str, self.names))}')
        return self._table[name]

    def read_numbers(self, name: str) -> np.ndarray:
        """Return the numbers (N,) of a column as float64, NaN where they are missing; dates and durations in seconds.

        Raises `NergError` if there is no such column, and for values that are not numbers.
        """
        column = self._column(name)
        values = np.asarray(column.to_numpy())
        if values.dtype.kind in "mM":
            unit = "datetime64[ns]" if values.dtype.kind == "M" else "timedelta64[ns]"
            values = values.astype(unit)
            return np.where(np.isnat(values), np.nan, values.astype(np.int64) / 1e9)
        try:
            return values.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise NergError(f'the column "{name}" contains values that are not numbers ({error})') from error

    def read_vectors(self, names: Iterable[str]) -> np.ndarray:
        """Return three columns as an array (N, 3). Raises `NergError` as `read_numbers`, and for another number."""
        names = [names] if isinstance(names, str) else list(names)
        if len(names) != 3:
            raise NergError(f"a vector needs three columns, got {', '.join(map(repr, names))}")
        return np.stack([self.read_numbers(name) for name in names], axis=1)

    def read_names(self, name: str) -> np.ndarray:
        """Return the texts (N,) of a column, "" where they are missing; other values are written as text."""
        column = self._column(name)
        texts = [str(value) for value in column.to_list()]
        missing = column.is_null().to_numpy()
        return np.where(missing, "", np.array(texts, dtype=np.str_))
