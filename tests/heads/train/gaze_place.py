"""The training of that field."""

import drjit as dr
import numpy as np
from nerg_mi.fields.gaze_place import PlaceConfig, PlaceField

from .gaze_recipes import Recipe, register_recipe
from .gaze_trainer import GazeTrainer, gaze_loss


class PlaceTrainer(GazeTrainer):
    def untrained(self):
        return PlaceField.random(self.config, self.box, self.ns, self.settings.seed, self._targets.blind)

    def backward(self):
        data, D = self.data, self.data.directions
        observers = self.rng.choice(data.count, min(self.settings.probes, data.count), replace=False)
        batch = data.batch(observers, np.broadcast_to(np.arange(D), (len(observers), D)))
        self.loss = gaze_loss(self.density(batch, self.current()), batch.truth, D, cc=0, mae=0).total
        dr.backward(self.loss)

    def density(self, batch, parameters):
        self.initial.set_parameters(parameters)
        D, lanes = dr.width(batch.r_o) // dr.width(batch.extent), dr.arange(self.ns.UInt32, dr.width(batch.r_o))
        p_o = dr.gather(type(batch.p_o), batch.p_o, lanes // D)
        emit, capture = self.initial.unnormalized(batch.p_od, p_o, batch.r_o)
        return emit * capture / dr.repeat(batch.integral(emit * capture), D)

    def judge(self, kld, cc, mae, off):
        return kld


register_recipe(
    Recipe(
        name="place",
        summary="what a place attracts, times how often a direction is looked in",
        config=lambda choices: PlaceConfig(variant=choices.variant),
        trainer=PlaceTrainer,
        losses=("likelihood",),
        settings={"steps": 12, "zones": 0, "loss": "likelihood", "integral": 0.0, "probes": 8, "mix_folds": 2},
        probes={"radius": 0.5, "count": 16, "min_rays": 8, "directions": 64},
        takes=frozenset({"mix-folds", "mix-kappa"}),
        quick=True,
    )
)
