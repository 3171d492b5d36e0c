"""Scene files of what the viewer displays, and the panel of the participants."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import matplotlib
import numpy as np

from nerg_mi.environment.nested_scene import SceneDocument, to_verbatim
from nerg_mi.environment.queries import trace
from nerg_mi.environment.scene_writer import Comment, element, format_document, format_numbers, prop

from . import layers
from .page import Page
from .points import PinholeView, make_heading
from .session import LOW_PRIORITY
from .tracks import ALL_PARTICIPANTS, MAX_RAYS, Tracks

# ---- Scene files of a view ----

CAMERA_DEFAULT, TARGET_DEFAULT, OBSERVER_DEFAULT = "view_camera", "view_target", "view_observer"
"""Names of the `<default>`s of a copied scene."""

CLIP_DISTANCES = {"near_clip": 1e-6, "far_clip": 1e12}
"""Clip distances of the copied camera, which are wide because rays of the viewer are not clipped."""

SENSOR_ID = "view"
"""The id of the copied camera."""


@dataclass(frozen=True, eq=False)
class ViewSettings:
    """What a page displays.

    Parameters
    ----------
    view : PinholeView
        The camera.
    observer : ndarray of shape (3,) or None
        Position of the observer in scene units. None: the camera is the observer.
    aovs : tuple of str
        AOVs to compute.
    width : int
        Width of the picture in pixels.
    spp : int
        Samples per pixel.
    falloff : float
        Fall-off of the integrator, in scene units.
    ceiling : tuple of (float, ndarray of shape (3,)) or None
        Height of the hidden ceiling in scene units, and the up direction.
    """

    view: PinholeView
    observer: np.ndarray | None
    aovs: tuple[str, ...]
    width: int
    spp: int
    falloff: float
    ceiling: tuple[float, np.ndarray] | None = None


def copy_scene(document: SceneDocument, settings: ViewSettings) -> str:
    """Copy a scene file with another camera, observer and settings.

    Parameters
    ----------
    document : SceneDocument
        Scene file.
    settings : ViewSettings
        Camera, observer and settings of the copy.

    Returns
    -------
    str
        The text of the copy. It contains absolute paths, so that it can be saved anywhere.

    Raises
    ------
    NergError
        The file does not contain exactly one integrator.
    """
    observer_defaults = (
        []
        if settings.observer is None
        else [element("default", name=OBSERVER_DEFAULT, value=format_numbers(settings.observer))]
    )
    # If the scene is itself such a copy, these elements are replaced.
    replaced = {("sensor", SENSOR_ID), ("default", CAMERA_DEFAULT), ("default", TARGET_DEFAULT)} | {
        ("default", OBSERVER_DEFAULT) for _ in observer_defaults
    }
    key = lambda child: (child.tag, child.get("id" if child.tag == "sensor" else "name"))
    elements = [child for child in document.elements if key(child) not in replaced]
    copy = dataclasses.replace(document, elements=deepcopy(elements))
    _update_integrator(copy.find_integrator(), settings)
    nodes = [
        element("default", name=CAMERA_DEFAULT, value=format_numbers(settings.view.origin)),
        element("default", name=TARGET_DEFAULT, value=format_numbers(settings.view.target)),
        *observer_defaults,
        _make_sensor(settings),
        Comment("The rest is copied from the original scene. Its sensors come after the sensor above."),
        *map(to_verbatim, copy.elements),
    ]
    return format_document(nodes, f"A view of {document.name}, saved by nerg view.", document.version)


def _update_integrator(integrator: Element, settings: ViewSettings) -> None:
    """Set observer, fall-off, ceiling and AOVs of the ``integrator``."""
    names = {"falloff", "aovs", "ceiling", "up"} | ({"observer"} if settings.observer is not None else set())
    for child in [c for c in integrator if c.get("name") in names]:
        integrator.remove(child)
    if settings.observer is not None:
        sensor = SubElement(integrator, "sensor", name="observer", type="perspective")
        SubElement(SubElement(sensor, "transform", name="to_world"), "translate", value=f"${OBSERVER_DEFAULT}")
    SubElement(integrator, "float", name="falloff", value=f"{settings.falloff:.9g}")
    if settings.ceiling is not None:
        height, up = settings.ceiling
        SubElement(integrator, "float", name="ceiling", value=f"{height:.9g}")
        SubElement(integrator, "vector", name="up", value=format_numbers(up))
    SubElement(integrator, "string", name="aovs", value=",".join(settings.aovs))


def _make_sensor(settings: ViewSettings):
    view = settings.view
    up = format_numbers(view.up)
    film = element(
        "film",
        prop("integer", "width", settings.width),
        prop("integer", "height", view.picture_height(settings.width)),
        element("rfilter", type="box"),
        prop("string", "component_format", "float32"),
        prop("string", "pixel_format", "rgb"),
        type="hdrfilm",
    )
    # From the exact aspect ratio; the height in pixels is rounded.
    fov_x = math.degrees(2 * math.atan(math.tan(view.fov / 2) * view.aspect))
    look = element("lookat", origin=f"${CAMERA_DEFAULT}", target=f"${TARGET_DEFAULT}", up=up)
    return element(
        "sensor",
        prop("float", "fov", f"{fov_x:.9g}"),
        prop("string", "fov_axis", "x"),
        *(prop("float", name, f"{distance:g}") for name, distance in CLIP_DISTANCES.items()),
        element("transform", look, name="to_world"),
        element("sampler", prop("integer", "sample_count", settings.spp), type="independent"),
        film,
        type="perspective",
        id=SENSOR_ID,
    )


def copy_view(session: Any, view: PinholeView) -> str:
    """Return a scene file of ``view`` with the observer, the layer and the settings of ``session``.

    Raises `NergError` if the scene shows objects in memory.
    """
    aovs = tuple(name for name in layers.required_quantities(session.display.layer) if name != "color")
    ceiling = None if session.ceiling is None else (session.ceiling, session.ceiling_up)
    settings = session.settings.width, session.spp, session.falloff, ceiling
    return copy_scene(session.source.describe(session.gaze_name), ViewSettings(view, session.observer, aovs, *settings))


# ---- Participants ----

NO_PARTICIPANT = "(none)"
_SLIDER_STEPS = 2000
_MISS_LENGTH = 1.0  # length of a ray that meets no surface, in scene units


class ParticipantsPanel:
    """The folder of the panel for recordings: paths, gaze rays, probes and poses of the participants."""

    def __init__(self, page: Page, tracks: Tracks):
        self.page, self._tracks = page, tracks
        self._pose_handles: list[Any] = []
        self._path_handle: Any = None
        self._recording_handles: dict[str, Any] = {}
        gui = page.server.gui
        first, last = tracks.time_range
        with gui.add_folder("Participants"):
            self._group = gui.add_dropdown("Group", tracks.groups, initial_value=ALL_PARTICIPANTS)
            self._show_paths = gui.add_checkbox("Paths", False)
            self._rays_checkbox = gui.add_checkbox("Gaze rays", False)
            self._probes_checkbox = gui.add_checkbox("Probes", False)
            step = max((last - first) / _SLIDER_STEPS, 1e-3)
            self._time = gui.add_slider("Time (s)", first, max(last, first + step), step, first)
            self._followed = gui.add_dropdown(
                "Observer follows", [NO_PARTICIPANT, *tracks.participants], initial_value=NO_PARTICIPANT
            )
        self._group.on_update(lambda event: self._draw_all())
        self._show_paths.on_update(lambda event: self._draw_all())
        self._rays_checkbox.on_update(lambda event: self._draw_rays())
        self._probes_checkbox.on_update(lambda event: self._draw_probes())
        self._time.on_update(lambda event: self._draw_poses())
        self._followed.on_update(lambda event: self._draw_poses())
        self._draw_all()

    def _draw_all(self) -> None:
        if self._path_handle is not None:
            self._path_handle.remove()
            self._path_handle = None
        segments, person = self._tracks.segments(self._group.value)
        if self._show_paths.value and len(segments):
            colors = np.repeat(participant_colors(person)[:, None], 2, axis=1)
            self._path_handle = self.page.server.scene.add_line_segments(
                "/people/paths", segments, colors, thickness=1.5, thickness_units="screen"
            )
        self._draw_poses()
        self._draw_rays()
        self._draw_probes()

    def _draw_rays(self) -> None:
        """Draw gaze rays up to the surfaces that they hit, if selected."""
        self._submit_drawing("rays", self._trace_rays if self._rays_checkbox.value else None)

    def _draw_probes(self) -> None:
        """Draw the probes of a kernel density of the gaze samples, if selected."""
        self._submit_drawing("probes", self._place_probes if self._probes_checkbox.value else None)

    def _submit_drawing(self, name: str, draw: Callable[[], Any] | None) -> None:
        """Replace the drawing ``name`` by the result of ``draw``, called on the render thread; None removes it."""

        def steps() -> Iterator[None]:
            old = self._recording_handles.pop(name, None)
            if old is not None:
                old.remove()
            if draw is not None:
                self._recording_handles[name] = draw()
            yield

        self.page.session.worker.submit(("people", name), LOW_PRIORITY, steps())

    def _trace_rays(self) -> Any:
        origins, directions, person = self._tracks.sample(self._group.value)
        if not len(origins):
            return self.page.server.scene.add_frame("/people/rays", show_axes=False)
        # Kernels depend on the number of rays.
        padding = MAX_RAYS - len(origins)
        o, d = (np.concatenate([v, np.repeat(v[-1:], padding, axis=0)]) for v in (origins, directions))
        traced = trace(self.page.session.scene, o, d, ["depth"], observers=o[:1])
        depth = np.asarray(traced.depth[0], float)[: len(origins)]
        length = np.where((depth > 0) & np.isfinite(depth), depth, _MISS_LENGTH)
        lines = np.stack([origins, origins + length[:, None] * directions], axis=1).astype(np.float32)
        colors = np.repeat(participant_colors(person)[:, None], 2, axis=1)
        return self.page.server.scene.add_line_segments(
            "/people/rays", lines, colors, thickness=1.0, thickness_units="screen"
        )

    def _place_probes(self) -> Any:
        positions, counts = self._tracks.place_probes(self._group.value)
        fraction = np.log(counts) / max(np.log(counts.max()), 1e-9)
        colors = (255 * matplotlib.colormaps["viridis"](fraction)[:, :3]).astype(np.uint8)
        return self.page.server.scene.add_point_cloud(
            "/people/probes", positions.astype(np.float32), colors, point_size=0.12, point_shape="circle"
        )

    def _draw_poses(self) -> None:
        for handle in self._pose_handles:
            handle.remove()
        self._pose_handles = []
        poses = self._tracks.poses_at(self._time.value, self._group.value)
        scene, names = self.page.server.scene, self._tracks.participants
        for k, pose in enumerate(poses[:200]):
            color = tuple(int(c) for c in participant_colors(np.array([names.index(pose.participant)]))[0])
            self._pose_handles.append(
                scene.add_icosphere(f"/people/at/{k}", radius=0.07, color=color, position=tuple(pose.position))
            )
            arrow = np.stack([pose.position, pose.position + 0.6 * pose.direction])[None].astype(np.float32)
            self._pose_handles.append(
                scene.add_arrows(f"/people/ahead/{k}", arrow, color, shaft_radius=0.012, head_radius=0.035)
            )
        followed = next((p for p in poses if p.participant == self._followed.value), None)
        if followed is not None:
            self.page.place_observer(followed.position, make_heading(followed.direction, self.page.session.source.up))


def participant_colors(person: np.ndarray) -> np.ndarray:
    """Return a colour (N, 3) uint8 for each participant index (N,)."""
    colors = matplotlib.colormaps["tab10"](np.asarray(person) % 10)[:, :3]
    return (255 * colors).astype(np.uint8)
