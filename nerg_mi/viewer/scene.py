"""The place and the people in it as the viewer's page shows them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import matplotlib
import numpy as np

from nerg_mi.api.query import trace
from nerg_mi.errors import NergError
from nerg_mi.rendering.nested_scene import name_files, scene_elements, verbatim
from nerg_mi.rendering.scene_writer import Comment, format_document, element, format_numbers, prop

from . import layers
from .page import Page
from .points import PinholeView, make_heading
from .session import ALL_PARTICIPANTS, LOW_PRIORITY, MAX_RAYS, Tracks

# ---- What a page shows as a scene file, which `nerg render` renders alike ----

CAMERA_DEFAULT, TARGET_DEFAULT, OBSERVER_DEFAULT = "view_camera", "view_target", "view_observer"
"""`<default>`s of a copied scene."""

CLIP_DISTANCES = {"near_clip": 1e-6, "far_clip": 1e12}
"""Distances at which its camera begins and ends to see: a page's rays have no limits."""

SENSOR_ID = "view"
"""The name of its camera."""


@dataclass(frozen=True, eq=False)
class ViewSettings:
    """What a page shows: its ``view``, the ``observer`` (3,) or None where the camera is it, AOVs, the ``width`` of the
    picture in pixels, samples ``spp`` a pixel, the integrator's ``falloff``, and the height and up (3,) of a
    ``ceiling`` that is cut off, or None."""

    view: PinholeView
    observer: np.ndarray | None
    aovs: tuple[str, ...]
    width: int
    spp: int
    falloff: float
    ceiling: tuple[float, np.ndarray] | None = None


def copy_scene(path: Path, settings: ViewSettings) -> str:
    """The scene file ``path`` as text, with the camera, the observer and the settings of what is ``shown``; names of
    files are absolute, so that it may be saved anywhere.

    Raises `NergError` for a scene whose integrator is not written in the file.
    """
    version, children = scene_elements(path)
    observer_defaults = (
        []
        if settings.observer is None
        else [element("default", name=OBSERVER_DEFAULT, value=format_numbers(settings.observer))]
    )
    # What a copy that is viewed itself has of its own is said anew.
    replaced = {("sensor", SENSOR_ID), ("default", CAMERA_DEFAULT), ("default", TARGET_DEFAULT)} | {
        ("default", OBSERVER_DEFAULT) for _ in observer_defaults
    }
    key = lambda child: (child.tag, child.get("id" if child.tag == "sensor" else "name"))
    copies = [deepcopy(child) for child in children if child.tag != "path" and key(child) not in replaced]
    integrators = [child for child in copies if child.tag == "integrator"]
    if len(integrators) != 1:
        raise NergError(f'"{path}" has {len(integrators)} integrators, and a copy needs one; leave one of them')
    name_files(copies, path, children)
    _update_integrator(integrators[0], settings)
    nodes = [
        element("default", name=CAMERA_DEFAULT, value=format_numbers(settings.view.origin)),
        element("default", name=TARGET_DEFAULT, value=format_numbers(settings.view.target)),
        *observer_defaults,
        _make_sensor(settings),
        Comment("What follows is from the scene that was viewed; its sensors are counted after ours."),
        *map(verbatim, copies),
    ]
    return format_document(nodes, f"A view of {path.name}, copied from the viewer.", version)


def _update_integrator(integrator: Element, settings: ViewSettings) -> None:
    """Put observer, fall-off, ceiling and AOVs into the ``integrator``."""
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
    # The angle between the left and the right border, which a picture's whole pixels may differ from by a trifle.
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
    """A scene file of ``view`` with the observer, the layer and the settings of ``session``."""
    check_can_copy(session)
    aovs = tuple(name for name in layers.required_quantities(session.display.layer) if name != "color")
    settings = session.options.width, session.spp, session.falloff, get_ceiling(session)
    return copy_scene(session.scene_file, ViewSettings(view, session.observer, aovs, *settings))


def get_ceiling(session: Any) -> tuple[float, np.ndarray] | None:
    """The height and the up of what ``session`` leaves out of views from above."""
    return None if session.ceiling is None else (session.ceiling, session.ceiling_up)


def check_can_copy(session: Any) -> None:
    """Raise `NergError` for a place that ends with the viewer, so that no copy of it could be rendered."""
    if session.source.made and session.scene_file.with_suffix(".vol").exists():
        raise NergError('the place was made of rays for this viewer; "nerg scene" writes it as a scene of its own')


# ---- People ----
#
# People in the page: their paths, rays and probes, where they are at a moment, and whose eye the observer is.

NO_PARTICIPANT = "(nobody)"
_SLIDER_STEPS = 2000
_MISS_LENGTH = 1.0  # length of a ray that meets no surface, in scene units


class ParticipantsPanel:
    """The part of a page's panel for rays, and their paths."""

    def __init__(self, page: Page, tracks: Tracks):
        self.page, self._tracks = page, tracks
        self._pose_handles: list[Any] = []
        self._path_handle: Any = None
        self._recording_handles: dict[str, Any] = {}
        gui = page.server.gui
        first, last = tracks.time_range
        with gui.add_folder("People"):
            self._group = gui.add_dropdown("Who", tracks.groups, initial_value=ALL_PARTICIPANTS)
            self._show_paths = gui.add_checkbox("Paths", False)
            self._rays_checkbox = gui.add_checkbox("Rays", False)
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
        """Lines from eyes to what they looked at, where rays are wanted."""
        self._submit_drawing("rays", self._trace_rays if self._rays_checkbox.value else None)

    def _draw_probes(self) -> None:
        """Balls where a density of the rays would be said to hold, where probes are wanted."""
        self._submit_drawing("probes", self._place_probes if self._probes_checkbox.value else None)

    def _submit_drawing(self, name: str, draw: Callable[[], Any] | None) -> None:
        """What is drawn as ``name``, by ``draw`` on the thread that renders; None: nothing."""

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
        # Kernels are compiled for a number of rays.
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
    """A colour (N, 3) uint8 for each person's number (N,)."""
    colors = matplotlib.colormaps["tab10"](np.asarray(person) % 10)[:, :3]
    return (255 * colors).astype(np.uint8)
