"""``nerg import``: Convert checkpoints of torch-ngp and of the NeRG paper's authors.

Fields that other programs have trained, as fields of our own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.fields.refinement import refine
from nerg_mi.files.atomic import check_writable
from nerg_mi.formats.fields import save_gaze, save_radiance
from nerg_mi.formats.torch_ngp import Given, is_nerg, open_checkpoint, read_nerg, read_torch_ngp

from .backend import select_backend
from .commands import argument, command, extra, out
from .options.checkpoints import ImportOptions
from .reporter import SILENT, Reporter


@dataclass(frozen=True)
class ImportedFields:
    """``field`` and ``gaze``, each None where the checkpoint holds none; ``origin``: where they are from (JSON);
    ``files`` written."""

    field: RadianceField | None
    gaze: AnyGazeField | None
    origin: dict
    files: list[Path]


def import_checkpoint(
    file: str | Path,
    output: str | Path | None = None,
    gaze: str | Path | None = None,
    options: ImportOptions | None = None,
    reporter: Reporter = SILENT,
) -> ImportedFields:
    """Read a checkpoint (.pth) of torch-ngp, or of the NeRG paper's authors; nothing in the file is run.

    ``output``, ``gaze``: files for the radiance and the gaze field (.safetensors), None: not written. Raises
    `NergError` where the file does not hold what is to be written, and for what the user can mend.
    """
    options = options or ImportOptions()
    output, gaze = (None if path is None else Path(path) for path in (output, gaze))
    for path in (output, gaze):
        if path is not None:
            check_writable(path, ".safetensors")
    given = Given(options.color_space, options.finest, options.bg_radius)
    reporter.progress(0.0, f"converting {Path(file).name}")
    ns = select_backend(options.mode)
    if is_nerg(open_checkpoint(file)[1]):
        field, attention, origin = read_nerg(file, ns, options.ema, given)
    else:
        if gaze is not None:
            raise NergError(f'"{file}" holds no gaze field: leave out --gaze')
        (field, origin), attention = read_torch_ngp(file, ns, options.ema, given), None
    if field is not None:
        field.occupancy = refine(field) or field.occupancy
    if output is not None:
        if field is None:
            raise NergError(f'"{file}" holds a gaze field without its NeRF: import that from its own file')
        save_radiance(field, output, origin, options.half)
        reporter.message(_about(field, origin))
        _tell(output, reporter)
    if attention is not None and gaze is not None:
        save_gaze(attention, gaze, origin, options.half)
        config = attention.config
        reporter.message(f"gaze: {config.variant}, trunk {config.trunk}, bound {attention.box.side / 2:g}")
        _tell(gaze, reporter)
    elif attention is not None:
        reporter.message(f'"{file}" also holds a gaze field: --gaze NAME.safetensors writes it')
    return ImportedFields(field, attention, origin, [path for path in (output, gaze) if path is not None])


@command(
    "import",
    "Convert a checkpoint to the fields of the volumes `nerf` and `gazefield`. Nothing in the file is run.",
    options=ImportOptions,
    file=argument("Checkpoint (.pth) of torch-ngp, or of the NeRG paper's authors."),
    output=out("Radiance field to write (.safetensors).", default=None),
    gaze=extra(None, "Gaze field to write (.safetensors).", Path, "-g", "--gaze"),
)
def import_to_files(
    file: Path, output: Path | None, gaze: Path | None, options: ImportOptions, reporter: Reporter
) -> None:
    """`import_checkpoint` to one file at least."""
    if output is None and gaze is None:
        raise NergError("nothing is asked for: give -o FIELD.safetensors, --gaze GAZE.safetensors, or both")
    import_checkpoint(file, output, gaze, options, reporter)


def _about(field: RadianceField, origin: dict) -> str:
    cells = "no occupancy grid (marching evaluates all of space)"
    if field.occupancy is not None:
        cells = f"{100 * field.occupancy.fraction:.1f} % of its box occupied"
    behind = "" if field.background is None else f", background of radius {field.background.config.radius:g}"
    return f"radiance: bound {field.box.side / 2:g}, {origin['weights']} weights, {cells}{behind}"


def _tell(path: Path, reporter: Reporter) -> None:
    reporter.message(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
