"""The log-density head in training: its model, the likelihood of rays, its recipe, and a field of a prior alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import Encoding, HashGridConfig, encoding_from_parameters
from nerg_mi.fields.gaze_base import make_prior_table, table_directions
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import softplus
from nerg_mi.fields.mlp import MLP
from nerg_mi.maths.geometry import AnyBox, Box
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.vmf import log_normaliser
from nerg_mi.probes.probes import compute_participant_weights
from nerg_mi.rays.rays import Rays

from .gaze_data import GazeBatch, GazeTargets, compute_observer_bounds
from .gaze_recipes import DEFAULT_RECIPE, FieldOptions, Recipe, register_recipe
from .gaze_trainer import GazeTrainer
from .radiance_losses import stack

# ---- The log-density gaze field's forward pass in the form that trains fastest: networks as tensor products ----


def evaluate_log_density(
    config: LogGazeConfig, box: AnyBox, parameters: dict, p_od: Any, p_o: Any, r_o: Any, misses: Any, ns: ModuleType
) -> Any:
    """Log of the unnormalised density of B observers ``p_o`` (Array3f, B lanes) along ``r_o`` (Array3f, B * D lanes, D
    for each in turn) at ``p_od``, ``escaped`` (Bool, as many) where there is no surface.

    The logarithm of what ``LogGazeField.unnormalized`` multiplies, on ``parameters`` spelt as the field spells them;
    gradients reach every entry that the variant uses.
    """
    net = lambda name: MLP([parameters[f"{name}.{i}"] for i in range(config.layers + 1)])
    # The field's own inputs.
    field = _Inputs(config, box, encoding_from_parameters(config.grid, parameters, mode=dr.ReduceMode.Expand), parameters["prior"])
    repeats = dr.width(r_o) // dr.width(p_o)
    logit = field.log_prior(r_o)
    each = dr.gather(type(p_o), p_o, dr.arange(ns.UInt32, dr.width(r_o)) // repeats)
    if config.variant != "capture":
        inputs = field.emit_inputs(p_od, each, r_o)
        emit = net("emit_net").tensor(stack(_full(inputs, r_o), ns)).array
        logit = logit + (
            emit
            if config.escaped == "nearest"
            else dr.select(
                misses,
                dr.gather(
                    ns.Float, parameters["escaped"], dr.zeros(ns.UInt32, dr.width(r_o)), mode=dr.ReduceMode.Expand
                ),
                emit,
            )
        )
    if config.variant != "emit":
        position = [dr.repeat(v, repeats) for v in field.capture_position(p_o)]
        x = net("capture_net").tensor(stack(_full(field.capture_inputs(position, r_o), r_o), ns)).array
        logit = logit - softplus(-x)
    return logit


class _Inputs(LogGazeField):
    """The part of a field that has no networks."""

    def __init__(self, config: LogGazeConfig, box: AnyBox, grid: Encoding, prior: Any):
        self.config, self.box, self.grid, self.prior = config, box, grid, prior


def _full(rows: list, like: Any) -> list:
    """``rows`` of as many lanes as ``like``: constants have one."""
    return [r + dr.zeros(type(r), dr.width(like)) if dr.width(r) == 1 else r for r in rows]


def select_trainable_parameters(config: LogGazeConfig, parameters: dict) -> dict:
    """Those of ``parameters`` that are trained: the blind density is not, and nothing that the variant leaves out."""
    idle = {"emit": ("capture_net",), "capture": ("emit_net", "grid", "escaped")}.get(config.variant, ())
    if config.escaped == "nearest":
        idle += ("escaped",)
    return {k: v for k, v in parameters.items() if k != "prior" and not k.startswith(idle or ("-",))}


# ---- Likelihood ----
#
# Training a normalised gaze field by the likelihood of rays: a softmax over each observer's sphere.
#
# A probe's rays are drawn from its kernel density: rays, each moved by its kernel, so that what is learnt is as smooth
# as the kernel is wide. The loss is their mean negative log density; the integral that normalises it is estimated from
# directions drawn uniformly (Blanc & Rendle 2018 on sampled softmax). Expectations are those of KL(truth || field).


class LikelihoodTrainer(GazeTrainer):
    """A run of a ``LogGazeField``; see ``GazeTrainer``. ``targets.blind``: its table of the blind density."""

    def complete_config(self, config: LogGazeConfig, targets: GazeTargets) -> LogGazeConfig:
        self._blind = targets.prior_table
        # Capture's encoding spans where people's heads were.
        return replace(config, heads=targets.observer_bounds or compute_observer_bounds(targets.positions, self.box))

    def set_targets(self, targets: GazeTargets, epoch: int) -> None:
        super().set_targets(targets, epoch)
        # Inverse transform sampling: each probe's distribution function over its directions of equal area.
        self._steps = np.cumsum(targets.truth, axis=1, dtype=np.float64)

    def init_field(self) -> LogGazeField:
        return LogGazeField.random(self.config, self.box, self.ns, self.settings.seed, self._blind)

    def select_trainable(self, parameters: dict) -> dict:
        return select_trainable_parameters(self.config, parameters)

    def backward(self) -> None:
        s, data, ns = self.settings, self.data, self.ns
        observers = self.rng.choice(data.num_observers, min(s.probes, data.num_observers), replace=False)
        D = min(s.directions, data.num_directions)
        uniform = np.argpartition(self.rng.random((len(observers), data.num_directions)), D - 1, axis=1)[:, :D]
        steps = self._steps[observers]
        drawn = self.rng.random((len(observers), s.rays)) * steps[:, -1:]
        rays = np.stack([np.searchsorted(row, u) for row, u in zip(steps, drawn)])
        batch = data.gather_batch(observers, np.concatenate([uniform, rays], axis=1))
        logit = self._logit(batch, self.current_parameters())
        # Back into the two halves of each probe's run.
        run, lane = D + s.rays, lambda n: dr.arange(ns.UInt32, len(observers) * n)
        part = lambda n, first: dr.gather(ns.Float, logit, lane(n) // n * run + lane(n) % n + first)
        likelihood = dr.block_sum(part(s.rays, D), s.rays) / s.rays
        self.loss = dr.mean(log_mean_exp(part(D, 0), D) - likelihood + dr.log(batch.solid_angle))
        dr.backward(self.loss)

    def _logit(self, batch: GazeBatch, parameters: dict) -> Any:
        return evaluate_log_density(self.config, self.box, parameters, batch.p_od, batch.p_o, batch.r_o, batch.misses, self.ns)

    def evaluate_density(self, batch: GazeBatch, parameters: dict) -> Any:
        return self._normalised(batch, self._logit(batch, parameters))

    @staticmethod
    def _normalised(batch: GazeBatch, logit: Any) -> Any:
        D = dr.width(logit) // dr.width(batch.solid_angle)
        return dr.exp(logit - dr.repeat(log_mean_exp(logit, D) + dr.log(batch.solid_angle), D))

    def validation_objective(self, kld: float, cc: float, mae: float, off: float) -> float:
        return kld


def log_mean_exp(logit: Any, count: int) -> Any:
    """Log of the mean of exp over each run of ``count`` values, without overflow."""
    top = dr.detach(dr.block_reduce(dr.ReduceOp.Max, logit, count))
    return dr.log(dr.block_sum(dr.exp(logit - dr.repeat(top, count)), count) / count) + top


# ---- Prior ----
#
# A gaze field for a place where nobody was tracked: how high people look, learnt in other places.
#
# Of what was tried, the elevation alone carries over from place to place (docs/explanation/accuracy.md): laws of distance,
# incidence and the like that were learnt in some places say less in others than it does.

ELEVATION_KAPPA = 30.0  # Concentration of the kernel of a ray
# Bins of the sine of the elevation; directions over which the table is scaled to integrate to one.
_BINS, _SCALED_OVER = 2048, 1 << 16


def compute_elevation_density(environments: Sequence[Rays], sine: np.ndarray, kappa: float = ELEVATION_KAPPA) -> np.ndarray:
    """Density (N,), 1/sr, of a direction whose elevation has ``sine`` (N,): the kernel density of the rays of
    ``places``, each turned to every azimuth alike. Places count alike, and people within a place.

    The mean over azimuths of a von Mises-Fisher density of concentration ``kappa`` about a direction of sine t is
    C(κ) exp(κ (s t - 1)) I₀(κ √(1 - s²) √(1 - t²)), `maths.vmf`'s C; `ive` is I₀ with its exponent taken out.
    """
    from scipy.special import ive

    share = np.zeros(_BINS)
    for rays in environments:
        weights = compute_participant_weights(rays) / len(rays) / len(environments)
        share += np.histogram(rays.direction[:, 2], _BINS, (-1, 1), weights=weights)[0]
    t, s = (np.arange(_BINS) + 0.5) * 2 / _BINS - 1, np.asarray(sine, np.float64)[:, None]
    across = np.sqrt(np.maximum(1 - s**2, 0)) * np.sqrt(1 - t**2)
    return np.exp(log_normaliser(kappa) + kappa * (s * t + across - 1)) * ive(0, kappa * across) @ share


def make_elevation_prior(environments: Sequence[Rays], ns: ModuleType) -> LogGazeField:
    """A gaze field that is `elevation_density` of ``places`` wherever an observer stands, with arrays of the backend
    ``ns``: in any place whose z axis points up, of any unit of length."""
    # All of it is the blind density: a network is there, and counts for nothing.
    grid = HashGridConfig(levels=1, log2_rows=4, base=2, finest=2)
    config = LogGazeConfig(grid=grid, variant="emit", width=8, layers=1, geometry="none", mix=1.0)
    rows = config.prior
    # One row of texels, for all columns.
    density = np.repeat(compute_elevation_density(environments, table_directions(rows)[:: 2 * rows, 2]), 2 * rows)
    table = make_prior_table(density, rows, ns, fibonacci_directions(_SCALED_OVER))
    return LogGazeField.random(config, Box((-1.0,) * 3, (1.0,) * 3), ns, prior=table)


# ---- Recipe ----


def _log_density(choices: FieldOptions) -> LogGazeConfig:
    return LogGazeConfig(
        grid=HashGridConfig(levels=5, log2_rows=14, base=2, finest=32),
        variant=choices.variant,
        sh_degree=3,
        mix=0.05,
        **get_geometry_options(choices.geometry_kind),
    )


def get_geometry_options(geometry_kind: str) -> dict[str, Any]:
    """What `LogGazeConfig` is told of a kind of ``place``: one of hit points has holes, through which nobody saw whom
    it was made from; no place has no surfaces."""
    return {
        "escaped": "nearest" if geometry_kind == "hits" else "constant",
        "geometry": "none" if geometry_kind == "none" else "surface",
    }


register_recipe(
    Recipe(
        name=DEFAULT_RECIPE,
        summary="a log density, normalised over the sphere, trained by the likelihood of rays; generalises best",
        make_config=_log_density,
        trainer=LikelihoodTrainer,
        losses=("likelihood",),
        # No zones: fits without those that a validation takes, and all around them, lack most of the probes. The
        # decay and the few harmonics keep longer trainings from following the people at hand: two or three times
        # the steps end alike.
        settings={
            "steps": 160,
            "zones": 0,
            "loss": "likelihood",
            "integral": 0.0,
            "probes": 24,
            "directions": 512,
            "rays": 64,
            "learning_rate": 3e-3,
            "lr_final_ratio": 0.1,
            "lr_hold_fraction": 0.5,
            "weight_decay": 4.0,
            "ema_decay": 0.95,
            "validation_min_rays": 64,
            "mix_folds": 5,
        },
        # Evenly over where people stood: as many at each place as there are rays would follow where people linger.
        # By person, not by time: whoever stays long at a place says little of others.
        probes={
            "placement": "blue",
            "spacing": 0.08,
            "count": 1024,
            "min_rays": 1,
            "kappa": 30.0,
            "mix_kappa": 10.0,
            "directions": 2048,
            "weights": "person",
        },
        views_only_settings={"steps": 200, "zones": 3, "patience": 10},
        supported_options=frozenset({"mix-folds", "mix-kappa"}),
        is_quick=True,
    )
)
