"""The panel: what is shown and how, the observer's own view, the numbers, and the camera."""

from __future__ import annotations

import math
import threading
import time
from html import escape
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sentence
from nerg_mi.figures.style import Provenance, provenance
from nerg_mi.files.png import encode_png
from nerg_mi.rendering.scene_file import files_of_scene

from . import layers
from .copied_scene import copied_view
from .layers import Scale
from .page import Page, Window
from .view import View, heading_of

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
        self._legend = gui.add_html(layers.legend(session.shade.layer, session.scale(), self.page.stale))
        basis = gui.add_html(basis_note(session))
        colors = gui.add_dropdown("Colours", (_USUAL, *layers.MAPS), initial_value=_USUAL)
        automatic = gui.add_checkbox("Automatic range", True)
        ends = gui.add_vector2("Range", (0.0, 1.0), step=0.01, disabled=True)
        # As Mitsuba has it, in single precision, it would be written with all its digits.
        top = 10.0 ** math.ceil(math.log10(3 * session.falloff)) if session.falloff > 0 else 1.0
        falloff = gui.add_slider("Fall-off", 0.0, top, 0.01 * top, float(f"{session.falloff:.4g}"))

        def change(event: Any) -> None:
            if event.client is None:
                # Written by the program, which has set all else.
                return
            fixed = None
            chosen = layers.LAYERS[layer.value]
            if chosen.quantity != session.shade.layer.quantity and not automatic.value:
                # A range in 1/sr says nothing of metres.
                automatic.value = True
            ends.disabled = automatic.value
            if automatic.value:
                scale = session.scale()
            elif event.target is automatic:
                scale = session.scale()
                ends.value = (float(f"{scale.low:.3g}"), float(f"{scale.high:.3g}"))
                fixed = ends.value
            else:
                fixed = ends.value
            if fixed is not None:
                try:
                    Scale(fixed[0], fixed[1])
                except NergError as error:
                    tell(event, "Range", sentence(error))
                    return
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
                tell(event, "Gaze field", sentence(error))
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
            try:
                session.set_falloff(falloff.value)
            except NergError as error:
                tell(event, "Fall-off", sentence(error))
                return
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
                    tell(event, "Observer", sentence(error))
                    self._at.value = rounded(session.observer)

        @to_camera.on_click
        def _(event: Any) -> None:
            view = View.of_page(event.client.camera)
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
            self._legend.content = layers.legend(session.shade.layer, session.scale(), self.page.stale)
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
        view = View.of(session.observer, session.observer + ahead, up, np.radians(60), 1.5)
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
            try:
                about = about_picture(session, window)
            except NergError as error:
                tell(event, "Picture", sentence(error))
                return
            data = png_bytes(session, window.last[1], about.text())
            event.client.send_file_download("view.png", data, save_immediately=True)

        @copy.on_click
        def _(event: Any) -> None:
            window = self._window(event)
            if window is None or window.view is None:
                return
            try:
                text = copied_view(session, window.view)
            except NergError as error:
                tell(event, "Scene", sentence(error))
                return
            event.client.send_file_download("view.xml", text.encode(), save_immediately=True)

    def _window(self, event: Any) -> Window | None:
        return None if event.client is None else self.page.windows.get(event.client.client_id)

    def _heights(self) -> tuple[float, float]:
        """Lowest and highest of the points along up."""
        proxy = self.session.proxy
        if proxy is None:
            return 0.0, 1.0
        along = proxy.points @ self.session.cut_up
        return float(np.percentile(along, 0.5)), float(np.percentile(along, 99.5))


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


def about_picture(session: Any, window: Window) -> Provenance:
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
    return provenance("nerg view", files_of_scene(session.scene_file), 0, settings, session.checksums)


def png_bytes(session: Any, colors: np.ndarray, text: dict[str, str] | None = None) -> bytes:
    """The bytes of a PNG of ``colors`` (height, width, 3) uint8 with ``text`` in its header, made on the render
    thread."""

    def encode() -> bytes:
        import mitsuba as mi

        return encode_png(mi.Bitmap(np.ascontiguousarray(colors)), text)

    return session.worker.call(encode).result()
