"""Ensembles of gaze fields. The spread of their predictions is an uncertainty estimate."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeEnsemble, GazeHead, GazeNetwork, summarize_provenance
from nerg_mi.files.schema import check_json
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.photos.salience import SalienceView
from nerg_mi.tracking.rays import Rays

from .gaze_data import Supervision
from .gaze_folds import (
    FOLD_TIME_FRACTION,
    SELECTION_KEY,
    compute_fold_cost,
    evaluate_folds,
    select_variant,
    selects_prior_weight,
)
from .gaze_recipes import GazePlan
from .gaze_run import KIND as RUN
from .gaze_run import StateSettings, fit_gaze, read_run_identity
from .gaze_settings import GazeSettings
from .gaze_trainer import ProgressCallback, StagedProgress, scale_progress
from .trainer import check_same_run, reading_run_state, saving_on_failure

MIN_BLOCKS = 5  # Minimum number of blocks for resampling; participants are the blocks if there are at least this many
BLOCK_SECONDS = 30.0  # Duration of a block in seconds, used if there are too few participants
VIEWS = "views"


def assign_blocks(rays: Rays) -> tuple[np.ndarray, str]:
    """Assign each ray to a resampling block.

    Returns the block index (N,) of each ray and the kind of block: ``people``, or ``blocks of 30 s``. Raises
    `NergError` if there are too few blocks.
    """
    persons, block = np.unique(rays.person, return_inverse=True)
    if len(persons) >= MIN_BLOCKS:
        return block, "people"
    first = np.array([rays.t[block == i].min() for i in range(len(persons))])
    stretch = np.floor((rays.t - first[block]) / BLOCK_SECONDS).astype(np.int64)
    _, block = np.unique(np.stack([block, stretch]), axis=1, return_inverse=True)
    if block.max() + 1 < MIN_BLOCKS:
        raise NergError(
            f"{block.max() + 1} blocks of {BLOCK_SECONDS:g} s of {len(persons)} participants are too few to "
            f"resample; record more data or leave out {parameter('ensemble')}"
        )
    return block.ravel(), f"blocks of {BLOCK_SECONDS:g} s"


def resample_rays(rays: Rays, seed: int | tuple[int, int]) -> Rays:
    """Draw as many blocks as ``rays`` has with replacement (bootstrap; Efron 1979).

    A participant who is drawn twice becomes two participants, so that weighting by participant counts both.
    """
    block, kind = assign_blocks(rays)
    count = block.max() + 1
    times = np.bincount(np.random.default_rng(seed).integers(0, count, count), minlength=count)[block]
    index = np.repeat(np.arange(len(rays)), times)
    drawn = rays.select(index)
    if kind != "people":
        return drawn
    repetition, num_persons = np.arange(len(index)) - np.repeat(np.cumsum(times) - times, times), len(rays.persons)
    names = [*rays.persons, *(f"{name} ({k + 2})" for k in range(repetition.max()) for name in rays.persons)]
    return replace(drawn, person=drawn.person + num_persons * repetition, persons=tuple(names))


def resample_views(views: tuple[SalienceView, ...], seed: int | tuple[int, int]) -> tuple[SalienceView, ...]:
    """Draw ``len(views)`` views with replacement. Raises `NergError` for fewer than five views."""
    if len(views) < MIN_BLOCKS:
        raise NergError(
            f"{len(views)} salience images are too few to resample; use at least {MIN_BLOCKS} or leave out "
            f"{parameter('ensemble')}"
        )
    return tuple(views[k] for k in np.random.default_rng(seed).integers(0, len(views), len(views)))


def train_ensemble(
    members: int,
    supervision: Supervision,
    geometry: Environment,
    plan: GazePlan,
    ns: ModuleType,
    *,
    state: StateSettings | None = None,
    on_progress: ProgressCallback | None = None,
    write: Callable[[GazeEnsemble, dict], None] | None = None,
) -> tuple[GazeEnsemble, dict]:
    """Train ``members`` gaze fields, each on its own bootstrap resample and with its own seed.

    Returns the ensemble and its provenance (JSON).

    Parameters
    ----------
    members : int
        Number of fields, at least 2.
    supervision, geometry, plan, ns
        As for `fit_gaze`. A time limit applies to all members together.
    state : StateSettings, optional
        Run state. With a path, each finished member is stored in its own file next to the state and removed after
        ``write`` has returned; without ``write`` the members remain.
    on_progress : ProgressCallback, optional
        Called with the progress of all members.
    write : callable, optional
        Called with the ensemble and its provenance to store them.

    Raises
    ------
    NergError
        If the data cannot be resampled.
    KeyboardInterrupt
        If the training is interrupted; the message says how to resume.
    """
    state = state or StateSettings()
    kind, path = _get_resampling_kind(members, supervision, plan), state.path
    # Folds of a resample would have the same participant on both sides. The prior weight is therefore selected once, on
    # the original rays.
    selects_weight = selects_prior_weight(plan, supervision.rays)
    parts = [path and path.with_name(f"{path.stem}.member{k}.safetensors") for k in range(members)]
    is_file = lambda file: file is not None and file.is_file()
    if state.resume and not any(map(is_file, (path, *parts))):
        raise NergError(
            f'cannot resume: the state file "{path}" does not exist; leave out {parameter("resume", True)} to '
            "start a new run"
        )
    on_progress = on_progress or (lambda progress: None)
    progress, fold_cost = StagedProgress(on_progress), compute_fold_cost(plan)
    report = progress.start(fold_cost, members)
    if state.resume and not is_file(path):
        # Between two members: what the ensemble was started with is recorded in those that are finished.
        resumed = load_gaze(next(part for part in parts if part and is_file(part)), ns)[1]["provenance"]["about"]
    else:
        resumed = read_run_identity(state)
    plan, selection = select_variant(supervision, geometry, plan, ns, report, resumed)
    if selection is not None:
        state = replace(state, identity={**state.identity, SELECTION_KEY: selection.to_dict()})
    full_plan, plan = plan, plan.with_settings(prior_folds=0)
    if plan.settings.minutes is not None:
        time_fraction = 1 - FOLD_TIME_FRACTION if selects_weight else 1.0
        plan = plan.with_settings(minutes=time_fraction * plan.settings.minutes / members)
    fields, provenances = [], []
    fold_cost = fold_cost if selects_weight and selection is None else 0.0
    report = progress.start(members, fold_cost)
    for k, part in enumerate(parts):
        member_state = replace(state, identity={**state.identity, "member": [k, members]})
        member_plan = plan.with_settings(seed=plan.settings.seed + 100 * k)
        # The identity describes the original rays, from which the resamples are drawn.
        identity = {**member_state.identity, **member_plan.make_identity(supervision, geometry)}
        if state.resume and part is not None and part.is_file():
            field, provenance = _load_member(part, identity, member_state, ns)
        else:
            rays, views, draw = supervision.rays, supervision.views, (plan.settings.seed, k)
            resampled = Supervision(
                None if rays is None else resample_rays(rays, draw), resample_views(views, draw) if views else ()
            )
            field, provenance = fit_gaze(
                resampled,
                geometry,
                member_plan,
                ns,
                state=replace(member_state, resume=state.resume and is_file(path)),
                on_progress=scale_progress(report, k, members, f"{k + 1}/{members} {{}}"),
                write=None if part is None else _make_writer(part, identity),
            )
            if provenance["interrupted"]:
                hint = (
                    "no state was saved"
                    if path is None
                    else f"resume with {parameter('resume', True)} (state in {path})"
                )
                raise KeyboardInterrupt(f"interrupted while training member {k + 1} of {members}; {hint}")
        fields.append(field)
        provenances.append(provenance)
    # Every member is already in its file, so there is nothing to save if this fails.
    with saving_on_failure(parts[0], lambda: None, is_done=False):
        if selects_weight and selection is None:
            selection = evaluate_folds(supervision, geometry, full_plan, ns, progress.start(fold_cost)).select()
        if selection is not None:
            for field in fields:
                selection.apply_prior(field, supervision.rays, geometry, plan)
        ensemble = GazeEnsemble(fields, supervision.make_support(plan.probes.radius, geometry))
        if selection is not None:
            ensemble.hits = selection.make_hits(supervision.rays, geometry, plan)
        ensemble.basis = summarize_provenance(supervision.summarize_data())
        provenance = _combine_provenances(provenances, plan.settings, supervision, kind) | (
            {"mix": selection.to_dict()} if selection else {}
        )
        if write is not None:
            write(ensemble, provenance)
    if write is not None:
        for part in parts:
            if part is not None:
                part.unlink(missing_ok=True)
    return ensemble, provenance


def _get_resampling_kind(members: int, supervision: Supervision, plan: GazePlan) -> str:
    """Return the kind of resampling block. Raises `NergError` if the data cannot be resampled."""
    if members < 2:
        raise NergError(f"an ensemble needs at least two members, got {members}")
    if supervision.rays is None:
        return VIEWS
    if plan.probes.kappa_rule == "loo":
        raise NergError(
            f'the kappa rule "loo" cannot be used with {parameter("ensemble")}, because resampled participants '
            'would predict themselves; choose "fixed" or "silverman"'
        )
    _, kind = assign_blocks(supervision.rays)
    return f"{kind} and {VIEWS}" if supervision.views else kind


def _load_member(part: Path, identity: dict, state: StateSettings, ns: ModuleType) -> tuple[GazeNetwork, dict]:
    """Load a member that an earlier process has finished, and its provenance. Raises `NergError` if it belongs to
    another run.
    """
    field, meta = load_gaze(part, ns)
    with reading_run_state(part):
        stored = check_json(meta["provenance"], {"about": dict, "trained": dict}, "provenance")
    check_same_run(part, stored["about"], identity)
    run = state.path
    if run is not None and run.is_file():
        with reading_run_state(run):
            member = read_checkpoint(run, RUN)[1]["about"].get("member")
        if member == state.identity["member"]:
            run.unlink()  # The process was killed after writing the member and before removing its state
    return field, stored["trained"]


def _make_writer(part: Path, identity: dict) -> Callable[[GazeHead, dict], None]:
    """Return a function that writes a finished member to ``part``. An interrupted member is only stored as run
    state."""

    def write(field: GazeHead, provenance: dict) -> None:
        if not provenance["interrupted"]:
            save_gaze(field, part, {"trained": provenance, "about": identity})

    return write


def _combine_provenances(provenances: list[dict], settings: GazeSettings, supervision: Supervision, kind: str) -> dict:
    """Combine the provenance of all members: mean scores and total times."""
    total = lambda name: round(sum(d[name] for d in provenances), 1)
    mean = lambda name: round(float(np.mean([d[name] for d in provenances])), 6)
    out = {
        **provenances[0],
        "settings": settings.to_dict(),
        **supervision.summarize_data(),
        "probes_made": round(mean("probes_made")),
        **{k: mean(k) for k in ("escaped_directions", "escaped_gaze")},
        **{k: total(k) for k in ("steps", "seconds", "seconds_preparing")},
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "ensemble": {
            "members": len(provenances),
            "resampled": kind,
            "seeds": [d["settings"]["seed"] for d in provenances],
        },
    }
    if "validation" in out:
        scores = [d["validation"] for d in provenances]
        out["ensemble"]["validation"] = scores
        numeric = [k for k, v in scores[0].items() if isinstance(v, (int, float))]
        out["validation"] = {k: round(float(np.mean([s[k] for s in scores])), 5) for k in numeric}
        out["validation"]["best_step"] = round(out["validation"]["best_step"])
    return out
