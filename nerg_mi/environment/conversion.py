"""Fields from and to other programs: checkpoints, meshes, points, splats and grids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.occupancy import refine_occupancy
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.files.html import summary_table
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.splats import SurfaceSplats, make_splats
from nerg_mi.formats.surfaces import Surface, extract_mesh, extract_points, sample_density_and_color
from nerg_mi.formats.torch_ngp import (
    ImportOptions,
    TorchNgpModel,
    is_nerg_checkpoint,
    make_torch_ngp,
    open_checkpoint,
    read_nerg,
    read_torch_ngp,
)
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import POSITIVE_VALUES, Range, check_ranges

from .contents import DensityGrid
from .gaze import GazeField
from .radiance import RadianceField
from .scene_loading import get_array_module

# ---- Import ----


class ImportedFields(NamedTuple):
    """Fields of an imported checkpoint; None for a field that it does not contain.

    Attributes
    ----------
    field : RadianceField or None
        The radiance field.
    gaze : GazeField or None
        The gaze field.
    """

    field: RadianceField | None
    gaze: GazeField | None

    def _repr_html_(self) -> str:
        return summary_table(self._asdict())

    def save(self, output: FilePath | None = None, gaze: FilePath | None = None) -> None:
        """Write the radiance field to ``output`` and the gaze field to ``gaze`` (.safetensors); None writes none.

        Raises `NergError` if there is no such field, or a file cannot be written.
        """
        name = next(part.name for part in self if part is not None)
        if output is not None and self.field is None:
            raise NergError(
                f'"{name}" contains a gaze field but no NeRF: write it with {parameter("gaze")} alone, without '
                f"{parameter('output')}, and import the NeRF from its own file"
            )
        if gaze is not None and self.gaze is None:
            raise NergError(f'"{name}" contains no gaze field: leave out {parameter("gaze")}')
        for part, path in ((self.field, output), (self.gaze, gaze)):
            if part is not None and path is not None:
                part.save(path)


@check_ranges
def import_checkpoint(
    file: FilePath,
    *,
    ema: bool | None = None,
    color_space: Literal["srgb", "linear"] = "srgb",
    bg_radius: Annotated[float, Range(0, 10**6)] | None = None,
    finest_resolution: Annotated[int, Range(2, 1 << 24)] | None = None,
    half: bool = False,
    progress: Progress = None,
) -> ImportedFields:
    """Read a checkpoint of torch-ngp, or of the NeRG paper's authors. No code in the file is executed.

    Parameters
    ----------
    file : path
        Checkpoint (.pth) of torch-ngp, or of the NeRG paper's authors.
    ema : bool, optional
        Import the exponential moving averages of the weights, or the last weights. Default: averages if there are any.
    color_space : str
        Value of --color_space in the original training: srgb or linear.
    bg_radius : float, optional
        Value of --bg_radius in the original training, needed if there is a background network; 0 leaves the network
        out.
    finest_resolution : int, optional
        Finest resolution of the hash grid in cells. Default: 2048 times the bound.
    half : bool
        Store the weights in half precision (fp16).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    ImportedFields
        The radiance field, ``field``, and the gaze field, ``gaze``.

    Raises
    ------
    NergError
        The file is not such a checkpoint.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> try:
    ...     nerg.import_checkpoint(folder / "nowhere.pth")
    ... except nerg.NergError as error:
    ...     print("nowhere.pth" in str(error))
    True
    """
    path, ns = to_path(file), get_array_module()
    settings = ImportOptions(color_space, finest_resolution, bg_radius)
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, f"converting {path.name}")
        gaze = None
        if is_nerg_checkpoint(open_checkpoint(path)[1]):
            field, gaze, origin = read_nerg(path, ns, ema, settings)
        else:
            field, origin = read_torch_ngp(path, ns, ema, settings)
        if field is not None:
            field.occupancy = refine_occupancy(field) or field.occupancy
            reporter.message(_describe_field(field, origin))
        if gaze is not None:
            config = gaze.config
            reporter.message(
                f"gaze: {config.variant}, trunk {config.trunk}, bound {gaze.box.side / 2:g}; it is written with "
                f"{parameter('gaze', 'NAME.safetensors')}"
            )
    return ImportedFields(
        None if field is None else RadianceField(field, origin, path.name, half=half),
        None if gaze is None else GazeField(gaze, origin, path.name, half=half),
    )


def _describe_field(field: RadianceNetwork, origin: dict) -> str:
    cells = "no occupancy grid (marching evaluates all of space)"
    if field.occupancy is not None:
        cells = f"{100 * field.occupancy.occupied_fraction:.1f} % of its box occupied"
    behind = "" if field.background is None else f", background of radius {field.background.config.radius:g}"
    return f"radiance: bound {field.box.side / 2:g}, {origin['weights']} weights, {cells}{behind}"


# ---- Export ----
#
# Radiance fields in the formats of other tools, in the units of the field.


def _open(field: RadianceField | FilePath, reporter: Reporter) -> RadianceNetwork:
    reporter.progress(0.0, "reading the field")
    trained = RadianceField.open(field)
    trained.network.require_density(f'"{trained.name}"')
    reporter.progress(0.01, "sampling the field")
    if trained.network.box.is_contracted:
        reporter.message("the scene is unbounded: only the box that the field resolves best is exported")
    return trained.network


@check_ranges
def export_mesh(
    field: RadianceField | FilePath,
    *,
    resolution: Annotated[int, Range(2, 2048)] = 256,
    density_threshold: Annotated[float, POSITIVE_VALUES] | None = None,
    keep_unseen: bool = False,
    up: Literal["z", "y"] = "z",
    progress: Progress = None,
) -> Surface:
    """Extract a mesh with vertex colours by marching cubes. Needs scikit-image.

    Parameters
    ----------
    field : RadianceField or path
        Radiance field (.safetensors).
    resolution : int
        Number of grid cells along the longest edge of the field's bounding box.
    density_threshold : float, optional
        Density of the extracted surface in 1/unit. Default: absorbs half of the light across a grid cell.
    keep_unseen : bool
        Keep surfaces that no training view saw, such as backs and insides.
    up : str
        Up axis of the field, z or y. It is turned to +y in .glb files.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    Surface
        The mesh, with a method ``save`` (.ply, .glb).

    Raises
    ------
    NergError
        There is no surface, or an argument is invalid.
    ImportError
        scikit-image is not installed.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> mesh = nerg.export_mesh(field, resolution=32)
    >>> mesh.save(folder / "store.ply")
    """
    with open_reporter(progress) as reporter:
        mesh = extract_mesh(_open(field, reporter), resolution, density_threshold, keep_unseen=keep_unseen)
        r = mesh.report
        reporter.message(
            f"surface at a density of {r['threshold']:.4g} / unit, cells of {r['cell']:.4g} units ({_by(r['lattice'])})"
        )
        reporter.message(
            f"{r['cells_filled']:,} cells of holes filled; removed {r['unseen_faces']:,} faces that no training view "
            f"saw, and {r['floater_faces']:,} faces in {r['pieces'] - r['pieces_kept']:,} small components; "
            f"{r['pieces_kept']} components kept"
        )
        reporter.message(
            f"{len(mesh.vertices):,} vertices, {mesh.face_count:,} faces; open edges: {r['edges_at_the_box']:,} at "
            f"the bounding box, {r['edges_of_holes']:,} around holes"
        )
    return replace(mesh, up=up)


@check_ranges
def export_points(
    field: RadianceField | FilePath,
    *,
    resolution: Annotated[int, Range(2, 2048)] = 256,
    density_threshold: Annotated[float, POSITIVE_VALUES] | None = None,
    max_points: Annotated[int, Range(1, 10**9)] | None = None,
    up: Literal["z", "y"] = "z",
    progress: Progress = None,
) -> Surface:
    """Sample surface points with normals and colours.

    Parameters
    ----------
    field, resolution, density_threshold, up, progress
        As for `export_mesh`.
    max_points : int, optional
        Maximum number of points; if there are more, a random selection is kept. Default: all.

    Returns
    -------
    Surface
        The points, with a method ``save`` (.ply, .glb).

    Raises
    ------
    NergError
        There is no surface, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> 0 < len(nerg.export_points(field, resolution=32, max_points=100).vertices) <= 100
    True
    """
    with open_reporter(progress) as reporter:
        points = extract_points(_open(field, reporter), resolution, density_threshold, max_points)
        reporter.message(f"{len(points.vertices):,} points at a density of {points.report['threshold']:.4g} / unit")
    return replace(points, up=up)


@check_ranges
def export_splats(
    field: RadianceField | FilePath,
    *,
    resolution: Annotated[int, Range(2, 2048)] = 256,
    density_threshold: Annotated[float, POSITIVE_VALUES] | None = None,
    progress: Progress = None,
) -> SurfaceSplats:
    """Place Gaussian splats on the surface, for splat viewers and the volume "splats".

    Parameters
    ----------
    field, resolution, density_threshold, progress
        As for `export_mesh`.

    Returns
    -------
    SurfaceSplats
        The Gaussians, with a method ``save`` (.ply).

    Raises
    ------
    NergError
        There is no surface, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> splats = nerg.export_splats(field, resolution=16)
    >>> splats.save(folder / "store.ply")
    """
    with open_reporter(progress) as reporter:
        splats = make_splats(_open(field, reporter), resolution, density_threshold)
        reporter.message(
            f"{len(splats):,} Gaussians, cells of {splats.cell:.4g} units; moved by {splats.shift:.2g} units "
            "(median) to the rendered depth"
        )
    return splats


@check_ranges
def export_volume(
    field: RadianceField | FilePath,
    *,
    resolution: Annotated[int, Range(2, 2048)] = 256,
    color: bool = False,
    progress: Progress = None,
) -> DensityGrid:
    """Sample density and colour on a grid, as Mitsuba grid volumes.

    A scene reads the files by a gridvolume with use_grid_bbox true, that of the colour also with raw true.

    Parameters
    ----------
    field, resolution, progress
        As for `export_mesh`.
    color : bool
        Whether to sample the colour, too.

    Returns
    -------
    DensityGrid
        The grid, with a method ``save`` (.vol).

    Raises
    ------
    NergError
        The field is empty, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> grid = nerg.export_volume(field, resolution=16)
    >>> grid.save(folder / "store.vol")
    """
    with open_reporter(progress) as reporter:
        density, colors, lower, upper = sample_density_and_color(_open(field, reporter), resolution, color)
        corners = " to ".join(f"({', '.join(f'{v:.4g}' for v in corner)})" for corner in (lower, upper))
        reporter.message(f"{_by(density.shape[::-1])} voxels from {corners}; density up to {density.max():.4g} / unit")
    return DensityGrid(density, lower, upper, colors)


def export_torch_ngp(field: RadianceField | FilePath, *, progress: Progress = None) -> TorchNgpModel:
    """Convert a field to a torch-ngp checkpoint, if its grid and networks fit its layout.

    Parameters
    ----------
    field, progress
        As for `export_mesh`.

    Returns
    -------
    TorchNgpModel
        The checkpoint, with a method ``save`` (.pth).

    Raises
    ------
    NergError
        The grid or the networks do not fit.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> try:
    ...     nerg.export_torch_ngp(field)
    ... except nerg.NergError as error:
    ...     print("torch-ngp" in str(error))
    True
    """
    with open_reporter(progress) as reporter:
        return make_torch_ngp(_open(field, reporter))


def _by(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))
