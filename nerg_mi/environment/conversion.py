"""Fields from and to other programs: checkpoints, meshes, points, splats and grids."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.occupancy import refine_occupancy
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.torch_ngp import ImportOptions, is_nerg_checkpoint, open_checkpoint, read_nerg, read_torch_ngp
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import Range, check_ranges
from nerg_mi.rendering.scene import get_array_module

from .trained import TrainedField

# ---- Import ----


class ImportedFields(NamedTuple):
    """Fields of an imported checkpoint; None for a field that it does not contain.

    Attributes
    ----------
    field : TrainedField or None
        The radiance field.
    gaze : TrainedField or None
        The gaze field; `load_gaze` loads it from its file with the methods of trained ones, such as ``density``.
    """

    field: TrainedField[RadianceField] | None
    gaze: TrainedField[AnyGazeField] | None

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
        None if field is None else TrainedField(field, origin, path.name, half=half),
        None if gaze is None else TrainedField(gaze, origin, path.name, half=half),
    )


def _describe_field(field: RadianceField, origin: dict) -> str:
    cells = "no occupancy grid (marching evaluates all of space)"
    if field.occupancy is not None:
        cells = f"{100 * field.occupancy.occupied_fraction:.1f} % of its box occupied"
    behind = "" if field.background is None else f", background of radius {field.background.config.radius:g}"
    return f"radiance: bound {field.box.side / 2:g}, {origin['weights']} weights, {cells}{behind}"
