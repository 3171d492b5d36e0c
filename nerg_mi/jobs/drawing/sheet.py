"""A contact sheet: several pictures on one page, with one scale where a quantity lies over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.figures.overlay import Heat, overlay, top_of
from nerg_mi.figures.sheets import contact_sheet, shrink
from nerg_mi.jobs.options import option
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.ranges import Range

from .files import EXR, read_stored, shared_note
from .kind import Drawing, Kind, ScaleOptions

_UNITS = {"gaze": "gaze density [1/sr]", "kde": "tracked gaze [1/sr]", "gaze_std": "standard deviation of gaze [1/sr]"}


@dataclass(frozen=True, kw_only=True)
class SheetOptions(ScaleOptions):
    """How pictures are put together."""

    overlay: str | None = option(
        None, "Lay this channel of .exr files over their colour, with one scale: gaze, kde, gaze_std, ..."
    )
    columns: int | None = option(None, "Pictures in a row.  [default: about as many as rows]", within=Range(1, 1000))
    width: int = option(480, "Pixels that a picture is wide at most; larger ones are shrunk.", within=Range(16, 4096))


def _draw_sheet(files: Sequence[Path], options: SheetOptions, reporter: Reporter) -> Drawing:
    """The pictures of ``files``, named by their files."""
    style, pictures, heat = options.style(), [], None
    names = [path.stem for path in files]
    if options.overlay is None:
        for k, path in enumerate(files):
            reporter.progress(k / len(files), path.name)
            pictures.append(shrink(_display(path), options.width))
        return Drawing(contact_sheet(pictures, names, options.columns), list(files))
    tops, notes = [], []
    for path in files:
        stored = read_stored(path, options.overlay)
        notes.append(stored.basis)
        if np.any(stored.values[stored.mask] > 0):
            tops.append(top_of(np.nan_to_num(stored.values), stored.mask))
    top = options.top or max(tops, default=0.0)
    # Raises where there is no scale.
    heat = Heat(top or top_of(np.zeros(1), np.ones(1, bool)), style.colors or "inferno", decades=style.decades)
    values, hatched = [], False
    for k, path in enumerate(files):
        reporter.progress(k / len(files), path.name)
        stored = read_stored(path, options.overlay)
        unknown = ~(stored.mask & np.isfinite(stored.values)) if style.hatched else None
        hatched = hatched or (unknown is not None and bool(unknown.any()))
        pictures.append(shrink(overlay(stored.color, stored.values, heat, stored.mask, unknown), options.width))
        highest = np.max(stored.values, where=stored.mask & np.isfinite(stored.values), initial=0.0)
        values.append((np.array([highest]), np.ones(1, bool)))
    label = _UNITS.get(options.overlay.partition(".")[0], options.overlay)
    note = shared_note(names, notes)
    return Drawing(contact_sheet(pictures, names, options.columns, heat, label, values, hatched, note), list(files))


def _display(path: Path) -> np.ndarray:
    """The picture as it is shown (h, w, 3), in 0..1."""
    from nerg_mi.figures.overlay import srgb
    from nerg_mi.photos.images import read_image
    from nerg_mi.rendering.pictures import activate

    if path.suffix.lower() == EXR:
        from nerg_mi.files.images import read_exr

        found = read_exr(path, "picture")
        if {"R", "G", "B"} <= set(found):
            return srgb(np.stack([found[name] for name in "RGB"], axis=-1))
    activate(None)
    image = read_image(path)
    shown = image / np.iinfo(image.dtype).max if image.dtype.kind == "u" else np.asarray(image, np.float64)
    if shown.shape[2] == 4:
        shown = shown[..., :3] * shown[..., 3:] + 1 - shown[..., 3:]
    return shown[..., :3]


SHEET_KIND = Kind(
    "sheet",
    "Several pictures on one page, with one scale.",
    "pictures (.png, .jpg, .exr)",
    400,
    SheetOptions,
    _draw_sheet,
)
