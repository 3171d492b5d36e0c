"""How a picture is divided into strips of samples, which an interruption and a report of progress can fall between."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

PACKET = 64
"""Samples that Dr.Jit may add up as one (16 on a CPU, 32 on a GPU): a strip begins at a multiple of this many."""

LEAST = 1 << 12
"""Samples below which the overhead of a strip outweighs its work."""

STRIP_SECONDS = 0.5
"""A strip that took longer than this is followed by shorter ones, one that took less than half of it by longer ones."""


class Pace:
    """How many samples a strip has, from the time that those before it took; ``fixed``: always as many. It may serve
    several pictures in turn, in one variant."""

    def __init__(self, fixed: int = 0):
        import mitsuba as mi

        self._fixed = fixed
        self._count = fixed or (1 << 20 if str(mi.variant()).startswith("cuda") else 1 << 15)
        self._most = 1 << 24 if str(mi.variant()).startswith("cuda") else 1 << 18
        self._since, self._strips = 0.0, 0

    def begin(self) -> None:
        """A picture begins: what was done since the last one is no strip's time."""
        self._strips = 0

    def strips(self, start: int, stop: int, spp: int) -> Iterator[tuple[int, int]]:
        """``(first, count)`` of strips from sample ``start``, or from the packet that it lies in, to ``stop``."""
        # With whole pixels in every strip, unless a pixel alone has more samples than a strip may have.
        unit = math.lcm(PACKET, spp)
        unit = unit if unit <= self._most else PACKET
        first = start - start % PACKET
        while first < stop:
            last = min(max((first + self._count) // unit, first // unit + 1) * unit, stop)
            yield first, last - first
            first = last

    def wait(self) -> None:
        """Until the strip before is done."""
        import drjit as dr

        dr.sync_thread()
        now = time.perf_counter()
        # The first wait is for nothing, and the first strip's kernel had to be compiled.
        if self._strips > 1 and not self._fixed:
            seconds = now - self._since
            if seconds > STRIP_SECONDS:
                self._count = max(self._count // 2, LEAST)
            elif seconds < STRIP_SECONDS / 2:
                self._count = min(self._count * 2, self._most)
        self._since, self._strips = now, self._strips + 1
