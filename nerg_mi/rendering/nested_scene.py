"""A scene file read as elements: as the place of a scene with gaze, and with another gaze field in it."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import translate_read_errors, resolve_path, check_regular_file

from .scene import check_scene_file
from .scene_writer import BlankLine, Comment, Node, SceneContent, Verbatim, format_document, element, relative_path, check_attribute

# ---- Somebody's scene file as the place of a scene with gaze ----
#
# Mitsuba takes one integrator a scene, which has to be `nerg`; the one of the file then lights its shapes from within
# (docs/how-to/environments.md). An `<include>` cannot do that, so that the file is copied: what it includes becomes a
# part of the copy, its sensors come after ours, and a `<path>` leads to the files that it names.

BYTES = 16 << 20
"""A scene file that is copied may have so many bytes, with each that it includes."""

SPP = 64
"""Samples a pixel: paths of light have more noise than fields."""


def nest_scene(path: Path, folder: Path) -> SceneContent:
    """The scene file ``path`` as the place of one that is written into ``folder``.

    Raises `NergError` for what is no scene file, and for one whose integrator is `nerg` already or one of several.
    """
    version, children = scene_elements(path)
    defaults = [child for child in children if child.tag == "default"]
    values = filled_values(children)
    integrators = [child for child in children if child.tag == "integrator"]
    _check_integrators(path, integrators, values)
    ids = {found.get("id", "") for child in children for found in child.iter()}
    others = [child for child in children if child.tag not in ("default", "integrator", "path")]
    light: tuple[Node, ...] = ()
    if integrators:
        light = (Comment(f"What lights the shapes: the integrator of {path.name}."), *map(verbatim, integrators))
    return SceneContent(
        integrator_children=light,
        scene_children=(Comment(f"What follows is {path.name}; its sensors are counted after ours."), *map(verbatim, others)),
        preamble=(*_paths(path, children, folder), *map(verbatim, defaults), BlankLine()),
        spp=SPP,
        version=version,
        reserved_names=frozenset(values) | frozenset(ids),
    )


def scene_elements(path: Path) -> tuple[str, list[ElementTree.Element]]:
    """The version of the scene file ``path``, and its elements, with those that it includes in their place. Raises
    `NergError` for what is no scene file."""
    check_scene_file(path)
    root = _root(path)
    return root.get("version", "3.0.0"), list(_inlined(root, path, [path.parent]))


def filled_values(children: list[ElementTree.Element]) -> dict[str, str]:
    """The values of the `<default>`s among a scene's elements, where they name each other filled in."""
    values: dict[str, str] = {}
    for default in children:
        if default.tag == "default":
            values.setdefault(default.get("name", ""), fill(default.get("value", ""), values))
    return values


def name_files(elements: list[ElementTree.Element], path: Path, children: list[ElementTree.Element]) -> None:
    """Make names of files that are there absolute, in ``elements`` and below, and in the values of `<default>`s; they
    are of the scene file ``path``, whose ``children`` say in which folders to look."""
    folders = [path.parent, *(path.parent / c.get("value", "") for c in children if c.tag == "path")]
    for one in (found for given in elements for found in given.iter()):
        named = one.tag == "default" or (one.tag == "string" and one.get("name") == "filename")
        value = one.get("value", "")
        if not named or not value or value.startswith("$"):
            continue
        there = next((f / value for f in folders if (f / value).is_file()), None)
        if there is not None:
            one.set("value", check_attribute(str(resolve_path(there))))


def verbatim(found: ElementTree.Element) -> Verbatim:
    """An element of a scene file as a part of another."""
    found = deepcopy(found)
    found.tail = None
    ElementTree.indent(found, " " * 4)
    return Verbatim(ElementTree.tostring(found, encoding="unicode"))


def _root(path: Path) -> ElementTree.Element:
    check_regular_file(path, "scene file", BYTES)
    builder = ElementTree.TreeBuilder(insert_comments=True)
    with translate_read_errors(path, "scene file", "correct it", extra_errors=(ElementTree.ParseError,)):
        root = ElementTree.parse(path, ElementTree.XMLParser(target=builder)).getroot()
    if root.tag != "scene":
        raise NergError(f'"{path}" is no scene file: it begins with <{sanitize(root.tag, 40)}> where <scene> is needed')
    return root


def _inlined(root: ElementTree.Element, path: Path, folders: list[Path]) -> Iterator[ElementTree.Element]:
    """The elements of a scene with those that it includes in their place. `check_scene_file` has bounded the depth."""
    for child in root:
        if child.tag == "path":
            folders.append(folders[0] / child.get("value", ""))
        if child.tag != "include":
            yield child
            continue
        name = child.get("filename", "")
        found = next((f / name for f in folders if name and (f / name).is_file()), None)
        if found is None:
            raise NergError(f'the scene file "{path}" includes "{sanitize(name)}", which is not there; correct the name')
        yield from _inlined(_root(found), found, folders)


def _check_integrators(path: Path, integrators: list[ElementTree.Element], values: dict[str, str]) -> None:
    if len(integrators) > 1:
        raise NergError(f'the scene file "{path}" has {len(integrators)} integrators; leave one of them')
    kinds = {fill(found.get("type", ""), values) for i in integrators for found in i.iter("integrator")}
    if "nerg" in kinds:
        raise NergError(
            f'the integrator of "{path}" is "nerg" already; put the gaze field into it by hand, as a <volume '
            'name="gaze" type="gazefield"> (docs/reference/plugins.md), and "nerg render" shows it'
        )


def fill(text: str, values: dict[str, str]) -> str:
    """``text`` with ``values`` in place of their `$key`s."""
    # The longest name first, as Mitsuba does.
    for key in sorted(values, key=len, reverse=True):
        text = text.replace(f"${key}", values[key])
    return text


def _paths(path: Path, children: list[ElementTree.Element], folder: Path) -> list[Node]:
    """Where the files are that the scene names."""
    given = [path.parent, *(path.parent / child.get("value", "") for child in children if child.tag == "path")]
    names = [relative_path(place, folder) for place in given]
    return [element("path", value=check_attribute(name)) for name in dict.fromkeys(names) if name != "."]


# ---- A scene file with another gaze field in its place ----

ROLE = "gaze"
"""The integrator's property that is its gaze field."""


def find_gaze_file(path: Path) -> Path | None:
    """The file of the gaze field in the integrator of the scene file ``path``; None where it has none.

    Raises `NergError` for a scene without an integrator of its own in the file.
    """
    _, own = _elements(path)
    volume = _gaze_volume(_integrator(path, own))
    if volume is None:
        return None
    name = next((c.get("value", "") for c in volume if c.get("name") == "filename"), "")
    return path.parent / fill(name, filled_values(own)) if name else None


def replace_gaze(path: Path, gaze: Path) -> str:
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
    SubElement(volume, "string", name="filename", value=check_attribute(str(resolve_path(gaze))))
    return format_document(list(map(verbatim, own)), f"{path.name} with the gaze field {gaze.name}.", version)


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
