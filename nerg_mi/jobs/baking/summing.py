"""All parts of a bake and their sums, in this process or wherever parts are run: the same to the bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import replacing
from nerg_mi.files.safe_read import read_npy
from nerg_mi.interruption import Interruption
from nerg_mi.jobs.backend import select_backend
from nerg_mi.jobs.parts import Parts, PlannedScene
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import Sums
from nerg_mi.surfaces.sources import Crowd, TrackedRays
from nerg_mi.tasks.engines import Output
from nerg_mi.tasks.task import RENDERS, Part, Plan

from .chunks import BakeScene, parts_of
from .splat_chunks import SplatScene

_BEGIN, _END = 0.05, 0.9  # of a bake is this
_NUMBERS = ("elsewhere", "escaped", "total", "weight", "count")


def sums_in_one_go(
    scene: BakeScene | SplatScene, groups: Sequence[Crowd | TrackedRays], reporter: Reporter
) -> list[Sums]:
    """The sums of each of ``groups``, of which nothing is kept."""
    parts = [list(parts_of(group)) for group in groups]
    count, done, totals = sum(map(len, parts)), 0, []
    with Interruption() as stop:
        for group in parts:
            sums = scene.nothing
            for part in group:
                stop.check()
                sums = sums.plus(scene.sums(part))
                done += 1
                reporter.progress(_BEGIN + (_END - _BEGIN) * done / count, f"part {done} of {count}")
            totals.append(sums)
    return totals


@dataclass(frozen=True)
class PlannedBake:
    """What all parts of a bake have in common. ``files``: those of the ``scene``'s scene file, where it has one;
    ``mode``: the Mitsuba variant."""

    scene: BakeScene | SplatScene
    files: PlannedScene | None
    mode: str

    @staticmethod
    def of(scene: BakeScene | SplatScene) -> PlannedBake:
        """That of ``scene``, in the variant in use."""
        import mitsuba as mi

        file = scene.scene if isinstance(scene, BakeScene) else None
        return PlannedBake(scene, None if file is None else PlannedScene.of(file), str(mi.variant()))


def sums_in_parts(
    scene: BakeScene | SplatScene, groups: Sequence[Crowd | TrackedRays], parts: Parts, what: str
) -> list[Sums]:
    """The sums of each of ``groups``, whose parts are kept; ``what``: the job, as its user calls it."""
    whole: list[Part] = []
    for group in groups:
        kind, start = "rays" if isinstance(group, TrackedRays) else "observers", 0
        for part in parts_of(group):
            whole.append(Part(part, f"{kind} {start + 1} to {start + len(part.weights)}"))
            start += len(part.weights)
    plan = Plan(what, bake_part, PlannedBake.of(scene), whole, ".npy", (*RENDERS, "scipy"))
    arriving = parts.run(plan, _BEGIN, _END)
    totals = []
    for group in groups:
        sums = scene.nothing
        for _ in parts_of(group):
            sums = sums.plus(read_sums(next(arriving), len(scene.nothing.face)))
        totals.append(sums)
    return totals


def bake_part(common: PlannedBake, part: Crowd | TrackedRays, output: Path) -> dict[str, float]:
    """Sums over faces and vertices (.npy) of some observers, or rays, with the others as notes."""
    select_backend(common.mode)
    if common.files is not None:
        common.files.checked()
    sums = common.scene.sums(part)
    with replacing(output) as temporary, temporary.open("wb") as out:
        np.save(out, np.concatenate([sums.face, sums.vertex]))
    return {name: getattr(sums, name) for name in _NUMBERS}


def read_sums(made: Output, faces: int) -> Sums:
    """What `bake_part` has written, of so many ``faces``."""
    values = read_npy(made.path, "part of a bake")
    return Sums(values[:faces], values[faces:], **{name: made.notes[name] for name in _NUMBERS})


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
