"""Views of a law: what an observer sees of it through a lens."""

from __future__ import annotations

import numpy as np

from nerg_mi.photos.cameras import Camera, Intrinsics, pixel_directions
from nerg_mi.photos.salience import SalienceView, pixel_solid_angles

LENS = Intrinsics(24, 18, 14.0, 14.0, 12.0, 9.0, k1=-0.08)
TARGET = np.array([1.9, 0.5, 1.6])


def pose(centre, towards):
    """OpenGL camera-to-world, z up."""
    back = -np.asarray(towards, float) / np.linalg.norm(towards)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = np.stack([right, np.cross(back, right), back], axis=1), centre
    return m


def view(density, centre, towards, lens=LENS, name="a"):
    """What an observer with ``density(p, d)`` sees of it through a lens."""
    camera = Camera(lens, pose(centre, towards))
    directions = pixel_directions(lens) @ camera.to_world[:3, :3].T
    solid = pixel_solid_angles(lens)
    share = density(camera.center, directions.reshape(-1, 3)).reshape(solid.shape) * solid
    return SalienceView(name, camera, (share / share.sum()).astype(np.float32), solid.astype(np.float32))


def lobe(p, d, kappa=12.0):
    """Most look at one point, the others anywhere."""
    mean = (TARGET - p) / np.linalg.norm(TARGET - p)
    return 0.8 * kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(kappa * (d @ mean - 1)) + 0.2 / (4 * np.pi)


def around(count, seed=0, density=lobe):
    """Cameras in the room that look about them, and a little down."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform((-1, -1, 1.4), (1, 1, 1.8), (count, 3))
    angle = rng.uniform(0, 2 * np.pi, count)
    towards = np.stack([np.cos(angle), np.sin(angle), rng.uniform(-0.4, 0.2, count)], axis=1)
    return [view(density, c, t, name=f"v{k}") for k, (c, t) in enumerate(zip(centres, towards))]
