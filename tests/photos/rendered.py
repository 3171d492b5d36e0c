"""Photos of a known scene: a textured floor with a textured box on it, ray-cast with NumPy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates, zoom

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
BOX = np.array([[-0.5, -0.4, 0.0], [0.5, 0.4, 0.7]])


def poses(count: int = 8) -> np.ndarray:
    """Return OpenGL camera-to-world poses (count, 4, 4) on an arc of 100 degrees, facing the box; up is +z."""
    out = []
    for k, a in enumerate(np.radians(np.linspace(20, 120, count))):
        center = np.array([2.4 * np.cos(a), 2.4 * np.sin(a), 1.3 + 0.1 * np.sin(3.0 * k)])
        back = center - [0, 0, 0.2]
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.column_stack([right, np.cross(back, right), back, center])
        out.append(pose)
    return np.array(out)


def textures() -> list[np.ndarray]:
    """Return one texture for each axis, (512, 512), with details at all scales."""
    rng = np.random.default_rng(7)
    out = []
    for _ in range(3):
        made = sum(zoom(rng.normal(size=(n, n)), 512 / n, order=1) * n**-0.3 for n in (16, 32, 64, 128, 256))
        out.append(np.clip(128 + 60 * (made - made.mean()) / made.std(), 0, 255))
    return out


def picture(pose: np.ndarray, painted: list[np.ndarray]) -> np.ndarray:
    """Render the image (HEIGHT, WIDTH, 3) uint8 of a camera at ``pose``."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    d = np.stack([x, -y, np.full_like(x, -FOCAL)], axis=-1) / FOCAL @ pose[:3, :3].T
    o = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (BOX[:, None, None] - o) / d
        near, far = np.minimum(t[0], t[1]).max(axis=-1), np.maximum(t[0], t[1]).min(axis=-1)
        ground = -o[2] / d[..., 2]
    axis = np.argmax(np.minimum(t[0], t[1]), axis=-1)
    hit = (near < far) & (near > 0)
    ground = np.where((ground > 0) & (ground < 30), ground, 30)
    axis, distance = np.where(hit, axis, 2), np.where(hit, near, ground)
    p = o + d * distance[..., None]
    gray = np.zeros((HEIGHT, WIDTH))
    for k in range(3):
        # Faces of the box use other parts of the texture than the floor.
        uv = [160 * p[..., j] + 90 * (k + 1) + 217 * hit for j in range(3) if j != k]
        gray = np.where(axis == k, map_coordinates(painted[k], uv, order=1, mode="grid-wrap"), gray)
    return np.repeat(gray[..., None], 3, axis=2).astype(np.uint8)


def write_photos(folder: Path, count: int = 8) -> Path:
    """Write the photos as 0.png, 1.png and so on."""
    folder.mkdir(parents=True, exist_ok=True)
    painted = textures()
    for k, pose in enumerate(poses(count)):
        Image.fromarray(picture(pose, painted)).save(folder / f"{k}.png")
    return folder
