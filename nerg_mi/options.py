"""Options of commands: how an option is declared, how its text is parsed, and options that many commands have.

An option is a dataclass field that `option` creates; `nerg_mi.cli` makes them of the parameters of functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import field
from typing import Any

from nerg_mi.errors import NergError, sanitize
from nerg_mi.ranges import CHANGES_RESULT, COORDINATES, IS_OPTION, RANGE, THREADS, Range, check_number

MAIN, INPUT, VIEW, MODEL, TRAINING, TEST = "Main", "Input", "View", "Model", "Training", "Test"
ANALYSIS, OUTPUT, PERFORMANCE = "Analysis", "Output", "Performance"
GROUPS = (MAIN, INPUT, VIEW, MODEL, TRAINING, TEST, ANALYSIS, OUTPUT, PERFORMANCE)
"""Groups of options in the order in which help lists them; options without a group come last."""

PANEL = "rich_help_panel"
"""The parameter of ``typer.Option`` that holds the group."""


def option(
    default: Any,
    help: str,
    *names: str,
    within: Range | None = None,
    parse: Callable[[str, str], Any] | None = None,
    changes_result: bool = True,
    group: str = "",
    **more: Any,
) -> Any:
    """Create a field of a dataclass of options, which derives from `nerg_mi.ranges.ValidatedDataclass`.

    Parameters
    ----------
    default
        Value of the option if it is not given.
    help
        What the value is, its unit and its default, in a sentence.
    names
        Spellings on the command line ("-s", "--seed"). Without any it is ``--`` and the name of the field.
    within
        Range of the number. Each numeric option needs one.
    parse
        ``parse(text, flag)`` converts a word of the command line to the value, where the type is not enough.
    changes_result
        False for options that set where, by whom or with how many threads something is computed. They must not change
        the result: cached parts are identified without them, and computed with their defaults.
    group
        Heading under which help lists the option, one of `GROUPS`.
    more
        Further parameters of ``typer.Option``, such as ``metavar``.
    """
    metadata = {"help": help, "names": names, "parse": parse, "more": {**more, PANEL: group}}
    metadata |= {CHANGES_RESULT: changes_result, RANGE: within, IS_OPTION: True}
    return field(default=default, metadata=metadata)


def parse_point(text: str, flag: str) -> tuple[float, ...]:
    """Parse three comma-separated coordinates. Raises `NergError`, which names ``flag``, for any other text."""
    numbers = parse_numbers(text, flag)
    if len(numbers) != 3:
        raise NergError(f"{flag} must be three numbers x,y,z, got {sanitize(text, 60)!r}")
    for number in numbers:
        check_number(number, COORDINATES, flag)
    return numbers


def parse_numbers(text: str, flag: str) -> tuple[float, ...]:
    """Parse numbers separated by commas or spaces. Raises `NergError`, which names ``flag``, for any other text."""
    try:
        return tuple(float(v) for v in (text.split(",") if "," in text or not text else text.split()))
    except ValueError:
        raise NergError(f"{flag} must be comma-separated numbers, got {sanitize(text, 60)!r}") from None


def parse_definitions(pairs: Iterable[str], flag: str) -> dict[str, str]:
    """Parse ``["spp=4", "name=a=b"]`` into ``{"spp": "4", "name": "a=b"}``.

    Raises `NergError` for a pair without a key or without "=".
    """
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise NergError(f"{flag} {pair} is not a definition: write KEY=VALUE")
        values[key] = value
    return values


# ---- Options of many commands ----


def best_variant() -> Any:
    """Declare the field ``mode``: a Mitsuba variant, or None for the fastest that works."""
    help = "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]"
    return option(None, help, "-m", "--mode", group=PERFORMANCE)


def llvm_variant() -> Any:
    """Declare the field ``mode`` of commands that run on the CPU by default."""
    return option(
        "llvm_ad_rgb", "Mitsuba variant, such as llvm_ad_rgb or cuda_ad_rgb.", "-m", "--mode", group=PERFORMANCE
    )


def cpu_threads(note: str = "") -> Any:
    """Declare the field ``threads``; ``note`` is appended to its help."""
    help = f"Number of CPU threads{note}.  [default: all cores]"
    return option(None, help, within=THREADS, changes_result=False, group=PERFORMANCE)
