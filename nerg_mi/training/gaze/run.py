"""A whole gaze training: from rays and a place to a field, with its scores at positions that it was not trained on."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.capture.salience.views import SalienceView
from nerg_mi.field.gaze.log_density import LogGazeConfig, LogGazeField
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.field.gaze.support import RaySupport
from nerg_mi.interruption import Interruption
from nerg_mi.maths.box import Box
from nerg_mi.maths.similarity import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.splits import purge, split_by_person, split_by_position
from nerg_mi.training.common.run_state import kept_unless

from .likelihood import LikelihoodTrainer
from .salience import digest_views, far_views, split_views, supervise_both
from .settings import GazeSettings, ProbeSettings
from .state import GazeRunFile, digest
from .supervision import Supervision
from .trainer import GazeTrainer, Scores


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
    """What a fit came to: the best weights, after how many of how many scheduled steps, and how it went. ``since``:
    looks without an improvement; ``next_look``: which is due."""

    trainer: GazeTrainer | None
    weights: dict = field(default_factory=dict)
    best_step: int = 0
    schedule: int = 0
    scores: Scores | None = None
    history: list = field(default_factory=list)
    interrupted: bool = False
    since: int = 0
    next_look: int = 0

    def found(self) -> dict:
        """What a resumed run needs to know besides arrays (JSON)."""
        scores = None if self.scores is None else [float(v) for v in self.scores]
        return {
            **{k: getattr(self, k) for k in ("best_step", "schedule", "history", "since", "next_look")},
            "scores": scores,
        }

    @staticmethod
    def of(found: dict, trainer=None, weights: dict | None = None) -> _Fit:
        scores = found.get("scores")
        return _Fit(trainer, weights or {}, **{**found, "scores": None if scores is None else Scores(*scores)})


def hold_out(
    rays: Rays, radius: float, zones: int, positions: int, seed: int = 0, min_rays: int = 64, people: float = 0.0
) -> tuple[Rays, dict]:
    """Rays to train on, when ``positions`` test positions in ``zones`` zones are held out; and an account of it (JSON).

    Every ray within 2 ``radius`` metres of a test position is left out (``rays.splits``), so that no probe of
    training comes within ``radius`` of one. With a share of ``people`` these are left out everywhere, and the test
    positions are theirs. The account holds the test ``centres`` in the rays' frame, and the names of the ``people``
    left out.
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
        "centres": split.test_centres.round(6).tolist(),
        "zone": split.zone.tolist(),
        "radius": radius,
        "purged_within": 2 * radius,
        "seed": seed,
        "rays": len(rays),
        "rays_to_train": int(train.sum()),
        "rays_near_tests": int(split.test.sum()),
        "people": names,
    }
    return rays.select(train), account


def train_gaze(
    rays: Rays | None,
    medium,
    box: Box,
    config: GazeConfig | LogGazeConfig,
    settings: GazeSettings,
    probes: ProbeSettings,
    ns: ModuleType,
    align: Similarity | None = None,
    on_progress: Callable[[GazeProgress], None] | None = None,
    initial: dict | None = None,
    *,
    state: Path | None = None,
    resume: bool = False,
    save_every: float = 60.0,
    about: dict | None = None,
    views: list[SalienceView] | tuple = (),
    write: Callable[[GazeField | LogGazeField, dict], None] | None = None,
) -> tuple[GazeField | LogGazeField, dict]:
    """Train a gaze field on ``rays`` in a place; returns it and its provenance (JSON).

    ``medium``: what depths are traced in; ``box``: where the gaze field lives; both in the field's frame, into which
    the similarity ``align`` takes the rays. Some zones of positions are held out, purged by 2R, and watched: the
    weights that score best there count (the loss that is trained), and the run ends when they get no better. With
    ``settings.refit`` a second fit then uses all rays for as many steps; the scores stay those of the first. Ctrl-C
    ends the run after the step at hand, with what it has come to. ``initial``: arrays to begin with
    (``gaze_semantics.trunk_of``). Raises ``ValueError`` when the rays make no probe.

    ``state``: file that holds the whole state of the run, written every ``save_every`` seconds and when the run is
    interrupted; ``resume``: go on from there (probes and depths are made again). ``about``: what else the run must
    agree on to be resumed (JSON), such as the files of the place. ``write``: given the result, which it puts into a
    file. Once it has done so, the state of a run that is done is removed; if it raises, the state is that of the end.
    Without it the state stays.

    ``views``: salience images, in the field's frame, to learn from besides the rays, or without any (``rays`` None);
    zones of views are watched then. No view within 2R of a position that is watched is learnt from in the first fit.
    """
    say = on_progress or (lambda state: None)
    started = time.perf_counter()
    same = identity(rays, views, settings, probes, config, box, align, about)
    file = GazeRunFile(state, same, save_every, resume)
    say(GazeProgress("probes", 0.0, 0, 0.0, None))
    learn, seen, watched, held = rays, views, None, 0
    supervised = lambda rays, views, seed, queries=None: supervise_both(
        rays, views, medium, box, probes, align, queries, seed, config.semantic, config
    )
    if settings.zones and rays is None:
        seen, some = split_views(views, settings.zones, 2 * probes.radius, settings.seed + 1)
        watched = supervised(None, some, settings.seed + 2)
    elif settings.zones:
        split = split_by_position(
            rays,
            probes.radius,
            zones=settings.zones,
            test_probes=settings.watched,
            min_rays=settings.watched_rays or probes.min_rays,
            seed=settings.seed + 1,
        )
        learn, held = rays.select(split.train), int((~split.train).sum())
        # With all rays around them: what is scored is what people there really looked at.
        watched = supervised(rays, (), settings.seed + 2, split.test_centres)
        seen = far_views(views, split.test_centres, 2 * probes.radius, align)
    refit = settings.refit and watched is not None
    prepared, used = 0.0, None
    if file.stage == "refit":
        first = last = _Fit.of(file.found)
    else:
        used = supervised(learn, seen, settings.seed)
        prepared = time.perf_counter() - started
        first = last = _fit(used, watched, box, config, settings, ns, say, 0.5 if refit else 1.0, initial, file)
    if refit and not first.interrupted:
        if file.stage != "refit":
            file.keep("refit", None, first.found(), {}, now=True)
        used = supervised(rays, views, settings.seed)
        last = _refit(used, box, config, settings, ns, say, first, initial, file)
    result = last.trainer.field(last.weights)
    if rays is not None:
        result.support = support_of(learn if last is first else rays, probes.radius, align)
    interrupted = first.interrupted or last.interrupted
    provenance = {
        "settings": settings.to_dict(),
        "probes": probes.to_dict(),
        "align": None if align is None or align.identity else align.matrix.tolist(),
        "rays": 0 if rays is None else len(rays),
        "salience_views": len(views),
        "probes_made": len(used.truth),
        "escaped_directions": round(used.escape_share, 6),
        "escaped_gaze": round(used.escaped_gaze, 6),
        "steps": last.trainer.steps,
        "seconds": round(file.spent, 1),
        "seconds_preparing": round(prepared, 1),
        "refitted": last is not first,
        "interrupted": interrupted,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    if watched is not None:
        provenance["validation"] = {
            "zones": settings.zones,
            "probes": len(watched.truth),
            "rays_held_out": held,
            "views_held_out": len(views) - len(seen),
            "best_step": first.best_step,
            **_rounded(first.scores),
            "history": first.history,
        }
    if write is not None:
        stage, weights = ("fit", last.weights) if last is first else ("refit", {})
        keep = lambda: file.keep(stage, last.trainer, first.found(), weights, now=True)
        with kept_unless(state, keep, done=not interrupted):
            write(result, provenance)
    return result, provenance


def identity(
    rays: Rays | None,
    views,
    settings: GazeSettings,
    probes: ProbeSettings,
    config,
    box: Box,
    align: Similarity | None,
    about: dict | None,
) -> dict:
    """What a run must agree on to be resumed (JSON): of two runs that differ in any of it, neither goes on with the
    other's state."""
    return {
        **(about or {}),
        "rays": None if rays is None else digest(rays),
        "views": digest_views(views),
        "settings": settings.to_dict(),
        "probes": probes.to_dict(),
        "architecture": config.to_dict(),
        "box": box.to_dict(),
        "align": None if align is None else align.matrix.tolist(),
    }


def support_of(rays: Rays, radius: float, align: Similarity | None = None) -> RaySupport:
    """How many of ``rays`` there are around a position, in the field's frame, for probes of ``radius`` metres."""
    align = align or Similarity()
    return RaySupport.of(rays.origin @ align.matrix[:3, :3].T + align.matrix[:3, 3], radius * align.scale)


def trainer_of(config) -> type[GazeTrainer]:
    """The kind of trainer that a gaze field of this configuration has."""
    return LikelihoodTrainer if isinstance(config, LogGazeConfig) else GazeTrainer


def _fit(
    supervision: Supervision,
    watched: Supervision | None,
    box,
    config,
    settings,
    ns,
    say,
    share: float,
    initial,
    file: GazeRunFile,
) -> _Fit:
    """Train until the schedule ends, or validation has not improved for ``patience`` looks. ``share``: of the
    minutes."""
    timed = settings.minutes is not None
    if timed:
        settings = replace(settings, minutes=settings.minutes * share)
    trainer = trainer_of(config)(supervision, box, config, settings, ns, initial=initial)
    out = _Fit.of(file.found, trainer, file.restore("fit", trainer))
    out.schedule = settings.steps or 0
    looks, recent = np.arange(1, settings.looks + 1) / settings.looks, out.scores
    with Interruption() as stop:
        while (
            trainer.progress < 1 and not out.interrupted and not (settings.patience and out.since >= settings.patience)
        ):
            trainer.step()
            if watched is not None and trainer.progress >= looks[out.next_look]:
                out.next_look = min(int(np.searchsorted(looks, trainer.progress, "right")), len(looks) - 1)
                recent = trainer.measure(watched)
                out.history.append({"steps": trainer.steps, **_rounded(recent)})
                out.since += 1
                if out.scores is None or np.isnan(out.scores.loss) or recent.loss < out.scores.loss:
                    out.weights, out.best_step, out.scores, out.since = trainer.weights(), trainer.steps, recent, 0
            file.keep("fit", trainer, out.found(), out.weights)
            out.interrupted = _stopped(
                stop, say, GazeProgress("fit", trainer.progress, trainer.steps, trainer.seconds, recent)
            )
    if out.interrupted:
        file.keep("fit", trainer, out.found(), out.weights, now=True)
    if watched is not None and out.scores is None and trainer.steps:
        out.scores, out.best_step, out.weights = trainer.measure(watched), trainer.steps, trainer.weights()
    if not out.weights:
        out.weights, out.best_step = trainer.weights(), trainer.steps
    if timed:
        # What the clock's schedule came to in steps, so that a second fit can follow the same one.
        out.schedule = max(trainer.steps, round(trainer.steps / max(trainer.progress, 1e-6)))
    return out


def _refit(supervision: Supervision, box, config, settings, ns, say, first: _Fit, initial, file: GazeRunFile) -> _Fit:
    """As many steps as were best, along the same schedule."""
    trainer = trainer_of(config)(
        supervision, box, config, replace(settings, steps=first.best_step, minutes=None), ns, first.schedule, initial
    )
    file.restore("refit", trainer)
    interrupted = False
    with Interruption() as stop:
        while trainer.steps < first.best_step and not interrupted:
            trainer.step()
            file.keep("refit", trainer, first.found(), {})
            interrupted = _stopped(
                stop,
                say,
                GazeProgress("refit", trainer.steps / first.best_step, trainer.steps, trainer.seconds, first.scores),
            )
    if interrupted:
        file.keep("refit", trainer, first.found(), {}, now=True)
    return _Fit(trainer, trainer.weights(), trainer.steps, first.schedule, first.scores, [], interrupted)


def _stopped(stop: Interruption, say: Callable, progress: GazeProgress) -> bool:
    """Tell ``progress``; whether there was a Ctrl-C. Heard only here: within a step, weights and random numbers are of
    different steps."""
    try:
        say(progress)
        stop.check()
    except KeyboardInterrupt:
        return True
    return False


def _rounded(scores: Scores) -> dict:
    return {k: round(float(v), 5) for k, v in scores._asdict().items()}
