"""A scene camera written another way than the package's: what tests of readers compare with.

Poses are OpenGL camera-to-world; turned in between by quaternions' slerp, gaze put through the lens forwards.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def project(d: np.ndarray, matrix, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0) -> np.ndarray:
    """Pixels (n, 2) of directions (n, 3), x right, y down, z forward, as OpenCV documents them."""
    x, y = d[:, 0] / d[:, 2], d[:, 1] / d[:, 2]
    r = np.hypot(x, y)
    f = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    u = x * f + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    v = y * f + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return (np.array(matrix, float) @ np.stack([u, v, np.ones_like(u)])).T[:, :2]


def angles(d: np.ndarray) -> np.ndarray:
    """Azimuth to the right and elevation up of the same directions, (n, 2) in degrees."""
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return np.degrees(np.stack([np.arctan2(d[:, 0], d[:, 2]), -np.arcsin(d[:, 1])], axis=1))


def gaze_in_camera(n: int, seed: int = 0, most: float = 0.55) -> np.ndarray:
    """Unit directions (n, 3) within a scene camera's picture."""
    xy = np.random.default_rng(seed).uniform(-most, most, (n, 2))
    d = np.c_[xy, np.ones(n)]
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _slerp(a: np.ndarray, b: np.ndarray, u: float) -> np.ndarray:
    cosine = float(a @ b)
    b, cosine = (-b, -cosine) if cosine < 0 else (b, cosine)
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-9:
        return a
    return (np.sin((1 - u) * angle) * a + np.sin(u * angle) * b) / np.sin(angle)


def rays_at(t: np.ndarray, times: np.ndarray, poses: np.ndarray, gaze: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (n, 3) in the world of ``gaze`` (n, 3) at ``t`` (n,), between OpenGL ``poses``."""
    origin, direction = [], []
    quaternions = [Rotation.from_matrix(p[:3, :3]).as_quat() for p in poses]
    for now, (x, y, z) in zip(t, gaze):
        k = min(max(int(np.sum(times <= now)) - 1, 0), len(times) - 2)
        u = (now - times[k]) / (times[k + 1] - times[k])
        q = _slerp(quaternions[k], quaternions[k + 1], u)
        origin.append((1 - u) * poses[k][:3, 3] + u * poses[k + 1][:3, 3])
        direction.append(Rotation.from_quat(q).apply([x, -y, -z]))
    return np.array(origin), np.array(direction)
