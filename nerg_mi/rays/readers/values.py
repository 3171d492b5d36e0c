"""Values of cells: times of day and dates as text, and fill values where a program had nothing to write."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable

import numpy as np

# ---- Clock times ----
#
# Times of day, and dates with one, as text: ISO 8601 and what is close to it.


_CLOCK = re.compile(
    r"(?:(?:(?P<year>\d{4})[-/](?P<month>\d\d)[-/](?P<day>\d\d)|"
    r"(?P<day_>\d\d)\.(?P<month_>\d\d)\.(?P<year_>\d{4}))(?:T|,? +))?"
    r"(?P<hour>\d\d?):(?P<minute>\d\d):(?P<second>\d\d)(?:[.,](?P<fraction>\d+))?"
    r"(?: ?(?P<half>[AaPp])\.?[Mm]\.?)? ?(?P<zone>Z|(?P<sign>[+-])(?P<zone_hour>\d\d):?(?P<zone_minute>\d\d))?"
)
# ISO 8601's basic format; its time alone would be a number.
_BASIC = re.compile(r"(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)(?=\D|$)")
_EPOCH = datetime.date(1970, 1, 1).toordinal()


def clock_seconds(text: str) -> tuple[float, bool] | None:
    """Seconds of a time such as ``2024-05-01T12:00:00.25+02:00`` or ``12:00:00.25``, and whether it has a date.

    With a date they count from 1970 in UTC, as which a time without an offset is taken; else from midnight. None for
    any other text. Dates are year-month-day or day.month.year, and hours count to 24 or have AM or PM, so that no order
    has to be guessed.
    """
    match = _CLOCK.fullmatch(_BASIC.sub(r"\1-\2-\3T\4:\5:\6", text.strip()[:64]))
    if match is None:
        return None
    hour, minute, second = int(match["hour"]), int(match["minute"]), int(match["second"])
    if match["half"]:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + 12 * (match["half"] in "Pp")
    if hour > 23 or minute > 59 or second > 60:
        return None
    seconds = 3600.0 * hour + 60 * minute + second + (float(f"0.{match['fraction']}") if match["fraction"] else 0.0)
    if match["sign"]:
        offset = 3600 * int(match["zone_hour"]) + 60 * int(match["zone_minute"])
        seconds -= offset if match["sign"] == "+" else -offset
    year, month, day = (match[name] or match[f"{name}_"] for name in ("year", "month", "day"))
    if year is None:
        return seconds, False
    try:
        days = datetime.date(int(year), int(month), int(day)).toordinal() - _EPOCH
    except ValueError:
        return None
    return 86400.0 * days + seconds, True


_DAY = 86400.0
_PAUSE = 3600.0  # seconds between two times of one recording, at most, of which one is before midnight


class DayCounter:
    """Lets times of day without a date go on past midnight, block by block of one column.

    Midnight lies between two times of which the second is earlier, and within an hour of the first on the next day.
    Other steps back lead from one recording to another, as in a table of several participants, and steps forth of more
    than half a day to the day before. ``tick``: seconds of a unit; ``on_note(passes_midnight=True)`` is called where a
    block has times of another day.
    """

    def __init__(self, tick: float, on_note: Callable[..., None] | None = None) -> None:
        self.tick, self._on_note = tick, on_note
        self._last, self._day = np.nan, 0

    def unwrap(self, times: np.ndarray) -> np.ndarray:
        """Units since the first midnight, (n,), of units since the last one; NaN stays."""
        valid = np.isfinite(times)
        if not valid.any():
            return times
        steps = self.tick * np.diff(times[valid], prepend=self._last)
        days = self._day + np.cumsum((steps < _PAUSE - _DAY).astype(int) - (steps > _DAY / 2))
        days -= np.minimum(np.minimum.accumulate(days), 0)
        self._last, self._day = times[valid][-1], int(days[-1])
        if days.any() and self._on_note is not None:
            self._on_note(passes_midnight=True)
        out = times.copy()
        out[valid] += days * (_DAY / self.tick)
        return out


# ---- Fill values ----
#
# Vectors whose components are all one fill value, as 0, 0, 0 or -1, -1, -1 where a program had nothing to write.


_FILLS = np.array(
    [
        *(0.0, -1.0, *(sign * 10.0**k - sign for k in range(2, 7) for sign in (1, -1))),
        *(limit for bits in (16, 32) for limit in (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1, 2.0**bits - 1)),
    ]
)
_LIMIT = 1e30  # of floats that are lengths or directions; a fill beyond is the largest of its type, however rounded
_APART = 0.1  # metres between a fill value and the nearest place of a person who was never there
_AIMED = np.cos(np.radians(2.0))  # of a ray that points at its hit point


def fill_values(v: np.ndarray) -> np.ndarray:
    """The fill value of vectors (..., C), (...); NaN of those that are none."""
    first = v[..., 0]
    is_fill = np.isin(first, _FILLS) | (np.isfinite(first) & (np.abs(first) > _LIMIT))
    return np.where((v == v[..., :1]).all(axis=-1) & is_fill, first, np.nan)


def is_filled_angles(angles: np.ndarray) -> np.ndarray:
    """Whether angles (n, C) of a head or of gaze, in degrees or radians, are one fill value, (n,) bool; 0 and -1 may be
    true."""
    return np.abs(fill_values(angles)) > 90


def is_aimed(origin: np.ndarray, direction: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Whether rays (n, 3) point at their hit points, to 2 degrees, (n,) bool."""
    way = hit - origin
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", way, direction) / np.linalg.norm(way, axis=1) / np.linalg.norm(direction, axis=1)
    return cosine > _AIMED


class FilledOrigins:
    """Finds origins of one source that are fill values, block by block.

    A place at exactly 0, 0, 0 may be true: somebody sits there, or a track begins there. It is a fill value where it is
    repeated and the same person is otherwise never within 0.1 m of it. ``metre``: of a unit of length.
    """

    def __init__(self, metre: float) -> None:
        self._apart = _APART / metre
        self._last: dict[int, np.ndarray] = {}  # the last place of each person that is none
        self._count: dict[tuple[int, float], int] = {}
        self.undecided: dict[int, int] = {}
        """Rows of a person that were let through since no other place was known yet, and turned out to be filled."""

    def find(self, origin: np.ndarray, person: np.ndarray) -> np.ndarray:
        """Which rows (n,) bool are filled, of origins (n, 3) and numbers of persons (n,)."""
        fill = fill_values(origin)
        filled, out = np.isfinite(fill), np.zeros(len(fill), bool)
        good = np.flatnonzero(np.isfinite(origin).all(axis=1) & ~filled)
        if filled.any():
            order = np.argsort(person, kind="stable")
            codes, starts = np.unique(person[order], return_index=True)
            for code, rows in zip(codes.tolist(), np.split(order, starts[1:])):
                if filled[rows].any():
                    out[rows] = self._find_of(code, origin[rows], fill[rows])
        if len(good):
            codes, at = np.unique(person[good][::-1], return_index=True)
            self._last.update(zip(codes.tolist(), origin[good[::-1][at]]))
        return out

    def _find_of(self, code: int, origin: np.ndarray, fill: np.ndarray) -> np.ndarray:
        others = origin[np.isnan(fill) & np.isfinite(origin).all(axis=1)]
        if code in self._last:
            others = np.vstack([others, self._last[code]])
        out = np.zeros(len(fill), bool)
        for value in np.unique(fill[np.isfinite(fill)]).tolist():
            before = self._count.get((code, value), 0)
            count = self._count[code, value] = before + int(np.count_nonzero(fill == value))
            if len(others) and count > 1 and np.linalg.norm(others - value, axis=1).min() > self._apart:
                out |= fill == value
                if before and code not in self._last:
                    self.undecided[code] = before
        return out
