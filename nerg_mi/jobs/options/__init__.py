"""Typed options of jobs: for each job a dataclass, frozen and of keywords alone, that imports nothing heavy.

A field tells its meaning once, by ``option``: a notebook reads it here, and the command makes its option of it
(``nerg_mi.cli.options``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Any

from nerg_mi.errors import NergError


def option(default: Any, help: str, *names: str, parse: Callable[[str, str], Any] | None = None, **more: Any) -> Any:
    """A field of a dataclass of options.

    ``default``: its value where none is given; ``help``: what it means, in one line. ``names``: how the command spells
    it ("-s", "--seed"), where that is not ``--`` and the field's name; ``parse(text, flag)``: its value from a word of
    the command line, where the type alone does not tell; ``more``: what else ``typer.Option`` takes, such as ``min``.
    """
    return field(default=default, metadata={"help": help, "names": names, "parse": parse, "more": more})


def parse_numbers(text: str, flag: str) -> tuple[float, ...]:
    """Numbers with commas, or spaces, between them. Raises `NergError` naming ``flag`` for other texts."""
    try:
        return tuple(float(v) for v in (text.split(",") if "," in text or not text else text.split()))
    except ValueError:
        raise NergError(f"{flag} is numbers with commas between them, got {text!r}") from None
