"""The place of a written scene: which files are what, photos with their cameras, and meshes, volumes and fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import MissingFile, NergError, sanitize
from nerg_mi.files.safe_read import translate_read_errors, resolve_path, check_regular_file
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.fields import matches_checksum
from nerg_mi.formats.meshes import DEFAULT_GREY, READERS, MeshFile, read_mesh_file
from nerg_mi.formats.splats import is_splat_file, choose_plugin, read_splats, refuse_unsupported_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Similarity
from nerg_mi.photos.colmap import find_pose_source
from nerg_mi.photos.images import read_photo, read_posed_images
from nerg_mi.photos.posed import PosedFrame, PosedImages
from nerg_mi.rays.dataset import is_dataset, load_rays
from nerg_mi.rendering.files import check_vol, write_mesh
from nerg_mi.rendering.nested_scene import nest_scene
from nerg_mi.rendering.scene_writer import (
    Comment,
    LookAt,
    Lens,
    Node,
    SceneContent,
    element,
    prop,
    relative_path,
    check_attribute,
)
from nerg_mi.train.geometry import DEFAULT_DEPTH, shade_hits

from .base import Reporter
from .geometry import read_training_alignment, find_training_file, geometry_key

# ---- What the files are that a scene is written for, found from the files themselves ----

KINDS = {".npz": "rays", ".parquet": "rays", **dict.fromkeys(READERS, "mesh"), ".vol": "hits", ".xml": "scene"}
"""Suffixes of what is not a checkpoint, and what they hold."""

_SOME = 4096
"""Rays of a dataset that tell whether it has hit points."""

PLACES = ("field", "mesh", "hits", "scene")


@dataclass(frozen=True)
class InputFiles:
    """``place``: the file that shows where people are, of ``kind`` "field", "mesh", "hits", "scene", or None and "none"
    where nothing is known of it; ``gaze``, ``rays``: files or None; ``about``: provenance of the gaze field;
    ``field_about``: metadata of the radiance field; of Gaussian splats, which are a field as well, there are none."""

    place: Path | None
    kind: str
    gaze: Path | None
    rays: Path | None
    about: dict
    field_about: dict

    @property
    def splats(self) -> bool:
        """Whether the field is one of Gaussian splats."""
        return self.kind == "field" and self.place is not None and is_splat_file(self.place)

    @property
    def align(self) -> Similarity:
        """From the rays to the place, as the gaze field was trained."""
        return read_training_alignment(self.about)


def detect_kind(path: Path) -> str:
    """What ``path`` holds: "field", "gaze", or a value of `KINDS`. Raises `NergError` for anything else."""
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    if is_dataset(path):
        return "rays"
    check_regular_file(path)
    suffix = path.suffix.lower()
    if suffix == ".safetensors":
        kind = read_metadata(path).get("kind")
        if kind not in ("radiance", "gaze"):
            raise NergError(f'"{path}" holds a {sanitize(kind, 40)} field; a scene shows radiance and gaze fields')
        return {"radiance": "field", "gaze": "gaze"}[kind]
    if is_splat_file(path):
        return "field"
    refuse_unsupported_splats(path)
    if suffix in (".pth", ".pt"):
        raise NergError(f'"{path}" is a checkpoint of torch; make fields of it with "nerg import"')
    if suffix not in KINDS:
        raise NergError(
            f"a scene is written for checkpoints (.safetensors), splats, rays and datasets of them, meshes and scenes "
            f'({", ".join(KINDS)}), and "{path}" is none of these'
        )
    return KINDS[suffix]


def recognise(files: Sequence[Path], geometry: str | None, reporter: Reporter) -> InputFiles:
    """What ``files`` are, and the place that a gaze field without one was trained in, found beside it by its name.

    ``geometry``: "hits" or "none", of rays alone; None: hits where there are any. A place of rays' hit points that has
    to be made yet is of kind "hits" without a file. Raises `NergError` for what does not make a scene.
    """
    if geometry not in (None, "hits", "none"):
        raise NergError(f'--geometry must be "hits" or "none", got "{geometry}"')
    found: dict[str, tuple[str, Path]] = {}
    for path in files:
        kind = detect_kind(path)
        role = "place" if kind in PLACES else kind
        if role in found:
            raise NergError(f'"{found[role][1]}" and "{path}" are both a {role}; a scene has one of them')
        found[role] = kind, path
    if not found:
        raise NergError("a scene needs a field, a mesh, a scene file, a gaze field or rays; name one at least")
    gaze, rays = (found[role][1] if role in found else None for role in ("gaze", "rays"))
    about = {} if gaze is None else read_metadata(gaze).get("provenance", {})
    kind, place = found.get("place", ("none", None))
    if place is not None and geometry is not None:
        raise NergError(f'--geometry says what rays alone are shown in, and there is "{place}"; leave out one of them')
    if place is not None and gaze is not None:
        _compare(place, gaze, about, reporter)
    elif gaze is not None:
        kind, place = _trained_in(gaze, about)
    elif place is None:
        kind = geometry or ("hits" if _have_hits(rays) else "none")
    trained = kind == "field" and place is not None and not is_splat_file(place)
    field_about = read_metadata(place) if trained and place is not None else {}
    return InputFiles(place, kind, gaze, rays, about, field_about)


def _trained_in(gaze: Path, about: dict) -> tuple[str, Path | None]:
    """The place that the ``gaze`` field was trained in."""
    if about.get("geometry") == "none":
        return "none", None
    try:
        key = geometry_key(gaze, about)
    except NergError as error:
        raise NergError(f"{error}; name its place, too: nerg scene PLACE GAZE") from error
    path = find_training_file(
        gaze,
        about,
        None,
        "put it beside the gaze field, or name the file: nerg scene PLACE GAZE",
        "name that one: nerg scene PLACE GAZE",
    )
    kinds = {"field_file": "field", "scene_file": KINDS.get(path.suffix.lower(), "scene"), "geometry_file": "hits"}
    return kinds[key], path


def _compare(place: Path, gaze: Path, about: dict, reporter: Reporter) -> None:
    """Warn where a gaze field is to be shown in another place than that of its training."""
    known = _place_file(about)
    if known is None:
        if about.get("geometry") == "none":
            reporter.warn(f'"{gaze}" was trained without a place; surfaces of "{place}" are not where it takes them')
        return
    if not matches_checksum(place, known.get("sha256")):
        reporter.warn(
            f'"{gaze}" was trained in another file than "{place}", {sanitize(known.get("file"), 80)}; gaze is right only '
            "where surfaces and coordinates are the same"
        )


def find_training_scene(about: dict) -> str | None:
    """The checksum of the file of the place that a gaze field was trained in, by its provenance ``about``; None where
    there was none."""
    known = _place_file(about)
    return None if known is None else known.get("sha256")


def _place_file(about: dict) -> dict | None:
    return next((about[k] for k in ("field_file", "scene_file", "geometry_file") if k in about), None)


def _have_hits(rays: Path | None) -> bool:
    import numpy as np

    if rays is None:
        return False
    hit = load_rays(rays, max_rays=_SOME).hit
    return hit is not None and bool(np.isfinite(hit).all(axis=1).any())


# ---- The cameras of photos that a radiance field was trained on, in the field's coordinates ----


@dataclass(frozen=True)
class PhotoCamera:
    """``eye`` and ``lens`` of the photo ``name``; ``bent``: whether its lens distorts, which no such camera does."""

    name: str
    eye: LookAt
    lens: Lens
    bent: bool


def load_photo_camera(photos: Path, photo: str, provenance: dict, allow_outside: bool = False) -> PhotoCamera:
    """The camera of the ``photo`` (its name, or its number from 0 on) of the data set ``photos``.

    ``provenance``: of the radiance field, which says in which coordinates it was trained. Raises `NergError` for
    photos that it was not trained on and for one that is not among them.
    """
    return _camera(_frame(_posed(photos, provenance, allow_outside), photo))


def load_photo_cameras(
    photos: Path, provenance: dict, allow_outside: bool = False, most: int = 200
) -> list[PhotoCamera]:
    """The cameras of the data set ``photos``, of ``most`` of them at most, evenly chosen; otherwise as
    `camera_of_photo`."""
    frames = _posed(photos, provenance, allow_outside).frames
    return [_camera(f) for f in frames[:: -(-len(frames) // most)]]


def _posed(photos: Path, provenance: dict, allow_outside: bool) -> PosedImages:
    posed = read_posed_images(find_pose_source(photos), allow_outside)
    if "sha256" in provenance and provenance["sha256"] != posed.sha256:
        raise NergError(f'"{posed.path}" is not what the field was trained on; give those photos with --photos')
    if "to_file" in provenance:
        posed = posed.transform(np.linalg.inv(np.asarray(provenance["to_file"], np.float64)))
    return posed


def _camera(frame: PosedFrame) -> PhotoCamera:
    lens = frame.lens
    size = (round(lens["w"]), round(lens["h"])) if "w" in lens and "h" in lens else _size(frame)
    i = frame.intrinsics(*size)
    origin = frame.to_world[:3, 3]
    # OpenGL cameras look along -z, with y up.
    ahead, up = -frame.to_world[:3, 2], frame.to_world[:3, 1]
    offset = (float(0.5 - i.cx / i.width), float(0.5 - i.cy / i.height))
    taken = Lens(float(np.degrees(2 * np.arctan(i.width / (2 * i.fx)))), i.width / i.height, offset)
    return PhotoCamera(frame.name, LookAt(origin, origin + ahead, up), taken, i.is_distorted)


def _size(frame: PosedFrame) -> tuple[int, int]:
    height, width = read_photo(frame).shape[:2]
    return width, height


def _frame(posed: PosedImages, photo: str) -> PosedFrame:
    frames = posed.frames
    for f in frames:
        if photo in (f.name, f.image.name, f.image.stem):
            return f
    if photo.isdecimal() and int(photo) < len(frames):
        return frames[int(photo)]
    raise NergError(
        f'there is no photo "{sanitize(photo, 80)}" in "{posed.path}": give --photo a number from 0 to {len(frames) - 1}, '
        f'or a name such as "{sanitize(frames[0].name, 80)}"'
    )


# ---- Each kind of place as a part of a written scene ----

LAMP = 2.5
"""Intensity of a lamp at distance 1 from what it is to light well: about half of white on grey."""


@dataclass(frozen=True)
class WrittenGeometry:
    """A place for a scene file in a folder: ``make(folder, lamps)`` gives its parts, with names of files as that folder
    has them and, where it has no light of its own, with lamps at ``$camera`` and ``$eye`` (names of `<default>`s) of
    that intensity. ``words``: what it is, for a comment; ``contracted``: whether it has no end; ``files`` written;
    ``notes`` on its file: sentences on what is not used, and on what was guessed."""

    make: Callable[[Path, dict[str, float]], SceneContent]
    words: str
    contracted: bool = False
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def write_scene_geometry(given: InputFiles, output: Path) -> WrittenGeometry:
    """The place in ``given``; what has to be written for it stands beside ``output``: the colours of hit points, and a
    mesh that Mitsuba does not show as it is.

    Raises `NergError` for files that cannot be used.
    """
    if given.kind == "field":
        contracted = "reach" in given.field_about.get("box", {})
        # A file that cannot be used is refused before a scene names it.
        splats = read_splats(_file(given)) if given.splats else None
        notes = () if splats is None else (*splats.assumptions, *splats.notes)
        make = lambda folder, lamps: _field(_file(given), folder)
        return WrittenGeometry(make, _words(given), contracted, notes=notes)
    if given.kind == "mesh":
        return _mesh(_file(given), output, _words(given))
    if given.kind == "scene":
        path = _file(given)
        nest_scene(path, output.parent)
        return WrittenGeometry(lambda folder, lamps: nest_scene(path, folder), _words(given))
    if given.kind == "hits":
        return _hits(_file(given), output, _words(given))
    return WrittenGeometry(lambda folder, lamps: _nowhere(lamps), _words(given))


def _words(given: InputFiles) -> str:
    name = "" if given.place is None else given.place.name
    if given.splats:
        return f"The Gaussian splats {name}"
    return {
        "field": f"The radiance field {name}",
        "mesh": f"The mesh {name}",
        "scene": f"The scene {name}",
        "hits": f"The hit points of rays in {name}, in greys by the way in which a surface faces",
        "none": "Nothing is known of the place: a sphere around the observer shows directions, in cells of 15 degrees",
    }[given.kind]


def _file(given: InputFiles) -> Path:
    assert given.place is not None
    return given.place


def _name(path: Path, folder: Path) -> str:
    return check_attribute(relative_path(path, folder))


def _field(path: Path, folder: Path) -> SceneContent:
    volume = element("volume", prop("string", "filename", "$field"), name="field", type=choose_plugin(path))
    return SceneContent(integrator_children=(volume,), files={"field": _name(path, folder)})


def mesh_path(output: Path) -> Path:
    """The file of a mesh that Mitsuba does not show as it is, beside the scene file ``output``."""
    return output.with_name(f"{output.stem}.mesh.ply")


def _mesh(path: Path, output: Path, words: str) -> WrittenGeometry:
    mesh, shown = read_mesh_file(path), path
    if not mesh.is_readable_by_mitsuba:
        shown = mesh_path(output)
        if resolve_path(shown) == resolve_path(path):
            raise NergError(f'"{path}" would be written over by what Mitsuba shows of it; give the scene another name')
        write_mesh(shown, mesh)
    kind = shown.suffix.lower().lstrip(".")
    color = _mesh_color(mesh)
    light = element("integrator", prop("integer", "max_depth", 5), type="path")

    def make(folder: Path, lamps: dict[str, float]) -> SceneContent:
        bsdf = element("bsdf", element("bsdf", color, type="diffuse"), type="twosided")
        shape = element("shape", prop("string", "filename", "$place"), bsdf, type=kind, id="place")
        return SceneContent(
            integrator_children=(Comment("What lights the shape."), light),
            scene_children=(
                shape,
                Comment("A mesh brings no light: lamps where the camera and the observer are."),
                *_lamps(lamps),
            ),
            files={"place": _name(shown, folder)},
            spp=64,
        )

    return WrittenGeometry(make, words, files=() if mesh.is_readable_by_mitsuba else (shown,), notes=mesh.notes)


def _mesh_color(mesh: MeshFile) -> Node:
    """The mesh's own colours, or grey."""
    if mesh.colors is None and mesh.face_colors is None:
        return prop("rgb", "reflectance", DEFAULT_GREY)
    name = "face_color" if mesh.colors is None else "vertex_color"
    return element("texture", prop("string", "name", name), name="reflectance", type="mesh_attribute")


def _lamps(lamps: dict[str, float]) -> list[Node]:
    return [
        element(
            "emitter",
            element("point", name="position", value=f"${name}"),
            prop("rgb", "intensity", f"{intensity:.4g}"),
            type="point",
        )
        for name, intensity in lamps.items()
    ]


def colors_path(output: Path) -> Path:
    """The file of the colours of hit points, beside the scene file ``output``."""
    return output.with_name(f"{output.stem}.color.vol")


def _hits(path: Path, output: Path, words: str) -> WrittenGeometry:
    check_vol(path)
    colors = colors_path(output)
    with translate_read_errors(path, "place of hit points"):
        shape = np.fromfile(path, "<i4", 4, offset=8)
        lower, upper = np.fromfile(path, "<f4", 6, offset=24).astype(float).reshape(2, 3)
        density = np.fromfile(path, "<f4", int(np.prod(shape, dtype=np.int64)), offset=48)
    if shape[3] != 1 or not (np.isfinite([lower, upper]).all() and (lower < upper).all()):
        raise NergError(f'"{path}" is no place of hit points; give one that "nerg train gaze --geometry hits" wrote')
    color, end = shade_hits(density.reshape(shape[2], shape[1], shape[0]), lower, upper)
    write_volume(colors, color, lower, end)

    def make(folder: Path, lamps: dict[str, float]) -> SceneContent:
        # As `train.geometry.volume_dict` has it: interpolation would bring every surface nearer.
        nearest, box = prop("string", "filter_type", "nearest"), prop("boolean", "use_grid_bbox", "true")
        density = element(
            "volume", prop("string", "filename", "$density"), box, nearest, name="density", type="gridvolume"
        )
        file = prop("string", "filename", "$color")
        raw = prop("boolean", "raw", "true")
        color = element("volume", file, box, raw, name="color", type="gridvolume")
        return SceneContent(
            integrator_children=(density, color), files={"density": _name(path, folder), "color": _name(colors, folder)}
        )

    return WrittenGeometry(make, words, files=(colors,))


def _nowhere(lamps: dict[str, float]) -> SceneContent:
    cells = element(
        "texture",
        prop("rgb", "color0", 0.24),
        prop("rgb", "color1", 0.32),
        element("transform", element("scale", x=12, y=6), name="to_uv"),
        name="reflectance",
        type="checkerboard",
    )
    sphere = element(
        "shape",
        element("point", name="center", value=f"${next(iter(lamps))}"),
        prop("float", "radius", f"{DEFAULT_DEPTH:g}"),
        prop("boolean", "flip_normals", "true"),
        element("bsdf", cells, type="diffuse"),
        type="sphere",
        id="nowhere",
    )
    return SceneContent(scene_children=(sphere,), spp=16)
