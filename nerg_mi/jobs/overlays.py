"""Pictures with a quantity laid over their colour, alone or as a sequence with one scale."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.figures import style
from nerg_mi.figures.overlay import Layers, Limits, Overlay, Style, find_overlay, shared_limits
from nerg_mi.figures.style import find_colors
from nerg_mi.files.atomic import write_bytes
from nerg_mi.interruption import Interruption
from nerg_mi.rendering.aovs import is_nerg, render_asked
from nerg_mi.rendering.scene_writer import pixel_of
from nerg_mi.transport.aovs import AOVS
from nerg_mi.transport.observer import center

from .options.pictures import PictureOptions

BYTES_PER_PIXEL = 400
"""Memory that drawing an overlay takes for a pixel, at most: matplotlib keeps colours in double precision."""


@dataclass(frozen=True)
class Picture:
    """``size`` (width, height) in pixels, number of ``channels``, and why it was not divided, as `PictureResult` has
    them."""

    size: tuple[int, int]
    channels: int
    whole: str | None = None


OVERLAY_FORMATS = (*style.FORMATS, ".mp4")

OnStrip = Callable[[int, int], None]
"""Is told how many samples are done, and of how many."""

Make = Callable[[Any, Any, OnStrip], Picture]
"""Makes a picture of a scene, a sensor, and a function that is told of each strip."""


_OF_OVERLAYS = (("top", None), ("cmap", None), ("decades", 0.0), ("hatching", True))

SUPPORT = 1.0
"""Support, in rays, below which an observer's gaze counts as not known: nobody was recorded within five radii of a
probe (docs/gaze-evaluation.md)."""


def check_overlay(output: Path, options: PictureOptions) -> None:
    """Raise `NergError` for options of an overlay that contradict each other."""
    if options.overlay is None:
        for name, default in _OF_OVERLAYS:
            if getattr(options, name) != default:
                flag = "--no-hatching" if name == "hatching" else f"--{name}"
                raise NergError(f"{flag} is about an overlay, and there is none; give --overlay, too")
        return
    overlay = find_overlay(options.overlay)
    if output.suffix.lower() not in OVERLAY_FORMATS:
        raise NergError(
            f'an overlay is a picture to look at, and "{output}" is none: let its name end in '
            f"{' or '.join(OVERLAY_FORMATS)} (an .exr holds the quantity itself, if the scene's aovs name it)"
        )
    if options.cmap is not None:
        find_colors(options.cmap, overlay.color_kind)


def overlay_pictures(
    path: Path,
    frames: Sequence[Mapping[str, str]],
    write: Callable[[Any], None],
    options: PictureOptions,
    render: Callable[[Mapping[str, str], Make], Picture],
    stop: Interruption,
) -> tuple[Picture, float | None]:
    """Give ``write`` a figure with the overlay of ``options`` for each of ``frames``, values of `<default>`s of the
    scene file ``path``, one after the other. Gives the last one, and the upper end of the scale of all, None where
    there is none.

    ``render``: loads the scene of a frame and lets a picture be made of it. Pictures of a sequence wait on the disk
    until the scale is known, and not at all where it is given. Raises `NergError` where the quantity is 0 everywhere.
    """
    overlay = find_overlay(options.overlay or "")
    style = style_of(options)
    limits: list[Limits] = []
    last = Picture((0, 0), 0)
    waits = shares_a_scale(overlay, len(frames), options)

    def finish(layers: Layers, ends: Limits) -> None:
        overlay.check_limits(ends)
        write(overlay.draw(layers, ends, style))
        stop.check()

    with tempfile.TemporaryDirectory() as folder:
        kept: list[tuple[Path, tuple[int, ...], Any, bool, str]] = []

        def make(loaded: Any, camera: Any, on_strip: OnStrip) -> Picture:
            check_memory(path, camera, options)
            layers = layers_of(path, loaded, camera, overlay, options.spp, options.seed, on_strip)
            limits.append(overlay.limits(layers))
            height, width = layers.mask.shape
            if waits:
                array = stacked(layers)
                file = Path(folder, str(len(kept)))
                write_bytes(file, array.data)
                kept.append((file, array.shape, layers.marker, layers.supported, layers.basis))
            else:
                finish(layers, shared_limits(limits[-1:], options.top))
            return Picture((width, height), 3)

        for frame in frames:
            last = render(frame, make)
        ends = shared_limits(limits, options.top)
        for file, shape, marker, supported, basis in kept:
            finish(unstacked(np.fromfile(file, np.float32).reshape(shape), marker, supported, basis), ends)
            file.unlink()
    return last, None if ends is None else ends[1]


def style_of(options: PictureOptions) -> Style:
    """How ``options`` have overlays drawn."""
    return Style(options.cmap, options.decades, options.hatching)


def shares_a_scale(overlay: Overlay, count: int, options: PictureOptions) -> bool:
    """Whether none of ``count`` pictures can be drawn before all are rendered."""
    return count > 1 and overlay.scaled and (options.top is None or not overlay.is_scaled_by_top)


def stacked(layers: Layers) -> np.ndarray:
    """Colour, values and mask of ``layers`` as one array (h, w, 5) of float32."""
    array = np.concatenate([layers.color, layers.values[..., None], layers.mask[..., None]], axis=-1)
    return np.ascontiguousarray(array, np.float32)


def unstacked(array: np.ndarray, marker: tuple[float, float] | None, supported: bool, basis: str) -> Layers:
    """What `stacked` was given, with its ``marker``, whether it is ``supported``, and its ``basis`` in words."""
    return Layers(array[..., :3], array[..., 3], array[..., 4] > 0.5, marker, supported, basis)


def check_memory(path: Path, camera: Any, options: PictureOptions) -> None:
    """Raise `NergError` where drawing the overlay of a picture takes more than it may."""
    width, height = map(int, camera.film().crop_size())
    needed = BYTES_PER_PIXEL * width * height / 1e9
    if needed > options.memory:
        raise NergError(
            f"an overlay of {width:,} x {height:,} pixels is drawn in one piece, for which it takes {needed:.2g} GB; "
            f'give --memory {needed:.1f}, or a smaller picture of "{path}"'
        )


def layers_of(
    path: Path, loaded: Any, camera: Any, overlay: Overlay, spp: int = 0, seed: int = 0, on_strip: OnStrip | None = None
) -> Layers:
    """What ``camera`` sees of the scene ``loaded`` from ``path`` with the quantity of ``overlay``, and who is there."""
    quantity = overlay.quantity
    asked = list(dict.fromkeys([quantity.name, "opacity", "depth"]))
    with mitsuba_says():
        found = render_asked(path, loaded, camera, asked, spp, seed, on_strip)
    if overlay.name not in found.aovs:
        raise NergError(f'"{path}" has no "{overlay.name}"; it has {", ".join(found.aovs)}')
    marker = observer_pixel(loaded, camera, found.aovs["depth"])
    supported = not quantity.needs_support or is_supported(loaded, camera)
    basis = basis_words(loaded, quantity.rests_on)
    return Layers(found.color, found.aovs[overlay.name], found.mask, marker, supported, basis)


def basis_words(loaded: Any, part: str = "gaze") -> str:
    """Rays and people that a ``part`` of the scene rests on, "gaze" or "kde", in words; "" where that is not known."""
    volume = loaded.integrator().children.get(part)
    if volume is None:
        return ""
    basis = volume.kde_view().basis if part == "kde" else volume.field.basis
    return "" if basis is None else f"made of {basis.words()}"


def basis_texts(loaded: Any) -> dict[str, str]:
    """The same for the header of a picture, by the names under which `jobs.drawing` finds it: "gaze.basis" and
    "kde.basis", as far as they are known."""
    if not is_nerg(loaded.integrator()):
        return {}
    parts = dict.fromkeys(aov.rests_on for aov in AOVS.values() if aov.rests_on)
    words = {f"{part}.basis": basis_words(loaded, part) for part in parts}
    return {name: text for name, text in words.items() if text}


def is_supported(loaded: Any, camera: Any) -> bool:
    """Whether anybody was recorded around the observer, that of the scene or else the ``camera``: `SUPPORT` rays at
    least. A gaze field that does not tell where it learnt counts as knowing."""
    integrator = loaded.integrator()
    gaze = integrator.gaze
    if gaze is None or gaze.field.support is None:
        return True
    eye = center(integrator.observer or camera)
    return float(np.ravel(np.array(gaze.field.support.at(gaze.to_world.point_to_local(eye))))[0]) >= SUPPORT


def observer_pixel(loaded: Any, camera: Any, depth: np.ndarray) -> tuple[float, float] | None:
    """The pixel at which the scene's observer stands, if the ``camera`` sees them."""
    observer = loaded.integrator().observer
    if observer is None or camera.class_name() != "PerspectiveCamera":
        return None
    eye = center(observer)
    found = pixel_of(camera, eye)
    if found is None:
        return None
    column, row = (int(np.clip(round(v), 0, n - 1)) for v, n in zip(found, depth.shape[::-1]))
    away = float(np.linalg.norm(np.ravel(np.array(eye - center(camera)))))
    before = depth[row, column]
    return found if not 0 < before < away else None
