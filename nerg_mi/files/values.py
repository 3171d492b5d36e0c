"""Numbers, times and names from arrays, lists and columns of NumPy, pandas, polars and Arrow.

One conversion for all arguments, data frames and files: missing values (None, NaN, NaT, pandas.NA, masked) become NaN
or "", and what is no number or time is refused by name.
"""

from __future__ import annotations

import datetime
import hashlib
import math
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator, KeysView, Mapping, Sequence, ValuesView
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike

from nerg_mi.errors import NergError, sanitize

# ---- Numbers and times ----

_TICKS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9, "ps": 10**12, "fs": 10**15, "as": 10**18}  # per second


def to_numbers(values: Any, name: str, dtype: DTypeLike = np.float64, *, flags: bool = False) -> np.ndarray:
    """Convert ``values`` of any shape to a contiguous array of floats, NaN where they are missing.

    Parameters
    ----------
    values
        Numbers: an array, nested sequences, or a column.
    name
        Name of the values, for messages.
    dtype
        Type of the result.
    flags
        Whether truth values are accepted, as 0 and 1.

    Raises
    ------
    NergError
        The values are truth values, complex, dates, durations, text or other objects, or differ in length.
    """
    array, missing = _to_array(values, name)
    if array.dtype.kind in "fiu" or (flags and array.dtype.kind == "b"):
        return _fill(array, missing, dtype)
    if array.dtype.kind == "O":
        return _convert_objects(array, missing, name, lambda value: _to_number(value, flags)).astype(dtype)
    raise _refuse(name, _KINDS.get(array.dtype.kind, str(array.dtype)), "numbers", array)


def to_seconds(values: Any, name: str) -> np.ndarray:
    """Convert times to seconds as float64, NaN where they are missing.

    Numbers are seconds. Durations are converted to seconds, and dates to seconds since 1970 in UTC, which is assumed
    for dates without a time zone. Parameters and errors as for `to_numbers`; dates as text are refused.
    """
    array, missing = _to_array(values, name)
    if array.dtype.kind in "mM":
        missing = np.isnat(array) if missing is None else missing | np.isnat(array)
        return np.where(missing, np.nan, _count_seconds(array, name))
    if array.dtype.kind in "fiu":
        return _fill(array, missing, np.float64)
    if array.dtype.kind == "O":
        return _convert_times(array, missing, name)
    raise _refuse(name, _KINDS.get(array.dtype.kind, str(array.dtype)), "numbers, dates or durations", array)


_KINDS = {
    "b": "truth values",
    "c": "complex numbers",
    "M": "dates",
    "m": "durations",
    "U": "text",
    "S": "text",
    "T": "text",
    "V": "records",
}


def _to_array(values: Any, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Convert ``values`` to an array, with the mask of what is missing by another way than its value, or None."""
    if isinstance(values, np.ma.MaskedArray):
        return np.asarray(values.data), np.broadcast_to(np.ma.getmaskarray(values), values.shape)
    if getattr(getattr(values, "dtype", None), "tz", None) is not None and hasattr(values, "to_numpy"):
        # Of pandas: an array of objects otherwise.
        return values.to_numpy(dtype="datetime64[ns]"), None
    if hasattr(getattr(values, "type", None), "index_type") and hasattr(values, "cast"):
        # Arrow's chunked dictionaries lose missing values on the way to NumPy.
        values = values.cast(values.type.value_type)
    if hasattr(values, "detach") and hasattr(values, "cpu"):
        # Tensors of PyTorch that have derivatives, or are on another device.
        values = values.detach().cpu()
        values = values.double() if values.is_floating_point() else values  # NumPy lacks bfloat16
    if isinstance(values, (Iterator, ValuesView, KeysView)):
        values = list(values)
    try:
        return np.asarray(values), None
    except (TypeError, ValueError, OverflowError) as error:
        raise NergError(f"{name} must be an array of equal rows, got {type(values).__name__}") from error


def _fill(array: np.ndarray, missing: np.ndarray | None, dtype: DTypeLike) -> np.ndarray:
    if missing is None or not missing.any():
        return np.asarray(array, dtype, order="C")
    return np.where(missing, np.nan, array).astype(dtype)


def _count_seconds(array: np.ndarray, name: str) -> np.ndarray:
    """Convert dates since 1970, or durations, to seconds; undefined where they are missing."""
    unit, step = np.datetime_data(array.dtype)
    if unit not in _TICKS:
        if array.dtype.kind == "m" and unit in ("Y", "M", "generic"):
            raise NergError(f"{name} are durations without a fixed length in seconds; convert them to timedelta64[ms]")
        array, unit, step = array.astype(f"{array.dtype.kind}8[s]"), "s", 1
    return array.astype(np.int64) * float(step) / _TICKS[unit]


def _convert_times(array: np.ndarray, missing: np.ndarray | None, name: str) -> np.ndarray:
    """Convert objects, which must be all numbers, all dates with or all without a time zone, or all durations."""
    kinds: set[str] = set()

    def convert(value: Any) -> float | None:
        if isinstance(value, datetime.datetime):
            kinds.add("dates without a time zone" if value.tzinfo is None else "dates with a time zone")
            return (value if value.tzinfo else value.replace(tzinfo=datetime.timezone.utc)).timestamp()
        if isinstance(value, datetime.timedelta):
            kinds.add("durations")
            return value.total_seconds()
        if isinstance(value, (np.datetime64, np.timedelta64, datetime.date)):
            scalar = np.asarray(value, "datetime64[D]" if isinstance(value, datetime.date) else None)
            kinds.add("durations" if scalar.dtype.kind == "m" else "dates without a time zone")
            return float(_count_seconds(scalar, name))
        kinds.add("numbers")
        return _to_number(value, False)

    seconds = _convert_objects(array, missing, name, convert, "numbers, dates or durations")
    if len(kinds) > 1:
        raise NergError(f"{name} mix {' and '.join(sorted(kinds))}; use one kind for all of them")
    return seconds


def _to_number(value: Any, flags: bool) -> float | None:
    """Convert an object to a number; None if it is no real number."""
    if isinstance(value, (bool, np.bool_)):
        return float(value) if flags else None
    # Decimal numbers are not registered as real numbers; durations are, as integers of any unit.
    is_number = isinstance(value, Real) or type(value).__name__ == "Decimal"
    is_number &= not isinstance(value, np.timedelta64)
    try:
        return float(value) if is_number else None
    except OverflowError:
        return math.inf if value > 0 else -math.inf  # pyright: ignore[reportOperatorIssue] real numbers are ordered


def _convert_objects(
    array: np.ndarray, missing: np.ndarray | None, name: str, convert: Any, expected: str = "numbers"
) -> np.ndarray:
    """Convert an array of objects one by one, NaN where ``is_missing``."""
    out = np.full(array.size, np.nan)
    skip = np.zeros(array.size, bool) if missing is None else missing.ravel()
    for k, value in enumerate(array.ravel().tolist()):
        if skip[k] or is_missing(value):
            continue
        number = convert(value)
        if number is None:
            kind = "text" if isinstance(value, (str, bytes)) else f"values of the kind {type(value).__name__}"
            raise _refuse(name, kind, expected, np.array([value], object))
        out[k] = number
    return out.reshape(array.shape)


def is_missing(value: Any) -> bool:
    """Whether a value is None, NaN, NaT or pandas.NA."""
    if value is None:
        return True
    try:
        return bool(value != value)
    except (TypeError, ValueError):
        # pandas.NA has no truth value; neither have arrays, which are values.
        return type(value).__name__ == "NAType"


def _refuse(name: str, kind: str, expected: str, array: np.ndarray) -> NergError:
    remedy = {
        "text": "convert them first, dates with pandas.to_datetime, numbers with astype(float)",
        "truth values": "convert them with astype(float) if they are 0 and 1",
        "complex numbers": "use their real part",
        "dates": "subtract the first one, and divide by numpy.timedelta64(1, 's')",
        "durations": "divide them by numpy.timedelta64(1, 's')",
        "values of the kind time": "add their dates, with datetime.datetime.combine",
        "values of the kind Period": "convert them first, with to_timestamp()",
    }.get(kind, "convert them first")
    example = f" such as {sanitize(str(array.ravel()[0]), 40)!r}" if array.size else ""
    return NergError(f"{name} must contain {expected}, got {kind}{example}; {remedy}")


def parse_float(text: str) -> float:
    """Return the number that ``text`` is in tables, as `float`. Raises ``ValueError``, also for 1_000: in a table that
    is the name of a trial."""
    if "_" in text:
        raise ValueError(f"could not convert string to float: {text[:60]!r}")
    return float(text)


# ---- Names ----
#
# Equal names may be different sequences of code points: composed or decomposed ("ö", which macOS writes decomposed),
# and the micro sign or the Greek letter. Names are stored composed (NFC), and compared by their compatible form (NFKC).


def normalize_name(text: str) -> str:
    """Return a name of a participant, cohort, area, recording or file in the form in which it is stored (NFC)."""
    return unicodedata.normalize("NFC", text)


def fold_name(text: str) -> str:
    """Return the form (NFKC, without spaces at the ends) by which names of columns, participants and other choices are
    compared."""
    return unicodedata.normalize("NFKC", _ENDS.sub("", text))


def find_name(name: str, names: Sequence[str]) -> int | None:
    """Return the index of the first of ``names`` that is equal to ``name``, or else equal in its folded form
    (`fold_name`); or None."""
    if name in names:
        return names.index(name)
    folded = fold_name(name)
    return next((k for k, other in enumerate(names) if fold_name(other) == folded), None)


# An integer that a program wrote as a floating-point number because other cells of the column are empty.
_WHOLE = re.compile(r"(-?(?:0|[1-9]\d*))\.0+")


# Spaces at the ends of a name, also those without width, which copies from pages contain.
_ENDS = re.compile(r"^[\s\u200b\u2060\ufeff]+|[\s\u200b\u2060\ufeff]+$")


def to_name(value: Any) -> str:
    """Return the name, or the number of a participant, as text; "" if it is missing.

    Whole numbers are written without decimals, also if they are text ("1.0"): columns of integers with empty cells are
    stored as floating-point numbers by many programs.
    """
    if isinstance(value, str):
        text = normalize_name(_ENDS.sub("", value))
        return match[1] if (match := _WHOLE.fullmatch(text)) else text
    if is_missing(value):
        return ""
    if isinstance(value, bytes):
        return to_name(value.decode("utf-8", "replace"))
    if isinstance(value, (float, np.floating)) and float(value).is_integer():
        return str(int(value))
    return to_name(str(value))


def to_names(values: Any, name: str) -> np.ndarray:
    """Convert names or numbers of participants to an array of text of the same shape, "" where they are missing.

    Parameters and errors as for `to_numbers`; see `to_name`.
    """
    array, missing = _to_array(values, name)
    if array.dtype.kind in "cV":
        raise _refuse(name, _KINDS[array.dtype.kind], "names or integers", array)
    if array.dtype.kind in "fO":
        array = _check_rounding(_keep_integers(array, values), array.dtype, name)
    if array.dtype.kind in "US" and array.size:
        # Far fewer names than rows.
        unique, inverse = np.unique(array, return_inverse=True)
        texts = np.array([to_name(value) for value in unique.tolist()], np.str_)[inverse].reshape(array.shape)
    else:
        texts = np.array([to_name(value) for value in array.ravel().tolist()], np.str_).reshape(array.shape)
    return texts if missing is None else np.where(missing, "", texts)


def _keep_integers(array: np.ndarray, values: Any) -> np.ndarray:
    """Return the cells of ``values`` as objects if ``array`` contains floats that are integers there, next to missing
    values: large ones are rounded to one number."""
    if array.dtype.kind == "O" or isinstance(values, np.ndarray) or array.ndim != 1:
        return array
    convert = next((getattr(values, k) for k in ("to_pylist", "to_list", "tolist") if hasattr(values, k)), None)
    cells = np.empty(len(array), object)
    cells[:] = list(values) if convert is None else convert()
    return cells


def _check_rounding(array: np.ndarray, dtype: np.dtype, name: str) -> np.ndarray:
    """Return ``array``. Raises `NergError` for floats of ``dtype`` so large that different integers are equal."""
    limit = 2.0 ** (np.finfo(dtype if dtype.kind == "f" else np.float64).nmant + 1)
    for value in array.ravel().tolist() if array.dtype.kind == "O" else array[np.isfinite(array)].tolist():
        if isinstance(value, (float, np.floating)) and limit <= abs(value) < np.inf:
            raise NergError(
                f"{name} must contain integers or text, got the floating-point number {value:.17g}, to which other "
                "integers are rounded, too; read them as integers or text"
            )
    return array


def unify_names(names: Iterable[Any]) -> tuple[tuple[str, ...], np.ndarray | None]:
    """Return ``names`` as `to_name` does, and the index of each among them if this made some equal, or None."""
    texts = [to_name(name) for name in names]
    unique = dict.fromkeys(texts)
    if len(unique) == len(texts):
        return tuple(texts), None
    index = {name: k for k, name in enumerate(unique)}
    return tuple(unique), np.array([index[name] for name in texts], np.int32)


def find_names(names: Iterable[Any], available: Sequence[str], what: str) -> list[int]:
    """Return the index among ``available`` of each of ``names``, compared by `to_name` and `fold_name`.

    Raises `NergError` naming ``what`` they are, such as "person", if one is not available.
    """
    wanted, stored = [to_name(name) for name in names], [to_name(name) for name in available]
    indices = [find_name(name, stored) for name in wanted]
    if unknown := [name for name, k in zip(wanted, indices) if k is None]:
        shown = ", ".join(sanitize(name, 40) for name in available[:20]) + (", ..." if len(available) > 20 else "")
        raise NergError(
            f"no {what} is called {', '.join(repr(sanitize(name, 40)) for name in unknown)}; there are {shown}"
        )
    return [k for k in indices if k is not None]


# ---- Paths ----

FilePath: TypeAlias = str | Path


def to_path(path: str | os.PathLike) -> Path:
    """Return ``path`` as a `Path`. Raises `NergError` for anything but a string or a path."""
    try:
        return Path(path)
    except TypeError as error:
        raise NergError(f"a file must be given as a string or a path, got {type(path).__name__}") from error


def hash_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 (hex) of arrays by name."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
