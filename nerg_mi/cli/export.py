"""`nerg export`: the command line of `nerg_mi.jobs.export`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.export import MeshOptions, PointOptions, SplatOptions, TorchNgpOptions, VolumeOptions

from .mode import OldMode, mode_of
from .options import takes
from .progress import TerminalReporter

export_app = typer.Typer(no_args_is_help=True, help="Write a radiance field for other tools, in the field's own units.")

_Field = Annotated[Path, typer.Argument(help="Radiance field (.safetensors).")]
_Output = Annotated[Path, typer.Option("-o", "--output", help="File to write.")]


@export_app.command("mesh")
@takes(MeshOptions)
def export_mesh(field: _Field, output: _Output, options: MeshOptions, variant: OldMode = None) -> None:
    """A mesh by marching cubes, with vertex colours: .ply or .glb."""
    from nerg_mi.jobs import export

    with TerminalReporter() as reporter:
        export.export_mesh(field, output, replace(options, mode=mode_of(options.mode, variant)), reporter)


@export_app.command("points")
@takes(PointOptions)
def export_points(field: _Field, output: _Output, options: PointOptions, variant: OldMode = None) -> None:
    """A cloud of surface points with normals and colours: .ply or .glb."""
    from nerg_mi.jobs import export

    with TerminalReporter() as reporter:
        export.export_points(field, output, replace(options, mode=mode_of(options.mode, variant)), reporter)


@export_app.command("splats")
@takes(SplatOptions)
def export_splats(field: _Field, output: _Output, options: SplatOptions) -> None:
    """Gaussian splats on the surface, with its colours: .ply, for viewers of splats and the volume "splats"."""
    from nerg_mi.jobs import export

    with TerminalReporter() as reporter:
        export.export_splats(field, output, replace(options, mode=mode_of(options.mode, None)), reporter)


@export_app.command("volume")
@takes(VolumeOptions)
def export_volume(field: _Field, output: _Output, options: VolumeOptions, variant: OldMode = None) -> None:
    """Density, and colour, as Mitsuba grid volumes (.vol)."""
    from nerg_mi.jobs import export

    with TerminalReporter() as reporter:
        export.export_volume(field, output, replace(options, mode=mode_of(options.mode, variant)), reporter)


@export_app.command("torch-ngp")
@takes(TorchNgpOptions)
def export_torch_ngp(field: _Field, output: _Output, options: TorchNgpOptions, variant: OldMode = None) -> None:
    """A torch-ngp checkpoint (.pth), of a field whose grid and networks have torch-ngp's shapes."""
    from nerg_mi.jobs import export

    with TerminalReporter() as reporter:
        export.export_torch_ngp(field, output, replace(options, mode=mode_of(options.mode, variant)), reporter)
