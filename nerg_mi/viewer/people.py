"""People in the page: their paths, rays and probes, where they are at a moment, and whose eye the observer is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import matplotlib
import numpy as np

from nerg_mi.api.queries import trace

from .page import Page
from .session import UNHURRIED
from .tracks import ALL, RAYS, Tracks
from .view import heading_of

NOBODY = "(nobody)"
_STEPS = 2000
_NOTHING = 1.0  # length of a ray that meets no surface, in scene units


class People:
    """The part of a page's panel for rays, and their paths."""

    def __init__(self, page: Page, tracks: Tracks):
        self.page, self._tracks = page, tracks
        self._shown: list[Any] = []
        self._paths: Any = None
        self._recorded: dict[str, Any] = {}
        gui = page.server.gui
        first, last = tracks.times
        with gui.add_folder("People"):
            self._group = gui.add_dropdown("Who", tracks.groups, initial_value=ALL)
            self._drawn = gui.add_checkbox("Paths", False)
            self._rays = gui.add_checkbox("Rays", False)
            self._probes = gui.add_checkbox("Probes", False)
            step = max((last - first) / _STEPS, 1e-3)
            self._time = gui.add_slider("Time (s)", first, max(last, first + step), step, first)
            self._eye = gui.add_dropdown("Observer follows", [NOBODY, *tracks.people], initial_value=NOBODY)
        self._group.on_update(lambda event: self._changed())
        self._drawn.on_update(lambda event: self._changed())
        self._rays.on_update(lambda event: self._show_rays())
        self._probes.on_update(lambda event: self._show_probes())
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
        self._show_rays()
        self._show_probes()

    def _show_rays(self) -> None:
        """Lines from eyes to what they looked at, where rays are wanted."""
        self._renew("rays", self._trace_rays if self._rays.value else None)

    def _show_probes(self) -> None:
        """Balls where a density of the rays would be said to hold, where probes are wanted."""
        self._renew("probes", self._place_probes if self._probes.value else None)

    def _renew(self, name: str, draw: Callable[[], Any] | None) -> None:
        """What is drawn as ``name``, by ``draw`` on the thread that renders; None: nothing."""

        def steps() -> Iterator[None]:
            old = self._recorded.pop(name, None)
            if old is not None:
                old.remove()
            if draw is not None:
                self._recorded[name] = draw()
            yield

        self.page.session.worker.submit(("people", name), UNHURRIED, steps())

    def _trace_rays(self) -> Any:
        eyes, ahead, person = self._tracks.sample(self._group.value)
        if not len(eyes):
            return self.page.server.scene.add_frame("/people/rays", show_axes=False)
        # Kernels are compiled for a number of rays.
        fill = RAYS - len(eyes)
        o, d = (np.concatenate([v, np.repeat(v[-1:], fill, axis=0)]) for v in (eyes, ahead))
        found = trace(self.page.session.scene, o, d, ["depth"], observers=o[:1])
        depth = np.asarray(found.depth[0], float)[: len(eyes)]
        length = np.where((depth > 0) & np.isfinite(depth), depth, _NOTHING)
        lines = np.stack([eyes, eyes + length[:, None] * ahead], axis=1).astype(np.float32)
        colors = np.repeat(color_of(person)[:, None], 2, axis=1)
        return self.page.server.scene.add_line_segments(
            "/people/rays", lines, colors, thickness=1.0, thickness_units="screen"
        )

    def _place_probes(self) -> Any:
        positions, counts = self._tracks.probes(self._group.value)
        share = np.log(counts) / max(np.log(counts.max()), 1e-9)
        colors = (255 * matplotlib.colormaps["viridis"](share)[:, :3]).astype(np.uint8)
        return self.page.server.scene.add_point_cloud(
            "/people/probes", positions.astype(np.float32), colors, point_size=0.12, point_shape="circle"
        )

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
