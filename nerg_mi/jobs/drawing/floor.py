"""The floor plan of rays in their place: paths, where people looked, and fields of view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.maps import Sight, Walk, floor_figure
from nerg_mi.jobs.options import definitions, option
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.ranges import COORDINATES, Checked, Range
from nerg_mi.rays.dataset_open import load_rays
from nerg_mi.rays.filters import find_sessions
from nerg_mi.rays.rays import Rays

from .kind import Drawing, Kind

_GAP = 1.0  # seconds without a ray after which a path begins anew
_JUMP = 1.0  # metres between two rays that nobody walks
_FINEST = 0.02  # metres between points of a path
_REACH = 1.2  # metres that a field of view, or a ray whose hit is not known, is drawn long


@dataclass(frozen=True, kw_only=True)
class FloorOptions(Checked):
    """What a floor plan shows."""

    scene: Path | None = option(None, "Scene file of the place, whose walls and furniture are drawn.")
    defaults: Mapping[str, str] | None = definitions()
    cut: float = option(1.2, "Height at which the place is cut, metres above its floor.", within=COORDINATES)
    floor: float = option(0.0, "Height of the floor (z).", within=COORDINATES)
    paths: bool = option(True, "Draw where people walked.")
    rays: int = option(0, "Draw so many rays, from the eye to what was looked at.", within=Range(0, 20000))
    views: int = option(0, "Draw so many fields of view of each person.", within=Range(0, 1000))
    fov: float = option(60.0, "Degrees that a field of view is wide.", within=Range(1, 180))
    people: str | None = option(None, "Draw these people alone: names with commas between them.")
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )


def _draw_floor(files: Sequence[Path], options: FloorOptions, reporter: Reporter) -> Drawing:
    """The plan of the rays of a file, over the place of ``options.scene`` where there is one."""
    (path,) = files
    rays = _of_people(load_rays(path), options.people)
    if not len(rays):
        raise NergError(f'"{path}" holds no rays; give a file of rays that has some')
    if not options.cut > 0:
        raise NergError(f"--cut is a height above the floor, got {options.cut}")
    low, high = _corners(rays)
    inputs, walls = [path], None
    if options.scene is not None:
        from nerg_mi.rendering.aovs import nerg_of
        from nerg_mi.rendering.scene import activate, load_scene

        from .walls import cut_place

        activate(options.mode)
        reporter.progress(0.0, "loading the scene")
        scene = load_scene(options.scene, options.defaults)
        reporter.progress(0.2, "cutting the place")
        nerg = nerg_of(options.scene, scene)
        walls = cut_place(nerg, scene, low, high, options.floor + options.cut, options.floor)
        inputs.append(options.scene)
    number = {person: k for k, person in enumerate(np.unique(rays.person))}
    walks = _walks(rays, number) if options.paths else []
    people = f"{len(number)} {'person' if len(number) == 1 else 'people'}"
    figure = floor_figure(
        low,
        high,
        walls,
        walks,
        _sights(rays, number, options.rays),
        _fields(rays, number, options.views),
        options.fov,
        f"{len(rays):,} rays of {people}",
    )
    return Drawing(figure, inputs)


def _of_people(rays: Rays, names: str | None) -> Rays:
    if names is None:
        return rays
    wanted = [name.strip() for name in names.split(",")]
    missing = [name for name in wanted if name not in rays.persons]
    if missing:
        some = ", ".join(rays.persons[:8])
        raise NergError(f'the rays have no person "{missing[0]}"; they have {some}{", ..." * (len(rays.persons) > 8)}')
    return rays.select(np.isin(rays.person, [rays.persons.index(name) for name in wanted]))


def _corners(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a plan that holds where people were and, but for strays, what they looked at."""
    parts = [rays.origin[:, :2]]
    if rays.hit is not None:
        hits = rays.hit[np.isfinite(rays.hit).all(axis=1), :2]
        parts += [np.percentile(hits, [1, 99], axis=0)] if len(hits) else []
    every = np.concatenate(parts)
    low, high = every.min(axis=0), every.max(axis=0)
    edge = max(0.06 * float((high - low).max()), 0.5)
    return low - edge, high + edge


def _walks(rays: Rays, people: Mapping[int, int]) -> list[Walk]:
    """The path of each person: not finer than can be seen, and with breaks where they were not recorded."""
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    label, found = sessions.label(), []
    for person in people:
        mine = rays.person[order] == person
        rows, recording = order[mine], label[mine]
        places, t = rays.origin[rows, :2], rays.t[rows]
        step = np.linalg.norm(np.diff(places, axis=0), axis=1)
        breaks = np.r_[True, (np.abs(np.diff(t)) > _GAP) | (step > _JUMP) | (np.diff(recording) != 0)]
        kept = breaks | np.r_[True, np.diff(np.floor(np.cumsum(np.r_[0.0, step]) / _FINEST)) > 0]
        found.append(Walk(rays.persons[person], places[kept], breaks[kept]))
    return found


def _sights(rays: Rays, number: dict[int, int], count: int) -> Sight | None:
    """``count`` rays, evenly taken."""
    if not count:
        return None
    some = np.unique(np.linspace(0, len(rays) - 1, count).astype(int))
    origins, ends = rays.origin[some, :2], _ahead(rays, some)
    if rays.hit is not None:
        hit = rays.hit[some, :2]
        ends = np.where(np.isfinite(hit), hit, ends)
    return Sight(origins, ends, np.array([number[p] for p in rays.person[some]]))


def _fields(rays: Rays, number: dict[int, int], count: int) -> Sight | None:
    """Fields of view at ``count`` moments of each person, evenly spread over their rays."""
    if not count:
        return None
    chosen = []
    for person in number:
        mine = np.flatnonzero(rays.person == person)
        mine = mine[np.argsort(rays.t[mine], kind="stable")]
        chosen.append(mine[np.unique(np.linspace(0, len(mine) - 1, count).astype(int))])
    some = np.concatenate(chosen)
    return Sight(rays.origin[some, :2], _ahead(rays, some), np.array([number[p] for p in rays.person[some]]))


def _ahead(rays: Rays, some: np.ndarray) -> np.ndarray:
    """Places (n, 2) on the floor where the rays ``some`` lead, as far as people look level."""
    return rays.origin[some, :2] + _REACH * rays.direction[some, :2]


FLOOR_KIND = Kind(
    "floor", "The floor plan of rays in their place.", "file of rays (.npz)", 1, FloorOptions, _draw_floor
)
