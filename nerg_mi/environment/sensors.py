"""Sensors that figures need besides those of a scene: level poses, films, samplers, the view of an observer, and
warnings of observers outside the recorded positions."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.progress import Reporter
from nerg_mi.transport.extrapolation import describe_extrapolation
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import sensor_center

from .bands import is_nerg

MAX_PIXELS = 1 << 23
"""Maximum number of pixels: a figure is drawn in one piece in double precision, with about 200 bytes per pixel."""


def upright_pose(sensor: Any) -> Any:
    """Return the pose (scalar transform) of ``sensor`` levelled.

    Its up direction is the scene axis that is nearest to the sensor's.
    """
    import mitsuba as mi

    matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    eye, up, ahead = matrix[:3, 3], matrix[:3, 1], matrix[:3, 2]
    axis = int(np.argmax(np.abs(up)))
    level = np.zeros(3)
    level[axis] = np.sign(up[axis]) or 1.0
    heading = ahead - level * (ahead @ level)
    if np.linalg.norm(heading) < 1e-3 * np.linalg.norm(ahead):
        heading = np.roll(level, 1)  # the sensor looks straight up or down
    heading = heading / np.linalg.norm(heading)
    look_at = mi.ScalarTransform4f().look_at
    return look_at(origin=eye.tolist(), target=(eye + heading).tolist(), up=level.tolist())


def make_film(width: int, height: int) -> dict[str, Any]:
    """Return a film with a box filter. Raises `NergError` for too many pixels."""
    if width * height > MAX_PIXELS:
        raise NergError(f"a figure of {width:,} x {height:,} pixels is too large; reduce its size")
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }


def copy_sampler(sensor: Any) -> dict[str, Any]:
    """Return an independent sampler with the sample count of ``sensor``."""
    return {"type": "independent", "sample_count": int(sensor.sampler().sample_count())}


def make_observer_camera(observer: Any, camera: Any) -> Any:
    """Return a camera at the pose of ``observer`` with the field of view and film of ``camera``."""
    import mitsuba as mi

    width, height = map(int, camera.film().crop_size())
    matrix = np.array(observer.world_transform().matrix, np.float64).reshape(4, 4)
    settings = {
        "type": "perspective",
        "fov": float(np.ravel(np.array(mi.traverse(camera)["x_fov"]))[0]),
        "fov_axis": "x",
        "near_clip": camera.near_clip(),
        "far_clip": camera.far_clip(),
        "to_world": mi.ScalarTransform4f(matrix.tolist()),
        "film": make_film(width, height),
        "sampler": copy_sampler(camera),
    }
    return mi.load_dict(settings)


def describe_observer(loaded: Any) -> str:
    """Return a sentence if the observer of a ``loaded`` scene is at a position where gaze and visibility are
    extrapolated, else ""."""
    integrator = loaded.integrator()
    if not is_nerg(integrator) or integrator.observer is None:
        return ""
    position = np.ravel(np.array(sensor_center(integrator.observer), np.float64))
    return describe_extrapolation(SceneGeometry(integrator.medium, loaded), integrator.gaze, position)


def warn_observer(loaded: Any, reporter: Reporter) -> None:
    """Warn with the sentence of `describe_observer`, if there is one."""
    if sentence := describe_observer(loaded):
        reporter.warn(sentence)
