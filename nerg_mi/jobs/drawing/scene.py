"""A scene file opened for a figure, and what its cameras see."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Layers, Overlay
from nerg_mi.interruption import Interruption
from nerg_mi.jobs.overlays import layers_of
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.rendering.aovs import nerg_of
from nerg_mi.rendering.scene import activate, load_scene

from .kind import SceneOptions

MOST_PIXELS = 1 << 23
"""A figure is drawn in one piece, in double precision, some 200 bytes a pixel; a film of 3,840 x 2,160 is allowed."""


class OpenScene:
    """The scene file ``path`` as it is loaded, its integrator ``nerg`` and its ``camera``.

    ``see`` renders, and tells of it as the next of ``parts`` pictures. Made by `open_scene`.
    """

    def __init__(self, path: Path, scene: Any, options: SceneOptions, tell: Callable[[float], None], parts: int):
        self.path, self.scene, self._options = path, scene, options
        self.nerg = nerg_of(path, scene)
        if not scene.sensors():
            raise NergError(f'"{path}" has no sensor; give it one')
        self._tell, self._parts, self._done = tell, parts, 0

    def camera(self, index: int) -> Any:
        """The sensor with this ``index``. Raises `NergError` for one that is not there."""
        count = len(self.scene.sensors())
        if not 0 <= index < count:
            raise NergError(
                f'"{self.path}" has {count} sensor(s) and number {index} was asked for: choose -s from 0 on'
            )
        return self.scene.sensors()[index]

    def see(self, sensor: Any, overlay: Overlay) -> Layers:
        """What ``sensor`` sees with the ``overlay``'s quantity."""
        options, first = self._options, self._done
        on_strip = lambda part, total: self._tell((first + part / total) / self._parts)
        found = layers_of(self.path, self.scene, sensor, overlay, options.spp, options.seed, on_strip)
        self._done += 1
        return found


@contextmanager
def open_scene(path: Path, options: SceneOptions, reporter: Reporter, parts: int = 1) -> Iterator[OpenScene]:
    """The scene file ``path``, of which ``parts`` pictures will be rendered within the block, which Ctrl-C ends. Raises
    `NergError` for what is none, or has another integrator than `nerg`."""
    activate(options.mode)
    with Interruption() as stop:

        def tell(share: float) -> None:
            stop.check()
            reporter.progress(share, f"rendering, {100 * share:.0f} %")

        loaded = load_scene(path, options.defaults)
        stop.check()
        yield OpenScene(path, loaded, options, tell, parts)
        stop.check()


def upright_pose(sensor: Any) -> Any:
    """A pose (scalar transform) at the place of ``sensor``, turned to the same side but level: its up is the axis of
    the scene that is nearest to the sensor's."""
    import mitsuba as mi

    matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    eye, up, ahead = matrix[:3, 3], matrix[:3, 1], matrix[:3, 2]
    axis = int(np.argmax(np.abs(up)))
    level = np.zeros(3)
    level[axis] = np.sign(up[axis]) or 1.0
    heading = ahead - level * (ahead @ level)
    if np.linalg.norm(heading) < 1e-3 * np.linalg.norm(ahead):
        heading = np.roll(level, 1)  # it looks straight up or down
    heading = heading / np.linalg.norm(heading)
    look_at = mi.ScalarTransform4f().look_at
    return look_at(origin=eye.tolist(), target=(eye + heading).tolist(), up=level.tolist())


def film(width: int, height: int) -> dict[str, Any]:
    """A film of so many pixels on which no value is blended with its neighbours'. Raises `NergError` for too many."""
    if width * height > MOST_PIXELS:
        raise NergError(
            f"a figure of {width:,} x {height:,} pixels is too large to be drawn in one piece; ask for less"
        )
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }


def sampler_like(sensor: Any) -> dict[str, Any]:
    """As many samples a pixel as ``sensor`` has, drawn independently."""
    return {"type": "independent", "sample_count": int(sensor.sampler().sample_count())}
