"""``nerg import``: fields that other programs have trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    file: Annotated[Path, typer.Argument(help="Checkpoint (.pth) of torch-ngp, or of the NeRG paper's authors.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Radiance field to write (.safetensors).")
    ] = None,
    gaze: Annotated[Path | None, typer.Option("-g", "--gaze", help="Gaze field to write (.safetensors).")] = None,
    ema: Annotated[
        bool | None,
        typer.Option(
            "--ema/--no-ema",
            help="Moving averages of the weights, or the weights.  [default: averages, if there are any]",
        ),
    ] = None,
    color_space: Annotated[str, typer.Option(help="What --color_space was in training: srgb or linear.")] = "srgb",
    bg_radius: Annotated[
        float | None,
        typer.Option(help="What --bg_radius was in training, where there is a background network; 0: leave it out."),
    ] = None,
    finest: Annotated[
        int | None, typer.Option(help="Finest resolution of the hash grid.  [default: 2048 x bound]")
    ] = None,
    half: Annotated[bool, typer.Option("--half", help="Store the weights in fp16.")] = False,
    variant: Annotated[str, typer.Option(help="Mitsuba variant.")] = "llvm_ad_rgb",
) -> None:
    """Convert a checkpoint to the fields of the volumes `nerf` and `gazefield`. Nothing in the file is run."""
    from nerg_mi.errors import NergError
    from nerg_mi.field.backend import namespace
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.formats.fields import save_gaze, save_radiance
    from nerg_mi.formats.torch_ngp.fields import Given, read_torch_ngp
    from nerg_mi.formats.torch_ngp.nerg import is_nerg, read_nerg
    from nerg_mi.formats.torch_ngp.state_dict import open_checkpoint
    from nerg_mi.rendering.pictures import activate

    if output is None and gaze is None:
        raise NergError("nothing is asked for: give -o FIELD.safetensors, --gaze GAZE.safetensors, or both.")
    for path in (output, gaze):
        if path is not None:
            check_writable(path, ".safetensors")
    given = Given(color_space, finest, bg_radius)
    ns = namespace(activate(variant))
    if is_nerg(open_checkpoint(file)[1]):
        field, attention, origin = read_nerg(file, ns, ema, given)
        if output is not None and field is None:
            raise NergError(f'"{file}" holds a gaze field without its NeRF: import that from its own file.')
    else:
        if gaze is not None:
            raise NergError(f'"{file}" holds no gaze field: leave out --gaze.')
        (field, origin), attention = read_torch_ngp(file, ns, ema, given), None
    if output is not None:
        save_radiance(field, output, origin, half)
        typer.echo(_about(field, origin))
        _wrote(output)
    if gaze is not None:
        save_gaze(attention, gaze, origin, half)
        typer.echo(
            f"gaze: {attention.config.variant}, trunk {attention.config.trunk}, bound {attention.box.side / 2:g}"
        )
        _wrote(gaze)
    elif attention is not None:
        typer.echo(f'"{file}" also holds a gaze field: --gaze NAME.safetensors writes it')


def _about(field, origin: dict) -> str:
    cells = "no occupancy grid (marching evaluates all of space)"
    if field.occupancy is not None:
        cells = f"{100 * field.occupancy.fraction:.1f} % of its box occupied"
    behind = "" if field.background is None else f", background of radius {field.background.config.radius:g}"
    return f"radiance: bound {field.box.side / 2:g}, {origin['weights']} weights, {cells}{behind}"


def _wrote(path: Path) -> None:
    typer.echo(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
