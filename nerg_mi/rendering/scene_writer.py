"""Scene files as text: elements with comments, and the parts of a scene with a place, a gaze field and an observer."""

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

# ---- Where a point of a scene lies in a camera's picture, and how near and far the camera sees ----


def clip_distances(extent: float, unit: float = 1.0) -> tuple[float, float]:
    """Distances at which a camera begins and ends to see, in scene units: a centimetre and ten kilometres, and nearer
    and farther where the scene is smaller or larger than what people are in, or in other units.

    ``extent``: diagonal of a box around the scene and the camera; ``unit``: scene units of a metre. Of traced rays the
    ratio of both costs no precision.
    """
    return min(0.01 * unit, 3e-3 * extent), max(1e4 * unit, 100 * extent)


def project_to_pixel(camera: Any, point: Point3f) -> tuple[float, float] | None:
    """Where ``point`` (one lane, scene units) lies in the picture of the perspective ``camera``: (x, y) in pixels,
    counted from the first one's centre; None outside of it, and behind the camera."""
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


# ---- Scene writer ----
#
# Scene files as text: elements with comments, escaped, in the layout in which people write them by hand.
#
# Nothing here knows what a scene is for: `scene_parts` says what belongs into one.

_INDENT = "    "
_WIDTH = 120
# What XML 1.0 holds besides tabs and line ends; halves of pairs come from file names that are no text.
_UNFIT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


@dataclass(frozen=True)
class Comment:
    """A sentence or more, broken into lines where it is written."""

    text: str


@dataclass(frozen=True)
class Verbatim:
    """XML that is written as it is, line by line, such as parts of somebody else's file."""

    text: str


@dataclass(frozen=True)
class BlankLine:
    """An empty line between groups."""


@dataclass(frozen=True)
class Element:
    """An XML element: its ``tag``, its ``attributes`` in their order, and what stands within it."""

    tag: str
    attributes: tuple[tuple[str, str], ...]
    children: tuple[Node, ...] = ()


Node = Element | Comment | Verbatim | BlankLine


def element(tag: str, *children: Node, **attributes: object) -> Element:
    """An element; attributes in the order in which they are given, a trailing underscore of their name left out."""
    return Element(tag, tuple((name.rstrip("_"), str(value)) for name, value in attributes.items()), children)


def prop(kind: str, name: str, value: object) -> Element:
    """A property: ``<kind name="name" value="value"/>``."""
    return element(kind, name=name, value=value)


def format_numbers(values: Iterable[float]) -> str:
    """Numbers with commas between them, with nine digits or, of single precision, as many as tell them apart; no
    "-0"."""
    return ", ".join(f"{_shortest(float(v)) + 0.0:.9g}" for v in values)


def _shortest(value: float) -> float:
    single = np.float32(value)
    return float(str(single)) if float(single) == value else value


def transform(*steps: Node, name: str = "to_world") -> Element:
    """A transform of ``steps``, of which the later apply after the earlier."""
    return element("transform", *steps, name=name)


def matrix(values: np.ndarray) -> Element:
    """A step of a transform: the (4, 4) matrix ``values``, in double precision."""
    return element("matrix", value=" ".join(f"{float(v) + 0.0:.15g}" for v in np.asarray(values).ravel()))


def format_document(nodes: Sequence[Node], head: str, version: str = "3.0.0") -> str:
    """A scene file of ``nodes`` whose first comment is ``head``, its paragraphs apart.

    Raises `NergError` for characters that no XML holds.
    """
    lines = _comment(head, "")
    lines.append(f"<scene version={_quoted(version)}>")
    for node in nodes:
        lines += _lines(node, _INDENT)
    return "\n".join([*lines, "</scene>", ""])


def check_attribute(name: str) -> str:
    """A file's ``name`` as the value of an attribute. Raises `NergError` for one that Mitsuba would not take as it is:
    it fills in what follows a dollar sign."""
    if "$" in name or _UNFIT.search(name):
        raise NergError(
            f'the name "{sanitize(name)}" cannot stand in a scene file, because of "$" or of characters that are no text; '
            "rename the file or its folder"
        )
    return name


def _lines(node: Node, indent: str) -> list[str]:
    match node:
        case BlankLine():
            return [""]
        case Comment(text):
            return _comment(text, indent)
        case Verbatim(text):
            return [indent + line if line.strip() else "" for line in text.splitlines()]
        case Element(tag, attributes, children):
            head = "".join(f" {name}={_quoted(value)}" for name, value in attributes)
            if not children:
                return [f"{indent}<{tag}{head}/>"]
            inner = [line for child in children for line in _lines(child, indent + _INDENT)]
            return [f"{indent}<{tag}{head}>", *inner, f"{indent}</{tag}>"]


def _quoted(value: str) -> str:
    if _UNFIT.search(value):
        raise NergError(f'"{sanitize(value)}" cannot stand in a scene file: it holds characters that are no text')
    return '"' + escape(value, {'"': "&quot;", "\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}) + '"'


def _comment(text: str, indent: str) -> list[str]:
    """``<!-- text -->`` in lines of at most 120 columns; two hyphens, which end a comment, become one."""
    text = re.sub("-{2,}", "-", _UNFIT.sub("?", text)).rstrip("-")
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            if line and len(indent) + 9 + len(line) + len(word) > _WIDTH:
                lines.append(line)
                line = ""
            line += f" {word}" if line else word
        lines.append(line)
    first, *others = lines
    out = [f"{indent}<!-- {first}", *(f"{indent}     {line}" if line else "" for line in others)]
    out[-1] += " -->"
    return out


# ---- Scene parts ----
#
# What a written scene consists of: the integrator `nerg` with a place, a gaze field and an observer, and three
# sensors, all of it set by `<default>`s at the top of the file.
#
# Sensors: 0 a camera, 1 the observer's own view, 2 all directions around the observer. These are the sensors, and the
# names, of ``scenes/store/scene.xml``.


@dataclass(frozen=True)
class LookAt:
    """Where somebody, or a camera, is and what they look at: (3,) each in scene units; ``up``: (3,), where it is not
    that of the scene."""

    origin: np.ndarray
    target: np.ndarray
    up: np.ndarray | None = None


@dataclass(frozen=True)
class Lens:
    """``fov``: degrees between the left and right border; ``aspect``: width by height; ``offset``: of the principal
    point, as shares of width and height, as Mitsuba counts it."""

    fov: float = 70.0
    aspect: float = 1.5
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class SceneContent:
    """What a scene shows. ``inside``: children of the integrator (a field, volumes, an integrator that lights shapes);
    ``beside``: of the scene (shapes, lights); ``first``: before all else (paths and defaults of another file).
    ``files``: names of files by the `<default>` that holds them."""

    integrator_children: tuple[Node, ...] = ()
    scene_children: tuple[Node, ...] = ()
    preamble: tuple[Node, ...] = ()
    files: Mapping[str, str] = field(default_factory=dict)
    # Samples a pixel that make a picture without much noise.
    spp: int = 16
    version: str = "3.0.0"
    # Names of <default>s, and ids, that another file has taken.
    reserved_names: frozenset[str] = frozenset()


@dataclass(frozen=True)
class GazeFiles:
    """Whose attention it shows: files of a gaze field and of rays, or None; ``align`` (4, 4): from the rays to the
    scene, None where they are the same."""

    gaze: str | None = None
    rays: str | None = None
    align: np.ndarray | None = None

    @property
    def quantity(self) -> str | None:
        """The AOV that is shown."""
        return "gaze" if self.gaze is not None else "kde" if self.rays is not None else None


@dataclass(frozen=True)
class SceneText:
    """All that a scene file says. ``unit``: scene units of a metre, or what stands for one; ``extent``: length of the
    diagonal of a box around the place and its cameras, in scene units; ``observer``: None where the camera is the
    observer."""

    content: SceneContent
    gaze_files: GazeFiles
    camera: LookAt
    observer: LookAt | None
    up: np.ndarray
    lens: Lens = Lens()
    width: int = 480
    unit: float = 1.0
    extent: float = 10.0
    # Sentences for whoever opens the file: of the file, of the camera, of the observer.
    comment: str = ""
    camera_comment: str = ""
    observer_comment: str = ""

    @property
    def falloff(self) -> float:
        """Distance over which gaze fades behind what the observer sees: 5 cm, within what a place of this size shows
        and single precision resolves."""
        return float(np.clip(0.05 * self.unit, 1e-4 * self.extent, 0.02 * self.extent))

    def to_xml(self) -> str:
        """The text of the file."""
        return format_document(_nodes(self), self.comment, self.content.version)


class _SceneNames:
    """The `<default>`s and ids of a scene, under names that no other file has taken."""

    def __init__(self, taken: frozenset[str]):
        self._taken = taken

    def __call__(self, name: str) -> str:
        return free_default_name(name, self._taken)

    def default(self, name: str, value: object) -> Element:
        return element("default", name=self(name), value=value)

    def use(self, name: str) -> str:
        return f"${self(name)}"


def _nodes(scene: SceneText) -> Sequence[Node]:
    names, place = _SceneNames(scene.content.reserved_names), scene.content
    return [
        *place.preamble,
        *_defaults(scene, names),
        BlankLine(),
        _integrator(scene, names),
        BlankLine(),
        _camera(scene, names),
        BlankLine(),
        *_own_sensors(scene, names),
        *([BlankLine(), *place.scene_children] if place.scene_children else []),
    ]


def _defaults(scene: SceneText, names: _SceneNames) -> list[Node]:
    height = max(1, round(scene.width / scene.lens.aspect))
    attention, sphere = scene.gaze_files, 2 * round(0.4 * scene.width)
    files = {**scene.content.files, "gaze": attention.gaze, "rays": attention.rays}
    out: list[Node] = [names.default(name, file) for name, file in files.items() if file is not None]
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
    aovs = ["depth", "opacity", *([attention.quantity] if attention.quantity else []), "visibility"]
    falloff = Comment(
        "How far behind what the observer sees gaze fades to zero, in units of the scene; 0: a hard edge."
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


def _integrator(scene: SceneText, names: _SceneNames) -> Element:
    attention = scene.gaze_files
    children: list[Node] = list(scene.content.integrator_children)
    if attention.gaze is not None:
        children.append(element("volume", prop("string", "filename", names.use("gaze")), name="gaze", type="gazefield"))
    if attention.rays is not None:
        where = [] if attention.align is None else [transform(matrix(attention.align))]
        file = prop("string", "filename", names.use("rays"))
        children.append(element("volume", file, *where, name="kde", type="gazekde"))
    if scene.observer is not None:
        pose = _look(names.use("eye"), names.use("ahead"), _up(scene.observer, names))
        children.append(element("sensor", pose, name="observer", type="perspective"))
    kinds = {"occlusion": "boolean", "radiance": "boolean", "falloff": "float", "tolerance": "float"}
    for name in ("occlusion", "radiance", "visibility", "falloff", "tolerance", "depth", "aovs"):
        children.append(prop(kinds.get(name, "string"), name, names.use(name)))
    return element("integrator", *children, type="nerg", id=names("integrator"))


def _camera(scene: SceneText, names: _SceneNames) -> Element:
    pose = _look(names.use("camera"), names.use("target"), _up(scene.camera, names))
    return _perspective("camera", pose, scene, names, scene.lens.offset)


def _own_sensors(scene: SceneText, names: _SceneNames) -> list[Node]:
    observer = scene.observer
    eye, ahead = ("camera", "target") if observer is None else ("eye", "ahead")
    pose = _look(names.use(eye), names.use(ahead), _up(observer or scene.camera, names))
    front = level_direction((observer or scene.camera), scene.up)
    around = transform(
        element("lookat", origin="0, 0, 0", target=format_numbers(front), up=format_numbers(scene.up)),
        element("translate", value=names.use(eye)),
    )
    film = _film(names.use("sphere_width"), names.use("sphere_height"))
    sphere = element("sensor", around, _sampler(names), film, type="panorama", id=names("gaze_sphere"))
    towards = "the direction in which the observer looks" if observer is not None else "where the camera looks"
    return [
        _perspective("own_view", pose, scene, names),
        BlankLine(),
        Comment(f"The middle of this picture is the horizon towards {towards}."),
        sphere,
    ]


def level_direction(eye: LookAt, up: np.ndarray) -> np.ndarray:
    """Unit direction (3,) in which ``eye`` looks, made level; any level one for an eye that looks straight up or
    down."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    for along in (np.subtract(eye.target, eye.origin), np.roll(up, 1)):
        level = along - up * (along @ up)
        if np.linalg.norm(level) > 1e-3 * np.linalg.norm(along):
            return level / np.linalg.norm(level)
    raise ValueError(f"no direction is level under the up {up}")


def _perspective(
    name: str, pose: Node, scene: SceneText, names: _SceneNames, offset: Sequence[float] = (0, 0)
) -> Element:
    lens: list[Node] = [prop("float", "fov", names.use("fov")), prop("string", "fov_axis", "x")]
    lens += [prop("float", f"principal_point_offset_{a}", format_numbers([v])) for a, v in zip("xy", offset) if v]
    near, far = (format_numbers([distance]) for distance in clip_distances(scene.extent, scene.unit))
    film = _film(names.use("width"), names.use("height"))
    clip = [prop("float", "near_clip", near), prop("float", "far_clip", far)]
    return element("sensor", *lens, *clip, pose, _sampler(names), film, type="perspective", id=names(name))


def _film(width: str, height: str) -> Element:
    return element(
        "film",
        prop("integer", "width", width),
        prop("integer", "height", height),
        element("rfilter", type="box"),
        prop("string", "component_format", "float32"),
        prop("string", "pixel_format", "rgb"),
        type="hdrfilm",
    )


def _sampler(names: _SceneNames) -> Element:
    return element("sampler", prop("integer", "sample_count", names.use("spp")), type="independent")


def _look(origin: str, target: str, up: str) -> Element:
    return transform(element("lookat", origin=origin, target=target, up=up))


def _up(eye: LookAt, names: _SceneNames) -> str:
    return names.use("up") if eye.up is None else format_numbers(eye.up)


def free_default_name(name: str, taken: frozenset[str]) -> str:
    """The `<default>` of a written scene that is called ``name`` where no other file has ``taken`` that name."""
    return f"nerg_{name}" if name in taken else name


def relative_path(path: Path, folder: Path) -> str:
    """``path`` as a scene file in ``folder`` names it: relative where both lie below a common folder, else absolute."""
    path, folder = Path(os.path.realpath(path)), Path(os.path.realpath(folder))
    common = os.path.commonpath([path, folder])
    return os.path.relpath(path, folder) if common != os.path.dirname(common) else str(path)
