"""A whole gaze training: from rays and a place to a field, with its scores at positions that it was not trained on."""
from __future__ import annotations

import time
from dataclasses import dataclass
from types import ModuleType
from typing import Callable

import numpy as np

from ..attention.rays import Rays
from ..attention.splits import purge, split_by_person, split_by_position
from ..field.box import Box
from ..field.gaze import GazeConfig, GazeField
from ..field.log_gaze import LogGazeConfig, LogGazeField
from ..transport.media import Similarity
from .gaze import GazeTrainer, Scores
from .gaze_likelihood import LikelihoodTrainer
from .gaze_settings import GazeSettings, ProbeSettings
from .gaze_supervision import Supervision, supervise_rays


@dataclass(frozen=True)
class GazeProgress:
    """State of a run. ``stage``: ``probes``, ``fit`` or ``refit``; ``done``: share 0..1 of the stage; ``scores``: the
    last validation, or None."""

    stage: str
    done: float
    steps: int
    seconds: float
    scores: Scores | None


@dataclass
class _Fit:
    """What a fit came to: the best weights, after how many of how many scheduled steps, and how it went."""

    trainer: GazeTrainer
    weights: dict
    best_step: int
    schedule: int
    scores: Scores | None
    history: list
    interrupted: bool


def hold_out(rays: Rays, radius: float, zones: int, positions: int, seed: int = 0, min_rays: int = 64,
             people: float = 0.0) -> tuple[Rays, dict]:
    """Rays to train on, when ``positions`` test positions in ``zones`` zones are held out; and an account of it (JSON).

    Every ray within 2 ``radius`` metres of a test position is left out (``attention.splits``), so that no probe of
    training comes within ``radius`` of one. With a share of ``people`` these are left out everywhere, and the test positions
    are theirs. The account holds the test ``centres`` in the rays' frame, and the names of the ``people`` left out.
    """
    known, names = np.ones(len(rays), bool), []
    looked_at = rays
    if people:
        known, unseen = split_by_person(rays, test_share=people, seed=seed)
        names = [rays.persons[i] for i in np.unique(rays.person[unseen])]
        looked_at = rays.select(unseen)
    split = split_by_position(looked_at, radius, zones=zones, test_probes=positions, min_rays=min_rays, seed=seed)
    train = known & purge(rays, split.test_centres, 2 * radius)
    account = {
        "centres": split.test_centres.round(6).tolist(), "zone": split.zone.tolist(), "radius": radius,
        "purged_within": 2 * radius, "seed": seed, "rays": len(rays), "rays_to_train": int(train.sum()),
        "rays_near_tests": int(split.test.sum()), "people": names,
    }  # fmt: skip
    return rays.select(train), account


def train_gaze(
    rays: Rays, medium, box: Box, config: GazeConfig | LogGazeConfig, settings: GazeSettings, probes: ProbeSettings, ns: ModuleType,
    align: Similarity | None = None, on_progress: Callable[[GazeProgress], None] | None = None, initial: dict | None = None,
) -> tuple[GazeField | LogGazeField, dict]:
    """Train a gaze field on ``rays`` in a place; returns it and its provenance (JSON).

    ``medium``: what depths are traced in; ``box``: where the gaze field lives; both in the field's frame, into which the
    similarity ``align`` takes the rays. Some zones of positions are held out, purged by 2R, and watched: the weights that
    score best there count (the loss that is trained), and the run ends when they get no better. With ``settings.refit`` a
    second fit then uses all rays for as many steps; the scores stay those of the first. Ctrl-C ends the run early with
    what it has come to. ``initial``: arrays to begin with (``gaze_semantics.trunk_of``). Raises ``ValueError`` when the
    rays make no probe.
    """
    say = on_progress or (lambda state: None)
    started = time.perf_counter()
    say(GazeProgress("probes", 0.0, 0, 0.0, None))
    learn, watched, held = rays, None, 0
    if settings.zones:
        split = split_by_position(rays, probes.radius, zones=settings.zones, test_probes=settings.watched,
                                  min_rays=settings.watched_rays or probes.min_rays, seed=settings.seed + 1)
        learn, held = rays.select(split.train), int((~split.train).sum())
        # With all rays around them: what is scored is what people there really looked at.
        watched = supervise_rays(rays, medium, box, probes, align, split.test_centres, settings.seed + 2, config.semantic, config)
    supervision = supervise_rays(learn, medium, box, probes, align, seed=settings.seed, semantic=config.semantic, config=config)
    prepared = time.perf_counter() - started

    refit = settings.refit and watched is not None
    fit = _fit(supervision, watched, box, config, settings, ns, say, 0.5 if refit else 1.0, initial)
    first, last, used = fit, fit, supervision
    if refit and not fit.interrupted:
        used = supervise_rays(rays, medium, box, probes, align, seed=settings.seed, semantic=config.semantic, config=config)
        last = _refit(used, box, config, settings, ns, say, first, initial)
    field = last.trainer.field(last.weights)
    provenance = {
        "settings": settings.to_dict(),
        "probes": probes.to_dict(),
        "align": None if align is None or align.identity else align.matrix.tolist(),
        "rays": len(rays),
        "probes_made": len(used.truth),
        "escaped_directions": round(used.escape_share, 6),
        "escaped_gaze": round(used.escaped_gaze, 6),
        "steps": last.trainer.steps,
        "seconds": round(time.perf_counter() - started, 1),
        "seconds_preparing": round(prepared, 1),
        "refitted": last is not first,
        "interrupted": first.interrupted or last.interrupted,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    if watched is not None:
        provenance["validation"] = {
            "zones": settings.zones, "probes": len(watched.truth), "rays_held_out": held, "best_step": first.best_step,
            **_rounded(first.scores), "history": first.history,
        }  # fmt: skip
    return field, provenance


def trainer_of(config) -> type[GazeTrainer]:
    """The kind of trainer that a gaze field of this configuration has."""
    return LikelihoodTrainer if isinstance(config, LogGazeConfig) else GazeTrainer


def _fit(supervision: Supervision, watched: Supervision | None, box, config, settings, ns, say, share: float, initial) -> _Fit:
    """Train until the schedule ends, or validation has not improved for ``patience`` looks. ``share``: of the minutes."""
    timed = settings.minutes is not None
    if timed:
        settings = _with(settings, minutes=settings.minutes * share)
    trainer = trainer_of(config)(supervision, box, config, settings, ns, initial=initial)
    out = _Fit(trainer, {}, 0, settings.steps or 0, None, [], False)
    looks, since, recent = np.arange(1, settings.looks + 1) / settings.looks, 0, None
    next_look = 0
    try:
        while trainer.progress < 1 and not (settings.patience and since >= settings.patience):
            trainer.step()
            if watched is not None and trainer.progress >= looks[next_look]:
                next_look = min(int(np.searchsorted(looks, trainer.progress, "right")), len(looks) - 1)
                recent = trainer.measure(watched)
                out.history.append({"steps": trainer.steps, **_rounded(recent)})
                since += 1
                if out.scores is None or recent.loss < out.scores.loss:
                    out.weights, out.best_step, out.scores, since = trainer.weights(), trainer.steps, recent, 0
            say(GazeProgress("fit", trainer.progress, trainer.steps, trainer.seconds, recent))
    except KeyboardInterrupt:
        out.interrupted = True
    if watched is not None and out.scores is None and trainer.steps:
        out.scores, out.best_step, out.weights = trainer.measure(watched), trainer.steps, trainer.weights()
    if not out.weights:
        out.weights, out.best_step = trainer.weights(), trainer.steps
    if timed:
        # What the clock's schedule came to in steps, so that a second fit can follow the same one.
        out.schedule = max(trainer.steps, round(trainer.steps / max(trainer.progress, 1e-6)))
    return out


def _refit(supervision: Supervision, box, config, settings, ns, say, first: _Fit, initial) -> _Fit:
    """As many steps as were best, along the same schedule."""
    trainer = trainer_of(config)(supervision, box, config, _with(settings, steps=first.best_step, minutes=None), ns, first.schedule, initial)
    interrupted = False
    try:
        while trainer.steps < first.best_step:
            trainer.step()
            say(GazeProgress("refit", trainer.steps / first.best_step, trainer.steps, trainer.seconds, first.scores))
    except KeyboardInterrupt:
        interrupted = True
    return _Fit(trainer, trainer.weights(), trainer.steps, first.schedule, first.scores, [], interrupted)


def _with(settings: GazeSettings, **values) -> GazeSettings:
    from dataclasses import replace

    return replace(settings, **values)


def _rounded(scores: Scores) -> dict:
    return {k: round(float(v), 5) for k, v in scores._asdict().items()}
