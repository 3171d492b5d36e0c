"""The option that names the Mitsuba variant, the same for every command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

Mode = Annotated[str, typer.Option("-m", "--mode", help="Mitsuba variant.")]
"""For what is computed on the CPU unless another variant is asked for."""

BestMode = Annotated[
    str | None,
    typer.Option("-m", "--mode", help="Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]"),
]
"""For what is rendered, on a GPU where there is one."""

OldMode = Annotated[str | None, typer.Option("--variant", hidden=True, help="Former name of --mode.")]
"""For commands whose --mode was called --variant, which means the factors of a gaze field elsewhere."""


def mode_of(mode: str, variant: str | None) -> str:
    """The Mitsuba variant that was asked for by ``--mode``, or by its former name ``--variant``, which is told so."""
    if variant is None:
        return mode
    print(f"note: --variant is now --mode (-m) here: write --mode {variant}.", file=sys.stderr)
    return variant
