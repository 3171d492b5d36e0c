"""Training of the log-density gaze field: its forward pass, its likelihood, and its recipe."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import HashGrid, HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import softplus
from nerg_mi.fields.mlp import MLP, stack

from .gaze_data import GazeBatch, GazeTargets, compute_observer_bounds
from .gaze_recipes import DEFAULT_RECIPE, FieldOptions, Recipe, register_recipe
from .gaze_settings import GazeSettings, ProbeSettings
from .gaze_trainer import GazeTrainer

# ---- Forward pass with the networks as tensor products, which trains fastest ----


def evaluate_log_density(field: LogGazeField, batch: GazeBatch, parameters: dict, ns: ModuleType) -> Any:
    """Evaluate the log of what ``field.unnormalized`` multiplies (Float), with other ``parameters`` by their names, in
    the B * D directions of a ``batch`` of B observers. Gradients reach every parameter that the variant uses."""
    config, p_o, r_o = field.config, batch.p_o, batch.r_o
    net = lambda name: MLP([parameters[f"{name}.{i}"] for i in range(config.layers + 1)])
    # The field computes the network inputs.
    field = copy(field)
    field.grid = HashGrid.from_parameters(config.grid, parameters, mode=dr.ReduceMode.Expand)
    field.prior = parameters["prior"]
    repeats = dr.width(r_o) // dr.width(p_o)
    logit = field.log_base(r_o)
    each = dr.gather(type(p_o), p_o, dr.arange(ns.UInt32, dr.width(r_o)) // repeats)
    if config.variant != "capture":
        inputs = field.emit_inputs(batch.p_od, each, r_o)
        emit = net("emit_net").tensor(stack(_broadcast(inputs, r_o), ns)).array
        if not config.fills_escaped:
            one = dr.zeros(ns.UInt32, dr.width(r_o))
            escaped = dr.gather(ns.Float, parameters["escaped"], one, mode=dr.ReduceMode.Expand)
            emit = dr.select(batch.misses, escaped, emit)
        logit = logit + emit
    if config.variant != "emit":
        position = [dr.repeat(v, repeats) for v in field.capture_position(p_o)]
        x = net("capture_net").tensor(stack(_broadcast(field.capture_inputs(position, r_o), r_o), ns)).array
        logit = logit - softplus(-x)
    return logit


def _broadcast(rows: list, like: Any) -> list:
    """Broadcast constants among ``rows``, which have one lane, to the number of lanes of ``like``."""
    return [r + dr.zeros(type(r), dr.width(like)) if dr.width(r) == 1 else r for r in rows]


# ---- Likelihood ----
#
# Maximum-likelihood training of a normalised gaze field: a softmax over the sphere of each observer.
#
# Rays are drawn from the kernel density of a probe, so that the target is as smooth as the kernel is wide. The loss is
# the mean negative log density of these rays. Its normalising integral is estimated from uniformly drawn directions
# (sampled softmax; Blanc and Rendle 2018). The expected gradient is that of KL(truth || field).


class LikelihoodTrainer(GazeTrainer):
    """Trains a ``LogGazeField`` by maximum likelihood; see ``GazeTrainer``. The prior is ``targets.prior_table``, or
    uniform without one."""

    def complete_config(self, config: LogGazeConfig, targets: GazeTargets) -> LogGazeConfig:
        # Capture's encoding spans the observer positions.
        return replace(config, heads=targets.observer_bounds or compute_observer_bounds(targets.positions, self.box))

    def set_targets(self, targets: GazeTargets, epoch: int) -> None:
        super().set_targets(targets, epoch)
        # Cumulative distribution of each probe over its directions of equal area, for inverse transform sampling.
        self._cumulative = np.cumsum(targets.truth, axis=1, dtype=np.float64)

    def init_field(self) -> LogGazeField:
        return LogGazeField.random(self.config, self.box, self.ns, self.settings.seed, self._targets.prior_table)

    def select_trainable(self, parameters: dict) -> dict:
        """Select the trainable ``parameters``: all but the position-independent prior and what the variant does not
        use."""
        unused = {"emit": ("capture_net",), "capture": ("emit_net", "grid", "escaped")}.get(self.config.variant, ())
        if self.config.fills_escaped:
            unused += ("escaped",)
        return {k: v for k, v in super().select_trainable(parameters).items() if not k.startswith(unused)}

    def draw_batch(self) -> GazeBatch:
        """Draw uniform directions, followed by rays of the true density."""
        s, data = self.settings, self.data
        observers = self.rng.choice(data.num_observers, min(s.probes, data.num_observers), replace=False)
        D = min(s.directions, data.num_directions)
        uniform = np.argpartition(self.rng.random((len(observers), data.num_directions)), D - 1, axis=1)[:, :D]
        cumulative = self._cumulative[observers]
        drawn = self.rng.random((len(observers), s.rays)) * cumulative[:, -1:]
        rays = np.stack([np.searchsorted(row, u) for row, u in zip(cumulative, drawn)])
        return data.gather_batch(observers, np.concatenate([uniform, rays], axis=1))

    def compute_loss(self, batch: GazeBatch) -> Any:
        logit = evaluate_log_density(self.initial_field, batch, self.current_parameters(), self.ns)
        # Split each probe's directions into the uniform ones and the rays.
        ns, count, rays = self.ns, dr.width(batch.p_o), self.settings.rays
        run = dr.width(batch.r_o) // count
        D, lane = run - rays, lambda n: dr.arange(ns.UInt32, count * n)
        part = lambda n, first: dr.gather(ns.Float, logit, lane(n) // n * run + lane(n) % n + first)
        likelihood = dr.block_sum(part(rays, D), rays) / rays
        return dr.mean(log_mean_exp(part(D, 0), D) - likelihood + dr.log(batch.solid_angle))

    def evaluate_density(self, batch: GazeBatch, parameters: dict) -> Any:
        logit = evaluate_log_density(self.initial_field, batch, parameters, self.ns)
        D = dr.width(logit) // dr.width(batch.solid_angle)
        return dr.exp(logit - dr.repeat(log_mean_exp(logit, D) + dr.log(batch.solid_angle), D))

    def validation_objective(self, kld: float, cc: float, mae: float, off: float) -> float:
        return kld


def log_mean_exp(logit: Any, count: int) -> Any:
    """Return the log of the mean of exp over each run of ``count`` values, without overflow."""
    top = dr.detach(dr.block_reduce(dr.ReduceOp.Max, logit, count))
    return dr.log(dr.block_sum(dr.exp(logit - dr.repeat(top, count)), count) / count) + top


# ---- Recipe ----


def _make_log_density_config(options: FieldOptions) -> LogGazeConfig:
    return LogGazeConfig(
        grid=HashGridConfig(levels=5, log2_rows=14, base=2, finest=32),
        variant=options.variant,
        sh_degree=3,
        mix=0.05,
        prior_factor=False,
        **get_geometry_options(options.geometry_kind),
    )


def get_geometry_options(geometry_kind: str) -> dict[str, Any]:
    """Return the `LogGazeConfig` options for a kind of training geometry.

    Geometry made of hit points has holes, so misses take the depth of neighbouring directions. Without geometry there
    are no surfaces.
    """
    return {
        "escaped": "nearest" if geometry_kind == "hits" else "constant",
        "geometry": "none" if geometry_kind == "none" else "surface",
    }


register_recipe(
    Recipe(
        name=DEFAULT_RECIPE,
        summary="a log density, normalised over the sphere, trained by maximum likelihood; generalises best",
        make_config=_make_log_density_config,
        trainer=LikelihoodTrainer,
        losses=("likelihood",),
        # No validation zones: a fit without the validation zones and their surroundings would lack most probes. Weight
        # decay and few harmonics prevent overfitting to the training participants: two or three times as many steps
        # give the same result.
        settings=GazeSettings(
            steps=160,
            validation_zones=0,
            loss="likelihood",
            integral_weight=0.0,
            probes=24,
            directions=512,
            rays=64,
            learning_rate=3e-3,
            lr_final_ratio=0.1,
            lr_hold_fraction=0.5,
            weight_decay=1.0,
            ema_decay=0.95,
            validation_min_rays=64,
            prior_folds=5,
            reaimed_hits=True,
        ),
        # Probes are spaced evenly over the observer positions; a density proportional to the rays would follow where
        # people linger. Participants are weighted equally, because a long stay of one participant says little about
        # others.
        probes=ProbeSettings(
            placement="blue", spacing=0.08, probes=1024, min_rays=1, kappa=200.0, directions=2048, ray_weights="person"
        ),
        views_only_settings={"steps": 200, "validation_zones": 3, "patience": 10},
        supported_options=frozenset({"prior_folds", "prior_kappa", "reaimed_hits"}),
    )
)
