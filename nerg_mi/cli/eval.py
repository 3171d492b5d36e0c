"""``nerg eval``: how good a trained field is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError

from .eval_gaze import eval_gaze

app = typer.Typer(no_args_is_help=True, help="Score trained fields.")


@app.callback()
def _fields() -> None:
    """Score trained fields."""


app.command("gaze")(eval_gaze)


@app.command("radiance")
def eval_radiance(
    field: Annotated[Path, typer.Argument(help="Checkpoint of a radiance field (.safetensors).")],
    dataset: Annotated[Path, typer.Argument(help="Posed image set with the views to compare with.")],
    holdout: Annotated[
        int | None, typer.Option(help="As it was trained with. Default: transforms_test.json, else 8.")
    ] = None,
    train: Annotated[bool, typer.Option("--train", help="Score the training views instead.")] = False,
    width: Annotated[int | None, typer.Option(help="Width of the pictures. Default: as it was trained.")] = None,
    scale: Annotated[float, typer.Option(help="As it was trained with.")] = 1.0,
    coordinates: Annotated[str, typer.Option(help="As it was trained with.")] = "file",
    allow_outside: Annotated[
        bool,
        typer.Option("--allow-outside", help="Read files outside of the data set's folder too, where it names them."),
    ] = False,
    spp: Annotated[int, typer.Option(min=1, help="Rays a pixel. The scatter of few is part of the score.")] = 16,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the pictures. Default: FIELD.eval")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the scores to this file.")] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads. Default: all.")] = None,
    variant: Annotated[str, typer.Option(help="Mitsuba variant.")] = "llvm_ad_rgb",
) -> None:
    """PSNR and SSIM on held-out views, and the error of depth where it is known, rendered by the integrator."""
    import drjit as dr

    from nerg_mi.capture.dataset import open_dataset
    from nerg_mi.evaluation.images import score_views
    from nerg_mi.files.atomic import check_folder, check_writable
    from nerg_mi.files.tables import write_json
    from nerg_mi.formats.checkpoint import read_checkpoint
    from nerg_mi.rendering.pictures import activate

    output = output or field.with_suffix(".eval")
    check_folder(output)
    if json_file is not None:
        check_writable(json_file)
    activate(variant)
    if threads is not None:
        dr.set_thread_count(threads)
    about = read_checkpoint(field, "radiance")[1].get("provenance", {})
    trained_width = about.get("width") if isinstance(about.get("width"), int) else None
    data = open_dataset(dataset, holdout, width or trained_width, None, None, True, scale, coordinates, allow_outside)
    held_out = about.get("held_out")
    trained = held_out.get("frames") if isinstance(held_out, dict) else None
    if not train and trained is not None and about.get("sha256") == data.source["sha256"]:
        seen = sorted({v.name for v in data.held_out} - set(trained))
        if seen:
            raise NergError(
                f'"{field}" was trained on {seen[0]} and {len(seen) - 1} other of the views that would be scored; '
                "give --holdout as it was trained with"
            )
    views = data.train if train else data.held_out
    typer.echo(f"{'view':32s} {'PSNR dB':>8s} {'SSIM':>7s}")
    show = lambda name, psnr, ssim: typer.echo(f"{name[-32:]:32s} {psnr:8.2f} {ssim:7.4f}")
    scores = score_views(field, views, spp, output, show)
    show("mean", scores["psnr_mean"], scores["ssim_mean"])
    if "depth" in scores:
        d = scores["depth"]
        typer.echo(
            f"depth: median error {d['median']:.4f} units, {d['off']:.1%} of the pixels off by more than 10 %; "
            f"opacity {d['opacity']:.3f}, {d['translucent']:.1%} of the pixels below 0.9"
        )
    typer.echo(f"wrote {len(views)} pictures to {output}")
    if json_file is not None:
        write_json(json_file, {"field": field.name, "dataset": data.source["dataset"], **scores})
        typer.echo(f"wrote {json_file}")
