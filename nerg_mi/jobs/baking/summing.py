"""All parts of a bake and their sums, in this process or wherever tasks are run: the same to the bit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.interruption import Interruption
from nerg_mi.jobs.parts import Parts
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import Sums
from nerg_mi.surfaces.sources import Crowd, TrackedRays
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.task import Task

from .chunks import bake_chunk, parts_of
from .tasks import read_sums, tasks_of

_BEGIN, _END = 0.05, 0.9  # of a bake is this


def sums_in_one_go(
    scene: Any, groups: Sequence[Crowd | TrackedRays], reporter: Reporter, make: Callable[..., Sums] = bake_chunk
) -> list[Sums]:
    """The sums of each of ``groups``, of which nothing is kept. ``make``: the sums of a ``scene`` of its kind, such as
    a `BakeScene`, and of a part."""
    parts = [list(parts_of(group)) for group in groups]
    count, done, found = sum(map(len, parts)), 0, []
    with Interruption() as stop:
        for group in parts:
            sums = scene.nothing
            for part in group:
                stop.check()
                sums = sums.plus(make(scene, part))
                done += 1
                reporter.progress(_BEGIN + (_END - _BEGIN) * done / count, f"part {done} of {count}")
            found.append(sums)
    return found


def sums_in_parts(
    scene: Any,
    groups: Sequence[Crowd | TrackedRays],
    parts: Parts,
    what: str,
    plan: Callable[..., list[Task]] = tasks_of,
) -> list[Sums]:
    """The sums of each of ``groups``, whose parts are kept; ``what``: the job, as its user calls it; ``plan``: the
    tasks of a ``scene`` of its kind, of a group of them, the variant and the parts."""
    import mitsuba as mi

    tasks = [plan(scene, group, str(mi.variant()), parts) for group in groups]
    arriving = parts.run(Plan(what, [task for group in tasks for task in group]), _BEGIN, _END)
    found = []
    for group in tasks:
        sums = scene.nothing
        for _ in group:
            sums = sums.plus(read_sums(next(arriving), len(scene.nothing.face)))
        found.append(sums)
    return found


def halves_of(who: TrackedRays, rays: Rays, seed: int) -> list[Crowd | TrackedRays]:
    """``who``, which are the ``rays``, as those of two halves of the people, drawn by ``seed``."""
    people = np.unique(rays.person)
    if len(people) < 2:
        raise NergError("--halves needs two people at least, and the rays are of one")
    first = np.isin(rays.person, np.random.default_rng(seed).permutation(people)[: len(people) // 2])
    order = [np.flatnonzero(first), np.flatnonzero(~first)]
    return [
        TrackedRays(who.origins[rows], who.directions[rows], who.weights[rows], start)
        for rows, start in zip(order, [0, len(order[0])])
    ]
