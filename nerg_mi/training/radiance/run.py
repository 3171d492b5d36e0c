"""A whole radiance training: from a data set to a checkpoint, with its held-out error on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.figures.provenance import provenance
from nerg_mi.files.png import write_png
from nerg_mi.interruption import Interruption
from nerg_mi.photos.dataset import Dataset
from nerg_mi.photos.images import View
from nerg_mi.training.common.run_state import kept_unless, load_run, save_run

from .coverage import share_beyond
from .held_out import measure
from .photo_colors import PHOTOS
from .settings import RadianceSettings
from .trainer import RadianceTrainer
from .verdict import complaints
from .warm_up import warm_up

# Shares of the run at which the held-out error is looked at.
_LOOKS = (0.05, 0.1, 0.2, 0.4, 0.6, 0.8)
_LOOK_VIEWS = 4
LOOK_GAP = 50
"""Steps at least between two looks, one of which takes as long as several."""
# Samples at most of a look and of a preview, and of the error at the end: fog has hundreds on each ray.
_LOOK_SAMPLES, _FINAL_SAMPLES = 2**20, 2**24


@dataclass(frozen=True)
class Progress:
    """State of a run. ``done``: share 0..1; ``seconds``: so far; ``psnr``: the last held-out error in dB, or None;
    ``rays``, ``samples``: of the last step."""

    done: float
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
    on_progress: Callable[[Progress], None] | None = None,
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
    so, the state of a run that is done is removed; if it raises, the state is that of the end. Without it the state
    stays.
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
    history = _resumed(trainer, state, about) if resume else []
    last = history[-1]["psnr"] if history else None
    looks = [x for x in _LOOKS if x > trainer.progress] if watched else []
    looked, saved, interrupted = history[-1]["steps"] if history else 0, trainer.seconds, False

    def keep() -> None:
        if state is not None:
            save_run(trainer, state, about, history)

    with Interruption() as stop:
        while trainer.progress < 1 and not interrupted:
            trainer.step()
            if looks and trainer.progress >= looks[0] and trainer.steps >= looked + LOOK_GAP:
                looks, looked = [x for x in looks if x > trainer.progress], trainer.steps
                last = _look(trainer, watched, history)
                if preview is not None:
                    write_preview(trainer, watched[0], preview)
            if state is not None and trainer.seconds - saved > save_every:
                keep()
                saved = trainer.seconds
            try:
                if on_progress is not None:
                    on_progress(
                        Progress(trainer.progress, trainer.steps, trainer.seconds, trainer.rays, trainer.samples, last)
                    )
                stop.check()
            except KeyboardInterrupt:
                # Only here, between two steps: elsewhere there would be weights and random numbers of different steps.
                interrupted = True
        if preview is not None and watched:
            with kept_unless(state, keep, done=False):
                write_preview(trainer, watched[0], preview)
        # One that came while the last preview was made.
        interrupted = interrupted or stop.asked
    seconds = trainer.seconds
    if interrupted:
        keep()
    with kept_unless(state, keep, done=write is not None and not interrupted):
        field, provenance = _result(trainer, dataset, watched, history, seconds, interrupted)
        if write is not None:
            write(field, provenance)
    return field, provenance


def _resumed(trainer: RadianceTrainer, state: Path | None, about: dict) -> list:
    """The history of the run in the file ``state``, which ``trainer`` then goes on with."""
    if state is None:
        raise NergError("there is nothing to resume: name the file that holds the state of the run")
    return load_run(trainer, state, about)


def _result(
    trainer: RadianceTrainer, dataset: Dataset, watched: list[View], history: list, seconds: float, interrupted: bool
) -> tuple[RadianceField, dict]:
    """The field that the run has come to, and its provenance with the error on all held-out views."""
    field = trainer.field()
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
        provenance["photo_stops"] = round(trainer.photos.stops(trainer.averaged[PHOTOS]), 3)
    if dataset.held_out:
        every = trainer.pixels_within(dataset.held_out, _FINAL_SAMPLES)
        error = measure(trainer, dataset.held_out, every, field)
        provenance["psnr_held_out"] = {
            "mean": round(error.mean, 3),
            "mean_fitted": round(error.mean_fitted, 3),
            "every_pixel": every,
            "views": {v.name: round(p, 3) for v, p in zip(dataset.held_out, error.psnr)},
        }
        _look(trainer, watched, history, field)
        if field.box.contracted:
            every = trainer.pixels_within(watched, _LOOK_SAMPLES)
            beyond = share_beyond(watched, lambda view: trainer.render(view, every, field), field.box.core, every)
            provenance["beyond_box"] = round(beyond, 4)
    provenance["psnr_watched"] = {"views": [v.name for v in watched], "history": history}
    minutes = trainer.settings.minutes
    provenance["complaints"] = complaints(history, trainer.steps, trainer.stride, minutes, seconds)
    return field, provenance


def _look(trainer: RadianceTrainer, watched: list[View], history: list, field: RadianceField | None = None) -> float:
    """The error on the ``watched`` views, added to ``history``: every so many pixels, as many as take little time."""
    every, seconds = trainer.pixels_within(watched, _LOOK_SAMPLES), trainer.seconds
    psnr = measure(trainer, watched, every, field).mean
    history.append({"steps": trainer.steps, "seconds": round(seconds, 1), "psnr": round(psnr, 2), "every_pixel": every})
    return psnr


def write_preview(trainer: RadianceTrainer, view: View, path: Path) -> None:
    """PNG of ``view`` as the field shows it now, beside what is true, on as many pixels as take little time."""
    import mitsuba as mi

    every = trainer.pixels_within([view], _LOOK_SAMPLES)
    seen = trainer.render(view, every)
    both = np.concatenate([np.clip(seen.color, 0, 1), view.over(0)[every // 2 :: every, every // 2 :: every]], axis=1)
    write_png(path, mi.Bitmap((255 * both + 0.5).astype(np.uint8)), provenance("nerg train radiance").text())
