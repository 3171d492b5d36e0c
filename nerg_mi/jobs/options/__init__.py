"""Typed options of jobs: for each job a dataclass, frozen and of keywords alone.

A field tells its meaning once, by ``option``: a notebook reads it here, and the command makes its option of it
(``nerg_mi.cli.building``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import field, fields
from typing import Any, TypeVar

from nerg_mi.errors import NergError, plain
from nerg_mi.ranges import CHANGES_RESULT, COORDINATES, FLAG, RANGE, Range, check_number

Base = TypeVar("Base")
Class = TypeVar("Class", bound=type)


def option(
    default: Any,
    help: str,
    *names: str,
    within: Range | None = None,
    parse: Callable[[str, str], Any] | None = None,
    changes_result: bool = True,
    **more: Any,
) -> Any:
    """A field of a dataclass of options, which derives from `nerg_mi.ranges.Checked`.

    ``default``: its value where none is given; ``help``: what it means, in one line. ``names``: how the command spells
    it ("-s", "--seed"), where that is not ``--`` and the field's name; ``within``: the range of its numbers, which each
    option that has any needs; ``parse(text, flag)``: its value from a word of the command line, where the type alone
    does not tell; ``changes_result``: False for where, by whom or with how many threads something is computed, which
    must not change what comes of it: parts of a job are kept without it, and run with the default; ``more``:
    what else ``typer.Option`` takes, such as ``metavar``.
    """
    about = {"help": help, "names": names, "parse": parse, "more": more, CHANGES_RESULT: changes_result}
    return field(default=default, metadata={**about, RANGE: within, FLAG: names[-1] if names else ""})


def exposes(*kinds: type, default: str = "") -> Callable[[Class], Class]:
    """Decorator of a class, under ``dataclass``: gives it an option for each `nerg_mi.ranges.setting` of ``kinds``.

    Parameters
    ----------
    kinds
        Dataclasses of settings, for which `chosen_settings` reads the options again. A field that the class declares
        itself stays as it is.
    default
        Ends the help of options that are None until they are set, where something else decides. Without it an option
        has the default of its setting.
    """

    def decorate(kind: Class) -> Class:
        for setting in (f for settings in kinds for f in fields(settings) if "help" in f.metadata):
            about, name, hint = setting.metadata, setting.metadata["option"] or setting.name, str(setting.type)
            if name in kind.__annotations__:
                continue
            names, value = about["names"], setting.default
            if default:
                value, hint = None, f"{hint.removesuffix(' | None')} | None"
                if "bool" in hint:
                    flag = (names[-1] if names else f"--{name.replace('_', '-')}").removeprefix("--")
                    names = (f"--{flag}/--no-{flag}",)
            kind.__annotations__[name] = hint
            setattr(kind, name, option(value, f"{about['help']} {default}".rstrip(), *names, within=about[RANGE]))
        return kind

    return decorate


def chosen_settings(options: Any, kind: type) -> dict[str, Any]:
    """Keywords of the settings ``kind``, for those of its exposed fields that are set in ``options``."""
    exposed = {f.name: f.metadata["option"] or f.name for f in fields(kind) if "help" in f.metadata}
    values = {name: getattr(options, option) for name, option in exposed.items()}
    return {name: value for name, value in values.items() if value is not None}


def as_base(options: Any, kind: type[Base]) -> Base:
    """The fields of ``options`` that the dataclass ``kind`` has, of which theirs is derived: who is given it cannot
    depend on the others."""
    return kind(**{f.name: getattr(options, f.name) for f in fields(kind)})  # pyright: ignore[reportArgumentType]


def parse_point(text: str, flag: str) -> tuple[float, ...]:
    """Three coordinates with commas between them. Raises `NergError` naming ``flag`` for other texts."""
    numbers = parse_numbers(text, flag)
    if len(numbers) != 3:
        raise NergError(f"{flag} is three numbers x,y,z, got {plain(text, 60)!r}")
    for number in numbers:
        check_number(number, COORDINATES, flag)
    return numbers


def parse_numbers(text: str, flag: str) -> tuple[float, ...]:
    """Numbers with commas, or spaces, between them. Raises `NergError` naming ``flag`` for other texts."""
    try:
        return tuple(float(v) for v in (text.split(",") if "," in text or not text else text.split()))
    except ValueError:
        raise NergError(f"{flag} is numbers with commas between them, got {plain(text, 60)!r}") from None


def parse_definitions(pairs: Iterable[str], flag: str) -> dict[str, str]:
    """``["spp=4", "name=a=b"]`` as ``{"spp": "4", "name": "a=b"}``.

    Raises `NergError` for a pair without a key or without "=".
    """
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise NergError(f'"-D {pair}" is no definition: write -D key=value')
        values[key] = value
    return values


def definitions() -> Any:
    """The field ``defaults`` of options of what renders a scene: a mapping of texts, or None."""
    help = "Value for $KEY or a <default> of the scene; repeatable."
    return option(None, help, "-D", "--define", parse=parse_definitions, metavar="KEY=VALUE")
