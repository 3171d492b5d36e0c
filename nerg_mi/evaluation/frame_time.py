"""How long the integrator takes for a frame of gaze, observer and camera in one place."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerg_mi.errors import mitsuba_says
from nerg_mi.formats.splats.files import plugin_of_field
from nerg_mi.train.geometry import GazePlace, volume_dict
from nerg_mi.transport.geometry import Place


def frame_timer(
    place: GazePlace,
    centres: np.ndarray,
    folder: Path,
    cameras: int = 4,
    width: int = 320,
    height: int = 180,
    seed: int = 0,
) -> Callable[[Path], float] | None:
    """``render(checkpoint)``: mean seconds a frame of ``cameras`` at random ``centres`` (T, 3), looking about level;
    None where there is nothing to render, and for a scene of shapes that also has a field.

    ``folder``: where the file of the place is. The first render of each checkpoint, which compiles, does not count; the
    integral of a normalised field does, since each camera has one of its own.
    """
    import mitsuba as mi

    if place.kind == "none" or (isinstance(place.medium, Place) and place.medium.medium is not None):
        return None
    rng = np.random.default_rng(seed)
    eyes, angles = centres[rng.integers(0, len(centres), cameras)], rng.uniform(0, 2 * np.pi, cameras)

    def render(checkpoint: Path) -> float:
        integrator = {"type": "nerg", "aovs": "gaze", "radiance": False, **_medium(place, folder)}
        integrator["gaze"] = {"type": "gazefield", "filename": str(checkpoint)}
        with mitsuba_says():
            scene = mi.load_dict({"type": "scene", "integrator": integrator, **_shapes(place)})
        times = []
        for eye, angle in [(eyes[0], angles[0]), *zip(eyes, angles)]:
            target = eye + (np.cos(angle), np.sin(angle), -0.1)
            sensor = mi.load_dict(
                {
                    "type": "perspective",
                    "fov": 70,
                    "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), target.tolist(), [0, 0, 1]),
                    "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
                    "sampler": {"type": "independent", "sample_count": 1},
                }
            )
            started = time.perf_counter()
            np.array(mi.render(scene, sensor=sensor))
            times.append(time.perf_counter() - started)
        return float(np.mean(times[1:]))

    return render


def _medium(place: GazePlace, folder: Path) -> dict:
    """What the integrator of ``place`` marches, as parameters of its plugin."""
    if place.kind == "field":
        path = folder / place.about["field_file"]["file"]
        return {"field": {"type": plugin_of_field(path), "filename": str(path)}}
    if place.kind == "hits":
        return {"density": volume_dict(folder / place.about["geometry_file"]["file"])}
    return {}


def _shapes(place: GazePlace) -> dict:
    """The shapes of ``place``, as children of a scene."""
    scene = place.medium.scene if isinstance(place.medium, Place) else None
    return {} if scene is None else {f"shape{i}": s for i, s in enumerate(scene.shapes())}
