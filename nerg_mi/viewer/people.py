"""People in the page: their paths, where they are at a moment, and whose eye the observer is."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np

from .page import Page
from .tracks import ALL, Tracks
from .view import heading_of

NOBODY = "(nobody)"
_STEPS = 2000


class People:
    """The part of a page's panel for rays, and their paths."""

    def __init__(self, page: Page, tracks: Tracks):
        self.page, self._tracks = page, tracks
        self._shown: list[Any] = []
        self._paths: Any = None
        gui = page.server.gui
        first, last = tracks.times
        with gui.add_folder("People"):
            self._group = gui.add_dropdown("Who", tracks.groups, initial_value=ALL)
            self._drawn = gui.add_checkbox("Paths", True)
            step = max((last - first) / _STEPS, 1e-3)
            self._time = gui.add_slider("Time (s)", first, max(last, first + step), step, first)
            self._eye = gui.add_dropdown("Observer follows", [NOBODY, *tracks.people], initial_value=NOBODY)
        self._group.on_update(lambda event: self._changed())
        self._drawn.on_update(lambda event: self._changed())
        self._time.on_update(lambda event: self._moment())
        self._eye.on_update(lambda event: self._moment())
        self._changed()

    def _changed(self) -> None:
        if self._paths is not None:
            self._paths.remove()
            self._paths = None
        segments, person = self._tracks.segments(self._group.value)
        if self._drawn.value and len(segments):
            colors = np.repeat(color_of(person)[:, None], 2, axis=1)
            self._paths = self.page.server.scene.add_line_segments(
                "/people/paths", segments, colors, thickness=1.5, thickness_units="screen"
            )
        self._moment()

    def _moment(self) -> None:
        for handle in self._shown:
            handle.remove()
        self._shown = []
        poses = self._tracks.at_time(self._time.value, self._group.value)
        scene, names = self.page.server.scene, self._tracks.people
        for k, pose in enumerate(poses[:200]):
            color = tuple(int(c) for c in color_of(np.array([names.index(pose.person)]))[0])
            self._shown.append(
                scene.add_icosphere(f"/people/at/{k}", radius=0.07, color=color, position=tuple(pose.at))
            )
            arrow = np.stack([pose.at, pose.at + 0.6 * pose.ahead])[None].astype(np.float32)
            self._shown.append(
                scene.add_arrows(f"/people/ahead/{k}", arrow, color, shaft_radius=0.012, head_radius=0.035)
            )
        followed = next((p for p in poses if p.person == self._eye.value), None)
        if followed is not None:
            self.page.place_observer(followed.at, heading_of(followed.ahead, self.page.session.place.up))


def color_of(person: np.ndarray) -> np.ndarray:
    """A colour (N, 3) uint8 for each person's number (N,)."""
    found = matplotlib.colormaps["tab10"](np.asarray(person) % 10)[:, :3]
    return (255 * found).astype(np.uint8)
