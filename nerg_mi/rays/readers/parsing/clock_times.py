"""Times of day, and dates with one, as text: ISO 8601 and what is close to it."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable

import numpy as np

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
