"""`nerg study`: the command line of `nerg_mi.jobs.study`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.study import StudyOptions

from .defines import Defines, parse_defines
from .options import takes
from .progress import TerminalReporter


@takes(StudyOptions, "defaults")
def study_command(
    scene: Annotated[str, typer.Argument(help="Scene file (.xml), or slab, sphere, sheets, fog or ramp.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; it is made.")],
    options: StudyOptions,
    define: Defines = None,
) -> None:
    """Measure error against run time: render a scene at many settings, compare each with what is true, and plot it.

    Writes study.csv (a row a setting), study.md (the same by factor), scaling.csv, study.json and two plots. A full
    study takes up to half an hour.
    """
    options = replace(options, defaults=parse_defines(define))
    from nerg_mi.jobs import study

    with TerminalReporter() as reporter:
        study.run_study(scene, out, options, reporter)
