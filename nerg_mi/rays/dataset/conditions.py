"""Which rays of a dataset are asked for: parts and row groups are passed over by what is known of them, and rays by
`nerg_mi.rays.filters`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.rays.filters import select_mask
from nerg_mi.rays.rays import Rays

from .layout import bucket_of
from .manifest import Part
from .merging import merge_rays


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What rays must meet, as `nerg_mi.rays.filters.select_mask` has it; None, or nothing: all do."""

    time: tuple[float | None, float | None] | None = None
    persons: Sequence[str] | None = None
    without_persons: Sequence[str] | None = None
    cohorts: Sequence[str] | None = None
    box: Sequence[float] | None = None
    min_confidence: float | None = None
    with_hit: bool = False

    def check(self) -> None:
        """Raise `NergError` for a box that is none."""
        select_mask(merge_rays([]), box=self.box)

    @property
    def any(self) -> bool:
        """Whether any is given."""
        return self != Conditions()

    def may_hold(self, part: Part, buckets: int) -> bool:
        """Whether rays of a part may meet them, by its account."""
        if self.with_hit and not part.hits:
            return False
        if self.persons is not None and not any(
            bucket_of(p, buckets) == part.bucket and part.first <= p <= part.last for p in self.persons
        ):
            return False
        return self._meets_time(part.start, part.end) and self._meets_box(part.low, part.high)

    def may_hold_group(self, found: dict[str, tuple[Any, Any]]) -> bool:
        """Whether rays of a row group may meet them; ``found``: least and greatest of its columns, as far as they are
        known."""
        axes = [found.get(f"origin_{axis}") for axis in "xyz"]
        if all(axes) and not self._meets_box([a[0] for a in axes if a], [a[1] for a in axes if a]):
            return False
        if "t" in found and not self._meets_time(*found["t"]):
            return False
        if "person" in found and self.persons is not None:
            low, high = found["person"]
            return any(low <= p <= high for p in self.persons)
        return True

    def _meets_time(self, start: float, end: float) -> bool:
        begin, until = self.time or (None, None)
        return (begin is None or end >= begin) and (until is None or start < until)

    def _meets_box(self, low: Sequence[float], high: Sequence[float]) -> bool:
        if self.box is None:
            return True
        sides = np.asarray(self.box, np.float64)
        return bool((np.asarray(high) >= sides[0::2]).all() and (np.asarray(low) <= sides[1::2]).all())

    def select(self, rays: Rays) -> Rays:
        """The rays that meet them. Names that do not occur among ``rays`` are no error here."""
        if not self.any:
            return rays
        here = lambda names, known: None if names is None else [name for name in names if name in known]
        asked = replace(
            self,
            persons=here(self.persons, rays.persons),
            without_persons=here(self.without_persons, rays.persons),
            cohorts=here(self.cohorts, rays.cohorts),
        )
        if asked.cohorts is not None and rays.cohort is None:
            # Of a source without cohorts.
            return rays.select(np.zeros(len(rays), bool))
        mask = select_mask(rays, **{name: getattr(asked, name) for name in asked.__dataclass_fields__})
        return rays if mask.all() else rays.select(mask)


EVERYTHING = Conditions()
"""What all rays meet."""
