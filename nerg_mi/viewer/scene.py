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
from .points import PinholeView, heading_of
from .session import ALL, RAYS, UNHURRIED, Tracks

# ---- What a page shows as a scene file, which `nerg render` renders alike ----

CAMERA, TARGET, OBSERVER = "view_camera", "view_target", "view_observer"
"""`<default>`s of a copied scene."""

CLIP = {"near_clip": 1e-6, "far_clip": 1e12}
"""Distances at which its camera begins and ends to see: a page's rays have no limits."""

SENSOR = "view"
"""The name of its camera."""


@dataclass(frozen=True, eq=False)
class Shown:
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


def copied(path: Path, shown: Shown) -> str:
    """The scene file ``path`` as text, with the camera, the observer and the settings of what is ``shown``; names of
    files are absolute, so that it may be saved anywhere.

    Raises `NergError` for a scene whose integrator is not written in the file.
    """
    version, children = scene_elements(path)
    eye = [] if shown.observer is None else [element("default", name=OBSERVER, value=format_numbers(shown.observer))]
    # What a copy that is viewed itself has of its own is said anew.
    ours = {("sensor", SENSOR), ("default", CAMERA), ("default", TARGET)} | {("default", OBSERVER) for _ in eye}
    named = lambda child: (child.tag, child.get("id" if child.tag == "sensor" else "name"))
    own = [deepcopy(child) for child in children if child.tag != "path" and named(child) not in ours]
    integrators = [child for child in own if child.tag == "integrator"]
    if len(integrators) != 1:
        raise NergError(f'"{path}" has {len(integrators)} integrators, and a copy needs one; leave one of them')
    name_files(own, path, children)
    _observe(integrators[0], shown)
    nodes = [
        element("default", name=CAMERA, value=format_numbers(shown.view.origin)),
        element("default", name=TARGET, value=format_numbers(shown.view.target)),
        *eye,
        _sensor(shown),
        Comment("What follows is from the scene that was viewed; its sensors are counted after ours."),
        *map(verbatim, own),
    ]
    return format_document(nodes, f"A view of {path.name}, copied from the viewer.", version)


def _observe(integrator: Element, shown: Shown) -> None:
    """Put observer, fall-off, ceiling and AOVs into the ``integrator``."""
    names = {"falloff", "aovs", "ceiling", "up"} | ({"observer"} if shown.observer is not None else set())
    for child in [c for c in integrator if c.get("name") in names]:
        integrator.remove(child)
    if shown.observer is not None:
        sensor = SubElement(integrator, "sensor", name="observer", type="perspective")
        SubElement(SubElement(sensor, "transform", name="to_world"), "translate", value=f"${OBSERVER}")
    SubElement(integrator, "float", name="falloff", value=f"{shown.falloff:.9g}")
    if shown.ceiling is not None:
        height, up = shown.ceiling
        SubElement(integrator, "float", name="ceiling", value=f"{height:.9g}")
        SubElement(integrator, "vector", name="up", value=format_numbers(up))
    SubElement(integrator, "string", name="aovs", value=",".join(shown.aovs))


def _sensor(shown: Shown):
    view = shown.view
    up = format_numbers(view.up)
    film = element(
        "film",
        prop("integer", "width", shown.width),
        prop("integer", "height", view.height(shown.width)),
        element("rfilter", type="box"),
        prop("string", "component_format", "float32"),
        prop("string", "pixel_format", "rgb"),
        type="hdrfilm",
    )
    # The angle between the left and the right border, which a picture's whole pixels may differ from by a trifle.
    across = math.degrees(2 * math.atan(math.tan(view.fov / 2) * view.aspect))
    look = element("lookat", origin=f"${CAMERA}", target=f"${TARGET}", up=up)
    return element(
        "sensor",
        prop("float", "fov", f"{across:.9g}"),
        prop("string", "fov_axis", "x"),
        *(prop("float", name, f"{distance:g}") for name, distance in CLIP.items()),
        element("transform", look, name="to_world"),
        element("sampler", prop("integer", "sample_count", shown.spp), type="independent"),
        film,
        type="perspective",
        id=SENSOR,
    )


def copied_view(session: Any, view: PinholeView) -> str:
    """A scene file of ``view`` with the observer, the layer and the settings of ``session``."""
    check_copied(session)
    asked = tuple(name for name in layers.quantities(session.shade.layer) if name != "color")
    settings = session.options.width, session.spp, session.falloff, ceiling_of(session)
    return copied(session.scene_file, Shown(view, session.observer, asked, *settings))


def ceiling_of(session: Any) -> tuple[float, np.ndarray] | None:
    """The height and the up of what ``session`` leaves out of views from above."""
    return None if session.ceiling is None else (session.ceiling, session.cut_up)


def check_copied(session: Any) -> None:
    """Raise `NergError` for a place that ends with the viewer, so that no copy of it could be rendered."""
    if session.place.made and session.scene_file.with_suffix(".vol").exists():
        raise NergError('the place was made of rays for this viewer; "nerg scene" writes it as a scene of its own')


# ---- People ----
#
# People in the page: their paths, rays and probes, where they are at a moment, and whose eye the observer is.

NOBODY = "(nobody)"
_STEPS = 2000
_NOTHING = 1.0  # length of a ray that meets no surface, in scene units


class PeoplePanel:
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
