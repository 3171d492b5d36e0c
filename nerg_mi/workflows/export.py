"""Export of fields to meshes, points, splats, volumes and checkpoints of other programs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import check_writable
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.splats import make_splats, write_ply_splats
from nerg_mi.formats.surfaces import (
    Surface,
    extract_mesh,
    extract_points,
    sample_density_and_color,
    write_glb,
    write_ply,
    write_volume,
)
from nerg_mi.formats.torch_ngp import write_torch_ngp
from nerg_mi.progress import SILENT, Reporter

from .base import argument, out, select_backend
from .radiance_commands import MeshOptions, PointOptions, SplatOptions, TorchNgpOptions, VolumeOptions

# ---- Export ----
#
# Radiance fields in the formats of other tools, in the units of the field: meshes, points, Gaussian splats, grid
# volumes, torch-ngp checkpoints.


_FIELD, _FILE = argument("Radiance field (.safetensors)."), out("File to write.")


@dataclass(frozen=True)
class Export:
    """Written ``files``; ``surface`` is the exported mesh or point cloud, None for other formats."""

    files: list[Path]
    surface: Surface | None = None


def export_mesh(
    field: str | Path | RadianceField,
    output: str | Path,
    options: MeshOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write a mesh by marching cubes, with vertex colours: .ply or .glb. Needs scikit-image.

    Raises `NergError` for errors that the user can correct.
    """
    options, output, start = options or MeshOptions(), Path(output), time.perf_counter()
    write = _surface_writer(output, options.up)
    surface = extract_mesh(
        _load(field, options.mode, reporter),
        options.resolution,
        options.density_threshold,
        options.fill_holes,
        options.min_component_area,
        options.keep_unseen,
    )
    write(surface, output)
    r = surface.report
    reporter.message(
        f"surface at a density of {r['threshold']:.4g} / unit, cells of {r['cell']:.4g} units ({_by(r['lattice'])})"
    )
    reporter.message(
        f"{r['cells_filled']:,} cells of holes filled; removed {r['unseen_faces']:,} faces that no training view "
        f"saw, and {r['floater_faces']:,} faces in {r['pieces'] - r['pieces_kept']:,} small components; "
        f"{r['pieces_kept']} components kept"
    )
    reporter.message(
        f"{len(surface.vertices):,} vertices, {surface.face_count:,} faces; open edges: {r['edges_at_the_box']:,} at "
        f"the bounding box, {r['edges_of_holes']:,} around holes"
    )
    return _written([output], start, reporter, surface)


def export_points(
    field: str | Path | RadianceField,
    output: str | Path,
    options: PointOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write surface points with normals and colours: .ply or .glb.

    Raises `NergError` for errors that the user can correct.
    """
    options, output, start = options or PointOptions(), Path(output), time.perf_counter()
    write = _surface_writer(output, options.up)
    surface = extract_points(
        _load(field, options.mode, reporter), options.resolution, options.density_threshold, options.max_points
    )
    write(surface, output)
    reporter.message(f"{len(surface.vertices):,} points at a density of {surface.report['threshold']:.4g} / unit")
    return _written([output], start, reporter, surface)


def export_splats(
    field: str | Path | RadianceField,
    output: str | Path,
    options: SplatOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write Gaussian splats on the surface: .ply. Raises `NergError` for errors that the user can correct."""
    options, output, start = options or SplatOptions(), Path(output), time.perf_counter()
    check_writable(output, ".ply")
    splats, done = make_splats(_load(field, options.mode, reporter), options.resolution, options.density_threshold)
    write_ply_splats(output, splats, comments=("Gaussian splats of a radiance field, by nerg_mi",))
    reporter.message(
        f"{len(splats):,} Gaussians, cells of {done['cell']:.4g} units; moved by {done['moved']:.2g} units "
        "(median) to the rendered depth"
    )
    return _written([output], start, reporter)


def export_volume(
    field: str | Path | RadianceField,
    output: str | Path,
    options: VolumeOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write density and colour as Mitsuba grid volumes (.vol). Raises `NergError` for errors that the user corrects."""
    options, output, start = options or VolumeOptions(), Path(output), time.perf_counter()
    files = [output] if options.color is None else [Path(options.color), output]
    for path in reversed(files):
        check_writable(path, ".vol")
    loaded = _load(field, options.mode, reporter)
    density, color, lower, upper = sample_density_and_color(loaded, options.resolution, options.color is not None)
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


def export_torch_ngp(
    field: str | Path | RadianceField,
    output: str | Path,
    options: TorchNgpOptions | None = None,
    reporter: Reporter = SILENT,
) -> Export:
    """Write a torch-ngp checkpoint (.pth). Raises `NergError` if the grid or networks do not fit its layout."""
    options, output, start = options or TorchNgpOptions(), Path(output), time.perf_counter()
    check_writable(output, ".pth")
    write_torch_ngp(_load(field, options.mode, reporter), output)
    return _written([output], start, reporter)


def _load(field: str | Path | RadianceField, mode: str, reporter: Reporter) -> RadianceField:
    reporter.progress(0.0, "reading the field")
    ns = select_backend(mode)
    loaded = field if isinstance(field, RadianceField) else load_radiance(field, ns)[0]
    loaded.require_density("the radiance field" if isinstance(field, RadianceField) else f'"{field}"')
    reporter.progress(0.01, "sampling the field")
    if loaded.box.is_contracted:
        reporter.message("the scene is unbounded: only the box that the field resolves best is exported")
    return loaded


def _surface_writer(output: Path, up: str) -> Callable[[Surface, Path], None]:
    if up not in ("y", "z"):
        raise NergError(f'{parameter("up")} must be z or y, got "{up}"')
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
