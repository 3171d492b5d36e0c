"""Predicted attention on AOIs: for recorded viewpoints, for positions on the floor, after changes, with its
uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from zlib import crc32

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.tables import join_reasons
from nerg_mi.formats.areas import AreaGroup, AreaSet, read_regions
from nerg_mi.formats.meshes import MeshFile
from nerg_mi.measures.estimates import adjust_p_values, estimate_ratio_differences
from nerg_mi.measures.shares import (
    COARSE,
    SamplePoints,
    VisibilityCache,
    compute_visibility,
    find_standing_positions,
    gaze_shares,
    visible_in_fov,
)
from nerg_mi.measures.tables import (
    MEASURES_BY_NAME,
    MIN_VIEWPOINTS,
    PREDICTED,
    MinParticipantsFilter,
    Participants,
    Row,
    explain_difference,
)
from nerg_mi.measures.visits import ALL, Aoi, Cell
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.tracking_kinds import TRACKING_NOTES

from .measured import AoiContext, TimeWindow, Viewpoints
from .options import AoiOptions, CountOptions, PredictionOptions, parse_window
from .scene import (
    Changes,
    GazeScene,
    apply_to_areas,
    apply_to_scene,
    load_gaze_scene,
    make_aois,
    read_changes,
    read_cohorts,
    read_meshes,
    shapes_by_id,
)

# ---- Prediction ----
#
# A gaze field predicts the attention shares of areas for the recorded viewpoints.
#
# A gaze field has no time course, so visits, revisits and the time to first visit cannot be predicted. The probability
# of at least one visit is predicted under the assumption that glances of a fixed duration are independent: 1 - Π (1 -
# s_i) over the recorded time, where s_i is the attention share at glance i.


@dataclass(frozen=True, eq=False)
class PredictedAttention:
    """Predicted attention of E viewpoints on A areas.

    Parameters
    ----------
    share
        Attention share, (E, A).
    distance
        Mean distance in metres times the share, (E, A).
    visible
        Whether the area is in the field of view and not occluded, (E, A) bool.
    support
        Number of training samples around the viewpoint, (E,); NaN if the checkpoint does not contain it.
    members
        Attention share by each ensemble member, (M, E, A); for a single field the share again.
    note
        Which viewpoints are extrapolated, and why; "" if none is.
    """

    share: np.ndarray
    distance: np.ndarray
    visible: np.ndarray
    support: np.ndarray
    members: np.ndarray
    note: str = ""


def subsample_participants(viewpoints: Viewpoints, max_participants: int, reporter: Reporter) -> Viewpoints:
    """Return the viewpoints of at most ``max_participants`` participants.

    The subset consists of the participants whose names have the smallest checksums, so it does not depend on the order
    of the samples.
    """
    names = sorted(set(viewpoints.participants), key=lambda name: (crc32(name.encode("utf-8", "surrogatepass")), name))
    if len(names) <= max_participants:
        return viewpoints
    reporter.message(
        f"the prediction uses {max_participants:,} of {len(names):,} participants; "
        f"{parameter('viewpoints', len(names))} uses all"
    )
    chosen_names = set(names[:max_participants])
    rows = [k for k, person in enumerate(viewpoints.participants) if person in chosen_names]
    person, cells = tuple(viewpoints.participants[k] for k in rows), tuple(viewpoints.cells[k] for k in rows)
    return Viewpoints(viewpoints.positions[rows], viewpoints.facing[rows], person, cells)


def predict_attention(
    gaze_scene: GazeScene,
    viewpoints: Viewpoints,
    aois: Sequence[Aoi],
    members: Sequence[tuple[int, ...]],
    margin: float,
    fov: float,
    num_points: int,
    num_directions: int,
    reporter: Reporter,
) -> PredictedAttention:
    """Predict the attention of viewpoints on areas with the gaze field of a scene.

    Parameters
    ----------
    gaze_scene
        Scene with a gaze field.
    viewpoints
        E viewpoints.
    aois
        Elementary AOIs.
    members
        Indices into ``aois`` of each of A areas.
    margin
        Surface tolerance in scene units.
    fov
        Angle of the field of view in degrees.
    num_points
        Number of sample points per AOI, for visibility.
    num_directions
        Initial number of directions around a viewpoint; small areas use more.
    reporter
        Reports progress.
    """
    E = len(viewpoints.positions)
    on_progress = lambda done: reporter.progress(done / E, f"prediction: viewpoint {done} of {E}")
    shares = gaze_shares(
        gaze_scene.query_from,
        viewpoints.positions,
        aois,
        members,
        margin,
        replace(COARSE, initial_directions=num_directions),
        on_progress,
    )
    targets = SamplePoints.sample(aois, num_points)
    in_fov = visible_in_fov(
        targets,
        viewpoints.positions,
        viewpoints.facing,
        compute_visibility(targets, viewpoints.positions, gaze_scene.trace_depth, margin),
        fov,
    )
    visible = np.stack([in_fov[:, list(indices)].any(axis=1) for indices in members], axis=1)
    support = np.array([gaze_scene.support_at(p) for p in viewpoints.positions])
    return PredictedAttention(shares.share, shares.distance / gaze_scene.scale, visible, support, shares.members)


def aggregate_by_participant(
    predicted: PredictedAttention,
    viewpoints: Viewpoints,
    cell: Cell,
    durations: dict[str, float],
    glance_duration: float,
) -> Participants | None:
    """Aggregate a prediction by participant; None if the cell has no viewpoints.

    Parameters
    ----------
    predicted
        Predicted attention.
    viewpoints
        Viewpoints of the prediction.
    cell
        Cell to aggregate.
    durations
        Recorded time of each participant in seconds.
    glance_duration
        Duration of a glance in seconds.
    """
    rows = [k for k, cells in enumerate(viewpoints.cells) if cell in cells and viewpoints.participants[k] in durations]
    names = sorted({viewpoints.participants[k] for k in rows})
    if not names:
        return None
    row_of = {name: k for k, name in enumerate(names)}
    index = np.array([row_of[viewpoints.participants[k]] for k in rows])
    count = np.bincount(index, minlength=len(names)).astype(float)

    def mean(v: np.ndarray) -> np.ndarray:
        total = np.zeros((len(names), v.shape[1]))
        np.add.at(total, index, v[rows].astype(float))
        return total / count[:, None]

    time = np.array([durations[name] for name in names])
    share = mean(predicted.share)
    log_miss = mean(-np.log1p(-np.minimum(predicted.share, 1 - 1e-12)))
    hit_probability = -np.expm1(-log_miss * (time / glance_duration)[:, None])
    seconds = time[:, None]
    distance, visible = mean(predicted.distance) * seconds, mean(predicted.visible) * seconds
    return Participants(tuple(names), time, share * seconds, distance, visible, hit_probability)


# ---- Observers without recordings ----


def place_observers_on_floor(gaze_scene: GazeScene, height: float, step: float, floor: float) -> np.ndarray:
    """Return standing positions (G, 3) at eye ``height`` on a grid. Raises `NergError` if there are none."""
    lower, upper = gaze_scene.bounds()
    positions = find_standing_positions(
        lower, upper, step * gaze_scene.scale, height * gaze_scene.scale, gaze_scene.trace_depth, floor
    )
    if not len(positions):
        raise NergError(
            f"no walkable floor was found at height {floor:g} ({parameter('floor_height')}) below eyes at "
            f"{height:g} ({parameter('eye_height')}); correct one of them"
        )
    return positions


def viewpoints_at(positions: np.ndarray) -> Viewpoints:
    """Return a viewpoint of a separate observer, who may face any direction, at each of ``positions`` (M, 3)."""
    names = tuple(f"observer {k + 1:0{len(str(len(positions)))}d}" for k in range(len(positions)))
    return Viewpoints(positions, np.tile([1.0, 0, 0], (len(positions), 1)), names, (frozenset([ALL]),) * len(positions))


# ---- AOI scene ----


@dataclass(frozen=True, eq=False)
class AoiScene:
    """Areas of interest in a scene.

    Parameters
    ----------
    gaze_scene
        Surfaces and gaze field.
    areas
        Areas.
    aois
        Elementary AOIs of the areas.
    options
        Options of the measurement (`CountOptions`), of the prediction (`PredictionOptions`), or of both.
    meshes
        Meshes of AOIs and changes, by file.
    alignment_doubts
        Messages about an alignment that its evidence did not determine.
    """

    gaze_scene: GazeScene
    areas: AreaSet
    aois: Sequence[Aoi]
    options: AoiOptions
    meshes: Mapping[Path, MeshFile]
    alignment_doubts: tuple[str, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """Warnings about the alignment, about a gaze field of heads, and about unused content of the meshes."""
        gaze = self.gaze_scene.gaze
        basis = None if gaze is None else gaze.field.basis
        note = None if basis is None else TRACKING_NOTES.get(basis.tracking)
        of_heads = f"the gaze field was trained on {note}: predictions are those of heads, not of eyes"
        return [
            *self.alignment_doubts,
            *([of_heads] if note else []),
            *(f"of {file}: {note}" for file, mesh in self.meshes.items() for note in mesh.notes),
        ]

    @cached_property
    def members(self) -> list[tuple[int, ...]]:
        """Indices of the elementary AOIs of each area."""
        return list(self.areas.element_indices().values())

    @property
    def margin(self) -> float:
        """Surface tolerance in scene units."""
        return self.options.margin * self.gaze_scene.scale

    def make_context(self, use_hit_points: bool, cohorts: tuple[str, ...]) -> AoiContext:
        """Create the context for measured samples; ``cohorts`` are those of the samples if no table defines cohorts."""
        o = self.options
        assert isinstance(o, CountOptions)
        visibility_cache = None
        if o.aoi_visibility:
            targets = SamplePoints.sample(self.aois, o.aoi_samples)
            visibility_cache = VisibilityCache(
                targets, self._trace_depth, o.cell_size * self.gaze_scene.scale, self.margin
            )
        leaves = [k for k, area in enumerate(self.areas.areas) if not isinstance(area, AreaGroup)]
        cohort_of = {} if o.cohorts is None else read_cohorts(o.cohorts)
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
            visibility_cache,
            [TimeWindow(*parse_window(text)) for text in o.windows],
            [] if o.zones is None else read_regions(o.zones),
            cohort_of,
            tuple(sorted(set(cohort_of.values()))) if cohort_of else cohorts,
        )

    def apply_changes(self, changes: Changes) -> AoiScene:
        """Return the scene after ``changes`` of shapes and areas. Raises `NergError` for invalid changes."""
        areas, gaze_scene, shapes = (
            apply_to_areas(self.areas, changes),
            self.gaze_scene,
            shapes_by_id(self.gaze_scene.scene),
        )
        meshes = {**self.meshes, **read_meshes(file for file in changes.meshes if file not in self.meshes)}
        if changes.changes_shapes:
            scene, shapes = apply_to_scene(gaze_scene.scene, changes, meshes)
            gaze_scene = gaze_scene.with_scene(scene)
        aois = make_aois(areas.elements, shapes, meshes, gaze_scene.scene)
        return replace(self, gaze_scene=gaze_scene, areas=areas, aois=aois, meshes=meshes)

    def predict(self, viewpoints: Viewpoints, fov: float, reporter: Reporter = SILENT) -> PredictedAttention:
        """Predict the attention of ``viewpoints`` with a field of view of ``fov`` degrees."""
        o = self.options
        assert isinstance(o, PredictionOptions)
        return predict_attention(
            self.gaze_scene,
            viewpoints,
            self.aois,
            self.members,
            self.margin,
            fov,
            o.aoi_samples,
            o.directions,
            reporter,
        )

    def _trace_depth(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the distance to the surfaces of the scene or, if they are unknown, to the nearest AOI."""
        if self.gaze_scene.geometry is not None:
            return self.gaze_scene.trace_depth(o, d)
        depth = np.full(len(o), np.inf)
        for aoi in self.aois:
            near, far = aoi.intersect(o, d)
            is_hit = (near >= 0) & (np.isfinite(near) if aoi.is_surface else near < far)
            depth = np.where(is_hit, np.minimum(depth, near), depth)
        return depth


def load_aoi_scene(
    scene: Path | None, field: Path | None, gaze: Path | None, areas: AreaSet, options: AoiOptions, ns: ModuleType
) -> AoiScene:
    """Load the AOI scene from files. Raises `NergError`; options are checked before any file is loaded."""
    if isinstance(options, CountOptions):
        # Fail before files are read.
        options.visit_rules()
    doubts: list[str] = []
    align = None
    if options.align is not None:
        align = read_similarity(options.align, parameter("align"), "rays to scene", doubts.append)
    gaze_scene = load_gaze_scene(scene, field, gaze, align, ns)
    meshes = read_meshes(areas.meshes)
    aois = make_aois(areas.elements, shapes_by_id(gaze_scene.scene), meshes, gaze_scene.scene)
    return AoiScene(gaze_scene, areas, aois, options, meshes, tuple(doubts))


# ---- Uncertainty ----
#
# Uncertainty of a prediction: the standard deviation over ensemble members, and the number of training samples around
# the viewpoints.

MEASURES_WITH_SPREAD = ("share", "dwell", "hit_ratio")  # measures with a standard deviation over ensemble members


def add_uncertainty(
    rows: Sequence[Row],
    predicted: PredictedAttention,
    viewpoints: Viewpoints,
    durations: Mapping[Cell, dict[str, float]],
    glance_duration: float,
) -> None:
    """Add the uncertainty of predictions to ``rows`` of the AOI table.

    ``support`` is the median number of training samples around the viewpoints of the cell, ``viewpoints`` the number of
    viewpoints per participant, and ``share_spread``, ``dwell_spread`` and ``hit_ratio_spread`` are standard deviations
    over ensemble members. Values are None for measured rows, and if they are suppressed or unknown; the ``note`` says
    why.
    """
    uncertainty: dict[tuple[str, str], tuple[float | None, float | None, dict[str, np.ndarray]]] = {}
    area_index: dict[str, int] = {}
    for cell in durations:
        mask = np.array([cell in cells for cells in viewpoints.cells], bool)
        participants = {person for person, is_in_cell in zip(viewpoints.participants, mask.tolist()) if is_in_cell}
        viewpoints_per_participant = float(mask.sum()) / len(participants) if participants else None
        spreads = _spreads(predicted, viewpoints, cell, durations, glance_duration)
        uncertainty[cell.dimension, cell.value] = median_support(predicted, mask), viewpoints_per_participant, spreads
    for row in rows:
        index = area_index.setdefault(row["aoi"], len(area_index))
        support, viewpoints_per_participant, spreads = uncertainty[row["cell"], row["value"]]
        is_predicted = row["source"] == PREDICTED
        reasons: dict[str, list[str]] = {}
        for name in MEASURES_WITH_SPREAD:
            has_spread = is_predicted and name in spreads and row[name] is not None
            row[f"{name}_spread"] = float(spreads[name][index]) if has_spread else None
            if not has_spread:
                reasons.setdefault(_NO_MEMBERS if is_predicted and not spreads else "no value", []).append(
                    f"{name}_spread"
                )
        is_shown = is_predicted and row["participants"] is not None
        row["support"] = support if is_shown else None
        row["viewpoints"] = viewpoints_per_participant if is_shown else None
        if row["support"] is None:
            reasons.setdefault(_NO_SUPPORT if is_shown else "suppressed", []).append("support")
        if row["viewpoints"] is None:
            reasons.setdefault("suppressed", []).append("viewpoints")
        if not is_predicted:
            reasons = {"of predictions only": [name for names in reasons.values() for name in names]}
        earlier = (predicted.note if is_predicted else "", row.get("note"), join_reasons(reasons))
        row["note"] = "; ".join(filter(None, earlier))


_NO_MEMBERS, _NO_SUPPORT = "the gaze field is no ensemble", "the checkpoint of the gaze field does not store it"


def median_support(predicted: PredictedAttention, mask: np.ndarray | None = None) -> float | None:
    """Return the median number of training samples around the viewpoints, or around those in ``mask`` (E,); None if
    the checkpoint does not contain support."""
    support = predicted.support if mask is None else predicted.support[mask]
    support = support[np.isfinite(support)]
    return float(np.median(support)) if len(support) else None


def warn_missing_support(predicted: PredictedAttention, reporter: Reporter) -> None:
    """Report that the checkpoint lacks the training support."""
    if median_support(predicted) is None:
        reporter.message(
            "the checkpoint of the gaze field does not contain training support, so the tables cannot show where the "
            "field extrapolates; train the field again with nerg train gaze to add it"
        )


def warn_few_viewpoints(viewpoints: Viewpoints, reporter: Reporter) -> None:
    """Report that too few viewpoints per participant bias the predicted hit ratio.

    A participant who looks at an area only from nearby is missed if none of their viewpoints is near the area.
    """
    num_participants = len(set(viewpoints.participants))
    if num_participants and len(viewpoints.participants) < MIN_VIEWPOINTS * num_participants:
        reporter.message(
            f"the prediction uses {len(viewpoints.participants) / num_participants:.1f} viewpoints per "
            "participant, which biases the hit ratio low; use "
            f"{parameter('viewpoints', MIN_VIEWPOINTS * num_participants)} for {MIN_VIEWPOINTS} per participant"
        )


def _spreads(
    predicted: PredictedAttention,
    viewpoints: Viewpoints,
    cell: Cell,
    durations: Mapping[Cell, dict[str, float]],
    glance_duration: float,
) -> dict[str, np.ndarray]:
    if len(predicted.members) < 2:
        return {}
    values: dict[str, list[np.ndarray]] = {name: [] for name in MEASURES_WITH_SPREAD}
    for share in predicted.members:
        participants = aggregate_by_participant(
            replace(predicted, share=share), viewpoints, cell, durations[cell], glance_duration
        )
        for name in MEASURES_WITH_SPREAD:
            sums = None if participants is None else MEASURES_BY_NAME[name].numerator_denominator(participants)
            if sums is None:
                return {}
            with np.errstate(divide="ignore", invalid="ignore"):
                values[name].append(sums[0].sum(axis=0) / sums[1].sum(axis=0))
    return {name: np.std(member_values, axis=0, ddof=1) for name, member_values in values.items()}


# ---- What-if table ----

Predict = Callable[[AoiScene, Viewpoints], PredictedAttention]


def what_if_rows(
    path: Path,
    aoi_scene: AoiScene,
    viewpoints: Viewpoints,
    before: PredictedAttention,
    predict: Predict,
    min_participants: MinParticipantsFilter,
    resamples: int,
    seed: int,
) -> list[Row]:
    """Compare predictions before and after the changes in the file ``path``.

    Each row has an area, a measure (``share`` of gaze or ``visible`` share of time), the values ``before`` and
    ``after``, the ``difference`` with its interval over participants, the standard deviation of the difference over
    ensemble members (``difference_spread``), and the median ``support`` after the changes. Raises `NergError`.

    Parameters
    ----------
    path
        File of changes.
    aoi_scene
        Scene before the changes.
    viewpoints, before
        Viewpoints and their prediction before the changes.
    predict
        Predicts the attention of viewpoints in the changed scene.
    min_participants
        Suppresses values of few participants.
    resamples, seed
        Number and seed of the bootstrap draws.
    """
    changes = read_changes(path)
    changed_scene = aoi_scene.apply_changes(changes)
    areas, after_areas = aoi_scene.areas, changed_scene.areas
    changed_viewpoints = viewpoints
    if changes.observers is not None:
        changed_viewpoints = viewpoints_at(changes.observers)
    if changes.shift is not None:
        changed_viewpoints = replace(changed_viewpoints, positions=changed_viewpoints.positions + changes.shift)
    after = predict(changed_scene, changed_viewpoints)
    after = replace(after, note=changed_scene.gaze_scene.describe_extrapolation(changed_viewpoints.positions))
    # Participants with viewpoints before and after the changes are paired.
    names = sorted({*viewpoints.participants, *changed_viewpoints.participants})
    support = median_support(after)
    rows: list[Row] = []
    for name in dict.fromkeys((*areas.names, *after_areas.names)):
        for measure in ("share", "visible"):
            old_sums = _mean_by_participant(viewpoints, names, getattr(before, measure), areas, name)
            new_sums = _mean_by_participant(changed_viewpoints, names, getattr(after, measure), after_areas, name)
            row = _what_if_row(name, measure, old_sums, new_sums, min_participants, resamples, seed)
            row["difference_spread"] = None
            reasons = {"": [], _NO_SUPPORT if support is None else "": ["support"]}
            if measure == "share" and row["difference"] is not None and len(after.members) > 1:
                differences = [
                    _overall_mean(_mean_by_participant(changed_viewpoints, names, new_share, after_areas, name))
                    - _overall_mean(_mean_by_participant(viewpoints, names, old_share, areas, name))
                    for old_share, new_share in zip(before.members, after.members)
                ]
                row["difference_spread"] = float(np.std(differences, ddof=1))
            else:
                reason = _NO_MEMBERS if measure == "share" else "visibility does not depend on the gaze field"
                reasons["no difference" if row["difference"] is None else reason] = ["difference_spread"]
            row["note"] = "; ".join(filter(None, (after.note, row["note"], join_reasons(reasons))))
            rows.append(row | {"support": support, "source": PREDICTED})
    adjusted_p = adjust_p_values(np.array([np.nan if row["p"] is None else row["p"] for row in rows], float))
    for row, p in zip(rows, adjusted_p):
        row["p_adjusted"] = float(p) if np.isfinite(p) else None
    return rows


def _mean_by_participant(
    viewpoints: Viewpoints, names: list[str], values: np.ndarray, areas: AreaSet, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of an area's ``values`` (E, A) over the viewpoints of each participant, and whether the
    participant has viewpoints, (P, 1) each."""
    total, count = np.zeros((len(names), 1)), np.zeros((len(names), 1))
    if name in areas.names:
        row_of = {n: k for k, n in enumerate(names)}
        index = np.array([row_of[p] for p in viewpoints.participants])
        np.add.at(total[:, 0], index, values[:, areas.names.index(name)].astype(float))
        np.add.at(count[:, 0], index, 1.0)
    return total / np.maximum(count, 1), (count > 0).astype(float)


def _overall_mean(pair: tuple[np.ndarray, np.ndarray]) -> float:
    return float(pair[0].sum() / pair[1].sum())


def _what_if_row(
    name: str, measure: str, old, new, min_participants: MinParticipantsFilter, resamples: int, seed: int
) -> Row:
    mean = lambda pair: _overall_mean(pair) if pair[1].sum() else None
    num_participants = int(min(old[1].sum() or new[1].sum(), new[1].sum() or old[1].sum()))
    is_allowed = min_participants.allows(num_participants)
    row: Row = {"aoi": name, "measure": measure, "participants": num_participants if is_allowed else None}
    row |= {"before": mean(old) if is_allowed else None, "after": mean(new) if is_allowed else None}
    has_both = bool(old[1].sum() and new[1].sum())
    differences = (
        estimate_ratio_differences(old, new, resamples=resamples, seed=seed) if has_both and is_allowed else None
    )
    number = lambda v: float(v[0]) if np.isfinite(v[0]) else None
    keys = {"difference": "value", "low": "low", "high": "high", "p": "p"}
    row |= {k: None if differences is None else number(getattr(differences, v)) for k, v in keys.items()}
    return row | {"note": explain_difference(row, has_both, min_participants, is_allowed)}
