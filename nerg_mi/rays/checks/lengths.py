"""The unit of length and the up axis, by where heads are.

The bounds are wide: they catch a wrong unit or axis, not an unusual shop.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.rays.rays import Rays

from .figures import ENOUGH, MOST, Figures, to_source
from .protocol import check

_HEADS = 0.4, 2.3  # metres over the floor between which the median of all heads is


@check(
    "heights and extents that heads do not have, and the axis of the file along which they have them (`--units`, "
    "`--up`)"
)
def check_lengths(figures: Figures) -> list[str]:
    """Units of length and the up axis, by the heights and the extent of the origins."""
    extent, median, out = figures.extent, figures.height[1], []
    if 100 <= median <= 230:
        out.append(f"the median height is {median:.0f} m: is the unit centimetres? (--units cm)")
    elif extent.max() > 1000 or 1000 <= median <= 2300:
        out.append(
            f"the origins span {extent.max():.0f} m, at a median height of {median:.0f} m: "
            "is the unit millimetres? (--units mm)"
        )
    elif extent.max() < 0.05 and len(figures.rays) >= ENOUGH:
        out.append(f"the origins span {extent.max():.3f} m: is the unit larger than declared?")
    elif (extent[2] > 2.0 and extent[2] > min(extent[0], extent[1])) or (
        figures.floor_known and not _HEADS[0] <= median <= _HEADS[1]
    ):
        what = (
            "the origins vary more in height than sideways"
            if not figures.floor_known or _HEADS[0] <= median <= _HEADS[1]
            else f"the median eye height is {median:.2f} m"
        )
        axis = _standing_axis(figures.rays)
        remedy = (
            f"{axis} of the file looks like the height: is it the up axis? (--up {axis})"
            if axis
            else "check the up axis and the unit, or the floor is not at height 0"
        )
        out.append(f"{what}; {remedy}")
    return out


def _standing_axis(rays: Rays) -> str | None:
    """The axis of the file along which origins stay where heads are, if there is one besides the declared."""
    part = rays.origin[:: max(1, len(rays) // MOST)] @ to_source(rays).T
    low, mid, high = np.percentile(part, [5, 50, 95], axis=0)
    like_heads = (np.abs(mid) > 0.9) & (np.abs(mid) < 2.2) & (high - low < 1.0)
    like_heads[np.argmax(np.abs(to_source(rays)[:, 2]))] = False
    (found,) = np.nonzero(like_heads)
    return None if len(found) != 1 else ("-" if mid[found[0]] < 0 else "") + "xyz"[found[0]]
