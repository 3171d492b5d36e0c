"""Ranges of numeric values: declared with a field or option, and validated by one function."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from types import SimpleNamespace
from typing import Any, TypeVar, cast, get_args, get_type_hints

from nerg_mi.errors import NergError, parameter, sanitize

RANGE, IS_OPTION = "nerg_mi.range", "nerg_mi.is_option"
"""Keys in the metadata of a dataclass field: the `Range` of its value, and whether it is a command-line option of its
own, which messages spell as one."""

CHANGES_RESULT = "nerg_mi.changes_result"
"""Key in the same metadata: False for a field that affects where or how a result is computed, but not the result."""


@dataclass(frozen=True)
class Range:
    """The numbers from ``low`` to ``high``, both included. Both ends are finite, which excludes NaN and infinity."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return " .. ".join(str(v) if isinstance(v, int) else f"{v:g}" for v in (self.low, self.high))


MAX_COORDINATE = 1e7
"""Largest absolute coordinate, in scene units or metres. Rays are traced in single precision, which resolves about one
unit at this distance. A room in millimetres and UTM coordinates in metres are within the limit."""

COORDINATES = Range(-MAX_COORDINATE, MAX_COORDINATE)
SEEDS = Range(0, 2**31 - 1)
BASE_SEEDS = Range(0, 2 * 10**9)
"""Base seeds, from which further seeds are derived by addition."""
THREADS = Range(1, 1024)
TIMES = Range(-1e20, 1e20)
"""Timestamps in seconds; the origin of the clock is arbitrary."""
LENGTHS = Range(1e-6, 1e6)
"""Positive lengths, and conversion factors between units of length."""
KAPPAS = Range(1e-6, 1e8)
"""Concentrations of von Mises-Fisher kernels. Single precision cannot resolve the width of narrower kernels."""
POSITIVE_VALUES = Range(1e-30, 1e30)
"""Positive values, such as densities and the limits of colour scales, whose products fit into single precision."""
TEST_FRACTIONS = Range(0, 0.99)
"""Fractions of the data that are held out; at least 1 % remains for training."""
SECONDS = Range(0, 1e9)
MINUTES = Range(1e-6, 1e6)
STEPS = Range(1, 10**9)
RAYS = Range(1, 2**31 - 1)
LOSS_WEIGHTS = Range(0, 1e6)
DIRECTIONS = Range(16, 1 << 20)
SPP = Range(1, 1 << 24)
"""Samples per pixel."""
LOG_DECADES = Range(0, 30)
"""Powers of ten that a logarithmic colour scale spans."""
RATES = Range(1e-3, 1e5)
"""Frames or samples per second."""
FIELDS_OF_VIEW = Range(1e-4, 179.9)
ELEVATIONS = Range(-90, 90)
"""Elevation angles in degrees; 0 is the horizon."""
TIME_UNITS = Range(1e-12, 1e12)
"""Duration of one unit of time, in seconds."""
LEARNING_RATES = Range(0, 1)
WEIGHT_DECAYS = Range(0, 1000)


def parse_kappa(value: str, name: str) -> float:
    """Return the concentration of a kernel from text: a number, or a standard deviation in degrees such as "4deg".

    For the von Mises-Fisher kernel of concentration kappa, the standard deviation along each axis is 1 / sqrt(kappa)
    radians, to 3 % for less than 20 degrees.

    Parameters
    ----------
    value
        The text.
    name
        Name of the value in the error message.

    Raises
    ------
    NergError
        If the text is neither, or the angle is not positive.
    """
    number, is_angle = value.strip().removesuffix("deg"), value.strip().endswith("deg")
    try:
        kappa = float(number)
        return math.degrees(1.0 / kappa) * math.degrees(1.0 / kappa) if is_angle else kappa
    except (ValueError, ZeroDivisionError):
        raise NergError(
            f'{name} must be a number, or a standard deviation in degrees such as "4deg", got {sanitize(value, 60)}'
        ) from None


def check_number(value: Any, allowed: Range, name: str, is_integer: bool = False) -> None:
    """Raise `NergError` unless ``value`` is a number in the range ``allowed``.

    Parameters
    ----------
    value
        The value to check.
    allowed
        The valid range.
    name
        Name of the value in the error message.
    is_integer
        Whether the value must be an integer.
    """
    number_type, noun = (Integral, "a whole number") if is_integer else (Real, "a number")
    # Durations of NumPy are registered as integers, of any unit.
    is_duration = type(value).__name__ == "timedelta64"
    if isinstance(value, bool) or is_duration or not isinstance(value, number_type):
        raise NergError(f"{name} must be {noun}, got {sanitize(repr(value), 60)}")
    numeric: Any = value
    if numeric not in allowed:
        raise NergError(f"{name} must lie in {allowed}, got {_format_value(value)}")


def range_field(default: Any, allowed: Range) -> Any:
    """Declare a field of a `ValidatedDataclass` whose numbers must be in the range ``allowed``."""
    return dataclasses.field(default=default, metadata={RANGE: allowed})


def setting(default: Any, help: str, allowed: Range | None = None, *, changes_result: bool = True) -> Any:
    """Declare a field of a settings dataclass (a `ValidatedDataclass`) that is also a command-line option.

    Parameters
    ----------
    default
        Default value.
    help
        One-line description of the value.
    allowed
        Range of the number.
    changes_result
        False for a setting that affects where or how a result is computed, but not the result (`CHANGES_RESULT`).
    """
    metadata = {RANGE: allowed, "help": help, CHANGES_RESULT: changes_result}
    return dataclasses.field(default=default, metadata=metadata)


def check_text(value: Any, annotation: Any, name: str) -> None:
    """Raise `NergError`, which calls the value ``name``, unless it is text if ``annotation`` is that of text, several
    texts (or numbers of participants), a sequence if it is that of one, and a mapping of texts if it is that of one,
    whose texts may be given as numbers."""
    is_sequence = isinstance(value, Iterable) and not isinstance(value, (str, bytes))
    if annotation in ("str", "str | None"):
        if not isinstance(value, str) and (value is not None or annotation == "str"):
            raise NergError(f"{name} must be text, got {sanitize(repr(value), 60)}; pass a string")
    elif annotation == "Sequence[str]" or annotation == "tuple[str, ...]":
        is_text = annotation == "Sequence[str]" or (
            isinstance(value, (list, tuple)) and all(isinstance(text, str) for text in value)
        )
        if not (is_sequence and is_text):
            raise NergError(f"{name} must be texts, got {sanitize(repr(value), 60)}; pass a list of strings")
    elif "Annotated[Sequence[" in str(annotation) and value is not None and not is_sequence:
        raise NergError(f"{name} must be numbers, got {sanitize(repr(value), 60)}; pass a list of numbers")
    elif str(annotation).startswith("Mapping[str, str") and value is not None:
        kinds = (str, Real) if "Mapping[str, str]" in annotation else object
        items = value.items() if isinstance(value, Mapping) else [(None, None)]
        if not all(isinstance(key, str) and isinstance(text, kinds) for key, text in items):
            raise NergError(f"{name} must map names to values, got {sanitize(repr(value), 60)}; pass a dict")


Function = TypeVar("Function", bound=Callable[..., Any])


def check_ranges(function: Function) -> Function:
    """Decorator: check annotated parameters, as ``Annotated[float, LENGTHS]``, ``Annotated[Sequence[float], LENGTHS]``
    or ``Literal[...]``, before ``function`` runs.

    A concentration (`KAPPAS`) may be text with an angle (`parse_kappa`).
    """
    signature = inspect.signature(function)
    choices = find_choices(function)

    @functools.wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        try:
            bound = signature.bind(*args, **keywords)
        except TypeError as error:
            # As Python says it where a function is called directly.
            raise TypeError(f"{function.__qualname__}() {error}") from None
        for name, value in bound.arguments.items():
            check_text(value, function.__annotations__.get(name), parameter(name))
        for name, allowed in find_ranges(function).items():
            value = bound.arguments.get(name)
            if allowed is KAPPAS and isinstance(value, str):
                bound.arguments[name] = parse_kappa(value, parameter(name))
            elif value is not None or (name in bound.arguments and "None" not in function.__annotations__[name]):
                annotation = function.__annotations__[name]
                for number in cast("Iterable[Any]", value) if "Sequence[" in annotation else (value,):
                    check_number(number, allowed, parameter(name), "[int," in annotation)
        for name, allowed in choices.items():
            if (value := bound.arguments.get(name, allowed[0])) not in allowed:
                names = " or ".join(f'"{choice}"' for choice in allowed if choice is not None)
                raise NergError(f"{parameter(name)} must be {names}, got {sanitize(repr(value), 60)}")
        return function(*bound.args, **bound.kwargs)

    return cast("Function", call)


def find_ranges(function: Callable[..., Any]) -> dict[str, Range]:
    """Return the ranges of the parameters of ``function``, by name."""
    annotated = {name: text for name, text in function.__annotations__.items() if "Annotated[" in text}
    # Annotations of objects that are imported for type checkers only cannot be evaluated.
    hints = get_type_hints(
        SimpleNamespace(__annotations__=annotated), inspect.unwrap(function).__globals__, include_extras=True
    )
    ranges = {}
    for name, hint in hints.items():
        notes = [note for part in (hint, *get_args(hint)) for note in getattr(part, "__metadata__", ())]
        ranges[name] = next(note for note in notes if isinstance(note, Range))
    return ranges


def find_choices(function: Callable[..., Any]) -> dict[str, tuple[str | None, ...]]:
    """Return the values of parameters of ``function`` that are annotated as ``Literal["a", "b"]`` or
    ``Literal["a", "b"] | None``, by name."""
    annotations = {k: text for k, text in function.__annotations__.items() if str(text).startswith("Literal[")}
    lists = {
        k: f"({text.removeprefix('Literal[').replace('] | None', ', None').rstrip(']')},)"
        for k, text in annotations.items()
    }
    return {name: ast.literal_eval(text) for name, text in lists.items()}


class ValidatedDataclass:
    """Base class of dataclasses that validate their numbers and texts on construction.

    A field that is annotated as text, or as a tuple of texts, holds these. A field with a `Range` in its metadata holds
    one number or several numbers in that range, or None if its type allows None. Other values raise `NergError`. A
    concentration (`KAPPAS`) may be text with an angle (`parse_kappa`).
    """

    def __post_init__(self) -> None:
        assert dataclasses.is_dataclass(self)
        for field in dataclasses.fields(self):
            allowed, annotation = field.metadata.get(RANGE), str(field.type)
            value: Any = getattr(self, field.name)
            check_text(value, annotation, _describe_field(field))
            if allowed is KAPPAS and isinstance(value, str):
                value = parse_kappa(value, _describe_field(field))
                object.__setattr__(self, field.name, value)
            if allowed is None or (value is None and "None" in annotation):
                continue
            numbers = (value,)
            if "tuple" in annotation:
                if not isinstance(value, Iterable):
                    raise NergError(
                        f"{_describe_field(field)} must be a sequence of numbers, got {sanitize(repr(value), 60)}"
                    )
                numbers = tuple(value)
            for number in numbers:
                check_number(number, allowed, _describe_field(field), bool(re.search(r"\bint\b", annotation)))


def _describe_field(field: dataclasses.Field) -> str:
    """Return the name of ``field`` in error messages."""
    return parameter(field.name) if field.metadata.get(IS_OPTION) else field.name


def _format_value(value: Any) -> str:
    """Return ``value`` as a short string; an integer may have more digits than Python prints."""
    if isinstance(value, int) and abs(value) >= 10**20:
        return f"an integer of {int(math.log10(abs(value))) + 1} digits"
    return str(value)
