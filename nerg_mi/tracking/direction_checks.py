"""Checks of rays for implausible directions: mirrored or reversed directions, tested with heads, walking and hit
points, and frames that differ between participants."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import parameter

from .checks import (
    MAX_CHECKED_RAYS,
    MIN_RAYS,
    Check,
    RayStatistics,
    check,
    group_medians,
    list_names,
    list_persons,
    to_source,
)
from .rays import Rays

# ---- Participants or recordings in different frames ----

_MAX_SESSION_ROWS, _MIN_SESSION_RAYS = 1000, 100  # rays of a recording: used at most, and required
_MAX_SESSIONS = 1000
_HEAD_HEIGHTS = 0.9, 2.0  # metres above the floor
_MAX_ABOVE, _MAX_BELOW = 0.5, 0.85  # metres from the typical height; no posture or stature explains more
_MAX_BOX_GAP = 10.0  # metres between recordings of one environment
_CELL_SIZE = 0.5  # metres
# Fraction of floor cells that two recordings of one frame share, and that match after a change of axes.
_MIN_SHARED_CELLS, _MIN_MATCHING_CELLS = 0.1, 0.7
_MIN_CELLS = 8
_AXIS_CHANGES = {"x negated": (0, 1, -1, 1), "y negated": (0, 1, 1, -1), "x and y negated": (0, 1, -1, -1)}
_AXIS_CHANGES |= {"x and y exchanged": (1, 0, 1, 1), "a turn by 90 degrees": (1, 0, -1, 1)}
_AXIS_CHANGES |= {"a turn by -90 degrees": (1, 0, 1, -1), "x and y exchanged and negated": (1, 0, -1, -1)}


@dataclass(frozen=True, eq=False)
class _SessionPositions:
    """Head positions in each of S recordings."""

    name: list[str]
    height: np.ndarray  # (S,) median, metres
    box: np.ndarray  # (S, 2, 2) minimum and maximum on the floor, without outliers, metres
    cells: list[np.ndarray]  # (C, 2) integer coordinates of the floor cells visited, per recording


@check(
    "participants or recordings with heads at implausible heights, far from all others, or, with axes negated or "
    "exchanged, at positions of the others (import them separately, `nerg align`)"
)
def check_frames(stats: RayStatistics) -> list[str]:
    stays = _summarise_sessions(stats)
    if len(stays.name) < 2:
        return []
    out, reported = [], np.zeros(len(stays.name), bool)
    for find_odd in (_check_heights, _check_boxes, _check_floors):
        if find_odd is _check_heights and not stats.is_floor_at_zero:
            continue
        messages, is_odd = find_odd(stays, reported)
        out += messages
        reported |= is_odd
    return out


def _summarise_sessions(stats: RayStatistics) -> _SessionPositions:
    rays, sessions = stats.rays, stats.sessions
    long = np.flatnonzero(np.diff(sessions.starts) >= _MIN_SESSION_RAYS)
    long = long[:: max(1, -(-len(long) // _MAX_SESSIONS))]
    has_several = np.bincount(sessions.person[long], minlength=len(rays.persons)) > 1
    names, heights, boxes, cells = [], [], [], []
    for s in long.tolist():
        a, b = sessions.starts[s : s + 2]
        positions = np.arange(a, b, max(1, (b - a) // _MAX_SESSION_ROWS))
        rows = positions if sessions.order is None else sessions.order[positions]
        origin, p = rays.origin[rows], sessions.person[s]
        names.append(rays.persons[p] + (f" (from {rays.t[rows[0]]:.6g} s)" if has_several[p] else ""))
        heights.append(np.median(origin[:, 2]))
        boxes.append(np.percentile(origin[:, :2], [2, 98], axis=0))
        cell = np.floor(origin[:, :2] / _CELL_SIZE)
        cells.append(cell[np.unique(_encode_cells(cell), return_index=True)[1]])
    return _SessionPositions(names, np.array(heights), np.array(boxes).reshape(-1, 2, 2), cells)


def _encode_cells(cells: np.ndarray) -> np.ndarray:
    """Encode each of the cells (C, 2) as one number (C,)."""
    return cells[:, 0] * 2.0**21 + cells[:, 1]


def _check_heights(stays: _SessionPositions, reported: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Find recordings whose heads are higher or lower than people's."""
    is_head_height = (stays.height > _HEAD_HEIGHTS[0]) & (stays.height < _HEAD_HEIGHTS[1])
    if is_head_height.mean() < 0.5:
        return [], reported & False  # all are wrong; check_lengths reports this
    typical = float(np.median(stays.height[is_head_height]))
    is_odd = (stays.height > typical + _MAX_ABOVE) | (stays.height < typical - _MAX_BELOW)
    if not is_odd.any() or is_odd.all():
        return [], reported & False
    height = float(np.median(stays.height[is_odd]))
    ratio = abs(height / typical) if typical else 0.0
    unit = next((name for name, size in (("cm", 100), ("mm", 1000)) if 0.7 < ratio / size < 1.4), None)
    remedy = (
        f"is their unit {unit}? Import them separately ({parameter('units', unit)})"
        if unit
        else "do they have another floor or origin? Import them separately, and align them (nerg align)"
    )
    names = list_names([stays.name[s] for s in np.flatnonzero(is_odd)])
    return [
        f"the heads of {names} are at a height of {height:.2f} m, those of the others at {typical:.2f} m; {remedy}"
    ], is_odd


def _check_boxes(stays: _SessionPositions, reported: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Find recordings that are too far from all others for one environment."""
    from scipy.sparse.csgraph import connected_components

    low, high = stays.box[:, 0], stays.box[:, 1]
    # Compare the gap between two boxes with their size.
    gap = np.maximum(0.0, np.maximum(low[:, None] - high[None], low[None] - high[:, None]))
    size = np.linalg.norm(high - low, axis=1)
    near = np.linalg.norm(gap, axis=2) <= np.maximum(_MAX_BOX_GAP, np.maximum(size[:, None], size[None]))
    _, group = connected_components(near, directed=False)
    main = np.argmax(np.bincount(group))
    is_odd = (group != main) & ~reported
    if not is_odd.any():
        return [], is_odd
    names = list_names([stays.name[s] for s in np.flatnonzero(is_odd)])
    distance = np.linalg.norm(gap[is_odd][:, group == main], axis=2).min()
    return [
        f"{names} is {distance:.0f} m or more from all other recordings: is this another frame, or another "
        "environment? Import them separately, and align them (nerg align)"
    ], is_odd


def _check_floors(stays: _SessionPositions, reported: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Find recordings that share no floor cells with the others, but do so after negating or exchanging axes."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    codes = [_encode_cells(cells) for cells in stays.cells]
    size = np.array([len(cells) for cells in codes])
    _, cell_index = np.unique(np.concatenate(codes), return_inverse=True)
    visits = csr_matrix((np.ones(len(cell_index)), (np.repeat(np.arange(len(codes)), size), cell_index)))
    shared = (visits @ visits.T).toarray() / np.minimum(size[:, None], size[None])
    _, group = connected_components(shared >= _MIN_SHARED_CELLS, directed=False)
    main = np.argmax(np.bincount(group))
    main_codes = np.concatenate([codes[s] for s in np.flatnonzero(group == main)])
    is_odd, names = np.zeros(len(codes), bool), {}
    for g in np.unique(group[(group != main) & ~reported]):
        members = np.flatnonzero((group == g) & ~reported)
        cells = np.concatenate([stays.cells[s] for s in members])
        if len(cells) < _MIN_CELLS:
            continue
        # Negation maps cell c to cell -1 - c.
        fractions = {
            change: float(np.isin(_encode_cells(np.stack(_change_axes(cells, *how), axis=1)), main_codes).mean())
            for change, how in _AXIS_CHANGES.items()
        }
        best = max(fractions, key=fractions.__getitem__)
        if fractions[best] > _MIN_MATCHING_CELLS:
            is_odd[members] = True
            names.setdefault(best, []).extend(stays.name[s] for s in members)
    return [
        (
            f"{list_names(odd_names)} walks where no other participant does; with {change} (of rays) the positions "
            f"would match: is this another frame? Import it separately ({parameter('up')}, {parameter('handedness')}), "
            "or align it (nerg align)"
        )
        for change, odd_names in names.items()
    ], is_odd


def _change_axes(cells: np.ndarray, a: int, b: int, sign_a: int, sign_b: int) -> list[np.ndarray]:
    return [cells[:, i] if sign > 0 else -1 - cells[:, i] for i, sign in ((a, sign_a), (b, sign_b))]


# ---- Gaze relative to the head: the eyes rotate by at most 50 degrees, and rarely by more than 30 ----

_MIN_COSINE = 0.5  # of 60 degrees
_MIN_BEYOND_FRACTION, _MIN_BEYOND_RAYS = 0.02, 20  # of a participant's rays; 0 in 44 correct recordings
# Lengths of the mean direction of concentrated and of dispersed directions.
_MIN_CONCENTRATED_LENGTH, _MAX_DISPERSED_LENGTH = 0.85, 0.75
# Correlation of gaze and head along an axis; 0.75 and more in correct recordings.
_MAX_OPPOSED_CORRELATION, _MIN_FOLLOWING_CORRELATION = -0.3, 0.2
_MIN_SPREADS = 0.1, 0.2  # standard deviation of heads along that axis that each test needs
_MIN_PERSON_RAYS = 200  # rays of a participant
_BLOCK = 1 << 18


def _select_runs(n: int, max_rows: int, run_length: int) -> np.ndarray:
    """Rows (m,) of ``n``: all, or, if ``n`` exceeds ``max_rows``, evenly spread runs of ``run_length`` neighbours."""
    if n <= max_rows:
        return np.arange(n)
    first = np.linspace(0, n - run_length, max_rows // run_length).astype(np.int64)
    return (first[:, None] + np.arange(run_length)).ravel()


def _name_negated_axes(signs: Sequence[float]) -> str:
    """Join the names of negative axes: ``x and z`` for (-1, 1, -1)."""
    return " and ".join(axis for axis, sign in zip("xyz", signs) if sign < 0)


_SIGNS = sorted(itertools.product((1.0, -1.0), repeat=3), key=lambda signs: -sum(signs))
"""Sign combinations of the three axes, those with the fewest negations first."""


@check(
    "directions more than 60 degrees from the direction of the head: concentrated around one direction of the world "
    "(gaze in the head's frame declared as gaze in the world), around another axis of the head (`--forward`), or "
    "correct after negating an axis (`--hand`); gaze that moves opposite to the head, or independently of it"
)
def check_head(stats: RayStatistics) -> list[str]:
    rays = stats.rays
    if rays.head is None:
        return []
    is_beyond, has_head = np.empty((2, len(rays)), bool)
    for a in range(0, len(rays), _BLOCK):
        rows = slice(a, a + _BLOCK)
        cosine = np.einsum("ij,ij->i", rays.head[rows], rays.direction[rows])
        has_head[rows] = np.isfinite(cosine)
        is_beyond[rows] = cosine < _MIN_COSINE
    # Frozen gaze has a check of its own.
    has_head &= ~stats.is_frozen
    is_beyond &= has_head
    count = len(rays.persons)
    num_beyond, num_rays = (np.bincount(rays.person[mask], minlength=count) for mask in (is_beyond, has_head))
    persons = np.flatnonzero((num_beyond >= _MIN_BEYOND_RAYS) & (num_beyond > _MIN_BEYOND_FRACTION * num_rays))
    if not persons.size:
        return _check_following(stats, rays.head, has_head)
    wrong = np.zeros(count, bool)
    wrong[persons] = True
    percent = 100 * num_beyond[persons].sum() / num_rays[persons].sum()
    suffix = "" if len(persons) == np.count_nonzero(num_rays) else f" of {list_persons(rays, persons)}"
    rows = np.flatnonzero(has_head & wrong[rays.person])
    return [
        f"{percent:.0f} % of the directions{suffix} are more than 60 degrees from the direction of the head; "
        + (
            _suggest_mirror(stats, rays.head, rows)
            or _suggest_frame(stats, rays.head, np.flatnonzero(is_beyond & wrong[rays.person]))
        )
    ]


def _check_following(stats: RayStatistics, heads: np.ndarray, has_head: np.ndarray) -> list[str]:
    """Find participants whose gaze moves opposite to the head along an axis of the file, or independently of it."""
    rays = stats.rays
    (rows,) = np.nonzero(has_head)
    rows = rows[:: max(1, len(rows) // MAX_CHECKED_RAYS)]
    R, person, count = to_source(rays), rays.person[rows], len(rays.persons)
    head, d, n = heads[rows] @ R.T, rays.direction[rows] @ R.T, np.bincount(person, minlength=count)
    mean = lambda v: np.stack([np.bincount(person, weights=c, minlength=count) for c in v.T]) / np.maximum(n, 1)
    (mh, md), cross = (mean(head), mean(d)), mean(head * d)
    spread = np.sqrt(np.maximum(mean(head**2) - mh**2, 0.0))
    r = (cross - mh * md) / np.maximum(spread * np.sqrt(np.maximum(mean(d**2) - md**2, 0.0)), 1e-12)
    is_opposed = (n >= _MIN_PERSON_RAYS) & (spread > _MIN_SPREADS[0]) & (r < _MAX_OPPOSED_CORRELATION)
    is_unrelated = (n >= _MIN_PERSON_RAYS) & (spread > _MIN_SPREADS[1]) & (r < _MIN_FOLLOWING_CORRELATION) & ~is_opposed
    out = []
    for axes in np.unique(is_opposed[:, is_opposed.any(axis=0)].T, axis=0):
        names = list_persons(rays, np.flatnonzero((is_opposed.T == axes).all(axis=1)))
        which = " and ".join("xyz"[i] for i in np.flatnonzero(axes))
        out.append(
            f"along {which} of the file the gaze of {names} moves opposite to the head: negate {which} of the "
            f"directions, or check their frame ({parameter('handedness')})"
        )
    if is_unrelated.any():
        names = list_persons(rays, np.flatnonzero(is_unrelated.any(axis=0)))
        out.append(
            f"the gaze of {names} does not follow the head: check whether it is in the head's frame "
            f"({parameter('preset', 'unity_local')}, or the head's pose in {parameter('columns')}), and whether "
            "the head is of the same participant"
        )
    return out


def _suggest_mirror(stats: RayStatistics, heads: np.ndarray, rows: np.ndarray) -> str:
    """Suggest negating axes of the file, if this brings all directions near the direction of the head; else ""."""
    rays, rows = stats.rays, rows[:: max(1, len(rows) // MAX_CHECKED_RAYS)]
    R = to_source(rays)
    head, d = heads[rows] @ R.T, rays.direction[rows] @ R.T
    for signs in _SIGNS[1:]:
        if np.mean(np.einsum("ij,ij->i", head, d * signs) < _MIN_COSINE) < 0.5 * _MIN_BEYOND_FRACTION:
            which = f"{_name_negated_axes(signs)} of the directions"
            return (
                f"with {which} negated this would not occur: check their frame ({parameter('handedness')}, "
                f"{parameter('forward')})"
            )
    return ""


def _suggest_frame(stats: RayStatistics, heads: np.ndarray, rows: np.ndarray) -> str:
    """Suggest a remedy from what the directions ``rows`` far from the head have in common."""
    rays, rows = stats.rays, rows[:: max(1, len(rows) // MAX_CHECKED_RAYS)]
    head, d = heads[rows].astype(np.float64), rays.direction[rows]
    gaze_in_head = np.einsum("nij,nj->ni", compute_head_frames(head), d)
    in_world, in_head = (np.linalg.norm(v.mean(axis=0)) for v in (d, gaze_in_head))
    if in_world > _MIN_CONCENTRATED_LENGTH and in_head < _MAX_DISPERSED_LENGTH:
        return (
            "they keep one direction of the file however the head turns: are they in the head's frame? "
            f"({parameter('preset', 'unity_local')}, or the head's pose in {parameter('columns')})"
        )
    if in_head > _MIN_CONCENTRATED_LENGTH and in_world < _MAX_DISPERSED_LENGTH:
        ahead, right, up = gaze_in_head.mean(axis=0)
        side = max(
            {"back": -ahead, "right": right, "left": -right, "up": up, "down": -up}.items(), key=lambda at: at[1]
        )[0]
        return (
            f"relative to the head they point {side}: is another axis of the head its forward axis? "
            f"({parameter('forward')})"
        )
    return (
        "check the order of the quaternion (xyzw or wxyz), and whether the directions are already in the world "
        f"frame ({parameter('preset', 'unity')}, or direction without a pose in {parameter('columns')})"
    )


AXIS_SWAPS = {
    "left and right": (1.0, -1.0, 1.0),
    "up and down": (1.0, 1.0, -1.0),
    "left and right, and up and down,": (1.0, -1.0, -1.0),
}
"""Swapped sides of the eyes, with the signs of directions (ahead, right, up) in the head (`compute_head_frames`)."""


def compute_head_frames(head: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) from the world to (ahead, right, up) of heads (n, 3) without roll."""
    right = np.cross(head, (0.0, 0.0, 1.0))
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-9)
    return np.stack([head, right, np.cross(right, head)], axis=1)


# ---- Gaze mirrored in the head's frame, detected by the vestibulo-ocular reflex (VOR) ----
#
# When the head turns, the eyes counter-rotate, so that gaze is stable in the world. If left and right, or up and down,
# of the eyes are swapped, gaze turns with the head instead, and twice as fast as the head.

_LAG = 0.08  # seconds between the two directions compared; a fixation lasts 0.2 and more
_TURN_RATES = 20.0, 200.0  # degrees per second; range of head rotation speeds evaluated
_MAX_TURN_RATIO = 0.88  # with against without a swap; in 44 correct recordings each swap gives 1.26 and more
_MIN_VOR_STEPS = 300
_VOR_RUNS = 1 << 18, 1 << 10  # maximum number of rays, and the length of the runs


@check("gaze that turns with the head instead of against it: left and right, or up and down, of the eyes swapped")
def check_vor(stats: RayStatistics) -> list[str]:
    rays = stats.rays
    if rays.head is None or stats.is_subsampled:
        return []
    turns, person = _measure_gaze_turns(stats, rays.head)
    if len(person) < _MIN_VOR_STEPS:
        return []
    if swap := _find_best_swap(turns):
        return [_describe_swap(swap, "")]
    names_by_swap: dict[str, list[str]] = {}
    for p in np.flatnonzero(np.bincount(person) >= _MIN_VOR_STEPS):
        if swap := _find_best_swap(turns[:, person == p]):
            names_by_swap.setdefault(swap, []).append(rays.persons[p])
    return [_describe_swap(swap, f" of {list_names(names)}") for swap, names in names_by_swap.items()]


def _describe_swap(swap: str, suffix: str) -> str:
    return (
        f"the gaze{suffix} turns with the head instead of against it; with {swap} of the eyes swapped it would be "
        "stable: negate that component of the direction in the head's frame, or check the frame "
        f"({parameter('handedness')})"
    )


def _find_best_swap(turns: np.ndarray) -> str:
    """Find the swap with the smallest median turn of gaze (4, n), if it is clearly below that without a swap."""
    unswapped, *swapped = np.median(turns, axis=1)
    best = int(np.argmin(swapped))
    return list(AXIS_SWAPS)[best] if swapped[best] < _MAX_TURN_RATIO * unswapped else ""


def _measure_gaze_turns(stats: RayStatistics, heads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles (4, n) by which gaze turns while the head does, unchanged and with each swap, and person codes (n,)."""
    rays, rows = stats.rays, _select_runs(len(stats.rays), *_VOR_RUNS)
    rows = rows if stats.order is None else stats.order[rows]
    t, person = rays.t[rows], rays.person[rows]
    step = np.diff(t)[np.diff(person) == 0]
    step = step[(step > 0) & (step < _LAG)]
    empty = np.empty((4, 0)), np.empty(0, np.int64)
    if not step.size:
        return empty
    lag = max(1, round(_LAG / float(np.median(step))))
    if len(rows) <= lag:
        return empty
    dt, head = t[lag:] - t[:-lag], heads[rows].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.degrees(np.linalg.norm(head[lag:] - head[:-lag], axis=1)) / dt
    is_used = (
        (person[lag:] == person[:-lag])
        & (dt > 0)
        & (dt < 2 * _LAG)
        & (speed > _TURN_RATES[0])
        & (speed < _TURN_RATES[1])
    )
    is_used &= ~stats.is_frozen[rows[lag:]]
    (first,) = np.nonzero(is_used)
    frames = [compute_head_frames(head[first + k]) for k in (0, lag)]
    gaze_in_head = [np.einsum("nij,nj->ni", f, rays.direction[rows[first + k]]) for f, k in zip(frames, (0, lag))]
    turns = []
    for signs in ((1.0, 1.0, 1.0), *AXIS_SWAPS.values()):
        before, after = (np.einsum("nij,ni->nj", f, v * signs) for f, v in zip(frames, gaze_in_head))
        turns.append(np.linalg.norm(after - before, axis=1))
    return np.array(turns), person[first]


# ---- Gaze at a constant angle to the head: a delayed or rotated copy of the head's direction ----

# Median angle in degrees to the mean direction in the head; 7 and more in 44 recordings of looking around.
_MAX_OFF_DEGREES = 4.0
# Minimum of 1 - length of the mean direction of heads: they turn within a cone of 40 degrees.
_MIN_HEAD_SPREAD = 0.25
_MIN_LOCKED_RAYS = 500  # rays of a participant


@check("gaze at a constant angle to the head while the head looks around (`nerg rays filter`)")
def check_locked(stats: RayStatistics) -> list[str]:
    rays = stats.rays
    if rays.head is None:
        return []
    (rows,) = np.nonzero(~stats.is_frozen & np.isfinite(rays.head[:, 0]))
    rows = rows[:: max(1, len(rows) // MAX_CHECKED_RAYS)]
    person, count = rays.person[rows], len(rays.persons)
    n, heads = np.bincount(person, minlength=count), rays.head[rows].astype(np.float64)
    gaze_in_head = np.einsum("nij,nj->ni", compute_head_frames(heads), rays.direction[rows])
    mean = lambda v: (
        np.stack([np.bincount(person, weights=c, minlength=count) for c in v.T], axis=1) / np.maximum(n[:, None], 1)
    )
    mean_direction = mean(gaze_in_head)
    mean_direction /= np.maximum(np.linalg.norm(mean_direction, axis=1, keepdims=True), 1e-12)
    off_degrees = np.degrees(
        2 * np.arcsin(np.minimum(1.0, 0.5 * np.linalg.norm(gaze_in_head - mean_direction[person], axis=1)))
    )
    has_turned = np.linalg.norm(mean(heads), axis=1) < 1 - _MIN_HEAD_SPREAD
    persons = np.flatnonzero(
        (n >= _MIN_LOCKED_RAYS) & has_turned & (group_medians(off_degrees, person, count) < _MAX_OFF_DEGREES)
    )
    if not persons.size:
        return []
    return [
        f"the gaze of {list_persons(rays, persons)} stays within {_MAX_OFF_DEGREES:g} degrees of one direction in the "
        "head, as if it were the head's direction: were the eyes tracked? Exclude these participants "
        "(nerg rays filter --without-person)"
    ]


# ---- Mirrored directions ----
#
# Directions that are mirrored relative to the environment: with the right axis negated, more gaze ends on a surface.

TraceFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Returns distances (N,) along unit directions (N, 3) from origins (N, 3) to the first surface; not finite for none."""

DECLARED = "as declared"  # Key of the directions without a negated axis
_MIN_MIRROR_GAIN = 0.02  # minimum gain in the hit fraction by a reflection, in addition to three standard errors


def compute_hit_fractions(
    trace: TraceFunction, origins: np.ndarray, directions: np.ndarray, to_source: np.ndarray | None = None
) -> dict[str, float]:
    """Fractions of rays that end on a surface, for the declared directions and with each combination of negated axes.

    Parameters
    ----------
    trace
        Traces rays against the surfaces.
    origins, directions
        (N, 3) each, in the frame of ``trace``.
    to_source
        Rotation or reflection (3, 3) from that frame to the axes to negate, those of the tracking file. Default:
        identity.

    Returns
    -------
    dict
        Fractions by `DECLARED`, ``x``, ``y``, ``z``, ``x and y``, ...
    """
    R = np.eye(3) if to_source is None else to_source
    fractions = {}
    for signs in _SIGNS:
        changed = directions @ (R.T * signs) @ np.linalg.inv(R).T
        fractions[_name_negated_axes(signs) or DECLARED] = float(np.mean(np.isfinite(trace(origins, changed))))
    return fractions


def describe_mirroring(fractions: dict[str, float], count: int) -> str | None:
    """Describe a likely reflection: one negated axis raises the hit fraction significantly; None if none does.

    Parameters
    ----------
    fractions
        Fractions from `compute_hit_fractions`.
    count
        Number of rays that these are of.

    Notes
    -----
    Several negated axes are a rotation, or a reflection and a rotation, and are not tested: rooms look similar in all
    directions.
    """
    declared, single = fractions[DECLARED], {axis: fractions[axis] for axis in "xyz"}
    best = max(single, key=single.__getitem__)
    error = np.sqrt(max(declared * (1 - declared) + single[best] * (1 - single[best]), 1e-12) / max(count, 1))
    if single[best] - declared <= max(_MIN_MIRROR_GAIN, 3 * error):
        return None
    return (
        f"{100 * declared:.1f} % of the gaze ends on a surface; with {best} of the directions negated it would be "
        f"{100 * single[best]:.1f} %: is the frame mirrored? ({parameter('handedness')}, or the sign of {best})"
    )


# ---- Frame of the directions, from walking: people look where they walk ----

_MIN_CORRELATION = 0.2  # correlation of gaze and walking along an axis
_WALK_RUNS = 1 << 19, 1 << 11  # maximum number of rays, and the length of runs in which neighbours matter
_PERSON_LIMITS = 0.3, 500  # correlation and number of steps for statements about one participant
_MIN_STEPS = 200  # half-second steps for a statement about walking
# Lengths of the mean direction: of gaze that keeps one direction, and of headings in many directions.
_MIN_FIXED_GAZE_LENGTH, _MAX_HEADING_LENGTH = 0.85, 0.5


@dataclass(frozen=True, eq=False)
class WalkingSteps:
    """W half-second steps of walking participants, horizontal components only, along the axes of the file."""

    heading: np.ndarray  # (W, 3) unit
    gaze: np.ndarray  # (W, 3) horizontal part of the unit gaze directions
    person: np.ndarray  # (W,) codes of participants


def find_walking_disagreements(stats: RayStatistics) -> list[str]:
    """Find directions that disagree with walking, of all or of some participants: reversed, mirrored, or independent of
    the heading."""
    rays = stats.rays
    steps = _find_walking_steps(rays, stats.order, stats.is_frozen)
    if len(steps.heading) < _MIN_STEPS:
        return []
    if rays.head is None and _is_gaze_fixed(steps):
        return [
            "the directions keep one direction of the file, whichever way people walk: are they in the head's "
            f"frame? ({parameter('preset', 'unity_local')}, or the head's pose in {parameter('columns')})"
        ]
    if message := _describe_disagreement(_correlate_steps(steps), "people", _MIN_CORRELATION):
        return [message]
    names_by_message, fixed = {}, []
    for p in np.flatnonzero(np.bincount(steps.person) >= _PERSON_LIMITS[1]):
        is_person = steps.person == p
        person_steps = WalkingSteps(steps.heading[is_person], steps.gaze[is_person], steps.person[is_person])
        if rays.head is None and _is_gaze_fixed(person_steps):
            fixed.append(rays.persons[p])
        elif message := _describe_disagreement(_correlate_steps(person_steps), "{}", _PERSON_LIMITS[0]):
            names_by_message.setdefault(message, []).append(rays.persons[p])
    out = [text.replace("{}", list_names(names)) for text, names in names_by_message.items()]
    if fixed:
        out.append(
            f"the directions of {list_names(fixed)} keep one direction of the file, whichever way they walk; those "
            f"of others do not: are they in the head's frame? ({parameter('preset', 'unity_local')}, or the head's "
            f"pose in {parameter('columns')})"
        )
    return out


def _describe_disagreement(correlations: np.ndarray, subject: str, min_correlation: float) -> str:
    against = [i for i in range(3) if correlations[i] < -min_correlation]
    along = [i for i in range(3) if correlations[i] > _MIN_CORRELATION]
    if against and not along:
        verb = "look opposite to their direction of walking"
        return f"{subject} {verb}: are the directions reversed? ({parameter('forward')}, or the sign of the direction)"
    if against:
        return (
            f"along {' and '.join('xyz'[i] for i in against)} of the file {subject} look opposite to their "
            f"walking: are positions and directions mirrored relative to each other? ({parameter('handedness')})"
        )
    return ""


def _is_gaze_fixed(steps: WalkingSteps) -> bool:
    """Whether gaze keeps one direction while people walk in many, uncorrelated with their heading."""
    length = np.maximum(np.linalg.norm(steps.gaze, axis=1, keepdims=True), 1e-12)
    gaze, heading = steps.gaze / length, steps.heading
    mean_gaze, mean_heading = gaze.mean(axis=0), heading.mean(axis=0)
    correlations = _correlate_steps(WalkingSteps(heading - mean_heading, gaze - mean_gaze, steps.person))
    lengths = np.linalg.norm(mean_gaze), np.linalg.norm(mean_heading)
    return bool(
        lengths[0] > _MIN_FIXED_GAZE_LENGTH
        and lengths[1] < _MAX_HEADING_LENGTH
        and (np.abs(correlations) < _MIN_CORRELATION).all()
    )


def _correlate_steps(steps: WalkingSteps) -> np.ndarray:
    v, d = steps.heading, steps.gaze
    norm = np.sqrt((v**2).mean(axis=0) * (d**2).mean(axis=0))
    # An axis with hardly any walking is not informative.
    fraction = (v**2).mean(axis=0)
    return np.where(fraction > 0.05, (v * d).mean(axis=0) / np.maximum(norm, 1e-12), 0.0)


def _find_walking_steps(rays: Rays, order: np.ndarray | None, excluded: np.ndarray | None = None) -> WalkingSteps:
    rows = _select_runs(len(rays), *_WALK_RUNS)
    order = rows if order is None else order[rows]
    t, person = rays.t[order], rays.person[order]
    starts = np.r_[np.flatnonzero(np.r_[True, np.diff(person) != 0]), len(t)]
    later = np.minimum(np.arange(len(t)) + _count_lag_rays(t, starts), len(t) - 1)
    dt = t[later] - t
    is_step = (person[later] == person) & (dt > 0) & (dt < 2.0)
    moved = (rays.origin[order[later]] - rays.origin[order])[is_step]
    moved[:, 2] = 0
    speed = np.linalg.norm(moved, axis=1) / dt[is_step]
    is_walking = (speed > 0.3) & (speed < 3.0)
    if excluded is not None:
        is_walking &= ~excluded[order[is_step]]
    R = to_source(rays)
    d = rays.direction[order[is_step]][is_walking] * (1, 1, 0)
    v = moved[is_walking] / np.linalg.norm(moved[is_walking], axis=1, keepdims=True)
    return WalkingSteps(v @ R.T, d @ R.T, person[is_step][is_walking])


def _count_lag_rays(t: np.ndarray, starts: np.ndarray) -> int:
    """Number of rays in half a second."""
    step = np.diff(t)
    step[starts[1:-1] - 1] = np.inf
    step = step[(step > 0) & (step <= 1.0)]
    # Intervals may be so small that the quotient exceeds any index.
    return max(1, round(min(0.5 / np.median(step), len(t)))) if step.size else 1


# ---- Frame of the directions ----
#
# A mirrored or reversed direction disagrees with the hit point, or with the direction of walking. A frame that is
# mirrored as a whole, positions and directions, is consistent and cannot be detected without the environment.

_MAX_ANGLES = 5.0, 10.0  # degrees between direction and hit point: median, and of single rays
_MIN_OFF_FRACTION = 0.05  # of rays that miss their hit points
_MIN_HIT_DISTANCE = 0.2  # metres; directions to nearer hit points are imprecise
_MIN_HITS = 20  # hit points for a statement
_MAX_ELEVATION = 50.0  # degrees up or down; of half of the rays


@check(
    "directions that miss the hit points, with the signs that would correct them; without hit points, directions "
    "opposite to walking, and steep gaze (`--hand`, `--forward`)"
)
def check_directions(stats: RayStatistics) -> list[str]:
    """Check the frame of the directions with the hit points or, if these give no result, with elevation and walking."""
    return _check_hits(stats.rays) or [*_check_elevation(stats.rays), *find_walking_disagreements(stats)]


def _check_hits(rays: Rays) -> list[str]:
    if rays.hit is None:
        return []
    R = to_source(rays)
    rows = np.flatnonzero(np.isfinite(rays.hit).all(axis=1))
    rows = rows[:: max(1, len(rows) // MAX_CHECKED_RAYS)]
    to_hit = (rays.hit[rows] - rays.origin[rows]) @ R.T
    length = np.linalg.norm(to_hit, axis=1)
    is_far = length > _MIN_HIT_DISTANCE
    if is_far.sum() < _MIN_HITS:
        return []
    to_hit, d, person = (
        to_hit[is_far] / length[is_far, None],
        rays.direction[rows][is_far] @ R.T,
        rays.person[rows][is_far],
    )
    angles = lambda v: np.degrees(np.arccos(np.clip(np.sum(v * to_hit, axis=1), -1, 1)))
    errors = angles(d)
    is_off, subject = np.ones(len(d), bool), "the directions miss"
    if not np.median(errors) > _MAX_ANGLES[0]:
        is_off = errors > _MAX_ANGLES[1]
        if not is_off.mean() > _MIN_OFF_FRACTION:
            return []
        wrong = np.bincount(person, weights=is_off) > 0.5 * np.maximum(np.bincount(person), 1)
        persons_text = f", those of {list_persons(rays, np.flatnonzero(wrong))}," if wrong.any() else ""
        subject = f"{100 * is_off.mean():.0f} % of the directions{persons_text} miss"
    median_error = float(np.median(errors[is_off]))
    errors_by_axes = {
        _name_negated_axes(s): float(np.median(angles(d * s)[is_off])) for s in itertools.product((1.0, -1.0), repeat=3)
    }
    del errors_by_axes[""]
    best = min(errors_by_axes, key=errors_by_axes.__getitem__)
    remedy = "check that both have the same frame and unit"
    if errors_by_axes[best] < min(_MAX_ANGLES[0], 0.5 * median_error):
        remedy = f"with {best} of the directions negated it would be {errors_by_axes[best]:.2g}: check their frame"
    return [f"{subject} the hit points by {median_error:.0f} degrees (median); {remedy}"]


def _check_elevation(rays: Rays) -> list[str]:
    elevation = np.degrees(np.arcsin(np.clip(rays.direction[:: max(1, len(rays) // MAX_CHECKED_RAYS), 2], -1, 1)))
    median = np.median(elevation)
    if abs(median) <= _MAX_ELEVATION or len(rays) < MIN_RAYS:
        return []
    return [
        f"half of the rays point more than {abs(median):.0f} degrees {'up' if median > 0 else 'down'}: "
        "check the axes of the directions, or the forward axis"
    ]


# ---- The checks of directions and their frames, in the order of the quality report ----

DIRECTION_CHECKS: tuple[Check, ...] = (check_locked, check_head, check_vor, check_directions, check_frames)
