"""Figures of image files: contact sheets and differences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np

from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import MissingFile, NergError, parameter
from nerg_mi.files.images import read_exr, read_exr_attributes
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.maths.types import Figure
from nerg_mi.photos.images import read_image
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import POSITIVE_VALUES, Range, check_ranges
from nerg_mi.transport.geometry import SURFACE_OPACITY

from .overlay import Overlay, OverlayLayers, difference_figure, find_channel_overlay, shared_limits, srgb
from .settings import Style
from .style import changed_arguments, check_figure, contact_sheet, finish_figure, shrink

EXR = ".exr"

MAX_IMAGES = 400
"""Maximum number of images on a page."""

MAX_WIDTH = 480
"""Maximum width in pixels of an image on a page; wider ones are reduced."""


@check_ranges
def draw_sheet(
    images: FilePath | Sequence[FilePath],
    output: FilePath | None = None,
    *,
    overlay: str | None = None,
    columns: Annotated[int, Range(1, 1000)] | None = None,
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    style: Style = Style(),
    progress: Progress = None,
) -> Figure:
    """Draw several images on one page, with a common colour scale.

    Parameters
    ----------
    images : path or sequence of path
        Images (.png, .jpg, .exr).
    output : path, optional
        Figure to write (.png, .svg or .pdf).
    overlay : str, optional
        AOV of .exr files drawn over their colour, with a common colour scale: gaze, kde, depth or any other. Default:
        colour only.
    columns : int, optional
        Number of images in a row. Default: about the number of rows.
    vmax : float, optional
        Upper end of the colour scale, in the unit of the values. Default: the 99.5th percentile.
    style : Style
        Colours of the AOV (`nerg_mi.figures.settings.Style`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        An argument is invalid, or an image cannot be read or has no such AOV.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=48, height=32)
    >>> pictures = [nerg.render_film(scene, folder / f"{spp}.exr", spp=spp).path for spp in (1, 2)]
    >>> len(nerg.draw_sheet(pictures, overlay="gaze").axes)
    3
    """
    changed = changed_arguments(draw_sheet, locals())
    check_figure(output)
    paths = _list_images(cast("Sequence[FilePath]", images if isinstance(images, (list, tuple)) else [images]))
    shown = None if overlay is None else find_channel_overlay(overlay)
    with open_reporter(progress) as reporter:
        if shown is None:
            pictures = []
            for k, path in enumerate(paths):
                reporter.progress(k / len(paths), path.name)
                pictures.append(shrink(_read_display(path), MAX_WIDTH))
            figure = contact_sheet(pictures, [path.stem for path in paths], columns)
        else:
            figure = _draw_overlays(paths, shown, columns, vmax, style, reporter)
        return finish_figure(figure, output, "nerg draw sheet", paths, None, changed, reporter)


def _list_images(images: Sequence[FilePath]) -> list[Path]:
    """Return the files of a page. Raises `NergError` for too many, and for one that does not exist."""
    paths = [to_path(image) for image in images]
    if not 1 <= len(paths) <= MAX_IMAGES:
        raise NergError(f"a page has 1 to {MAX_IMAGES} images, got {len(paths)}")
    for path in paths:
        if not path.exists():
            raise MissingFile(f'there is no file "{path}"')
    return paths


def _draw_overlays(
    paths: Sequence[Path], overlay: Overlay, columns: int | None, vmax: float | None, style: Style, reporter: Reporter
) -> Any:
    """Draw an AOV over the colour of each image, on one scale."""
    overlay.check_style(style)
    limits, notes = [], []
    for path in paths:
        stored = read_aov(path, overlay)
        notes.append(stored.support_note)
        limits.append(overlay.limits(stored))
    ends = shared_limits(limits, vmax)
    overlay.check_limits(ends)
    names = [path.stem for path in paths]
    pictures, explained, hatched = [], [], False
    for k, path in enumerate(paths):
        reporter.progress(k / len(paths), path.name)
        stored = read_aov(path, overlay)
        seen = stored.mask & np.isfinite(stored.values)
        unknown = ~seen if style.hatching else None
        hatched = hatched or (unknown is not None and bool(unknown.any()))
        pictures.append(shrink(overlay.paint(stored, ends, style, unknown), MAX_WIDTH))
        # Two extreme values are enough for a scale.
        outermost = [stored.values[seen].min(), stored.values[seen].max()] if seen.any() else []
        explained.append(OverlayLayers(stored.color, np.array(outermost), np.ones(len(outermost), bool)))
    scale = lambda sheet: overlay.add_scale(sheet, explained, ends, style, hatched)
    note = shared_note(names, notes)
    return contact_sheet(pictures, names, columns, scale, note)


@check_ranges
def draw_difference(
    first: FilePath,
    second: FilePath,
    output: FilePath | None = None,
    *,
    channel: str = "gaze",
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    progress: Progress = None,
) -> Figure:
    """Draw the difference of a channel between two images.

    Parameters
    ----------
    first : path
        Image (.exr).
    second : path
        Image (.exr) that is subtracted from the first.
    output : path, optional
        Figure to write (.png, .svg or .pdf).
    channel : str
        Name of the channel, which both files must have.
    vmax : float, optional
        Upper end of the colour scale, which is symmetric about 0. Default: the 99.5th percentile.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        An argument is invalid, or the images differ in size.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=48, height=32)
    >>> pictures = [nerg.render_film(scene, folder / f"{spp}.exr", spp=spp).path for spp in (1, 2)]
    >>> nerg.draw_difference(*pictures).axes[0].get_title()
    '1 minus 2'
    """
    changed = changed_arguments(draw_difference, locals())
    check_figure(output)
    paths = _list_images([first, second])
    overlay = find_channel_overlay(channel)
    if overlay.display.kind == "categorical":
        raise NergError(f'"{overlay.name}" is categorical and has no difference; choose another {parameter("channel")}')
    with open_reporter(progress) as reporter:
        before, after = (read_aov(path, overlay) for path in paths)
        if before.values.shape != after.values.shape:
            sizes = " and ".join(f"{v.shape[1]} x {v.shape[0]}" for v in (before.values, after.values))
            raise NergError(f"images of {sizes} pixels cannot be compared; render both in the same size")
        names, unit = [path.stem for path in paths], overlay.quantity.unit
        figure = difference_figure(
            before.values,
            after.values,
            before.mask & after.mask,
            f"{names[0]} minus {names[1]}",
            f"difference of {overlay.name}" + (f" [{unit}]" if unit else ""),
            vmax,
            "RdBu_r",
            shared_note(names, [before.support_note, after.support_note]),
        )
        return finish_figure(figure, output, "nerg draw difference", paths, None, changed, reporter)


def _read_display(path: Path) -> np.ndarray:
    """Return the image as displayed (h, w, 3), in 0..1."""
    if path.suffix.lower() == EXR:
        channels = read_exr(path, "picture")
        if {"R", "G", "B"} <= set(channels):
            return srgb(np.stack([channels[name] for name in "RGB"], axis=-1))
    activate_mitsuba()
    image = read_image(path)
    shown = image / np.iinfo(image.dtype).max if image.dtype.kind == "u" else np.asarray(image, np.float64)
    if shown.shape[2] == 4:
        shown = shown[..., :3] * shown[..., 3:] + 1 - shown[..., 3:]
    return shown[..., :3]


def shared_note(names: Sequence[str], basis: Sequence[str]) -> str:
    """Return a line on the data behind several images: once if it is the same, else by their names."""
    if len(set(basis)) == 1:
        return basis[0]
    return "; ".join(f"{name}: {words or 'unknown'}" for name, words in zip(names, basis))


def read_aov(path: Path, overlay: Overlay) -> OverlayLayers:
    """Read the AOV of ``overlay`` from the EXR file ``path``.

    Without an opacity channel, all pixels count as surfaces. Raises `NergError` for other files, and if there is no
    such channel.
    """
    if path.suffix.lower() != EXR:
        raise NergError(f'"{path}" is not an EXR file and has no AOVs; give one that "nerg render" has written')
    channels = read_exr(path, "picture")
    values = next((channels[name] for name in channels if overlay.name in (name, name.partition(".")[0])), None)
    if values is None:
        raise NergError(f'"{path}" has no channel "{overlay.name}"; it has {", ".join(channels)}')
    color = [channels[name] for name in "RGB"] if {"R", "G", "B"} <= set(channels) else [np.zeros_like(values)] * 3
    opacity = channels.get("opacity.Y")
    mask = np.ones(values.shape, bool) if opacity is None else opacity >= SURFACE_OPACITY
    as_floats = lambda array: np.nan_to_num(np.asarray(array, np.float32))
    part = overlay.quantity.data_source
    basis = read_exr_attributes(path, "picture").get(f"{part}.basis", "") if part else ""
    return OverlayLayers(as_floats(np.stack(color, axis=-1)), np.asarray(values, np.float32), mask, support_note=basis)
