"""The former name of the option that names the Mitsuba variant, which is --mode for every command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

OldMode = Annotated[str | None, typer.Option("--variant", hidden=True, help="Former name of --mode.")]
"""For commands whose --mode was called --variant, which means the factors of a gaze field elsewhere."""


def mode_of(mode: str, variant: str | None) -> str:
    """The Mitsuba variant that was asked for by ``--mode``, or by its former name ``--variant``, which is told so."""
    if variant is None:
        return mode
    print(f"note: --variant is now --mode (-m) here: write --mode {variant}.", file=sys.stderr)
    return variant
