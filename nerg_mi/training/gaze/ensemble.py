"""Ensembles of gaze fields: the same training on resamples of the people, whose spread says what the data does not
decide.

What repeats itself is drawn together: a person with all of their rays where there are several people, else stretches of
time of each person (block bootstrap, Künsch 1989). Single rays of one second say the same, and their resamples would
too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.gaze.ensemble import GazeEnsemble
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.rays.rays import Rays
from nerg_mi.training.common.run_state import kept_unless, require_same

from .run import GazeProgress, identity, support_of, train_gaze
from .settings import GazeSettings, ProbeSettings
from .state import KIND as RUN

FEW = 5
"""Blocks that a resample needs at least; people are the blocks where there are as many of them."""
BLOCK = 30.0
"""Seconds of a block where there are too few people."""


def blocks_of(rays: Rays) -> tuple[np.ndarray, str]:
    """The block (N,) that each ray is resampled with, and what the blocks are: ``people``, or ``blocks of 30 s``.

    Raises ``NergError`` where there are too few of either.
    """
    persons, block = np.unique(rays.person, return_inverse=True)
    if len(persons) >= FEW:
        return block, "people"
    first = np.array([rays.t[block == i].min() for i in range(len(persons))])
    stretch = np.floor((rays.t - first[block]) / BLOCK).astype(np.int64)
    _, block = np.unique(np.stack([block, stretch]), axis=1, return_inverse=True)
    if block.max() + 1 < FEW:
        raise NergError(
            f"{block.max() + 1} stretches of {BLOCK:g} s of {len(persons)} people are too few to resample; leave out --ensemble"
        )
    return block.ravel(), f"blocks of {BLOCK:g} s"


def resample(rays: Rays, seed) -> Rays:
    """As many blocks as ``rays`` has, drawn with replacement: a block that is drawn twice counts twice (Efron 1979).

    A person who is drawn twice is two people then, so that weights by person count both.
    """
    block, kind = blocks_of(rays)
    count = block.max() + 1
    times = np.bincount(np.random.default_rng(seed).integers(0, count, count), minlength=count)[block]
    index = np.repeat(np.arange(len(rays)), times)
    drawn = rays.select(index)
    if kind != "people":
        return drawn
    again, known = np.arange(len(index)) - np.repeat(np.cumsum(times) - times, times), len(rays.persons)
    names = [*rays.persons, *(f"{name} ({k + 2})" for k in range(again.max()) for name in rays.persons)]
    return replace(drawn, person=drawn.person + known * again, persons=tuple(names))


def train_ensemble(
    members: int,
    rays: Rays | None,
    medium,
    box,
    config,
    settings: GazeSettings,
    probes: ProbeSettings,
    ns,
    align=None,
    on_progress=None,
    initial: dict | None = None,
    *,
    state: Path | None = None,
    resume: bool = False,
    save_every: float = 60.0,
    about: dict | None = None,
    views: list | tuple = (),
    write: Callable[[GazeEnsemble, dict], None] | None = None,
) -> tuple[GazeEnsemble, dict]:
    """Train ``members`` gaze fields, each on a resample and with a seed of its own; returns them and their provenance
    (JSON).

    The other arguments are those of ``gaze_run.train_gaze``; minutes are those of all members together. With ``state``,
    what is done is kept beside it, one file a member, and removed once ``write`` has put the ensemble into a file;
    without it the members stay. Raises `KeyboardInterrupt`, whose message says how to go on, where it is interrupted.
    """
    if members < 2:
        raise NergError(f"an ensemble needs at least two members, got {members}")
    if rays is None or views:
        raise NergError("an ensemble resamples people: it is trained on rays alone; leave out --ensemble or --views")
    if probes.kappa_rule == "loo":
        raise NergError(
            'an ensemble draws people twice, who would predict themselves; choose the kappa rule "fixed" or "silverman"'
        )
    if settings.minutes is not None:
        settings = replace(settings, minutes=settings.minutes / members)
    _, kind = blocks_of(rays)
    parts = [
        state.with_name(f"{state.stem}.member{k}.safetensors") if state is not None else None for k in range(members)
    ]
    if resume and not (state.is_file() or any(p.is_file() for p in parts)):
        raise NergError(f'there is nothing to resume: "{state}" does not exist; leave out --resume to start')
    fields, each = [], []
    for k, part in enumerate(parts):
        mine, same = replace(settings, seed=settings.seed + 100 * k), {**(about or {}), "member": [k, members]}
        # All that a state of the run compares, of the rays that the resamples are drawn from.
        whole = identity(rays, (), mine, probes, config, box, align, same)
        say = lambda s, k=k: (
            on_progress
            and on_progress(
                GazeProgress(f"{k + 1}/{members} {s.stage}", (k + s.done) / members, s.steps, s.seconds, s.scores)
            )
        )
        if resume and part.is_file():
            field, meta = load_gaze(part, ns)
            done = meta["provenance"]
            require_same(part, done["about"], whole)
            done = done["trained"]
            if state.is_file() and read_checkpoint(state, RUN)[1]["about"].get("member") == same["member"]:
                # Killed between the writing of the member and the removal of its state.
                state.unlink()
        else:
            keep = None if part is None else _keeper(part, whole)
            field, done = train_gaze(
                resample(rays, (settings.seed, k)),
                medium,
                box,
                config,
                mine,
                probes,
                ns,
                align,
                say,
                initial,
                state=state,
                resume=resume and state.is_file(),
                save_every=save_every,
                about=same,
                write=keep,
            )
            if done["interrupted"]:
                kept = f"go on with --resume (state in {state})" if state is not None else "nothing was kept"
                raise KeyboardInterrupt(f"interrupted while training member {k + 1} of {members}; {kept}")
        fields.append(field)
        each.append(done)
    ensemble, provenance = (
        GazeEnsemble(fields, support_of(rays, probes.radius, align)),
        _together(each, settings, rays, kind),
    )
    if write is not None:
        # Every member is in its file by now: there is nothing more to keep if this fails.
        with kept_unless(state, lambda: None, done=False):
            write(ensemble, provenance)
        for part in parts:
            if part is not None:
                part.unlink(missing_ok=True)
    return ensemble, provenance


def _keeper(part: Path, about: dict):
    """Writes a member into ``part``; one that was interrupted has its state, and is none yet."""

    def keep(field, done: dict) -> None:
        if not done["interrupted"]:
            save_gaze(field, part, {"trained": done, "about": about})

    return keep


def _together(each: list[dict], settings: GazeSettings, rays: Rays, kind: str) -> dict:
    """One account of all members: means of their scores, sums of their seconds."""
    total = lambda name: round(sum(d[name] for d in each), 1)
    mean = lambda name: round(float(np.mean([d[name] for d in each])), 6)
    out = {
        **each[0],
        "settings": settings.to_dict(),
        "rays": len(rays),
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
