"""People who look at one point, the small fields that learn it, and plans of their training: what these tests share."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig
from nerg_mi.fields.gaze_product import GazeConfig
from nerg_mi.maths.geometry import Box
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_log_density import LikelihoodTrainer
from nerg_mi.train.gaze_product import ProductTrainer
from nerg_mi.train.gaze_run import train_gaze
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.gaze_trainer import GazePlan, StateSettings
from nerg_mi.train.geometry import GazePlace

BOX = Box((-2, -2, 0), (2, 2, 3))
GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=8)
SMALL = GazeConfig(grid=GRID, width=16, geometry=4)
LOG = LogGazeConfig(grid=HashGridConfig(levels=2, log2_rows=10, base=2, finest=4), width=16, prior=16, mix=0.1)
PROBES = ProbeSettings(radius=0.5, count=16, cap=64, min_rays=8, kappa=20.0, directions=64)
NOWHERE = GazePlace(None, BOX, "none")
PRODUCT = GazeSettings(steps=16, looks=8, zones=2, watched=6, probes=4, directions=32)
LIKELIHOOD = GazeSettings(
    steps=16, looks=8, zones=2, watched=6, probes=4, directions=32, loss="likelihood", integral=0.0, rays=16
)


def looking_at(target, n=400, seed=0, spread=1.2):
    """Rays of two people who walk about and look at ``target``, with hits on the wall x = 1.5."""
    rng = np.random.default_rng(seed)
    origin = np.stack([rng.uniform(-1.2, 0, n), rng.uniform(-spread, spread, n), rng.uniform(1.5, 1.7, n)], axis=1)
    direction = np.asarray(target) + rng.normal(0, 0.15, (n, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    hit = origin + direction * ((1.5 - origin[:, :1]) / direction[:, :1])
    return Rays(np.arange(n), np.arange(n) % 2, ("a", "b"), origin, direction, np.ones(n), hit)


def planned(config, settings: GazeSettings, probes: ProbeSettings = PROBES, **more) -> GazePlan:
    """The training of a field of the kind that the loss is of."""
    trainer = LikelihoodTrainer if settings.loss == "likelihood" else ProductTrainer
    return GazePlan(config=config, settings=settings, probes=probes, trainer=trainer, **more)


RAYS = looking_at((1.5, 0, 1.2), 3000, spread=6.0)


def train(place, settings, config, probes=PROBES, supervision=None, *, tell=None, write=None, **state):
    """A training on ``RAYS``, unless others are given; ``state``: of `StateSettings`."""
    plan = planned(config, settings, probes)
    supervision = supervision or Supervision(RAYS)
    return train_gaze(supervision, place, plan, ns, state=StateSettings(**state), tell=tell, write=write)


def stopping(stage, step):
    """Ctrl-C as soon as a stage has come to a step."""
    seen = []

    def watch(state):
        seen.append((state.stage, state.steps))
        if len([s for s in seen if s == (stage, step)]) == 1 and (state.stage, state.steps) == (stage, step):
            raise KeyboardInterrupt

    watch.seen = seen
    return watch
