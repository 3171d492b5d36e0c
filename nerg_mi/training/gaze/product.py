"""Training a gaze field that is a product (equation 1), on the paper's losses."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.gaze_product import GazeField

from .batches import Batch
from .losses import gaze_loss
from .product_model import gaze_density, used_parameters
from .settings import LOSSES
from .trainer import GazeTrainer


class ProductTrainer(GazeTrainer):
    """A run of a ``GazeField``; see ``GazeTrainer``."""

    def untrained(self) -> GazeField:
        return GazeField.random(self.config, self.box, self.ns, self.settings.seed)

    def trainable(self, parameters: dict) -> dict:
        return used_parameters(self.config, parameters)

    def backward(self) -> None:
        s, data = self.settings, self.data
        count, D = min(s.probes, data.count), min(s.directions, data.directions)
        observers = self.rng.choice(data.count, count, replace=False)
        if D < data.directions:
            directions = np.argpartition(self.rng.random((count, data.directions)), D, axis=1)[:, :D]
        else:
            directions = np.broadcast_to(np.arange(D), (count, D))
        batch = data.batch(observers, directions)
        density = self.density(batch, self.current())
        self.loss = gaze_loss(density, batch.truth, D, **LOSSES[s.loss])
        total = self.loss.total
        if s.integral:
            # Against the truth in the same directions, so that drawing few of them is no bias.
            total += s.integral * dr.mean(dr.square(batch.integral(density - batch.truth)))
        dr.backward(total)

    def density(self, batch: Batch, parameters: dict) -> Any:
        semantic = batch.semantic if self.config.semantic else None
        density = gaze_density(self.config, self.box, parameters, batch.p_od, batch.p_o, batch.r_o, self.ns, semantic)
        return batch.given_view(density, batch.truth)

    def judge(self, kld: float, cc: float, mae: float, off: float) -> float:
        w = LOSSES[self.settings.loss]
        return w["kld"] * kld + w["cc"] * (1 - cc) + w["mae"] * mae + self.settings.integral * off
