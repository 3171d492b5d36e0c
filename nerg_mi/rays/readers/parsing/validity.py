"""Columns that say whether the gaze of a row is valid: how they are named, and what their values mean."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain

from .column_finder import column_words

# Of the gaze as a whole, as one word: isvalid, gazevalidity, combinedgazestatus. Those of one eye are none.
_OF_GAZE = re.compile(
    r"(is|has|was)?(gaze|eyes?|combined|tracking|tracker|ray|data|sample)*(is|has|was)?"
    r"(valid(ity)?|status|tracked|trackingstate)(flag|code)?|(is|has)?valid(gaze|eyes?|data|sample)|"
    r"(is)?(gaze|eye)trackingenabledandvalid"
)
# Words of names that may say so, too.
_MAY_BE = {"detected", "available", "found", "lost", "missing", "dropout", "blink", "blinking", "worn", "tracked"}
_VALID = ("valid", "true", "tracked", "tracking", "ok", "yes")
_INVALID = (
    *("invalid", "false", "lost", "untracked", "nottracked", "nottracking", "notvalid", "no", "none", "limited"),
    *("adjust", "calibrating", "unavailable", "missing", "error", "nan", "null", "na", ""),
)
_VARJO = {0, 1, 2}  # invalid, being calibrated, valid
_SHOWN = 6


def is_validity(column: str) -> bool:
    """Whether the name of a column says that it holds the validity of the gaze."""
    return bool(_OF_GAZE.fullmatch(column_words(column).replace("_", "")))


def looks_like_validity(column: str) -> bool:
    """Whether a name may be that of a validity of any kind, such as ``left_eye_validity``."""
    return "valid" in column.lower() or is_validity(column) or not _MAY_BE.isdisjoint(column_words(column).split("_"))


def valid_values(column: str, values: Iterable[str]) -> list[str] | None:
    """Those of the ``values`` of a column of validity that mark a valid row; None where one of them has no meaning that
    is certain.

    Words speak for themselves. A code of 1 beside 0 is "true", unless the column is a status, whose codes are the
    device's. The status of the gaze with codes to 2 is Varjo's: 0 invalid, 1 being calibrated, 2 valid.
    """
    words = {value: re.sub(r"[^a-z0-9.]", "", value.lower()) for value in values}
    codes = {value: float(value) for value in words if re.fullmatch(r"\s*[+-]?\d{1,9}(\.0*)?\s*", value)}
    name = column_words(column).replace("_", "")
    is_status = name.endswith(("status", "state", "code"))
    if is_status and "gaze" in name and 2 in codes.values() and set(codes.values()) <= _VARJO:
        valid_code = 2
    elif not is_status and set(codes.values()) <= {0, 1}:
        valid_code = 1
    elif codes:
        return None
    else:
        valid_code = -1
    if any(word not in _VALID + _INVALID for value, word in words.items() if value not in codes):
        return None
    return [value for value, word in words.items() if word in _VALID or codes.get(value) == valid_code]


def require_valid_values(source: str, column: str, counts: Mapping[str, int]) -> list[str]:
    """As `valid_values`; raises `NergError` naming the values, which occur ``counts`` times, where one has no meaning
    that is certain."""
    valid = valid_values(column, counts)
    if valid is None:
        some = sorted(counts, key=lambda value: -counts[value])[:_SHOWN]
        shown = ", ".join(f"{plain(value, 20) or 'nothing'} ({counts[value]:,} rows)" for value in some)
        more = f" and {len(counts) - _SHOWN} more" if len(counts) > _SHOWN else ""
        raise NergError(
            f"{source}: the column {plain(column, 40)!r} holds {shown}{more}, and nothing says which of them mark "
            f'valid rows; name those (--valid "{plain(column, 40)}=VALUE,VALUE"), or use no such column (--valid none)'
        )
    return valid


def mark_valid(cells: np.ndarray, values: Iterable[str]) -> np.ndarray:
    """Whether cells (n,) are one of the ``values``, (n,) bool; cases are one, and so are 2 and 2.0."""
    wanted = {_key(value) for value in values}
    different, where = np.unique(cells, return_inverse=True)
    return np.array([_key(cell) in wanted for cell in different.tolist()], bool)[where]


def _key(text: str) -> str:
    text = text.strip().lower()
    return text.partition(".")[0] if re.fullmatch(r"\d+\.0*", text) else text


def parse_valid(text: str | None) -> dict[str, tuple[str, ...]] | None:
    """Columns with the values of valid rows, of ``"gaze_status=2 isValid=true,1"``; none of ``none``; None without a
    text. Raises `NergError` for another text."""
    if text is None:
        return None
    import shlex

    try:
        words = [] if text.strip().lower() == "none" else shlex.split(text)
        pairs = {name: tuple(v.strip() for v in values.split(",")) for name, values in (w.split("=", 1) for w in words)}
    except ValueError:
        pairs = {"": ()}
    if any(not name or not any(values) for name, values in pairs.items()) or (not pairs and "none" not in text.lower()):
        raise NergError(f'--valid is {plain(text, 60)!r}; it is COLUMN=VALUE,VALUE (several between spaces), or "none"')
    return pairs
