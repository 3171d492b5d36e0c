"""Scene files as XML elements: nested in another scene, or with another gaze field."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import check_regular_file, resolve_path, translate_read_errors

from .scene_loading import check_scene_file
from .scene_writer import (
    INTEGRATOR_SETTINGS,
    BlankLine,
    Comment,
    SceneContent,
    Verbatim,
    check_attribute,
    format_document,
)

# ---- A scene file nested in a scene with gaze ----
#
# A Mitsuba scene has one integrator, which must be `nerg`; the integrator of the nested file becomes its child and
# computes the light on the shapes (docs/how-to/environments.md). If it is `nerg` itself, its field or volumes are
# copied in its place. An `<include>` cannot do this, so the elements of the file are copied, included files are
# expanded, and a `<path>` makes its relative file names valid.

MAX_BYTES = 16 << 20
"""Maximum size of a scene file to copy, and of each file that it includes."""

DEFAULT_SPP = 64
"""Samples per pixel: path tracing is noisier than fields."""

GAZE_PROPERTIES = ("gaze", "kde")
"""Names of the gaze in the integrator `nerg`."""

VIEW_PROPERTIES = (*GAZE_PROPERTIES, "observer", *INTEGRATOR_SETTINGS)
"""Properties of `nerg` that belong to a view of an environment; a written scene has its own."""


def nest_scene(path: Path, values: Mapping[str, str] | None = None) -> SceneContent:
    """Make the content of a new scene file from an existing one.

    Parameters
    ----------
    path : Path
        Scene file to nest.
    values : mapping of str to str, optional
        Values of its `<default>`s.

    Returns
    -------
    SceneContent
        The elements of the nested file.

    Raises
    ------
    NergError
        The file is not a scene file, has several integrators, or its integrator `nerg` is within another one.
    """
    version, children = read_scene_elements(path, values)
    defaults = [child for child in children if child.tag == "default"]
    values = resolve_defaults(children)
    others = [child for child in children if child.tag not in ("default", "integrator", "path")]
    integrator = _read_integrator(path, children, values)
    is_nerg = integrator is not None and _is_nerg(integrator, values)
    comment, copied, left_out = f"The integrator of {path.name} computes the light on the shapes.", [], ()
    if integrator is not None and is_nerg:
        comment = f"Copied from the integrator of {path.name}."
        copied = [node for node in integrator if node.get("name") not in VIEW_PROPERTIES]
        left_out = tuple(name for node in integrator if (name := node.get("name", "")) in VIEW_PROPERTIES)
    elif integrator is not None:
        copied = [integrator]
    nodes = [node for child in (*copied, *others) for node in child.iter()]
    is_lit = not is_nerg or any(node.tag in ("integrator", "emitter") for node in nodes)
    return SceneContent(
        integrator_children=(Comment(comment), *map(to_verbatim, copied)) if copied else (),
        scene_children=(
            Comment(f"The rest is copied from {path.name}. Its sensors come after the sensors above."),
            *map(to_verbatim, others),
        ),
        folders=_list_folders(path, children),
        preamble=(*map(to_verbatim, defaults), BlankLine()),
        spp=DEFAULT_SPP if is_lit else SceneContent.spp,
        version=version,
        reserved_names=frozenset(values) | {node.get("id", "") for node in nodes},
        left_out=left_out,
        subject=f"The scene {path.name}",
    )


def read_scene_elements(path: Path, values: Mapping[str, str] | None = None) -> tuple[str, list[ElementTree.Element]]:
    """Read the version and the elements of a scene file, with its includes expanded and ``values`` of its `<default>`s.

    Raises
    ------
    NergError
        The file is not a scene file.
    """
    check_scene_file(path)
    root = _parse_root(path)
    children = list(_expand_includes(root, path, [path.parent]))
    for child in children:
        if child.tag == "default" and (name := child.get("name", "")) in (values or {}):
            child.set("value", check_attribute((values or {})[name]))
    return root.get("version", "3.0.0"), children


def resolve_defaults(children: list[ElementTree.Element]) -> dict[str, str]:
    """Return the values of the `<default>`s among the elements of a scene, with references resolved."""
    values: dict[str, str] = {}
    for default in children:
        if default.tag == "default":
            values.setdefault(default.get("name", ""), substitute_defaults(default.get("value", ""), values))
    return values


def make_paths_absolute(elements: list[ElementTree.Element], path: Path, children: list[ElementTree.Element]) -> None:
    """Make file names in ``elements`` and their `<default>`s absolute, in place.

    Parameters
    ----------
    elements : list of Element
        Elements to change.
    path : Path
        The scene file that contains them.
    children : list of Element
        All elements of the scene file, whose `<path>` elements name the folders to search.
    """
    folders = _list_folders(path, children)
    for node in (node for top in elements for node in top.iter()):
        names_file = node.tag == "default" or (node.tag == "string" and node.get("name") == "filename")
        value = node.get("value", "")
        if not names_file or not value or value.startswith("$"):
            continue
        path_in_folder = next((f / value for f in folders if (f / value).is_file()), None)
        if path_in_folder is not None:
            node.set("value", check_attribute(str(resolve_path(path_in_folder))))


def to_verbatim(node: ElementTree.Element) -> Verbatim:
    """Copy an element of a scene file for another one."""
    node = deepcopy(node)
    node.tail = None
    ElementTree.indent(node, " " * 4)
    return Verbatim(ElementTree.tostring(node, encoding="unicode"))


def _parse_root(path: Path) -> ElementTree.Element:
    check_regular_file(path, "scene file", MAX_BYTES)
    builder = ElementTree.TreeBuilder(insert_comments=True)
    with translate_read_errors(path, "scene file", "correct it", extra_errors=(ElementTree.ParseError,)):
        root = ElementTree.parse(path, ElementTree.XMLParser(target=builder)).getroot()
    if root.tag != "scene":
        raise NergError(f'"{path}" is not a scene file: its root element is <{sanitize(root.tag, 40)}>, not <scene>')
    return root


def _expand_includes(root: ElementTree.Element, path: Path, folders: list[Path]) -> Iterator[ElementTree.Element]:
    """Yield the elements of a scene with its includes expanded. `check_scene_file` has limited the depth."""
    for child in root:
        if child.tag == "path":
            folders.append(folders[0] / child.get("value", ""))
        if child.tag != "include":
            yield child
            continue
        name = child.get("filename", "")
        included = next((f / name for f in folders if name and (f / name).is_file()), None)
        if included is None:
            raise NergError(
                f'the scene file "{path}" includes "{sanitize(name)}", which does not exist; correct the path'
            )
        yield from _expand_includes(_parse_root(included), included, folders)


def _read_integrator(path: Path, children: list[ElementTree.Element], values: dict[str, str]) -> Element | None:
    """Return the integrator among the elements of a scene file, or None."""
    integrators = [child for child in children if child.tag == "integrator"]
    if len(integrators) > 1:
        raise NergError(f'the scene file "{path}" has {len(integrators)} integrators; keep one of them')
    integrator = next(iter(integrators), None)
    if integrator is not None and any(_is_nerg(node, values) for node in integrator.findall(".//integrator")):
        raise NergError(f'the integrator "nerg" of "{path}" is within another integrator; take it out of that')
    return integrator


def _is_nerg(integrator: Element, values: dict[str, str]) -> bool:
    return substitute_defaults(integrator.get("type", ""), values) == "nerg"


def substitute_defaults(text: str, values: dict[str, str]) -> str:
    """Replace `$key` references in ``text`` by ``values``."""
    # Longest names first, as in Mitsuba.
    for key in sorted(values, key=len, reverse=True):
        text = text.replace(f"${key}", values[key])
    return text


def _list_folders(path: Path, children: list[ElementTree.Element]) -> tuple[Path, ...]:
    """Return the folders in which the file names of a scene are looked up."""
    return (path.parent, *(path.parent / child.get("value", "") for child in children if child.tag == "path"))


# ---- Replacing the fields of a scene file ----

GAZE_PROPERTY = "gaze"
"""Name of the gaze field in the integrator."""

FIELD_PROPERTY = "field"
"""Name of the radiance field in the integrator."""


def find_field_file(path: Path, name: str) -> Path | None:
    """Find the file of a field of a scene file, `GAZE_PROPERTY` or `FIELD_PROPERTY`; None if it has no such field.

    Raises
    ------
    NergError
        The file does not contain exactly one integrator.
    """
    _, elements = _read_absolute_elements(path)
    node = _find_filename(_find_volume(_find_integrator(path, elements), name))
    value = "" if node is None else node.get("value", "")
    return path.parent / substitute_defaults(value, resolve_defaults(elements)) if value else None


def replace_radiance_field(path: Path, field: Path) -> str:
    """Return the text of a scene file with another file as its radiance field, in the same place.

    The text contains absolute paths, so that it can be written anywhere. Raises `NergError` if the scene has no
    radiance field from a file.
    """
    version, elements = _read_absolute_elements(path)
    node = _find_filename(_find_volume(_find_integrator(path, elements), FIELD_PROPERTY))
    if node is None:
        raise NergError(f'"{path}" has no radiance field from a file')
    node.set("value", check_attribute(str(resolve_path(field))))
    return format_document(list(map(to_verbatim, elements)), f"{path.name} with the field {field.name}.", version)


def replace_gaze(path: Path, gaze: Path) -> str:
    """Return the text of a scene file with another gaze field.

    Parameters
    ----------
    path : Path
        Scene file.
    gaze : Path
        Gaze field, which replaces that of the scene or is added.

    Returns
    -------
    str
        The text. It contains absolute paths, so that it can be written anywhere.

    Raises
    ------
    NergError
        The file does not contain exactly one integrator.
    """
    version, elements = _read_absolute_elements(path)
    integrator = _find_integrator(path, elements)
    volume = _find_volume(integrator, GAZE_PROPERTY)
    if volume is not None:
        integrator.remove(volume)
    volume = SubElement(integrator, "volume", name=GAZE_PROPERTY, type="gazefield")
    SubElement(volume, "string", name="filename", value=check_attribute(str(resolve_path(gaze))))
    return format_document(list(map(to_verbatim, elements)), f"{path.name} with the gaze field {gaze.name}.", version)


def _read_absolute_elements(path: Path) -> tuple[str, list[Element]]:
    """Read the version and the elements of a scene file, with absolute file names."""
    version, children = read_scene_elements(path)
    elements = [deepcopy(child) for child in children if child.tag != "path"]
    make_paths_absolute(elements, path, children)
    return version, elements


def _find_integrator(path: Path, children: list[Element]) -> Element:
    integrators = [child for child in children if child.tag == "integrator"]
    if len(integrators) != 1:
        raise NergError(f'"{path}" has {len(integrators)} integrators, but a scene with gaze needs exactly one')
    return integrators[0]


def _find_volume(integrator: Element, name: str) -> Element | None:
    return next((child for child in integrator if child.tag == "volume" and child.get("name") == name), None)


def _find_filename(volume: Element | None) -> Element | None:
    return None if volume is None else next((c for c in volume if c.get("name") == "filename"), None)
