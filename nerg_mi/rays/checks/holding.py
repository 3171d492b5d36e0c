"""Gaze mirrored in the head's frame: eyes turn against the head, so that gaze holds still in the world.

The vestibulo-ocular reflex. With left and right, or up and down, of the eyes exchanged, gaze would turn with the head
in place of against it, and twice as fast as the head does.
"""

from __future__ import annotations

import numpy as np

from .figures import Figures, name_some
from .head import EXCHANGES, head_frames
from .protocol import check

_LAG = 0.08  # seconds between two directions that are compared; a fixation takes 0.2 and more
_TURNS = 20.0, 200.0  # degrees a second of heads that are looked at
_BETTER = 0.88  # in 44 recordings that are right, each exchange makes gaze turn 1.26 times as fast and more
_FEW = 300
_MOST = 1 << 18, 1 << 10  # rays looked at in runs of so many


@check("gaze that turns with the head where eyes turn against it: left and right, or up and down, exchanged")
def check_holding(figures: Figures) -> list[str]:
    rays = figures.rays
    if rays.head is None or figures.selected:
        return []
    turned, person = _turned(figures, rays.head)
    if len(person) < _FEW:
        return []
    if found := _best_exchange(turned):
        return [_sentence(found, "")]
    wrong: dict[str, list[str]] = {}
    for p in np.flatnonzero(np.bincount(person) >= _FEW):
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
    return list(EXCHANGES)[best] if others[best] < _BETTER * now else ""


def _turned(figures: Figures, heads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far gaze turns (4, n) while the head does, as it is and with each of `EXCHANGES`; and the persons (n,)."""
    rays, n, (most, run) = figures.rays, len(figures.rays), _MOST
    rows = np.arange(n)
    if n > most:
        first = np.linspace(0, n - run, most // run).astype(np.int64)
        rows = (first[:, None] + np.arange(run)).ravel()
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
    frames = [head_frames(head[first + k]) for k in (0, lag)]
    own = [np.einsum("nij,nj->ni", f, rays.direction[rows[first + k]]) for f, k in zip(frames, (0, lag))]
    turned = []
    for signs in ((1.0, 1.0, 1.0), *EXCHANGES.values()):
        before, after = (np.einsum("nij,ni->nj", f, v * signs) for f, v in zip(frames, own))
        turned.append(np.linalg.norm(after - before, axis=1))
    return np.array(turned), person[first]
