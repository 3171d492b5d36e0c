"""Gaze that stays at one place in the head: the head's direction, some time later or turned by some degrees."""

from __future__ import annotations

import numpy as np

from .figures import MOST, Figures, group_medians, name_some
from .head import head_frames
from .protocol import check

_STILL = 4.0  # degrees from its mean direction in the head, by the median; 44 people who look about have 7 and more
_TURNED = 0.25  # of heads, whose mean directions are shorter by that than one: they look about in a cone of 40 degrees
_ENOUGH = 500  # rays of a person


@check("gaze that stays at one place in the head while the head looks about (`nerg rays filter`)")
def check_locked(figures: Figures) -> list[str]:
    rays = figures.rays
    if rays.head is None:
        return []
    (rows,) = np.nonzero(~figures.frozen & np.isfinite(rays.head[:, 0]))
    rows = rows[:: max(1, len(rows) // MOST)]
    person, count = rays.person[rows], len(rays.persons)
    n, heads = np.bincount(person, minlength=count), rays.head[rows].astype(np.float64)
    own = np.einsum("nij,nj->ni", head_frames(heads), rays.direction[rows])
    mean = lambda v: (
        np.stack([np.bincount(person, weights=c, minlength=count) for c in v.T], axis=1) / np.maximum(n[:, None], 1)
    )
    middle = mean(own)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    off = np.degrees(2 * np.arcsin(np.minimum(1.0, 0.5 * np.linalg.norm(own - middle[person], axis=1))))
    turned = np.linalg.norm(mean(heads), axis=1) < 1 - _TURNED
    who = np.flatnonzero((n >= _ENOUGH) & turned & (group_medians(off, person, count) < _STILL))
    if not who.size:
        return []
    return [
        f"the gaze of {name_some([rays.persons[p] for p in who])} stays at one place in the head, within "
        f"{_STILL:g} degrees, as if it were the head's direction: were the eyes tracked? Leave them out "
        "(nerg rays filter --without-person)"
    ]
