"""What a page shows as a scene file, which `nerg render` renders alike."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rendering.nested_scene import name_files, scene_elements, verbatim
from nerg_mi.rendering.scene_writer import Comment, document, element, numbers, prop

from . import layers
from .view import View

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

    view: View
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
    eye = [] if shown.observer is None else [element("default", name=OBSERVER, value=numbers(shown.observer))]
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
        element("default", name=CAMERA, value=numbers(shown.view.origin)),
        element("default", name=TARGET, value=numbers(shown.view.target)),
        *eye,
        _sensor(shown),
        Comment("What follows is from the scene that was viewed; its sensors are counted after ours."),
        *map(verbatim, own),
    ]
    return document(nodes, f"A view of {path.name}, copied from the viewer.", version)


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
        SubElement(integrator, "vector", name="up", value=numbers(up))
    SubElement(integrator, "string", name="aovs", value=",".join(shown.aovs))


def _sensor(shown: Shown):
    view = shown.view
    up = numbers(view.up)
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


def copied_view(session: Any, view: View) -> str:
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
