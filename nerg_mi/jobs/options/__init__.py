"""Typed options of jobs: for each job a dataclass, frozen and of keywords alone, that imports nothing heavy.

A field tells its meaning once, by ``option``: a notebook reads it here, and the command makes its option of it
(``nerg_mi.cli.options``).
"""

from __future__ import annotations

from dataclasses import field
from typing import Any


def option(default: Any, help: str, *names: str, **more: Any) -> Any:
    """A field of a dataclass of options.

    ``default``: its value where none is given; ``help``: what it means, in one line. ``names``: how the command spells
    it ("-s", "--seed"), where that is not ``--`` and the field's name; ``more``: what else ``typer.Option`` takes, such
    as ``min``.
    """
    return field(default=default, metadata={"help": help, "names": names, "more": more})
