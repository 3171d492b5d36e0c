"""Scene files as XML elements: nested in another scene, or with another gaze field."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
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


def _make_paths_absolute(elements: list[Element], folders: Sequence[Path]) -> None:
    """Make file names in ``elements`` and their `<default>`s, which are looked up in ``folders``, absolute in place."""
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
    with translate_read_errors(path, "scene file", "correct it", extra_errors=(ElementTree.ParseError,)):
        root = ElementTree.parse(path, _make_parser()).getroot()
    if root.tag != "scene":
        raise NergError(f'"{path}" is not a scene file: its root element is <{sanitize(root.tag, 40)}>, not <scene>')
    return root


def _make_parser() -> ElementTree.XMLParser:
    return ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))


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


# ---- Scene files in memory ----


@dataclass(frozen=True, eq=False)
class SceneDocument:
    """The elements of a scene file, with absolute file names, so that its text can be loaded and written anywhere.

    Attributes
    ----------
    name : str
        Name of the file in messages and comments.
    version : str
        Version of the scene format.
    elements : list of Element
        The elements. They are not changed in place.
    """

    name: str
    version: str
    elements: list[Element]

    @classmethod
    def read(cls, path: Path, values: Mapping[str, str] | None = None) -> SceneDocument:
        """Read a scene file with ``values`` of its `<default>`s. Raises `NergError` if it is none."""
        version, children = read_scene_elements(path, values)
        elements = [child for child in children if child.tag != "path"]
        _make_paths_absolute(elements, _list_folders(path, children))
        return cls(path.name, version, elements)

    @classmethod
    def parse(cls, text: str, name: str) -> SceneDocument:
        """Parse the ``text`` of a scene file with absolute file names, as `format_document` returns it."""
        root = ElementTree.fromstring(text, _make_parser())
        return cls(name, root.get("version", "3.0.0"), list(root))

    def find_integrator(self) -> Element:
        """Return the integrator. Raises `NergError` if there is not exactly one."""
        integrators = [element for element in self.elements if element.tag == "integrator"]
        if len(integrators) != 1:
            raise NergError(
                f'"{self.name}" has {len(integrators)} integrators, but a scene with gaze needs exactly one'
            )
        return integrators[0]

    def without_volumes(self, names: Collection[str]) -> SceneDocument:
        """Return a copy without the volumes of the integrator of these names. Raises `NergError` as
        `find_integrator`."""
        copied = replace(self, elements=deepcopy(self.elements))
        integrator = copied.find_integrator()
        for volume in [child for child in integrator if child.tag == "volume" and child.get("name") in names]:
            integrator.remove(volume)
        return copied

    def with_gaze(self, gaze: Path) -> SceneDocument:
        """Return a copy with the gaze field of a file, which replaces that of the scene or is added. Raises
        `NergError` as `find_integrator`."""
        copied = self.without_volumes(["gaze"])
        volume = SubElement(copied.find_integrator(), "volume", name="gaze", type="gazefield")
        SubElement(volume, "string", name="filename", value=check_attribute(str(resolve_path(gaze))))
        return copied

    def to_xml(self) -> str:
        """Return the text of the file."""
        return format_document(list(map(to_verbatim, self.elements)), f"A copy of {self.name}.", self.version)
