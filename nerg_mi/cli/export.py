"""`nerg export`: the command line of `nerg_mi.jobs.export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .mode import Mode, OldMode, mode_of
from .progress import TerminalReporter

app = typer.Typer(no_args_is_help=True, help="Write a radiance field for other tools, in the field's own units.")

_Field = Annotated[Path, typer.Argument(help="Radiance field (.safetensors).")]
_Output = Annotated[Path, typer.Option("-o", "--output", help="File to write.")]
_Resolution = Annotated[
    int, typer.Option(min=2, max=2048, help="Lattice cells along the longest edge of the field's box.")
]
_Density = Annotated[
    float | None,
    typer.Option(
        "--density", help="Density, 1/unit, at which the surface lies.  [default: half of the light absorbed in a cell]"
    ),
]
_Up = Annotated[str, typer.Option(help="Up axis of the field, for .glb: z or y.")]


@app.command("mesh")
def export_mesh(
    field: _Field,
    output: _Output,
    resolution: _Resolution = 256,
    density: _Density = None,
    fill: Annotated[int, typer.Option(min=0, help="Close holes of up to twice so many cells; 0: none.")] = 1,
    keep: Annotated[
        float, typer.Option(min=0, max=1, help="Drop pieces with less than this share of the largest one's area.")
    ] = 0.001,
    unseen: Annotated[
        bool, typer.Option("--unseen", help="Keep the backs and insides that training never looked at.")
    ] = False,
    up: _Up = "z",
    mode: Mode = "llvm_ad_rgb",
    variant: OldMode = None,
) -> None:
    """A mesh by marching cubes, with vertex colours: .ply or .glb."""
    from nerg_mi.jobs import export

    options = export.MeshOptions(
        resolution=resolution, density=density, fill=fill, keep=keep, unseen=unseen, up=up, mode=mode_of(mode, variant)
    )
    with TerminalReporter() as reporter:
        export.export_mesh(field, output, options, reporter)


@app.command("points")
def export_points(
    field: _Field,
    output: _Output,
    resolution: _Resolution = 256,
    density: _Density = None,
    count: Annotated[int | None, typer.Option(min=1, help="Points at most.  [default: all]")] = None,
    up: _Up = "z",
    mode: Mode = "llvm_ad_rgb",
    variant: OldMode = None,
) -> None:
    """A cloud of surface points with normals and colours: .ply or .glb."""
    from nerg_mi.jobs import export

    options = export.PointOptions(
        resolution=resolution, density=density, count=count, up=up, mode=mode_of(mode, variant)
    )
    with TerminalReporter() as reporter:
        export.export_points(field, output, options, reporter)


@app.command("volume")
def export_volume(
    field: _Field,
    output: _Output,
    color: Annotated[Path | None, typer.Option(help="Also write the colour, to this .vol file.")] = None,
    resolution: _Resolution = 256,
    mode: Mode = "llvm_ad_rgb",
    variant: OldMode = None,
) -> None:
    """Density, and colour, as Mitsuba grid volumes (.vol)."""
    from nerg_mi.jobs import export

    options = export.VolumeOptions(resolution=resolution, color=color, mode=mode_of(mode, variant))
    with TerminalReporter() as reporter:
        export.export_volume(field, output, options, reporter)


@app.command("torch-ngp")
def export_torch_ngp(field: _Field, output: _Output, mode: Mode = "llvm_ad_rgb", variant: OldMode = None) -> None:
    """A torch-ngp checkpoint (.pth), of a field whose grid and networks have torch-ngp's shapes."""
    from nerg_mi.jobs import export

    with TerminalReporter() as reporter:
        export.export_torch_ngp(field, output, mode_of(mode, variant), reporter)
