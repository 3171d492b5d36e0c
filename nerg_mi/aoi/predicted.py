"""What a gaze field predicts of areas: for people where they stood, for places where nobody was tracked, after a
change, and how far it is to be trusted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from zlib import crc32

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError
from nerg_mi.formats.areas import AreaGroup, AreaSet, read_regions
from nerg_mi.formats.meshes import MeshFile
from nerg_mi.statistics.estimates import adjust_p_values, estimate_ratio_differences
from nerg_mi.statistics.shares import (
    COARSE,
    VisibilityCache,
    Isovists,
    SamplePoints,
    gaze_shares,
    visible_in_fov,
    find_standing_positions,
    unhidden,
)
from nerg_mi.statistics.tables import MEASURES_BY_NAME, PREDICTED, MIN_VIEWPOINTS, MinParticipantsFilter, Participants, Row
from nerg_mi.statistics.visits import ALL, Aoi, Cell
from nerg_mi.workflows.base import SILENT, Reporter

from .measured import AoiContext, TimeWindow, Viewpoints
from .options import CountOptions, PredictionOptions, AoiOptions, parse_window
from .scene import (
    Changes,
    GazeScene,
    apply_to_areas,
    changed_scene,
    read_changes,
    read_cohorts,
    read_meshes,
    shapes_by_id,
    surroundings_of_files,
    make_aois,
)

# ---- Foretold ----
#
# What a gaze field foretells of people who stand where they stood: the same numbers as those that are counted, as far
# as a field tells them.
#
# A field knows how gaze is shared out at a moment, and nothing of its course: there are no looks, returns or first
# looks in it. The probability that somebody looked at all follows if glances, one every so many seconds, are
# independent of each other: 1 - Π (1 - s_i) over their time, s_i the share at glance i.


@dataclass(frozen=True, eq=False)
class PredictedAttention:
    """Of E eyes and A areas: ``share`` (E, A) of the gaze, ``distance`` (E, A) its mean in metres, times the share,
    ``visible`` (E, A) bool, ``support`` (E,) rays that the field learnt from there, NaN where it does not say;
    ``members`` (M, E, A): the share by each member of an ensemble, by one field the same share again."""

    share: np.ndarray
    distance: np.ndarray
    visible: np.ndarray
    support: np.ndarray
    members: np.ndarray


def subsample_participants(viewpoints: Viewpoints, most: int, reporter: Reporter) -> Viewpoints:
    """Those of at most ``most`` people, who are the same whatever the order in which they came: those whose names have
    the least checksums."""
    people = sorted(set(viewpoints.participants), key=lambda name: (crc32(name.encode("utf-8", "surrogatepass")), name))
    if len(people) <= most:
        return viewpoints
    reporter.message(f"the field is asked of {most:,} of {len(people):,} people; --eyes {len(people)} asks of all")
    chosen = set(people[:most])
    rows = [k for k, person in enumerate(viewpoints.participants) if person in chosen]
    person, cells = tuple(viewpoints.participants[k] for k in rows), tuple(viewpoints.cells[k] for k in rows)
    return Viewpoints(viewpoints.positions[rows], viewpoints.ahead[rows], person, cells)


def predict_attention(
    gaze_scene: GazeScene,
    viewpoints: Viewpoints,
    aois: Sequence[Aoi],
    members: Sequence[tuple[int, ...]],
    margin: float,
    fov: float,
    samples: int,
    num_directions: int,
    reporter: Reporter,
) -> PredictedAttention:
    """What the gaze field of ``around`` says of each of the ``eyes``, whose shares over the sphere add up to one, in
    so many ``directions`` around each or, where a thing is small, more."""
    E = len(viewpoints.positions)
    told = lambda done: reporter.progress(done / E, f"the field: place {done} of {E}")
    found = gaze_shares(
        gaze_scene.query_from, viewpoints.positions, aois, members, margin, replace(COARSE, initial_directions=num_directions), told
    )
    targets = SamplePoints.sample(aois, samples)
    seen = visible_in_fov(targets, viewpoints.positions, viewpoints.ahead, unhidden(targets, viewpoints.positions, gaze_scene.trace_depth, margin), fov)
    visible = np.stack([seen[:, list(of)].any(axis=1) for of in members], axis=1)
    support = np.array([gaze_scene.support_at(p) for p in viewpoints.positions])
    return PredictedAttention(found.share, found.distance / gaze_scene.scale, visible, support, found.members)


def aggregate_by_participant(
    predicted: PredictedAttention, viewpoints: Viewpoints, cell: Cell, times: dict[str, float], glance: float
) -> Participants | None:
    """The people of a cell by the field; ``times``: for how long each was there, in seconds; ``glance``: seconds that
    one takes. None where no eye is of the cell."""
    rows = [k for k, cells in enumerate(viewpoints.cells) if cell in cells and viewpoints.participants[k] in times]
    names = sorted({viewpoints.participants[k] for k in rows})
    if not names:
        return None
    place = {name: k for k, name in enumerate(names)}
    who = np.array([place[viewpoints.participants[k]] for k in rows])
    count = np.bincount(who, minlength=len(names)).astype(float)

    def mean(v: np.ndarray) -> np.ndarray:
        total = np.zeros((len(names), v.shape[1]))
        np.add.at(total, who, v[rows].astype(float))
        return total / count[:, None]

    time = np.array([times[name] for name in names])
    share = mean(predicted.share)
    missed = mean(-np.log1p(-np.minimum(predicted.share, 1 - 1e-12)))
    reached = -np.expm1(-missed * (time / glance)[:, None])
    seconds = time[:, None]
    distance, visible = mean(predicted.distance) * seconds, mean(predicted.visible) * seconds
    return Participants(tuple(names), time, share * seconds, distance, visible, reached)


# ---- Places ----
#
# Places on the floor where nobody was tracked: where one can stand, and what is seen from there.


def place_observers_on_floor(around: GazeScene, height: float, step: float, floor: float) -> np.ndarray:
    """Places (G, 3) at eye height where one can stand. Raises `NergError` where there are none."""
    lower, upper = around.bounds()
    found = find_standing_positions(lower, upper, step * around.scale, height * around.scale, around.trace_depth, floor)
    if not len(found):
        raise NergError(
            f"nobody can stand anywhere: there is no floor at {floor:g} (--floor) below eyes at {height:g} (--height)"
        )
    return found


def viewpoints_at(positions: np.ndarray) -> Viewpoints:
    """Somebody at each of ``positions`` (M, 3), who may turn round."""
    names = tuple(f"observer {k + 1:0{len(str(len(positions)))}d}" for k in range(len(positions)))
    return Viewpoints(positions, np.tile([1.0, 0, 0], (len(positions), 1)), names, (frozenset([ALL]),) * len(positions))


def isovist_rows(isovists: Isovists, names: Sequence[str], members: Sequence[tuple[int, ...]]) -> list[Row]:
    """A row for each place; of each area the share of its points that are seen from there."""
    rows = []
    for k, (x, y, z) in enumerate(isovists.points.tolist()):
        row: Row = {"x": x, "y": y, "z": z}
        row |= {n: float(getattr(isovists, n)[k]) for n in ("area", "perimeter", "nearest", "farthest", "radius")}
        rows.append(row | {f"sees {n}": float(isovists.visible_share[k, list(of)].mean()) for n, of in zip(names, members)})
    return rows


# ---- Setting ----
#
# What a count needs besides rays, from files and options: the same in whatever process it is made.


@dataclass(frozen=True, eq=False)
class AoiScene:
    """``areas`` in what is ``around`` people, and the ``things`` that they consist of; ``options`` of how it is
    counted (`CountOptions`), asked of a field (`PredictionOptions`), or both; ``meshes`` that were read, by file."""

    gaze_scene: GazeScene
    areas: AreaSet
    aois: Sequence[Aoi]
    options: AoiOptions
    meshes: Mapping[Path, MeshFile]

    @property
    def warnings(self) -> list[str]:
        """Sentences on what of the meshes is not used."""
        return [f"of {file}: {note}" for file, mesh in self.meshes.items() for note in mesh.notes]

    @cached_property
    def members(self) -> list[tuple[int, ...]]:
        """Of each area the numbers of its things."""
        return list(self.areas.element_indices().values())

    @property
    def margin(self) -> float:
        """In units of the place."""
        return self.options.margin * self.gaze_scene.scale

    def make_context(self, use_hit_points: bool, cohorts: tuple[str, ...]) -> AoiContext:
        """How rays are counted which end at their ``hits``, or not, and have these ``cohorts`` where no table does."""
        o = self.options
        assert isinstance(o, CountOptions)
        in_view = None
        if o.aoi_visibility:
            targets = SamplePoints.sample(self.aois, o.aoi_samples)
            in_view = VisibilityCache(targets, self._depth_or_things, o.cell_size * self.gaze_scene.scale, self.margin)
        leaves = [k for k, area in enumerate(self.areas.areas) if not isinstance(area, AreaGroup)]
        table = {} if o.cohorts is None else read_cohorts(o.cohorts)
        return AoiContext(
            self.gaze_scene,
            self.aois,
            self.areas.names,
            self.members,
            leaves,
            o.visit_rules(),
            self.margin,
            o.tolerance,
            use_hit_points,
            o.fov,
            in_view,
            [TimeWindow(*parse_window(text)) for text in o.windows],
            [] if o.zones is None else read_regions(o.zones),
            table,
            tuple(sorted(set(table.values()))) if table else cohorts,
        )

    def apply_changes(self, changes: Changes) -> AoiScene:
        """The same after ``changes`` of shapes and areas. Raises `NergError` for those that cannot be made."""
        areas, around, shapes = apply_to_areas(self.areas, changes), self.gaze_scene, shapes_by_id(self.gaze_scene.scene)
        meshes = {**self.meshes, **read_meshes(file for file in changes.meshes if file not in self.meshes)}
        if changes.of_shapes:
            scene, shapes = changed_scene(around.scene, changes, meshes)
            around = around.with_scene(scene)
        things = make_aois(areas.elements, shapes, meshes)
        return replace(self, gaze_scene=around, areas=areas, aois=things, meshes=meshes)

    def predict(self, viewpoints: Viewpoints, view: float, reporter: Reporter = SILENT) -> PredictedAttention:
        """What the field says of the gaze of ``eyes`` that see so many degrees (``view``)."""
        o = self.options
        assert isinstance(o, PredictionOptions)
        return predict_attention(
            self.gaze_scene, viewpoints, self.aois, self.members, self.margin, view, o.aoi_samples, o.directions, reporter
        )

    def _depth_or_things(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """How far is seen: to the surfaces of the place, or, where none is known, to the nearest thing."""
        if self.gaze_scene.geometry is not None:
            return self.gaze_scene.trace_depth(o, d)
        reach = np.full(len(o), np.inf)
        for thing in self.aois:
            near, far = thing.interval(o, d)
            met = (near >= 0) & (np.isfinite(near) if thing.is_surface else near < far)
            reach = np.where(met, np.minimum(reach, near), reach)
        return reach


def load_aoi_scene(
    scene: Path | None, field: Path | None, gaze: Path | None, areas: AreaSet, options: AoiOptions, ns: ModuleType
) -> AoiScene:
    """The setting of these files. Raises `NergError`; what is plainly wrong is told before anything is loaded."""
    if isinstance(options, CountOptions):
        # Before anything is read.
        options.visit_rules()
    align = None if options.align is None else read_similarity(options.align, "--align", "rays to place")
    around = surroundings_of_files(scene, field, gaze, align, ns)
    meshes = read_meshes(areas.meshes)
    return AoiScene(around, areas, make_aois(areas.elements, shapes_by_id(around.scene), meshes), options, meshes)


# ---- Trust ----
#
# How far what a field foretells is to be trusted: the spread of an ensemble's members, and how many rays it learnt
# from around the eyes.

SPREAD = ("share", "dwell", "reach")  # numbers whose spread over members is told


def add_uncertainty(
    rows: Sequence[Row],
    predicted: PredictedAttention,
    viewpoints: Viewpoints,
    times: Mapping[Cell, dict[str, float]],
    glance: float,
) -> None:
    """Give ``rows`` of the table of things ``support``, the median over the eyes of their cell, ``places``, the eyes of
    the cell for each of its people, and ``share_spread``, ``dwell_spread`` and ``reach_spread``, the standard
    deviations over the members of an ensemble; None for what was counted, is blank, or is not known."""
    found: dict[tuple[str, str], tuple[float | None, float | None, dict[str, np.ndarray]]] = {}
    areas: dict[str, int] = {}
    for cell in times:
        mine = np.array([cell in cells for cells in viewpoints.cells], bool)
        people = {person for person, own in zip(viewpoints.participants, mine.tolist()) if own}
        places = float(mine.sum()) / len(people) if people else None
        spreads = _spreads(predicted, viewpoints, cell, times, glance)
        found[cell.dimension, cell.value] = support_of(predicted, mine), places, spreads
    for row in rows:
        place = areas.setdefault(row["thing"], len(areas))
        support, places, spreads = found[row["cell"], row["value"]]
        told = row["source"] == PREDICTED
        for name in SPREAD:
            known = told and name in spreads and row[name] is not None
            row[f"{name}_spread"] = float(spreads[name][place]) if known else None
        row["support"] = support if told and row["people"] is not None else None
        row["places"] = places if told and row["people"] is not None else None


def support_of(foretold: PredictedAttention, mine: np.ndarray | None = None) -> float | None:
    """Rays that the field learnt from around an eye, at the median of all, or of ``mine`` (E,); None where the
    checkpoint keeps none."""
    some = foretold.support if mine is None else foretold.support[mine]
    some = some[np.isfinite(some)]
    return float(np.median(some)) if len(some) else None


def warn_missing_support(predicted: PredictedAttention, reporter: Reporter) -> None:
    """Say what is missing where nobody can tell how much data the numbers of a field rest on."""
    if support_of(predicted) is None:
        reporter.message(
            "the gaze field's checkpoint keeps no support, so that the tables cannot say where it learnt from nobody; "
            "nerg train gaze with the rays makes one that does"
        )


def warn_few_viewpoints(viewpoints: Viewpoints, reporter: Reporter) -> None:
    """Say so where a field is asked from too few places a person for their reach: who looks at a thing only where it is
    near is taken for somebody who does not, unless one of their places is there."""
    people = len(set(viewpoints.participants))
    if people and len(viewpoints.participants) < MIN_VIEWPOINTS * people:
        reporter.message(
            f"the field is asked from {len(viewpoints.participants) / people:.1f} places a person, by which reach comes out too "
            f"low; --eyes {MIN_VIEWPOINTS * people} asks from {MIN_VIEWPOINTS}"
        )


def _spreads(
    foretold: PredictedAttention, eyes: Viewpoints, cell: Cell, times: Mapping[Cell, dict[str, float]], glance: float
) -> dict[str, np.ndarray]:
    if len(foretold.members) < 2:
        return {}
    values: dict[str, list[np.ndarray]] = {name: [] for name in SPREAD}
    for share in foretold.members:
        people = aggregate_by_participant(replace(foretold, share=share), eyes, cell, times[cell], glance)
        for name in SPREAD:
            pair = None if people is None else MEASURES_BY_NAME[name].numerator_denominator(people)
            if pair is None:
                return {}
            with np.errstate(divide="ignore", invalid="ignore"):
                values[name].append(pair[0].sum(axis=0) / pair[1].sum(axis=0))
    return {name: np.std(found, axis=0, ddof=1) for name, found in values.items()}


# ---- The table of what a change would do, by the field ----

Foretell = Callable[[AoiScene, Viewpoints], PredictedAttention]


def what_if_rows(
    path: Path,
    aoi_scene: AoiScene,
    viewpoints: Viewpoints,
    before: PredictedAttention,
    foretell: Foretell,
    min_participants: MinParticipantsFilter,
    resamples: int,
    seed: int,
) -> list[Row]:
    """Of each area and measure (``share`` of gaze, ``visible`` share of people's time) what the field says ``before``
    and ``after`` the changes in the file ``path``, the ``difference`` with its interval over people and, of an
    ensemble's shares, its ``difference_spread`` over the members, and the ``support``: rays that the field learnt from
    around an eye, at the median after the changes. ``foretell`` is asked what the field says in the changed setting of
    the observers that there are then. Raises `NergError`."""
    changes = read_changes(path)
    there = aoi_scene.apply_changes(changes)
    areas, after_areas = aoi_scene.areas, there.areas
    others = viewpoints
    if changes.observers is not None:
        others = viewpoints_at(changes.observers)
    if changes.shift is not None:
        others = replace(others, positions=others.positions + changes.shift)
    after = foretell(there, others)
    # People who are the same before and after are compared with themselves.
    names = sorted({*viewpoints.participants, *others.participants})
    support = support_of(after)
    rows: list[Row] = []
    for name in dict.fromkeys((*areas.names, *after_areas.names)):
        for measure in ("share", "visible"):
            old = _of(viewpoints, names, getattr(before, measure), areas, name)
            new = _of(others, names, getattr(after, measure), after_areas, name)
            row = _row(name, measure, old, new, min_participants, resamples, seed)
            row["difference_spread"] = None
            if measure == "share" and row["difference"] is not None and len(after.members) > 1:
                apart = [
                    _mean(_of(others, names, to, after_areas, name)) - _mean(_of(viewpoints, names, at, areas, name))
                    for at, to in zip(before.members, after.members)
                ]
                row["difference_spread"] = float(np.std(apart, ddof=1))
            rows.append(row | {"support": support, "source": PREDICTED})
    corrected = adjust_p_values(np.array([np.nan if row["p"] is None else row["p"] for row in rows], float))
    for row, p in zip(rows, corrected):
        row["p_adjusted"] = float(p) if np.isfinite(p) else None
    return rows


def _of(
    eyes: Viewpoints, names: list[str], values: np.ndarray, areas: AreaSet, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of an area's ``values`` (E, A) over the eyes of each person, and who has any, (P, 1) each."""
    total, count = np.zeros((len(names), 1)), np.zeros((len(names), 1))
    if name in areas.names:
        place = {n: k for k, n in enumerate(names)}
        who = np.array([place[p] for p in eyes.participants])
        np.add.at(total[:, 0], who, values[:, areas.names.index(name)].astype(float))
        np.add.at(count[:, 0], who, 1.0)
    return total / np.maximum(count, 1), (count > 0).astype(float)


def _mean(pair: tuple[np.ndarray, np.ndarray]) -> float:
    return float(pair[0].sum() / pair[1].sum())


def _row(name: str, measure: str, old, new, floor: MinParticipantsFilter, resamples: int, seed: int) -> Row:
    mean = lambda pair: _mean(pair) if pair[1].sum() else None
    people = int(min(old[1].sum() or new[1].sum(), new[1].sum() or old[1].sum()))
    told = floor.passes(people)
    row: Row = {"thing": name, "measure": measure, "people": people if told else None}
    row |= {"before": mean(old) if told else None, "after": mean(new) if told else None}
    both = bool(old[1].sum() and new[1].sum())
    found = estimate_ratio_differences(old, new, resamples=resamples, seed=seed) if both and told else None
    number = lambda v: float(v[0]) if np.isfinite(v[0]) else None
    keys = {"difference": "value", "low": "low", "high": "high", "p": "p"}
    return row | {k: None if found is None else number(getattr(found, v)) for k, v in keys.items()}
