"""The loop that trains a gaze field: its plan, its state and the fit."""

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

from nerg_mi.errors import NergError, sanitize
from nerg_mi.fields.gaze_base import GazeHead, GazeHeadConfig
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import GazeBatch, GazeTargets, Supervision, TargetArrays
from .gaze_settings import MIN_MEAN_DENSITY, GazeSettings, ProbeSettings
from .geometry import TrainingGeometry
from .trainer import Trainer, read_count, check_same_run, check_shape, reading_run_state

# ---- Losses between predicted and true gaze densities of probes, in Dr.Jit ----
#
# Densities are flat arrays, probe after probe with the same D directions each (P * D values, 1/sr): value p * D + d is
# probe p in direction d. Sums over a probe are weighted by solid angle. Definitions as in
# :mod:`nerg_mi.evaluation.metrics`; NeRG, Section 4.3 (whose text adds the correlation itself; it is 1 - CC that is
# minimised).

KLD_EPS = 1e-6  # Of the uniform density: what a density of zero counts as inside a logarithm
MIN_RELATIVE_SPREAD = 1e-5  # A probe whose spread is below this fraction of its mean is constant: no correlation


class GazeLoss(NamedTuple):
    """``total``, differentiable, and its unweighted parts ``kld`` (nats), ``cc`` (the correlation itself) and ``mae``
    (1/sr): arrays of one value, the mean over the probes. A part of weight zero is ``None``: it is not traced."""

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
    """kld · KLD + cc · (1 - CC) + mae · MAE, averaged over the probes.

    ``prediction``, ``truth``: (P * D,) Dr.Jit floats of one type, in 1/sr; gradients flow to the prediction only.
    ``directions``: D. ``solid_angle``: (D,) for every probe alike, or (P * D,), or ``None`` for equal areas.
    :data:`PAPER` and :data:`CODE` are ready weights: ``gaze_loss(..., **CODE)``.

    KLD normalises both densities over the probe's directions, and counts a negative prediction as zero. MAE does not
    normalise, so that it alone holds the scale. ``ValueError`` for lengths that do not fit, and when every weight is
    zero.
    """
    if not (kld or cc or mae):
        raise ValueError("every weight of the gaze loss is zero; give kld, cc or mae a weight")
    n = _lengths(prediction, truth, directions)
    w = _shares(type(truth), directions, n, solid_angle)
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
    """KL(truth || prediction) of each probe, (P,) nats; ``w`` (P * D,) shares
    of solid angle that sum to one in each probe."""
    p = _relative(truth, directions, w) + KLD_EPS
    q = _relative(dr.maximum(prediction, 0), directions, w) + KLD_EPS
    return dr.block_sum(w * p * (dr.log(p) - dr.log(q)), directions) / (1 + KLD_EPS)


def compute_probe_cc(prediction: Any, truth: Any, directions: int, w: Any) -> Any:
    """Pearson's correlation of each probe, (P,); 0 with zero gradient where either density is constant."""
    x, spread_x = _centred(prediction, directions, w)
    y, spread_y = _centred(truth, directions, w)
    live = (spread_x > 0) & (spread_y > 0)
    # The root's argument is replaced before the root: a masked infinite derivative times zero would still be NaN.
    scale = dr.rsqrt(dr.select(live, spread_x, 1)) * dr.rsqrt(dr.select(live, spread_y, 1))
    return dr.select(live, dr.block_sum(w * x * y, directions) * scale, 0)


def _relative(density: Any, directions: int, w: Any) -> Any:
    """Density in units of the uniform one of equal integral."""
    mean = dr.block_sum(w * density, directions)
    live = mean > MIN_MEAN_DENSITY
    inverse = dr.select(live, dr.rcp(dr.select(live, mean, 1)), 0)
    # A map of zeros has no shape: it counts as uniform, without a gradient.
    return density * dr.repeat(inverse, directions) + dr.repeat(dr.select(live, type(density)(0), 1), directions)


def _centred(values: Any, directions: int, w: Any) -> tuple[Any, Any]:
    """Values minus their mean, and their variance per probe, which is exactly
    zero (and without gradient) where rounding is all there is."""
    mean = dr.block_sum(w * values, directions)
    centred = values - dr.repeat(mean, directions)
    variance = dr.block_sum(w * centred * centred, directions)
    return centred, dr.select(variance > dr.square(MIN_RELATIVE_SPREAD * dr.detach(mean)), variance, 0)


def _lengths(prediction: Any, truth: Any, directions: int) -> int:
    n = dr.width(truth)
    if dr.width(prediction) != n or directions < 1 or n % directions:
        raise ValueError(
            f"{dr.width(prediction)} predictions, {n} true densities and {directions} directions do not fit: "
            "both are flat, probe after probe, with the same directions each"
        )
    return n


def _shares(Float: type, directions: int, n: int, solid_angle: Any) -> Any:
    if solid_angle is None:
        return Float(1.0 / directions)
    w = Float(solid_angle)
    if dr.width(w) not in (directions, n):
        raise ValueError(f"{dr.width(w)} solid angles for {directions} directions; give one a direction or one a value")
    if dr.width(w) != n:
        w = dr.tile(w, n // directions)
    return w / dr.repeat(dr.block_sum(w, directions), directions)


# ---- Training a gaze field on targets (NeRG, Section 4.3): what every kind of field's training has in common ----

_CHUNK = 1 << 16  # Samples of one launch of a validation


class Scores(NamedTuple):
    """Means over probes: ``loss`` as trained, ``kld`` (nats), ``cc``, ``mae`` (1/sr), ``integral`` over the sphere."""

    loss: float
    kld: float
    cc: float
    mae: float
    integral: float


class GazeTrainer(Trainer, ABC):
    """One run: state, ``step()``, ``measure()``, and ``field()`` for what it has come to.

    ``targets``: what to learn from; ``box``: where the field lives, in the same frame; ``config``: of the field;
    ``initial``: arrays to begin with in place of random ones, which with ``settings.frozen`` stay as they are. Equal
    seeds draw equal batches; sums over threads are not ordered, so that weights agree between runs to rounding (and bit
    for bit only with one thread).

    A kind of field has a class of its own, which says what its weights are and what moves them.
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
        # A field's class knows its configuration's, and so does its trainer.
        self.config: Any = self.complete_config(config, targets)
        self.set_targets(targets, 0)
        self.initial_field: Any = self.init_field()
        if initial:
            self.initial_field.set_parameters(initial)
        parameters, frozen = self.initial_field.parameters(), (initial or {}) if settings.frozen else {}
        trained = {k: v for k, v in self.select_trainable(parameters).items() if k not in frozen}
        self.constant = {k: v for k, v in parameters.items() if k not in trained}
        self.loss: Any = None
        decay = settings.weight_decay
        self.start(AdamW(settings.learning_rate, trained, beta_2=0.99, epsilon=1e-15, weight_decay=decay))

    @classmethod
    def init_from_radiance(cls, radiance: RadianceField, config: Any) -> tuple[Any, dict]:
        """``config`` with the sizes of the field ``radiance``, and the arrays of it that a training begins with."""
        raise NergError(f"a {config.kind} gaze field does not begin as a radiance field; leave out --begin field")

    @classmethod
    def configure_features(cls, radiance: RadianceField, config: Any) -> Any:
        """``config``, which has semantic features, with as many as ``radiance`` gives."""
        raise NergError(f"a {config.kind} gaze field has no semantic features; leave out --semantic")

    def complete_config(self, config: Any, targets: GazeTargets) -> Any:
        """``config`` with what only the ``targets`` tell."""
        return config

    @abstractmethod
    def init_field(self) -> GazeHead:
        """The field with its random weights."""

    def select_trainable(self, parameters: dict) -> dict:
        """Those of a field's ``parameters`` that are trained: all that are not fixed."""
        return {k: v for k, v in parameters.items() if k not in self.initial_field.fixed}

    @abstractmethod
    def backward(self) -> None:
        """Draw a batch, and leave the gradients of its loss in the weights."""

    @abstractmethod
    def evaluate_density(self, batch: GazeBatch, parameters: dict) -> Any:
        """Density (Float, 1/sr) of the field with ``parameters`` in the directions of ``batch``, for a validation, as
        it is without its share of the density that does not depend on the position."""

    @abstractmethod
    def validation_objective(self, kld: float, cc: float, mae: float, off: float) -> float:
        """What a validation is judged by, from its means over probes; ``off``: squared error of the integral."""

    def set_targets(self, targets: GazeTargets, epoch: int) -> None:
        """Take ``targets``, which are those of ``epoch``, in place of the ones before."""
        self.data, self._epoch = TargetArrays(targets, self.ns), epoch

    def current_parameters(self) -> dict:
        """All arrays, as they are while training."""
        return {**self.constant, **dict(self.optimiser.items())}

    def step(self) -> None:
        """Draw probes and directions, and move the weights once."""
        if self._targets.resample is not None:
            epoch = self.steps * min(self.settings.probes, self.data.num_observers) // self.data.num_observers
            if epoch != self._epoch:
                self.set_targets(self._targets.resample(epoch), epoch)
        self.backward()
        self.move_weights()
        self.steps += 1
        self.average_weights()
        # Steps are only queued otherwise: their time would count as none, and a run of minutes would go on long after
        # them.
        dr.sync_thread()

    def evaluate(self, targets: GazeTargets, weights: dict | None = None) -> Scores:
        """Scores of the averaged weights (or of ``weights``) on other targets, all of their directions."""
        rows = []
        with dr.suspend_grad():
            for batch in self.iter_batches(targets):
                density = self._mixed(batch, {**self.constant, **(weights or self.averaged)})
                parts = compute_gaze_loss(density, batch.truth, targets.truth.shape[1])
                integral = batch.integrate(density)
                means = parts.kld, parts.cc, parts.mae, dr.mean(integral), dr.mean(dr.square(1 - integral))
                rows.append((dr.width(batch.solid_angle), *(float(v[0]) for v in means)))
        rows = np.array(rows)
        kld, cc, mae, integral, off = rows[:, 0] @ rows[:, 1:] / rows[:, 0].sum()
        return Scores(self.validation_objective(kld, cc, mae, off), kld, cc, mae, integral)

    def _mixed(self, batch: GazeBatch, parameters: dict) -> Any:
        density, mix = self.evaluate_density(batch, parameters), self.config.mix
        if mix:
            # Of a view the share counts as on the sphere: the field's integral there is not known from within.
            density = (1 - mix) * density + mix * batch.condition_on_view(dr.exp(self.initial_field.log_prior(batch.r_o)))
        return density

    def evaluate_densities(self, targets: GazeTargets) -> tuple[np.ndarray, np.ndarray]:
        """Densities (P, D) of the averaged weights in the directions of ``targets``, as the field is without its share
        of the blind density; and the blind density there."""
        parts, D = [], targets.truth.shape[1]
        with dr.suspend_grad():
            for batch in self.iter_batches(targets):
                density = self.evaluate_density(batch, {**self.constant, **self.averaged})
                blind = dr.exp(self.initial_field.log_prior(batch.r_o))
                parts.append([np.asarray(v).reshape(-1, D) for v in (density, blind)])
        field, blind = (np.concatenate(v) for v in zip(*parts))
        return field, blind

    def iter_batches(self, targets: GazeTargets) -> Iterator[GazeBatch]:
        """All of ``targets`` in all of their directions, some observers at a time."""
        data = TargetArrays(targets, self.ns)
        block, every = max(1, _CHUNK // data.num_directions), np.arange(data.num_directions)[None]
        for a in range(0, data.num_observers, block):
            observers = np.arange(a, min(a + block, data.num_observers))
            yield data.gather_batch(observers, np.broadcast_to(every, (len(observers), data.num_directions)))

    def copy_weights(self) -> dict:
        """A copy of the averaged weights."""
        return {k: type(v)(v) for k, v in self.averaged.items()}

    def make_field(self, weights: dict | None = None) -> GazeHead:
        """The field with the averaged weights (or ``weights``)."""
        out = self.init_field()
        out.set_parameters({**self.constant, **(weights or self.copy_weights())})
        return out


# ---- The whole state of a gaze training in a file: of both of its fits, and of what validation has found so far ----

KIND = "gaze run"
STAGES = ("fit", "refit")


@dataclass(frozen=True, kw_only=True)
class StateSettings:
    """Whether a run can be gone on with, and from where."""

    path: Path | None = None  # File that holds the whole state of the run; None: none is kept
    resume: bool = False  # Go on from the state in that file; probes and depths are made again
    interval: float = 60.0  # Seconds between two states; it is also written when the run is interrupted
    # What else a run must agree on to be gone on with (JSON), such as the files of its place.
    identity: dict = field(default_factory=dict)


def read_run_identity(state: StateSettings) -> dict | None:
    """What the run that ``state`` goes on with has been started as (`GazePlan.identity`); None where it starts anew.
    Raises `NergError` where nothing was kept, and for a damaged file."""
    if not state.resume:
        return None
    path = _kept_file(state.path)
    with reading_run_state(path):
        about = read_checkpoint(path, KIND)[1]["about"]
        if not isinstance(about, dict):
            raise TypeError("it does not say what it was started as")
    return about


def _kept_file(path: Path | None) -> Path:
    if path is None or not path.is_file():
        raise NergError(f'there is nothing to resume: "{path}" does not exist; leave out --resume to start')
    return path


class GazeRunFile:
    """State of one training, kept in ``path`` (None: not at all) every ``every`` seconds.

    ``about``: what a run must agree on to go on (JSON). With ``resume`` the state is read at once: `NergError` where
    there is none, or one of another run. ``stage``: that of the state, ``fit`` or ``refit``, None without one;
    ``seconds``: that were spent before this process.
    """

    def __init__(self, path: Path | None, identity: dict, interval: float = 60.0, resume: bool = False):
        self.path, self.identity, self.interval = path, identity, interval
        self.stage, self.validation_state, self.seconds, self._tensors = None, {}, 0.0, {}
        self._started = self._kept = time.perf_counter()
        if resume:
            path = _kept_file(path)
            self._tensors, self._meta = read_checkpoint(path, KIND)
            with reading_run_state(path):
                check_same_run(path, self._meta["about"], identity)
                self.stage, self.validation_state = self._meta["stage"], self._meta["found"]
                self.seconds = read_count(self._meta, "spent")
                if self.stage not in STAGES or not isinstance(self.validation_state, dict):
                    raise ValueError(f'its "stage" is {sanitize(self.stage, 40)} and not one of {", ".join(STAGES)}')

    @property
    def elapsed(self) -> float:
        """Wall time of the run in seconds, without that between an interruption and its resumption."""
        return self.seconds + time.perf_counter() - self._started

    def restore(self, stage: str, trainer: GazeTrainer) -> dict:
        """Set ``trainer`` to the state of ``stage``, where that was read; returns the weights that ``keep`` was
        given."""
        if self.path is None or stage != self.stage or "random" not in self._meta:
            return {}
        with reading_run_state(self.path):
            trainer.restore(self._tensors, self._meta)
            best = {k: v for k, v in trainer.averaged.items() if f"best.{k}" in self._tensors}
            for k, v in best.items():
                check_shape(self._tensors, f"best.{k}", v)
            return {k: type(v)(self._tensors[f"best.{k}"]) for k, v in best.items()}

    def save(self, stage: str, trainer: GazeTrainer | None, validation_state: dict, weights: dict, force: bool = False) -> None:
        """Write the state, atomically, when it is time (or ``now``). ``trainer``: None between two fits; ``found``:
        what validation has come to (JSON); ``weights``: the best ones so far."""
        if self.path is None or not (force or time.perf_counter() - self._kept > self.interval):
            return
        tensors, meta = {f"best.{k}": v.numpy() for k, v in weights.items()}, {}
        if trainer is not None:
            state, meta = trainer.get_state()
            tensors |= state
        write_checkpoint(
            self.path, KIND, tensors, {"about": self.identity, "stage": stage, "found": validation_state, "spent": self.elapsed, **meta}
        )
        self._kept = time.perf_counter()


# ---- How one gaze field is trained: its architecture, the settings, and the trainer of its kind ----


@dataclass(frozen=True, kw_only=True)
class GazePlan:
    """All that decides a training but for what it learns from and where."""

    config: GazeHeadConfig  # Architecture of the field
    # Others that folds may choose in its place (`gaze_run.choose_variant`).
    alternatives: tuple[GazeHeadConfig, ...] = ()
    settings: GazeSettings  # How weights are moved, and for how long
    probes: ProbeSettings  # How rays become probes
    trainer: type[GazeTrainer]  # Moves the weights of a field of this kind
    # Arrays to begin with in place of random ones, by name (`GazeTrainer.begin_as`); None: random ones.
    initial_arrays: dict[str, Any] | None = None

    def with_settings(self, **changes: Any) -> GazePlan:
        """The same with other ``settings``."""
        return replace(self, settings=replace(self.settings, **changes))

    def make_identity(self, supervision: Supervision, geometry: TrainingGeometry, state: StateSettings) -> dict:
        """What a run must agree on to be gone on with (JSON): of two runs that differ in any of it, neither goes on
        with the other's state."""
        return {
            **state.identity,
            **supervision.compute_digest(),
            "settings": self.settings.to_dict(),
            "probes": self.probes.to_dict(),
            "architecture": self.config.to_dict(),
            "box": geometry.box.to_dict(),
            "align": alignment_to_json(geometry),
        }


def alignment_to_json(geometry: TrainingGeometry) -> list[list[float]] | None:
    """The similarity from the rays' frame to that of ``place``, as JSON; None where they are one."""
    return None if geometry.align.is_identity else geometry.align.matrix.tolist()


# ---- Fit ----
#
# The two fits of a training: one that a validation watches, and a second one on everything, as long as was best.


@dataclass(frozen=True)
class GazeProgress:
    """State of a run."""

    stage: str  # "probes", "fit" or "refit"; of an ensemble with the member before it
    fraction: float  # Share of the stage that is done, 0..1; of an ensemble, of all members
    steps: int  # Steps taken
    seconds: float  # Wall time of the fit
    scores: Scores | None  # The last validation; None before the first


ProgressCallback = Callable[[GazeProgress], object]  # Is told how a run goes; may raise `KeyboardInterrupt` to end it


@dataclass
class GazeFit:
    """What a fit has come to."""

    trainer: Any = None  # The `GazeTrainer`; None: of an earlier process, which kept no more than what was found
    weights: dict = field(default_factory=dict)  # The best weights
    best_step: int = 0  # After how many steps they were
    schedule: int = 0  # Steps that the schedule spans
    scores: Scores | None = None  # Of the best weights
    history: list[dict] = field(default_factory=list)  # Every validation (JSON)
    interrupted: bool = False  # Whether it ended by Ctrl-C
    since: int = 0  # Looks without an improvement
    next_look: int = 0  # Which look is due

    def to_dict(self) -> dict:
        """What a resumed run needs to know besides arrays (JSON)."""
        scores = None if self.scores is None else [float(v) for v in self.scores]
        return {
            **{k: getattr(self, k) for k in ("best_step", "schedule", "history", "since", "next_look")},
            "scores": scores,
        }

    @staticmethod
    def from_dict(found: dict, trainer: GazeTrainer | None = None, weights: dict | None = None) -> GazeFit:
        """The fit of which ``found`` was kept."""
        scores = found.get("scores")
        return GazeFit(trainer, weights or {}, **{**found, "scores": None if scores is None else Scores(*scores)})


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
    """Train until the schedule ends, or validation on ``watched`` has not improved for ``patience`` looks; ``share``:
    of minutes."""
    settings = plan.settings
    if settings.minutes is not None:
        settings = replace(settings, minutes=settings.minutes * minutes_fraction)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, initial=plan.initial_arrays)
    out = GazeFit.from_dict(file.validation_state, trainer, file.restore("fit", trainer))
    out.schedule = settings.steps or 0
    looks, recent = np.arange(1, settings.num_validations + 1) / settings.num_validations, out.scores
    with Interruption() as stop:
        while (
            trainer.progress < 1 and not out.interrupted and not (settings.patience and out.since >= settings.patience)
        ):
            trainer.step()
            if validation is not None and trainer.progress >= looks[out.next_look]:
                out.next_look = min(int(np.searchsorted(looks, trainer.progress, "right")), len(looks) - 1)
                recent = trainer.evaluate(validation)
                out.history.append({"steps": trainer.steps, **round_scores(recent)})
                out.since += 1
                if out.scores is None or np.isnan(out.scores.loss) or recent.loss < out.scores.loss:
                    out.weights, out.best_step, out.scores, out.since = trainer.copy_weights(), trainer.steps, recent, 0
            file.save("fit", trainer, out.to_dict(), out.weights)
            out.interrupted = _stopped(
                stop, on_progress, GazeProgress("fit", trainer.progress, trainer.steps, trainer.seconds, recent)
            )
    if out.interrupted:
        file.save("fit", trainer, out.to_dict(), out.weights, force=True)
    if validation is not None and out.scores is None and trainer.steps:
        out.scores, out.best_step, out.weights = trainer.evaluate(validation), trainer.steps, trainer.copy_weights()
    if not out.weights:
        out.weights, out.best_step = trainer.copy_weights(), trainer.steps
    if settings.minutes is not None:
        # What the clock's schedule came to in steps, so that a second fit can follow the same one.
        out.schedule = max(trainer.steps, round(trainer.steps / max(trainer.progress, 1e-6)))
    return out


def refit(
    targets: GazeTargets, first: GazeFit, box: AnyBox, plan: GazePlan, ns: ModuleType, file: GazeRunFile, on_progress: ProgressCallback
) -> GazeFit:
    """Train for as many steps as were best in the ``first`` fit, along the same schedule."""
    settings = replace(plan.settings, steps=first.best_step, minutes=None)
    trainer = plan.trainer(targets, box, plan.config, settings, ns, first.schedule, plan.initial_arrays)
    file.restore("refit", trainer)
    interrupted = False
    with Interruption() as stop:
        while trainer.steps < first.best_step and not interrupted:
            trainer.step()
            file.save("refit", trainer, first.to_dict(), {})
            done = trainer.steps / first.best_step
            interrupted = _stopped(
                stop, on_progress, GazeProgress("refit", done, trainer.steps, trainer.seconds, first.scores)
            )
    if interrupted:
        file.save("refit", trainer, first.to_dict(), {}, force=True)
    return GazeFit(trainer, trainer.copy_weights(), trainer.steps, first.schedule, first.scores, [], interrupted)


def _stopped(stop: Interruption, tell: ProgressCallback, progress: GazeProgress) -> bool:
    """Tell ``progress``; whether there was a Ctrl-C. Heard only here: within a step, weights and random numbers do not
    belong together."""
    try:
        tell(progress)
        stop.check()
    except KeyboardInterrupt:
        return True
    return False


def round_scores(scores: Scores) -> dict[str, float]:
    """``scores`` by name, with five digits (JSON)."""
    return {k: round(float(v), 5) for k, v in scores._asdict().items()}
