"""From where a page looks, and the rays of its picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.api.camera import Camera
from nerg_mi.api.scene import Scene


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera: ``origin`` (3,) in scene units, the unit vectors ``ahead`` and ``up`` (3,), perpendicular to
    each other, ``fov`` in radians between the lower and the upper border, and ``aspect``, width by height."""

    origin: np.ndarray
    ahead: np.ndarray
    up: np.ndarray
    fov: float
    aspect: float

    @classmethod
    def of(cls, origin: Any, target: Any, up: Any, fov: float, aspect: float) -> View:
        """One that looks at ``target``; ``up`` is made perpendicular, and chosen where it lies along the view."""
        origin = np.asarray(origin, float)
        ahead = _unit(np.asarray(target, float) - origin)
        up = np.asarray(up, float)
        if np.linalg.norm(np.cross(ahead, up)) < 1e-6:
            up = np.eye(3)[np.argmin(np.abs(ahead))]
        return cls(origin, ahead, _unit(up - ahead * (ahead @ up)), float(fov), float(aspect))

    @classmethod
    def of_page(cls, camera: Any) -> View:
        """That of a `viser.CameraHandle`, whose frame has x to the right, y down and z ahead."""
        w, x, y, z = camera.wxyz
        ahead = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        down = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
        aspect = camera.image_width / camera.image_height if camera.image_height else 1.5
        return cls.of(camera.position, np.asarray(camera.position) + ahead, -down, camera.fov, aspect)

    @classmethod
    def of_sensor(cls, sensor: Any) -> View:
        """That of a perspective sensor of a Mitsuba scene; of others the place and the direction, and a usual lens."""
        import mitsuba as mi

        pose = np.array(sensor.world_transform().matrix, float).reshape(4, 4)
        width, height = map(int, sensor.film().crop_size())
        params: Any = mi.traverse(sensor)
        across = math.radians(float(np.ravel(params["x_fov"])[0])) if "x_fov" in params else math.radians(70)
        fov = 2 * math.atan(math.tan(across / 2) * height / width)
        return cls.of(pose[:3, 3], pose[:3, 3] + pose[:3, 2], pose[:3, 1], fov, width / height)

    @property
    def target(self) -> np.ndarray:
        """A point (3,) that it looks at, so far away that rounding it to the digits of a file does not turn it."""
        return self.origin + max(1.0, float(np.linalg.norm(self.origin))) * self.ahead

    @property
    def across(self) -> float:
        """Degrees between the left and the right border."""
        return math.degrees(2 * math.atan(math.tan(self.fov / 2) * self.aspect))

    def camera(self, width: int) -> Camera:
        """The same as a `Camera` whose pictures are ``width`` pixels wide."""
        target = self.origin + self.ahead
        size = dict(width=width, height=self.height(width))
        return Camera(tuple(self.origin), tuple(target), tuple(self.up), self.across, **size)

    def height(self, width: int) -> int:
        """Rows of a picture with ``width`` columns."""
        return max(round(width / self.aspect), 1)

    def rays(self, width: int, height: int, within: np.ndarray) -> np.ndarray:
        """Unit directions (height * width, 3) through a picture's pixels, row by row. ``within`` (height * width, 2):
        where in each pixel, 0..1 from its upper left corner."""
        column = (np.tile(np.arange(width), height) + within[:, 0]) / width * 2 - 1
        row = 1 - (np.repeat(np.arange(height), width) + within[:, 1]) / height * 2
        rise = math.tan(self.fov / 2)
        right = np.cross(self.ahead, self.up)
        # Pixels are squares, as those of a `Camera`, whose height follows from its width.
        run = rise * self.aspect
        rise = run * height / width
        found = self.ahead + (column * run)[:, None] * right + (row * rise)[:, None] * self.up
        return found / np.linalg.norm(found, axis=1, keepdims=True)


def _unit(v: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(v))
    return v / length if length > 0 else np.array([1.0, 0.0, 0.0])


def heading_of(ahead: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) with the columns ahead, left and up, level by ``up``."""
    level = ahead - up * (ahead @ up)
    if np.linalg.norm(level) < 1e-6:
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - up * (level @ up)
    level = level / np.linalg.norm(level)
    return np.stack([level, np.cross(up, level), up], axis=1)


def ahead_of(scene: Scene) -> np.ndarray:
    """Where the observer of ``scene`` is turned to."""
    pose = np.array(scene.integrator.observer.world_transform().matrix, float).reshape(4, 4)
    return pose[:3, 2]
