"""Simulated participants who look at one point, small fields trained on them, and training plans."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig
from nerg_mi.fields.gaze_product import GazeConfig
from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions
from nerg_mi.photos.salience import SalienceView, pixel_solid_angles
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_log_density import LikelihoodTrainer
from nerg_mi.train.gaze_product import ProductTrainer
from nerg_mi.train.gaze_recipes import GazePlan
from nerg_mi.train.gaze_run import StateSettings, fit_gaze
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings

BOX = Box((-2, -2, 0), (2, 2, 3))
GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=8)
SMALL = GazeConfig(grid=GRID, width=16, geometry=4)
LOG = LogGazeConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=2, finest=4), width=16, prior=16, mix=0.1)
PROBES = ProbeSettings(radius=0.5, probes=16, max_rays=64, min_rays=8, kappa=20.0, directions=64)
NOWHERE = Environment(None, BOX, "none")
PRODUCT = GazeSettings(steps=16, num_validations=8, validation_zones=2, validation_probes=6, probes=4, directions=32)
LIKELIHOOD = GazeSettings(
    steps=16,
    num_validations=8,
    validation_zones=2,
    validation_probes=6,
    probes=4,
    directions=32,
    loss="likelihood",
    integral_weight=0.0,
    rays=16,
)


def looking_at(target, n=400, seed=0, spread=1.2):
    """Rays of two participants who move and look at ``target``, with hits on the wall x = 1.5."""
    rng = np.random.default_rng(seed)
    origin = np.stack([rng.uniform(-1.2, 0, n), rng.uniform(-spread, spread, n), rng.uniform(1.5, 1.7, n)], axis=1)
    direction = np.asarray(target) + rng.normal(0, 0.15, (n, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    hit = origin + direction * ((1.5 - origin[:, :1]) / direction[:, :1])
    return Rays(np.arange(n), np.arange(n) % 2, ("a", "b"), origin, direction, np.ones(n), hit)


def planned(config, settings: GazeSettings, probes: ProbeSettings = PROBES, **options) -> GazePlan:
    """Make the plan of a field of the kind that matches the loss."""
    trainer = LikelihoodTrainer if settings.loss == "likelihood" else ProductTrainer
    return GazePlan(config=config, settings=settings, probes=probes, trainer=trainer, **options)


RAYS = looking_at((1.5, 0, 1.2), 3000, spread=6.0)


def train(place, settings, config, probes=PROBES, supervision=None, *, on_progress=None, write=None, **state):
    """Train on ``RAYS``, unless other data are given; ``state`` are arguments of `StateSettings`."""
    plan = planned(config, settings, probes)
    supervision = supervision or Supervision(RAYS)
    return fit_gaze(supervision, place, plan, ns, state=StateSettings(**state), on_progress=on_progress, write=write)


def stopping(stage, step):
    """Simulate Ctrl-C when a stage reaches a step."""
    seen = []

    def watch(state):
        seen.append((state.stage, state.steps))
        if len([s for s in seen if s == (stage, step)]) == 1 and (state.stage, state.steps) == (stage, step):
            raise KeyboardInterrupt

    watch.seen = seen
    return watch


# ---- Views of a density, as an observer sees it through a lens ----

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
    """Make the view of an observer with ``density(p, d)`` through a lens."""
    camera = PosedCamera(lens, pose(centre, towards))
    directions = pixel_directions(lens) @ camera.to_world[:3, :3].T
    solid = pixel_solid_angles(lens)
    share = density(camera.center, directions.reshape(-1, 3)).reshape(solid.shape) * solid
    return SalienceView(name, camera, (share / share.sum()).astype(np.float32), solid.astype(np.float32))


def lobe(p, d, kappa=12.0):
    """Most gaze is at one point, the rest uniform."""
    mean = (TARGET - p) / np.linalg.norm(TARGET - p)
    return 0.8 * kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(kappa * (d @ mean - 1)) + 0.2 / (4 * np.pi)


def around(count, seed=0, density=lobe):
    """Cameras in the room that look around, and slightly down."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform((-1, -1, 1.4), (1, 1, 1.8), (count, 3))
    angle = rng.uniform(0, 2 * np.pi, count)
    towards = np.stack([np.cos(angle), np.sin(angle), rng.uniform(-0.4, 0.2, count)], axis=1)
    return [view(density, c, t, name=f"v{k}") for k, (c, t) in enumerate(zip(centres, towards))]
