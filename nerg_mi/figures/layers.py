"""Images of scenes to draw on: the colour of a view with a quantity over it, smoothed, and what is known about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.bands import Channels, is_nerg, render_aovs, require_nerg
from nerg_mi.environment.scene_writer import project_to_pixel
from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.transport.aovs import AOVS
from nerg_mi.transport.observer import sensor_center
from nerg_mi.transport.volume_medium import VolumeMedium

from .overlay import Overlay, OverlayLayers
from .settings import SMOOTHING
from .shading import draw_outlines, smooth_on_surfaces

OnBand = Callable[[int, int], None]
"""Called with the number of completed samples and of all samples."""

_MIN_VISIBILITY = 1e-3
"""Visibility from which a density is divided by it."""


SUPPORT = 1.0
"""Support in rays below which the gaze of an observer counts as unknown: nothing was recorded within five radii of a
probe (docs/explanation/measurements.md, "Support and error")."""


def render_layers(
    path: Path,
    loaded: Any,
    camera: Any,
    overlay: Overlay,
    spp: int = 0,
    seed: int = 0,
    on_strip: OnBand | None = None,
    smoothing: float = 0.0,
) -> OverlayLayers:
    """Render ``camera`` with the AOV of ``overlay``; also return the observer's pixel and the data behind the AOV.

    Surfaces without light are outlined. ``smoothing``: standard deviation in degrees by which a density seen by a
    perspective camera is smoothed on surfaces.
    """
    require_nerg(path, loaded)
    quantity = overlay.quantity
    has_outlines = shows_unlit_surfaces(loaded)
    sigma = smoothing * pixels_per_degree(camera) if quantity.display.kind == "heat" else 0.0
    aovs = [quantity.name, "opacity", "depth", *["position"] * has_outlines, *["visibility"] * (sigma > 0)]
    aovs = list(dict.fromkeys(aovs))
    with translate_mitsuba_errors():
        channels = render_aovs(path, loaded, camera, aovs, spp, seed, on_strip)
    if overlay.name not in channels.aovs:
        raise NergError(f'"{path}" has no "{overlay.name}"; it has {", ".join(channels.aovs)}')
    marker = observer_pixel(loaded, camera, channels.aovs["depth"])
    supported = not quantity.needs_support or is_supported(loaded, camera)
    basis = describe_basis(loaded, quantity.data_source)
    color, values = channels.color, channels.aovs[overlay.name]
    if has_outlines:
        position = np.stack([channels.aovs[f"position.{axis}"] for axis in "XYZ"], axis=-1)
        color = draw_outlines(color, position, channels.mask)
    if sigma > 0:
        values = _smooth_density(values, channels, loaded, sigma)
        basis = describe_smoothing(basis, smoothing)
    return OverlayLayers(color, values, channels.mask, marker, supported, basis)


def _smooth_density(values: np.ndarray, channels: Channels, loaded: Any, sigma: float) -> np.ndarray:
    """Smooth a density (h, w) on surfaces, divided by the visibility before, so that shadows keep their border."""
    visible = channels.aovs["visibility"] if loaded.integrator().occlusion else 1.0
    weights = np.where(channels.mask, visible, 0.0)
    weights = np.where(weights > _MIN_VISIBILITY, weights, 0.0)
    unoccluded = np.divide(values, weights, out=np.zeros_like(weights), where=weights > 0)
    return weights * smooth_on_surfaces(unoccluded, weights, channels.aovs["depth"], sigma)


def smooth_gaze(channels: Channels, loaded: Any, camera: Any, smoothing: float = SMOOTHING) -> Channels:
    """Return the image of ``camera`` with its AOV ``gaze`` smoothed by ``smoothing`` degrees on surfaces.

    It needs the AOV ``depth``, and ``visibility`` if the scene has occlusion.
    """
    width = channels.mask.shape[1] / camera.film().crop_size()[0]
    sigma = smoothing * pixels_per_degree(camera) * width
    if not sigma > 0:
        return channels
    gaze = _smooth_density(channels.aovs["gaze"], channels, loaded, sigma)
    return replace(channels, aovs={**channels.aovs, "gaze": gaze})


def describe_smoothing(basis: str, smoothing: float = SMOOTHING) -> str:
    """Return the note ``basis`` on the data with a note on the smoothing."""
    return "; ".join(filter(None, [basis, f"smoothed by {smoothing:g}°"]))


def shows_unlit_surfaces(loaded: Any) -> bool:
    """Return whether the surfaces of a scene have neither light nor colours of photos: shapes without emitters, or hit
    points."""
    integrator = loaded.integrator()
    is_volume = integrator.medium is None or isinstance(integrator.medium, VolumeMedium)
    return is_volume and integrator.shading.nested is None and not len(loaded.emitters())


def pixels_per_degree(camera: Any) -> float:
    """Return the pixels per degree in the centre of the image of a perspective ``camera``; 0 for other cameras."""
    import mitsuba as mi

    if camera.class_name() != "PerspectiveCamera":
        return 0.0
    half = np.radians(float(np.ravel(np.array(mi.traverse(camera)["x_fov"]))[0])) / 2
    return float(np.radians(1) * camera.film().size()[0] / 2 / np.tan(half))


def describe_basis(loaded: Any, part: str = "gaze") -> str:
    """Describe the rays and participants behind a ``part`` of the scene, "gaze" or "kde"; "" if unknown."""
    volume = loaded.integrator().children.get(part)
    if volume is None:
        return ""
    basis = volume.kde_view().basis if part == "kde" else volume.field.basis
    return "" if basis is None else f"data: {basis.words()}"


def describe_bases(loaded: Any) -> dict[str, str]:
    """Return these descriptions for image headers, under the keys "gaze.basis" and "kde.basis"."""
    if not is_nerg(loaded.integrator()):
        return {}
    parts = dict.fromkeys(aov.data_source for aov in AOVS.values() if aov.data_source)
    words = {f"{part}.basis": describe_basis(loaded, part) for part in parts}
    return {name: text for name, text in words.items() if text}


def is_supported(loaded: Any, camera: Any) -> bool:
    """Return whether at least `SUPPORT` rays were recorded around the observer of the scene, or else the ``camera``.

    A gaze field that does not store its support counts as supported.
    """
    integrator = loaded.integrator()
    gaze = integrator.gaze
    if gaze is None or gaze.field.support is None:
        return True
    eye = sensor_center(integrator.observer or camera)
    return float(np.ravel(np.array(gaze.field.support.evaluate(gaze.to_world.point_to_local(eye))))[0]) >= SUPPORT


def observer_pixel(loaded: Any, camera: Any, depth: np.ndarray) -> tuple[float, float] | None:
    """Return the pixel of the scene's observer if it is visible from ``camera``, else None."""
    observer = loaded.integrator().observer
    if observer is None or camera.class_name() != "PerspectiveCamera":
        return None
    eye = sensor_center(observer)
    pixel = project_to_pixel(camera, eye)
    if pixel is None:
        return None
    column, row = (int(np.clip(round(v), 0, n - 1)) for v, n in zip(pixel, depth.shape[::-1]))
    away = float(np.linalg.norm(np.ravel(np.array(eye - sensor_center(camera)))))
    before = depth[row, column]
    return pixel if not 0 < before < away else None
