"""One browser that looks: its view, what it is shown, and how quickly it draws."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .proxy import LEVELS
from .refining import Picture
from .view import View

SLOW, QUICK = 1 / 20, 1 / 40
"""Seconds a frame above which a browser is given fewer points, and below which more."""

_FRAMES = 8
"""It is judged by so many frames."""

REST = 0.12
"""Seconds without movement after which a picture is refined."""

_LONGEST_REST = 0.8


@dataclass(eq=False)
class Window:
    """One browser: its ``client`` and the points in it; when it or what it shows ``moved`` last and whether that was
    ``noticed``, and when it ``looked`` elsewhere last; the ``version`` of its view, and whether it shows a ``picture``;
    ``stale``: why its points are greyed, "" where they are not; ``note``: what was done to its camera; ``free``: where
    that last stood in free air; the ``last`` picture, with its colours. ``level``: which of the proxy's numbers of
    points it is given; ``frames``: seconds between the last views of a movement."""

    client: Any
    status: Any
    cloud: Any = None
    view: View | None = None
    moved: float = 0.0
    looked: float = 0.0
    noticed: bool = False
    version: int = 0
    picture: bool = False
    stale: str = ""
    note: str = ""
    free: np.ndarray | None = None
    last: tuple[Picture, np.ndarray] | None = None
    lines: list[str] = field(default_factory=list)
    level: int = LEVELS - 2
    frames: list[float] = field(default_factory=list)

    def learn_pace(self, seconds: float) -> None:
        """The view before was told ``seconds`` ago: a browser tells of each frame, while its camera moves."""
        if seconds < 1:
            self.frames.append(seconds)

    @property
    def rest(self) -> float:
        """Seconds without a new view after which its camera rests: a browser that draws slowly tells of it seldom, and
        pictures that are refined meanwhile would make it slower still."""
        return float(np.clip(3 * np.median(self.frames[-_FRAMES:] or [0.0]), REST, _LONGEST_REST))

    def level_for_pace(self, at_rest: bool) -> int:
        """The level that its frames ask for; more points only ``at_rest``."""
        if len(self.frames) < _FRAMES:
            return self.level
        # The quickest quarter: a mouse that pauses is no slow browser.
        frame = float(np.percentile(self.frames, 25))
        if frame > SLOW:
            return min(self.level + 1, LEVELS - 1)
        return max(self.level - 1, 0) if at_rest and frame < QUICK else self.level
