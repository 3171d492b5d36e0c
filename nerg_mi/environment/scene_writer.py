"""Writing of scene files: XML elements with comments, and scenes with a gaze field and an observer."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.maths.types import Point3f, variant_types

# ---- Camera projection ----


def compute_clip_distances(extent: float, unit: float = 1.0) -> tuple[float, float]:
    """Compute the near and far clip distances of a camera.

    The defaults are one centimetre and ten kilometres; smaller or larger scenes widen the range. Ray tracing loses no
    precision with a large ratio of the two.

    Parameters
    ----------
    extent : float
        Diagonal of a box around the scene and the camera, in scene units.
    unit : float
        Scene units per metre.

    Returns
    -------
    tuple of float
        Near and far distance in scene units.
    """
    return min(0.01 * unit, 3e-3 * extent), max(1e4 * unit, 100 * extent)


def project_to_pixel(camera: Any, point: Point3f) -> tuple[float, float] | None:
    """Project a point to the image of a perspective camera.

    Parameters
    ----------
    camera : mi.Sensor
        The camera.
    point : Point3f
        One point in scene units.

    Returns
    -------
    tuple of float or None
        (x, y) in pixels, relative to the centre of the first pixel; None if the point is outside the image or behind
        the camera.
    """
    mi = variant_types()
    film = camera.film()
    fov = mi.traverse(camera)["x_fov"]
    local = camera.world_transform().inverse() @ point
    clip = camera.near_clip(), camera.far_clip()
    screen = mi.perspective_projection(film.size(), film.crop_size(), film.crop_offset(), fov, *clip)
    x, y, _ = (float(v[0]) for v in np.array(screen @ local).reshape(3, -1))
    depth = float(np.array(local).reshape(3, -1)[2, 0])
    if depth <= 0 or not (0 < x < 1 and 0 < y < 1):
        return None
    width, height = film.crop_size()
    return x * width - 0.5, y * height - 0.5


# ---- XML formatting ----

_INDENT = "    "
_WIDTH = 120
# Characters that XML 1.0 forbids; lone surrogates come from file names that are not valid Unicode.
_INVALID_CHARACTERS = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


@dataclass(frozen=True)
class Comment:
    """A comment, wrapped when it is written."""

    text: str


@dataclass(frozen=True)
class Verbatim:
    """XML that is written unchanged, such as parts of another file."""

    text: str


@dataclass(frozen=True)
class BlankLine:
    """An empty line between groups."""


@dataclass(frozen=True)
class Element:
    """An XML element: ``tag``, ``attributes`` in order, and ``children``."""

    tag: str
    attributes: tuple[tuple[str, str], ...]
    children: tuple[Node, ...] = ()


Node = Element | Comment | Verbatim | BlankLine


def element(tag: str, *children: Node, **attributes: object) -> Element:
    """Make an element with attributes in the given order; a trailing underscore of an attribute name is removed."""
    return Element(tag, tuple((name.rstrip("_"), str(value)) for name, value in attributes.items()), children)


def prop(kind: str, name: str, value: object) -> Element:
    """Make a property: ``<kind name="name" value="value"/>``."""
    return element(kind, name=name, value=value)


def format_numbers(values: Iterable[float]) -> str:
    """Format numbers separated by commas, with nine digits, or the shortest text that restores a single-precision
    value; -0 becomes 0."""
    return ", ".join(f"{_round_single(float(v)) + 0.0:.9g}" for v in values)


def _round_single(value: float) -> float:
    single = np.float32(value)
    return float(str(single)) if float(single) == value else value


def transform(*steps: Node, name: str = "to_world") -> Element:
    """Make a transform of ``steps``, applied in this order."""
    return element("transform", *steps, name=name)


def matrix(values: np.ndarray) -> Element:
    """Make a transform step from a (4, 4) matrix, in double precision."""
    return element("matrix", value=" ".join(f"{float(v) + 0.0:.15g}" for v in np.asarray(values).ravel()))


def format_document(nodes: Sequence[Node], head: str, version: str = "3.0.0") -> str:
    """Format a scene file.

    Parameters
    ----------
    nodes : sequence of Node
        Elements of the scene.
    head : str
        First comment; empty lines separate paragraphs.
    version : str
        Version of the scene format.

    Returns
    -------
    str
        The text of the file.

    Raises
    ------
    NergError
        An attribute contains characters that XML forbids.
    """
    lines = _format_comment(head, "")
    lines.append(f"<scene version={_quote(version)}>")
    for node in nodes:
        lines += _format_node(node, _INDENT)
    return "\n".join([*lines, "</scene>", ""])


def check_attribute(name: str) -> str:
    """Return the file name ``name`` if it can be used as an attribute of a scene file.

    Raises
    ------
    NergError
        The name contains ``$``, which Mitsuba would substitute, or characters that XML forbids.
    """
    if "$" in name or _INVALID_CHARACTERS.search(name):
        raise NergError(
            f'the path "{sanitize(name)}" cannot be written to a scene file, because it contains "$" or characters '
            "that are not valid text; rename the file or its folder"
        )
    return name


def _format_node(node: Node, indent: str) -> list[str]:
    match node:
        case BlankLine():
            return [""]
        case Comment(text):
            return _format_comment(text, indent)
        case Verbatim(text):
            return [indent + line if line.strip() else "" for line in text.splitlines()]
        case Element(tag, attributes, children):
            head = "".join(f" {name}={_quote(value)}" for name, value in attributes)
            if not children:
                return [f"{indent}<{tag}{head}/>"]
            inner = [line for child in children for line in _format_node(child, indent + _INDENT)]
            return [f"{indent}<{tag}{head}>", *inner, f"{indent}</{tag}>"]


def _quote(value: str) -> str:
    if _INVALID_CHARACTERS.search(value):
        raise NergError(f'"{sanitize(value)}" cannot be written to a scene file: it is not valid text')
    return '"' + escape(value, {'"': "&quot;", "\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}) + '"'


def _format_comment(text: str, indent: str) -> list[str]:
    """Format a comment in lines of at most 120 columns; double hyphens, which end a comment, become single ones."""
    text = re.sub("-{2,}", "-", _INVALID_CHARACTERS.sub("?", text)).rstrip("-")
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            if line and len(indent) + 9 + len(line) + len(word) > _WIDTH:
                lines.append(line)
                line = ""
            line += f" {word}" if line else word
        lines.append(line)
    first, *rest = lines
    out = [f"{indent}<!-- {first}", *(f"{indent}     {line}" if line else "" for line in rest)]
    out[-1] += " -->"
    return out


# ---- Scenes with gaze ----
#
# A written scene consists of the integrator `nerg`, with fields and an observer, and three sensors: 0 a camera, 1 the
# view of the observer, 2 a panorama around the observer. `<default>`s at the top of the file contain all settings.
# Sensors and names are those of ``scenes/store/scene.xml``.


@dataclass(frozen=True)
class LookAt:
    """Position and target of a camera or an observer.

    Parameters
    ----------
    origin, target : ndarray of shape (3,)
        Position, and the point in the centre of the view, in scene units.
    up : ndarray of shape (3,) or None
        Up direction. None: the up direction of the scene.
    """

    origin: np.ndarray
    target: np.ndarray
    up: np.ndarray | None = None


@dataclass(frozen=True)
class Lens:
    """Projection of a perspective camera.

    Parameters
    ----------
    fov : float
        Horizontal field of view in degrees.
    aspect : float
        Width divided by height.
    offset : tuple of float
        Offset of the principal point, relative to width and height, with Mitsuba's sign.
    """

    fov: float = 70.0
    aspect: float = 1.5
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class SceneContent:
    """Environment of a written scene.

    Parameters
    ----------
    integrator_children : tuple of Node
        Children of the integrator: a field, volumes, or an integrator for the light on shapes.
    scene_children : tuple of Node
        Children of the scene: shapes and lights.
    folders : tuple of Path
        Folders in which its file names are looked up, besides that of the written scene.
    preamble : tuple of Node
        Elements at the top of the file: defaults of another file.
    files : mapping of str to Path
        Files by the name of their `<default>`.
    spp : int
        Samples per pixel for an image with little noise.
    version : str
        Version of the scene format.
    reserved_names : frozenset of str
        Names of `<default>`s and ids that another file uses.
    left_out : tuple of str
        Names of properties of another file's integrator `nerg` that are not used.
    subject : str
        Name of the environment, which begins the first comment.
    written : tuple of Path
        Files that were written for it.
    volumes, shapes : mapping of str to object
        What has no file, by name: children of the integrator and of the scene, as dicts for ``mi.load_dict``, objects
        of Mitsuba, or elements of `nerg_mi.environment.contents`. Only a scene in memory shows them.
    """

    integrator_children: tuple[Node, ...] = ()
    scene_children: tuple[Node, ...] = ()
    folders: tuple[Path, ...] = ()
    preamble: tuple[Node, ...] = ()
    files: Mapping[str, Path] = field(default_factory=dict)
    spp: int = 16
    version: str = "3.0.0"
    reserved_names: frozenset[str] = frozenset()
    left_out: tuple[str, ...] = ()
    subject: str = ""
    written: tuple[Path, ...] = ()
    volumes: Mapping[str, Any] = field(default_factory=dict)
    shapes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class GazeFiles:
    """Gaze of a written scene.

    Parameters
    ----------
    gaze : Path, GazeField or None
        A gaze field, as a file or in memory.
    rays : Path, Rays or None
        Recorded gaze samples, displayed as a kernel density.
    align : ndarray of shape (4, 4) or None
        Transform from the frame of the recordings to the scene. None: identity.
    """

    gaze: Any = None
    rays: Any = None
    align: np.ndarray | None = None

    @property
    def quantity(self) -> str | None:
        """The AOV to display."""
        return "gaze" if self.gaze is not None else "kde" if self.rays is not None else None


@dataclass(frozen=True)
class SceneText:
    """The contents of a scene file.

    Parameters
    ----------
    content : SceneContent
        The environment.
    gaze_files : GazeFiles
        The gaze.
    camera : LookAt
        The camera.
    observer : LookAt or None
        The observer. None: the camera is the observer.
    up : ndarray of shape (3,)
        Up direction of the scene.
    lens : Lens
        Projection of the camera.
    width : int
        Width of the image in pixels.
    unit : float
        Scene units per metre.
    extent : float
        Diagonal of a box around the environment and the cameras, in scene units.
    comment, camera_comment, observer_comment : str
        Comments in the file: at the top, at the camera and at the observer.
    """

    content: SceneContent
    gaze_files: GazeFiles
    camera: LookAt
    observer: LookAt | None
    up: np.ndarray
    lens: Lens = Lens()
    width: int = 480
    unit: float = 1.0
    extent: float = 10.0
    comment: str = ""
    camera_comment: str = ""
    observer_comment: str = ""

    @property
    def falloff(self) -> float:
        """Distance in scene units over which gaze fades out behind a surface: 5 cm, within limits set by the extent of
        the scene."""
        return float(np.clip(0.05 * self.unit, 1e-4 * self.extent, 0.02 * self.extent))

    def to_xml(self, folder: Path | None = None) -> str:
        """Return the text of a file in ``folder``, with file names relative to it; of none, with absolute file names.

        Raises `NergError` for names that cannot be written.
        """
        return format_document(_make_nodes(self, folder), self.comment, self.content.version)


INTEGRATOR_SETTINGS = ("occlusion", "radiance", "visibility", "falloff", "tolerance", "depth", "aovs")
"""Parameters of the integrator that are `<default>`s of a written scene."""


class _SceneNames:
    """Names of the `<default>`s and ids of a scene that do not collide with names of another file."""

    def __init__(self, taken: frozenset[str]):
        self._taken = taken

    def __call__(self, name: str) -> str:
        return free_default_name(name, self._taken)

    def default(self, name: str, value: object) -> Element:
        return element("default", name=self(name), value=value)

    def use(self, name: str) -> str:
        return f"${self(name)}"


def _make_nodes(scene: SceneText, folder: Path | None) -> Sequence[Node]:
    names, content = _SceneNames(scene.content.reserved_names), scene.content
    paths = dict.fromkeys(relative_path(path, folder) for path in content.folders)
    pose = _make_look_at(names.use("camera"), names.use("target"), _format_up(scene.camera, names))
    return [
        *(element("path", value=check_attribute(path)) for path in paths if path != "."),
        *content.preamble,
        *_make_defaults(scene, names, folder),
        BlankLine(),
        _make_integrator(scene, names),
        BlankLine(),
        _make_perspective("camera", pose, scene, names, scene.lens.offset),
        BlankLine(),
        *_make_observer_sensors(scene, names),
        *([BlankLine(), *content.scene_children] if content.scene_children else []),
    ]


def _make_defaults(scene: SceneText, names: _SceneNames, folder: Path | None) -> list[Node]:
    height = max(1, round(scene.width / scene.lens.aspect))
    gaze_files, sphere = scene.gaze_files, 2 * round(0.4 * scene.width)
    files = {**scene.content.files, "gaze": gaze_files.gaze, "rays": gaze_files.rays}
    out: list[Node] = [
        names.default(name, check_attribute(relative_path(file, folder)))
        for name, file in files.items()
        if isinstance(file, Path)
    ]
    out += [
        names.default(name, value)
        for name, value in {
            "spp": scene.content.spp,
            "width": scene.width,
            "height": height,
            "sphere_width": sphere,
            "sphere_height": sphere // 2,
        }.items()
    ]
    out += [BlankLine(), Comment(scene.camera_comment)]
    out += [
        names.default("camera", format_numbers(scene.camera.origin)),
        names.default("target", format_numbers(scene.camera.target)),
    ]
    out += [names.default("fov", format_numbers([scene.lens.fov])), names.default("up", format_numbers(scene.up))]
    if scene.observer is not None:
        out += [BlankLine(), Comment(scene.observer_comment)]
        out += [names.default("eye", format_numbers(scene.observer.origin))]
        out += [names.default("ahead", format_numbers(scene.observer.target))]
    aovs = ["depth", "opacity", *([gaze_files.quantity] if gaze_files.quantity else []), "visibility"]
    falloff = Comment(
        "Distance behind a visible surface over which gaze fades to zero, in scene units. 0: a hard edge."
    )
    return [
        *out,
        BlankLine(),
        names.default("aovs", ",".join(aovs)),
        names.default("depth", "median"),
        falloff,
        names.default("falloff", format_numbers([scene.falloff])),
        names.default("visibility", "depth"),
        names.default("tolerance", "0"),
        names.default("occlusion", "true"),
        names.default("radiance", "true"),
    ]


def _make_integrator(scene: SceneText, names: _SceneNames) -> Element:
    gaze_files = scene.gaze_files
    children: list[Node] = list(scene.content.integrator_children)
    if isinstance(gaze_files.gaze, Path):
        children.append(element("volume", prop("string", "filename", names.use("gaze")), name="gaze", type="gazefield"))
    if isinstance(gaze_files.rays, Path):
        transforms = [] if gaze_files.align is None else [transform(matrix(gaze_files.align))]
        file = prop("string", "filename", names.use("rays"))
        children.append(element("volume", file, *transforms, name="kde", type="gazekde"))
    if scene.observer is not None:
        pose = _make_look_at(names.use("eye"), names.use("ahead"), _format_up(scene.observer, names))
        children.append(element("sensor", pose, name="observer", type="perspective"))
    kinds = {"occlusion": "boolean", "radiance": "boolean", "falloff": "float", "tolerance": "float"}
    for name in INTEGRATOR_SETTINGS:
        children.append(prop(kinds.get(name, "string"), name, names.use(name)))
    return element("integrator", *children, type="nerg", id=names("integrator"))


def _make_observer_sensors(scene: SceneText, names: _SceneNames) -> list[Node]:
    observer = scene.observer
    eye, ahead = ("camera", "target") if observer is None else ("eye", "ahead")
    pose = _make_look_at(names.use(eye), names.use(ahead), _format_up(observer or scene.camera, names))
    forward = level_direction((observer or scene.camera), scene.up)
    pose_of_sphere = transform(
        element("lookat", origin="0, 0, 0", target=format_numbers(forward), up=format_numbers(scene.up)),
        element("translate", value=names.use(eye)),
    )
    film = _make_film(names.use("sphere_width"), names.use("sphere_height"))
    sphere = element("sensor", pose_of_sphere, _make_sampler(names), film, type="panorama", id=names("gaze_sphere"))
    direction = (
        "the viewing direction of the observer" if observer is not None else "the viewing direction of the camera"
    )
    return [
        _make_perspective("own_view", pose, scene, names),
        BlankLine(),
        Comment(f"The centre of this image is the horizon in {direction}."),
        sphere,
    ]


def level_direction(pose: LookAt, up: np.ndarray) -> np.ndarray:
    """Return the horizontal unit vector (3,) in the viewing direction of ``pose``; any horizontal one for a vertical
    view."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    for along in (np.subtract(pose.target, pose.origin), np.roll(up, 1)):
        level = along - up * (along @ up)
        if np.linalg.norm(level) > 1e-3 * np.linalg.norm(along):
            return level / np.linalg.norm(level)
    raise ValueError(f"no direction is orthogonal to the up direction {up}")


def _make_perspective(
    name: str, pose: Node, scene: SceneText, names: _SceneNames, offset: Sequence[float] = (0, 0)
) -> Element:
    lens: list[Node] = [prop("float", "fov", names.use("fov")), prop("string", "fov_axis", "x")]
    lens += [prop("float", f"principal_point_offset_{a}", format_numbers([v])) for a, v in zip("xy", offset) if v]
    near, far = (format_numbers([distance]) for distance in compute_clip_distances(scene.extent, scene.unit))
    film = _make_film(names.use("width"), names.use("height"))
    clip = [prop("float", "near_clip", near), prop("float", "far_clip", far)]
    return element("sensor", *lens, *clip, pose, _make_sampler(names), film, type="perspective", id=names(name))


def _make_film(width: str, height: str) -> Element:
    return element(
        "film",
        prop("integer", "width", width),
        prop("integer", "height", height),
        element("rfilter", type="box"),
        prop("string", "component_format", "float32"),
        prop("string", "pixel_format", "rgb"),
        type="hdrfilm",
    )


def _make_sampler(names: _SceneNames) -> Element:
    return element("sampler", prop("integer", "sample_count", names.use("spp")), type="independent")


def _make_look_at(origin: str, target: str, up: str) -> Element:
    return transform(element("lookat", origin=origin, target=target, up=up))


def _format_up(pose: LookAt, names: _SceneNames) -> str:
    return names.use("up") if pose.up is None else format_numbers(pose.up)


def free_default_name(name: str, taken: frozenset[str]) -> str:
    """Return ``name``, or a variant of it if ``taken`` contains it, as the name of a `<default>`."""
    return f"nerg_{name}" if name in taken else name


def relative_path(path: Path, folder: Path | None) -> str:
    """Return ``path`` relative to ``folder``, or absolute if the two have no common folder except the root."""
    path = Path(os.path.realpath(path))
    if folder is None:
        return str(path)
    folder = Path(os.path.realpath(folder))
    common = os.path.commonpath([path, folder])
    return os.path.relpath(path, folder) if common != os.path.dirname(common) else str(path)
