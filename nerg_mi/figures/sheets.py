"""Contact sheets of several pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .style import Sheet


def contact_sheet(
    pictures: Sequence[np.ndarray],
    titles: Sequence[str],
    columns: int | None = None,
    add_scale: Callable[[Sheet], None] | None = None,
    note: str = "",
) -> Any:
    """``pictures`` (h, w, 3), display values, each under its title, in rows of ``columns`` (default: about as many as
    rows); smaller ones lie in the middle of their place.

    ``add_scale``: draws the one scale of all on the sheet; ``note``: what they rest on.
    """
    if not pictures:
        raise ValueError("a contact sheet needs at least one picture")
    columns = columns or math.ceil(math.sqrt(len(pictures)))
    height, width = (max(p.shape[axis] for p in pictures) for axis in (0, 1))
    sheet = Sheet(
        [_padded(p, height, width) for p in pictures], titles, scale=add_scale is not None, columns=columns, note=note
    )
    if add_scale is not None:
        add_scale(sheet)
    return sheet.page


def shrink(picture: Any, width: int) -> np.ndarray:
    """``picture`` (h, w, 3) at most ``width`` pixels wide: means of squares of whole pixels, so that nothing is
    invented; what lacks to a square at the right and lower edge is left out."""
    picture = np.asarray(picture, np.float64)
    by = max(math.ceil(picture.shape[1] / width), 1)
    h, w = (max(n // by, 1) for n in picture.shape[:2])
    if by == 1:
        return picture
    some = picture[: h * by, : w * by]
    return some.reshape(h, some.shape[0] // h, w, some.shape[1] // w, 3).mean(axis=(1, 3))


def _padded(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    out = np.ones((height, width, 3))
    h, w = picture.shape[:2]
    top, left = (height - h) // 2, (width - w) // 2
    out[top : top + h, left : left + w] = picture
    return out
