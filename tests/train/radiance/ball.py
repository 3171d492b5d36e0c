"""A ball in a box as pictures with exact depth, and trainers that learn it in seconds."""

from __future__ import annotations

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig
from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions
from nerg_mi.photos.dataset import Dataset
from nerg_mi.photos.images import PhotoView
from nerg_mi.train.radiance_settings import RadianceSettings
from nerg_mi.train.radiance_trainer import RadianceTrainer
from tests.tiny import ball_pose

BOX = Box((-1, -1, -1), (1, 1, 1))
RADIUS = 0.6
TINY = RadianceConfig(
    grid=HashGridConfig(levels=4, log2_rows=12, base=8, finest=64), width=16, color_hidden=1, density_scale=0.5
)
LENS = Intrinsics(24, 24, 30.0, 30.0, 12.0, 12.0)


def ball(pose, depth=True):
    """Render a ball of radius RADIUS, coloured by its normal, in front of a transparent background."""
    d = (pixel_directions(LENS) @ pose[:3, :3].T).reshape(-1, 3)
    o = pose[:3, 3]
    b, c = d @ o, o @ o - RADIUS**2
    hit = b * b - c > 0
    t = np.where(hit, -b - np.sqrt(np.where(hit, b * b - c, 0)), 0)
    rgb = 0.5 + 0.4 * (o + d * t[:, None]) / RADIUS
    color = np.concatenate([np.where(hit[:, None], rgb, 0), hit[:, None]], axis=1)
    return PhotoView(
        "ball",
        PosedCamera(LENS, pose),
        color.reshape(24, 24, 4).astype(np.float32),
        t.reshape(24, 24).astype(np.float32) if depth else None,
    )


def ball_dataset():
    """Twenty training views of the ball, and four held-out views."""
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(24, 3)) * [1, 1, 0.5]
    views = [replace(ball(ball_pose(2 * c / np.linalg.norm(c))), name=f"ball {k}") for k, c in enumerate(centers)]
    return Dataset(views[4:], views[:4], BOX, "as given", [], {"dataset": "ball"})


def settings(**changes):
    options = {
        "steps": 300,
        "batch": 2**12,
        "resolution": 32,
        "march_step": 1 / 64,
        "stride_fraction": 0.2,
        "seed": 1,
        "depth_weight": 2e-3,
        "grid_decay": 1e-3,
        **changes,
    }
    return RadianceSettings(**options)


def trainer(dataset, **changes):
    depth = changes.pop("depth", True)
    return RadianceTrainer(
        dataset.train, BOX, TINY, settings(**{"steps": 40, "extraction_start": 0.75, **changes}), ns, depth
    )


def state(t):
    arrays = {k: v[0].numpy() for k, v in t.optimiser.state.items()}
    arrays |= {f"first.{k}": v[3][1].numpy() for k, v in t.optimiser.state.items()}
    arrays |= {f"averaged.{k}": v.numpy() for k, v in t.averaged.items()}
    return arrays | {"bits": t.grid.bits.numpy(), "value": t.grid.value.numpy(), "hard": t.hard_pixels, "rays": t.rays}
