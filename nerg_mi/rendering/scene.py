"""Loading a scene: the Mitsuba variant, checks of its file before Mitsuba reads it, and of the scene after that."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from nerg_mi import llvm
from nerg_mi.errors import NergError, UnusableLLVM, translate_mitsuba_errors, format_error
from nerg_mi.files.images import check_image, ensure_two_threads
from nerg_mi.files.safe_read import open_file, resolve_path, check_regular_file
from nerg_mi.formats.meshes import READERS as MESHES
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.properties import resolve_scene_file
from nerg_mi.ranges import SPP, check_number
from nerg_mi.transport.geometry import check_shape

from .files import check_mesh, check_points, check_vol

# ---- Scene file ----
#
# A scene file looked at before Mitsuba reads it: what would end the process or fill the memory is refused in a
# sentence.
#
# The XML is read as a stream of tags, without recursion and without entities; the files that it includes are followed,
# and the meshes, volumes and pictures that it names are looked at by their headers.

DEPTH = 256
"""Elements may be nested so deep; Mitsuba's parser ends the process at some thousands."""

ELEMENTS = 1_000_000
"""A scene may have so many elements, with those of the files that it includes."""

BYTES = 256 << 20
"""A scene may have so many bytes of XML, with what is filled in for its `$key`s: values that name others may grow with
each of them."""

INCLUDES = 16
"""Files may be included so deep."""

PIXELS = 1 << 28
"""A picture may have so many pixels: 16384 x 16384."""

_PICTURES = {".png", ".jpg", ".jpeg", ".exr", ".hdr", ".rgbe", ".pfm", ".ppm", ".bmp"}
_CHECKS = {"gridvolume": check_vol, "sdfgrid": check_vol, "ellipsoids": check_points, "ellipsoidsmesh": check_points}


def check_scene_file(path: str | Path, defaults: Mapping[str, str] | None = None) -> None:
    """Look at the scene file ``path`` and at all that it names; ``defaults``: values for its `<default>` and `$key`.

    What is missing or unknown is left to Mitsuba, which says so. Raises `NergError`.
    """
    path = Path(path)
    _Scene(path.parent, {k: str(v) for k, v in (defaults or {}).items()}).read_whole(path)


def list_scene_files(path: str | Path, defaults: Mapping[str, str] | None = None) -> list[Path]:
    """The scene file ``path`` and the files that it names, as far as they are there: what it includes, meshes, fields,
    textures; a mesh is its own only file. ``defaults`` and errors as of `check_scene_file`."""
    path = Path(path)
    if path.suffix.lower() in MESHES:
        return [path]
    reader = _Scene(path.parent, {k: str(v) for k, v in (defaults or {}).items()})
    reader.read_whole(path)
    return list(dict.fromkeys([path, *reader.files]))


def check_scene(path: str | Path, scene) -> None:
    """Look at what Mitsuba has made of the file: shapes, sensors, films and samplers. Raises `NergError`."""
    for shape in scene.shapes():
        check_shape(shape, f' of "{path}"', check_merged=True)
    for index, sensor in enumerate(scene.sensors()):
        check_coordinates(
            np.array(sensor.world_transform().matrix, float).reshape(4, 4)[:3, 3:].T,
            f'the to_world of sensor {index} of "{path}"',
        )
        film, count = sensor.film(), sensor.sampler().sample_count()
        width, height = map(int, film.crop_size())
        if not 0 < width * height <= PIXELS:
            raise NergError(
                f'the film of sensor {index} of "{path}" has {width:,} x {height:,} pixels: give it 1 to {PIXELS:,}'
            )
        check_samples(count, f'the sampler of sensor {index} of "{path}"')


def check_samples(count: int, what: str) -> None:
    """Raise `NergError` for no samples a pixel and for too many."""
    check_number(count, SPP, f"the number of samples a pixel of {what}", is_integer=True)


class _Scene:
    def __init__(self, folder: Path, defaults: dict[str, str]):
        self._folders, self._values = [folder], dict(defaults)
        self._given = set(defaults)
        self._elements = self._bytes = 0
        self.files: list[Path] = []
        # Kinds of the meshes, and whether a texture shows their colours.
        self._meshes: dict[Path, str] = {}
        self._colored = False

    def read_whole(self, path: Path) -> None:
        self.read(path, 0, ())
        for mesh, kind in self._meshes.items():
            check_mesh(mesh, kind, self._colored)

    def read(self, path: Path, depth: int, within: tuple[Path, ...]) -> None:
        whole = resolve_path(path)
        if whole in within:
            raise NergError(f'the scene file "{path}" includes itself; take that <include> out')
        if len(within) > INCLUDES:
            raise NergError(f'the scene file "{path}" is included more than {INCLUDES} files deep; include fewer')
        parser = expat.ParserCreate()
        # The parser itself would grow the text of entities without bound.
        parser.EntityDeclHandler = lambda *_: self._refuse(
            path, parser, "declares an entity; write out what it stands for"
        )
        parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
        stack: list[tuple[str, str]] = []

        def start(tag, attributes):
            self._elements += 1
            if depth + len(stack) >= DEPTH:
                self._refuse(path, parser, f"nests elements more than {DEPTH} deep; nest fewer")
            if self._elements > ELEMENTS:
                self._refuse(path, parser, f"has more than {ELEMENTS:,} elements; keep meshes in files of their own")
            values = {key: self._filled(value, path, parser) for key, value in attributes.items()}
            parent = stack[-1] if stack else ("", "")
            stack.append((tag, values.get("type", "")))
            self._element(path, parser, tag, values, parent, depth + len(stack), (*within, whole))

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda tag: stack.pop()
        try:
            with open_file(path, "scene file") as file:
                while part := file.read(1 << 16):
                    self._count(len(part), path, parser)
                    parser.Parse(part, False)
            parser.Parse(b"", True)
        except expat.ExpatError as error:
            raise NergError(f'the scene file "{path}" is no well-formed XML ({error}); correct it') from error

    def _refuse(self, path, parser, why):
        raise NergError(f'the scene file "{path}" (line {parser.CurrentLineNumber}) {why}')

    def _count(self, more: int, path, parser) -> None:
        self._bytes += more
        if self._bytes > BYTES:
            self._refuse(path, parser, f"has more than {BYTES >> 20} MB of XML; keep meshes in files of their own")

    def _filled(self, value: str, path, parser) -> str:
        if "$" not in value:
            return value
        # The longest name first, as Mitsuba does.
        for key in sorted(self._values, key=len, reverse=True):
            self._count(value.count(f"${key}") * len(self._values[key]), path, parser)
            value = value.replace(f"${key}", self._values[key])
        return value

    def _element(self, path, parser, tag, values, parent, depth, within) -> None:
        name, value = values.get("name", ""), values.get("value", "")
        if tag == "default" and name not in self._given:
            self._values.setdefault(name, value)
        elif tag == "path":
            self._folders.append(self._folders[0] / value)
        elif tag == "include":
            found = self._find(values.get("filename", ""), "scene file")
            if found is not None:
                self.files.append(found)
                self.read(found, depth, within)
        elif tag == "spectrum" and "filename" in values:
            found = self._find(values["filename"], "spectrum")
            if found is not None:
                self.files.append(found)
        elif name == "sample_count" and parent[0] == "sampler" and tag == "integer":
            try:
                count = int(value)
            except ValueError:
                return  # Mitsuba names the line
            check_samples(count, f'the sampler of "{path}" (line {parser.CurrentLineNumber})')
        elif value in ("vertex_color", "face_color") and name == "name" and parent[1] == "mesh_attribute":
            self._colored = True
        elif name == "filename" and tag == "string":
            found = self._find(value, "file")
            if found is None:
                return
            self.files.append(found)
            if parent[1] in ("ply", "obj"):
                self._meshes[found] = parent[1]
            elif parent[1] in _CHECKS:
                _CHECKS[parent[1]](found)
            elif parent[1] in ("bitmap", "envmap") and found.suffix.lower() in _PICTURES:
                check_image(found, "texture")

    def _find(self, name: str, what: str) -> Path | None:
        """The file that Mitsuba opens as ``name``, None where there is none. Raises `NergError` for a pipe, a device or
        a folder."""
        places = [folder / name for folder in self._folders] + [Path(resolve_scene_file(name))]
        found = next((place for place in places if name and os.path.exists(place)), None)
        if found is not None:
            check_regular_file(found, what)
        return found


# ---- Pictures ----
#
# What comes before a picture: the Mitsuba variant that renders it, and its scene.

_PREFERRED = ("cuda_ad_rgb", "llvm_ad_rgb")
# What mi.load_file takes besides the values of a scene.
_OWN = ("path", "parallel", "optimize")


def activate_variant(variant: str | None = None) -> str:
    """Make a Mitsuba variant the active one, with the plugins of this package, and give its name.

    `variant` None: `cuda_ad_rgb` where there is an NVIDIA driver, otherwise `llvm_ad_rgb`. Raises NergError for a name
    that Mitsuba does not know and for a variant that does not work here.
    """
    import mitsuba as mi

    if variant is not None and variant not in mi.variants():
        raise NergError(f'there is no variant "{variant}"; this Mitsuba has {", ".join(mi.variants())}')
    wanted = [variant] if variant else [v for v in _PREFERRED if not v.startswith("cuda") or llvm.has_cuda()]
    reason = ""
    for choice in wanted:
        try:
            mi.set_variant(choice)
            return choice
        except UnusableLLVM:
            raise
        except ImportError as error:  # Mitsuba says so where the backend of a variant cannot start
            reason = format_error(error)
    raise NergError(f'the variant "{wanted[-1]}" does not work here ({reason}); "nerg doctor" says how to mend it')


def load_scene(path: str | Path, defaults: Mapping[str, str] | None = None, merge: bool = True):
    """The scene of a file, with ``defaults`` for its `<default>` and `$key`; the variant must be active. ``merge``:
    whether Mitsuba may make one of meshes of the same material, which then lose their names.

    Raises NergError for what Mitsuba does not take, and for what would end its process or fill the memory.
    """
    import mitsuba as mi

    if not Path(path).exists():
        raise NergError(f'there is no scene file "{path}"')
    # Values of any type, among which Mitsuba looks for its own parameters.
    given: dict[str, Any] = dict(defaults or {})
    for name in _OWN:
        if name in given:
            raise NergError(f'"{name}" is a name that Mitsuba keeps for itself: give the value in "{path}" another')
    check_scene_file(path, defaults)
    with translate_mitsuba_errors(), ensure_two_threads():
        try:
            loaded = mi.load_file(str(path), optimize=merge, **given)
        except RuntimeError as error:
            unused = (
                re.findall(r"^\s*- \$(\w+)=", str(error), re.MULTILINE) if "unused parameters" in str(error) else []
            )
            if unused:
                raise NergError(
                    f'the scene "{path}" asks for no "${unused[0]}": correct the name that is given a value'
                ) from error
            raise
        except UnicodeDecodeError as error:
            # Mitsuba quotes what it cannot read, and that is no text.
            raise NergError(f'a mesh or another file that the scene "{path}" names is damaged: make it anew') from error
    check_scene(path, loaded)
    return loaded
