"""Which of several architectures a place gets, by the folds that choose its share of the blind density.

Where no surfaces are known, emit is told of points at one distance whatever is there. In some places it tells where
others look from elsewhere all the same, in others it follows whom it has seen: those who are held out tell which.
"""

from __future__ import annotations

import json
from dataclasses import replace
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeFieldConfig
from nerg_mi.training.geometry.places import GazePlace

from .fit import GazeProgress, Listener
from .mixing import SHARES, JudgedFolds, MixChoice, judge_folds, mixes, nearly_best
from .plan import GazePlan
from .supervision import Supervision

CHOICE = "choice"
"""Entry of what a run must agree on (``GazePlan.identity``): what was chosen before it began."""


def choose_variant(
    supervision: Supervision,
    place: GazePlace,
    plan: GazePlan,
    ns: ModuleType,
    tell: Listener = lambda progress: None,
    kept: dict | None = None,
) -> tuple[GazePlan, MixChoice | None]:
    """``plan`` with one architecture, and the share of the blind density where folds have chosen both.

    That of `GazePlan.config` stays, unless one of the ``alternatives`` foretells those who are held out better by half
    a standard error over folds, each with its own share. Without alternatives, rays or folds nothing is chosen.
    ``kept``: what a run that is gone on with has been started as; its choice stands. ``tell``: is told how it goes.
    Raises ``KeyboardInterrupt`` after Ctrl-C, or where ``tell`` does.
    """
    configs, plan = (plan.config, *plan.alternatives), replace(plan, alternatives=())
    if len(configs) == 1 or not mixes(plan) or supervision.rays is None:
        return plan, None
    if kept is not None:
        return _kept(plan, configs, kept)
    each, judging = [], plan
    if plan.settings.minutes is not None:
        judging = plan.with_settings(minutes=plan.settings.minutes / len(configs))
    try:
        for k, config in enumerate(configs):
            told = _of_variant(tell, config, k, len(configs))
            each.append(judge_folds(supervision, place, replace(judging, config=config), ns, told))
    except KeyboardInterrupt as error:
        names = " and ".join(config.variant for config in configs)
        raise KeyboardInterrupt(f"interrupted while folds chose between {names}; nothing was kept") from error
    return _best(plan, configs, each)


def _kept(plan: GazePlan, configs: tuple[GazeFieldConfig, ...], kept: dict) -> tuple[GazePlan, MixChoice | None]:
    """What was chosen among ``configs``; that of another run is found out when the two are compared."""
    started = [c for c in configs if json.loads(json.dumps(c.to_dict())) == kept.get("architecture")]
    plan = replace(plan, config=started[0]) if started else plan
    if CHOICE not in kept:
        return plan, None
    try:
        return plan, MixChoice.of(kept[CHOICE])
    except (TypeError, ValueError) as error:
        raise NergError(f"what the run had chosen is damaged ({error}); start anew without --resume") from error


def _best(
    plan: GazePlan, configs: tuple[GazeFieldConfig, ...], each: list[JudgedFolds]
) -> tuple[GazePlan, MixChoice | None]:
    """The plan with the best of ``configs``, which were judged as ``each`` says, and its share."""
    choices = [judged.choose() for judged in each]
    # Folds end early for a field that needs none of the blind density.
    folds = min(len(judged.curves) for judged in each)
    if not folds:
        return plan, choices[0]
    shares = [int(np.abs(SHARES - choice.mix).argmin()) for choice in choices]
    curves = np.stack([judged.curves[:folds, s] for judged, s in zip(each, shares)], axis=1)
    k = int(nearly_best(curves)[0])
    variants = {config.variant: float(kld) for config, kld in zip(configs, curves.mean(axis=0))}
    return replace(plan, config=configs[k]), replace(choices[k], variant=configs[k].variant, variants=variants)


def _of_variant(tell: Listener, config: GazeFieldConfig, k: int, count: int) -> Listener:
    """Tells how the folds of ``config``, number ``k`` of ``count``, go."""

    def told(progress: GazeProgress) -> None:
        done = (k + progress.done) / count
        tell(replace(progress, stage=f"{progress.stage} of {config.variant}", done=done))

    return told
