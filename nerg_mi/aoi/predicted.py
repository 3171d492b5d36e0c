"""Predicted attention on AOIs: for recorded viewpoints, for positions on the floor, after changes, with its
uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.tables import join_reasons
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.tracking.rays import Rays

from .areas import Areas
from .changes import Changes, apply_changes
from .estimates import estimate_ratio_differences
from .measured import AoiContext, facing_directions
from .placed import PlacedAreas
from .settings import ObserverGrid
from .shares import COARSE, SamplePoints, compute_visibility, find_standing_positions, gaze_shares, visible_in_fov
from .tables import (
    MEASURES_BY_NAME,
    MIN_VIEWPOINTS,
    PREDICTED,
    MinParticipantsFilter,
    Participants,
    Row,
    add_adjusted_p,
    explain_difference,
)
from .tracker_error import LEVELS, disturb_query
from .visits import ALL, Cell

# ---- Viewpoints ----


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """E viewpoints in the scene: ``positions`` and ``facing`` directions (E, 3), names of their participants, and
    the cells that each belongs to."""

    positions: np.ndarray
    facing: np.ndarray
    participants: tuple[str, ...]
    cells: tuple[frozenset[Cell], ...]


class ViewpointSampler:
    """Selects every n-th sample of a stream as a viewpoint, and at least one per block for each participant."""

    def __init__(self, stride: int):
        self._stride, self._num_passed = max(1, stride), 0
        self._poses: list[np.ndarray] = [np.zeros((0, 6))]
        self._participants: list[str] = []
        self._cells: list[frozenset[Cell]] = []
        self._interned: dict[frozenset[Cell], frozenset[Cell]] = {}

    def add(self, rays: Rays, context: AoiContext) -> None:
        """Select viewpoints from a block."""
        number = self._num_passed + np.arange(len(rays))
        is_chosen = number % self._stride == self._stride // 2
        order = np.argsort(rays.person, kind="stable")
        _, start, count = np.unique(rays.person[order], return_index=True, return_counts=True)
        has_none = ~np.logical_or.reduceat(is_chosen[order], start)
        is_chosen[order[(start + count // 2)[has_none]]] = True
        self._num_passed += len(rays)
        rows = np.flatnonzero(is_chosen)
        subset = rays.select(rows)
        positions, facing = (
            context.placed.environment.points_to_field(subset.origin),
            context.placed.environment.directions_to_field(facing_directions(subset)),
        )
        self._poses.append(np.hstack([positions, facing]))
        self._participants += [subset.persons[k] for k in subset.person.tolist()]
        cells = context.cell_masks(subset, positions)
        for k in range(len(rows)):
            row_cells = frozenset(cell for cell, mask in cells if mask is None or mask[k])
            self._cells.append(self._interned.setdefault(row_cells, row_cells))

    def viewpoints(self) -> Viewpoints:
        """Return all selected viewpoints."""
        poses = np.concatenate(self._poses)
        return Viewpoints(poses[:, :3], poses[:, 3:], tuple(self._participants), tuple(self._cells))


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
    disturbed
        Attention share with the error of the eye tracker added once more, and twice, (2, E, A); None if it is ignored.
    """

    share: np.ndarray
    distance: np.ndarray
    visible: np.ndarray
    support: np.ndarray
    members: np.ndarray
    note: str = ""
    disturbed: np.ndarray | None = None

    @property
    def corrected_share(self) -> np.ndarray:
        """Attention share extrapolated to no error, (E, A), as in `nerg_mi.aoi.tracker_error`. Needs ``disturbed``."""
        assert self.disturbed is not None
        once, twice = self.disturbed
        return 3 * self.share - 3 * once + twice


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
    placed: PlacedAreas, viewpoints: Viewpoints, fov: float, reporter: Reporter = SILENT, *, sigma: float = 0.0
) -> PredictedAttention:
    """Predict the attention of E viewpoints on areas, with a field of view of ``fov`` degrees. Requires a gaze field.

    Small areas use more directions than those of ``placed.sampling``. With the standard deviation ``sigma`` of the
    error of an eye tracker along an axis, in radians, the prediction is also made with this error added.
    """
    sampler = placed.sampler
    assert sampler is not None
    E, sampling = len(viewpoints.positions), placed.sampling
    on_progress = lambda done: reporter.progress(done / E, f"prediction: viewpoint {done} of {E}")
    rule = replace(COARSE, initial_directions=sampling.directions)
    of_areas = viewpoints.positions, placed.aois, placed.members, placed.margin, rule, on_progress
    shares, disturbed = gaze_shares(sampler.query_from, *of_areas), None
    if sigma > 0:
        # In a second sum, so that the prediction does not depend on the error. Differences between densities that are
        # summed over the same directions have the smallest errors.
        levels = gaze_shares(lambda eye: disturb_query(sampler.query_from(eye), sigma), *of_areas).members
        recorded, *added = (members.mean(axis=0) for members in np.split(levels, 1 + len(LEVELS)))
        disturbed = np.clip(shares.share + np.stack(added) - recorded, 0, 1)
    targets = SamplePoints.sample(placed.aois, sampling.aoi_samples)
    in_fov = visible_in_fov(
        targets,
        viewpoints.positions,
        viewpoints.facing,
        compute_visibility(targets, viewpoints.positions, placed.trace_depth, placed.margin),
        fov,
    )
    visible = np.stack([in_fov[:, list(indices)].any(axis=1) for indices in placed.members], axis=1)
    support = np.array([sampler.support_at(p) for p in viewpoints.positions])
    distance = shares.distance / placed.scale
    return PredictedAttention(shares.share, distance, visible, support, shares.members, disturbed=disturbed)


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


def place_observers_on_floor(placed: PlacedAreas, grid: ObserverGrid) -> np.ndarray:
    """Return standing positions (G, 3) on a grid. Raises `NergError` if there are none."""
    environment, scale = placed.environment, placed.scale
    bounds = environment.scene_geometry.bounds()
    if bounds is None:
        raise NergError("the bounds of the scene are unknown; give a scene or a radiance field")
    lower, upper = (np.array(corner, float) for corner in bounds)
    step, height = grid.grid_step * scale, grid.eye_height * scale
    positions = find_standing_positions(lower, upper, step, height, environment.trace_depth, grid.floor_height)
    if not len(positions):
        raise NergError(
            f"no walkable floor was found at height {grid.floor_height:g} ({parameter('floor_height')}) below eyes at "
            f"{grid.eye_height:g} ({parameter('eye_height')}); correct one of them, or give "
            f"{parameter('observers')}"
        )
    return positions


def viewpoints_at(positions: np.ndarray) -> Viewpoints:
    """Return a viewpoint of a separate observer, who may face any direction, at each of ``positions`` (M, 3)."""
    names = tuple(f"observer {k + 1:0{len(str(len(positions)))}d}" for k in range(len(positions)))
    return Viewpoints(positions, np.tile([1.0, 0, 0], (len(positions), 1)), names, (frozenset([ALL]),) * len(positions))


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


_OF_VISIBILITY = "visibility does not depend on the gaze field"
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

Predict = Callable[[PlacedAreas, Viewpoints], PredictedAttention]


def what_if_rows(
    changes: Changes,
    placed: PlacedAreas,
    viewpoints: Viewpoints,
    before: PredictedAttention,
    predict: Predict,
    suppression: MinParticipantsFilter,
    resamples: int,
    seed: int,
) -> list[Row]:
    """Compare predictions before and after ``changes``.

    Each row has an area, a measure (``share`` of gaze, ``corrected_share`` if ``before`` has it, or ``visible`` share
    of time), the values ``before`` and ``after``, the ``difference`` with its interval over participants, the standard
    deviation of the difference over ensemble members (``difference_spread``), and the median ``support`` after the
    changes. Raises `NergError`.

    Parameters
    ----------
    changes
        Changes.
    placed
        Areas before the changes.
    viewpoints, before
        Viewpoints and their prediction before the changes.
    predict
        Predicts the attention of viewpoints after the changes.
    suppression
        Suppresses values of few participants.
    resamples, seed
        Number and seed of the bootstrap draws.
    """
    changed = apply_changes(placed, changes)
    areas, after_areas = placed.areas, changed.areas
    changed_viewpoints = viewpoints
    if changes.observers is not None:
        changed_viewpoints = viewpoints_at(changes.observers)
    if changes.shift is not None:
        changed_viewpoints = replace(changed_viewpoints, positions=changed_viewpoints.positions + changes.shift)
    after = predict(changed, changed_viewpoints)
    # Participants with viewpoints before and after the changes are paired.
    names = sorted({*viewpoints.participants, *changed_viewpoints.participants})
    support = median_support(after)
    rows: list[Row] = []
    corrected = "corrected_share"
    for name in dict.fromkeys((*areas.names, *after_areas.names)):
        for measure in ("share", *(() if before.disturbed is None else (corrected,)), "visible"):
            old_sums = _mean_by_participant(viewpoints, names, getattr(before, measure), areas, name)
            new_sums = _mean_by_participant(changed_viewpoints, names, getattr(after, measure), after_areas, name)
            row = _what_if_row(name, measure, old_sums, new_sums, suppression, resamples, seed)
            if measure == corrected:  # as in the table of the tracker's error
                row |= {key: None if row[key] is None else min(max(row[key], 0.0), 1.0) for key in ("before", "after")}
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
                reason = {"share": _NO_MEMBERS, corrected: "members are not corrected"}.get(measure, _OF_VISIBILITY)
                reasons["no difference" if row["difference"] is None else reason] = ["difference_spread"]
            row["note"] = "; ".join(filter(None, (after.note, row["note"], join_reasons(reasons))))
            rows.append(row | {"support": support, "source": PREDICTED})
    # The correction tests the same differences again.
    add_adjusted_p([row for row in rows if row["measure"] != corrected])
    add_adjusted_p([row for row in rows if row["measure"] == corrected])
    return rows


def _mean_by_participant(
    viewpoints: Viewpoints, names: list[str], values: np.ndarray, areas: Areas, name: str
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
    name: str, measure: str, old, new, suppression: MinParticipantsFilter, resamples: int, seed: int
) -> Row:
    mean = lambda pair: _overall_mean(pair) if pair[1].sum() else None
    num_participants = int(min(old[1].sum() or new[1].sum(), new[1].sum() or old[1].sum()))
    is_allowed = suppression.admit(num_participants)
    row: Row = {"aoi": name, "measure": measure, "participants": num_participants if is_allowed else None}
    row |= {"before": mean(old) if is_allowed else None, "after": mean(new) if is_allowed else None}
    has_both = bool(old[1].sum() and new[1].sum())
    differences = (
        estimate_ratio_differences(old, new, resamples=resamples, seed=seed) if has_both and is_allowed else None
    )
    number = lambda v: float(v[0]) if np.isfinite(v[0]) else None
    keys = {"difference": "value", "low": "low", "high": "high", "p": "p"}
    row |= {k: None if differences is None else number(getattr(differences, v)) for k, v in keys.items()}
    return row | {"note": explain_difference(row, has_both, suppression, is_allowed)}
