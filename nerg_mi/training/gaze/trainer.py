"""Training a gaze field on targets (NeRG, Section 4.3): what every kind of field's training has in common."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from drjit.opt import AdamW

from nerg_mi.fields.gaze_base import GazeDensity
from nerg_mi.maths.geometry import AnyBox

from .batches import Batch, TargetArrays
from .losses import gaze_loss
from .settings import GazeSettings
from .targets import Targets

# Samples of one launch of a validation.
_CHUNK = 1 << 16


class Scores(NamedTuple):
    """Means over probes: ``loss`` as trained, ``kld`` (nats), ``cc``, ``mae`` (1/sr), ``integral`` over the sphere."""

    loss: float
    kld: float
    cc: float
    mae: float
    integral: float


class GazeTrainer(ABC):
    """One run: state, ``step()``, ``measure()``, and ``field()`` for what it has come to.

    ``targets``: what to learn from; ``box``: where the field lives, in the same frame; ``config``: of the field;
    ``schedule``: steps that the learning rate's schedule spans, where that is not ``settings``' own length;
    ``initial``: arrays to begin with in place of random ones, which with ``settings.frozen`` stay as they are. Equal
    seeds draw equal batches; sums over threads are not ordered, so that weights agree between runs to rounding (and bit
    for bit only with one thread).

    A kind of field has a class of its own, which says what its weights are and what moves them.
    """

    def __init__(
        self,
        targets: Targets,
        box: AnyBox,
        config: Any,
        settings: GazeSettings,
        ns: ModuleType,
        schedule: int | None = None,
        initial: dict | None = None,
    ):
        # A field's class knows its configuration's, and so does its trainer.
        self.config: Any = config
        self.settings, self.box, self.ns = settings, box, ns
        self.rng = np.random.default_rng(settings.seed)
        self._schedule, self._targets = schedule, targets
        self.learn_from(targets, 0)
        self.initial: Any = self.untrained()
        if initial:
            self.initial.set_parameters(initial)
        self.constant = dict(initial or {}) if settings.frozen else {}
        trained = {k: v for k, v in self.trainable(self.initial.parameters()).items() if k not in self.constant}
        self.optimiser = AdamW(
            settings.learning_rate, trained, beta_2=0.99, epsilon=1e-15, weight_decay=settings.weight_decay
        )
        self.averaged = {k: type(v)(dr.detach(v)) for k, v in self.optimiser.items()}
        self.steps, self.loss = 0, None
        self._started = time.perf_counter()

    @abstractmethod
    def untrained(self) -> GazeDensity:
        """The field with its random weights."""

    @abstractmethod
    def trainable(self, parameters: dict) -> dict:
        """Those of a field's ``parameters`` that are trained."""

    @abstractmethod
    def backward(self) -> None:
        """Draw a batch, and leave the gradients of its loss in the weights."""

    @abstractmethod
    def density(self, batch: Batch, parameters: dict) -> Any:
        """Density (Float, 1/sr) of the field with ``parameters`` in the directions of ``batch``, for a validation."""

    @abstractmethod
    def judge(self, kld: float, cc: float, mae: float, off: float) -> float:
        """What a validation is judged by, from its means over probes; ``off``: squared error of the integral."""

    @property
    def seconds(self) -> float:
        """Wall time of the run, without that between an interruption and its resumption."""
        return time.perf_counter() - self._started

    @property
    def progress(self) -> float:
        """Share of the schedule that is done, 0..1."""
        steps, minutes = self._schedule or self.settings.steps, self.settings.minutes
        if not steps and minutes is not None:
            return min(1.0, self.seconds / (60 * minutes))
        return min(1.0, self.steps / (steps or 1))

    def restore(self, steps: int, seconds: float, random: dict) -> None:
        """Go on from stored numbers; see ``state``."""
        self.steps, self._started = steps, time.perf_counter() - seconds
        self.rng.bit_generator.state = random

    def learn_from(self, targets: Targets, epoch: int) -> None:
        """Take ``targets``, which are those of ``epoch``, in place of the ones before."""
        self.data, self._epoch = TargetArrays(targets, self.ns), epoch

    def current(self) -> dict:
        """All arrays, as they are while training."""
        return {**self.constant, **dict(self.optimiser.items())}

    def step(self) -> None:
        """Draw probes and directions, and move the weights once."""
        if self._targets.renew is not None:
            epoch = self.steps * min(self.settings.probes, self.data.count) // self.data.count
            if epoch != self._epoch:
                self.learn_from(self._targets.renew(epoch), epoch)
        self.backward()
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

    def measure(self, targets: Targets, weights: dict | None = None) -> Scores:
        """Scores of the averaged weights (or of ``weights``) on other targets, all of their directions."""
        rows = []
        with dr.suspend_grad():
            for batch in self.batches(targets):
                density = self.density(batch, {**self.constant, **(weights or self.averaged)})
                parts = gaze_loss(density, batch.truth, targets.truth.shape[1])
                integral = batch.integral(density)
                means = parts.kld, parts.cc, parts.mae, dr.mean(integral), dr.mean(dr.square(1 - integral))
                rows.append((dr.width(batch.extent), *(float(v[0]) for v in means)))
        rows = np.array(rows)
        kld, cc, mae, integral, off = rows[:, 0] @ rows[:, 1:] / rows[:, 0].sum()
        return Scores(self.judge(kld, cc, mae, off), kld, cc, mae, integral)

    def batches(self, targets: Targets) -> Iterator[Batch]:
        """All of ``targets`` in all of their directions, some observers at a time."""
        data = TargetArrays(targets, self.ns)
        block, every = max(1, _CHUNK // data.directions), np.arange(data.directions)[None]
        for a in range(0, data.count, block):
            observers = np.arange(a, min(a + block, data.count))
            yield data.batch(observers, np.broadcast_to(every, (len(observers), data.directions)))

    def weights(self) -> dict:
        """A copy of the averaged weights."""
        return {k: type(v)(v) for k, v in self.averaged.items()}

    def field(self, weights: dict | None = None) -> GazeDensity:
        """The field with the averaged weights (or ``weights``)."""
        out = self.untrained()
        out.set_parameters({**self.constant, **(weights or self.weights())})
        return out
