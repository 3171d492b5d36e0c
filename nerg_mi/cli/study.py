"""`nerg study`: the command line of `nerg_mi.jobs.study`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .defines import Defines, parse_defines
from .mode import BestMode
from .progress import TerminalReporter


def command(
    scene: Annotated[str, typer.Argument(help="Scene file (.xml), or slab, sphere, sheets, fog or ramp.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; it is made.")],
    scene_kind: Annotated[str, typer.Option(help="What SCENE is: auto, analytic or file.")] = "auto",
    width: Annotated[int, typer.Option(help="Width of a picture in pixels.")] = 192,
    height: Annotated[int, typer.Option(help="Height of a picture in pixels.")] = 128,
    repeats: Annotated[int, typer.Option(help="Timed renders of each setting; their median counts.")] = 5,
    quick: Annotated[bool, typer.Option("--quick", help="A few settings only, each timed once.")] = False,
    only: Annotated[str, typer.Option(metavar="REGEX", help="Only the default, and settings whose name matches.")] = "",
    define: Defines = None,
    mode: BestMode = None,
) -> None:
    """Measure error against run time: render a scene at many settings, compare each with what is true, and plot it.

    Writes study.csv (a row a setting), study.md (the same by factor), scaling.csv, study.json and two plots. A full
    study takes up to half an hour.
    """
    defaults = parse_defines(define)
    from nerg_mi.jobs import study

    options = study.StudyOptions(
        scene_kind=scene_kind,
        width=width,
        height=height,
        repeats=repeats,
        quick=quick,
        only=only,
        defaults=defaults,
        mode=mode,
    )
    with TerminalReporter() as reporter:
        study.run_study(scene, out, options, reporter)
