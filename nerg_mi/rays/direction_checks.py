"""Checks of rays for implausible directions: mirrored or reversed ones, by heads, walking and hit points, and
frames that differ between people."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .checks import ENOUGH, MOST, Check, Figures, check, group_medians, name_persons, name_some, to_source
from .filters import argsort_by_person_time
from .rays import Rays

# ---- People, or recordings, in frames of their own ----

_ROWS, _FEW = 1000, 100  # rays of a recording that are looked at, and that it needs
_SESSIONS = 1000
_HEADS = 0.9, 2.0  # metres over the floor
_HIGHER, _LOWER = 0.5, 0.85  # metres from the height of others that are no person's, however they sit or grow
_AWAY = 10.0  # metres between people who share no place
_CELL = 0.5  # metres
_SHARED, _THERE = 0.1, 0.7  # shares of places: of two recordings in one frame, and of one that was brought into it
_CELLS = 8
_FLIPS = {"x negated": (0, 1, -1, 1), "y negated": (0, 1, 1, -1), "x and y negated": (0, 1, -1, -1)}
_FLIPS |= {"x and y exchanged": (1, 0, 1, 1), "a turn by 90 degrees": (1, 0, -1, 1)}
_FLIPS |= {"a turn by -90 degrees": (1, 0, 1, -1), "x and y exchanged and negated": (1, 0, -1, -1)}


@dataclass(frozen=True, eq=False)
class _Stays:
    """Where heads were in each of S recordings."""

    name: list[str]
    height: np.ndarray  # (S,) median
    box: np.ndarray  # (S, 2, 2) low and high on the floor, without the outermost
    cells: list[np.ndarray]  # of the floor, (C, 2) whole numbers each


@check(
    "people or recordings whose heads are higher or lower than people's, far from all others, or, with axes negated or "
    "exchanged, where others walk (import them apart, `nerg align`)"
)
def check_frames(figures: Figures) -> list[str]:
    stays = _find_stays(figures)
    if len(stays.name) < 2:
        return []
    out, told = [], np.zeros(len(stays.name), bool)
    for find_odd in (_check_heights, _check_boxes, _check_floors):
        if find_odd is _check_heights and not figures.floor_known:
            continue
        found, odd = find_odd(stays, told)
        out += found
        told |= odd
    return out


def _find_stays(figures: Figures) -> _Stays:
    rays, sessions = figures.rays, figures.sessions
    long = np.flatnonzero(np.diff(sessions.starts) >= _FEW)
    long = long[:: max(1, -(-len(long) // _SESSIONS))]
    several = np.bincount(sessions.person[long], minlength=len(rays.persons)) > 1
    names, heights, boxes, cells = [], [], [], []
    for s in long.tolist():
        a, b = sessions.starts[s : s + 2]
        places = np.arange(a, b, max(1, (b - a) // _ROWS))
        rows = places if sessions.order is None else sessions.order[places]
        origin, p = rays.origin[rows], sessions.person[s]
        names.append(rays.persons[p] + (f" (from {rays.t[rows[0]]:.6g} s)" if several[p] else ""))
        heights.append(np.median(origin[:, 2]))
        boxes.append(np.percentile(origin[:, :2], [2, 98], axis=0))
        cell = np.floor(origin[:, :2] / _CELL)
        cells.append(cell[np.unique(_code(cell), return_index=True)[1]])
    return _Stays(names, np.array(heights), np.array(boxes).reshape(-1, 2, 2), cells)


def _code(cells: np.ndarray) -> np.ndarray:
    """A number for each of the cells (C, 2)."""
    return cells[:, 0] * 2.0**21 + cells[:, 1]


def _check_heights(stays: _Stays, told: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Heads at heights that differ by more than people do."""
    like_heads = (stays.height > _HEADS[0]) & (stays.height < _HEADS[1])
    if like_heads.mean() < 0.5:
        return [], told & False  # all of them are wrong, which another check tells
    usual = float(np.median(stays.height[like_heads]))
    odd = (stays.height > usual + _HIGHER) | (stays.height < usual - _LOWER)
    if not odd.any() or odd.all():
        return [], told & False
    height = float(np.median(stays.height[odd]))
    ratio = abs(height / usual) if usual else 0.0
    unit = next((name for name, size in (("cm", 100), ("mm", 1000)) if 0.7 < ratio / size < 1.4), None)
    remedy = (
        f"is their unit {unit}? Import them apart (--units {unit})"
        if unit
        else "do they count from another floor or origin? Import them apart, and align them (nerg align)"
    )
    names = name_some([stays.name[s] for s in np.flatnonzero(odd)])
    return [
        f"the heads of {names} are at a height of {height:.2f} m, and those of others at {usual:.2f} m; {remedy}"
    ], odd


def _check_boxes(stays: _Stays, told: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Recordings so far from all others that they share no place."""
    from scipy.sparse.csgraph import connected_components

    low, high = stays.box[:, 0], stays.box[:, 1]
    # How far two boxes are apart, against how large they are.
    gap = np.maximum(0.0, np.maximum(low[:, None] - high[None], low[None] - high[:, None]))
    size = np.linalg.norm(high - low, axis=1)
    near = np.linalg.norm(gap, axis=2) <= np.maximum(_AWAY, np.maximum(size[:, None], size[None]))
    _, group = connected_components(near, directed=False)
    main = np.argmax(np.bincount(group))
    odd = (group != main) & ~told
    if not odd.any():
        return [], odd
    names = name_some([stays.name[s] for s in np.flatnonzero(odd)])
    away = np.linalg.norm(gap[odd][:, group == main], axis=2).min()
    return [
        f"{names} is {away:.0f} m and more from where all others are: are these frames, or places, of their own? "
        "Import them apart, and align them (nerg align)"
    ], odd


def _check_floors(stays: _Stays, told: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Recordings that share no place with others, and would with axes negated or exchanged."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    own = [_code(cells) for cells in stays.cells]
    size = np.array([len(cells) for cells in own])
    _, place = np.unique(np.concatenate(own), return_inverse=True)
    visits = csr_matrix((np.ones(len(place)), (np.repeat(np.arange(len(own)), size), place)))
    shared = (visits @ visits.T).toarray() / np.minimum(size[:, None], size[None])
    _, group = connected_components(shared >= _SHARED, directed=False)
    main = np.argmax(np.bincount(group))
    others = np.concatenate([own[s] for s in np.flatnonzero(group == main)])
    odd, names = np.zeros(len(own), bool), {}
    for g in np.unique(group[(group != main) & ~told]):
        members = np.flatnonzero((group == g) & ~told)
        cells = np.concatenate([stays.cells[s] for s in members])
        if len(cells) < _CELLS:
            continue
        # A negated cell is the one on the other side of zero.
        shares = {
            what: float(np.isin(_code(np.stack(_flipped(cells, *how), axis=1)), others).mean())
            for what, how in _FLIPS.items()
        }
        best = max(shares, key=shares.__getitem__)
        if shares[best] > _THERE:
            odd[members] = True
            names.setdefault(best, []).extend(stays.name[s] for s in members)
    return [
        f"{name_some(who)} walks where no other does, and with {what} (of rays) would walk where others do: is it in "
        "another frame? Import it apart (--up, --hand), or align it (nerg align)"
        for what, who in names.items()
    ], odd


def _flipped(cells: np.ndarray, a: int, b: int, sign_a: int, sign_b: int) -> list[np.ndarray]:
    return [cells[:, i] if sign > 0 else -1 - cells[:, i] for i, sign in ((a, sign_a), (b, sign_b))]


# ---- Gaze against the head: eyes turn by 50 degrees at most, and rarely by more than 30 ----

_COSINE = 0.5  # of 60 degrees
_SHARE, _HEAD_FEW = 0.02, 20  # of a person's rays; in 44 recordings that are right it is 0
_ONE_WAY, _MANY_WAYS = 0.85, 0.75  # lengths of mean directions: of those about one direction, of those that are not
_AGAINST, _FOLLOWS = (-0.3, 0.2)  # correlations of gaze and head along an axis; 0.75 and more where all is right
_SPREAD = 0.1, 0.2  # of heads along that axis, for each; of those that stay, eyes may turn as they like
_ENOUGH = 200  # rays of a person
_BLOCK = 1 << 18


def _spread_runs(n: int, most: int, run: int) -> np.ndarray:
    """Rows of ``n``: all of them, or, of more than ``most``, runs of ``run`` neighbours, evenly spread."""
    if n <= most:
        return np.arange(n)
    first = np.linspace(0, n - run, most // run).astype(np.int64)
    return (first[:, None] + np.arange(run)).ravel()


def _axes_negated(signs: Sequence[float]) -> str:
    """``x and z`` of (-1, 1, -1)."""
    return " and ".join(axis for axis, sign in zip("xyz", signs) if sign < 0)


_SIGNS = sorted(itertools.product((1.0, -1.0), repeat=3), key=lambda signs: -sum(signs))
"""Of all axes, those with the fewest negated first."""


@check(
    "directions more than 60 degrees from where the head points; whether they stay about one direction of the world "
    "(gaze in the head's frame taken for that in the world), about another axis of the head (`--forward`), or would be "
    "right with an axis negated (`--hand`); gaze that goes against the head, or does not follow it"
)
def check_head(figures: Figures) -> list[str]:
    rays = figures.rays
    if rays.head is None:
        return []
    beyond, known = np.empty((2, len(rays)), bool)
    for a in range(0, len(rays), _BLOCK):
        rows = slice(a, a + _BLOCK)
        cosine = np.einsum("ij,ij->i", rays.head[rows], rays.direction[rows])
        known[rows] = np.isfinite(cosine)
        beyond[rows] = cosine < _COSINE
    # What stands still is told by itself.
    known &= ~figures.frozen
    beyond &= known
    count = len(rays.persons)
    off, all_ = (np.bincount(rays.person[mask], minlength=count) for mask in (beyond, known))
    who = np.flatnonzero((off >= _HEAD_FEW) & (off > _SHARE * all_))
    if not who.size:
        return _check_following(figures, rays.head, known)
    wrong = np.zeros(count, bool)
    wrong[who] = True
    share = 100 * off[who].sum() / all_[who].sum()
    whose = "" if len(who) == np.count_nonzero(all_) else f" of {name_persons(rays, who)}"
    rows = np.flatnonzero(known & wrong[rays.person])
    return [
        f"{share:.0f} % of the directions{whose} lie more than 60 degrees from where the head points; "
        + (_mirror(figures, rays.head, rows) or _guess(figures, rays.head, np.flatnonzero(beyond & wrong[rays.person])))
    ]


def _check_following(figures: Figures, heads: np.ndarray, known: np.ndarray) -> list[str]:
    """Gaze that goes against the head along an axis of the file, or pays no heed to it: where heads turn, gaze does."""
    rays = figures.rays
    (rows,) = np.nonzero(known)
    rows = rows[:: max(1, len(rows) // MOST)]
    R, person, count = to_source(rays), rays.person[rows], len(rays.persons)
    head, d, n = heads[rows] @ R.T, rays.direction[rows] @ R.T, np.bincount(person, minlength=count)
    mean = lambda v: np.stack([np.bincount(person, weights=c, minlength=count) for c in v.T]) / np.maximum(n, 1)
    (mh, md), cross = (mean(head), mean(d)), mean(head * d)
    spread = np.sqrt(np.maximum(mean(head**2) - mh**2, 0.0))
    r = (cross - mh * md) / np.maximum(spread * np.sqrt(np.maximum(mean(d**2) - md**2, 0.0)), 1e-12)
    against = (n >= _ENOUGH) & (spread > _SPREAD[0]) & (r < _AGAINST)
    aloof = (n >= _ENOUGH) & (spread > _SPREAD[1]) & (r < _FOLLOWS) & ~against
    out = []
    for axes in np.unique(against[:, against.any(axis=0)].T, axis=0):
        names = name_persons(rays, np.flatnonzero((against.T == axes).all(axis=1)))
        which = " and ".join("xyz"[i] for i in np.flatnonzero(axes))
        out.append(
            f"along {which} of the file the gaze of {names} goes where the head turns away from: negate {which} of the "
            "directions, or check their frame (--hand)"
        )
    if aloof.any():
        names = name_persons(rays, np.flatnonzero(aloof.any(axis=0)))
        out.append(
            f"the gaze of {names} does not follow the head: check whether it is in the head's frame "
            "(--preset unity_local, or the head's pose in --map), and whose head it is"
        )
    return out


def _mirror(figures: Figures, heads: np.ndarray, rows: np.ndarray) -> str:
    """The remedy where the directions with some axes of the file negated would all be about the head."""
    rays, rows = figures.rays, rows[:: max(1, len(rows) // MOST)]
    R = to_source(rays)
    head, d = heads[rows] @ R.T, rays.direction[rows] @ R.T
    for signs in _SIGNS[1:]:
        if np.mean(np.einsum("ij,ij->i", head, d * signs) < _COSINE) < 0.5 * _SHARE:
            which = f"{_axes_negated(signs)} of the directions"
            return f"with {which} negated they would not: check their frame (--hand, --forward)"
    return ""


def _guess(figures: Figures, heads: np.ndarray, rows: np.ndarray) -> str:
    """The remedy, by what the directions (rows) that are far from the head have in common."""
    rays, rows = figures.rays, rows[:: max(1, len(rows) // MOST)]
    head, d = heads[rows].astype(np.float64), rays.direction[rows]
    own = np.einsum("nij,nj->ni", compute_head_frames(head), d)
    in_world, in_head = (np.linalg.norm(v.mean(axis=0)) for v in (d, own))
    if in_world > _ONE_WAY and in_head < _MANY_WAYS:
        return (
            "they stay about one direction of the file however the head turns: are they in the head's frame? "
            "(--preset unity_local, or the head's pose in --map)"
        )
    if in_head > _ONE_WAY and in_world < _MANY_WAYS:
        ahead, right, up = own.mean(axis=0)
        where = max(
            {"back": -ahead, "right": right, "left": -right, "up": up, "down": -up}.items(), key=lambda at: at[1]
        )[0]
        return f"they look {where} from the head: does another axis of the head look ahead? (--forward)"
    return (
        "check the order of the quaternion (xyzw or wxyz), and whether the directions are in the world already "
        "(--preset unity, or direction without a pose in --map)"
    )


AXIS_SWAPS = {
    "left and right": (1.0, -1.0, 1.0),
    "up and down": (1.0, 1.0, -1.0),
    "left and right, and up and down,": (1.0, -1.0, -1.0),
}
"""Signs of a direction ahead, to the right and up in the head (`head_frames`), by what they exchange of the eyes."""


def compute_head_frames(head: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) from the world to ahead, right and up of heads (n, 3) that are not tilted sideways."""
    right = np.cross(head, (0.0, 0.0, 1.0))
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-9)
    return np.stack([head, right, np.cross(right, head)], axis=1)


# ---- Gaze mirrored in the head's frame: eyes turn against the head, so that gaze holds still in the world ----
#
# The vestibulo-ocular reflex. With left and right, or up and down, of the eyes exchanged, gaze would turn with the head
# in place of against it, and twice as fast as the head does.

_LAG = 0.08  # seconds between two directions that are compared; a fixation takes 0.2 and more
_TURNS = 20.0, 200.0  # degrees a second of heads that are looked at
_BETTER = 0.88  # in 44 recordings that are right, each exchange makes gaze turn 1.26 times as fast and more
_HOLDING_FEW = 300
_MOST = 1 << 18, 1 << 10  # rays looked at in runs of so many


@check("gaze that turns with the head where eyes turn against it: left and right, or up and down, exchanged")
def check_holding(figures: Figures) -> list[str]:
    rays = figures.rays
    if rays.head is None or figures.selected:
        return []
    turned, person = _turned(figures, rays.head)
    if len(person) < _HOLDING_FEW:
        return []
    if found := _best_exchange(turned):
        return [_sentence(found, "")]
    wrong: dict[str, list[str]] = {}
    for p in np.flatnonzero(np.bincount(person) >= _HOLDING_FEW):
        if found := _best_exchange(turned[:, person == p]):
            wrong.setdefault(found, []).append(rays.persons[p])
    return [_sentence(found, f" of {name_some(names)}") for found, names in wrong.items()]


def _sentence(found: str, whose: str) -> str:
    return (
        f"the gaze{whose} turns with the head where eyes turn against it; with {found} of the eyes exchanged it would "
        "hold still: negate that part of the direction in the head's frame, or check the frame (--hand)"
    )


def _best_exchange(turned: np.ndarray) -> str:
    """The exchange with which gaze turns least (medians of (4, n)), if it is clearly less than without."""
    now, *others = np.median(turned, axis=1)
    best = int(np.argmin(others))
    return list(AXIS_SWAPS)[best] if others[best] < _BETTER * now else ""


def _turned(figures: Figures, heads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far gaze turns (4, n) while the head does, as it is and with each of `EXCHANGES`; and the persons (n,)."""
    rays, rows = figures.rays, _spread_runs(len(figures.rays), *_MOST)
    rows = rows if figures.order is None else figures.order[rows]
    t, person = rays.t[rows], rays.person[rows]
    step = np.diff(t)[np.diff(person) == 0]
    step = step[(step > 0) & (step < _LAG)]
    nothing = np.empty((4, 0)), np.empty(0, np.int64)
    if not step.size:
        return nothing
    lag = max(1, round(_LAG / float(np.median(step))))
    if len(rows) <= lag:
        return nothing
    dt, head = t[lag:] - t[:-lag], heads[rows].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.degrees(np.linalg.norm(head[lag:] - head[:-lag], axis=1)) / dt
    use = (person[lag:] == person[:-lag]) & (dt > 0) & (dt < 2 * _LAG) & (speed > _TURNS[0]) & (speed < _TURNS[1])
    use &= ~figures.frozen[rows[lag:]]
    (first,) = np.nonzero(use)
    frames = [compute_head_frames(head[first + k]) for k in (0, lag)]
    own = [np.einsum("nij,nj->ni", f, rays.direction[rows[first + k]]) for f, k in zip(frames, (0, lag))]
    turned = []
    for signs in ((1.0, 1.0, 1.0), *AXIS_SWAPS.values()):
        before, after = (np.einsum("nij,ni->nj", f, v * signs) for f, v in zip(frames, own))
        turned.append(np.linalg.norm(after - before, axis=1))
    return np.array(turned), person[first]


# ---- Gaze that stays at one place in the head: the head's direction, some time later or turned by some degrees ----

_STILL = 4.0  # degrees from its mean direction in the head, by the median; 44 people who look about have 7 and more
_TURNED = 0.25  # of heads, whose mean directions are shorter by that than one: they look about in a cone of 40 degrees
_LOCKED_ENOUGH = 500  # rays of a person


@check("gaze that stays at one place in the head while the head looks about (`nerg rays filter`)")
def check_locked(figures: Figures) -> list[str]:
    rays = figures.rays
    if rays.head is None:
        return []
    (rows,) = np.nonzero(~figures.frozen & np.isfinite(rays.head[:, 0]))
    rows = rows[:: max(1, len(rows) // MOST)]
    person, count = rays.person[rows], len(rays.persons)
    n, heads = np.bincount(person, minlength=count), rays.head[rows].astype(np.float64)
    own = np.einsum("nij,nj->ni", compute_head_frames(heads), rays.direction[rows])
    mean = lambda v: (
        np.stack([np.bincount(person, weights=c, minlength=count) for c in v.T], axis=1) / np.maximum(n[:, None], 1)
    )
    middle = mean(own)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    off = np.degrees(2 * np.arcsin(np.minimum(1.0, 0.5 * np.linalg.norm(own - middle[person], axis=1))))
    turned = np.linalg.norm(mean(heads), axis=1) < 1 - _TURNED
    who = np.flatnonzero((n >= _LOCKED_ENOUGH) & turned & (group_medians(off, person, count) < _STILL))
    if not who.size:
        return []
    return [
        f"the gaze of {name_persons(rays, who)} stays at one place in the head, within "
        f"{_STILL:g} degrees, as if it were the head's direction: were the eyes tracked? Leave them out "
        "(nerg rays filter --without-person)"
    ]


# ---- Mirror ----
#
# Directions mirrored against a place: more of the gaze ends on its surfaces as it is than with an axis negated.

Trace = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Distances (N,) along unit directions (N, 3) from origins (N, 3) to what they meet; not finite for nothing."""

DECLARED = "as declared"  # Name of the directions without an axis negated
_MIRROR_BETTER = 0.02  # share by which a mirror must be better, besides three standard errors


def compute_hit_fractions(
    trace: Trace, origins: np.ndarray, directions: np.ndarray, to_source: np.ndarray | None = None
) -> dict[str, float]:
    """Share of the rays that end on a surface, for the directions as they are and with each of the axes negated.

    ``origins``, ``directions`` (N, 3), in the frame of ``trace``. ``to_source`` (3, 3): rotation, or mirror, to the
    axes by which mirrors are named, those of the tracking file; by default they are those of the rays. Keys:
    `DECLARED`, ``x``, ``y``, ``z``, ``x and y``, ...
    """
    R = np.eye(3) if to_source is None else to_source
    shares = {}
    for signs in _SIGNS:
        turned = directions @ (R.T * signs) @ np.linalg.inv(R).T
        shares[_axes_negated(signs) or DECLARED] = float(np.mean(np.isfinite(trace(origins, turned))))
    return shares


def describe_mirroring(shares: dict[str, float], count: int) -> str | None:
    """A sentence where `hit_shares` of ``count`` rays are better with one axis negated than as they are declared, by
    more than chance; None otherwise.

    Several axes negated at once are a turn, or a mirror of a turn, and are not asked here: rooms are much the same all
    around.
    """
    declared, single = shares[DECLARED], {axis: shares[axis] for axis in "xyz"}
    best = max(single, key=single.__getitem__)
    error = np.sqrt(max(declared * (1 - declared) + single[best] * (1 - single[best]), 1e-12) / max(count, 1))
    if single[best] - declared <= max(_MIRROR_BETTER, 3 * error):
        return None
    return (
        f"{100 * declared:.1f} % of the gaze ends on a surface, and with {best} of the directions negated "
        f"{100 * single[best]:.1f} % would: is the frame mirrored? (--hand, or the sign of {best})"
    )


# ---- The frame of the directions, by walking: people look ahead ----

_AHEAD = 0.2  # correlation of gaze and walking along an axis
_WALKED = 1 << 19, 1 << 11  # rays looked at in runs of so many, where it matters which comes after which
_ALONE = 0.3, 500  # the same of one person, of whom more is needed
_STEPS = 200  # of half a second, from which on walking says something
_WALKING_ONE_WAY, _ANY_WAY = 0.85, 0.5  # lengths of mean directions: of gaze that stays about one, of ways that do not


@dataclass(frozen=True, eq=False)
class WalkingSteps:
    """Steps of half a second of people who walk: W of them, along the axes of the file, without their heights."""

    way: np.ndarray  # (W, 3) unit
    gaze: np.ndarray  # (W, 3) of lengths up to one
    person: np.ndarray  # (W,)


def find_against_walking(figures: Figures) -> list[str]:
    """Directions that disagree with where people walk: of all of them or of some; reversed, mirrored, or staying
    where they are whichever way people walk."""
    rays = figures.rays
    steps = _find_steps(rays, figures.order, figures.frozen)
    if len(steps.way) < _STEPS:
        return []
    if rays.head is None and _stays(steps):
        return [
            "the directions stay about one direction of the file, whichever way people walk: are they in the head's "
            "frame? (--preset unity_local, or the head's pose in --map)"
        ]
    if found := _name_disagreement(_correlate(steps), "people", _AHEAD):
        return [found]
    by_person, stay = {}, []
    for p in np.flatnonzero(np.bincount(steps.person) >= _ALONE[1]):
        mine = steps.person == p
        own = WalkingSteps(steps.way[mine], steps.gaze[mine], steps.person[mine])
        if rays.head is None and _stays(own):
            stay.append(rays.persons[p])
        elif found := _name_disagreement(_correlate(own), "{}", _ALONE[0]):
            by_person.setdefault(found, []).append(rays.persons[p])
    out = [text.replace("{}", name_some(names)) for text, names in by_person.items()]
    if stay:
        out.append(
            f"the directions of {name_some(stay)} stay about one direction of the file, whichever way they walk, and "
            "those of others do not: are they in the head's frame? (--preset unity_local, or the head's pose in --map)"
        )
    return out


def _name_disagreement(agree: np.ndarray, who: str, least: float) -> str:
    against = [i for i in range(3) if agree[i] < -least]
    along = [i for i in range(3) if agree[i] > _AHEAD]
    if against and not along:
        verb = "look back to where they came from"
        return f"{who} {verb}: are the directions reversed? (--forward, or the sign of the direction)"
    if against:
        return (
            f"along {' and '.join('xyz'[i] for i in against)} of the file {who} look away from where they walk: "
            "are positions and directions mirrored against each other? (--hand)"
        )
    return ""


def _stays(steps: WalkingSteps) -> bool:
    """Whether gaze stays about one direction while people walk in many, and turns neither with them nor against."""
    length = np.maximum(np.linalg.norm(steps.gaze, axis=1, keepdims=True), 1e-12)
    gaze, way = steps.gaze / length, steps.way
    mean_gaze, mean_way = gaze.mean(axis=0), way.mean(axis=0)
    turns = _correlate(WalkingSteps(way - mean_way, gaze - mean_gaze, steps.person))
    lengths = np.linalg.norm(mean_gaze), np.linalg.norm(mean_way)
    return bool(lengths[0] > _WALKING_ONE_WAY and lengths[1] < _ANY_WAY and (np.abs(turns) < _AHEAD).all())


def walking_agreement(rays: Rays, order: np.ndarray | None = None) -> np.ndarray | None:
    """Correlation of gaze with walking along each axis of the file, (3,), 0 along the up axis; ``None`` where nobody
    walks.

    Steps of half a second, at 0.3 to 3 m/s. People look ahead: far above zero along each axis on which they walk.
    ``order``: `filters.time_order` of the rays, if it is known. Of millions of rays, runs of some thousands are looked
    at.
    """
    steps = _find_steps(rays, argsort_by_person_time(rays) if order is None else order)
    return None if len(steps.way) < _STEPS else _correlate(steps)


def _correlate(steps: WalkingSteps) -> np.ndarray:
    v, d = steps.way, steps.gaze
    norm = np.sqrt((v**2).mean(axis=0) * (d**2).mean(axis=0))
    # An axis on which hardly anybody walks says nothing.
    share = (v**2).mean(axis=0)
    return np.where(share > 0.05, (v * d).mean(axis=0) / np.maximum(norm, 1e-12), 0.0)


def _find_steps(rays: Rays, order: np.ndarray | None, without: np.ndarray | None = None) -> WalkingSteps:
    rows = _spread_runs(len(rays), *_WALKED)
    order = rows if order is None else order[rows]
    t, person = rays.t[order], rays.person[order]
    starts = np.r_[np.flatnonzero(np.r_[True, np.diff(person) != 0]), len(t)]
    later = np.minimum(np.arange(len(t)) + _lag(t, starts), len(t) - 1)
    dt = t[later] - t
    same = (person[later] == person) & (dt > 0) & (dt < 2.0)
    moved = (rays.origin[order[later]] - rays.origin[order])[same]
    moved[:, 2] = 0
    speed = np.linalg.norm(moved, axis=1) / dt[same]
    walks = (speed > 0.3) & (speed < 3.0)
    if without is not None:
        walks &= ~without[order[same]]
    R = to_source(rays)
    d = rays.direction[order[same]][walks] * (1, 1, 0)
    v = moved[walks] / np.linalg.norm(moved[walks], axis=1, keepdims=True)
    return WalkingSteps(v @ R.T, d @ R.T, person[same][walks])


def _lag(t: np.ndarray, starts: np.ndarray) -> int:
    """Rays in half a second."""
    step = np.diff(t)
    step[starts[1:-1] - 1] = np.inf
    step = step[(step > 0) & (step <= 1.0)]
    # Times may lie so close together that the quotient is no index.
    return max(1, round(min(0.5 / np.median(step), len(t)))) if step.size else 1


# ---- The frame of the directions ----
#
# A mirrored or reversed direction shows where it disagrees with the hit point, or with where people walk: people look
# ahead. A frame mirrored as a whole, positions with directions, contradicts nothing and cannot be seen without the
# place itself.

_OFF = 5.0, 10.0  # degrees between direction and hit point: of half of the rays, and of some
_SOME = 0.05  # share of the rays that are some
_NEAR = 0.2  # metres: directions to nearer hit points say little
_DIRECTIONS_FEW = 20  # hit points from which on they are asked
_STEEP = 50.0  # degrees up or down


@check(
    "directions that miss the hit points, with the signs that would mend them; where there are none, directions away "
    "from where people walk, and steep gaze (`--hand`, `--forward`)"
)
def check_directions(figures: Figures) -> list[str]:
    """The frame of the directions: by the hit points or, where these tell nothing, by steep gaze and by walking."""
    return _check_hits(figures.rays) or [*_check_elevation(figures.rays), *find_against_walking(figures)]


def _check_hits(rays: Rays) -> list[str]:
    if rays.hit is None:
        return []
    R = to_source(rays)
    some = np.flatnonzero(np.isfinite(rays.hit).all(axis=1))
    some = some[:: max(1, len(some) // MOST)]
    to_hit = (rays.hit[some] - rays.origin[some]) @ R.T
    length = np.linalg.norm(to_hit, axis=1)
    far = length > _NEAR
    if far.sum() < _DIRECTIONS_FEW:
        return []
    to_hit, d, person = to_hit[far] / length[far, None], rays.direction[some][far] @ R.T, rays.person[some][far]
    angles = lambda v: np.degrees(np.arccos(np.clip(np.sum(v * to_hit, axis=1), -1, 1)))
    found = angles(d)
    off, whose = np.ones(len(d), bool), "the directions miss"
    if not np.median(found) > _OFF[0]:
        off = found > _OFF[1]
        if not off.mean() > _SOME:
            return []
        wrong = np.bincount(person, weights=off) > 0.5 * np.maximum(np.bincount(person), 1)
        of = f", those of {name_persons(rays, np.flatnonzero(wrong))}," if wrong.any() else ""
        whose = f"{100 * off.mean():.0f} % of the directions{of} miss"
    now = float(np.median(found[off]))
    tried = {_axes_negated(s): float(np.median(angles(d * s)[off])) for s in itertools.product((1.0, -1.0), repeat=3)}
    del tried[""]
    best = min(tried, key=tried.__getitem__)
    remedy = "check that they are of one frame and one unit"
    if tried[best] < min(_OFF[0], 0.5 * now):
        remedy = f"with {best} of the directions negated they would, to {tried[best]:.2g}: check their frame"
    return [f"{whose} the hit points by {now:.0f} degrees (median); {remedy}"]


def _check_elevation(rays: Rays) -> list[str]:
    elevation = np.degrees(np.arcsin(np.clip(rays.direction[:: max(1, len(rays) // MOST), 2], -1, 1)))
    median = np.median(elevation)
    if abs(median) <= _STEEP or len(rays) < ENOUGH:
        return []
    return [
        f"half of the rays look more than {abs(median):.0f} degrees {'up' if median > 0 else 'down'}: "
        "check the axes of the directions, or which way is forward"
    ]


# ---- The checks of directions and their frames, in the order of the card ----

DIRECTION_CHECKS: tuple[Check, ...] = (check_locked, check_head, check_holding, check_directions, check_frames)
