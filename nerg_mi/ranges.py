"""Ranges of numbers, declared where a value is declared and checked by one function wherever it enters."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from .errors import NergError, sanitize

RANGE, FLAG = "nerg_mi.range", "nerg_mi.flag"
"""Keys in the metadata of a dataclass's field: the `Range` of its value, and its spelling on the command line, "" for
that of its name; without one, it is none of the command line."""

CHANGES_RESULT = "nerg_mi.changes_result"
"""Key in the same metadata: False for a field that says where or by whom something is computed, never what."""


@dataclass(frozen=True)
class Range:
    """The numbers from ``low`` to ``high``, both included. Both are finite, so that neither NaN nor infinity is in."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return " .. ".join(str(v) if isinstance(v, int) else f"{v:g}" for v in (self.low, self.high))


MAX_COORDINATE = 1e7
"""No coordinate is farther from 0, in scene units or metres. Single precision, in which rays are traced, resolves about
one unit there; a room in millimetres and UTM coordinates in metres are nearer."""

COORDINATES = Range(-MAX_COORDINATE, MAX_COORDINATE)
SEEDS = Range(0, 2**31 - 1)
BASE_SEEDS = Range(0, 2 * 10**9)
"""Seeds that others follow."""
THREADS = Range(1, 1024)
TIMES = Range(-1e20, 1e20)
"""Seconds on a clock of any origin."""
LENGTHS = Range(1e-6, 1e6)
"""Lengths that are not 0, and factors between units of length."""
KAPPAS = Range(1e-6, 1e8)
"""Concentrations of von Mises-Fisher kernels; beyond, single precision cannot resolve a kernel's width."""
POSITIVE_VALUES = Range(1e-30, 1e30)
"""Positive values, such as densities and the ends of colour scales, whose products single precision can hold."""
TEST_FRACTIONS = Range(0, 0.99)
"""Shares held out, of which something is left to train on."""
SECONDS = Range(0, 1e9)
MINUTES = Range(1e-6, 1e6)
STEPS = Range(1, 10**9)
RAYS = Range(1, 2**31 - 1)
LOSS_WEIGHTS = Range(0, 1e6)
DIRECTIONS = Range(16, 1 << 20)
SPP = Range(1, 1 << 24)
"""Samples a pixel."""
LOG_DECADES = Range(0, 30)
"""Powers of ten of a colour scale."""
RATES = Range(1e-3, 1e5)
"""Pictures, or samples, a second."""
FIELDS_OF_VIEW = Range(1e-4, 179.9)
ELEVATIONS = Range(-90, 90)
"""Degrees above and below the horizon."""
TIME_UNITS = Range(1e-12, 1e12)
"""Seconds in a unit of time."""
LEARNING_RATES = Range(0, 1)
WEIGHT_DECAYS = Range(0, 1000)


def check_number(value: Any, allowed: Range, name: str, is_integer: bool = False) -> None:
    """Raise `NergError`, which calls it ``name``, unless ``value`` is a number in a range, and an integer if it is to
    be ``whole``."""
    kind, noun = (Integral, "a whole number") if is_integer else (Real, "a number")
    if isinstance(value, bool) or not isinstance(value, kind):
        raise NergError(f"{name} must be {noun}, got {sanitize(repr(value), 60)}")
    number: Any = value
    if number not in allowed:
        raise NergError(f"{name} must lie in {allowed}, got {_shown(value)}")


def range_field(default: Any, allowed: Range) -> Any:
    """A field of a `Checked` dataclass whose numbers lie ``within`` a range."""
    return dataclasses.field(default=default, metadata={RANGE: allowed})


def setting(default: Any, help: str, *names: str, allowed: Range | None = None, option: str = "") -> Any:
    """A field of a dataclass of settings, a `Checked` one, that is an option of what uses these settings, too.

    Parameters
    ----------
    default
        Its value where none is set.
    help
        What it means, in one line.
    names
        How the command line spells it, where that is not ``--`` and the option's name.
    within
        The range of its numbers.
    option
        The option's name, where that is not the field's.
    """
    return dataclasses.field(default=default, metadata={RANGE: allowed, "help": help, "names": names, "option": option})


class ValidatedDataclass:
    """Base of dataclasses that check their numbers on construction.

    A field with a `Range` in its metadata holds a number in it, or several of them; None where its type allows that.
    Raises `NergError` for others.
    """

    def __post_init__(self) -> None:
        assert dataclasses.is_dataclass(self)
        for field in dataclasses.fields(self):
            within, kind = field.metadata.get(RANGE), str(field.type)
            value: Any = getattr(self, field.name)
            if within is None or (value is None and "None" in kind):
                continue
            numbers = (value,)
            if "tuple" in kind:
                if not isinstance(value, Iterable):
                    raise NergError(f"{_name(field)} must be several numbers, got {sanitize(repr(value), 60)}")
                numbers = tuple(value)
            for number in numbers:
                check_number(number, within, _name(field), bool(re.search(r"\bint\b", kind)))


def _name(field: dataclasses.Field) -> str:
    """What a message calls ``field``."""
    flag = field.metadata.get(FLAG)
    return field.name if flag is None else flag or "--" + field.name.replace("_", "-")


def _shown(value: Any) -> str:
    """``value`` in a few characters: an integer may have more digits than Python prints."""
    if isinstance(value, int) and abs(value) >= 10**20:
        return f"an integer of {int(math.log10(abs(value))) + 1} digits"
    return str(value)
