"""A scene file with another gaze field in its place."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from nerg_mi.errors import NergError

from .nested_scene import fill, filled_values, name_files, scene_elements, verbatim
from .scene_writer import document, value_of

ROLE = "gaze"
"""The integrator's property that is its gaze field."""


def gaze_of_scene(path: Path) -> Path | None:
    """The file of the gaze field in the integrator of the scene file ``path``; None where it has none.

    Raises `NergError` for a scene without an integrator of its own in the file.
    """
    _, own = _elements(path)
    volume = _gaze_volume(_integrator(path, own))
    if volume is None:
        return None
    name = next((c.get("value", "") for c in volume if c.get("name") == "filename"), "")
    return path.parent / fill(name, filled_values(own)) if name else None


def with_gaze(path: Path, gaze: Path) -> str:
    """The scene file ``path`` as text, with the gaze field of the file ``gaze`` in place of its own, or beside what it
    has; names of files are absolute, so that it may be written anywhere.

    Raises `NergError` as `gaze_of_scene`.
    """
    version, own = _elements(path)
    integrator = _integrator(path, own)
    volume = _gaze_volume(integrator)
    if volume is not None:
        integrator.remove(volume)
    volume = SubElement(integrator, "volume", name=ROLE, type="gazefield")
    SubElement(volume, "string", name="filename", value=value_of(str(gaze.resolve())))
    return document(list(map(verbatim, own)), f"{path.name} with the gaze field {gaze.name}.", version)


def _elements(path: Path) -> tuple[str, list[Element]]:
    """The version of a scene file, and its elements with absolute names of files."""
    version, children = scene_elements(path)
    own = [deepcopy(child) for child in children if child.tag != "path"]
    name_files(own, path, children)
    return version, own


def _integrator(path: Path, children: list[Element]) -> Element:
    found = [child for child in children if child.tag == "integrator"]
    if len(found) != 1:
        raise NergError(f'"{path}" has {len(found)} integrators, where a gaze field goes into one; leave one of them')
    return found[0]


def _gaze_volume(integrator: Element) -> Element | None:
    return next((child for child in integrator if child.tag == "volume" and child.get("name") == ROLE), None)
