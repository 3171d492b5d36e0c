"""A contact sheet: several pictures on one page, with one scale where a quantity lies over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.figures.overlay import Layers, find_stored, shared_limits
from nerg_mi.figures.sheets import contact_sheet, shrink
from nerg_mi.jobs.options import option
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.ranges import Range

from .files import EXR, read_stored, shared_note
from .kind import Drawing, Kind, ScaleOptions


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
    pictures = []
    names = [path.stem for path in files]
    if options.overlay is None:
        for k, path in enumerate(files):
            reporter.progress(k / len(files), path.name)
            pictures.append(shrink(_display(path), options.width))
        return Drawing(contact_sheet(pictures, names, options.columns), list(files))
    overlay = find_stored(options.overlay)
    style = options.style(kind=overlay.color_kind)
    limits, notes = [], []
    for path in files:
        stored = read_stored(path, overlay)
        notes.append(stored.basis)
        limits.append(overlay.limits(stored))
    ends = shared_limits(limits, options.top)
    overlay.check_limits(ends)
    explained, hatched = [], False
    for k, path in enumerate(files):
        reporter.progress(k / len(files), path.name)
        stored = read_stored(path, overlay)
        seen = stored.mask & np.isfinite(stored.values)
        unknown = ~seen if style.hatched else None
        hatched = hatched or (unknown is not None and bool(unknown.any()))
        pictures.append(shrink(overlay.paint(stored, ends, style, unknown), options.width))
        # Of all values the outermost are enough for a scale.
        outermost = [stored.values[seen].min(), stored.values[seen].max()] if seen.any() else []
        explained.append(Layers(stored.color, np.array(outermost), np.ones(len(outermost), bool)))
    scale = lambda sheet: overlay.add_scale(sheet, explained, ends, style, hatched)
    note = shared_note(names, notes)
    return Drawing(contact_sheet(pictures, names, options.columns, scale, note), list(files))


def _display(path: Path) -> np.ndarray:
    """The picture as it is shown (h, w, 3), in 0..1."""
    from nerg_mi.figures.overlay import srgb
    from nerg_mi.photos.images import read_image
    from nerg_mi.rendering.scene import activate

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
