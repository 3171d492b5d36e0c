"""Rays of posed cameras.

Frames: image x right, y down, pixel centres at half-integers; camera OpenGL (x right,
y up, looking along -z); world the data set's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError

from . import lens
from .intrinsics import Intrinsics

# OpenGL cameras look along -z with x to the right, Mitsuba's along +z with x to the left.
OPENGL_FROM_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])
# OpenCV's cameras look along +z with y down.
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0])
_WIDEST = float(np.tan(np.radians(85)))


@dataclass(frozen=True)
class Camera:
    """A posed camera. ``to_world``: (4, 4) rigid OpenGL camera-to-world."""

    intrinsics: Intrinsics
    to_world: np.ndarray

    @property
    def center(self) -> np.ndarray:
        return self.to_world[:3, 3]

    @property
    def axis(self) -> np.ndarray:
        """Unit viewing direction."""
        return -self.to_world[:3, 2]


def pixel_grid(intrinsics: Intrinsics) -> np.ndarray:
    """Normalised image coordinates (height, width, 2) of the pixels' centres."""
    i = intrinsics
    x, y = np.meshgrid((np.arange(i.width) + 0.5 - i.cx) / i.fx, (np.arange(i.height) + 0.5 - i.cy) / i.fy)
    return np.stack([x, y], axis=-1)


def pixel_directions(intrinsics: Intrinsics) -> np.ndarray:
    """Unit directions (height, width, 3), float64, of the pixels' centres in the OpenGL camera frame."""
    return lens.rays(pixel_grid(intrinsics), intrinsics) * _OPENGL_FROM_OPENCV


def view_tangents(intrinsics: Intrinsics) -> tuple[float, float, float, float]:
    """How far a picture reaches left, right, up and down: tangents of the angles from its axis, lens included.

    At most tan 85°: what a fisheye sees beyond that no frustum holds.
    """
    i = intrinsics
    x = np.linspace(0, i.width, 33)
    y = np.linspace(0, i.height, 33)
    border = [(u, v) for u in x for v in (0, i.height)] + [(u, v) for v in y for u in (0, i.width)]
    xy = (np.array(border) - [i.cx, i.cy]) / [i.fx, i.fy]
    d = lens.rays(xy, i)
    ahead = np.maximum(d[:, 2], 1e-9)
    tangent = np.clip(d[:, :2] / ahead[:, None], -_WIDEST, _WIDEST)
    left, up = -tangent.min(axis=0)
    right, down = tangent.max(axis=0)
    return float(left), float(right), float(up), float(down)


def project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates (N, 2) of world ``points`` (N, 3), and a mask (N,) of those that the lens can show."""
    i = camera.intrinsics
    local = (np.asarray(points) - camera.center) @ camera.to_world[:3, :3]
    xy, shown = lens.image(local * _OPENGL_FROM_OPENCV, i)
    return xy * [i.fx, i.fy] + [i.cx, i.cy], shown


def sensor_dict(camera: Camera) -> dict:
    """A Mitsuba ``perspective`` sensor (dict for ``mi.load_dict``) that takes this camera's picture.

    Box filter, float32 RGB, one ray through each pixel's footprint. Raises `NergError` for what
    that sensor cannot express: distortion, and pixels that are not square to 0.1 %.
    """
    import mitsuba as mi

    i = camera.intrinsics
    if i.is_distorted:
        raise NergError(
            "Mitsuba's perspective sensor has no lens distortion, but this camera has "
            f"{'a fisheye lens' if i.fisheye else f'k1, k2, p1, p2 = {i.distortion[:4]}'}; undistort the images first"
        )
    if abs(i.fx / i.fy - 1) > 1e-3:
        raise NergError(
            f"Mitsuba's perspective sensor has square pixels, but this camera has fx={i.fx:g}, fy={i.fy:g}; "
            "resize the images first"
        )
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f((camera.to_world @ OPENGL_FROM_MITSUBA).tolist()),
        "fov": float(np.degrees(2 * np.arctan(i.width / (2 * i.fx)))),
        "fov_axis": "x",
        # Mitsuba counts the offset from the principal point to the film's centre.
        "principal_point_offset_x": float(0.5 - i.cx / i.width),
        "principal_point_offset_y": float(0.5 - i.cy / i.height),
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "film": {
            "type": "hdrfilm",
            "width": i.width,
            "height": i.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "independent", "sample_count": 1},
    }
