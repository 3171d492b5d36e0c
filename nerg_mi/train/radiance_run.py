"""A training of a radiance field from its photographs to its checkpoint, with its verdict on held-out views."""

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

from nerg_mi.errors import NergError
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.figures.style import make_provenance
from nerg_mi.files.images import write_png
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.interruption import Interruption
from nerg_mi.maths.color import mean_ignoring_nan, psnr, color_corrected_psnr
from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.photos.dataset import Dataset
from nerg_mi.photos.images import PhotoView

from .radiance_losses import PHOTO_PARAMETER
from .radiance_settings import RadianceSettings
from .radiance_trainer import Preview, RadianceTrainer
from .trainer import StepClock, saving_on_failure, check_same_run, reading_run_state

# ---- How much of what photos show lies beyond the part of a place that its field resolves best ----


def compute_outside_fraction(views: list[PhotoView], render: Callable[[PhotoView], Preview], core: Box, every: int = 1) -> float:
    """Share of the pixels of ``views`` (every ``every``-th, from ``every // 2`` on) that show what lies outside of
    ``core``, or nothing, by the depths that ``render`` finds for them."""
    outside = []
    for view in views:
        seen = render(view)
        d = pixel_directions(view.camera.intrinsics)[every // 2 :: every, every // 2 :: every]
        p = view.camera.center + seen.depth[..., None] * (d @ view.camera.to_world[:3, :3].T)
        inside = (seen.opacity > 0.5) & np.all((p >= core.lower) & (p <= core.upper), axis=-1)
        outside.append(~inside.ravel())
    return float(np.mean(np.concatenate(outside)))


# ---- The error of a training on views that it does not learn from ----


@dataclass(frozen=True)
class HeldOutError:
    """In dB, one of each view: ``psnr`` before black; ``fitted`` of right halves, their colours fitted on left
    halves (`color_corrected_psnr`). NaN where no pixel counts, of all views in their means."""

    psnr: list[float]
    psnr_fitted: list[float]

    @property
    def mean(self) -> float:
        return mean_ignoring_nan(self.psnr)

    @property
    def mean_fitted(self) -> float:
        return mean_ignoring_nan(self.psnr_fitted)


def evaluate_views(
    trainer: RadianceTrainer, views: list[PhotoView], every: int = 1, field: RadianceField | None = None
) -> HeldOutError:
    """The error on ``views``, on every ``every``-th pixel of those that their masks leave in.

    Of ``field``, by its own occupancy; without one, of the trainer's averaged weights so far.
    """
    field, part = field or trainer.make_field(with_occupancy=False), (slice(every // 2, None, every),) * 2
    errors = HeldOutError([], [])
    for view in views:
        color, truth = trainer.render(view, every, field).color, view.composite_over(0)[part]
        mask = None if view.mask is None else view.mask[part]
        alpha = view.color[part][..., 3] if view.has_alpha else None
        errors.psnr.append(psnr(color, truth, mask))
        errors.psnr_fitted.append(color_corrected_psnr(color, truth, alpha, mask))
    return errors


# ---- What a finished radiance training has to say against itself ----

_FALL = 1.0  # Looks at a few views differ by some tenths of a dB from one another
_FEW_STEPS = 500  # Fields of photos still gain whole dB with every doubling of their steps below this


def find_problems(history: list[dict], steps: int, stride: int, minutes: float | None, seconds: float = 0.0) -> list[str]:
    """One sentence for each thing that makes the result worse than it might be; none for a sound run.

    ``history``: looks at the watched views in order, each with ``steps`` and ``psnr`` in dB, the last being that of the
    result; ``steps``: taken; ``stride``: how many times coarser than it is rendered the field was sampled at the end;
    ``minutes``: that were asked for, or None for a run by steps; ``seconds``: that it took.
    """
    out = []
    more = "more --steps" if minutes is None else "more --minutes, or --steps"
    if steps < _FEW_STEPS:
        timed = minutes is not None and seconds > 0
        rate = f" ({steps / seconds:.2g} a second: this machine is slow or busy)" if timed else ""
        out.append(f"only {steps} steps{rate}, where a field needs {_FEW_STEPS} before it is of use; give {more}")
    if stride > 1:
        out.append(
            f"the run ended while marching {stride} times coarser than the field is rendered: fog was not yet cleared; "
            f"give {more}"
        )
    if len(history) > 1:
        best = max(history[:-1], key=lambda x: x["psnr"])
        fall = best["psnr"] - history[-1]["psnr"]
        if fall > _FALL:
            out.append(
                f"the result has {history[-1]['psnr']:.2f} dB on the watched views where step {best['steps']} had "
                f"{best['psnr']:.2f} dB: it is {fall:.1f} dB worse than the run promised; try another --seed, or {more}"
            )
    return out


# ---- Compiling what a radiance training runs, before its clock starts ----


def warm_up(trainer) -> None:
    """Run, and forget, what the steps of ``trainer`` (`RadianceTrainer`) consist of.

    Compiling takes seconds where the kernels are not in Dr.Jit's cache on the disk: a large share of a run of a minute,
    in the part that decides how it ends. Weights, random numbers and all else are as before; the clock of the run
    starts.
    """
    with _forgotten(trainer):
        every, grid = trainer.settings.grid_interval, trainer.grid
        # The kernels of the average differ the first two times; a step whose number is divisible looks over the grid.
        for before in (3, 7, every):
            trainer.steps = before
            trainer.step()
        # Nothing is empty yet, and the penalty on what is has kernels of its own, which differ where the grid has just
        # been looked over.
        for before in (every, every + 1):
            grid.value = dr.select((grid.index & 1) == 0, grid.value, 0)
            dr.eval(grid.value)
            grid.unsampled = dr.opaque(type(grid.unsampled), 0, 64)
            trainer.steps = before
            trainer.step()
        settling = trainer.extraction
        for at in (0, 1, settling.PROBE_PIECES, settling.NUM_PIECES - 1):
            # As if density had been found everywhere: where there is none yet no ray would meet any.
            settling.dilated_dense = dr.select(grid.seen, type(grid.bits)(1), 0)
            settling.pieces_done = at
            trainer.update_current_field()
            trainer.extract_occupancy_piece()
        dr.sync_thread()
    trainer.start()


@contextmanager
def _forgotten(trainer):
    parts = (trainer, trainer.grid, trainer.extraction, trainer.optimiser)
    # Arrays are scattered to in place: a second name would change with the first.
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
            # The old array has gathered derivatives.
            value = type(value)(dr.detach(value))
            dr.enable_grad(value)
            state[name] = (value, *rest)
        trainer.optimiser.state = state
        trainer.current_field.set_parameters(live)


# ---- A whole radiance training: from a data set to a checkpoint, with its held-out error on the way ----

KIND = "radiance run"
# Shares of the run at which the held-out error is looked at.
_LOOKS = (0.05, 0.1, 0.2, 0.4, 0.6, 0.8)
_LOOK_VIEWS = 4
MIN_EVALUATION_INTERVAL = 50  # Steps at least between two looks, one of which takes as long as several
# Samples at most of a look and of a preview, and of the error at the end: fog has hundreds on each ray.
_LOOK_SAMPLES, _FINAL_SAMPLES = 2**20, 2**24


@dataclass(frozen=True)
class RadianceProgress:
    """State of a run. ``done``: share 0..1; ``seconds``: so far; ``psnr``: the last held-out error in dB, or None;
    ``rays``, ``samples``: of the last step."""

    fraction: float
    steps: int
    seconds: float
    rays: int
    samples: int
    psnr: float | None


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
    write: Callable[[RadianceField, dict], None] | None = None,
) -> tuple[RadianceField, dict]:
    """Train a field on ``dataset``; returns it, with its occupancy, and its provenance (JSON).

    Kernels are compiled before the run's time begins. The held-out views are looked at and never learnt from: a few of
    them, coarsely, at some shares of the run, and all of them at the end, on every pixel unless that takes many
    samples. What is wrong with the result stands in the provenance's ``complaints``. Ctrl-C ends the run after the step
    at hand, with what it has come to.

    ``state``: file that holds the whole state of the run, written every ``save_every`` seconds and when the run is
    interrupted; ``resume``: go on from there. ``write``: given the result, which it puts into a file. Once it has done
    so, the state of a run that is done is removed; if it raises, it is that of the end. Without it the state stays.
    ``preview``: PNG of the first watched view, its picture beside what is true, rewritten at every look and at the end.
    """
    trainer = RadianceTrainer(dataset.train, dataset.box, config, settings, ns, depth)
    warm_up(trainer)
    spread = np.linspace(0, len(dataset.held_out) - 1, min(_LOOK_VIEWS, len(dataset.held_out))).round().astype(int)
    watched = [dataset.held_out[i] for i in spread]
    about = {
        **{k: dataset.source.get(k) for k in ("sha256", "training_frames", "width", "height")},
        "settings": settings.to_dict(),
        "architecture": config.to_dict(),
        "box": dataset.box.to_dict(),
        "depth": depth,
    }
    history = load_run(trainer, state, about) if resume else []
    last = history[-1]["psnr"] if history else None
    looks = [x for x in _LOOKS if x > trainer.progress] if watched else []
    looked, saved, interrupted = history[-1]["steps"] if history else 0, trainer.seconds, False

    def keep() -> None:
        if state is not None:
            save_run(trainer, state, about, history)

    with Interruption() as stop:
        while trainer.progress < 1 and not interrupted:
            trainer.step()
            if looks and trainer.progress >= looks[0] and trainer.steps >= looked + MIN_EVALUATION_INTERVAL:
                looks, looked = [x for x in looks if x > trainer.progress], trainer.steps
                _look(trainer, watched, history)
                last = history[-1]["psnr"] if history else None
                if preview is not None:
                    write_preview(trainer, watched[0], preview)
            if state is not None and trainer.seconds - saved > save_every:
                keep()
                saved = trainer.seconds
            try:
                if on_progress is not None:
                    on_progress(
                        RadianceProgress(
                            trainer.progress, trainer.steps, trainer.seconds, trainer.rays, trainer.samples, last
                        )
                    )
                stop.check()
            except KeyboardInterrupt:
                # Only here, between two steps: elsewhere there would be weights and random numbers of different steps.
                interrupted = True
        if preview is not None and watched:
            with saving_on_failure(state, keep, is_done=False):
                write_preview(trainer, watched[0], preview)
        interrupted = interrupted or stop.is_requested  # One that came while the last preview was made
    seconds = trainer.seconds
    if interrupted:
        keep()
    with saving_on_failure(state, keep, is_done=write is not None and not interrupted):
        field, provenance = _result(trainer, dataset, watched, history, seconds, interrupted)
        if write is not None:
            write(field, provenance)
    return field, provenance


def save_run(trainer: RadianceTrainer, path: Path, identity: dict, history: list) -> None:
    """Write the state of ``trainer`` atomically. ``about``: what the run must agree on to be resumed (JSON);
    ``history``: of its held-out error so far."""
    tensors, metadata = trainer.get_state()
    write_checkpoint(path, KIND, tensors, {"about": identity, "history": history, **metadata})


def load_run(trainer: RadianceTrainer, path: Path | None, identity: dict) -> list:
    """Set ``trainer`` to the state in ``path``; returns the history.

    Raises `NergError` unless the state is one of a run with the same ``about``.
    """
    if path is None:
        raise NergError("there is nothing to resume: name the file that holds the state of the run")
    tensors, meta = read_checkpoint(path, KIND)
    with reading_run_state(path):
        check_same_run(path, meta["about"], identity)
        trainer.restore(tensors, meta)
        return list(meta["history"])


def _result(
    trainer: RadianceTrainer,
    dataset: Dataset,
    watched: list[PhotoView],
    history: list,
    seconds: float,
    interrupted: bool,
) -> tuple[RadianceField, dict]:
    """The field that the run has come to, and its provenance with the error on all held-out views."""
    field = trainer.make_field()
    provenance = {
        **dataset.source,
        "settings": trainer.settings.to_dict(),
        "depth_supervision": trainer.use_depth,
        "steps": trainer.steps,
        "seconds": round(seconds, 1),
        "interrupted": interrupted,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        **trainer.clock.summary(),
    }
    if trainer.photos is not None:
        provenance["photo_stops"] = round(trainer.photos.compute_exposure_spread(trainer.averaged[PHOTO_PARAMETER]), 3)
    if dataset.held_out:
        every = trainer.choose_pixel_stride(dataset.held_out, _FINAL_SAMPLES)
        error = evaluate_views(trainer, dataset.held_out, every, field)
        provenance["psnr_held_out"] = {
            "mean": _rounded(error.mean),
            "mean_fitted": _rounded(error.mean_fitted),
            "every_pixel": every,
            "views": {v.name: _rounded(p) for v, p in zip(dataset.held_out, error.psnr)},
        }
        _look(trainer, watched, history, field)
        if field.box.is_contracted:
            every = trainer.choose_pixel_stride(watched, _LOOK_SAMPLES)
            beyond = compute_outside_fraction(watched, lambda view: trainer.render(view, every, field), field.box.core, every)
            provenance["beyond_box"] = round(beyond, 4)
    provenance["psnr_watched"] = {"views": [v.name for v in watched], "history": history}
    minutes = trainer.settings.minutes
    provenance["complaints"] = find_problems(history, trainer.steps, trainer.stride, minutes, seconds)
    return field, provenance


def _rounded(decibels: float) -> float | None:
    """For the checkpoint: None where no pixel counted."""
    return None if math.isnan(decibels) else round(decibels, 3)


def _look(
    trainer: RadianceTrainer, watched: list[PhotoView], history: list, field: RadianceField | None = None
) -> None:
    """Add the error on the ``watched`` views, if any of their pixels counts, to ``history``: every so many pixels, as
    many as take little time."""
    every, seconds = trainer.choose_pixel_stride(watched, _LOOK_SAMPLES), trainer.seconds
    psnr = evaluate_views(trainer, watched, every, field).mean
    if not math.isnan(psnr):
        row = {"steps": trainer.steps, "seconds": round(seconds, 1), "psnr": round(psnr, 2), "every_pixel": every}
        history.append(row)


def write_preview(trainer: RadianceTrainer, view: PhotoView, path: Path) -> None:
    """PNG of ``view`` as the field shows it now, beside what is true, on as many pixels as take little time."""
    import mitsuba as mi

    every = trainer.choose_pixel_stride([view], _LOOK_SAMPLES)
    seen = trainer.render(view, every)
    both = np.concatenate([np.clip(seen.color, 0, 1), view.composite_over(0)[every // 2 :: every, every // 2 :: every]], axis=1)
    write_png(path, mi.Bitmap((255 * both + 0.5).astype(np.uint8)), make_provenance("nerg train radiance").text())
