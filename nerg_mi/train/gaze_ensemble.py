"""Ensembles of gaze fields, whose spread says how far a prediction is to be trusted."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField, GazeEnsemble, GazeHead, summarize_provenance
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.photos.salience import SalienceView
from nerg_mi.rays.rays import Rays

from .gaze_data import Supervision
from .gaze_run import SELECTION_KEY, FOLD_TIME_FRACTION, select_variant, evaluate_folds, selects_prior_weight, scale_progress, train_gaze
from .gaze_settings import GazeSettings
from .gaze_trainer import KIND as RUN
from .gaze_trainer import GazePlan, ProgressCallback, StateSettings, read_run_identity
from .geometry import TrainingGeometry
from .trainer import saving_on_failure, check_same_run

MIN_BLOCKS = 5  # Blocks that a resample needs at least; people are the blocks where there are as many of them
BLOCK_SECONDS = 30.0  # Seconds of a block where there are too few people
VIEWS = "views"


def assign_blocks(rays: Rays) -> tuple[np.ndarray, str]:
    """The block (N,) that each ray is resampled with, and what the blocks are: ``people``, or ``blocks of 30 s``.

    Raises ``NergError`` where there are too few of either.
    """
    persons, block = np.unique(rays.person, return_inverse=True)
    if len(persons) >= MIN_BLOCKS:
        return block, "people"
    first = np.array([rays.t[block == i].min() for i in range(len(persons))])
    stretch = np.floor((rays.t - first[block]) / BLOCK_SECONDS).astype(np.int64)
    _, block = np.unique(np.stack([block, stretch]), axis=1, return_inverse=True)
    if block.max() + 1 < MIN_BLOCKS:
        raise NergError(
            f"{block.max() + 1} stretches of {BLOCK_SECONDS:g} s of {len(persons)} people are too few to resample; "
            "leave out --ensemble"
        )
    return block.ravel(), f"blocks of {BLOCK_SECONDS:g} s"


def resample_rays(rays: Rays, seed: int | tuple[int, int]) -> Rays:
    """As many blocks as ``rays`` has, drawn with replacement: a block that is drawn twice counts twice (Efron 1979).

    A person who is drawn twice is two people then, so that weights by person count both.
    """
    block, kind = assign_blocks(rays)
    count = block.max() + 1
    times = np.bincount(np.random.default_rng(seed).integers(0, count, count), minlength=count)[block]
    index = np.repeat(np.arange(len(rays)), times)
    drawn = rays.select(index)
    if kind != "people":
        return drawn
    again, known = np.arange(len(index)) - np.repeat(np.cumsum(times) - times, times), len(rays.persons)
    names = [*rays.persons, *(f"{name} ({k + 2})" for k in range(again.max()) for name in rays.persons)]
    return replace(drawn, person=drawn.person + known * again, persons=tuple(names))


def resample_views(views: tuple[SalienceView, ...], seed: int | tuple[int, int]) -> tuple[SalienceView, ...]:
    """As many views as ``views`` has, drawn with replacement. Raises ``NergError`` for fewer than five."""
    if len(views) < MIN_BLOCKS:
        raise NergError(f"{len(views)} salience images are too few to resample; leave out --ensemble")
    return tuple(views[k] for k in np.random.default_rng(seed).integers(0, len(views), len(views)))


class TrainedEnsemble(NamedTuple):
    """What the training of an ensemble came to: the fields, and their provenance (JSON)."""

    field: GazeEnsemble
    provenance: dict


def train_ensemble(
    members: int,
    supervision: Supervision,
    geometry: TrainingGeometry,
    plan: GazePlan,
    ns: ModuleType,
    *,
    state: StateSettings | None = None,
    on_progress: ProgressCallback | None = None,
    write: Callable[[GazeEnsemble, dict], None] | None = None,
) -> TrainedEnsemble:
    """Train ``members`` gaze fields as ``gaze_run.train_gaze`` does, each on a resample of the rays and the views and
    with a seed of its own.

    Minutes are those of all members together. With a file in ``state``, what is done is kept beside it, one file a
    member, and removed once ``write`` has put the ensemble into a file; without ``write`` the members stay. Raises
    `NergError` for what cannot be resampled, and `KeyboardInterrupt`, which says how to go on, where it is interrupted.
    """
    state = state or StateSettings()
    kind, path = _kind(members, supervision, plan), state.path
    # Folds of resamples would have a person on both sides: the share of the blind density is chosen once, on the rays.
    mixed = selects_prior_weight(plan) and supervision.rays is not None
    parts = [path and path.with_name(f"{path.stem}.member{k}.safetensors") for k in range(members)]
    is_file = lambda file: file is not None and file.is_file()
    if state.resume and not any(map(is_file, (path, *parts))):
        raise NergError(f'there is nothing to resume: "{path}" does not exist; leave out --resume to start')
    on_progress = on_progress or (lambda progress: None)
    plan, choice = select_variant(supervision, geometry, plan, ns, on_progress, _kept(state, parts, ns))
    if choice is not None:
        state = replace(state, identity={**state.identity, SELECTION_KEY: choice.to_dict()})
    whole, plan = plan, plan.with_settings(mix_folds=0)
    if plan.settings.minutes is not None:
        share = 1 - FOLD_TIME_FRACTION if mixed else 1.0
        plan = plan.with_settings(minutes=share * plan.settings.minutes / members)
    fields, each = [], []
    for k, part in enumerate(parts):
        own = replace(state, identity={**state.identity, "member": [k, members]})
        member_plan = plan.with_settings(seed=plan.settings.seed + 100 * k)
        # All that a state of the run compares, of the rays that the resamples are drawn from.
        identity = member_plan.make_identity(supervision, geometry, own)
        if state.resume and part is not None and part.is_file():
            field, provenance = _finished(part, identity, own, ns)
        else:
            field, provenance = train_gaze(
                _resampled(supervision, (plan.settings.seed, k)),
                geometry,
                member_plan,
                ns,
                state=replace(own, resume=state.resume and is_file(path)),
                on_progress=scale_progress(on_progress, k, members, f"{k + 1}/{members} {{}}"),
                write=None if part is None else _writer(part, identity),
            )
            if provenance["interrupted"]:
                kept = "nothing was kept" if path is None else f"go on with --resume (state in {path})"
                raise KeyboardInterrupt(f"interrupted while training member {k + 1} of {members}; {kept}")
        fields.append(field)
        each.append(provenance)
    if mixed and choice is None:
        choice = evaluate_folds(supervision, geometry, whole, ns, on_progress).select_weight()
    if choice is not None:
        for field in fields:
            field.set_prior_weight(choice.mix)
    ensemble = GazeEnsemble(fields, supervision.make_support(plan.probes.radius, geometry))
    ensemble.basis = summarize_provenance(supervision.count_data())
    provenance = _account(each, plan.settings, supervision, kind) | ({"mix": choice.to_dict()} if choice else {})
    if write is not None:
        # Every member is in its file by now: there is nothing more to keep if this fails.
        with saving_on_failure(path, lambda: None, is_done=False):
            write(ensemble, provenance)
        for part in parts:
            if part is not None:
                part.unlink(missing_ok=True)
    return TrainedEnsemble(ensemble, provenance)


def _kept(state: StateSettings, parts: list[Path | None], ns: ModuleType) -> dict | None:
    """What an ensemble that is gone on with has been started as, by the first of its files; None for a new one."""
    if not state.resume or (state.path is not None and state.path.is_file()):
        return read_run_identity(state)
    return next((load_gaze(p, ns)[1]["provenance"]["about"] for p in parts if p is not None and p.is_file()), None)


def _kind(members: int, supervision: Supervision, plan: GazePlan) -> str:
    """What is drawn together. Raises `NergError` for what cannot be resampled."""
    if members < 2:
        raise NergError(f"an ensemble needs at least two members, got {members}")
    if supervision.rays is None:
        return VIEWS
    if plan.probes.kappa_rule == "loo":
        raise NergError(
            'an ensemble draws people twice, who would predict themselves; choose the kappa rule "fixed" or "silverman"'
        )
    _, kind = assign_blocks(supervision.rays)
    return f"{kind} and {VIEWS}" if supervision.views else kind


def _resampled(supervision: Supervision, seed: tuple[int, int]) -> Supervision:
    """What a member is trained on."""
    rays, views = supervision.rays, supervision.views
    return Supervision(None if rays is None else resample_rays(rays, seed), resample_views(views, seed) if views else ())


def _finished(part: Path, identity: dict, state: StateSettings, ns: ModuleType) -> tuple[AnyGazeField, dict]:
    """A member that an earlier process has finished, and its provenance. Raises `NergError` for one of another run."""
    field, meta = load_gaze(part, ns)
    kept = meta["provenance"]
    check_same_run(part, kept["about"], identity)
    run = state.path
    if (
        run is not None
        and run.is_file()
        and read_checkpoint(run, RUN)[1]["about"].get("member") == state.identity["member"]
    ):
        run.unlink()  # Killed between the writing of the member and the removal of its state
    return field, kept["trained"]


def _writer(part: Path, identity: dict) -> Callable[[GazeHead, dict], None]:
    """Writes a member into ``part``; one that was interrupted has its state, and is none yet."""

    def write(field: GazeHead, provenance: dict) -> None:
        if not provenance["interrupted"]:
            save_gaze(field, part, {"trained": provenance, "about": identity})

    return write


def _account(each: list[dict], settings: GazeSettings, supervision: Supervision, kind: str) -> dict:
    """One account of all members: means of their scores, sums of their seconds."""
    total = lambda name: round(sum(d[name] for d in each), 1)
    mean = lambda name: round(float(np.mean([d[name] for d in each])), 6)
    out = {
        **each[0],
        "settings": settings.to_dict(),
        **supervision.count_data(),
        "probes_made": round(mean("probes_made")),
        **{k: mean(k) for k in ("escaped_directions", "escaped_gaze")},
        **{k: total(k) for k in ("steps", "seconds", "seconds_preparing")},
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "ensemble": {"members": len(each), "resampled": kind, "seeds": [d["settings"]["seed"] for d in each]},
    }
    if "validation" in out:
        scores = [d["validation"] for d in each]
        out["ensemble"]["validation"] = scores
        number = [k for k, v in scores[0].items() if isinstance(v, (int, float))]
        out["validation"] = {k: round(float(np.mean([s[k] for s in scores])), 5) for k in number}
        out["validation"]["best_step"] = round(out["validation"]["best_step"])
    return out
