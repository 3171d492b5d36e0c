"""Camera paths of nerfstudio (``camera_path.json``), as its viewer saves them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_json, translate_read_errors
from nerg_mi.files.schema import NUMBER, Items, Number, check_json
from nerg_mi.maths.transforms import check_rigid_transforms, correct_rotation

MAX_FRAMES = 100_000
"""Maximum number of frames of a path."""

_POSITIVE, _PIXELS = Number(1e-6, 1e6), Number(1, 1 << 20)
_PATH = {
    "camera_path": Items({"camera_to_world": Items(NUMBER, 16, 16), "fov": Number(1e-6, 179.999)}, 1, MAX_FRAMES),
    "render_width": _PIXELS,
    "render_height": _PIXELS,
    "fps?": _POSITIVE,
}


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A sequence of perspective cameras.

    Attributes
    ----------
    to_world
        Poses (N, 4, 4) of OpenGL: right, up, backwards, position.
    fov
        Vertical fields of view (N,) in degrees.
    width, height
        Size of the images in pixels.
    fps
        Frames per second.
    """

    to_world: np.ndarray
    fov: np.ndarray
    width: int
    height: int
    fps: float

    @property
    def horizontal_fov(self) -> np.ndarray:
        """Horizontal fields of view (N,) in degrees."""
        half = np.tan(np.radians(self.fov) / 2) * self.width / self.height
        return 2 * np.degrees(np.arctan(half))


def read_camera_path(path: str | os.PathLike) -> CameraPath:
    """Read the camera path in ``path``.

    Raises `NergError` for another file, for cameras that are not perspective, and for poses that are not rotations.
    """
    data: Any = read_json(path, "camera path")
    with translate_read_errors(path, "camera path", "save it again"):
        kind = check_json(data, {}).get("camera_type", "perspective")
        if kind != "perspective":
            raise NergError(
                f'the cameras of "{path}" are of type "{sanitize(kind, 40)}"; save a path of perspective cameras'
            )
        frames = check_json(data, _PATH)["camera_path"]
        to_world = np.array([frame["camera_to_world"] for frame in frames], np.float64).reshape(-1, 4, 4)
        fov = np.array([frame["fov"] for frame in frames], np.float64)
        check_rigid_transforms(to_world, f'the camera_to_world of "{path}"', lambda k: f"frame {k + 1}")
        to_world[:, :3, :3] = [correct_rotation(linear) for linear in to_world[:, :3, :3]]
        width, height = int(data["render_width"]), int(data["render_height"])
        fps = float(data.get("fps", 24))
    return CameraPath(to_world, fov, width, height, fps)
