"""Loading of scenes: the Mitsuba variant, checks of the scene file, and checks of the loaded scene."""

from __future__ import annotations

import io
import os
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.parsers import expat

import numpy as np

from nerg_mi import __version__, llvm
from nerg_mi.errors import NergError, UnusableLLVM, format_error, translate_mitsuba_errors
from nerg_mi.files.images import check_image, ensure_two_threads
from nerg_mi.files.safe_read import check_regular_file, open_file, resolve_path
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.transforms import check_rigid_transforms
from nerg_mi.properties import resolve_scene_file
from nerg_mi.ranges import SPP, check_number
from nerg_mi.transport.geometry import check_shape

from .rendering_files import check_mesh, check_ply_points, check_vol

# ---- Checks of a scene file ----
#
# Before Mitsuba reads a scene file, it is checked for contents that would crash the process or exhaust the memory. The
# XML is read as a stream of tags, without recursion and without entities. Included files are followed, and the headers
# of meshes, volumes and images are checked.

MAX_DEPTH = 256
"""Maximum nesting depth of elements; Mitsuba's parser crashes at some thousands."""

MAX_ELEMENTS = 1_000_000
"""Maximum number of elements of a scene, with included files."""

MAX_BYTES = 256 << 20
"""Maximum size of the XML of a scene after `$key` substitution; values that refer to others can grow exponentially."""

MAX_INCLUDE_DEPTH = 16
"""Maximum nesting depth of includes."""

MAX_PIXELS = 1 << 28
"""Maximum number of pixels of an image: 16384 x 16384."""

_IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".exr", ".hdr", ".rgbe", ".pfm", ".ppm", ".bmp"}
_CHECKS = {
    "gridvolume": check_vol,
    "sdfgrid": check_vol,
    "ellipsoids": check_ply_points,
    "ellipsoidsmesh": check_ply_points,
}


def check_scene_file(path: str | Path, defaults: Mapping[str, str] | None = None) -> None:
    """Check a scene file and all files that it names.

    Missing files and unknown elements are left to Mitsuba, which reports them.

    Parameters
    ----------
    path : str or Path
        Scene file.
    defaults : mapping of str to str, optional
        Values for its `<default>`s and `$key`s.

    Raises
    ------
    NergError
        A file is damaged, too large or nested too deeply.
    """
    path = Path(path)
    _SceneFileChecker(path.parent, {k: str(v) for k, v in (defaults or {}).items()}).check(path)


def list_scene_files(path: str | Path, defaults: Mapping[str, str] | None = None) -> list[Path]:
    """List a scene file and the existing files that it names: includes, meshes, fields and textures.

    Another file is its own only file. Parameters and errors as for `check_scene_file`.
    """
    path = Path(path)
    if path.suffix.lower() != ".xml":
        return [path]
    reader = _SceneFileChecker(path.parent, {k: str(v) for k, v in (defaults or {}).items()})
    reader.check(path)
    return list(dict.fromkeys([path, *reader.files]))


def check_scene(path: str | Path, scene) -> None:
    """Check the shapes, sensors, films and samplers of a loaded scene. Raises `NergError`."""
    for shape in scene.shapes():
        check_shape(shape, f' of "{path}"', check_merged=True)
    for index, sensor in enumerate(scene.sensors()):
        check_sensor(sensor, f'the to_world of sensor {index} of "{path}"')
        film, count = sensor.film(), sensor.sampler().sample_count()
        width, height = map(int, film.crop_size())
        if not 0 < width * height <= MAX_PIXELS:
            raise NergError(
                f'the film of sensor {index} of "{path}" has {width:,} x {height:,} pixels; the size must be 1 to '
                f"{MAX_PIXELS:,} pixels"
            )
        check_samples(count, f'the sampler of sensor {index} of "{path}"')


def check_sensor(sensor, name: str) -> None:
    """Raise `NergError` if the matrix of a sensor, ``name`` in the message, is no pose, or too far away."""
    pose = np.array(sensor.world_transform().matrix, float).reshape(4, 4)
    check_rigid_transforms(pose, name, tolerance=np.inf)
    check_coordinates(pose[:3, 3:].T, name)


def check_samples(count: int, subject: str) -> None:
    """Raise `NergError` if the number of samples per pixel is out of range."""
    check_number(count, SPP, f"the number of samples per pixel of {subject}", is_integer=True)


class _SceneFileChecker:
    def __init__(self, folder: Path, defaults: dict[str, str]):
        self._folders, self._values = [folder], dict(defaults)
        self._fixed_names = set(defaults)
        self._num_elements = self._num_bytes = 0
        self.files: list[Path] = []
        # Kinds of the meshes, and whether a texture shows their colours.
        self._meshes: dict[Path, str] = {}
        self._uses_mesh_colors = False

    def check(self, path: Path, data: bytes | None = None) -> None:
        self._read(path, 0, (), data)
        for mesh, kind in self._meshes.items():
            check_mesh(mesh, kind, self._uses_mesh_colors)

    def _read(self, path: Path, depth: int, parents: tuple[Path, ...], data: bytes | None = None) -> None:
        resolved_path = resolve_path(path)
        if resolved_path in parents:
            raise NergError(f'the scene file "{path}" includes itself; remove that <include>')
        if len(parents) > MAX_INCLUDE_DEPTH:
            raise NergError(
                f'the scene file "{path}" is nested more than {MAX_INCLUDE_DEPTH} includes deep; reduce the nesting'
            )
        parser = expat.ParserCreate()
        # Expanded entities can grow without bound.
        parser.EntityDeclHandler = lambda *_: self._refuse(
            path, parser, "declares an entity, which is not supported; write out its text"
        )
        parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
        stack: list[tuple[str, str]] = []

        def start(tag, attributes):
            self._num_elements += 1
            if depth + len(stack) >= MAX_DEPTH:
                self._refuse(path, parser, f"nests elements more than {MAX_DEPTH} levels deep; reduce the nesting")
            if self._num_elements > MAX_ELEMENTS:
                self._refuse(path, parser, f"has more than {MAX_ELEMENTS:,} elements; move meshes to separate files")
            values = {key: self._substitute(value, path, parser) for key, value in attributes.items()}
            parent = stack[-1] if stack else ("", "")
            stack.append((tag, values.get("type", "")))
            self._check_element(path, parser, tag, values, parent, depth + len(stack), (*parents, resolved_path))

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda tag: stack.pop()
        try:
            with open_file(path, "scene file") if data is None else io.BytesIO(data) as file:
                while part := file.read(1 << 16):
                    self._count_bytes(len(part), path, parser)
                    parser.Parse(part, False)
            parser.Parse(b"", True)
        except expat.ExpatError as error:
            remedy = (
                "correct it"
                if path.suffix.lower() == ".xml"
                else "pass a scene file (.xml), or what make_scene makes of it"
            )
            raise NergError(f'the scene file "{path}" is not well-formed XML ({error}); {remedy}') from error

    def _refuse(self, path, parser, reason):
        raise NergError(f'the scene file "{path}" (line {parser.CurrentLineNumber}) {reason}')

    def _count_bytes(self, num_bytes: int, path, parser) -> None:
        self._num_bytes += num_bytes
        if self._num_bytes > MAX_BYTES:
            self._refuse(path, parser, f"has more than {MAX_BYTES >> 20} MB of XML; move meshes to separate files")

    def _substitute(self, value: str, path, parser) -> str:
        if "$" not in value:
            return value
        # Longest names first, as in Mitsuba.
        for key in sorted(self._values, key=len, reverse=True):
            self._count_bytes(value.count(f"${key}") * len(self._values[key]), path, parser)
            value = value.replace(f"${key}", self._values[key])
        return value

    def _check_element(self, path, parser, tag, values, parent, depth, parents) -> None:
        name, value = values.get("name", ""), values.get("value", "")
        if tag == "default" and name not in self._fixed_names:
            self._values.setdefault(name, value)
        elif tag == "path":
            self._folders.append(self._folders[0] / value)
        elif tag == "include":
            file = self._find(values.get("filename", ""), "scene file")
            if file is not None:
                self.files.append(file)
                self._read(file, depth, parents)
        elif tag == "matrix":
            # Mitsuba applies transposed matrices as they are.
            try:
                numbers = [float(x) for x in value.replace(",", " ").split()]
            except ValueError:
                return  # Mitsuba reports the line
            if len(numbers) == 16:
                name = f'the matrix in "{path}" (line {parser.CurrentLineNumber})'
                check_rigid_transforms(np.reshape(numbers, (4, 4)), name, tolerance=np.inf)
        elif tag == "spectrum" and "filename" in values:
            file = self._find(values["filename"], "spectrum")
            if file is not None:
                self.files.append(file)
        elif name == "sample_count" and parent[0] == "sampler" and tag == "integer":
            try:
                count = int(value)
            except ValueError:
                return  # Mitsuba reports the line
            check_samples(count, f'the sampler of "{path}" (line {parser.CurrentLineNumber})')
        elif value in ("vertex_color", "face_color") and name == "name" and parent[1] == "mesh_attribute":
            self._uses_mesh_colors = True
        elif name == "filename" and tag == "string":
            file = self._find(value, "file")
            if file is None:
                return
            self.files.append(file)
            if parent[1] in ("ply", "obj"):
                self._meshes[file] = parent[1]
            elif parent[1] in _CHECKS:
                _CHECKS[parent[1]](file)
            elif parent[1] in ("bitmap", "envmap") and file.suffix.lower() in _IMAGE_SUFFIXES:
                check_image(file, "texture")

    def _find(self, name: str, kind: str) -> Path | None:
        """Return the file that Mitsuba opens as ``name``; None if there is none. Raises `NergError` for pipes, devices
        and folders."""
        candidates = [folder / name for folder in self._folders] + [Path(resolve_scene_file(name))]
        path = next((candidate for candidate in candidates if name and os.path.exists(candidate)), None)
        if path is not None:
            check_regular_file(path, kind)
        return path


# ---- Variants and loading ----

_PREFERRED_VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb")
# Parameters of mi.load_file besides the values of a scene.
_RESERVED_NAMES = ("path", "parallel", "optimize")


def activate_variant(variant: str | None = None) -> str:
    """Activate a Mitsuba variant with the plugins of this package.

    Parameters
    ----------
    variant : str, optional
        Name of the variant. Default: ``cuda_ad_rgb`` with an NVIDIA driver, otherwise ``llvm_ad_rgb``.

    Returns
    -------
    str
        Name of the active variant.

    Raises
    ------
    NergError
        The variant does not exist or does not work on this machine.
    """
    import mitsuba as mi

    if variant is not None and variant not in mi.variants():
        raise NergError(f'there is no Mitsuba variant "{variant}"; available variants: {", ".join(mi.variants())}')
    candidates = (
        [variant] if variant else [v for v in _PREFERRED_VARIANTS if not v.startswith("cuda") or llvm.has_cuda()]
    )
    reason = ""
    for candidate in candidates:
        try:
            mi.set_variant(candidate)
            return candidate
        except UnusableLLVM:
            raise
        except ImportError as error:  # The backend of the variant cannot start.
            reason = format_error(error)
    raise NergError(
        f'the variant "{candidates[-1]}" does not work on this machine ({reason}); run "nerg doctor" for help'
    )


def activate_mitsuba() -> ModuleType:
    """Import Mitsuba with a variant active.

    An active variant is kept. Otherwise ``cuda_ad_rgb`` is activated if it works, and ``llvm_ad_rgb`` if not, as in the
    command `nerg`.

    Returns
    -------
    module
        ``mitsuba``.

    Raises
    ------
    NergError
        A scalar variant is active.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        activate_variant()
    elif variant.startswith("scalar"):
        raise NergError(
            f'fields do not support scalar variants such as "{variant}"; '
            'call mi.set_variant("llvm_ad_rgb") or mi.set_variant("cuda_ad_rgb") first'
        )
    return mi


def get_array_module() -> ModuleType:
    """Return the Dr.Jit array types of the active variant (`nerg_mi.fields.mlp.namespace`)."""
    from nerg_mi.fields.mlp import namespace

    return namespace(activate_mitsuba().variant())


def list_library_versions(mode: str) -> dict[str, str]:
    """Return the versions of all libraries that affect results, by name; ``mode`` is the active Mitsuba variant."""
    import drjit
    import mitsuba
    import numpy

    out = {
        "nerg_mi": __version__,
        "mitsuba": mitsuba.__version__,
        "drjit": drjit.__version__,  # pyright: ignore[reportAttributeAccessIssue] which its stubs leave out
        "numpy": numpy.__version__,
        "python": platform.python_version(),
    }
    library = llvm.find_current()
    if mode.startswith("llvm") and library is not None:
        out["libLLVM"] = ".".join(map(str, library.version))
    if mode.startswith("cuda"):
        out["cuda"] = ".".join(map(str, drjit.detail.cuda_version()))
    return out


def load_scene(path: str | Path, defaults: Mapping[str, str] | None = None, merge: bool = True):
    """Load a scene file; the variant must be active.

    Parameters
    ----------
    path : str or Path
        Scene file.
    defaults : mapping of str to str, optional
        Values for its `<default>`s and `$key`s.
    merge : bool
        Whether Mitsuba may merge meshes of the same material, which then lose their names.

    Returns
    -------
    mi.Scene
        The scene.

    Raises
    ------
    NergError
        Mitsuba rejects the scene, or it fails the checks of this module.
    """
    import mitsuba as mi

    if not Path(path).exists():
        raise NergError(f'there is no scene file "{path}"')
    # Any type, since the parameters of mi.load_file are passed in the same way.
    values: dict[str, Any] = dict(defaults or {})
    for name in _RESERVED_NAMES:
        if name in values:
            raise NergError(f'the name "{name}" is reserved by Mitsuba; rename the <default> in "{path}"')
    check_scene_file(path, defaults)
    with translate_mitsuba_errors(), ensure_two_threads():
        try:
            loaded = mi.load_file(str(path), optimize=merge, **values)
        except RuntimeError as error:
            unused = (
                re.findall(r"^\s*- \$(\w+)=", str(error), re.MULTILINE) if "unused parameters" in str(error) else []
            )
            if unused:
                raise NergError(
                    f'the scene "{path}" does not use "${unused[0]}"; correct the name of the value'
                ) from error
            raise
        except UnicodeDecodeError as error:
            # Mitsuba quotes the unreadable data, which is not text.
            raise NergError(f'a mesh or another file of the scene "{path}" is damaged; create it again') from error
    check_scene(path, loaded)
    return loaded


def load_scene_text(text: str, defaults: Mapping[str, str], volumes: Mapping[str, Any], shapes: Mapping[str, Any]):
    """Load the text of a scene file with absolute file names, and with objects in memory; the variant must be active.

    Parameters
    ----------
    text : str
        The text.
    defaults : mapping of str to str
        Values for its `<default>`s.
    volumes, shapes : mapping of str to object
        Further properties of its integrator and of the scene by name, such as objects of Mitsuba.

    Returns
    -------
    mi.Scene
        The scene.

    Raises
    ------
    NergError
        Mitsuba rejects the scene, or it fails the checks of this module.
    """
    import mitsuba as mi

    _SceneFileChecker(Path(), dict(defaults)).check(Path("scene in memory"), text.encode())
    parser: Any = mi.parser
    values: dict[str, Any] = dict(defaults)
    with translate_mitsuba_errors(), ensure_two_threads():
        config = parser.ParserConfig(mi.variant())
        state = parser.parse_string(config, text, **values)
        integrator = next(node for node in state.nodes if node.props.plugin_name() == "nerg")
        for node, objects in ((integrator, volumes), (state.root, shapes)):
            for name, value in objects.items():
                node.props[name] = value
        parser.transform_all(config, state)
        loaded = parser.instantiate(config, state)
    check_scene("scene in memory", loaded)
    return loaded
