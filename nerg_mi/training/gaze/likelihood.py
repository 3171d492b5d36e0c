"""Training a normalised gaze field by the likelihood of rays: a softmax over each observer's sphere.

A probe's rays are drawn from its kernel density: rays, each moved by its kernel, so that what is learnt is as smooth as
the kernel is wide. The loss is their mean negative log density; the integral that normalises it is estimated from
directions drawn uniformly (Blanc & Rendle 2018 on sampled softmax). Expectations are those of KL(truth || field).
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np

from nerg_mi.field.gaze.log_density import LogGazeConfig, LogGazeField

from .log_density_model import log_gaze, used_parameters
from .supervision import Supervision
from .trainer import GazeTrainer, _Samples


class LikelihoodTrainer(GazeTrainer):
    """A run of a ``LogGazeField``; see ``GazeTrainer``. ``supervision.blind``: its table of the blind density."""

    def __init__(self, supervision: Supervision, box, config: LogGazeConfig, settings, ns, schedule=None, initial=None):
        self._blind = supervision.blind
        # Capture's encoding spans where people's heads were.
        low, high = supervision.positions.min(axis=0), supervision.positions.max(axis=0)
        config = replace(config, heads=(tuple(low.tolist()), tuple(np.maximum(high, low + 1e-3 * box.side).tolist())))
        super().__init__(supervision, box, config, settings, ns, schedule, initial)
        trained = set(self.optimiser.keys())
        self.constant = {k: v for k, v in self.initial.parameters().items() if k not in trained}

    def _learn_from(self, supervision: Supervision, epoch: int) -> None:
        super()._learn_from(supervision, epoch)
        self._escaped = self.ns.Bool(np.ascontiguousarray(supervision.escaped).ravel())
        # Inverse transform sampling: each probe's distribution function over its directions of equal area.
        self._steps = np.cumsum(supervision.truth, axis=1, dtype=np.float64)

    def _untrained(self) -> LogGazeField:
        return LogGazeField.random(self.config, self.box, self.ns, self.settings.seed, self._blind)

    def _trainable(self, parameters: dict) -> dict:
        return used_parameters(self.config, parameters)

    def _backward(self) -> None:
        s, data, ns = self.settings, self.data, self.ns
        probe = self.rng.choice(data.probes, min(s.probes, data.probes), replace=False)
        D = min(s.directions, data.count)
        uniform = np.argpartition(self.rng.random((len(probe), data.count)), D - 1, axis=1)[:, :D]
        steps = self._steps[probe]
        drawn = self.rng.random((len(probe), s.rays)) * steps[:, -1:]
        rays = np.stack([np.searchsorted(row, u) for row, u in zip(steps, drawn)])
        logit = self._logits(data, self._escaped, self._now(), probe, np.concatenate([uniform, rays], axis=1))
        # Back into the two halves of each probe's run.
        run, lane = D + s.rays, lambda n: dr.arange(ns.UInt32, len(probe) * n)
        part = lambda n, first: dr.gather(ns.Float, logit, lane(n) // n * run + lane(n) % n + first)
        likelihood = dr.block_sum(part(s.rays, D), s.rays) / s.rays
        total = dr.mean(_log_mean_exp(part(D, 0), D) - likelihood + dr.log(data.extent(probe)))
        self.loss = total
        dr.backward(total)

    def _logits(self, data: _Samples, escaped, parameters: dict, probe, which):
        p_od, p_o, r_o, index = data.gather(probe, which)
        return log_gaze(
            self.config, self.box, parameters, p_od, p_o, r_o, dr.gather(self.ns.Bool, escaped, index), self.ns
        )

    def measure(self, supervision: Supervision, weights: dict | None = None):
        self._measured = self.ns.Bool(np.ascontiguousarray(supervision.escaped).ravel())
        return super().measure(supervision, weights)

    def _densities(self, data, parameters, probe, which):
        D, m = which.shape[1], self.config.mix
        p_od, p_o, r_o, index = data.gather(probe, which)
        escaped = dr.gather(self.ns.Bool, self._measured, index)
        logit = log_gaze(self.config, self.box, parameters, p_od, p_o, r_o, escaped, self.ns)
        density = dr.exp(logit - dr.repeat(_log_mean_exp(logit, D) + dr.log(data.extent(probe)), D))
        if m:
            # Of a view the share m counts as on the sphere: the field's integral there is not known from within.
            density = (1 - m) * density + m * data.given_view(dr.exp(self.initial.log_blind(r_o)), probe)
        return density, data.truth(index)

    def _loss(self, kld, cc, mae, off):
        return kld


def _log_mean_exp(logit, count: int):
    """Log of the mean of exp over each run of ``count`` values, without overflow."""
    top = dr.detach(dr.block_reduce(dr.ReduceOp.Max, logit, count))
    return dr.log(dr.block_sum(dr.exp(logit - dr.repeat(top, count)), count) / count) + top
