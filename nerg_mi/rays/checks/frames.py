"""People, or recordings, in frames of their own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .figures import Figures, name_some
from .protocol import check

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
