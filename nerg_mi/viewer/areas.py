"""Areas of interest in the page: boxes that are drawn, moved, named, and saved as JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sentence
from nerg_mi.formats.regions import MOST, Region, to_json

from .controls import tell
from .page import Page
from .view import View

COLOR = (90, 200, 255)
_CHOSEN = (255, 210, 60)
_NONE = "(none)"
_LEAST = 0.05
_FEW = 8


class Areas:
    """The part of a page's panel for areas, and their boxes."""

    def __init__(self, page: Page):
        self.page, self.session = page, page.session
        self._boxes: dict[str, list[Any]] = {}
        self._gizmo: Any = None
        gui = page.server.gui
        with gui.add_folder("Areas of interest", expand_by_default=False):
            self._name = gui.add_text("Name", "area 1")
            draw = gui.add_button("Draw a box in the view")
            self._chosen = gui.add_dropdown("Change", self._names(), initial_value=_NONE)
            self._size = gui.add_vector3("Size", (1.0, 1.0, 1.0), min=(_LEAST,) * 3, step=0.05)
            remove = gui.add_button("Remove")
            self._visible = gui.add_checkbox("Show boxes", len(self.session.regions) <= _FEW)
            save = gui.add_button("Save (JSON)")
        draw.on_click(self._draw)
        remove.on_click(self._remove)
        self._chosen.on_update(lambda event: self._choose())
        self._size.on_update(self._resize)
        self._visible.on_update(lambda event: self._show_all())

        @save.on_click
        def _(event: Any) -> None:
            text = to_json(self.session.regions, self.session.other_areas).encode()
            event.client.send_file_download("areas.json", text, save_immediately=True)

        self._show_all()

    def add(self, region: Region) -> None:
        """One more area. Raises `NergError` for a name that there is already, and for too many."""
        if region.name in (r.name for r in self.session.regions):
            raise NergError(f'there is an area "{region.name}" already; give it another name')
        if len(self.session.regions) >= MOST:
            raise NergError(f"there are {MOST} areas already; remove one of them")
        self.session.regions = [*self.session.regions, region]
        self._changed(region.name)

    def _draw(self, event: Any) -> None:
        client, name = event.client, self._name.value
        if client is None:
            return
        scene = client.scene

        @scene.on_rect_select()
        def _(drawn: Any) -> None:
            scene.remove_rect_select_callback()
            proxy = self.session.proxy
            view = View.of_page(client.camera)
            try:
                if proxy is None:
                    raise NergError("there are no points to lay a box around yet; wait a moment")
                lower, upper = box_around(proxy.points, proxy.size, view, drawn.screen_min, drawn.screen_max)
                self.add(Region.of(name, lower, upper))
            except NergError as error:
                tell(client, "Areas", sentence(error))
                return
            self._name.value = f"area {len(self.session.regions) + 1}"

        # Messages arrive in order: whoever reads this can draw, and does not turn the camera instead.
        tell(client, "Areas", "Draw a rectangle around a thing: a box is laid around what is in it.")

    def _remove(self, event: Any) -> None:
        self.session.regions = [r for r in self.session.regions if r.name != self._chosen.value]
        self._changed(_NONE)

    def _names(self) -> list[str]:
        return [_NONE, *(region.name for region in self.session.regions)]

    def _changed(self, chosen: str) -> None:
        self._chosen.options = self._names()
        self._chosen.value = chosen
        self._choose()
        self.page.count()

    def _choose(self) -> None:
        """A gizmo for the area that is chosen."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        region = next((r for r in self.session.regions if r.name == self._chosen.value), None)
        if region is not None:
            corners = region.corners
            self._size.value = tuple(corners[1] - corners[0])
            scene = self.page.server.scene
            self._gizmo = scene.add_transform_controls(
                "/chosen_area",
                scale=0.35,
                disable_rotations=True,
                depth_test=False,
                position=tuple(corners.mean(axis=0)),
            )

            @self._gizmo.on_update
            def _(event: Any) -> None:
                self._replace(np.asarray(self._gizmo.position), np.asarray(self._size.value))

        self._show_all()

    def _resize(self, event: Any) -> None:
        if self._gizmo is not None and event.client is not None:
            self._replace(np.asarray(self._gizmo.position), np.asarray(self._size.value))

    def _replace(self, middle: np.ndarray, size: np.ndarray) -> None:
        name = self._chosen.value
        lower, upper = middle - size / 2, middle + size / 2
        turn = next((r.turn for r in self.session.regions if r.name == name), None)
        try:
            new = Region.of(name, lower, upper, turn)
        except NergError:
            # Nothing that a hand can drag: the gizmo goes back to where the area is.
            self._choose()
            return
        self.session.regions = [new if r.name == name else r for r in self.session.regions]
        self._show_all()
        self.page.count()

    def _show_all(self) -> None:
        for handles in self._boxes.values():
            for handle in handles:
                handle.remove()
        self._boxes = {}
        if not self._visible.value:
            return
        scene = self.page.server.scene
        for k, region in enumerate(self.session.regions):
            chosen = region.name == self._chosen.value
            color = _CHOSEN if chosen else COLOR
            box = scene.add_line_segments(
                f"/areas/{k}", edges(region), np.array(color, np.uint8), thickness=2.0, thickness_units="screen"
            )
            handles = [box]
            if chosen or len(self.session.regions) <= _FEW:
                top = (*region.middle[:2], region.bounds[1, 2])
                handles.append(scene.add_label(f"/areas/{k}_name", region.name, position=top, anchor="bottom-center"))
            self._boxes[region.name] = handles


def edges(region: Region) -> np.ndarray:
    """The twelve edges (12, 2, 3) of a box, along one axis after the other."""
    corners = region.vertices
    ends = [(k, k | 1 << axis) for axis in range(3) for k in range(8) if not k >> axis & 1]
    return corners[np.array(ends)].astype(np.float32)


def box_around(
    points: np.ndarray, margin: float, view: View, low: tuple[float, float], high: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box around those of ``points`` (N, 3) that are seen within a rectangle of the picture (0..1 from its
    upper left corner), with a ``margin``: those that lie no deeper behind the foremost than the rectangle is wide
    there.

    Raises `NergError` where there are none.
    """
    away = np.asarray(points, float) - view.origin
    depth = away @ view.ahead
    right = np.cross(view.ahead, view.up)
    rise = np.tan(view.fov / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = 0.5 + (away @ right) / (depth * rise * view.aspect) / 2
        y = 0.5 - (away @ view.up) / (depth * rise) / 2
    inside = (depth > 1e-3) & (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    if inside.sum() < 8:
        raise NergError("there is nothing within that rectangle; draw one around a thing")
    foremost = float(np.percentile(depth[inside], 5))
    wide = 2 * foremost * rise * max((high[0] - low[0]) * view.aspect, high[1] - low[1])
    near = np.asarray(points, float)[inside & (depth <= foremost + wide)]
    return np.percentile(near, 1, axis=0) - margin, np.percentile(near, 99, axis=0) + margin
