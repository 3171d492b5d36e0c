"""The log-density head in training: its model and the likelihood of rays."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import Encoding, encoding_of
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import softplus
from nerg_mi.fields.mlp import MLP
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import Batch, Targets
from .gaze_settings import GazeSettings
from .gaze_trainer import GazeTrainer
from .radiance_losses import stack

# ---- Log density model ----
#
# The log-density gaze field's forward pass in the form that trains fastest: networks as tensor products.


def log_gaze(
    config: LogGazeConfig, box: AnyBox, parameters: dict, p_od: Any, p_o: Any, r_o: Any, escaped: Any, ns: ModuleType
) -> Any:
    """Log of the unnormalised density of B observers ``p_o`` (Array3f, B lanes) along ``r_o`` (Array3f, B * D lanes, D
    for each in turn) at ``p_od``, ``escaped`` (Bool, as many) where there is no surface.

    The logarithm of what ``LogGazeField.unnormalized`` multiplies, on ``parameters`` spelt as the field spells them;
    gradients reach every entry that the variant uses.
    """
    net = lambda name: MLP([parameters[f"{name}.{i}"] for i in range(config.layers + 1)])
    # The field's own inputs.
    field = _Inputs(config, box, encoding_of(config.grid, parameters, mode=dr.ReduceMode.Expand), parameters["prior"])
    repeats = dr.width(r_o) // dr.width(p_o)
    logit = field.log_blind(r_o)
    each = dr.gather(type(p_o), p_o, dr.arange(ns.UInt32, dr.width(r_o)) // repeats)
    if config.variant != "capture":
        inputs = field.emit_inputs(p_od, each, r_o)
        emit = net("emit_net").tensor(stack(_full(inputs, r_o), ns)).array
        logit = logit + (
            emit
            if config.escaped == "nearest"
            else dr.select(
                escaped,
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


def used_parameters(config: LogGazeConfig, parameters: dict) -> dict:
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

    def __init__(
        self,
        targets: Targets,
        box: AnyBox,
        config: LogGazeConfig,
        settings: GazeSettings,
        ns: ModuleType,
        schedule: int | None = None,
        initial: dict | None = None,
    ):
        self._blind = targets.blind
        # Capture's encoding spans where people's heads were.
        config = replace(config, heads=targets.heads or heads_box(targets.positions, box))
        super().__init__(targets, box, config, settings, ns, schedule, initial)
        trained = set(self.optimiser.keys())
        self.constant = {k: v for k, v in self.initial.parameters().items() if k not in trained}

    def learn_from(self, targets: Targets, epoch: int) -> None:
        super().learn_from(targets, epoch)
        # Inverse transform sampling: each probe's distribution function over its directions of equal area.
        self._steps = np.cumsum(targets.truth, axis=1, dtype=np.float64)

    def untrained(self) -> LogGazeField:
        return LogGazeField.random(self.config, self.box, self.ns, self.settings.seed, self._blind)

    def trainable(self, parameters: dict) -> dict:
        return used_parameters(self.config, parameters)

    def backward(self) -> None:
        s, data, ns = self.settings, self.data, self.ns
        observers = self.rng.choice(data.count, min(s.probes, data.count), replace=False)
        D = min(s.directions, data.directions)
        uniform = np.argpartition(self.rng.random((len(observers), data.directions)), D - 1, axis=1)[:, :D]
        steps = self._steps[observers]
        drawn = self.rng.random((len(observers), s.rays)) * steps[:, -1:]
        rays = np.stack([np.searchsorted(row, u) for row, u in zip(steps, drawn)])
        batch = data.batch(observers, np.concatenate([uniform, rays], axis=1))
        logit = self._logit(batch, self.current())
        # Back into the two halves of each probe's run.
        run, lane = D + s.rays, lambda n: dr.arange(ns.UInt32, len(observers) * n)
        part = lambda n, first: dr.gather(ns.Float, logit, lane(n) // n * run + lane(n) % n + first)
        likelihood = dr.block_sum(part(s.rays, D), s.rays) / s.rays
        self.loss = dr.mean(log_mean_exp(part(D, 0), D) - likelihood + dr.log(batch.extent))
        dr.backward(self.loss)

    def _logit(self, batch: Batch, parameters: dict) -> Any:
        return log_gaze(self.config, self.box, parameters, batch.p_od, batch.p_o, batch.r_o, batch.escaped, self.ns)

    def densities(self, targets: Targets) -> tuple[np.ndarray, np.ndarray]:
        """Densities (P, D) of the averaged weights in the directions of ``targets``, as the field is without its share
        of the blind density; and the blind density there."""
        parts, D = [], targets.truth.shape[1]
        with dr.suspend_grad():
            for batch in self.batches(targets):
                density = self._normalised(batch, self._logit(batch, {**self.constant, **self.averaged}))
                blind = dr.exp(self.initial.log_blind(batch.r_o))
                parts.append([np.asarray(v).reshape(-1, D) for v in (density, blind)])
        field, blind = (np.concatenate(v) for v in zip(*parts))
        return field, blind

    def density(self, batch: Batch, parameters: dict) -> Any:
        logit, mix = self._logit(batch, parameters), self.config.mix
        density = self._normalised(batch, logit)
        if mix:
            # Of a view the share counts as on the sphere: the field's integral there is not known from within.
            density = (1 - mix) * density + mix * batch.given_view(dr.exp(self.initial.log_blind(batch.r_o)))
        return density

    @staticmethod
    def _normalised(batch: Batch, logit: Any) -> Any:
        D = dr.width(logit) // dr.width(batch.extent)
        return dr.exp(logit - dr.repeat(log_mean_exp(logit, D) + dr.log(batch.extent), D))

    def judge(self, kld: float, cc: float, mae: float, off: float) -> float:
        return kld


def heads_box(positions: np.ndarray, box: AnyBox) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Corners of the box of observers at ``positions`` (N, 3), with some extent along each axis of the place's
    ``box``."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    return tuple(low.tolist()), tuple(np.maximum(high, low + 1e-3 * box.side).tolist())


def log_mean_exp(logit: Any, count: int) -> Any:
    """Log of the mean of exp over each run of ``count`` values, without overflow."""
    top = dr.detach(dr.block_reduce(dr.ReduceOp.Max, logit, count))
    return dr.log(dr.block_sum(dr.exp(logit - dr.repeat(top, count)), count) / count) + top
