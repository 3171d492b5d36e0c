"""The kinds of figures of files that were rendered or baked before, in the order in which they are listed."""

from __future__ import annotations

from .difference import DIFFERENCE_KIND
from .kind import Kind
from .sheet import SHEET_KIND
from .surface import SURFACE_KIND

FILE_KINDS: tuple[Kind, ...] = (SHEET_KIND, DIFFERENCE_KIND, SURFACE_KIND)
