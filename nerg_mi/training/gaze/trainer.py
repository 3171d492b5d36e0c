"""Training a gaze field on probes (NeRG, Section 4.3): positions and directions in, densities out."""

from __future__ import annotations

import time
from typing import NamedTuple

import drjit as dr
import numpy as np
from drjit.opt import AdamW

from nerg_mi.errors import NergError
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.maths.box import Box

from .losses import VANISHED, gaze_loss
from .product_model import gaze_density, used_parameters
from .settings import LOSSES, GazeSettings
from .supervision import Supervision

# Samples of one launch of a validation.
_CHUNK = 1 << 16


class Scores(NamedTuple):
    """Means over probes: ``loss`` as trained, ``kld`` (nats), ``cc``, ``mae`` (1/sr), ``integral`` over the sphere."""

    loss: float
    kld: float
    cc: float
    mae: float
    integral: float


class GazeTrainer:
    """One run: state, ``step()``, ``measure()``, and ``field()`` for what it has come to.

    ``supervision``: what to learn from; ``box``: where the field lives, in the same frame; ``schedule``: steps that the
    learning rate's schedule spans, where that is not ``settings``' own length; ``initial``: arrays to begin with in
    place of random ones, which with ``settings.frozen`` stay as they are. Equal seeds draw equal batches; sums over
    threads are not ordered, so that weights agree between runs to rounding (and bit for bit only with one thread).
    """

    def __init__(
        self,
        supervision: Supervision,
        box: Box,
        config: GazeConfig,
        settings: GazeSettings,
        ns,
        schedule: int | None = None,
        initial: dict | None = None,
    ):
        self.config, self.settings, self.box, self.ns = config, settings, box, ns
        self.rng = np.random.default_rng(settings.seed)
        self._schedule, self._supervision = schedule, supervision
        self._learn_from(supervision, 0)
        self.initial = self._untrained()
        if initial:
            self.initial.set_parameters(initial)
        self.constant = dict(initial or {}) if settings.frozen else {}
        trained = {k: v for k, v in self._trainable(self.initial.parameters()).items() if k not in self.constant}
        self.optimiser = AdamW(
            settings.learning_rate, trained, beta_2=0.99, epsilon=1e-15, weight_decay=settings.weight_decay
        )
        self.averaged = {k: type(v)(dr.detach(v)) for k, v in self.optimiser.items()}
        self.steps, self.loss = 0, None
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Wall time of the run, without that between an interruption and its resumption."""
        return time.perf_counter() - self._started

    @property
    def progress(self) -> float:
        """Share of the schedule that is done, 0..1."""
        s, steps = self.settings, self._schedule or self.settings.steps
        return min(1.0, self.steps / steps if steps else self.seconds / (60 * s.minutes))

    def restore(self, steps: int, seconds: float, random: dict) -> None:
        """Go on from stored numbers; see ``gaze_state``."""
        self.steps, self._started = steps, time.perf_counter() - seconds
        self.rng.bit_generator.state = random

    def _learn_from(self, supervision: Supervision, epoch: int) -> None:
        self.data, self._epoch = _Samples(supervision, self.ns), epoch

    def _untrained(self) -> GazeField:
        return GazeField.random(self.config, self.box, self.ns, self.settings.seed)

    def _trainable(self, parameters: dict) -> dict:
        return used_parameters(self.config, parameters)

    def _now(self) -> dict:
        """All arrays, as they are while training."""
        return {**self.constant, **dict(self.optimiser.items())}

    def step(self) -> None:
        """Draw probes and directions, and move the weights once."""
        if self._supervision.renew is not None:
            epoch = self.steps * min(self.settings.probes, self.data.probes) // self.data.probes
            if epoch != self._epoch:
                self._learn_from(self._supervision.renew(epoch), epoch)
        self._backward()
        self.optimiser.set_learning_rate(self.settings.rate(self.progress))
        self.optimiser.step()
        self.steps += 1
        # A short memory at first: the start of a run is not worth remembering.
        decay = min(self.settings.average, (1 + self.steps) / (10 + self.steps))
        for k, old in self.averaged.items():
            self.averaged[k] = old + (dr.detach(self.optimiser[k]) - old) * dr.opaque(self.ns.Float, 1 - decay)
        dr.eval(self.averaged)
        # Steps are only queued otherwise: their time would count as none, and a run of minutes would go on long after
        # them.
        dr.sync_thread()

    def _backward(self) -> None:
        """Draw a batch, and leave the gradients of its loss in the weights."""
        s, data = self.settings, self.data
        probes = min(s.probes, data.probes)
        D = min(s.directions, data.count)
        probe = self.rng.choice(data.probes, probes, replace=False)
        if D < data.count:
            which = np.argpartition(self.rng.random((probes, data.count)), D, axis=1)[:, :D]
        else:
            which = np.broadcast_to(np.arange(D), (probes, D))
        prediction, truth = data.evaluate(self.config, self.box, self._now(), probe, which)
        self.loss = gaze_loss(prediction, truth, D, **LOSSES[s.loss])
        total = self.loss.total
        if s.integral:
            # Against the truth in the same directions, so that drawing few of them is no bias.
            total += s.integral * dr.mean(dr.square(_integral(prediction - truth, data.extent(probe))))
        dr.backward(total)

    def measure(self, supervision: Supervision, weights: dict | None = None) -> Scores:
        """Scores of the averaged weights (or of ``weights``) on other probes, all of their directions."""
        data = _Samples(supervision, self.ns)
        block, rows = max(1, _CHUNK // data.count), []
        which = np.arange(data.count)[None]
        with dr.suspend_grad():
            for a in range(0, data.probes, block):
                probe = np.arange(a, min(a + block, data.probes))
                prediction, truth = self._densities(
                    data,
                    {**self.constant, **(weights or self.averaged)},
                    probe,
                    np.broadcast_to(which, (len(probe), data.count)),
                )
                parts = gaze_loss(prediction, truth, data.count)
                integral = _integral(prediction, data.extent(probe))
                means = parts.kld, parts.cc, parts.mae, dr.mean(integral), dr.mean(dr.square(1 - integral))
                rows.append((len(probe), *(float(v[0]) for v in means)))
        rows = np.array(rows)
        kld, cc, mae, integral, off = rows[:, 0] @ rows[:, 1:] / rows[:, 0].sum()
        return Scores(self._loss(kld, cc, mae, off), kld, cc, mae, integral)

    def _densities(self, data: _Samples, parameters: dict, probe: np.ndarray, which: np.ndarray) -> tuple:
        """``(prediction, truth)`` in 1/sr for a validation."""
        return data.evaluate(self.config, self.box, parameters, probe, which)

    def _loss(self, kld: float, cc: float, mae: float, off: float) -> float:
        """What a validation is judged by."""
        w = LOSSES[self.settings.loss]
        return w["kld"] * kld + w["cc"] * (1 - cc) + w["mae"] * mae + self.settings.integral * off

    def weights(self) -> dict:
        """A copy of the averaged weights."""
        return {k: type(v)(v) for k, v in self.averaged.items()}

    def field(self, weights: dict | None = None) -> GazeField:
        """The field with the averaged weights (or ``weights``)."""
        out = self._untrained()
        out.set_parameters({**self.constant, **(weights or self.weights())})
        return out


def _integral(density, extent):
    """Integral of each probe's density over its ``extent`` (sr, a lane a probe), of which the directions are equal
    parts."""
    directions = dr.width(density) // dr.width(extent)
    return dr.block_sum(density, directions) * (extent / directions)


class _Samples:
    """A ``Supervision`` as arrays of a backend, from which batches are gathered."""

    def __init__(self, s: Supervision, ns):
        self.ns, self.probes, self.count = ns, *s.truth.shape
        if self.probes == 0:
            raise NergError("there are no probes to train on")
        flat = lambda v: ns.Float(np.ascontiguousarray(v, np.float32).ravel())
        self._extent = None if s.extent is None else np.asarray(s.extent, np.float32)
        self._positions, self._directions = flat(s.positions), flat(s.directions)
        self._truth, self._distance = flat(s.truth), flat(s.distance)
        self._features = 0 if s.semantic is None else s.semantic.shape[-1]
        if self._features:
            self._semantic = ns.Float16(np.ascontiguousarray(s.semantic).ravel())

    def evaluate(self, config, box, parameters, probe: np.ndarray, which: np.ndarray):
        """``(prediction, truth)`` in directions ``which`` (B, D) of the probes ``probe`` (B,), flat."""
        ns = self.ns
        p_od, p_o, r_o, index = self.gather(probe, which)
        semantic = None
        if config.semantic:
            F = self._features
            semantic = [ns.Float(dr.gather(ns.Float16, self._semantic, index * F + k)) for k in range(F)]
        prediction = gaze_density(config, box, parameters, p_od, p_o, r_o, ns, semantic)
        truth = self.truth(index)
        return self.given_view(prediction, probe, truth), truth

    def extent(self, probe: np.ndarray):
        """Solid angle (sr, a lane a probe) that the directions of the probes ``probe`` are equal parts of."""
        return self.ns.Float(
            np.full(len(probe), 4 * np.pi, np.float32) if self._extent is None else self._extent[probe]
        )

    def given_view(self, density, probe: np.ndarray, truth=None):
        """Densities of probes that are views, given the view: what else is looked at is not known there. Others stay.
        The result has the integral that ``truth`` has in the same directions, else one."""
        if self._extent is None:
            return density
        extent = self.extent(probe)
        inside = _integral(dr.maximum(density, 0), extent)
        # A density of zeros has no scale to be taken out.
        scaled = (extent < 4 * np.pi * (1 - 1e-6)) & (inside > VANISHED)
        factor = dr.select(scaled, (1 if truth is None else _integral(truth, extent)) / dr.select(scaled, inside, 1), 1)
        return density * dr.repeat(factor, dr.width(density) // len(probe))

    def gather(self, probe: np.ndarray, which: np.ndarray) -> tuple:
        """``(p_od, p_o, r_o, index)`` of directions ``which`` (B, D) of the probes ``probe`` (B,); p_o has B lanes."""
        ns = self.ns
        at = ns.UInt32(probe.astype(np.uint32))
        index = ns.UInt32((probe[:, None] * self.count + which).astype(np.uint32).ravel())
        p_o, r_o = dr.gather(ns.Array3f, self._positions, at), dr.gather(ns.Array3f, self._directions, index)
        p_od = dr.gather(ns.Array3f, self._positions, index // self.count) + r_o * dr.gather(
            ns.Float, self._distance, index
        )
        return p_od, p_o, r_o, index

    def truth(self, index):
        """True densities (1/sr) at ``index`` of ``gather``."""
        return dr.gather(self.ns.Float, self._truth, index)
