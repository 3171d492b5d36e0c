"""Gaze that does not move."""

from __future__ import annotations

import numpy as np

from .figures import Figures, name_some
from .protocol import check

_SHARE, _SECONDS = 0.01, 10.0  # of a person's rays: less is a moment without the eyes


@check(
    "gaze that does not turn for a second or more, in the world or against the head, while the head moves "
    "(`nerg rays filter`)"
)
def check_frozen(figures: Figures) -> list[str]:
    rays = figures.rays
    frozen = figures.frozen
    if not frozen.any() or not figures.step:
        return []
    lost, all_ = (np.bincount(p, minlength=len(rays.persons)) for p in (rays.person[frozen], rays.person))
    who = np.flatnonzero((lost >= _SHARE * all_) & (lost * figures.step >= _SECONDS))
    if not who.size:
        return []
    who = who[np.argsort(-lost[who] / all_[who], kind="stable")]
    names = [f"{rays.persons[p]} ({100 * lost[p] / all_[p]:.0f} % of the rays)" for p in who]
    whole = [p for p in who if lost[p] > 0.9 * all_[p]]
    remedy = "leave these times out (nerg rays filter --from, --to)"
    if len(whole) == len(who):
        remedy = "leave them out (nerg rays filter --without-person)"
    return [
        f"the gaze of {name_some(names)} stands still for seconds while the head moves, as if the tracker had lost the "
        f"eyes or wrote the head's direction in their place; {remedy}"
    ]
