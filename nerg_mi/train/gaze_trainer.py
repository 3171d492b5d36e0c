"""Gaze training step: losses, the base class of trainers, and progress of a run."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from drjit.opt import AdamW

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeHead
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import GazeBatch, GazeTargets, TargetArrays
from .gaze_settings import MIN_MEAN_DENSITY, GazeSettings
from .trainer import Trainer, learning_rate_at

# ---- Losses between predicted and true gaze densities of probes, in Dr.Jit ----
#
# Densities are flat arrays, probe after probe with D directions each (P * D values, 1/sr): value p * D + d is probe p
# in direction d. Sums over a probe are weighted by solid angle. The definitions match
# :mod:`nerg_mi.evaluation.metrics`; see NeRG, Section 4.3. The text there adds the correlation itself; the loss
# minimises 1 - CC.

KLD_EPS = 1e-6  # Floor of the densities inside the logarithm, relative to the uniform density
MIN_RELATIVE_SPREAD = 1e-5  # A probe with a smaller spread relative to its mean is constant and has no correlation


class GazeLoss(NamedTuple):
    """Loss of a batch: ``total``, differentiable, and its unweighted terms.

    ``kld`` is in nats, ``cc`` is the correlation itself, and ``mae`` is in 1/sr. Each is an array of one value, the
    mean over the probes. A term with weight zero is None and is not traced.
    """

    total: Any
    kld: Any
    cc: Any
    mae: Any


def compute_gaze_loss(
    prediction: Any, truth: Any, directions: int, *, kld: float = 1.0, cc: float = 1.0, mae: float = 1.0
) -> GazeLoss:
    """Compute kld · KLD + cc · (1 - CC) + mae · MAE, averaged over the probes.

    KLD normalises both densities over the directions of the probe and counts negative predictions as zero. MAE does not
    normalise and is the only term that determines the scale.

    Parameters
    ----------
    prediction, truth : Float
        Densities (P * D,) in 1/sr. Gradients only reach the prediction.
    directions : int
        Number D of directions per probe, of equal solid angle.
    kld, cc, mae : float
        Weights of the terms. `gaze_settings.LOSSES` has those of each loss, such as ``**LOSSES["paper"]``.

    Raises
    ------
    ValueError
        If the sizes do not match or all weights are zero.
    """
    if not (kld or cc or mae):
        raise ValueError("all weights of the gaze loss are zero; set kld, cc or mae")
    n = dr.width(truth)
    if dr.width(prediction) != n or directions < 1 or n % directions:
        raise ValueError(
            f"{dr.width(prediction)} predictions, {n} true densities and {directions} directions per probe do not "
            "match: both must be flat arrays with all directions of each probe in turn"
        )
    w = type(truth)(1.0 / directions)
    truth = dr.detach(truth)

    parts: dict[str, Any] = {"kld": None, "cc": None, "mae": None}
    total = type(truth)(0)
    if kld:
        parts["kld"] = dr.mean(compute_probe_kld(prediction, truth, directions, w))
        total += kld * parts["kld"]
    if cc:
        parts["cc"] = dr.mean(compute_probe_cc(prediction, truth, directions, w))
        total += cc * (1 - parts["cc"])
    if mae:
        parts["mae"] = dr.mean(dr.block_sum(w * dr.abs(prediction - truth), directions))
        total += mae * parts["mae"]
    return GazeLoss(total, **parts)


def compute_probe_kld(prediction: Any, truth: Any, directions: int, w: Any) -> Any:
    """Return KL(truth || prediction) of each probe, (P,) in nats.

    ``w`` (P * D,) are the solid angles, normalised to one in each probe.
    """
    p = _normalise_density(truth, directions, w) + KLD_EPS
    q = _normalise_density(dr.maximum(prediction, 0), directions, w) + KLD_EPS
    return dr.block_sum(w * p * (dr.log(p) - dr.log(q)), directions) / (1 + KLD_EPS)


def compute_probe_cc(prediction: Any, truth: Any, directions: int, w: Any) -> Any:
    """Return Pearson's correlation of each probe, (P,); 0 with zero gradient if either density is constant."""
    x, spread_x = _center(prediction, directions, w)
    y, spread_y = _center(truth, directions, w)
    is_varying = (spread_x > 0) & (spread_y > 0)
    # Replace the argument before taking the root: a masked infinite derivative times zero would be NaN.
    scale = dr.rsqrt(dr.select(is_varying, spread_x, 1)) * dr.rsqrt(dr.select(is_varying, spread_y, 1))
    return dr.select(is_varying, dr.block_sum(w * x * y, directions) * scale, 0)


def _normalise_density(density: Any, directions: int, w: Any) -> Any:
    """Return the density relative to the uniform density with the same integral."""
    mean = dr.block_sum(w * density, directions)
    is_nonzero = mean > MIN_MEAN_DENSITY
    inverse = dr.select(is_nonzero, dr.rcp(dr.select(is_nonzero, mean, 1)), 0)
    # A density of zeros counts as uniform, without a gradient.
    return density * dr.repeat(inverse, directions) + dr.repeat(dr.select(is_nonzero, type(density)(0), 1), directions)


def _center(values: Any, directions: int, w: Any) -> tuple[Any, Any]:
    """Return the values minus their mean and their variance per probe.

    The variance is exactly zero, without gradient, if it is within rounding error.
    """
    mean = dr.block_sum(w * values, directions)
    centred = values - dr.repeat(mean, directions)
    variance = dr.block_sum(w * centred * centred, directions)
    return centred, dr.select(variance > dr.square(MIN_RELATIVE_SPREAD * dr.detach(mean)), variance, 0)


# ---- Trainer of a gaze field (NeRG, Section 4.3): base class of all kinds ----

_CHUNK = 1 << 16  # Samples per launch during validation


class Scores(NamedTuple):
    """Means over probes: ``loss`` as trained, ``kld`` (nats), ``cc``, ``mae`` (1/sr), and ``integral`` over the
    sphere."""

    loss: float
    kld: float
    cc: float
    mae: float
    integral: float


class GazeTrainer(Trainer):
    """Base class of gaze trainers; each kind of field has a subclass.

    Parameters
    ----------
    targets : GazeTargets
        Training targets.
    box : AnyBox
        Bounds of the field, in the frame of the targets.
    config : GazeHeadConfig
        Configuration of the field.
    settings : GazeSettings
        Optimisation settings.
    ns : module
        Dr.Jit backend.
    schedule : int, optional
        Number of steps that the learning-rate schedule spans, if it differs from the length of the run.
    initial : dict, optional
        Initial arrays by name. With ``settings.freeze`` they are not trained.

    Notes
    -----
    Equal seeds draw equal batches. Sums over threads are not ordered, so weights of equal runs agree to rounding error,
    and exactly only with one thread.
    """

    def __init__(
        self,
        targets: GazeTargets,
        box: AnyBox,
        config: Any,
        settings: GazeSettings,
        ns: ModuleType,
        schedule: int | None = None,
        initial: dict | None = None,
    ):
        super().__init__(settings, ns, schedule)
        self.box, self._targets = box, targets
        # The type of the configuration depends on the subclass.
        self.config: Any = self.complete_config(config, targets)
        self.set_targets(targets, 0)
        self.initial_field: Any = self.init_field()
        if initial:
            self.initial_field.set_parameters(initial)
        parameters, frozen = self.initial_field.parameters(), (initial or {}) if settings.freeze else {}
        trained = {k: v for k, v in self.select_trainable(parameters).items() if k not in frozen}
        self.constant = {k: v for k, v in parameters.items() if k not in trained}
        decay = settings.weight_decay
        self.start(AdamW(settings.learning_rate, trained, beta_2=0.99, epsilon=1e-15, weight_decay=decay))

    @classmethod
    def init_from_radiance(cls, radiance: RadianceNetwork, config: Any) -> tuple[Any, dict]:
        """Return ``config`` with the sizes of a radiance field, and the arrays of the field to start from."""
        raise NergError(
            f"a {config.kind} gaze field cannot be initialised from a radiance field; leave out the option "
            "init_from_field of the recipe"
        )

    @classmethod
    def configure_features(cls, radiance: RadianceNetwork, config: Any) -> Any:
        """Return ``config`` with the number of semantic features of ``radiance``."""
        raise NergError(
            f"a {config.kind} gaze field has no semantic features; leave out the option semantic of the recipe"
        )

    def complete_config(self, config: Any, targets: GazeTargets) -> Any:
        """Return ``config`` with the values that depend on the ``targets``."""
        return config

    @abstractmethod
    def init_field(self) -> GazeHead:
        """Return the field with random weights."""

    def select_trainable(self, parameters: dict) -> dict:
        """Select the trainable ``parameters`` of a field: all that are not fixed."""
        return {k: v for k, v in parameters.items() if k not in self.initial_field.fixed}

    @abstractmethod
    def draw_batch(self) -> GazeBatch:
        """Draw the observers and directions of a step."""

    @abstractmethod
    def compute_loss(self, batch: GazeBatch) -> Any:
        """Compute the loss (Float, one lane) of ``batch`` with the current weights."""

    @abstractmethod
    def evaluate_density(self, batch: GazeBatch, parameters: dict) -> Any:
        """Evaluate the density (Float, 1/sr) in the directions of ``batch`` for validation, without the mixed-in
        prior."""

    @abstractmethod
    def validation_objective(self, kld: float, cc: float, mae: float, off: float) -> float:
        """Return the objective of a validation (lower is better) from means over probes; ``off`` is the squared error
        of the integral.
        """

    def set_targets(self, targets: GazeTargets, epoch: int) -> None:
        """Replace the targets by those of ``epoch``."""
        self.data, self._epoch = TargetArrays(targets, self.ns), epoch

    def current_parameters(self) -> dict:
        """Return all parameter arrays with the current weights."""
        return {**self.constant, **dict(self.optimiser.items())}

    def step(self) -> None:
        """Run one optimisation step on a random batch."""
        if self._targets.resample is not None:
            epoch = self.steps * min(self.settings.probes, self.data.num_observers) // self.data.num_observers
            if epoch != self._epoch:
                self.set_targets(self._targets.resample(epoch), epoch)
        dr.backward(self.compute_loss(self.draw_batch()))
        self.optimiser.set_learning_rate(learning_rate_at(self.settings, self.progress))
        self.optimiser.step()
        self.steps += 1
        self.average_weights()
        # Synchronise, because kernels are only queued: otherwise a run with a time limit would count no time and
        # overrun.
        dr.sync_thread()

    def evaluate(self, targets: GazeTargets) -> Scores:
        """Score the averaged weights on other targets, in all of their directions."""
        rows = []
        with dr.suspend_grad():
            for batch in self.iter_batches(targets):
                density = self.evaluate_density(batch, {**self.constant, **self.averaged})
                if mix := self.config.mix:
                    # The prior weight applies on the sphere. For a view it is applied within the view, because the
                    # field's integral outside is unknown.
                    prior = batch.condition_on_view(dr.exp(self.initial_field.log_prior(batch.r_o)))
                    density = (1 - mix) * density + mix * prior
                parts = compute_gaze_loss(density, batch.truth, targets.truth.shape[1])
                integral = batch.integrate(density)
                means = parts.kld, parts.cc, parts.mae, dr.mean(integral), dr.mean(dr.square(1 - integral))
                rows.append((dr.width(batch.solid_angle), *(float(v[0]) for v in means)))
        rows = np.array(rows)
        kld, cc, mae, integral, off = rows[:, 0] @ rows[:, 1:] / rows[:, 0].sum()
        return Scores(self.validation_objective(kld, cc, mae, off), kld, cc, mae, integral)

    def evaluate_densities(self, targets: GazeTargets) -> np.ndarray:
        """Evaluate the field, without the mixed-in prior, in the directions of ``targets`` (P, D)."""
        parts = []
        with dr.suspend_grad():
            for batch in self.iter_batches(targets):
                density = self.evaluate_density(batch, {**self.constant, **self.averaged})
                parts.append(np.asarray(density).reshape(-1, targets.truth.shape[1]))
        return np.concatenate(parts)

    def iter_batches(self, targets: GazeTargets) -> Iterator[GazeBatch]:
        """Yield all of ``targets`` in all of their directions, some observers at a time."""
        data = TargetArrays(targets, self.ns)
        block, all_directions = max(1, _CHUNK // data.num_directions), np.arange(data.num_directions)[None]
        for a in range(0, data.num_observers, block):
            observers = np.arange(a, min(a + block, data.num_observers))
            yield data.gather_batch(observers, np.broadcast_to(all_directions, (len(observers), data.num_directions)))

    def copy_weights(self) -> dict:
        """Return a copy of the averaged weights."""
        return {k: type(v)(v) for k, v in self.averaged.items()}

    def make_field(self, weights: dict | None = None) -> GazeHead:
        """Return the field with the averaged weights (or ``weights``)."""
        out = self.init_field()
        out.set_parameters({**self.constant, **(weights or self.copy_weights())})
        return out


# ---- Progress of a run, which trains several fields ----


@dataclass(frozen=True)
class GazeProgress:
    """Progress of a run."""

    stage: str  # "probes", "fit" or "refit"; for an ensemble, prefixed by the member
    fraction: float  # Completed fraction of the stage; for an ensemble, of all members
    steps: int  # Steps taken
    seconds: float  # Wall time of the fit
    scores: Scores | None  # Scores of the last validation; None before the first


# Called with the progress of a run; may raise `KeyboardInterrupt` to end it
ProgressCallback = Callable[[GazeProgress], object]


class StagedProgress:
    """Reports the stages of a run as fractions of the whole, which never fall.

    A stage covers a part of the fraction that is left, in proportion to its cost and to those of the later stages. So a
    stage that ends early leaves more to the others.
    """

    def __init__(self, on_progress: ProgressCallback):
        self._on_progress, self._fraction = on_progress, 0.0

    def start(self, cost: float, *later: float) -> ProgressCallback:
        """Return the callback of a stage of this ``cost`` that is followed by stages of the costs ``later``."""
        begin = self._fraction
        length = (1 - begin) * cost / max(cost + sum(later), 1e-9)

        def report(progress: GazeProgress) -> None:
            self._fraction = max(self._fraction, begin + length * progress.fraction)
            self._on_progress(replace(progress, fraction=self._fraction))

        return report


def scale_progress(on_progress: ProgressCallback, k: int, count: int, stage: str) -> ProgressCallback:
    """Return a callback that reports part ``k`` of ``count`` as progress of the whole; ``stage`` formats the stage
    names.
    """

    def report(progress: GazeProgress) -> None:
        on_progress(replace(progress, stage=stage.format(progress.stage), fraction=(k + progress.fraction) / count))

    return report
