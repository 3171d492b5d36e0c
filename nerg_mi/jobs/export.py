"""``nerg export mesh``: A mesh by marching cubes, with vertex colours: .ply or .glb.
``nerg export points``: A cloud of surface points with normals and colours: .ply or .glb.
``nerg export splats``: Gaussian splats on the surface, with its colours: .ply, for viewers of splats and the volume
"splats".
``nerg export volume``: Density, and colour, as Mitsuba grid volumes (.vol).
``nerg export torch-ngp``: A torch-ngp checkpoint (.pth), of a field whose grid and networks have torch-ngp's shapes.

Radiance fields for other tools, in the field's own units: meshes, points, Gaussian splats, grid volumes,
torch-ngp checkpoints.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import check_writable
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.splats import splats_of_field, write_ply_splats
from nerg_mi.formats.surfaces import Surface, density_and_color, mesh, points, write_glb, write_ply, write_volume
from nerg_mi.formats.torch_ngp import write_torch_ngp

from .backend import select_backend
from .commands import argument, command, out
from .options.export import MeshOptions, PointOptions, SplatOptions, TorchNgpOptions, VolumeOptions
from .reporter import SILENT, Reporter

_FIELD, _FILE = argument("Radiance field (.safetensors)."), out("File to write.")


@dataclass(frozen=True)
class Export:
    """``files`` written; ``surface``: what a mesh or a cloud of points holds, None for other kinds."""

    files: list[Path]
    surface: Surface | None = None


@command("export mesh", options=MeshOptions, field=_FIELD, output=_FILE)
def export_mesh(
    field: str | Path | RadianceField,
    output: str | Path,
    options: MeshOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write a mesh by marching cubes, with vertex colours: .ply or .glb. Needs scikit-image.

    Raises `NergError` for what the user can mend.
    """
    options, output, start = options or MeshOptions(), Path(output), time.perf_counter()
    write = _surface_writer(output, options.up)
    found = mesh(
        _load(field, options.mode, reporter),
        options.resolution,
        options.density,
        options.fill,
        options.keep,
        options.unseen,
    )
    write(found, output)
    r = found.report
    reporter.message(
        f"surface at a density of {r['threshold']:.4g} / unit, cells of {r['cell']:.4g} units ({_by(r['lattice'])})"
    )
    reporter.message(
        f"{r['cells_filled']:,} cells of holes filled; dropped {r['unseen_faces']:,} faces that training never looked "
        f"at, and {r['floater_faces']:,} of {r['pieces'] - r['pieces_kept']:,} floaters; {r['pieces_kept']} pieces kept"
    )
    reporter.message(
        f"{len(found.vertices):,} vertices, {found.face_count:,} faces; open edges: {r['edges_at_the_box']:,} where "
        f"the box cuts, {r['edges_of_holes']:,} around holes"
    )
    return _written([output], start, reporter, found)


@command("export points", options=PointOptions, field=_FIELD, output=_FILE)
def export_points(
    field: str | Path | RadianceField,
    output: str | Path,
    options: PointOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write a cloud of surface points with normals and colours: .ply or .glb. Raises `NergError` for what the user can
    mend."""
    options, output, start = options or PointOptions(), Path(output), time.perf_counter()
    write = _surface_writer(output, options.up)
    found = points(_load(field, options.mode, reporter), options.resolution, options.density, options.count)
    write(found, output)
    reporter.message(f"{len(found.vertices):,} points, at a density of {found.report['threshold']:.4g} / unit")
    return _written([output], start, reporter, found)


@command("export splats", options=SplatOptions, field=_FIELD, output=_FILE)
def export_splats(
    field: str | Path | RadianceField,
    output: str | Path,
    options: SplatOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write Gaussian splats on the field's surface: .ply. Raises `NergError` for what the user can mend."""
    options, output, start = options or SplatOptions(), Path(output), time.perf_counter()
    check_writable(output, ".ply")
    splats, done = splats_of_field(_load(field, options.mode, reporter), options.resolution, options.density)
    write_ply_splats(output, splats, comments=("Gaussian splats of a radiance field, by nerg_mi",))
    reporter.message(
        f"{len(splats):,} Gaussians, cells of {done['cell']:.4g} units; moved by {done['moved']:.2g} units (median) to "
        "the depth that rays find"
    )
    return _written([output], start, reporter)


@command("export volume", options=VolumeOptions, field=_FIELD, output=_FILE)
def export_volume(
    field: str | Path | RadianceField,
    output: str | Path,
    options: VolumeOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write density, and colour, as Mitsuba grid volumes (.vol). Raises `NergError` for what the user can mend."""
    options, output, start = options or VolumeOptions(), Path(output), time.perf_counter()
    files = [output] if options.color is None else [Path(options.color), output]
    for path in reversed(files):
        check_writable(path, ".vol")
    loaded = _load(field, options.mode, reporter)
    density, color, lower, upper = density_and_color(loaded, options.resolution, options.color is not None)
    write_volume(output, density, lower, upper)
    reporter.message(
        f"{_by(density.shape[::-1])} voxels from {_corner(lower)} to {_corner(upper)}; "
        f"density up to {density.max():.4g} / unit"
    )
    if color is not None:
        write_volume(files[0], color, lower, upper)
    done = _written(files, start, reporter)
    reporter.message(
        'use: <volume type="gridvolume"> with <boolean name="use_grid_bbox" value="true"/>, '
        'and "raw" true for the colour'
    )
    return done


@command("export torch-ngp", options=TorchNgpOptions, field=_FIELD, output=_FILE)
def export_torch_ngp(
    field: str | Path | RadianceField,
    output: str | Path,
    options: TorchNgpOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write a torch-ngp checkpoint (.pth), of a field whose grid and networks have torch-ngp's shapes; raises
    `NergError` for another."""
    options, output, start = options or TorchNgpOptions(), Path(output), time.perf_counter()
    check_writable(output, ".pth")
    write_torch_ngp(_load(field, options.mode, reporter), output)
    return _written([output], start, reporter)


def _load(field: str | Path | RadianceField, mode: str, reporter: Reporter) -> RadianceField:
    reporter.progress(0.0, "reading the field")
    ns = select_backend(mode)
    loaded = field if isinstance(field, RadianceField) else load_radiance(field, ns)[0]
    reporter.progress(0.01, "looking through its volume")
    if loaded.box.contracted:
        reporter.message("the place has no end: written is the box that it resolves best, not what is around it")
    return loaded


def _surface_writer(output: Path, up: str) -> Callable[[Surface, Path], None]:
    if up not in ("y", "z"):
        raise NergError(f'--up must be z or y, not "{up}"')
    check_writable(output, ".ply", ".glb")
    if output.suffix.lower() == ".ply":
        return write_ply
    return lambda surface, path: write_glb(surface, path, up)


def _written(files: list[Path], start: float, reporter: Reporter, surface: Surface | None = None) -> Export:
    for path in files:
        size, seconds = path.stat().st_size / 1e6, time.perf_counter() - start
        reporter.message(f"wrote {path} ({size:.1f} MB, {seconds:.1f} s)")
    return Export(files, surface)


def _by(shape) -> str:
    return " x ".join(map(str, shape))


def _corner(values) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"
