"""``nerg export``: radiance fields for other tools."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

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
_Variant = Annotated[str, typer.Option(help="Mitsuba variant.")]


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
    variant: _Variant = "llvm_ad_rgb",
) -> None:
    """A mesh by marching cubes, with vertex colours: .ply or .glb."""
    from nerg_mi.formats.surfaces import mesh

    write = _writer(output, up)
    start = time.perf_counter()
    surface = mesh(_load(field, variant), resolution, density, fill, keep, unseen)
    write(surface, output)
    r = surface.report
    typer.echo(
        f"surface at a density of {r['threshold']:.4g} / unit, cells of {r['cell']:.4g} units ({_by(r['lattice'])})"
    )
    typer.echo(
        f"{r['cells_filled']:,} cells of holes filled; dropped {r['unseen_faces']:,} faces that training never looked at, and "
        f"{r['floater_faces']:,} of {r['pieces'] - r['pieces_kept']:,} floaters; {r['pieces_kept']} pieces kept"
    )
    typer.echo(
        f"{len(surface.vertices):,} vertices, {len(surface.faces):,} faces; open edges: {r['edges_at_the_box']:,} where the box "
        f"cuts, {r['edges_of_holes']:,} around holes"
    )
    _wrote(output, start)


@app.command("points")
def export_points(
    field: _Field,
    output: _Output,
    resolution: _Resolution = 256,
    density: _Density = None,
    count: Annotated[int | None, typer.Option(min=1, help="Points at most.  [default: all]")] = None,
    up: _Up = "z",
    variant: _Variant = "llvm_ad_rgb",
) -> None:
    """A cloud of surface points with normals and colours: .ply or .glb."""
    from nerg_mi.formats.surfaces import points

    write = _writer(output, up)
    start = time.perf_counter()
    surface = points(_load(field, variant), resolution, density, count)
    write(surface, output)
    typer.echo(f"{len(surface.vertices):,} points, at a density of {surface.report['threshold']:.4g} / unit")
    _wrote(output, start)


@app.command("volume")
def export_volume(
    field: _Field,
    output: _Output,
    color: Annotated[Path | None, typer.Option(help="Also write the colour, to this .vol file.")] = None,
    resolution: _Resolution = 256,
    variant: _Variant = "llvm_ad_rgb",
) -> None:
    """Density, and colour, as Mitsuba grid volumes (.vol)."""
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.formats.volumes import density_and_color, write_volume

    for path in (output, color):
        if path is not None:
            check_writable(path, ".vol")
    start = time.perf_counter()
    sigma, paint, lower, upper = density_and_color(_load(field, variant), resolution, color is not None)
    write_volume(output, sigma, lower, upper)
    typer.echo(
        f"{_by(sigma.shape[::-1])} voxels from {_corner(lower)} to {_corner(upper)}; density up to {sigma.max():.4g} / unit"
    )
    if color is not None:
        write_volume(color, paint, lower, upper)
        _wrote(color, start)
    _wrote(output, start)
    typer.echo(
        'use: <volume type="gridvolume"> with <boolean name="use_grid_bbox" value="true"/>, and "raw" true for the colour'
    )


@app.command("torch-ngp")
def export_torch_ngp(field: _Field, output: _Output, variant: _Variant = "llvm_ad_rgb") -> None:
    """A torch-ngp checkpoint (.pth), of a field whose grid and networks have torch-ngp's shapes."""
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.formats.torch_ngp.fields import write_torch_ngp

    check_writable(output, ".pth")
    start = time.perf_counter()
    write_torch_ngp(_load(field, variant), output)
    _wrote(output, start)


def _load(path: Path, variant: str):
    from nerg_mi.field.backend import namespace
    from nerg_mi.formats.fields import load_radiance
    from nerg_mi.rendering.pictures import activate

    return load_radiance(path, namespace(activate(variant)))[0]


def _writer(output: Path, up: str):
    from nerg_mi.errors import NergError
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.formats.surfaces import write_glb, write_ply

    if up not in ("y", "z"):
        raise NergError(f'--up must be z or y, not "{up}".')
    check_writable(output, ".ply", ".glb")
    if output.suffix.lower() == ".ply":
        return write_ply
    return lambda surface, path: write_glb(surface, path, up)


def _by(shape) -> str:
    return " x ".join(map(str, shape))


def _corner(values) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"


def _wrote(path: Path, start: float) -> None:
    typer.echo(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB, {time.perf_counter() - start:.1f} s)")
