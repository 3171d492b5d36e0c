"""Geometry of a written scene: input files, cameras of photos, and fields, meshes and volumes as scene elements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.environment.environment import DEFAULT_DEPTH
from nerg_mi.environment.hits import shade_hits
from nerg_mi.environment.kinds import ENVIRONMENTS, KINDS, detect_kind
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import resolve_path, translate_read_errors
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.fields import matches_checksum
from nerg_mi.formats.meshes import DEFAULT_GREY, MeshFile, read_mesh_file, with_shading_normals
from nerg_mi.formats.splats import choose_plugin, is_splat_file, read_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import invert_similarity
from nerg_mi.photos.colmap import find_pose_source
from nerg_mi.photos.images import read_photo, read_posed_images
from nerg_mi.photos.posed import PosedFrame, PosedImages
from nerg_mi.progress import Reporter
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rendering.files import check_vol, write_mesh
from nerg_mi.rendering.nested_scene import GAZE_PROPERTIES, nest_scene
from nerg_mi.rendering.scene_writer import (
    Comment,
    Lens,
    LookAt,
    Node,
    SceneContent,
    check_attribute,
    element,
    prop,
    relative_path,
)
from nerg_mi.train.geometry_files import find_training_file, geometry_key, read_training_alignment
from nerg_mi.transport.geometry import HEADLIGHT

# ---- Input files, recognised by their content ----

_SOME = 4096
"""Number of rays of a dataset that are checked for hit points."""


@dataclass(frozen=True)
class InputFiles:
    """Input files of a scene.

    Attributes
    ----------
    environment
        File of the geometry, or None.
    kind
        Its kind: "field", "mesh", "hits", "scene", or "none" without geometry.
    gaze, rays
        Files, or None.
    gaze_provenance
        Provenance of the gaze field.
    field_metadata
        Metadata of the radiance field; empty for Gaussian splats.
    """

    environment: Path | None
    kind: str
    gaze: Path | None
    rays: Path | None
    gaze_provenance: dict
    field_metadata: dict

    @property
    def splats(self) -> bool:
        """Whether the field consists of Gaussian splats."""
        return self.kind == "field" and self.environment is not None and is_splat_file(self.environment)

    @property
    def align(self) -> Similarity:
        """Transform from the rays to the scene, as in the training of the gaze field."""
        return read_training_alignment(self.gaze_provenance)


def recognise(files: Sequence[Path], geometry: str | None, reporter: Reporter) -> InputFiles:
    """Detect the kind of each of ``files``. If they contain a gaze field and no geometry, use the geometry file of its
    training, which must be in the folder of the gaze field.

    ``geometry`` is "hits" or "none" for rays alone; None uses hit points if there are any. A geometry of hit points
    that still has to be built has kind "hits" and no file. Raises `NergError` for files that do not make a scene.
    """
    if geometry not in (None, "hits", "none"):
        raise NergError(f'{parameter("geometry")} must be "hits" or "none", got "{geometry}"')
    by_role: dict[str, tuple[str, Path]] = {}
    for path in files:
        kind = detect_kind(path)
        role = "environment" if kind in ENVIRONMENTS else kind
        if role in by_role:
            raise NergError(
                f'"{by_role[role][1]}" and "{path}" have the same role ({role}), and a scene can have one of each'
            )
        by_role[role] = kind, path
    if not by_role:
        raise NergError("a scene needs a field, a mesh, a scene file, a gaze field or rays; name at least one")
    gaze, rays = (by_role[role][1] if role in by_role else None for role in ("gaze", "rays"))
    provenance = {} if gaze is None else read_metadata(gaze).get("provenance", {})
    kind, environment = by_role.get("environment", ("none", None))
    if environment is not None and geometry is not None:
        raise NergError(
            f'{parameter("geometry")} applies to rays alone, and there is "{environment}"; leave out one of them'
        )
    if gaze is not None and geometry is not None:
        raise NergError(
            f'{parameter("geometry")} applies to rays alone, and "{gaze}" is shown in the geometry of its '
            "training; leave it out"
        )
    if environment is not None and gaze is not None:
        _compare(environment, gaze, provenance, reporter)
    elif gaze is not None:
        kind, environment = _find_training_geometry(gaze, provenance)
    elif environment is None:
        kind = geometry or ("hits" if _have_hits(rays) else "none")
    trained = kind == "field" and environment is not None and not is_splat_file(environment)
    field_metadata = read_metadata(environment) if trained and environment is not None else {}
    return InputFiles(environment, kind, gaze, rays, provenance, field_metadata)


def _find_training_geometry(gaze: Path, provenance: dict) -> tuple[str, Path | None]:
    """Return kind and file of the geometry that the ``gaze`` field was trained in."""
    if provenance.get("geometry") == "none":
        return "none", None
    try:
        key = geometry_key(gaze, provenance)
    except NergError as error:
        raise NergError(f"{error}; also name its scene: nerg scene SCENE GAZE") from error
    path = find_training_file(
        gaze,
        provenance,
        None,
        "move it next to the gaze field, or name the file: nerg scene SCENE GAZE",
        "name the right file: nerg scene SCENE GAZE",
    )
    kinds = {"field_file": "field", "scene_file": KINDS.get(path.suffix.lower(), "scene"), "geometry_file": "hits"}
    return kinds[key], path


def _compare(environment: Path, gaze: Path, provenance: dict, reporter: Reporter) -> None:
    """Warn if a gaze field is shown in a scene other than that of its training."""
    trained_file = _environment_file(provenance)
    if trained_file is None:
        if provenance.get("geometry") == "none":
            reporter.warn(
                f'"{gaze}" was trained without geometry; the surfaces of "{environment}" are not where it assumes them'
            )
        return
    if not matches_checksum(environment, trained_file.get("sha256")):
        reporter.warn(
            f'"{gaze}" was not trained in "{environment}" but in {sanitize(trained_file.get("file"), 80)}; its gaze is '
            "valid only if surfaces and coordinates are the same"
        )


def find_training_scene(provenance: dict) -> str | None:
    """Return the checksum of the geometry file of a gaze field with this ``provenance``, or None."""
    trained_file = _environment_file(provenance)
    return None if trained_file is None else trained_file.get("sha256")


def _environment_file(provenance: dict) -> dict | None:
    return next((provenance[k] for k in ("field_file", "scene_file", "geometry_file") if k in provenance), None)


def _have_hits(rays: Path | None) -> bool:
    import numpy as np

    if rays is None:
        return False
    hit = load_rays(rays, max_rays=_SOME).hit
    return hit is not None and bool(np.isfinite(hit).all(axis=1).any())


# ---- Cameras of photos, in the coordinates of the radiance field ----


@dataclass(frozen=True)
class PhotoCamera:
    """``eye`` and ``lens`` of the photo ``name``. ``has_distortion``: its lens has distortion, which is ignored."""

    name: str
    eye: LookAt
    lens: Lens
    has_distortion: bool


def load_photo_camera(photos: Path, photo: str, provenance: dict, allow_outside: bool = False) -> PhotoCamera:
    """Return the camera of a ``photo`` (its name, or its number from 0) of the data set ``photos``.

    ``provenance`` is that of the radiance field and defines the coordinates. Raises `NergError` for photos other than
    those of the training, and for an unknown photo.
    """
    return _camera(_frame(_posed(photos, provenance, allow_outside), photo))


def load_photo_cameras(
    photos: Path, provenance: dict, allow_outside: bool = False, max_count: int = 200
) -> list[PhotoCamera]:
    """Return the cameras of at most ``max_count`` evenly selected photos, otherwise like `load_photo_camera`."""
    frames = _posed(photos, provenance, allow_outside).frames
    return [_camera(f) for f in frames[:: -(-len(frames) // max_count)]]


def _posed(photos: Path, provenance: dict, allow_outside: bool) -> PosedImages:
    posed = read_posed_images(find_pose_source(photos), allow_outside)
    if "sha256" in provenance and provenance["sha256"] != posed.sha256:
        raise NergError(
            f'the field was not trained on "{posed.path}"; give the photos of its training with {parameter("photos")}'
        )
    if "to_file" in provenance:
        posed = posed.transform(invert_similarity(provenance["to_file"], '"to_file" of the field'))
    return posed


def _camera(frame: PosedFrame) -> PhotoCamera:
    lens = frame.lens
    size = (round(lens["w"]), round(lens["h"])) if "w" in lens and "h" in lens else _size(frame)
    i = frame.intrinsics(*size)
    origin = frame.to_world[:3, 3]
    # OpenGL cameras look along -z, y up.
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
        f'there is no photo "{sanitize(photo, 80)}" in "{posed.path}": give {parameter("photo")} a number from 0 '
        f'to {len(frames) - 1}, or a name such as "{sanitize(frames[0].name, 80)}"'
    )


# ---- Scene elements for each kind of geometry ----

NO_DATA_GREY = 0.65
"""Grey behind hit points, so that their gaps are not mistaken for dark surfaces."""


@dataclass(frozen=True)
class WrittenGeometry:
    """Geometry of a scene file.

    Attributes
    ----------
    make
        ``make(folder, center)`` returns its scene elements, with file names relative to that folder; ``center`` names
        the `<default>` of the observer's position.
    words
        Description for a comment.
    contracted
        Whether it is unbounded.
    files
        Written files.
    notes
        Sentences on its file: what is not used, and what was guessed.
    """

    make: Callable[[Path, str], SceneContent]
    words: str
    contracted: bool = False
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def write_scene_geometry(inputs: InputFiles, output: Path) -> WrittenGeometry:
    """Return the scene elements of the geometry in ``inputs``.

    Additional files are written next to ``output``: the colours of hit points, and a mesh that Mitsuba cannot show as
    it is. Raises `NergError` for unusable files.
    """
    if inputs.kind == "field":
        contracted = "reach" in inputs.field_metadata.get("box", {})
        # Unusable files are rejected before a scene refers to them.
        splats = read_splats(_file(inputs)) if inputs.splats else None
        notes = () if splats is None else (*splats.assumptions, *splats.notes)
        make = lambda folder, center: _field(_file(inputs), folder)
        return WrittenGeometry(make, _describe_geometry(inputs), contracted, notes=notes)
    if inputs.kind == "mesh":
        return _mesh(_file(inputs), output, _describe_geometry(inputs))
    if inputs.kind == "scene":
        path = _file(inputs)
        left_out = [name for name in nest_scene(path, output.parent).left_out if name != "aovs"]
        # Gaze is replaced, and never only lost.
        replaced_by = dict(zip(GAZE_PROPERTIES, (inputs.gaze, inputs.gaze or inputs.rays)))
        lost = next((name for name in left_out if name in replaced_by and replaced_by[name] is None), None)
        if lost is not None:
            raise NergError(
                f'"{path}" already has the "{lost}" of an observer; use it as it is, or also name the gaze field to '
                "show in its place"
            )
        notes = (f"not used of its integrator: {', '.join(left_out)}",) if left_out else ()
        make = lambda folder, center: nest_scene(path, folder)
        return WrittenGeometry(make, _describe_geometry(inputs), notes=notes)
    if inputs.kind == "hits":
        return _hits(_file(inputs), output, _describe_geometry(inputs))
    return WrittenGeometry(lambda folder, center: _direction_sphere(center), _describe_geometry(inputs))


def _describe_geometry(inputs: InputFiles) -> str:
    name = "" if inputs.environment is None else inputs.environment.name
    if inputs.splats:
        return f"The Gaussian splats {name}"
    return {
        "field": f"The radiance field {name}",
        "mesh": f"The mesh {name}",
        "scene": f"The scene {name}",
        "hits": f"The hit points of rays in {name}, in grey shaded by surface orientation",
        "none": "There is no geometry: a sphere around the observer shows directions, in cells of 15 degrees",
    }[inputs.kind]


def _file(inputs: InputFiles) -> Path:
    assert inputs.environment is not None
    return inputs.environment


def _name(path: Path, folder: Path) -> str:
    return check_attribute(relative_path(path, folder))


def _field(path: Path, folder: Path) -> SceneContent:
    volume = element("volume", prop("string", "filename", "$field"), name="field", type=choose_plugin(path))
    return SceneContent(integrator_children=(volume,), files={"field": _name(path, folder)})


def mesh_path(output: Path) -> Path:
    """Return the file next to the scene ``output`` for a mesh that Mitsuba cannot show as it is."""
    return output.with_name(f"{output.stem}.mesh.ply")


def _mesh(path: Path, output: Path, words: str) -> WrittenGeometry:
    mesh, shown = read_mesh_file(path), path
    shaded = with_shading_normals(mesh)
    if not mesh.is_readable_by_mitsuba or shaded is not mesh:
        shown = mesh_path(output)
        if resolve_path(shown) == resolve_path(path):
            raise NergError(f'"{path}" would be overwritten by a converted mesh; give the scene another name')
        write_mesh(shown, shaded)
    kind = shown.suffix.lower().lstrip(".")
    color = _mesh_color(mesh)

    def make(folder: Path, center: str) -> SceneContent:
        bsdf = element("bsdf", element("bsdf", color, type="diffuse"), type="twosided")
        shape = element("shape", prop("string", "filename", "$place"), bsdf, type=kind, id="place")
        headlight = Comment("Without emitters, a headlight shows the mesh."), prop("float", "headlight", HEADLIGHT)
        return SceneContent(
            integrator_children=headlight, scene_children=(shape,), files={"place": _name(shown, folder)}
        )

    return WrittenGeometry(make, words, files=() if shown is path else (shown,), notes=mesh.notes)


def _mesh_color(mesh: MeshFile) -> Node:
    """Return the colours of the mesh, or grey."""
    if mesh.colors is None and mesh.face_colors is None:
        return prop("rgb", "reflectance", DEFAULT_GREY)
    name = "face_color" if mesh.colors is None else "vertex_color"
    return element("texture", prop("string", "name", name), name="reflectance", type="mesh_attribute")


def colors_path(output: Path) -> Path:
    """Return the file next to the scene ``output`` for the colours of hit points."""
    return output.with_name(f"{output.stem}.color.vol")


def shade_hit_volume(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the colours (z, y, x, 3) of the hit-point volume ``path``, and the lower and upper corner of their box.

    Raises `NergError` for other files.
    """
    check_vol(path)
    with translate_read_errors(path, "volume of hit points"):
        shape = np.fromfile(path, "<i4", 4, offset=8)
        lower, upper = np.fromfile(path, "<f4", 6, offset=24).astype(float).reshape(2, 3)
        density = np.fromfile(path, "<f4", int(np.prod(shape, dtype=np.int64)), offset=48)
    if shape[3] != 1 or not (np.isfinite([lower, upper]).all() and (lower < upper).all()):
        raise NergError(
            f'"{path}" is not a volume of hit points; give one that "nerg train gaze --geometry hits" has written'
        )
    color, end = shade_hits(density.reshape(shape[2], shape[1], shape[0]), lower, upper)
    return color, lower, end


def _hits(path: Path, output: Path, words: str) -> WrittenGeometry:
    color, lower, end = shade_hit_volume(path)
    colors = colors_path(output)
    write_volume(colors, color, lower, end)

    def make(folder: Path, center: str) -> SceneContent:
        # Interpolation rounds the edges of voxels; it moves surfaces by less than half a voxel from where a training
        # looked for them (`nerg_mi.environment.hits.make_volume_dict`).
        box = prop("boolean", "use_grid_bbox", "true")
        density = element("volume", prop("string", "filename", "$density"), box, name="density", type="gridvolume")
        file = prop("string", "filename", "$color")
        raw = prop("boolean", "raw", "true")
        color = element("volume", file, box, raw, name="color", type="gridvolume")
        return SceneContent(
            integrator_children=(density, color, prop("rgb", "background", NO_DATA_GREY)),
            files={"density": _name(path, folder), "color": _name(colors, folder)},
        )

    return WrittenGeometry(make, words, files=(colors,))


def _direction_sphere(center: str) -> SceneContent:
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
        element("point", name="center", value=f"${center}"),
        prop("float", "radius", f"{DEFAULT_DEPTH:g}"),
        prop("boolean", "flip_normals", "true"),
        element("bsdf", cells, type="diffuse"),
        type="sphere",
        id="nowhere",
    )
    return SceneContent(scene_children=(sphere,), spp=16)
