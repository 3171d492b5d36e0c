"""The state of the viewer that all browsers share: the scene, its observer, and the tasks that compute pictures."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from nerg_mi.aoi.areas import Area, Areas
from nerg_mi.aoi.attention import make_shape_aois
from nerg_mi.aoi.placed import Aoi
from nerg_mi.environment.arrays import check_point
from nerg_mi.environment.queries import trace
from nerg_mi.environment.scene import COLOR
from nerg_mi.environment.scene_loading import activate_mitsuba, get_array_module
from nerg_mi.errors import NergError, parameter, translate_mitsuba_errors
from nerg_mi.figures.layers import describe_basis
from nerg_mi.files.atomic import file_sha256, write_bytes
from nerg_mi.formats.boxes import Region
from nerg_mi.formats.fields import decode_radiance, encode_radiance, load_radiance
from nerg_mi.progress import SILENT
from nerg_mi.ranges import MAX_COORDINATE
from nerg_mi.registration import get_plugin_class
from nerg_mi.transport.extrapolation import describe_extrapolation
from nerg_mi.transport.geometry import Ceiling

from . import layers
from .compilation import BackgroundCompilation, find_compiled_file, is_current
from .frames import render_frame
from .lattice import Lattice
from .layers import DisplaySettings, Layer, Scale
from .points import (
    BAND_SECONDS,
    BAND_SIZES,
    FRAME_SIZES,
    BandPace,
    FramePace,
    PinholeView,
    PointProxy,
    Points,
    StagePicture,
    compute_point_gaze,
    find_free_position,
    gather_points,
    get_observer_forward,
    make_heading,
    pad_directions,
    refine,
)
from .shares import AttentionShare, iter_attention_shares
from .source import ViewerInputs
from .tracks import Tracks
from .worker import Worker

# ---- Listener ----


class Listener(Protocol):
    """Receives the events of a `Session`, on its render thread."""

    def on_proxy(self) -> None:
        """Called when new points are available."""
        ...

    def on_baked(self) -> None:
        """Called when new gaze values of the points are available."""
        ...

    def on_shares(self) -> None:
        """Called when new attention shares are available."""
        ...

    def on_range(self) -> None:
        """Called when the automatic range of the displayed layer has changed."""
        ...

    def on_error(self, error: BaseException) -> None:
        """Called when a task has failed."""
        ...


# ---- Session ----
#
# Mitsuba and Dr.Jit are used only on the thread of the `Worker`, which also calls the `Listener`.

FRAME_PRIORITY = 0
"""Priority of the frames of a movement."""

NORMAL_PRIORITY = 1
"""Priority of tasks that take turns, such as pictures and attention shares."""

LOW_PRIORITY = 2
"""Priority of small pictures and of drawings of the recordings."""

_TASK_NAMES = {
    "proxy": "points on surfaces",
    "picture": "picture",
    "gaze": "gaze on the points",
    "shares": "attention shares",
    "inset": "observer views",
    "people": "recordings",
}
"""Descriptions of the worker's tasks for the status text."""

_COMPILING = "faster pictures"

_MAX_SPP = 256
_MAX_SHAPES = 60


@dataclass(frozen=True)
class SessionSettings:
    """Width and samples per pixel of refined images, initial position of the observer, areas of interest, and whether
    the radiance field is compiled (`nerg_mi.viewer.serve.view`)."""

    width: int = 720
    spp: int = 0
    observer: Sequence[float] | None = None
    areas: Areas = field(default_factory=lambda: Areas(()))
    compile: bool = True


class Session:
    """A scene with its observer and display settings.

    Parameters
    ----------
    load_source : callable
        Returns the scene to view; called on the render thread.
    settings : SessionSettings
        Settings of the viewer.
    listener : Listener
        Receives events.
    """

    def __init__(self, load_source: Callable[[], ViewerInputs], settings: SessionSettings, listener: Listener):
        self.settings, self.listener = settings, listener
        self._load_source = load_source
        self.worker = Worker(listener.on_error)
        self.lock = threading.RLock()
        self.proxy: PointProxy | None = None
        self.point_values: dict[str, np.ndarray] = {}
        self.finished_observer: np.ndarray | None = None
        # The inputs of `point_values` and `shares`: observer, areas and `settings_version`.
        self._point_inputs: tuple[np.ndarray, int] | None = None
        self._share_inputs: tuple[np.ndarray, tuple[Region, ...], int] | None = None
        self.shares: dict[str, AttentionShare] = {}
        # Why the gaze of the observer is extrapolated; "" if it is not.
        self.observer_note = ""
        self.ceiling: float | None = None
        self.regions: list[Region] = []
        self.other_areas: list[Area] = []
        self.band_pace, self.frame_pace = BandPace(), FramePace()
        # Whether images of a movement are drafts.
        self.has_drafts = True
        # The view and the observer of the last frame.
        self._last_view: PinholeView | None = None
        self._last_observer: np.ndarray | None = None
        # The volume of the compiled radiance field, and the process that compiles it.
        self.compiled: Any = None
        self._compilation: BackgroundCompilation | None = None
        self.checksums: dict[Path, str] = {}
        self._ranges: dict[str, tuple[float, float]] = {}
        self._busy: set[str] = set()
        self._finished_share_inputs: tuple[np.ndarray, tuple[Region, ...], int] | None = None
        # Counts the changes of the gaze field and its settings; results of earlier versions are dropped.
        self.settings_version = 0

    def start(self) -> None:
        """Load the scene and start to sample its points.

        Raises
        ------
        NergError
            The scene cannot be displayed.
        """
        self.worker.call(self._load).result()
        self.worker.submit("proxy", NORMAL_PRIORITY, self._gather())
        if self.settings.compile:
            self.worker.call(self._start_compilation).result()

    def stop(self) -> None:
        """Stop the render thread and the compilation of the field."""
        if self._compilation is not None:
            self._compilation.stop()
        self.worker.stop()

    def _start_compilation(self) -> None:
        """Use the compiled copy of the radiance field; make it in the background if there is none."""
        volume = self.scene.integrator.children.get("field")
        if not isinstance(volume, get_plugin_class("nerf")) or volume.field.voxels is not None:
            return
        # A field in memory has no metadata.
        file = Path(volume.filename) if volume.metadata else None
        cached = None if file is None else find_compiled_file(file)
        if file is not None and cached is not None and is_current(cached, file):
            self._use_compiled(partial(load_radiance, cached))
            return
        origin = None if file is None else volume.metadata.get("refined_from") or file_sha256(file)
        provenance, half = volume.metadata.get("provenance", {}), volume.metadata.get("half", False)

        def finish(compiled: bytes) -> None:
            self._use_compiled(partial(decode_radiance, compiled))
            if cached is not None:
                write_bytes(cached, compiled)

        encoded = encode_radiance(volume.field, provenance, half, origin)
        self._compilation = BackgroundCompilation(encoded, f'"{volume.filename}"', finish, self.listener.on_error)

    def _use_compiled(self, load: Callable[[Any], tuple[Any, dict]]) -> None:
        """Render with the compiled radiance field that ``load`` returns for a backend from now on."""

        def steps() -> Iterator[None]:
            import mitsuba as mi

            volume = self.scene.integrator.children["field"]
            to_world = mi.ScalarTransform4d(volume.medium().to_world.matrix)
            self.compiled = type(volume).from_network(load(get_array_module())[0], to_world, volume.filename)
            self._load_scene(self.gaze_name)
            self._set_falloff()
            self.frame_pace = FramePace()
            yield
            yield from self._time_frames(self.home_view)

        self.worker.submit("compiled", FRAME_PRIORITY, steps())

    def _load(self) -> None:
        self.source = self._load_source()
        self.variant = activate_mitsuba().variant()
        self._load_scene(next(iter(self.source.gaze), ""))
        self.display = DisplaySettings(self._default_layer())
        sensors = self.scene.mitsuba.sensors()
        if not sensors:
            raise NergError(
                f'"{self.source.name}" has gaze, but no sensor for the initial view; add a <sensor> to the scene, or '
                "in Python a camera by make_scene"
            )
        self.home_view = PinholeView.from_sensor(sensors[0])
        self.spp = min(self.settings.spp or int(sensors[0].sampler().sample_count()), _MAX_SPP)
        observer = check_point(self.settings.observer, parameter("observer"))
        scene_observer = self.scene.observer
        if observer is None:
            observer = self._default_observer() if scene_observer is None else np.asarray(scene_observer, float)
        forward = self.home_view.forward if scene_observer is None else get_observer_forward(self.scene)
        self.place_observer(np.asarray(observer, float), make_heading(forward, self.source.up))
        self.falloff = float(np.ravel(np.array(self.scene.integrator.falloff))[0])
        ceiling = self.scene.integrator.ceiling
        self.ceiling_up, self.ceiling = (self.source.up, None) if ceiling is None else (ceiling.up, ceiling.height)
        self.tracks = None if self.source.rays is None else Tracks(self.source.rays, self.source.align)
        areas = self.settings.areas
        # Areas that are not boxes are not displayed, but are saved with the boxes.
        self.regions = areas.boxes
        self.other_areas = [area for area in areas.areas if not isinstance(area, Region)]
        shapes = [shape.id() for shape in self.scene.mitsuba.shapes() if shape.is_mesh()]
        self.shapes = [name for name in shapes if name and not name.startswith("__")][:_MAX_SHAPES]

    def _load_scene(self, gaze: str) -> None:
        """Load the scene with the gaze field of this name and the compiled radiance field, and use it from now on."""
        self.scene, self.gaze_name = self.source.load(gaze, self.compiled), gaze
        self._shape_aois: list[Aoi] | None = None
        self.layers = layers.list_layers(self.scene)
        self.basis = describe_basis(self.scene.mitsuba)

    def _default_layer(self) -> Layer:
        return next((la for la in self.layers if la.quantity in ("gaze", "kde")), self.layers[0])

    def _default_observer(self) -> np.ndarray:
        """Return an observer position for a scene without one: half way to the surface at the centre of the camera's
        view."""
        traced = trace(
            self.scene, self.home_view.origin, pad_directions(self.home_view.forward[None], BAND_SIZES[0]), ["depth"]
        )
        depth = float(traced.depth[0])
        return self.home_view.origin + (0.5 * depth if np.isfinite(depth) else 0.0) * self.home_view.forward

    # Changes of the state

    def place_observer(self, position: np.ndarray, heading: np.ndarray | None = None) -> None:
        """Move the observer.

        Parameters
        ----------
        position : ndarray of shape (3,)
            Position in scene units.
        heading : ndarray of shape (3, 3) or None
            Rotation with the columns forward, left and up. None: unchanged.

        Raises
        ------
        NergError
            The position is not finite or too far away, or the rotation is not finite.
        """
        array = np.asarray(position, float)
        is_valid = array.shape == (3,) and (np.abs(array) <= MAX_COORDINATE).all()
        if not is_valid or not (heading is None or np.isfinite(heading).all()):
            text = ", ".join(f"{v:g}" for v in array.ravel()[:3])
            raise NergError(f"invalid observer position ({text}); enter three finite numbers in scene units")
        with self.lock:
            self.observer = np.array(position, float)
            if heading is not None:
                self.heading = np.array(heading, float)

    def set_falloff(self, value: float) -> None:
        """Set the distance behind a surface over which gaze fades out, in scene units.

        Raises
        ------
        NergError
            ``value`` is negative or not finite.
        """
        if not 0 <= value < np.inf:
            raise NergError(f"the fall-off must be 0 or a positive length in scene units, got {value:g}")

        def change() -> None:
            self.falloff = float(value)
            self._set_falloff()
            self._invalidate()

        self.worker.call(change).result()

    def _set_falloff(self) -> None:
        import mitsuba as mi

        with translate_mitsuba_errors():
            params: Any = mi.traverse(self.scene.integrator)
            params["falloff"] = self.falloff
            params.update()

    def select_gaze(self, name: str) -> None:
        """Use the gaze field ``name`` of the loaded gaze fields.

        If the new field lacks the displayed layer, the gaze is displayed.

        Raises
        ------
        NergError
            The file no longer exists.
        """

        def change() -> None:
            self._load_scene(name)
            self._set_falloff()
            self._invalidate()
            with self.lock:
                self.point_values, self._ranges = {}, {}
                if self.display.layer not in self.layers:
                    self.display = DisplaySettings(self._default_layer())

        self.worker.call(change).result()

    def _invalidate(self) -> None:
        """Invalidate the gaze on the points and the attention shares."""
        with self.lock:
            self.settings_version += 1
            self.finished_observer = self._finished_share_inputs = None

    def set_display(self, **changes: Any) -> None:
        """Change the layer, the colours or the limits (fields of `DisplaySettings`)."""
        with self.lock:
            self.display = replace(self.display, **changes)

    # Results

    @property
    def stale_points_reason(self) -> str:
        """Why the points do not display the current layer, observer and settings; "" if they do."""
        # No lock here: the thread that handles a new range may hold it, and the state is polled again soon.
        layer, inputs = self.display.layer, self._point_inputs
        if not layer.quantity:
            return ""
        if layer.quantity not in self.point_values:
            return f"the points do not show {layer.title}"
        if inputs is None or not np.array_equal(inputs[0], self.observer):
            return f"{layer.title} of a previous observer position"
        return "" if inputs[1] == self.settings_version else f"{layer.title} of previous settings"

    @property
    def are_shares_stale(self) -> bool:
        """Whether the attention shares belong to another observer, other areas or other settings."""
        inputs = self._share_inputs
        return inputs is None or not _same_inputs(inputs, self._current_share_inputs())

    @property
    def has_scale(self) -> bool:
        """Whether the colour scale of the layer is known; until then it is 0 to 1."""
        display = self.display
        overlay = display.layer.overlay
        needs_no_scale = overlay is None or not overlay.needs_limits
        return needs_no_scale or display.limits is not None or display.layer.title in self._ranges

    @property
    def running_tasks(self) -> list[str]:
        """Descriptions of the running tasks."""
        names = {name[0] if isinstance(name, tuple) else name for name in self.worker.task_names}
        descriptions = _TASK_NAMES | {"gaze": f"{'gaze' if self.scene.has_gaze else 'visibility'} on the points"}
        tasks = [text for name, text in descriptions.items() if name in names]
        return [*tasks, *([_COMPILING] if self._compilation is not None and self.compiled is None else [])]

    def keep_in_free_space(
        self, name: Hashable, position: np.ndarray, free_position: np.ndarray, deliver: Callable[[np.ndarray], None]
    ) -> None:
        """Check ``position`` (3,) and call ``deliver`` with it, or with a free position if it is inside a solid.

        See `find_free_position` for ``free_position``.
        """
        self.worker.submit(("way", name), NORMAL_PRIORITY, self._find_free_position(position, free_position, deliver))

    def _current_share_inputs(self) -> tuple[np.ndarray, tuple[Region, ...], int]:
        return self.observer, tuple(self.regions), self.settings_version

    def update_points(self) -> bool:
        """Start to compute the gaze on the points if needed; return whether it is up to date."""
        with self.lock:
            observer = self.observer
            is_current = self.finished_observer is not None and np.array_equal(self.finished_observer, observer)
            if not is_current and self.proxy is not None and "gaze" not in self._busy:
                self._busy.add("gaze")
                self.worker.submit("gaze", NORMAL_PRIORITY, self._bake(observer))
            return is_current

    def update_shares(self) -> bool:
        """Start to compute the attention shares, if needed; return whether they are up to date."""
        with self.lock:
            if not self.scene.has_gaze:
                return True
            inputs = self._current_share_inputs()
            is_current = self._finished_share_inputs is not None and _same_inputs(self._finished_share_inputs, inputs)
            if not is_current and "shares" not in self._busy:
                self._busy.add("shares")
                self.worker.submit("shares", NORMAL_PRIORITY, self._compute_shares(inputs))
            return is_current

    def refine_picture(
        self,
        name: Hashable,
        view: PinholeView,
        deliver: Callable[[StagePicture, np.ndarray], None],
        width: int,
        spp: int,
        min_width: int = 0,
    ) -> None:
        """Start to refine a picture.

        Parameters
        ----------
        name : hashable
            Name of the picture; it replaces a picture of the same name.
        view : PinholeView
            The camera.
        deliver : callable
            Called with each picture and its colours (height, width, 3) uint8, on the render thread.
        width : int
            Width of the final picture in pixels.
        spp : int
            Samples per pixel of the final picture.
        min_width : int
            Pictures that are not wider are left out.
        """
        self.worker.submit(("picture", name), NORMAL_PRIORITY, self._refine_view(view, deliver, width, spp, min_width))

    def choose_lattice(self, view: PinholeView) -> Lattice | None:
        """Return the pixels of the next frame of ``view`` during a movement; None if rendering is too slow for
        frames."""
        if not self.has_drafts:
            return view.make_lattice(min(FRAME_SIZES[0][0], self.settings.width))
        is_view_kept = view is self._last_view and self.observer is not self._last_observer
        options = view, self.settings.width, is_view_kept and self.display.layer.can_keep_view
        lattice = self.frame_pace.choose_lattice(*options)
        if lattice is None and self.frame_pace.start_retry(*options):
            self.worker.submit("frame times", FRAME_PRIORITY, self._time_frames(view))
        return lattice

    def render_frame(
        self,
        name: Hashable,
        view: PinholeView,
        deliver: Callable[[StagePicture | None, np.ndarray | None], None],
        lattice: Lattice,
    ) -> None:
        """Render a frame of a movement before other tasks, and call ``deliver`` with the picture and its colours, or
        with None if it could not be rendered. ``lattice``: of `choose_lattice`; others as for `refine_picture`."""

        def steps() -> Iterator[None]:
            picture, colors = None, None
            try:
                picture, colors = self._make_frame(view, lattice, self.has_drafts)
            finally:
                deliver(picture, colors)
            yield

        self.worker.submit(("frame", name), FRAME_PRIORITY, steps())

    def _make_frame(
        self, view: PinholeView, lattice: Lattice, is_draft: bool = True
    ) -> tuple[StagePicture, np.ndarray]:
        with self.lock:
            display, observer, height = self.display, self.observer, self.ceiling
        options = {
            "ceiling": None if height is None else Ceiling(height, self.ceiling_up),
            "is_draft": is_draft,
            "is_observer_at_rest": observer is self._last_observer,
            "is_view_at_rest": view is self._last_view,
        }
        self._last_view, self._last_observer = view, observer
        return render_frame(
            self.scene, view, observer, display.layer, self.scale(), lattice, self.frame_pace, **options
        )

    def _colorize(self, layer: Layer, picture: StagePicture) -> np.ndarray:
        values = layer.select_values(picture.values)
        return layers.colorize(layer, picture.values["color"], values, picture.values["opacity"] > 0.5, self.scale())

    def refine_inset(
        self, name: Hashable, view: PinholeView, deliver: Callable[[StagePicture, np.ndarray], None], width: int
    ) -> None:
        """Start to refine a small picture with one sample per pixel, at low priority. Arguments as for
        `refine_picture`."""
        self.worker.submit(("inset", name), LOW_PRIORITY, self._refine(view, deliver, width, 1, False))

    def render_panorama(self, deliver: Callable[[np.ndarray], None], width: int) -> None:
        """Render an equirectangular picture around the observer, centred on the heading, and pass its colours to
        ``deliver``."""
        self.worker.submit(("inset", "sphere"), LOW_PRIORITY, self._render_panorama(deliver, width))

    def cancel(self, name: Hashable) -> None:
        """Stop the refinement of the picture ``name``."""
        self.worker.cancel(("picture", name))

    def scale(self) -> Scale:
        """Return the colour scale of the displayed layer."""
        display = self.display
        return layers.choose_scale(
            display.layer, display.limits or self._ranges.get(display.layer.title), display.colors
        )

    def points(self, level: int = 0) -> Points | None:
        """Return the coloured points of a level (`PointProxy.levels`) below the ceiling; None if there are no points
        yet."""
        with self.lock:
            proxy, point_values, display, ceiling = self.proxy, self.point_values, self.display, self.ceiling
        if proxy is None:
            return None
        count, size = proxy.levels[level]
        points, color = proxy.points[:count], proxy.color[:count]
        values = display.layer.select_values(point_values)
        if values is not None and len(values) == len(proxy.points):
            layer, values = display.layer, values[:count]
        else:
            layer, values = layers.get_layer(COLOR), None
        colors = layers.colorize(
            layer, color, values, np.ones(count, bool), self.scale() if values is not None else Scale()
        )
        if self.stale_points_reason:
            colors = layers.grey_out(colors)
        if ceiling is not None:
            below = points @ self.ceiling_up <= ceiling
            points, colors = points[below], colors[below]
        return Points(points, colors, size)

    def _gather(self) -> Iterator[None]:
        for proxy in gather_points(self.scene, [self.observer, self.home_view.origin]):
            if proxy is not None:
                with self.lock:
                    self.proxy, self.point_values, self.finished_observer = proxy, {}, None
                self.listener.on_proxy()
            yield None

    def _bake(self, observer: np.ndarray) -> Iterator[None]:
        try:
            proxy, version = self.proxy, self.settings_version
            assert proxy is not None
            for step, values in enumerate(compute_point_gaze(self.scene, proxy, observer)):
                with self.lock:
                    if self.proxy is not proxy or self.settings_version != version:
                        return
                    self.point_values, self._point_inputs = values, (observer, version)
                    has_moved = not np.array_equal(self.observer, observer)
                    if step == 0:
                        for name in values:
                            self._update_range(name, values, values["visibility"] > 0.5)
                self.listener.on_baked()
                if has_moved:
                    # While the observer is dragged, the first approximation is sufficient.
                    return
                yield None
            with self.lock:
                if self.settings_version == version:
                    self.finished_observer = observer
        except NergError:
            self.finished_observer = observer
            raise
        finally:
            self._busy.discard("gaze")

    def _compute_shares(self, inputs: tuple[np.ndarray, tuple[Region, ...], int]) -> Iterator[None]:
        try:
            observer, regions, version = inputs
            gaze = self.scene.integrator.gaze
            self.observer_note = describe_extrapolation(self.scene.geometry, gaze, observer)
            if self._shape_aois is None:
                self._shape_aois = make_shape_aois(self.scene, self.shapes)
            names = {*(region.name for region in regions), *self.shapes}
            shares: dict[str, AttentionShare] = {}
            for part in iter_attention_shares(self.scene, observer, regions, self.shapes, self._shape_aois):
                shares |= part
                yield None
                if version != self.settings_version:
                    return
                if shares.keys() == names:
                    # Preliminary shares of all are replaced by better ones, unless the observer has moved on.
                    with self.lock:
                        self.shares, self._share_inputs = dict(shares), inputs
                    self.listener.on_shares()
                    if not _same_inputs(inputs, self._current_share_inputs()):
                        return
            with self.lock:
                self.shares, self._finished_share_inputs, self._share_inputs = shares, inputs, inputs
            self.listener.on_shares()
        except NergError:
            # Report the error once, not at each tick of the clock.
            self._finished_share_inputs = inputs
            raise
        finally:
            self._busy.discard("shares")

    def _find_free_position(
        self, position: np.ndarray, free_position: np.ndarray, deliver: Callable[[np.ndarray], None]
    ) -> Iterator[None]:
        with self.lock:
            proxy, height = self.proxy, self.ceiling
        corrected = None
        if proxy is not None and (height is None or position @ self.ceiling_up <= height):
            corrected = find_free_position(self.scene, proxy, position, free_position)
        deliver(position if corrected is None else corrected)
        yield None

    def _refine_view(
        self,
        view: PinholeView,
        deliver: Callable[[StagePicture, np.ndarray], None],
        width: int,
        spp: int,
        min_width: int,
    ) -> Iterator[None]:
        """Refine the picture of a browser, beginning with one of the full width if that is fast."""
        if self.has_scale and self.frame_pace.estimate(width * view.picture_height(width)) <= BAND_SECONDS:
            deliver(*self._make_frame(view, view.make_lattice(width), is_draft=False))
            min_width = width
            yield None
        yield from self._refine(view, deliver, width, spp, min_width=min_width)
        yield from self._time_frames(view)

    def _time_frames(self, view: PinholeView) -> Iterator[None]:
        """Compile the kernels of frames, and measure the time of their rays, unless they are known to be fast."""
        if self.choose_lattice(view) is None:
            width, pixels_per_ray = FRAME_SIZES[-1]
            for _ in range(3):
                self._make_frame(view, view.make_lattice(min(width, self.settings.width), pixels_per_ray))
                yield None

    def _refine(
        self,
        view: PinholeView,
        deliver: Callable[[StagePicture, np.ndarray], None],
        width: int,
        spp: int,
        sets_range: bool = True,
        min_width: int = 0,
    ) -> Iterator[None]:
        """Refine a picture; ``sets_range``: whether it sets the automatic range."""
        with self.lock:
            display, observer, height = self.display, self.observer, self.ceiling
        ceiling = None if height is None else Ceiling(height, self.ceiling_up)
        layer, quantities = display.layer, layers.required_quantities(display.layer)
        settings = {"ceiling": ceiling, "min_width": min_width}
        for picture in refine(self.scene, view, observer, quantities, width, spp, self.band_pace, **settings):
            if picture is not None:
                mask = picture.values["opacity"] > 0.5
                values = layer.select_values(picture.values)
                if sets_range and values is not None and layer.quantity not in self.point_values:
                    with self.lock:
                        self._update_range(layer.quantity, picture.values, mask)
                deliver(picture, self._colorize(layer, picture))
            yield None

    def _render_panorama(self, deliver: Callable[[np.ndarray], None], width: int) -> Iterator[None]:
        with self.lock:
            observer, heading, layer = self.observer, self.heading, self.display.layer
        height = width // 2
        longitude = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
        latitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
        longitude, latitude = np.meshgrid(longitude, latitude)
        local = np.stack(
            [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
        )
        directions = local.reshape(-1, 3) @ heading.T
        quantities = layers.required_quantities(layer)
        traced = trace(
            self.scene,
            observer,
            pad_directions(directions, self.band_pace.num_rays),
            quantities,
            observers=observer[None],
            progress=SILENT,
        )
        count = len(directions)
        values = {k: np.asarray(traced[k][0])[:count].reshape(height, width, *traced[k].shape[2:]) for k in quantities}
        yield None
        mask = values["opacity"] > 0.5
        deliver(layers.colorize(layer, values["color"], layer.select_values(values), mask, self.scale()))

    def _update_range(self, quantity: str, by_quantity: Mapping[str, np.ndarray], mask: np.ndarray) -> None:
        """Set the automatic range of the layers of ``quantity`` from its values."""
        for layer in self.layers:
            values = layer.select_values(by_quantity)
            if layer.quantity == quantity and values is not None:
                limits = layers.choose_range(layer, values, mask)
                if limits is None:
                    self._ranges.setdefault(layer.title, (0.0, 1.0))
                elif limits != self._ranges.get(layer.title):
                    self._ranges[layer.title] = limits
                    if layer == self.display.layer and self.display.limits is None:
                        self.listener.on_range()


def _same_inputs(one: tuple, other: tuple) -> bool:
    return np.array_equal(one[0], other[0]) and one[1:] == other[1:]
