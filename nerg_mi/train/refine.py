"""Refinement of the occupancy grid of a radiance field, so that it renders with fewer evaluations."""

from __future__ import annotations

import copy

from nerg_mi.environment.trained import TrainedField, open_field
from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import refine_occupancy
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.values import FilePath
from nerg_mi.progress import Progress, open_reporter


def refine_field(
    field: TrainedField[RadianceField] | FilePath, *, progress: Progress = None
) -> TrainedField[RadianceField]:
    """Compute a finer occupancy grid of a radiance field, so that it renders with fewer evaluations.

    Training and nerg import compute this grid already; the function is for older files. The weights do not change, and
    gaze fields that were trained in the field accept the new one.

    Parameters
    ----------
    field : TrainedField or path
        Radiance field (.safetensors).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    TrainedField
        The field with the finer grid.

    Raises
    ------
    NergError
        The field has no occupancy grid, or one of nested cubes.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.load_field(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> fine = nerg.refine_field(field)
    >>> fine.network.occupancy.occupied_fraction < field.network.occupancy.coarse.occupied_fraction
    True
    """
    original = open_field(field)
    before = original.network.occupancy
    if before is None:
        raise NergError(f'"{original.name}" has no occupancy grid to refine: rays are marched through its whole box')
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, f"refining {original.name}")
        grid = refine_occupancy(original.network)
        if grid is None:
            raise NergError(
                f'the occupancy grid of "{original.name}" consists of nested cubes, which cannot be refined: use the '
                "field as it is"
            )
        reporter.message(
            f"occupied: {100 * grid.occupied_fraction:.2f} % of the box, before "
            f"{100 * before.coarse.occupied_fraction:.2f} %; a random line misses an optical depth of "
            f"{grid.missed_optical_depth:.1e}"
        )
    network = copy.copy(original.network)
    network.occupancy = grid
    return original.derive(network)
