"""Training of the log-density gaze field: its forward pass, its likelihood, its recipe, and the elevation prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import HashGrid, HashGridConfig
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

# ---- Forward pass with the networks as tensor products, which trains fastest ----


def evaluate_log_density(
    config: LogGazeConfig, box: AnyBox, parameters: dict, p_od: Any, p_o: Any, r_o: Any, misses: Any, ns: ModuleType
) -> Any:
    """Evaluate the log of the unnormalised gaze density.

    Parameters
    ----------
    config : LogGazeConfig
        Configuration of the field.
    box : AnyBox
        Bounds of the field.
    parameters : dict
        Parameter arrays by their names in the field. Gradients reach every entry that the variant uses.
    p_od : Array3f
        Surface points (B * D lanes).
    p_o : Array3f
        Observer positions (B lanes).
    r_o : Array3f
        Unit viewing directions (B * D lanes), D for each observer in turn.
    misses : Bool
        Directions that hit no surface (B * D lanes).

    Returns
    -------
    Float
        Logarithm of what ``LogGazeField.unnormalized`` multiplies (B * D lanes).
    """
    net = lambda name: MLP([parameters[f"{name}.{i}"] for i in range(config.layers + 1)])
    # The field computes the network inputs.
    field = _Inputs(
        config, box, HashGrid.from_parameters(config.grid, parameters, mode=dr.ReduceMode.Expand), parameters["prior"]
    )
    repeats = dr.width(r_o) // dr.width(p_o)
    logit = field.log_base(r_o)
    each = dr.gather(type(p_o), p_o, dr.arange(ns.UInt32, dr.width(r_o)) // repeats)
    if config.variant != "capture":
        inputs = field.emit_inputs(p_od, each, r_o)
        emit = net("emit_net").tensor(stack(_broadcast(inputs, r_o), ns)).array
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
        x = net("capture_net").tensor(stack(_broadcast(field.capture_inputs(position, r_o), r_o), ns)).array
        logit = logit - softplus(-x)
    return logit


class _Inputs(LogGazeField):
    """A field without networks, used for its inputs."""

    def __init__(self, config: LogGazeConfig, box: AnyBox, grid: HashGrid, prior: Any):
        self.config, self.box, self.grid, self.prior = config, box, grid, prior


def _broadcast(rows: list, like: Any) -> list:
    """Broadcast constants among ``rows``, which have one lane, to the number of lanes of ``like``."""
    return [r + dr.zeros(type(r), dr.width(like)) if dr.width(r) == 1 else r for r in rows]


def select_trainable_parameters(config: LogGazeConfig, parameters: dict) -> dict:
    """Select the trainable ``parameters``: all but the position-independent prior and what the variant does not use."""
    unused = {"emit": ("capture_net",), "capture": ("emit_net", "grid", "escaped")}.get(config.variant, ())
    if config.escaped == "nearest":
        unused += ("escaped",)
    return {k: v for k, v in parameters.items() if k != "prior" and not k.startswith(unused or ("-",))}


# ---- Likelihood ----
#
# Maximum-likelihood training of a normalised gaze field: a softmax over the sphere of each observer.
#
# Rays are drawn from the kernel density of a probe, so that the target is as smooth as the kernel is wide. The loss is
# the mean negative log density of these rays. Its normalising integral is estimated from uniformly drawn directions
# (sampled softmax; Blanc and Rendle 2018). The expected gradient is that of KL(truth || field).


class LikelihoodTrainer(GazeTrainer):
    """Trains a ``LogGazeField`` by maximum likelihood; see ``GazeTrainer``. Requires ``targets.prior_table``."""

    def complete_config(self, config: LogGazeConfig, targets: GazeTargets) -> LogGazeConfig:
        self._prior_table = targets.prior_table
        # Capture's encoding spans the observer positions.
        return replace(config, heads=targets.observer_bounds or compute_observer_bounds(targets.positions, self.box))

    def set_targets(self, targets: GazeTargets, epoch: int) -> None:
        super().set_targets(targets, epoch)
        # Cumulative distribution of each probe over its directions of equal area, for inverse transform sampling.
        self._cumulative = np.cumsum(targets.truth, axis=1, dtype=np.float64)

    def init_field(self) -> LogGazeField:
        return LogGazeField.random(self.config, self.box, self.ns, self.settings.seed, self._prior_table)

    def select_trainable(self, parameters: dict) -> dict:
        return select_trainable_parameters(self.config, parameters)

    def backward(self) -> None:
        s, data, ns = self.settings, self.data, self.ns
        observers = self.rng.choice(data.num_observers, min(s.probes, data.num_observers), replace=False)
        D = min(s.directions, data.num_directions)
        uniform = np.argpartition(self.rng.random((len(observers), data.num_directions)), D - 1, axis=1)[:, :D]
        cumulative = self._cumulative[observers]
        drawn = self.rng.random((len(observers), s.rays)) * cumulative[:, -1:]
        rays = np.stack([np.searchsorted(row, u) for row, u in zip(cumulative, drawn)])
        batch = data.gather_batch(observers, np.concatenate([uniform, rays], axis=1))
        logit = self._evaluate_logit(batch, self.current_parameters())
        # Split each probe's directions into the uniform ones and the rays.
        run, lane = D + s.rays, lambda n: dr.arange(ns.UInt32, len(observers) * n)
        part = lambda n, first: dr.gather(ns.Float, logit, lane(n) // n * run + lane(n) % n + first)
        likelihood = dr.block_sum(part(s.rays, D), s.rays) / s.rays
        self.loss = dr.mean(log_mean_exp(part(D, 0), D) - likelihood + dr.log(batch.solid_angle))
        dr.backward(self.loss)

    def _evaluate_logit(self, batch: GazeBatch, parameters: dict) -> Any:
        return evaluate_log_density(
            self.config, self.box, parameters, batch.p_od, batch.p_o, batch.r_o, batch.misses, self.ns
        )

    def evaluate_density(self, batch: GazeBatch, parameters: dict) -> Any:
        return self._normalise(batch, self._evaluate_logit(batch, parameters))

    @staticmethod
    def _normalise(batch: GazeBatch, logit: Any) -> Any:
        D = dr.width(logit) // dr.width(batch.solid_angle)
        return dr.exp(logit - dr.repeat(log_mean_exp(logit, D) + dr.log(batch.solid_angle), D))

    def validation_objective(self, kld: float, cc: float, mae: float, off: float) -> float:
        return kld


def log_mean_exp(logit: Any, count: int) -> Any:
    """Return the log of the mean of exp over each run of ``count`` values, without overflow."""
    top = dr.detach(dr.block_reduce(dr.ReduceOp.Max, logit, count))
    return dr.log(dr.block_sum(dr.exp(logit - dr.repeat(top, count)), count) / count) + top


# ---- Elevation prior ----
#
# A gaze field for an environment without recordings: the distribution of the gaze elevation in other environments.
#
# Among the candidates tried, only the elevation transfers between environments (docs/gaze-evaluation.md): laws of
# distance or incidence fitted in other environments predict gaze worse.

ELEVATION_KAPPA = 30.0  # Concentration of the kernel of a ray
ELEVATION_PRIOR = "prior"  # Recipe in the provenance of such a field
# Bins of the sine of the elevation, and directions of the quadrature that normalises the table.
_NUM_BINS, _QUADRATURE_DIRECTIONS = 2048, 1 << 16


def compute_elevation_density(
    environments: Sequence[Rays], sine: np.ndarray, kappa: float = ELEVATION_KAPPA
) -> np.ndarray:
    """Estimate the gaze density as a function of the elevation only.

    Parameters
    ----------
    environments : sequence of Rays
        Gaze rays of each environment, z up. Environments have equal weight, and so have the participants of an
        environment.
    sine : numpy.ndarray
        Sine of the elevation (N,) at which to evaluate.
    kappa : float
        Concentration of the von Mises-Fisher kernel of a ray.

    Returns
    -------
    numpy.ndarray
        Density (N,) in 1/sr.

    Notes
    -----
    The mean over azimuths of a von Mises-Fisher density of concentration κ about a direction with sine t is C(κ) exp(κ
    (s t - 1)) I₀(κ √(1 - s²) √(1 - t²)), with C of `maths.vmf`. `ive` is the exponentially scaled I₀.
    """
    from scipy.special import ive

    histogram = np.zeros(_NUM_BINS)
    for rays in environments:
        weights = compute_participant_weights(rays) / len(rays) / len(environments)
        histogram += np.histogram(rays.direction[:, 2], _NUM_BINS, (-1, 1), weights=weights)[0]
    t, s = (np.arange(_NUM_BINS) + 0.5) * 2 / _NUM_BINS - 1, np.asarray(sine, np.float64)[:, None]
    across = np.sqrt(np.maximum(1 - s**2, 0)) * np.sqrt(1 - t**2)
    return np.exp(log_normaliser(kappa) + kappa * (s * t + across - 1)) * ive(0, kappa * across) @ histogram


def make_elevation_prior(environments: Sequence[Rays], ns: ModuleType) -> LogGazeField:
    """Make a gaze field that is the elevation density of ``environments`` at every observer position.

    It can be used in any environment whose z axis points up, in any unit of length. ``ns`` is the Dr.Jit backend.
    """
    # The prior weight is 1: the networks exist but have no influence.
    grid = HashGridConfig(levels=1, log2_rows=4, base=2, finest=2)
    config = LogGazeConfig(grid=grid, variant="emit", width=8, layers=1, geometry="none", mix=1.0)
    rows = config.prior
    # Evaluate one texel per row; the density is the same in all columns.
    density = np.repeat(compute_elevation_density(environments, table_directions(rows)[:: 2 * rows, 2]), 2 * rows)
    table = make_prior_table(density, rows, ns, fibonacci_directions(_QUADRATURE_DIRECTIONS))
    return LogGazeField.random(config, Box((-1.0,) * 3, (1.0,) * 3), ns, prior=table)


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
        settings={
            "steps": 160,
            "validation_zones": 0,
            "loss": "likelihood",
            "integral_weight": 0.0,
            "probes": 24,
            "directions": 512,
            "rays": 64,
            "learning_rate": 3e-3,
            "lr_final_ratio": 0.1,
            "lr_hold_fraction": 0.5,
            "weight_decay": 1.0,
            "ema_decay": 0.95,
            "validation_min_rays": 64,
            "prior_folds": 5,
            "reaimed_hits": True,
        },
        # Probes are spaced evenly over the observer positions; a density proportional to the rays would follow where
        # people linger. Participants are weighted equally, because a long stay of one participant says little about
        # others.
        probes={
            "placement": "blue",
            "spacing": 0.08,
            "probes": 1024,
            "min_rays": 1,
            "kappa": 200.0,
            "directions": 2048,
            "ray_weights": "person",
        },
        views_only_settings={"steps": 200, "validation_zones": 3, "patience": 10},
        supported_options=frozenset({"prior_folds", "prior_kappa", "reaimed_hits"}),
    )
)
