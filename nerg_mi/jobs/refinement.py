"""``nerg refine``: Find more closely where a radiance field holds matter, so that it renders faster.

A finer bound on where a trained field holds matter, for checkpoints that were written without one.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import RefinedGrid
from nerg_mi.fields.refinement import refine
from nerg_mi.files.atomic import check_writable, file_sha256
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.formats.fields import load_radiance, occupancy_arrays

from .backend import select_backend
from .commands import argument, command, out
from .options.checkpoints import RefineOptions
from .reporter import SILENT, Reporter


@dataclass(frozen=True)
class Refinement:
    """``occupancy``: the finer bound; ``before``: share of the box's cells that the bound had before; ``output``: the
    file."""

    occupancy: RefinedGrid
    before: float
    output: Path


@command(
    "refine",
    "Find more closely where a trained field holds matter, so that it renders with fewer evaluations.",
    more="Fields that are trained or imported now have it. Weights stay as they are, and gaze fields know the new "
    "file.",
    options=RefineOptions,
    field=argument("Radiance field (.safetensors)."),
    output=out("Radiance field to write (.safetensors)."),
)
def refine_checkpoint(
    field: str | Path, output: str | Path, options: RefineOptions | None = None, reporter: Reporter = SILENT
) -> Refinement:
    """Write the radiance field in ``field`` to ``output`` with a finer bound, and everything else as it is.

    The new file names the checksum of the old one, so that gaze fields that were trained in that one know it. Raises
    `NergError` for what the user can mend.
    """
    options, field, output, start = options or RefineOptions(), Path(field), Path(output), time.perf_counter()
    check_writable(output, ".safetensors")
    ns = select_backend(options.mode)
    loaded, _ = load_radiance(field, ns)
    if loaded.occupancy is None:
        raise NergError(f'"{field}" has no occupancy grid to refine: its field is marched through all of its box')
    reporter.progress(0.0, f"refining {field.name}")
    before, grid = loaded.occupancy.coarse.fraction, refine(loaded)
    if grid is None:
        raise NergError(f'the occupancy of "{field}" is nested cubes, which are not refined: use the field as it is')
    tensors, meta = read_checkpoint(field, "radiance")
    arrays, about = occupancy_arrays(grid)
    origin = meta.get("refined_from") or file_sha256(field)
    kept = {key: value for key, value in meta.items() if key not in ("format", "kind")}
    write_checkpoint(output, "radiance", tensors | arrays, kept | {"occupancy": about, "refined_from": origin})
    reporter.message(
        f"matter in {100 * grid.fraction:.2f} % of the box, where it was {100 * before:.2f} %; a random line misses an "
        f"optical depth of {grid.missed:.1e}"
    )
    seconds = time.perf_counter() - start
    reporter.message(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB) in {seconds:.1f} s")
    return Refinement(grid, before, output)
