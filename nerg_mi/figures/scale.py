"""Ticks of a scale: round values, written so that they are short however small or large they are."""

from __future__ import annotations

import math

_SUPER = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def ticks_of(low: float, high: float, most: int, log: bool = False) -> tuple[list[float], list[str], str]:
    """``(places, names, factor)``: where ticks stand on a scale from 0 (``low``) to 1 (``high``), what is written
    there, and what belongs before the unit, such as "10⁻⁶" of values that are so small. About ``most`` of them;
    ``log``: at powers of ten of a logarithmic scale."""
    from matplotlib.ticker import MaxNLocator

    if log:
        first, last = math.log10(low), math.log10(high)
        step = max(1, math.ceil((last - first) / most))
        powers = [p for p in range(math.ceil(first - 1e-9), math.floor(last + 1e-9) + 1) if p % step == 0]
        if len(powers) >= 2:
            return [(p - first) / (last - first) for p in powers], [_power(p) for p in powers], ""
        ends = [low, math.sqrt(low * high), high]
        return [0.0, 0.5, 1.0], [f"{v:.2g}" for v in ends], ""
    most_of_all = max(abs(low), abs(high))
    power = math.floor(math.log10(most_of_all)) if most_of_all > 0 else 0
    power = 0 if -3 <= power < 4 else power
    unit = 10.0**power
    found = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low / unit, high / unit)
    edge = 1e-9 * (high - low) / unit
    values = [v for v in found if low / unit - edge <= v <= high / unit + edge]
    span = (high - low) / unit
    gap = min((b - a for a, b in zip(values, values[1:])), default=span)
    # As many digits as tell neighbours apart.
    digits = max(0, -math.floor(math.log10(gap) + 1e-9)) if gap > 0 else 0
    if gap > 0 and abs(round(gap, digits) - gap) > 1e-6 * gap:
        digits += 1
    names = [f"{0.0 if abs(v) < 1e-12 * span else v:.{digits}f}".replace("-", "−") for v in values]
    return [(v - low / unit) / span for v in values], names, "" if power == 0 else _power(power)


def _power(p: int) -> str:
    return {0: "1", 1: "10"}.get(p, "10" + str(p).translate(_SUPER))
