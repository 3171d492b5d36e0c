"""Rays of posed cameras: pinhole with OpenCV's radial and tangential distortion.

Frames: image x right, y down, pixel centres at half-integers; camera OpenGL (x right,
y up, looking along -z); world the data set's own.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..formats.transforms import Intrinsics

# OpenGL cameras look along -z with x to the right, Mitsuba's along +z with x to the left.
_OPENGL_FROM_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])


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


def distort(xy: np.ndarray, distortion: tuple) -> np.ndarray:
    """Distorted normalised coordinates (N, 2) of ideal ones: OpenCV's model with k1, k2, p1, p2."""
    k1, k2, p1, p2 = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    return np.stack([
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    ], axis=-1)


def undistort(xy: np.ndarray, distortion: tuple, iterations: int = 20) -> np.ndarray:
    """Ideal normalised coordinates (N, 2) of distorted ones, by Newton's iteration on `distort`.

    Raises ``ValueError`` where the model folds over inside the image, so that no inverse exists.
    """
    k1, k2, p1, p2 = distortion
    goal = np.asarray(xy, np.float64)
    if not any(distortion):
        return goal.copy()
    u = goal.copy()
    for _ in range(iterations):
        x, y = u[..., 0], u[..., 1]
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (k1 + r2 * k2), k1 + 2 * k2 * r2
        residual = distort(u, distortion) - goal
        # The Jacobian of `distort`; it is symmetric.
        a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        d = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        det = a * d - b * b
        det = np.where(np.abs(det) > 1e-6, det, 1e-6)
        u = u - np.stack([d * residual[..., 0] - b * residual[..., 1],
                          a * residual[..., 1] - b * residual[..., 0]], axis=-1) / det[..., None]
        if np.abs(residual).max() < 1e-12:
            break
    error = np.abs(distort(u, distortion) - goal).max()
    if not error < 1e-6:
        raise ValueError(
            f"the distortion k1={k1:g}, k2={k2:g}, p1={p1:g}, p2={p2:g} cannot be inverted over the whole image; "
            "undistort the images beforehand, or crop them"
        )
    return u


def pixel_directions(intrinsics: Intrinsics) -> np.ndarray:
    """Unit directions (height, width, 3), float64, of the pixels' centres in the OpenGL camera frame."""
    i = intrinsics
    x, y = np.meshgrid((np.arange(i.width) + 0.5 - i.cx) / i.fx, (np.arange(i.height) + 0.5 - i.cy) / i.fy)
    xy = undistort(np.stack([x, y], axis=-1), i.distortion)
    d = np.stack([xy[..., 0], -xy[..., 1], -np.ones_like(x)], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates (N, 2) of world ``points`` (N, 3), and a mask (N,) of those in front of the camera."""
    i = camera.intrinsics
    local = (np.asarray(points) - camera.center) @ camera.to_world[:3, :3]
    depth = -local[:, 2]
    front = depth > 1e-9
    safe = np.where(front, depth, 1.0)
    xy = distort(np.stack([local[:, 0] / safe, -local[:, 1] / safe], axis=-1), i.distortion)
    return xy * [i.fx, i.fy] + [i.cx, i.cy], front


def sensor_dict(camera: Camera) -> dict:
    """A Mitsuba ``perspective`` sensor (dict for ``mi.load_dict``) that takes this camera's picture.

    Box filter, float32 RGB, one ray through each pixel's footprint. Raises ``ValueError`` for what
    that sensor cannot express: distortion, and pixels that are not square to 0.1 %.
    """
    import mitsuba as mi

    i = camera.intrinsics
    if i.is_distorted:
        raise ValueError(
            f"Mitsuba's perspective sensor has no lens distortion, but this camera has k1, k2, p1, p2 = {i.distortion}; "
            "undistort the images first"
        )
    if abs(i.fx / i.fy - 1) > 1e-3:
        raise ValueError(f"Mitsuba's perspective sensor has square pixels, but this camera has fx={i.fx:g}, fy={i.fy:g}")
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f((camera.to_world @ _OPENGL_FROM_MITSUBA).tolist()),
        "fov": float(np.degrees(2 * np.arctan(i.width / (2 * i.fx)))),
        "fov_axis": "x",
        # Mitsuba counts the offset from the principal point to the film's centre.
        "principal_point_offset_x": float(0.5 - i.cx / i.width),
        "principal_point_offset_y": float(0.5 - i.cy / i.height),
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "film": {
            "type": "hdrfilm", "width": i.width, "height": i.height, "rfilter": {"type": "box"},
            "pixel_format": "rgb", "component_format": "float32",
        },
        "sampler": {"type": "independent", "sample_count": 1},
    }
