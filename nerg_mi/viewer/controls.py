"""The panel of the viewer: display settings, observer, attention, camera, and areas of interest."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np

from nerg_mi.aoi.areas import format_areas
from nerg_mi.errors import NergError, clean_text, format_error
from nerg_mi.figures.style import Provenance, make_provenance
from nerg_mi.files.images import encode_png
from nerg_mi.formats.boxes import MAX_AREAS, Region

from . import layers
from .layers import Scale
from .page import BrowserWindow, Page
from .points import PinholeView, make_heading
from .scene import copy_view
from .shares import AttentionShare

# ---- Panel ----

INSET_WIDTH = 240
"""Width of the observer's views in the panel, in pixels."""

_MAX_ROWS = 12
_DEFAULT_COLORS = "default"
_INSET_INTERVAL = 0.4


def notify(event_or_client: Any, title: str, text: str) -> None:
    """Show a notification in the browser of a client or event."""
    client = getattr(event_or_client, "client", event_or_client)
    if client is not None:
        client.add_notification(title=title, body=clean_text(text), with_close_button=True, auto_close_seconds=12.0)


@contextmanager
def notify_errors(event_or_client: Any, title: str) -> Iterator[None]:
    """Show a `NergError` raised within the block as a notification."""
    try:
        yield
    except NergError as error:
        notify(event_or_client, title, format_error(error))


class Inset:
    """A small picture in the panel, which is grey while a new one is rendered.

    Parameters
    ----------
    gui : viser.GuiApi
        The panel.
    title : str
        Title of the picture.
    height : int
        Height in pixels; the width is `INSET_WIDTH`.
    """

    def __init__(self, gui: Any, title: str, height: int):
        self._title, self._colors = title, np.zeros((height, INSET_WIDTH, 3), np.uint8)
        self._handle = gui.add_image(self._colors, label=title)
        self._stale = False
        self.mark_stale()

    def mark_stale(self) -> None:
        """Mark the picture as outdated."""
        if not self._stale:
            self._stale = True
            self._handle.image = layers.grey_out(self._colors)
            self._handle.label = f"{self._title} (grey: outdated)"

    def show(self, colors: np.ndarray) -> None:
        """Show ``colors`` (height, width, 3) uint8."""
        self._stale, self._colors = False, colors
        self._handle.image = colors
        self._handle.label = self._title


def slider_max(value: float) -> float:
    """Return the maximum of a slider for ``value``: a power of ten, at least three times as large."""
    return 10.0 ** math.ceil(math.log10(3 * value)) if value > 0 else 1.0


class Controls:
    """The panel of a `Page`."""

    def __init__(self, page: Page):
        self.page, self.session, self.gui = page, page.session, page.server.gui
        self._last_inset_time, self._is_inset_scheduled = 0.0, False
        self._inset_inputs: tuple[Any, ...] = ()
        self._lock, self._legend_lock = threading.Lock(), threading.Lock()
        with self.gui.add_folder("Display"):
            self._build_display()
        with self.gui.add_folder("Observer"):
            self._build_observer()
        if self.session.scene.has_gaze:
            with self.gui.add_folder("Attention"):
                self._table = self.gui.add_html("")
        with self.gui.add_folder("Camera", expand_by_default=False):
            self._build_camera()
        page.update_callbacks.append(self.refresh)
        page.scale_callbacks.append(self.refresh)

    # Display settings

    def _build_display(self) -> None:
        session, gui = self.session, self.gui
        names = list(session.source.gaze)
        variant = gui.add_dropdown("Gaze field", names, initial_value=session.gaze_name) if len(names) > 1 else None
        titles = [layer.title for layer in session.layers]
        layer = gui.add_dropdown("Layer", titles, initial_value=session.display.layer.title)
        self._legend = gui.add_html(
            layers.format_legend(session.display.layer, session.scale(), self.page.stale_scale_reason)
        )
        basis = gui.add_html(format_basis(session))
        colors = gui.add_dropdown("Colours", _colormap_names(session.display.layer), initial_value=_DEFAULT_COLORS)
        automatic = gui.add_checkbox("Automatic range", True)
        range_input = gui.add_vector2("Range", (0.0, 1.0), step=0.01, disabled=True)
        # Rounded, since Mitsuba's single precision would show all its digits.
        max_falloff = slider_max(session.falloff)
        falloff = gui.add_slider("Fall-off", 0.0, max_falloff, 0.01 * max_falloff, float(f"{session.falloff:.4g}"))
        drafts = gui.add_checkbox("Drafts while moving", session.has_drafts)

        def change(event: Any) -> None:
            if event.client is None:
                # Changed by the program, not by the user.
                return
            selected = next(la for la in session.layers if la.title == layer.value)
            if tuple(colors.options) != _colormap_names(selected):
                colors.options = _colormap_names(selected)
            if selected != session.display.layer and not automatic.value:
                # The range of the previous layer has another unit.
                automatic.value = True
            range_input.disabled = automatic.value
            if event.target is automatic and not automatic.value:
                scale = session.scale()
                range_input.value = (float(f"{scale.low:.3g}"), float(f"{scale.high:.3g}"))
            limits = None if automatic.value else range_input.value
            with notify_errors(event, "Range"):
                if limits is not None:
                    Scale(limits[0], limits[1])
                session.set_display(
                    layer=selected, colors=None if colors.value == _DEFAULT_COLORS else colors.value, limits=limits
                )
                self._update_display()

        for handle in (layer, colors, automatic, range_input):
            handle.on_update(change)

        def change_gaze(event: Any) -> None:
            if event.client is None:
                return
            try:
                session.select_gaze(event.target.value)
            except NergError as error:
                notify(event, "Gaze field", format_error(error))
                event.target.value = session.gaze_name
                return
            layer.options = tuple(la.title for la in session.layers)
            layer.value = session.display.layer.title
            basis.content = format_basis(session)
            self.page.request_points()
            self._update_display()

        if variant is not None:
            variant.on_update(change_gaze)

        @drafts.on_update
        def _(event: Any) -> None:
            session.has_drafts = drafts.value

        @falloff.on_update
        def _(event: Any) -> None:
            with notify_errors(event, "Fall-off"):
                session.set_falloff(falloff.value)
                self.page.request_points()
                self._update_display()

    def _update_display(self) -> None:
        self.page.redraw_points()
        self.page.restart_pictures()
        self.refresh()

    # The observer

    def _build_observer(self) -> None:
        session, gui = self.session, self.gui
        self._position = gui.add_vector3("Position", round_position(session.observer), step=0.05)
        to_camera = gui.add_button("Move observer to camera")
        to_observer = gui.add_button("Move camera to observer")
        self._own_view, self._panorama = (
            Inset(gui, "Observer view", INSET_WIDTH * 2 // 3),
            Inset(gui, "Panorama", INSET_WIDTH // 2),
        )

        @self._position.on_update
        def _(event: Any) -> None:
            if event.client is not None and not np.allclose(self._position.value, session.observer, atol=1e-3):
                try:
                    self.page.place_observer(np.array(self._position.value))
                except NergError as error:
                    notify(event, "Observer", format_error(error))
                    self._position.value = round_position(session.observer)

        @to_camera.on_click
        def _(event: Any) -> None:
            view = PinholeView.from_page(event.client.camera)
            self.page.place_observer(view.origin, make_heading(view.forward, session.source.up))

        @to_observer.on_click
        def _(event: Any) -> None:
            set_camera(event.client, session.observer, session.observer + 2 * session.heading[:, 0], session.source.up)

    def refresh(self) -> None:
        """Update numbers, legend and insets; the insets at most once per `_INSET_INTERVAL`."""
        session = self.session
        self._update_legend()
        position = round_position(session.observer)
        if not np.allclose(self._position.value, position, atol=1e-3):
            self._position.value = position
        with self._lock:
            if self._get_inset_inputs() == self._inset_inputs:
                return
            self._own_view.mark_stale()
            self._panorama.mark_stale()
            if time.monotonic() - self._last_inset_time < _INSET_INTERVAL:
                if not self._is_inset_scheduled:
                    self._is_inset_scheduled = True
                    timer = threading.Timer(_INSET_INTERVAL, self._run_scheduled_insets)
                    timer.daemon = True
                    timer.start()
                return
            self._last_inset_time = time.monotonic()
        self._start_insets()

    def _update_legend(self) -> None:
        # Several threads call this; without the lock, an older state could overwrite a newer one.
        with self._legend_lock:
            session = self.session
            self._legend.content = layers.format_legend(
                session.display.layer, session.scale(), self.page.stale_scale_reason
            )
            if session.scene.has_gaze:
                table = format_shares(session.shares, session.are_shares_stale)
                self._table.content = table + (
                    layers.format_note(session.observer_note) if session.observer_note else ""
                )

    def _get_inset_inputs(self) -> tuple[Any, ...]:
        """Return everything the insets depend on."""
        session = self.session
        at = session.observer.tolist(), session.heading.tolist()
        return *at, session.display, session.scale(), session.settings_version, session.ceiling

    def _run_scheduled_insets(self) -> None:
        with self._lock:
            self._is_inset_scheduled, self._last_inset_time = False, time.monotonic()
        self._start_insets()

    def _start_insets(self) -> None:
        session = self.session
        inputs = self._inset_inputs = self._get_inset_inputs()

        def show_own_view(picture: Any, colors: np.ndarray) -> None:
            if picture.is_final and inputs == self._get_inset_inputs():
                self._own_view.show(colors)

        def show_panorama(colors: np.ndarray) -> None:
            if inputs == self._get_inset_inputs():
                self._panorama.show(colors)

        forward, up = session.heading[:, 0], session.heading[:, 2]
        view = PinholeView.look_at(session.observer, session.observer + forward, up, np.radians(60), 1.5)
        session.refine_inset("own", view, show_own_view, INSET_WIDTH)
        session.render_panorama(show_panorama, INSET_WIDTH)

    # The camera

    def _build_camera(self) -> None:
        session, gui, place = self.session, self.gui, self.session.source
        home = gui.add_button("Initial view")
        above = gui.add_button("View from above")
        cut = gui.add_checkbox("Hide the ceiling", session.ceiling is not None)
        height = gui.add_slider("Ceiling height", 0.0, 1.0, 0.01, 0.8)
        shot = gui.add_button("Save picture (PNG)")
        copy = gui.add_button("Save scene (XML)")

        @home.on_click
        def _(event: Any) -> None:
            view = session.home_view
            set_camera(event.client, view.origin, view.origin + 3 * view.forward, place.up)

        def change_cut(event: Any) -> None:
            lower, upper = self._height_range()
            session.ceiling = lower + height.value * (upper - lower) if cut.value else None
            self._update_display()

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
            # A view straight down has no up direction; a small tilt keeps the orientation of the picture.
            side = session.heading[:, 0] * 0.02 * size
            set_camera(event.client, middle + 0.95 * size * place.up - side, middle, place.up)

        @shot.on_click
        def _(event: Any) -> None:
            window = self._find_window(event)
            if window is None or window.last_picture is None:
                notify(event, "Picture", "There is no picture yet. Wait until the view has been rendered.")
                return
            with notify_errors(event, "Picture"):
                data = encode_picture(session, window.last_picture[1], picture_provenance(session, window).text())
                event.client.send_file_download("view.png", data, save_immediately=True)

        @copy.on_click
        def _(event: Any) -> None:
            window = self._find_window(event)
            if window is None or window.view is None:
                return
            with notify_errors(event, "Scene"):
                text = copy_view(session, window.view)
                event.client.send_file_download("view.xml", text.encode(), save_immediately=True)

    def _find_window(self, event: Any) -> BrowserWindow | None:
        return None if event.client is None else self.page.windows.get(event.client.client_id)

    def _height_range(self) -> tuple[float, float]:
        """Return the lowest and highest coordinate of the points along the up direction, without outliers."""
        proxy = self.session.proxy
        if proxy is None:
            return 0.0, 1.0
        along = proxy.points @ self.session.ceiling_up
        return float(np.percentile(along, 0.5)), float(np.percentile(along, 99.5))


def _colormap_names(layer: layers.Layer) -> tuple[str, ...]:
    return _DEFAULT_COLORS, *layers.COLORMAPS[layers.colormap_kind(layer)]


def format_basis(session: Any) -> str:
    """Format the number of gaze samples and participants behind the gaze as HTML; "" if unknown."""
    return layers.format_note(f"gaze {session.basis}") if session.basis else ""


def set_camera(client: Any, origin: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    """Set the camera of one browser."""
    if client is None:
        return
    with client.atomic():
        client.camera.up_direction = tuple(up)
        client.camera.position = tuple(origin)
        client.camera.look_at = tuple(target)


def format_shares(shares: Mapping[str, AttentionShare], stale: bool = False) -> str:
    """Format attention shares and their errors as an HTML table, largest first.

    Shares whose error exceeds the accuracy of the viewer are pale and marked; ``stale``: whether all are outdated.
    """
    if not shares:
        return layers.format_note("Computing." if stale else "Add areas of interest to see their attention shares.")
    rows = sorted(shares.items(), key=lambda item: -item[1].share)
    entries, remainder = rows[:_MAX_ROWS], [value for _, value in rows[_MAX_ROWS:]]
    if remainder:
        total = AttentionShare(sum(v.share for v in remainder), sum(v.error for v in remainder))
        entries.append((f"{len(remainder)} more", total))
    are_final = [*(value.is_final for _, value in rows[:_MAX_ROWS]), all(v.is_final for v in remainder)]
    preliminary = f" style='{layers.STALE_STYLE}'"
    cells = "".join(
        f"<tr{'' if is_final else preliminary}><td>{escape(name)}</td>"
        f"<td style='text-align:right'>{100 * value.share:.1f} % ± {100 * value.error:.1f}</td></tr>"
        for (name, value), is_final in zip(entries, are_final)
    )
    style = f"font-size:0.85em;margin:0 1em;{layers.STALE_STYLE if stale else ''}"
    text = f"<table style='{style}'><tr><th>area of interest</th><th>attention share</th></tr>{cells}</table>"
    if stale:
        return text + layers.format_note("Outdated: computing.")
    return text if all(are_final) else text + layers.format_note("Preliminary where pale.")


def round_position(position: np.ndarray) -> tuple[float, float, float]:
    """Round a position to three decimals for the panel."""
    x, y, z = (float(round(float(v), 3)) for v in position)
    return x, y, z


def picture_provenance(session: Any, window: BrowserWindow) -> Provenance:
    """Describe how the last picture of ``window`` was made.

    Raises
    ------
    NergError
        A file of the scene no longer exists.
    """
    assert window.last_picture is not None and window.view is not None
    view, display, scale = window.view, session.display, session.scale()
    settings = {
        "layer": display.layer.title,
        "colors": scale.colors,
        "range": [scale.low, scale.high],
        "observer": session.observer.tolist(),
        "falloff": session.falloff,
        "camera": {"origin": view.origin.tolist(), "ahead": view.forward.tolist(), "up": view.up.tolist()},
        "degrees": view.fov_x_degrees,
        "samples": window.last_picture[0].samples,
        "ceiling": session.ceiling,
    }
    return make_provenance("nerg view", session.source.list_files(session.gaze_name), 0, settings, session.checksums)


def encode_picture(session: Any, colors: np.ndarray, text: dict[str, str] | None = None) -> bytes:
    """Encode ``colors`` (height, width, 3) uint8 as PNG, with ``text`` in its header, on the render thread."""

    def encode() -> bytes:
        import mitsuba as mi

        return encode_png(mi.Bitmap(np.ascontiguousarray(colors)), text)

    return session.worker.call(encode).result()


# ---- Areas of interest ----

AREA_COLOR = (90, 200, 255)
_SELECTED_COLOR = (255, 210, 60)
_NONE = "(none)"
_MIN_SIZE = 0.05
_MAX_LABELS = 8


class AreasPanel:
    """The folder of the panel for areas of interest, and their boxes in the view."""

    def __init__(self, page: Page):
        self.page, self.session = page, page.session
        self._boxes: dict[str, list[Any]] = {}
        self._gizmo: Any = None
        gui = page.server.gui
        with gui.add_folder("Areas of interest", expand_by_default=False):
            self._name = gui.add_text("Name", "area 1")
            draw = gui.add_button("Draw box in view")
            self._selected = gui.add_dropdown("Selected area", self._dropdown_options(), initial_value=_NONE)
            self._size = gui.add_vector3("Size", (1.0, 1.0, 1.0), min=(_MIN_SIZE,) * 3, step=0.05)
            remove = gui.add_button("Remove area")
            self._visible = gui.add_checkbox("Show boxes", len(self.session.regions) <= _MAX_LABELS)
            save = gui.add_button("Save areas (JSON)")
        draw.on_click(self._start_drawing)
        remove.on_click(self._remove)
        self._selected.on_update(lambda event: self._update_selection())
        self._size.on_update(self._resize)
        self._visible.on_update(lambda event: self._draw_boxes())

        @save.on_click
        def _(event: Any) -> None:
            with notify_errors(event.client, "Areas"):
                areas = [*self.session.regions, *self.session.other_areas]
                text = format_areas(areas, self.session.settings.areas.folder).encode()
                event.client.send_file_download("areas.json", text, save_immediately=True)

        self._draw_boxes()

    def add(self, region: Region) -> None:
        """Add an area of interest.

        Raises
        ------
        NergError
            An area of this name exists, or there are too many areas.
        """
        if region.name in (r.name for r in self.session.regions):
            raise NergError(f'an area named "{region.name}" already exists; choose another name')
        if len(self.session.regions) >= MAX_AREAS:
            raise NergError(f"the maximum of {MAX_AREAS} areas is reached; remove an area first")
        self.session.regions = [*self.session.regions, region]
        self._on_regions_changed(region.name)

    def _start_drawing(self, event: Any) -> None:
        client, name = event.client, self._name.value
        if client is None:
            return
        scene = client.scene

        @scene.on_rect_select()
        def _(drawn: Any) -> None:
            scene.remove_rect_select_callback()
            proxy, view = self.session.proxy, PinholeView.from_page(client.camera)
            with notify_errors(client, "Areas"):
                if proxy is None:
                    raise NergError("the points are not loaded yet; try again in a moment")
                lower, upper = fit_box(proxy.points, proxy.size, view, drawn.screen_min, drawn.screen_max)
                self.add(Region.create(name, lower, upper))
                self._name.value = f"area {len(self.session.regions) + 1}"

        # Messages arrive in order: once this is visible, dragging draws and does not rotate the camera.
        notify(client, "Areas", "Draw a rectangle around an object. A box is fitted to the points inside it.")

    def _remove(self, event: Any) -> None:
        self.session.regions = [r for r in self.session.regions if r.name != self._selected.value]
        self._on_regions_changed(_NONE)

    def _dropdown_options(self) -> list[str]:
        return [_NONE, *(region.name for region in self.session.regions)]

    def _on_regions_changed(self, selected: str) -> None:
        self._selected.options = self._dropdown_options()
        self._selected.value = selected
        self._update_selection()
        self.page.request_shares()

    def _update_selection(self) -> None:
        """Attach the gizmo to the selected area."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        region = next((r for r in self.session.regions if r.name == self._selected.value), None)
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
                self._update_selected(np.asarray(self._gizmo.position), np.asarray(self._size.value))

        self._draw_boxes()

    def _resize(self, event: Any) -> None:
        if self._gizmo is not None and event.client is not None:
            self._update_selected(np.asarray(self._gizmo.position), np.asarray(self._size.value))

    def _update_selected(self, center: np.ndarray, size: np.ndarray) -> None:
        name = self._selected.value
        lower, upper = center - size / 2, center + size / 2
        turn = next((r.rotation for r in self.session.regions if r.name == name), None)
        try:
            new = Region.create(name, lower, upper, turn)
        except NergError:
            # An invalid box: move the gizmo back to the area.
            self._update_selection()
            return
        self.session.regions = [new if r.name == name else r for r in self.session.regions]
        self._draw_boxes()
        self.page.request_shares()

    def _draw_boxes(self) -> None:
        for handles in self._boxes.values():
            for handle in handles:
                handle.remove()
        self._boxes = {}
        if not self._visible.value:
            return
        scene = self.page.server.scene
        for k, region in enumerate(self.session.regions):
            is_selected = region.name == self._selected.value
            color = _SELECTED_COLOR if is_selected else AREA_COLOR
            box = scene.add_line_segments(
                f"/areas/{k}", box_edges(region), np.array(color, np.uint8), thickness=2.0, thickness_units="screen"
            )
            handles = [box]
            if is_selected or len(self.session.regions) <= _MAX_LABELS:
                top = (*region.center[:2], region.bounds[1, 2])
                handles.append(scene.add_label(f"/areas/{k}_name", region.name, position=top, anchor="bottom-center"))
            self._boxes[region.name] = handles


def box_edges(region: Region) -> np.ndarray:
    """Return the twelve edges (12, 2, 3) of a box, grouped by axis."""
    corners = region.vertices
    vertex_pairs = [(k, k | 1 << axis) for axis in range(3) for k in range(8) if not k >> axis & 1]
    return corners[np.array(vertex_pairs)].astype(np.float32)


def fit_box(
    points: np.ndarray, margin: float, view: PinholeView, low: tuple[float, float], high: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a box to the points within a rectangle of a view.

    Points count if they are not farther behind the nearest surface than the rectangle is wide there.

    Parameters
    ----------
    points : ndarray of shape (N, 3)
        Positions in scene units.
    margin : float
        Distance to add on each side, in scene units.
    view : PinholeView
        The camera.
    low, high : tuple of float
        Upper left and lower right corner of the rectangle, from 0 to 1 over the picture.

    Returns
    -------
    tuple of ndarray of shape (3,)
        Lower and upper corner of the box.

    Raises
    ------
    NergError
        The rectangle contains too few points.
    """
    offsets = np.asarray(points, float) - view.origin
    depth = offsets @ view.forward
    right = np.cross(view.forward, view.up)
    tan_half_fov = np.tan(view.fov / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = 0.5 + (offsets @ right) / (depth * tan_half_fov * view.aspect) / 2
        y = 0.5 - (offsets @ view.up) / (depth * tan_half_fov) / 2
    inside = (depth > 1e-3) & (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    if inside.sum() < 8:
        raise NergError("the rectangle contains no points; draw it around an object")
    nearest_depth = float(np.percentile(depth[inside], 5))
    max_thickness = 2 * nearest_depth * tan_half_fov * max((high[0] - low[0]) * view.aspect, high[1] - low[1])
    nearest = np.asarray(points, float)[inside & (depth <= nearest_depth + max_thickness)]
    return np.percentile(nearest, 1, axis=0) - margin, np.percentile(nearest, 99, axis=0) + margin
