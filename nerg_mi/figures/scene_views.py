"""Scenes that are rendered for a figure."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_loading import list_scene_files
from nerg_mi.errors import NergError, parameter
from nerg_mi.interruption import Interruption
from nerg_mi.progress import Reporter

from .layers import OnBand


def open_scene(scene: Any, defaults: Mapping[str, str] | None) -> Scene:
    """Open a scene file with ``defaults``, the values of its `<default>`s, or what `Scene.coerce` takes.

    Raises `NergError`.
    """
    if isinstance(scene, (str, os.PathLike)):
        return Scene.load(Path(scene), **(defaults or {}))
    if defaults:
        raise NergError(f"{parameter('defaults')} applies to scene files; load the scene with these values instead")
    return Scene.coerce(scene)


def name_scene(scene: Scene) -> Path:
    """Return the file that a scene was loaded from, or what messages call it."""
    return Path("scene in memory") if scene.source is None else scene.source[0]


def list_files(scene: Scene) -> list[Path]:
    """Return the files of a scene, for the provenance; none of a scene in memory."""
    return [] if scene.source is None else list_scene_files(*scene.source)


def find_camera(scene: Scene, sensor: int) -> Any:
    """Return the sensor with this index. Raises `NergError` if there is none, or if it is no perspective camera."""
    camera = scene.resolve_sensor(sensor)
    if camera.class_name() != "PerspectiveCamera":
        raise NergError(
            f'sensor {sensor} of "{name_scene(scene)}" is not a perspective camera; choose another '
            f"{parameter('sensor')}"
        )
    return camera


@contextmanager
def report_views(reporter: Reporter, count: int = 1) -> Iterator[Callable[[int], OnBand]]:
    """Yield a function that returns what reports the progress of one of ``count`` views, by its index.

    Ctrl-C ends the rendering.
    """
    with Interruption() as stop:

        def report_view(index: int) -> OnBand:
            def on_band(done: int, total: int) -> None:
                stop.check()
                fraction = (index + done / total) / count
                reporter.progress(fraction, f"rendering, {100 * fraction:.0f} %")

            return on_band

        yield report_view
        stop.check()
