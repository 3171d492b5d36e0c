"""Radiance training from photos to a checkpoint, with its error on held-out views."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, clean_text, parameter
from nerg_mi.fields.radiance import EMPTY, RadianceConfig, RadianceNetwork
from nerg_mi.files.schema import INDEX, NUMBER, Items, Number, check_json
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.maths.color import color_corrected_psnr, mean_ignoring_nan, psnr
from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.photos.dataset import Dataset
from nerg_mi.photos.images import PhotoView, pick_evenly
from nerg_mi.threads import measure_processor_time

from .radiance_budget import EVALUATION_SAMPLES, Budget
from .radiance_diagnosis import MIN_STEPS, Outcome, describe_pace, find_causes, find_problems
from .radiance_losses import PHOTO_PARAMETER
from .radiance_monitor import (
    PreviewWriter,
    TrainingObserver,
    get_curves_figure,
    write_curves_figure,
    write_curves_table,
)
from .radiance_settings import RadianceSettings
from .radiance_trainer import Preview, RadianceTrainer
from .trainer import StepClock, check_same_run, reading_run_state, saving_on_failure

# ---- Fraction of the pixels outside the core box ----


def compute_outside_fraction(
    views: list[PhotoView], render: Callable[[PhotoView], Preview], core: Box, every: int = 1
) -> float:
    """Return the fraction of the pixels of ``views`` that show something outside ``core``, or nothing.

    ``render`` returns the depths and opacities of every ``every``-th row and column, starting at ``every // 2``. A
    pixel with an opacity of at most 0.5 shows nothing.
    """
    is_outside = []
    for view in views:
        rendered = render(view)
        d = pixel_directions(view.camera.intrinsics)[every // 2 :: every, every // 2 :: every]
        p = view.camera.center + rendered.depth[..., None] * (d @ view.camera.to_world[:3, :3].T)
        is_inside = (rendered.opacity > 0.5) & np.all((p >= core.lower) & (p <= core.upper), axis=-1)
        is_outside.append(~is_inside.ravel())
    return float(np.mean(np.concatenate(is_outside)))


# ---- Error on held-out views ----


@dataclass(frozen=True)
class HeldOutError:
    """PSNR in dB of each held-out view.

    ``psnr`` is computed over a black background. ``psnr_fitted`` is that of the right halves after fitting their
    colours on the left halves (`color_corrected_psnr`). Views without pixels are NaN and excluded from the means.
    """

    psnr: list[float]
    psnr_fitted: list[float]

    @property
    def mean(self) -> float:
        return mean_ignoring_nan(self.psnr)

    @property
    def mean_fitted(self) -> float:
        return mean_ignoring_nan(self.psnr_fitted)


def evaluate_views(
    trainer: RadianceTrainer,
    views: list[PhotoView],
    every: int = 1,
    field: RadianceNetwork | None = None,
    on_view: Callable[[int], None] = lambda number: None,
) -> HeldOutError:
    """Compute the error on ``views``, on every ``every``-th unmasked pixel.

    Renders ``field`` with its own occupancy, or by default the averaged weights of the trainer. ``on_view`` is called
    with the number of finished views before each view.
    """
    field, pixels = field or trainer.make_field(with_occupancy=False), (slice(every // 2, None, every),) * 2
    errors = HeldOutError([], [])
    for number, view in enumerate(views):
        on_view(number)
        color, truth = trainer.render(view, every, field).color, view.composite_over(0)[pixels]
        mask = None if view.mask is None else view.mask[pixels]
        alpha = view.color[pixels][..., 3] if view.has_alpha else None
        errors.psnr.append(psnr(color, truth, mask))
        errors.psnr_fitted.append(color_corrected_psnr(color, truth, alpha, mask))
    return errors


# ---- Compiling the kernels of a training before its clock starts ----


def warm_up(trainer) -> None:
    """Run all kinds of steps of ``trainer`` (`RadianceTrainer`) once, and discard their effects.

    Compilation takes seconds if the kernels are not in Dr.Jit's disk cache: a large part of a run of one minute.
    Weights, random numbers and all other state are restored, and the clock of the run starts.
    """
    with _restoring_state(trainer):
        every, grid = trainer.settings.grid_interval, trainer.grid
        # The kernels of the average differ the first two times. A step whose number is divisible updates the grid.
        for before in (3, 7, every):
            trainer.steps = before
            trainer.step()
        # No cell is empty yet. The penalty on empty cells has kernels of its own, which differ directly after an update
        # of the grid.
        for before in (every, every + 1):
            grid.value = dr.select((grid.index & 1) == 0, grid.value, 0)
            dr.eval(grid.value)
            grid.unsampled = dr.opaque(type(grid.unsampled), 0, 64)
            trainer.steps = before
            trainer.step()
        settling = trainer.extraction
        for at in (0, 1, settling.PROBE_PIECES, settling.NUM_PIECES - 1):
            # Pretend that there is density everywhere; otherwise no ray would hit anything.
            settling.dilated_dense = dr.select(grid.seen, type(grid.bits)(1), 0)
            settling.pieces_done = at
            trainer.update_current_field()
            trainer.extract_occupancy_piece()
        trainer.end_free_space()
        dr.sync_thread()
    trainer.start()


@contextmanager
def _restoring_state(trainer):
    parts = (trainer, trainer.grid, trainer.extraction, trainer.optimiser)
    # Copy arrays, because scatter operations modify them in place.
    before = [{k: type(v)(v) if dr.is_array_v(v) else v for k, v in vars(part).items()} for part in parts]
    state, averaged, rng = dict(trainer.optimiser.state), dict(trainer.averaged), copy.deepcopy(trainer.rng)
    live = {k: type(v)(v) for k, v in trainer.current_field.parameters().items()}
    try:
        yield
    finally:
        for part, values in zip(parts, before):
            vars(part).update(values)
        trainer.averaged, trainer.rng, trainer.clock = averaged, rng, StepClock()
        for name, (value, *rest) in state.items():
            # Detach the array, which has accumulated gradients.
            value = type(value)(dr.detach(value))
            dr.enable_grad(value)
            state[name] = (value, *rest)
        trainer.optimiser.state = state
        trainer.current_field.set_parameters(live)


# ---- Training run from a data set to a checkpoint ----

KIND = "radiance run"
# Fractions of the run at which the held-out error is evaluated.
_EVALUATION_TIMES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_NUM_VALIDATION_VIEWS, _NUM_TRAINING_VIEWS = 4, 2
# Fraction of the run after which its pace is judged.
_PACE_TIME = 0.1
# An earlier state replaces the last one if it is better on the validation views by more than this, in dB.
_MIN_IMPROVEMENT = 0.2
# Minimum number of steps between two evaluations, each of which takes as long as several steps
MIN_EVALUATION_INTERVAL = 50


@dataclass(frozen=True)
class RadianceProgress:
    """Progress of a run.

    ``phase`` is "training", "extracting" (the occupancy), "scoring" (of the held-out views) or "writing".
    ``fraction`` is the completed fraction of all of them, and ``remaining`` the seconds that remain, both estimated
    from measured costs (`Budget`). ``seconds`` is the time so far, ``psnr`` the last held-out error in dB or None;
    ``rays`` and ``samples`` are those of the last step.
    """

    fraction: float
    remaining: float
    steps: int
    seconds: float
    rays: int
    samples: int
    psnr: float | None
    phase: str = "training"


def train_field(
    dataset: Dataset,
    config: RadianceConfig,
    settings: RadianceSettings,
    ns: ModuleType,
    depth: bool = True,
    on_progress: Callable[[RadianceProgress], None] | None = None,
    *,
    state: Path | None = None,
    resume: bool = False,
    save_every: float = 60.0,
    preview: Path | None = None,
    curves: Path | None = None,
    observer: TrainingObserver | None = None,
    write: Callable[[RadianceNetwork, dict], None] | None = None,
    on_warning: Callable[[str], None] = lambda text: None,
) -> tuple[RadianceNetwork, dict]:
    """Train a radiance field on ``dataset``, and return its best state on the validation views.

    Parameters
    ----------
    dataset : Dataset
        Posed photos. Held-out views are only evaluated: a few of them coarsely during the run, which choose the state
        (`WatchedViews`), and all of them at the end, on every pixel unless that takes too many samples. The error of
        the views that do not choose is the one to report.
    config : RadianceConfig
        Configuration of the field.
    settings : RadianceSettings
        Training settings.
    ns : module
        Dr.Jit backend.
    depth : bool
        Use depth supervision if the photos have depth.
    on_progress : callable, optional
        Called with `RadianceProgress` after each step, and while the result of an uninterrupted run is scored and
        written.
    state : Path, optional
        State file of the run, written every ``save_every`` seconds and when the run is interrupted.
    resume : bool
        Resume from the state file.
    save_every : float
        Seconds between two states.
    preview : Path, optional
        PNG of the first validation view, with the photo to its right, updated at evaluations, as far as its time allows
        (`PreviewWriter`), and at the end.
    curves : Path, optional
        CSV file of the evaluations, updated at each of them. At the end, a figure of it is written (.png).
    observer : TrainingObserver, optional
        Called before the first step and after each step. Its errors end the training, see `GuardedObserver`.
    write : callable, optional
        Called with the field and its provenance to store them. The run state is removed after it returns; if it raises,
        the final state is saved. Without ``write`` the state remains.
    on_warning : callable
        Called with a sentence after a tenth of the run if its pace is too low for a usable field.

    Returns
    -------
    field : RadianceNetwork
        Field with its occupancy.
    provenance : dict
        Provenance (JSON), including the names of the views that chose the state (``validation_views``) and problems of
        the result (``complaints``).

    Notes
    -----
    Kernels are compiled before the clock of the run starts. Ctrl-C ends the run after the current step with the result
    so far.
    """
    trainer = RadianceTrainer(dataset.train, dataset.box, config, settings, ns, depth)
    warm_up(trainer)
    watched = WatchedViews.choose(dataset)
    identity = {
        **{k: dataset.source.get(k) for k in ("sha256", "training_frames", "width", "height")},
        "settings": settings.to_dict(),
        "architecture": config.to_dict(),
        "box": dataset.box.to_dict(),
        "depth": depth,
        "validation_views": watched.validation_names,
    }
    history = load_run(trainer, state, identity) if resume else []
    last_psnr = history[-1]["psnr"] if history else None
    evaluations, saved, interrupted = _EvaluationTimes(trainer, watched, history), trainer.seconds, False
    previews = PreviewWriter(preview, watched.held_out[0]) if preview is not None and watched.held_out else None

    def save() -> None:
        if state is not None:
            save_run(trainer, state, identity, history)

    budget = Budget(trainer, dataset.held_out)

    def report(phase: str = "training", part: float = 0.0) -> None:
        if on_progress is not None and not interrupted:
            now = trainer.steps, trainer.seconds, trainer.rays, trainer.samples
            on_progress(RadianceProgress(*budget.estimate(part), *now, last_psnr, phase))

    pace = Pace(trainer)
    if observer is not None:
        observer.on_start(trainer, dataset)

    def evaluate() -> None:
        nonlocal last_psnr
        with budget.timing_evaluation([*watched.held_out, *watched.training]) as strides:
            row = _append_evaluation(trainer, watched, history)
            strides += [] if row is None else [row["every_pixel"]]
        last_psnr = history[-1]["psnr"] if history else None
        with saving_on_failure(state, save, is_done=False):
            if curves is not None and history:
                write_curves_table(curves, history)
            if previews is not None:
                previews.write_if_affordable(trainer)

    def after_step() -> None:
        nonlocal saved
        if (line := pace.judge()) is not None:
            on_warning(line)
        if evaluations.take_due():
            evaluate()
        if state is not None and trainer.seconds - saved > save_every:
            save()
            saved = trainer.seconds
        if observer is not None:
            observer.on_step(trainer, history)

    def update_budget() -> None:
        if (line := budget.update()) is not None:
            on_warning(line)
        report()

    interrupted = trainer.run(lambda: trainer.progress >= 1, after_step, update_budget)
    seconds = trainer.seconds
    if interrupted:
        save()

    def save_end() -> None:
        trainer.set_seconds(seconds)
        save()

    with saving_on_failure(state, save_end, is_done=write is not None and not interrupted):
        budget.start_result()
        report("extracting")
        score = lambda fraction: report("scoring", fraction)

        def extract(part: float) -> None:
            budget.update_extraction(part)
            report("extracting")

        duration = seconds, pace.waiting_fraction
        # A copy, because the evaluation of the result is not part of the run: a resumed run would not repeat it.
        field, provenance = _make_result(
            trainer, dataset, watched, list(history), duration, interrupted, budget, score, extract
        )
        evaluations, result = provenance["psnr_watched"]["history"], provenance["psnr_watched"]["result"]
        if previews is not None:
            previews.write_result(trainer, field)
        if curves is not None and evaluations:
            write_curves_table(curves, evaluations)
            write_curves_figure(get_curves_figure(curves), evaluations, result)
        if write is not None:
            report("writing", 1.0)
            write(field, provenance)
    return field, provenance


class _EvaluationTimes:
    """Times at which a run is evaluated, `_EVALUATION_TIMES`, as far as they follow the evaluations of ``history``."""

    def __init__(self, trainer: RadianceTrainer, watched: WatchedViews, history: list):
        self._trainer, self._last_step = trainer, history[-1]["steps"] if history else 0
        # Not from the present progress: an evaluation that has come due may be postponed (`MIN_EVALUATION_INTERVAL`).
        done = trainer.progress_at(history[-1]["steps"], history[-1]["seconds"]) if history else 0.0
        self._left = [x for x in _EVALUATION_TIMES if x > done] if watched.held_out else []

    def take_due(self) -> bool:
        """Return whether an evaluation is due, and start to wait for the next one."""
        steps, progress = self._trainer.steps, self._trainer.progress
        if not self._left or progress < self._left[0] or steps < self._last_step + MIN_EVALUATION_INTERVAL:
            return False
        self._left, self._last_step = [x for x in self._left if x > progress], steps
        return True


class Pace:
    """Pace of a run, and the fraction of the processor time that other programs use meanwhile."""

    def __init__(self, trainer: RadianceTrainer):
        self._trainer, self._time, self._is_judged = trainer, measure_processor_time(), False
        # Those of a resumed run are not 0.
        self._first_step: int = trainer.steps
        self._begin: float = trainer.seconds
        self._first_progress: float = trainer.progress

    @property
    def waiting_fraction(self) -> float:
        """Fraction of the time since the start in which threads were ready but waited for a processor; 0 if unknown."""
        before, now = self._time, measure_processor_time()
        if before is None or now is None:
            return 0.0
        running, waiting = now[0] - before[0], now[1] - before[1]
        return max(0.0, waiting / max(running + waiting, 1e-9))

    def judge(self) -> str | None:
        """Return a warning, once a tenth of the run after the start, if it will have too few steps."""
        t = self._trainer
        if self._is_judged or t.progress - self._first_progress < _PACE_TIME or t.settings.minutes is None:
            return None
        self._is_judged = True
        per_second = (t.steps - self._first_step) / max(t.seconds - self._begin, 1e-9)
        expected = t.steps + per_second * max(60 * t.settings.minutes - t.reserved_seconds - t.seconds, 0.0)
        if expected >= MIN_STEPS:
            return None
        return (
            f"at this pace ({describe_pace(per_second, self.waiting_fraction)}) the training will have about "
            f"{expected:.0f} steps, but a usable field needs at least {MIN_STEPS}: give it more "
            f"{parameter('minutes')}"
        )


def save_run(trainer: RadianceTrainer, path: Path, identity: dict, history: list) -> None:
    """Write the state of ``trainer`` atomically.

    ``identity`` must match for the run to be resumed (JSON); ``history`` are the evaluations so far.
    """
    tensors, metadata = trainer.get_state()
    write_checkpoint(path, KIND, tensors, {"about": identity, "history": history, **metadata})


# An evaluation in a run state; "psnr_train" may be null.
_EVALUATION = {"steps": INDEX, "seconds": Number(0), "psnr": NUMBER, "every_pixel": Number(1, is_integer=True)}


def load_run(trainer: RadianceTrainer, path: Path | None, identity: dict) -> list:
    """Restore ``trainer`` from the state in ``path`` and return the history.

    Raises `NergError` unless the state belongs to a run with the same ``identity``.
    """
    if path is None:
        raise NergError("cannot resume: no state file is given")
    tensors, meta = read_checkpoint(path, KIND)
    with reading_run_state(path):
        check_same_run(path, meta["about"], identity)
        history = check_json(meta["history"], Items(_EVALUATION), "history")
        check_json(meta, {"best?": _EVALUATION})
        trainer.restore(tensors, meta)
        return history


def _make_result(
    trainer: RadianceTrainer,
    dataset: Dataset,
    watched: WatchedViews,
    history: list,
    duration: tuple[float, float],
    interrupted: bool,
    budget: Budget,
    on_progress: Callable[[float], None],
    on_extraction: Callable[[float], None],
) -> tuple[RadianceNetwork, dict]:
    """Return the best field and its provenance with the error on held-out views.

    ``duration`` is the time in seconds and the fraction of it in which other programs had the processors;
    ``on_progress`` is called with the fraction of the scored views, ``on_extraction`` with that of the occupancy.
    """
    seconds, waiting_fraction = duration
    field, result = _choose_state(trainer, watched, history, seconds, budget, on_extraction)
    provenance = {
        **dataset.source,
        "settings": trainer.settings.to_dict(),
        "depth_supervision": trainer.use_depth,
        "point_supervision": len(trainer.pixels.points) if trainer.use_points else 0,
        "steps": trainer.steps,
        "seconds": round(seconds, 1),
        "waiting_fraction": round(waiting_fraction, 3),
        "interrupted": interrupted,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        **trainer.clock.summary(),
    }
    if trainer.photos is not None:
        provenance["photo_stops"] = round(trainer.photos.compute_exposure_spread(trainer.averaged[PHOTO_PARAMETER]), 3)
    provenance["validation_views"] = watched.validation_names
    test_psnr = None
    if dataset.held_out:
        provenance["psnr_held_out"] = scores = _score_held_out(trainer, dataset, watched, field, budget, on_progress)
        test_psnr = scores["mean" if trainer.photos is None else "mean_fitted"]
        if field.box.is_contracted:
            every = trainer.choose_pixel_stride(watched.held_out, EVALUATION_SAMPLES)
            outside_fraction = compute_outside_fraction(
                watched.held_out, lambda view: trainer.render(view, every, field), field.box.core, every
            )
            provenance["beyond_box"] = round(outside_fraction, 4)
    provenance["psnr_watched"] = {"views": [v.name for v in watched.held_out], "history": history, "result": result}
    outcome = Outcome(
        history, result, test_psnr, trainer.steps, trainer.stride, trainer.settings.minutes, seconds, waiting_fraction
    )
    if test_psnr is not None:
        provenance["quality"] = "poor" if outcome.is_poor else "usable"
    causes = []
    if outcome.is_poor:
        causes = find_causes(dataset.train, provenance.get("photo_stops", 0.0), provenance.get("beyond_box", 0.0))
    problems = [*([f"the field {EMPTY}"] if field.is_empty else []), *find_problems(outcome, causes)]
    provenance["complaints"] = [clean_text(problem) for problem in problems]
    return field, provenance


def _score_held_out(
    trainer: RadianceTrainer,
    dataset: Dataset,
    watched: WatchedViews,
    field: RadianceNetwork,
    budget: Budget,
    on_progress: Callable[[float], None],
) -> dict:
    """Return the error on all held-out views (JSON).

    The means are those of the views that did not choose the state, and in ``validation`` those of the views that did.
    """
    on_progress(0.0)
    views, count = dataset.held_out, len(dataset.held_out)
    every = trainer.choose_pixel_stride(views, budget.choose_final_samples())
    error = evaluate_views(trainer, views, every, field, lambda number: on_progress(number / count))
    on_progress(1.0)
    has_chosen = [v.name in watched.validation_names for v in views]
    test, validation = (
        {
            name: _round_decibels(mean_ignoring_nan([p for p, c in zip(values, has_chosen) if c == is_validation]))
            for name, values in (("mean", error.psnr), ("mean_fitted", error.psnr_fitted))
        }
        for is_validation in (False, True)
    )
    each = {v.name: _round_decibels(p) for v, p in zip(views, error.psnr)}
    return {**test, "every_pixel": every, "views": each, "validation": validation}


def _choose_state(
    trainer: RadianceTrainer,
    watched: WatchedViews,
    history: list,
    seconds: float,
    budget: Budget,
    on_extraction: Callable[[float], None],
) -> tuple[RadianceNetwork, dict | None]:
    """Return the field of the last state, or of the best one if that is better as a result, and its evaluation.

    The last state is appended to ``history``, and the evaluation of the best one replaced if it was repeated;
    ``seconds`` is the time of the training of the last state.
    """
    field = trainer.make_field(on_progress=on_extraction)
    with budget.timing_evaluation([*watched.held_out, *watched.training]) as strides:
        last = _append_evaluation(trainer, watched, history, field, seconds)
        strides += [] if last is None else [last["every_pixel"]]
    best = trainer.best
    if last is None or best is None or best.row["psnr"] <= last["psnr"] + _MIN_IMPROVEMENT:
        return field, last
    earlier = trainer.make_field(snapshot=best)
    row = {**best.row, **_evaluate(trainer, watched, history, earlier)}
    # The evaluation during the training may have covered other cells, and cannot be compared with the last.
    history[:] = [row if r["steps"] == row["steps"] else r for r in history]
    if row["psnr"] <= last["psnr"] + _MIN_IMPROVEMENT:
        return field, last
    return earlier, row


def _round_decibels(decibels: float) -> float | None:
    """Round ``decibels`` for the checkpoint; None if no pixel counted."""
    return None if math.isnan(decibels) else round(decibels, 3)


@dataclass(frozen=True)
class WatchedViews:
    """A few views that are evaluated during training: ``held_out`` ones, and ones of the ``training``.

    The held-out ones choose the state (``is_choosing``). They are at most half of all held-out views, so that others
    remain to score the result. A single held-out view scores it, and the last state is the result: training on one
    photo less to choose would cost more than the choice gains.
    """

    held_out: list[PhotoView]
    training: list[PhotoView]
    is_choosing: bool

    @staticmethod
    def choose(dataset: Dataset) -> WatchedViews:
        """Choose views at equal intervals."""
        num_choosing = min(_NUM_VALIDATION_VIEWS, len(dataset.held_out) // 2)
        return WatchedViews(
            pick_evenly(dataset.held_out, max(num_choosing, 1)),
            pick_evenly(dataset.train, _NUM_TRAINING_VIEWS),
            num_choosing > 0,
        )

    @property
    def validation_names(self) -> list[str]:
        """Names of the held-out views that choose the state."""
        return [view.name for view in self.held_out] if self.is_choosing else []


def _append_evaluation(
    trainer: RadianceTrainer,
    watched: WatchedViews,
    history: list,
    field: RadianceNetwork | None = None,
    seconds: float | None = None,
) -> dict | None:
    """Append an evaluation to ``history``, keep the state if it is the best so far, and return the evaluation.

    ``seconds`` is the time of the training, by default until now. None, and nothing is appended, without held-out
    views, or if all of their pixels are masked.
    """
    seconds = trainer.seconds if seconds is None else seconds
    row = {"steps": trainer.steps, "seconds": round(seconds, 1), **_evaluate(trainer, watched, history, field)}
    if row["psnr"] is None:
        return None
    history.append(row)
    if field is None and watched.is_choosing:
        trainer.keep_if_best(row)
    return row


def _evaluate(trainer: RadianceTrainer, watched: WatchedViews, history: list, field: RadianceNetwork | None) -> dict:
    """Return the PSNR of held-out and training views, on a subset of the pixels that takes little time.

    All evaluations of a run (``history``) cover the same pixels, because results on others differ by tenths of a dB.
    If photos have colour changes of their own, which cannot be known of held-out photos, colours are fitted first:
    otherwise the PSNR would follow exposures, and choose an early state of a field that still improves.
    """
    if not watched.held_out:
        return {"psnr": None}
    if history:
        every = history[0]["every_pixel"]
    else:
        every = trainer.choose_pixel_stride(watched.held_out, EVALUATION_SAMPLES)
    shown = field or trainer.make_field(with_occupancy=False)
    errors = [evaluate_views(trainer, views, every, shown) for views in (watched.held_out, watched.training)]
    held_out, training = ((e.mean if trainer.photos is None else e.mean_fitted) for e in errors)
    as_number = lambda x: None if math.isnan(x) else round(x, 2)
    return {"psnr": as_number(held_out), "psnr_train": as_number(training), "every_pixel": every}
