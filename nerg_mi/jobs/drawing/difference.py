"""How two pictures differ in a quantity: the first less the second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import difference_figure, find_stored
from nerg_mi.figures.style import find_colors
from nerg_mi.jobs.options import option
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.ranges import VALUES, Checked

from .files import read_stored, shared_note
from .kind import Drawing, Kind


@dataclass(frozen=True, kw_only=True)
class DifferenceOptions(Checked):
    """How a difference is drawn."""

    channel: str = option("gaze", "Channel of both files.")
    top: float | None = option(None, "Both ends of the scale.  [default: the 99.5th percentile]", within=VALUES)
    cmap: str = option("RdBu_r", "Colour map: RdBu_r, PuOr_r, BrBG_r, PRGn_r.")


def _draw_difference(files: Sequence[Path], options: DifferenceOptions, reporter: Reporter) -> Drawing:
    """The first of two files less the second."""
    find_colors(options.cmap, "diverging")
    if options.top is not None and not (np.isfinite(options.top) and options.top > 0):
        raise NergError(f"--top must be positive, got {options.top}")
    if len(files) != 2:
        raise NergError(f"a difference is of two pictures, and {len(files)} were given; name two .exr files")
    overlay = find_stored(options.channel)
    if overlay.display.kind == "categorical":
        raise NergError(f'"{overlay.name}" names classes, which have no difference; choose another --channel')
    first, second = (read_stored(path, overlay) for path in files)
    if first.values.shape != second.values.shape:
        sizes = " and ".join(f"{v.shape[1]} x {v.shape[0]}" for v in (first.values, second.values))
        raise NergError(f"pictures of {sizes} pixels cannot be compared; render both with one size")
    mask, unit = first.mask & second.mask, overlay.quantity.unit
    title = f"{files[0].stem} less {files[1].stem}"
    label = f"difference of {overlay.name}" + (f" [{unit}]" if unit else "")
    note = shared_note([path.stem for path in files], [first.basis, second.basis])
    figure = difference_figure(first.values, second.values, mask, title, label, options.top, options.cmap, note)
    return Drawing(figure, list(files))


DIFFERENCE_KIND = Kind(
    "difference",
    "A quantity of one picture less that of another.",
    "two pictures (.exr)",
    2,
    DifferenceOptions,
    _draw_difference,
)
