"""Controls of the viewer: sliders, layers, and areas of interest that are drawn on the page."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, format_error
from nerg_mi.figures.style import Provenance, make_provenance
from nerg_mi.files.images import encode_png
from nerg_mi.formats.areas import MAX_AREAS, Region, format_areas
from nerg_mi.rendering.scene import list_scene_files

from . import layers
from .layers import Scale
from .page import BrowserWindow, Page
from .points import PinholeView, heading_of
from .scene import copied_view

# ---- Controls ----
#
# The panel: what is shown and how, the observer's own view, the numbers, and the camera.

INSET = 240
"""Width of the observer's own view, in pixels."""

_ROWS = 12
_USUAL = "as usual"
_AGAIN = 0.4


def tell(event_or_client: Any, title: str, text: str) -> None:
    """A note in the corner of one page."""
    client = getattr(event_or_client, "client", event_or_client)
    if client is not None:
        client.add_notification(title=title, body=text, with_close_button=True, auto_close_seconds=12.0)


@contextmanager
def telling(event_or_client: Any, title: str) -> Iterator[None]:
    """Tell one page of what is refused within the block, which ends there."""
    try:
        yield
    except NergError as error:
        tell(event_or_client, title, format_error(error))


class Inset:
    """A small picture of the panel, ``title``, which is greyed while another one is made."""

    def __init__(self, gui: Any, title: str, height: int):
        self._title, self._colors = title, np.zeros((height, INSET, 3), np.uint8)
        self._handle = gui.add_image(self._colors, label=title)
        self._stale = False
        self.set_stale()

    def set_stale(self) -> None:
        """What it shows is out of date."""
        if not self._stale:
            self._stale = True
            self._handle.image = layers.greyed(self._colors)
            self._handle.label = f"{self._title} (grey: out of date)"

    def show(self, colors: np.ndarray) -> None:
        """Show ``colors`` (height, width, 3) uint8, which are up to date."""
        self._stale, self._colors = False, colors
        self._handle.image = colors
        self._handle.label = self._title


def slider_end(value: float) -> float:
    """The upper end of a slider from 0 on which ``value`` lies: a power of ten, at least three times as large."""
    return 10.0 ** math.ceil(math.log10(3 * value)) if value > 0 else 1.0


class Controls:
    """The panel of a `Page`."""

    def __init__(self, page: Page):
        self.page, self.session, self.gui = page, page.session, page.server.gui
        self._insets_at, self._insets_late = 0.0, False
        self._insets_of: tuple[Any, ...] = ()
        self._lock, self._scaling = threading.Lock(), threading.Lock()
        with self.gui.add_folder("Show"):
            self._show()
        with self.gui.add_folder("Observer"):
            self._observer()
        if self.session.scene.has_gaze:
            with self.gui.add_folder("Attention"):
                self._table = self.gui.add_html("")
        with self.gui.add_folder("Camera", expand_by_default=False):
            self._camera()
        page.on_moved.append(self.refresh)
        page.on_marked.append(self.refresh)

    # What is shown

    def _show(self) -> None:
        session, gui = self.session, self.gui
        names = list(session.place.variants)
        variant = gui.add_dropdown("Gaze field", names, initial_value=session.gaze_name) if len(names) > 1 else None
        titles = [layer.title for layer in session.layers]
        layer = gui.add_dropdown("Layer", titles, initial_value=session.shade.layer.title)
        self._legend = gui.add_html(layers.format_legend(session.shade.layer, session.scale(), self.page.stale))
        basis = gui.add_html(basis_note(session))
        colors = gui.add_dropdown("Colours", _maps_of(session.shade.layer), initial_value=_USUAL)
        automatic = gui.add_checkbox("Automatic range", True)
        ends = gui.add_vector2("Range", (0.0, 1.0), step=0.01, disabled=True)
        # As Mitsuba has it, in single precision, it would be written with all its digits.
        top = slider_end(session.falloff)
        falloff = gui.add_slider("Fall-off", 0.0, top, 0.01 * top, float(f"{session.falloff:.4g}"))

        def change(event: Any) -> None:
            if event.client is None:
                # Written by the program, which has set all else.
                return
            chosen = next(la for la in session.layers if la.title == layer.value)
            if tuple(colors.options) != _maps_of(chosen):
                colors.options = _maps_of(chosen)
            if chosen != session.shade.layer and not automatic.value:
                # A range in 1/sr says nothing of metres.
                automatic.value = True
            ends.disabled = automatic.value
            if event.target is automatic and not automatic.value:
                scale = session.scale()
                ends.value = (float(f"{scale.low:.3g}"), float(f"{scale.high:.3g}"))
            fixed = None if automatic.value else ends.value
            with telling(event, "Range"):
                if fixed is not None:
                    Scale(fixed[0], fixed[1])
                session.set_shade(layer=chosen, colors=None if colors.value == _USUAL else colors.value, fixed=fixed)
                self._shown_anew()

        for handle in (layer, colors, automatic, ends):
            handle.on_update(change)

        def change_gaze(event: Any) -> None:
            if event.client is None:
                return
            try:
                session.set_gaze(event.target.value)
            except NergError as error:
                tell(event, "Gaze field", format_error(error))
                event.target.value = session.gaze_name
                return
            layer.options = tuple(la.title for la in session.layers)
            layer.value = session.shade.layer.title
            basis.content = basis_note(session)
            self.page.follow()
            self._shown_anew()

        if variant is not None:
            variant.on_update(change_gaze)

        @falloff.on_update
        def _(event: Any) -> None:
            with telling(event, "Fall-off"):
                session.set_falloff(falloff.value)
                self.page.follow()
                self._shown_anew()

    def _shown_anew(self) -> None:
        self.page.recolor()
        self.page.renew()
        self.refresh()

    # The observer

    def _observer(self) -> None:
        session, gui = self.session, self.gui
        self._at = gui.add_vector3("At", rounded(session.observer), step=0.05)
        to_camera = gui.add_button("Observer to the camera")
        to_observer = gui.add_button("Camera to the observer")
        self._own, self._sphere = Inset(gui, "Own view", INSET * 2 // 3), Inset(gui, "All around", INSET // 2)

        @self._at.on_update
        def _(event: Any) -> None:
            if event.client is not None and not np.allclose(self._at.value, session.observer, atol=1e-3):
                try:
                    self.page.place_observer(np.array(self._at.value))
                except NergError as error:
                    tell(event, "Observer", format_error(error))
                    self._at.value = rounded(session.observer)

        @to_camera.on_click
        def _(event: Any) -> None:
            view = PinholeView.of_page(event.client.camera)
            self.page.place_observer(view.origin, heading_of(view.ahead, session.place.up))

        @to_observer.on_click
        def _(event: Any) -> None:
            look(event.client, session.observer, session.observer + 2 * session.heading[:, 0], session.place.up)

    def refresh(self) -> None:
        """Numbers, scale and insets as they are now; insets not more often than they can be looked at."""
        session = self.session
        self._rescale()
        at = rounded(session.observer)
        if not np.allclose(self._at.value, at, atol=1e-3):
            self._at.value = at
        with self._lock:
            if self._inset_key() == self._insets_of:
                return
            self._own.set_stale()
            self._sphere.set_stale()
            if time.monotonic() - self._insets_at < _AGAIN:
                if not self._insets_late:
                    self._insets_late = True
                    timer = threading.Timer(_AGAIN, self._insets_later)
                    timer.daemon = True
                    timer.start()
                return
            self._insets_at = time.monotonic()
        self._insets()

    def _rescale(self) -> None:
        # Several threads come here, and the last to write should be the last to have looked.
        with self._scaling:
            session = self.session
            self._legend.content = layers.format_legend(session.shade.layer, session.scale(), self.page.stale)
            if session.scene.has_gaze:
                self._table.content = table(session.shares, session.stale_shares)

    def _inset_key(self) -> tuple[Any, ...]:
        """What the insets depend on."""
        session = self.session
        at = session.observer.tolist(), session.heading.tolist()
        return *at, session.shade, session.scale(), session.version, session.ceiling

    def _insets_later(self) -> None:
        with self._lock:
            self._insets_late, self._insets_at = False, time.monotonic()
        self._insets()

    def _insets(self) -> None:
        session = self.session
        key = self._insets_of = self._inset_key()

        def own(picture: Any, colors: np.ndarray) -> None:
            if picture.whole and key == self._inset_key():
                self._own.show(colors)

        def sphere(colors: np.ndarray) -> None:
            if key == self._inset_key():
                self._sphere.show(colors)

        ahead, up = session.heading[:, 0], session.heading[:, 2]
        view = PinholeView.of(session.observer, session.observer + ahead, up, np.radians(60), 1.5)
        session.inset("own", view, own, INSET)
        session.sphere(sphere, INSET)

    # The camera

    def _camera(self) -> None:
        session, gui, place = self.session, self.gui, self.session.place
        home = gui.add_button("First view")
        above = gui.add_button("From above")
        cut = gui.add_checkbox("Cut the ceiling off", session.ceiling is not None)
        height = gui.add_slider("Height of the cut", 0.0, 1.0, 0.01, 0.8)
        shot = gui.add_button("Save the picture (PNG)")
        copy = gui.add_button("Copy as a scene (XML)")

        @home.on_click
        def _(event: Any) -> None:
            view = session.home
            look(event.client, view.origin, view.origin + 3 * view.ahead, place.up)

        def change_cut(event: Any) -> None:
            lower, upper = self._heights()
            session.ceiling = lower + height.value * (upper - lower) if cut.value else None
            self._shown_anew()

        cut.on_update(change_cut)
        height.on_update(change_cut)

        @above.on_click
        def _(event: Any) -> None:
            if session.proxy is None:
                return
            cut.value = True
            change_cut(event)
            lower, upper = (np.asarray(corner, float) for corner in session.proxy.bounds)
            middle, size = (lower + upper) / 2, float(np.linalg.norm(upper - lower))
            # Straight down there is no up: a little to the side keeps the picture the right way round.
            side = session.heading[:, 0] * 0.02 * size
            look(event.client, middle + 0.95 * size * place.up - side, middle, place.up)

        @shot.on_click
        def _(event: Any) -> None:
            window = self._window(event)
            if window is None or window.last is None:
                tell(event, "Picture", "There is no picture yet: wait until the view rests.")
                return
            with telling(event, "Picture"):
                data = png_bytes(session, window.last[1], about_picture(session, window).text())
                event.client.send_file_download("view.png", data, save_immediately=True)

        @copy.on_click
        def _(event: Any) -> None:
            window = self._window(event)
            if window is None or window.view is None:
                return
            with telling(event, "Scene"):
                text = copied_view(session, window.view)
                event.client.send_file_download("view.xml", text.encode(), save_immediately=True)

    def _window(self, event: Any) -> BrowserWindow | None:
        return None if event.client is None else self.page.windows.get(event.client.client_id)

    def _heights(self) -> tuple[float, float]:
        """Lowest and highest of the points along up."""
        proxy = self.session.proxy
        if proxy is None:
            return 0.0, 1.0
        along = proxy.points @ self.session.cut_up
        return float(np.percentile(along, 0.5)), float(np.percentile(along, 99.5))


def _maps_of(layer: layers.Layer) -> tuple[str, ...]:
    return _USUAL, *layers.MAPS[layers.color_kind(layer)]


def basis_note(session: Any) -> str:
    """How many rays of how many people the gaze is made of, as HTML; "" where that is not known."""
    return layers.note(f"gaze {session.basis}") if session.basis else ""


def look(client: Any, origin: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    """Turn one page's camera."""
    if client is None:
        return
    with client.atomic():
        client.camera.up_direction = tuple(up)
        client.camera.position = tuple(origin)
        client.camera.look_at = tuple(target)


def table(shares: dict[str, float], stale: bool = False) -> str:
    """Shares of attention as HTML, the largest first; ``stale``: they are out of date."""
    if not shares:
        return layers.note("Computing." if stale else "Name areas to see their share of attention.")
    rows = sorted(shares.items(), key=lambda item: -item[1])
    rest = sum(share for _, share in rows[_ROWS:])
    shown = [*rows[:_ROWS], *([(f"{len(rows) - _ROWS} more", rest)] if len(rows) > _ROWS else [])]
    cells = "".join(
        f"<tr><td>{escape(name)}</td><td style='text-align:right'>{100 * share:.1f} %</td></tr>"
        for name, share in shown
    )
    style = f"font-size:0.85em;margin:0 1em;{layers.STALE if stale else ''}"
    text = f"<table style='{style}'><tr><th>area</th><th>share</th></tr>{cells}</table>"
    return text + (layers.note("Out of date: computing.") if stale else "")


def rounded(at: np.ndarray) -> tuple[float, float, float]:
    """A position as the panel shows it: to a thousandth of a unit."""
    x, y, z = (float(round(float(v), 3)) for v in at)
    return x, y, z


def about_picture(session: Any, window: BrowserWindow) -> Provenance:
    """What the last picture of ``window`` was made of. Raises `NergError` for files of the scene that are gone."""
    assert window.last is not None and window.view is not None
    view, shade, scale = window.view, session.shade, session.scale()
    settings = {
        "layer": shade.layer.title,
        "colors": scale.colors,
        "range": [scale.low, scale.high],
        "observer": session.observer.tolist(),
        "falloff": session.falloff,
        "camera": {"origin": view.origin.tolist(), "ahead": view.ahead.tolist(), "up": view.up.tolist()},
        "degrees": view.across,
        "samples": window.last[0].samples,
        "ceiling": session.ceiling,
    }
    return make_provenance("nerg view", list_scene_files(session.scene_file), 0, settings, session.checksums)


def png_bytes(session: Any, colors: np.ndarray, text: dict[str, str] | None = None) -> bytes:
    """The bytes of a PNG of ``colors`` (height, width, 3) uint8 with ``text`` in its header, made on the render
    thread."""

    def encode() -> bytes:
        import mitsuba as mi

        return encode_png(mi.Bitmap(np.ascontiguousarray(colors)), text)

    return session.worker.call(encode).result()


# ---- Areas ----
#
# Areas of interest in the page: boxes that are drawn, moved, named, and saved as JSON.

COLOR = (90, 200, 255)
_CHOSEN = (255, 210, 60)
_NONE = "(none)"
_LEAST = 0.05
_FEW = 8


class AreasPanel:
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
            text = format_areas(self.session.regions, self.session.other_areas).encode()
            event.client.send_file_download("areas.json", text, save_immediately=True)

        self._show_all()

    def add(self, region: Region) -> None:
        """One more area. Raises `NergError` for a name that there is already, and for too many."""
        if region.name in (r.name for r in self.session.regions):
            raise NergError(f'there is an area "{region.name}" already; give it another name')
        if len(self.session.regions) >= MAX_AREAS:
            raise NergError(f"there are {MAX_AREAS} areas already; remove one of them")
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
            proxy, view = self.session.proxy, PinholeView.of_page(client.camera)
            with telling(client, "Areas"):
                if proxy is None:
                    raise NergError("there are no points to lay a box around yet; wait a moment")
                lower, upper = box_around(proxy.points, proxy.size, view, drawn.screen_min, drawn.screen_max)
                self.add(Region.create(name, lower, upper))
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
        turn = next((r.rotation for r in self.session.regions if r.name == name), None)
        try:
            new = Region.create(name, lower, upper, turn)
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
                top = (*region.center[:2], region.bounds[1, 2])
                handles.append(scene.add_label(f"/areas/{k}_name", region.name, position=top, anchor="bottom-center"))
            self._boxes[region.name] = handles


def edges(region: Region) -> np.ndarray:
    """The twelve edges (12, 2, 3) of a box, along one axis after the other."""
    corners = region.vertices
    ends = [(k, k | 1 << axis) for axis in range(3) for k in range(8) if not k >> axis & 1]
    return corners[np.array(ends)].astype(np.float32)


def box_around(
    points: np.ndarray, margin: float, view: PinholeView, low: tuple[float, float], high: tuple[float, float]
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
