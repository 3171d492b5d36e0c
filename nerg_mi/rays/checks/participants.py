"""Participants who are rows of a table: its column of them counts rows, or names each sample."""

from __future__ import annotations

import numpy as np

from .figures import ENOUGH, Figures
from .protocol import check

_FEW = 2  # rays of a participant, by the median


@check("participants of one or two rays each: a column that counts rows, taken for participants (`person` in `--map`)")
def check_participants(figures: Figures) -> list[str]:
    rays = np.bincount(figures.rays.person)
    rays = rays[rays > 0]
    if figures.selected or len(rays) < ENOUGH or np.median(rays) > _FEW:
        return []
    return [
        f"{len(rays):,} participants have {len(figures.rays):,} rays together: does their column count rows? (leave "
        "person out of --map, so that each file is a participant)"
    ]
