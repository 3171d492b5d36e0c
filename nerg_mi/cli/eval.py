"""`nerg eval`: the command line of `nerg_mi.jobs.radiance`, and of the evaluations of gaze fields."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.radiance import RadianceScoreOptions

from .eval_folds import eval_folds
from .eval_gaze import eval_gaze
from .mode import OldMode, mode_of
from .options import takes
from .progress import TerminalReporter

eval_app = typer.Typer(no_args_is_help=True, help="Score trained fields.")
eval_app.command("gaze")(eval_gaze)
eval_app.command("folds")(eval_folds)


@eval_app.command("radiance")
@takes(RadianceScoreOptions)
def eval_radiance(
    field: Annotated[Path, typer.Argument(help="Checkpoint of a radiance field (.safetensors).")],
    dataset: Annotated[Path, typer.Argument(help="Posed image set with the views to compare with.")],
    options: RadianceScoreOptions,
    variant: OldMode = None,
) -> None:
    """PSNR and SSIM on held-out views, and the error of depth where it is known, rendered by the integrator.

    The pictures are written into FIELD.eval where no other folder is given.
    """
    from nerg_mi.jobs import radiance

    pictures = options.pictures or field.with_suffix(".eval")
    options = replace(options, pictures=pictures, mode=mode_of(options.mode, variant))
    with TerminalReporter() as reporter:
        radiance.evaluate_radiance(field, dataset, options, reporter)
