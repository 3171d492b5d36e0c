"""Gaze against the head: eyes turn by 50 degrees at most, and rarely by more than 30."""

from __future__ import annotations

import itertools

import numpy as np

from .figures import MOST, Figures, name_some, to_source
from .protocol import check

_COSINE = 0.5  # of 60 degrees
_SHARE, _FEW = 0.02, 20  # of a person's rays; in 44 recordings that are right it is 0
_ONE_WAY, _MANY_WAYS = 0.85, 0.75  # lengths of mean directions: of those about one direction, of those that are not
_AGAINST, _FOLLOWS = (-0.3, 0.2)  # correlations of gaze and head along an axis; 0.75 and more where all is right
_SPREAD = 0.1, 0.2  # of heads along that axis, for each; of those that stay, eyes may turn as they like
_ENOUGH = 200  # rays of a person
_BLOCK = 1 << 18


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
    who = np.flatnonzero((off >= _FEW) & (off > _SHARE * all_))
    if not who.size:
        return _check_following(figures, rays.head, known)
    wrong = np.zeros(count, bool)
    wrong[who] = True
    share = 100 * off[who].sum() / all_[who].sum()
    whose = "" if len(who) == np.count_nonzero(all_) else f" of {name_some([rays.persons[p] for p in who])}"
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
        names = name_some([rays.persons[p] for p in np.flatnonzero((against.T == axes).all(axis=1))])
        which = " and ".join("xyz"[i] for i in np.flatnonzero(axes))
        out.append(
            f"along {which} of the file the gaze of {names} goes where the head turns away from: negate {which} of the "
            "directions, or check their frame (--hand)"
        )
    if aloof.any():
        names = name_some([rays.persons[p] for p in np.flatnonzero(aloof.any(axis=0))])
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
    for signs in sorted(itertools.product((1.0, -1.0), repeat=3), key=lambda s: -sum(s))[1:]:
        if np.mean(np.einsum("ij,ij->i", head, d * signs) < _COSINE) < 0.5 * _SHARE:
            axes = " and ".join("xyz"[i] for i in range(3) if signs[i] < 0)
            return f"with {axes} of the directions negated they would not: check their frame (--hand, --forward)"
    return ""


def _guess(figures: Figures, heads: np.ndarray, rows: np.ndarray) -> str:
    """The remedy, by what the directions (rows) that are far from the head have in common."""
    rays, rows = figures.rays, rows[:: max(1, len(rows) // MOST)]
    head, d = heads[rows].astype(np.float64), rays.direction[rows]
    own = np.einsum("nij,nj->ni", head_frames(head), d)
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


EXCHANGES = {
    "left and right": (1.0, -1.0, 1.0),
    "up and down": (1.0, 1.0, -1.0),
    "left and right, and up and down,": (1.0, -1.0, -1.0),
}
"""Signs of a direction ahead, to the right and up in the head (`head_frames`), by what they exchange of the eyes."""


def head_frames(head: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) from the world to ahead, right and up of heads (n, 3) that are not tilted sideways."""
    right = np.cross(head, (0.0, 0.0, 1.0))
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-9)
    return np.stack([head, right, np.cross(right, head)], axis=1)
