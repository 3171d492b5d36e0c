"""Times of day, and dates with one, as text: ISO 8601 and what is close to it."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable

import numpy as np

_CLOCK = re.compile(
    r"(?:(\d{4})[-/](\d\d)[-/](\d\d)(?:T| +))?(\d\d?):(\d\d):(\d\d)(?:[.,](\d+))? ?(Z|([+-])(\d\d):?(\d\d))?"
)
_EPOCH = datetime.date(1970, 1, 1).toordinal()


def clock_seconds(text: str) -> tuple[float, bool] | None:
    """Seconds of a time such as ``2024-05-01T12:00:00.25+02:00`` or ``12:00:00.25``, and whether it has a date.

    With a date they count from 1970 in UTC, as which a time without an offset is taken; else from midnight. None for
    any other text. The year stands first and hours count to 24, so that no order has to be guessed.
    """
    match = _CLOCK.fullmatch(text.strip()[:64])
    if match is None:
        return None
    year, month, day, hour, minute, second, fraction, zone, sign, zone_hour, zone_minute = match.groups()
    if int(hour) > 23 or int(minute) > 59 or int(second) > 60:
        return None
    seconds = 3600.0 * int(hour) + 60 * int(minute) + int(second) + (float(f"0.{fraction}") if fraction else 0.0)
    if zone and sign:
        seconds -= (1 if sign == "+" else -1) * (3600 * int(zone_hour) + 60 * int(zone_minute))
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
