"""Typed options of a reader: fields of a frozen dataclass, from which the command line and the manual are made."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.ranges import FLAG, RANGE, TICKS, Checked, Range

_KEY = "nerg_mi.reader_option"


@dataclass(frozen=True)
class Option:
    """One option of a reader, as :func:`options_of` finds it."""

    name: str  # of the dataclass's field
    flag: str  # on the command line: --tick
    kind: type  # of the value, without None: str, float, int, bool, Path; str where `parse` makes the value
    default: Any  # of the field
    shown: str  # the default in words; empty where there is none to speak of
    help: str  # a sentence, units included
    parse: Callable[[str], Any] | None  # from the command line's text to the value
    recorded: bool  # whether a value goes into the metadata of rays under its name


def option(
    default: Any,
    help: str,
    *,
    flag: str | None = None,
    shown: str | None = None,
    within: Range | None = None,
    parse: Callable[[str], Any] | None = None,
    recorded: bool = True,
) -> Any:
    """A field of a reader's options, with what is said of it on the command line and in the manual.

    ``flag``: on the command line, where that is not the field's name with hyphens. ``shown``: the default in words,
    where it does not speak for itself. ``within``: the range of its numbers, which each option that has any needs, and
    for which the dataclass derives from `Checked`. ``parse``: makes the value of the command line's text, and raises
    `NergError` naming the flag; without it the field's type is that of the command line (str, int, float, bool or Path,
    or None besides). ``recorded``: false for what the metadata of rays tell in another way, as the frame.
    """
    about = {"help": help, "flag": flag, "shown": shown, "parse": parse, "recorded": recorded}
    return dataclasses.field(default=default, metadata={_KEY: about, RANGE: within, FLAG: flag or ""})


def tick_option(default: float = 1.0) -> Any:
    """The unit of the file's time, in seconds."""
    return option(default, "Seconds in one unit of the file's time.", within=TICKS)


def valid_option() -> Any:
    """Which values of columns of validity mark valid rows; to be parsed by `parse_valid`."""
    return option(
        None,
        'Columns of validity and the values of rows that are kept, as "gaze_status=2" or "isValid=true,1"; '
        "none: no column is one.",
    )


@dataclass(frozen=True, kw_only=True)
class NoOptions:
    """The options of a reader that has none."""


@dataclass(frozen=True, kw_only=True)
class TickOption(Checked):
    """For readers of files whose unit of time is not known. Raises `NergError` for what is no length of time."""

    tick: float = tick_option()


# Annotations are evaluated as code: once, when a reader is registered, and not beside files that are read.
@functools.cache
def options_of(kind: type) -> tuple[Option, ...]:
    """The options of a dataclass, in the order of its fields.

    Raises ``TypeError`` for one that is no frozen dataclass, or a field that was not made by :func:`option`.
    """
    if not dataclasses.is_dataclass(kind):
        raise TypeError(f"{kind.__qualname__} is no dataclass; options of a reader are a frozen one")
    hints = typing.get_type_hints(kind)
    found = []
    for field in dataclasses.fields(kind):
        if _KEY not in field.metadata:
            raise TypeError(f"{kind.__qualname__}.{field.name} says nothing of itself; make it with option(...)")
        about = field.metadata[_KEY]
        shown = about["shown"]
        if shown is None:
            shown = "" if field.default is None or isinstance(field.default, bool) else _number(field.default)
        found.append(
            Option(
                name=field.name,
                flag=about["flag"] or "--" + field.name.replace("_", "-"),
                kind=str if about["parse"] else _without_none(hints[field.name]),
                default=field.default,
                shown=shown,
                help=about["help"],
                parse=about["parse"],
                recorded=about["recorded"],
            )
        )
    return tuple(found)


def recorded_options(options: Any) -> dict[str, Any]:
    """The values that go into the metadata of rays: those that are set, tuples as lists. Files are kept there as
    sources, when a reader begins them."""
    known = [o for o in options_of(type(options)) if o.recorded and o.kind is not Path]
    values = {o.name: getattr(options, o.name) for o in known}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items() if v is not None}


def _without_none(hint: Any) -> type:
    """``float`` of ``float | None``."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
    return hint


def _number(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
