"""Camera paths of nerfstudio (``camera_path.json``), as its viewer saves them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_text
from nerg_mi.files.safe_read import MAX_JSON_BYTES, read_bytes, translate_read_errors

MAX_FRAMES = 100_000
"""Maximum number of frames of a path."""


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
    raw = read_bytes(path, "camera path", MAX_JSON_BYTES)
    with translate_read_errors(
        path, "camera path", "save it again", extra_errors=(KeyError, TypeError, AttributeError)
    ):
        data = json.loads(raw)
        kind = data.get("camera_type", "perspective")
        if kind != "perspective":
            raise NergError(f'the cameras of "{path}" are of type "{kind}"; save a path of perspective cameras')
        frames = data["camera_path"]
        if not 0 < len(frames) <= MAX_FRAMES:
            raise ValueError(f"it has {len(frames)} frames; a path has 1 to {MAX_FRAMES:,}")
        to_world = np.array([frame["camera_to_world"] for frame in frames], np.float64).reshape(-1, 4, 4)
        fov = np.array([frame["fov"] for frame in frames], np.float64)
        rotation = to_world[:, :3, :3]
        if not (
            np.isfinite(to_world).all() and np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-3)
        ):
            raise ValueError("a camera_to_world is not a rotation and a translation")
        if not ((fov > 0) & (fov < 180)).all():
            raise ValueError("a fov is not between 0 and 180 degrees")
        width, height = int(data["render_width"]), int(data["render_height"])
        fps = float(data.get("fps", 24))
        if min(width, height) < 1 or not 0 < fps < np.inf:
            raise ValueError("its size or its number of frames per second is not positive")
    return CameraPath(to_world, fov, width, height, fps)


def format_camera_path(path: CameraPath) -> str:
    """Return ``path`` as the JSON text that ``ns-render camera-path`` reads."""
    aspect = path.width / path.height
    frames = [
        {"camera_to_world": pose.ravel().tolist(), "fov": float(fov), "aspect": aspect}
        for pose, fov in zip(np.asarray(path.to_world, float), path.fov)
    ]
    data = {
        "camera_type": "perspective",
        "render_width": path.width,
        "render_height": path.height,
        "fps": path.fps,
        "seconds": len(frames) / path.fps,
        "is_cycle": False,
        "crop": None,
        "camera_path": frames,
    }
    return json.dumps(data)


def write_camera_path(output: str | os.PathLike, path: CameraPath) -> None:
    """Write ``path`` to the file ``output`` (.json)."""
    write_text(Path(output), format_camera_path(path))
