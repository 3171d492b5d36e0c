"""The training of that field."""

import drjit as dr
import numpy as np
from nerg_mi.fields.gaze_place import PlaceConfig, PlaceField

from .gaze_recipes import Recipe, register_recipe
from .gaze_settings import GazeSettings, ProbeSettings
from .gaze_trainer import GazeTrainer, compute_gaze_loss


class PlaceTrainer(GazeTrainer):
    def init_field(self):
        return PlaceField.random(self.config, self.box, self.ns, self.settings.seed, self._targets.prior_table)

    def draw_batch(self):
        data, D = self.data, self.data.num_directions
        observers = self.rng.choice(data.num_observers, min(self.settings.probes, data.num_observers), replace=False)
        return data.gather_batch(observers, np.broadcast_to(np.arange(D), (len(observers), D)))

    def compute_loss(self, batch):
        density = self.evaluate_density(batch, self.current_parameters())
        return compute_gaze_loss(density, batch.truth, self.data.num_directions, cc=0, mae=0).total

    def evaluate_density(self, batch, parameters):
        self.initial_field.set_parameters(parameters)
        D, lanes = dr.width(batch.r_o) // dr.width(batch.solid_angle), dr.arange(self.ns.UInt32, dr.width(batch.r_o))
        p_o = dr.gather(type(batch.p_o), batch.p_o, lanes // D)
        emit, capture = self.initial_field.unnormalized(batch.p_od, p_o, batch.r_o)
        return emit * capture / dr.repeat(batch.integrate(emit * capture), D)

    def validation_objective(self, kld, cc, mae, off):
        return kld


register_recipe(
    Recipe(
        name="place",
        summary="what a place attracts, times how often a direction is looked in",
        make_config=lambda choices: PlaceConfig(variant=choices.variant),
        trainer=PlaceTrainer,
        losses=("likelihood",),
        settings=GazeSettings(
            steps=12, validation_zones=0, loss="likelihood", integral_weight=0.0, probes=8, prior_folds=2
        ),
        probes=ProbeSettings(radius=0.5, probes=16, min_rays=8, directions=64),
        supported_options=frozenset({"prior_folds", "prior_kappa"}),
    )
)
