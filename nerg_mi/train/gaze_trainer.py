"""Gaze training loop: losses, trainer base class, run state and fits."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from drjit.opt import AdamW

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.fields.gaze_base import GazeHead, GazeHeadConfig
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.schema import INDEX, Items, check_json
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import GazeBatch, GazeTargets, Supervision, TargetArrays
from .gaze_settings import MIN_MEAN_DENSITY, GazeSettings, ProbeSettings
from .trainer import Trainer, check_same_run, check_shape, read_count, reading_run_state

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
    prediction: Any,
    truth: Any,
    directions: int,
    solid_angle: Any = None,
    *,
    kld: float = 1.0,
    cc: float = 1.0,
    mae: float = 1.0,
) -> GazeLoss:
    """Compute kld · KLD + cc · (1 - CC) + mae · MAE, averaged over the probes.

    KLD normalises both densities over the directions of the probe and counts negative predictions as zero. MAE does not
    normalise and is the only term that determines the scale.

    Parameters
    ----------
    prediction, truth : Float
        Densities (P * D,) in 1/sr. Gradients only reach the prediction.
    directions : int
        Number D of directions per probe.
    solid_angle : Float, optional
        Solid angles (D,) common to all probes, or (P * D,). Default: equal.
    kld, cc, mae : float
        Weights of the terms. :data:`PAPER` and :data:`CODE` are predefined: ``compute_gaze_loss(..., **CODE)``.

    Raises
    ------
    ValueError
        If the sizes do not match or all weights are zero.
    """
    if not (kld or cc or mae):
        raise ValueError("all weights of the gaze loss are zero; set kld, cc or mae")
    n = _check_lengths(prediction, truth, directions)
    w = _normalise_weights(type(truth), directions, n, solid_angle)
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


def _check_lengths(prediction: Any, truth: Any, directions: int) -> int:
    n = dr.width(truth)
    if dr.width(prediction) != n or directions < 1 or n % directions:
        raise ValueError(
            f"{dr.width(prediction)} predictions, {n} true densities and {directions} directions per probe do not "
            "match: both must be flat arrays with all directions of each probe in turn"
        )
    return n


def _normalise_weights(Float: type, directions: int, n: int, solid_angle: Any) -> Any:
    if solid_angle is None:
        return Float(1.0 / directions)
    w = Float(solid_angle)
    if dr.width(w) not in (directions, n):
        raise ValueError(
            f"got {dr.width(w)} solid angles for {directions} directions; pass one per direction or one per value"
        )
    if dr.width(w) != n:
        w = dr.tile(w, n // directions)
    return w / dr.repeat(dr.block_sum(w, directions), directions)


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


class GazeTrainer(Trainer, ABC):
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
        self.loss: Any = None
        decay = settings.weight_decay
        self.start(AdamW(settings.learning_rate, trained, beta_2=0.99, epsilon=1e-15, weight_decay=decay))

    @classmethod
    def init_from_radiance(cls, radiance: RadianceField, config: Any) -> tuple[Any, dict]:
        """Return ``config`` with the sizes of a radiance field, and the arrays of the field to start from."""
        raise NergError(
            f"a {config.kind} gaze field cannot be initialised from a radiance field; leave out "
            f"{parameter('init', 'field')}"
        )

    @classmethod
    def configure_features(cls, radiance: RadianceField, config: Any) -> Any:
        """Return ``config`` with the number of semantic features of ``radiance``."""
        raise NergError(f"a {config.kind} gaze field has no semantic features; leave out {parameter('semantic')}")

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
    def backward(self) -> None:
        """Draw a batch and accumulate the gradients of its loss in the weights."""

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
        self.backward()
        self.move_weights()
        self.steps += 1
        self.average_weights()
        # Synchronise, because kernels are only queued: otherwise a run with a time limit would count no time and
        # overrun.
        dr.sync_thread()

    def evaluate(self, targets: GazeTargets, weights: dict | None = None) -> Scores:
        """Score the averaged weights (or ``weights``) on other targets, in all of their directions."""
        rows = []
        with dr.suspend_grad():
            for batch in self.iter_batches(targets):
                density = self._mix_prior(batch, {**self.constant, **(weights or self.averaged)})
                parts = compute_gaze_loss(density, batch.truth, targets.truth.shape[1])
                integral = batch.integrate(density)
                means = parts.kld, parts.cc, parts.mae, dr.mean(integral), dr.mean(dr.square(1 - integral))
                rows.append((dr.width(batch.solid_angle), *(float(v[0]) for v in means)))
        rows = np.array(rows)
        kld, cc, mae, integral, off = rows[:, 0] @ rows[:, 1:] / rows[:, 0].sum()
        return Scores(self.validation_objective(kld, cc, mae, off), kld, cc, mae, integral)

    def _mix_prior(self, batch: GazeBatch, parameters: dict) -> Any:
        density, mix = self.evaluate_density(batch, parameters), self.config.mix
        if mix:
            # The prior weight applies on the sphere. For a view it is applied within the view, because the field's
            # integral outside is unknown.
            density = (1 - mix) * density + mix * batch.condition_on_view(
                dr.exp(self.initial_field.log_prior(batch.r_o))
            )
        return density

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


# ---- State of a gaze training in a file: both fits and the validation results ----

KIND = "gaze run"
STAGES = ("fit", "refit")


@dataclass(frozen=True, kw_only=True)
class StateSettings:
    """Where the state of a run is stored, and whether to resume from it."""

    path: Path | None = None  # State file; None: no state is stored
    resume: bool = False  # Resume from the state file; probes and depths are computed again
    interval: float = 60.0  # Seconds between two states. The state is also written if the run is interrupted.
    # Additional data that must match for a run to be resumed (JSON), such as the files of its geometry.
    identity: dict = field(default_factory=dict)


def read_run_identity(state: StateSettings) -> dict | None:
    """Return the identity of the run to resume (`GazePlan.make_identity`), or None for a new run.

    Raises `NergError` if there is no state or the file is damaged.
    """
    if not state.resume:
        return None
    path = _require_state_file(state.path)
    with reading_run_state(path):
        identity = read_checkpoint(path, KIND)[1]["about"]
        if not isinstance(identity, dict):
            raise TypeError("it has no identity of the run")
    return identity


def _require_state_file(path: Path | None) -> Path:
    if path is None or not path.is_file():
        raise NergError(
            f'cannot resume: the state file "{path}" does not exist; leave out {parameter("resume", True)} to '
            "start a new run"
        )
    return path


class GazeRunFile:
    """State of one training in a file.

    Parameters
    ----------
    path : Path or None
        State file; None: no state is stored.
    identity : dict
        Data that must match for a run to be resumed (JSON).
    interval : float
        Seconds between two states.
    resume : bool
        Read the state at once. Raises `NergError` if there is none, or if it belongs to another run.

    Attributes
    ----------
    stage : str or None
        Stage of the state, ``fit`` or ``refit``.
    seconds : float
        Time spent before this process.
    """

    def __init__(self, path: Path | None, identity: dict, interval: float = 60.0, resume: bool = False):
        self.path, self.identity, self.interval = path, identity, interval
        self.stage, self.validation_state, self.seconds, self._tensors = None, {}, 0.0, {}
        self._started = self._last_saved = time.perf_counter()
        if resume:
            path = _require_state_file(path)
            self._tensors, self._meta = read_checkpoint(path, KIND)
            with reading_run_state(path):
                check_same_run(path, self._meta["about"], identity)
                self.stage, self.validation_state = self._meta["stage"], self._meta["found"]
                self.seconds = read_count(self._meta, "spent")
                if self.stage not in STAGES:
                    raise ValueError(f'its "stage" is {sanitize(self.stage, 40)}; expected one of {", ".join(STAGES)}')
                GazeFit.from_dict(self.validation_state)

    @property
    def elapsed(self) -> float:
        """Wall time of the run in seconds, excluding the time between an interruption and its resumption."""
        return self.seconds + time.perf_counter() - self._started

    def restore(self, stage: str, trainer: GazeTrainer) -> dict:
        """Restore ``trainer`` if the state is one of ``stage``; returns the best weights that `save` was given."""
        if self.path is None or stage != self.stage or "random" not in self._meta:
            return {}
        with reading_run_state(self.path):
            trainer.restore(self._tensors, self._meta)
            best = {k: v for k, v in trainer.averaged.items() if f"best.{k}" in self._tensors}
            for k, v in best.items():
                check_shape(self._tensors, f"best.{k}", v)
            return {k: type(v)(self._tensors[f"best.{k}"]) for k, v in best.items()}

    def save(
        self, stage: str, trainer: GazeTrainer | None, validation_state: dict, weights: dict, force: bool = False
    ) -> None:
        """Write the state atomically if the interval has passed (or with ``force``).

        Parameters
        ----------
        stage : str
            Stage of the run.
        trainer : GazeTrainer or None
            Current trainer; None between two fits.
        validation_state : dict
            Validation results so far (JSON).
        weights : dict
            Best weights so far.
        force : bool
            Write even if the interval has not passed.
        """
        if self.path is None or not (force or time.perf_counter() - self._last_saved > self.interval):
            return
        tensors, meta = {f"best.{k}": v.numpy() for k, v in weights.items()}, {}
        if trainer is not None:
            state, meta = trainer.get_state()
            tensors |= state
        write_checkpoint(
            self.path,
            KIND,
            tensors,
            {"about": self.identity, "stage": stage, "found": validation_state, "spent": self.elapsed, **meta},
        )
        self._last_saved = time.perf_counter()


# ---- Training plan: architecture, settings and trainer ----


@dataclass(frozen=True, kw_only=True)
class GazePlan:
    """Architecture, settings and trainer of a training, without its data and geometry."""

    config: GazeHeadConfig  # Architecture of the field
    # Alternative architectures that folds may select (`gaze_run.select_variant`).
    alternatives: tuple[GazeHeadConfig, ...] = ()
    settings: GazeSettings  # Optimisation settings
    probes: ProbeSettings  # How rays become probes
    trainer: type[GazeTrainer]  # Trainer class of this kind of field
    # Initial arrays by name (`GazeTrainer.init_from_radiance`); None: random initialisation.
    initial_arrays: dict[str, Any] | None = None

    def with_settings(self, **changes: Any) -> GazePlan:
        """Return the plan with changed ``settings``."""
        return replace(self, settings=replace(self.settings, **changes))

    def make_identity(self, supervision: Supervision, geometry: Environment, state: StateSettings) -> dict:
        """Return the data that must match for a run to be resumed (JSON)."""
        return {
            **state.identity,
            **supervision.compute_digest(),
            "settings": self.settings.to_dict(),
            "probes": self.probes.to_dict(),
            "architecture": self.config.to_dict(),
            "box": geometry.box.to_dict(),
            "align": alignment_to_json(geometry),
        }


def alignment_to_json(geometry: Environment) -> list[list[float]] | None:
    """Return the similarity from the frame of the rays to that of the geometry as JSON; None if both are the same."""
    return None if geometry.align.is_identity else geometry.align.matrix.tolist()


# ---- Fit ----
#
# The two fits of a training: one with validation, and a refit on all data for the best number of steps.


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


_FIT_STATE = {
    **dict.fromkeys(("best_step?", "schedule?", "since?", "next_look?"), INDEX),
    "history?": Items({"steps": INDEX}),
}


@dataclass
class GazeFit:
    """Result of a fit."""

    trainer: Any = None  # The `GazeTrainer`; None if restored from the state of an earlier process
    weights: dict = field(default_factory=dict)  # Best weights
    best_step: int = 0  # Step of the best weights
    schedule: int = 0  # Number of steps that the schedule spans
    scores: Scores | None = None  # Scores of the best weights
    history: list[dict] = field(default_factory=list)  # All validations (JSON)
    interrupted: bool = False  # Whether Ctrl-C ended the fit
    evaluations_since_best: int = 0  # Validations since the best
    next_evaluation: int = 0  # Index of the next validation

    def to_dict(self) -> dict:
        """Return the validation results for the run state (JSON)."""
        scores = None if self.scores is None else [float(v) for v in self.scores]
        return {
            **{k: getattr(self, k) for k in ("best_step", "schedule", "history")},
            "since": self.evaluations_since_best,
            "next_look": self.next_evaluation,
            "scores": scores,
        }

    @staticmethod
    def from_dict(data: dict[str, Any], trainer: GazeTrainer | None = None, weights: dict | None = None) -> GazeFit:
        """Restore a fit from `to_dict`. Raises ``ValueError`` or ``TypeError`` for other ``data``."""
        check_json(data, _FIT_STATE, "found")
        names = {"since": "evaluations_since_best", "next_look": "next_evaluation"}
        values = {names.get(k, k): v for k, v in data.items()}
        scores = values.pop("scores", None)
        return GazeFit(trainer, weights or {}, scores=None if scores is None else Scores(*scores), **values)


def fit_with_validation(
    targets: GazeTargets,
    validation: GazeTargets | None,
    box: AnyBox,
    plan: GazePlan,
    ns: ModuleType,
    minutes_fraction: float,
    file: GazeRunFile,
    on_progress: ProgressCallback,
) -> GazeFit:
    """Train until the schedule ends, or until ``patience`` validations bring no improvement.

    ``minutes_fraction`` is the fraction of the time limit for this fit.
    """
    settings = plan.settings
    if settings.minutes is not None:
        settings = replace(settings, minutes=settings.minutes * minutes_fraction)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, initial=plan.initial_arrays)
    out = GazeFit.from_dict(file.validation_state, trainer, file.restore("fit", trainer))
    out.schedule = settings.steps or 0
    evaluation_times, last_scores = np.arange(1, settings.num_validations + 1) / settings.num_validations, out.scores
    with Interruption() as stop:
        while (
            trainer.progress < 1
            and not out.interrupted
            and not (settings.patience and out.evaluations_since_best >= settings.patience)
        ):
            trainer.step()
            if validation is not None and trainer.progress >= evaluation_times[out.next_evaluation]:
                out.next_evaluation = min(
                    int(np.searchsorted(evaluation_times, trainer.progress, "right")), len(evaluation_times) - 1
                )
                last_scores = trainer.evaluate(validation)
                out.history.append({"steps": trainer.steps, **round_scores(last_scores)})
                out.evaluations_since_best += 1
                if out.scores is None or np.isnan(out.scores.loss) or last_scores.loss < out.scores.loss:
                    out.weights, out.best_step, out.scores, out.evaluations_since_best = (
                        trainer.copy_weights(),
                        trainer.steps,
                        last_scores,
                        0,
                    )
            file.save("fit", trainer, out.to_dict(), out.weights)
            out.interrupted = _is_interrupted(
                stop, on_progress, GazeProgress("fit", trainer.progress, trainer.steps, trainer.seconds, last_scores)
            )
    if out.interrupted:
        file.save("fit", trainer, out.to_dict(), out.weights, force=True)
    if validation is not None and out.scores is None and trainer.steps:
        out.scores, out.best_step, out.weights = trainer.evaluate(validation), trainer.steps, trainer.copy_weights()
    if not out.weights:
        out.weights, out.best_step = trainer.copy_weights(), trainer.steps
    if settings.minutes is not None:
        # Convert the time-based schedule to steps, so that a refit can follow the same schedule.
        out.schedule = max(trainer.steps, round(trainer.steps / max(trainer.progress, 1e-6)))
    return out


def refit(
    targets: GazeTargets,
    first: GazeFit,
    box: AnyBox,
    plan: GazePlan,
    ns: ModuleType,
    file: GazeRunFile,
    on_progress: ProgressCallback,
) -> GazeFit:
    """Train for the best number of steps of the ``first`` fit, with the same schedule."""
    settings = replace(plan.settings, steps=first.best_step, minutes=None)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, first.schedule, plan.initial_arrays)
    file.restore("refit", trainer)
    interrupted = False
    with Interruption() as stop:
        while trainer.steps < first.best_step and not interrupted:
            trainer.step()
            file.save("refit", trainer, first.to_dict(), {})
            fraction = trainer.steps / first.best_step
            interrupted = _is_interrupted(
                stop, on_progress, GazeProgress("refit", fraction, trainer.steps, trainer.seconds, first.scores)
            )
    if interrupted:
        file.save("refit", trainer, first.to_dict(), {}, force=True)
    return GazeFit(trainer, trainer.copy_weights(), trainer.steps, first.schedule, first.scores, [], interrupted)


def _is_interrupted(stop: Interruption, tell: ProgressCallback, progress: GazeProgress) -> bool:
    """Report ``progress`` and return whether Ctrl-C was pressed.

    Ctrl-C is only handled here, because within a step weights and random numbers are inconsistent.
    """
    try:
        tell(progress)
        stop.check()
    except KeyboardInterrupt:
        return True
    return False


def round_scores(scores: Scores) -> dict[str, float]:
    """Return ``scores`` by name, rounded to five digits (JSON)."""
    return {k: round(float(v), 5) for k, v in scores._asdict().items()}
