"""What a scene is made of: meshes, volumes and fields in memory or in files, as objects of Mitsuba and as a scene file.

The content of a scene is a dict as for `mi.load_dict`, in which values may also be a `MeshFile`, a `FieldVolume` or a
`GridVolume`. `load_content` makes Mitsuba's objects of them in memory, and `write_content` files next to a scene file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, clean_text, parameter, translate_mitsuba_errors
from nerg_mi.fields.splats import Splats
from nerg_mi.files.atomic import check_writable, make_folder, replace_atomically, write_text
from nerg_mi.files.html import Summary
from nerg_mi.files.names import make_portable_name
from nerg_mi.files.values import to_numbers
from nerg_mi.formats.meshes import MeshFile, read_mesh_file, with_shading_normals
from nerg_mi.formats.splats import choose_plugin, write_ply_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.transforms import check_rigid_transforms
from nerg_mi.properties import resolve_scene_file
from nerg_mi.registration import PLUGINS, get_plugin_class
from nerg_mi.tracking.rays import Rays

from .rendering_files import check_mesh, read_vol, write_mesh
from .scene_writer import (
    Element,
    Node,
    check_attribute,
    element,
    format_document,
    format_numbers,
    matrix,
    prop,
    relative_path,
    transform,
)
from .trained import TrainedField

if TYPE_CHECKING:
    import trimesh

# ---- Grids of densities ----


@dataclass(frozen=True, eq=False, repr=False)
class DensityGrid(Summary):
    """An environment as a grid of densities.

    Parameters
    ----------
    density : array_like of shape (Z, Y, X)
        Density of each cell in 1/scene unit, 0 or more. The order of the axes is that of Mitsuba's volumes.
    lower, upper : array_like of shape (3,)
        Corners of the box that the grid fills, x, y, z in scene units.
    color : array_like of shape (Z, Y, X, 3), optional
        Linear colour from 0 to 1. Default: grey.

    Raises
    ------
    NergError
        A shape is wrong, a value is not finite or negative, or the box is empty.

    Examples
    --------
    >>> import nerg_mi as nerg, numpy as np
    >>> cloud = nerg.DensityGrid(np.full((2, 3, 4), 5.0), lower=(0, 0, 0), upper=(4, 3, 2))
    >>> scene = nerg.make_scene(cloud, camera=nerg.Camera((-2, 1.5, 1), (2, 1.5, 1), width=9, height=6))
    >>> bool(nerg.render(scene, quantities="opacity", spp=1).opacity[0, 3, 4] > 0.99)
    True
    """

    density: ArrayLike
    lower: ArrayLike
    upper: ArrayLike
    color: ArrayLike | None = None

    def __post_init__(self) -> None:
        for name in ("density", "lower", "upper", "color"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, to_numbers(value, f"{name} of a DensityGrid", np.float32))
        shapes = {"density": 3, "lower": 1, "upper": 1} | ({} if self.color is None else {"color": 4})
        for name, dimensions in shapes.items():
            array = np.asarray(getattr(self, name))
            if array.ndim != dimensions or not array.size or not np.isfinite(array).all():
                raise NergError(
                    f"{name} of a DensityGrid must be {dimensions}-dimensional and finite, got {array.shape}"
                )
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        if lower.shape != (3,) or upper.shape != (3,) or not (lower < upper).all():
            raise NergError(
                f"lower must be below upper on each of three axes, got {lower.tolist()} and {upper.tolist()}"
            )
        if (np.asarray(self.density) < 0).any():
            raise NergError("density of a DensityGrid must not be negative")
        if self.color is not None and np.shape(self.color)[-1] != 3:
            raise NergError(f"color of a DensityGrid must have the shape (Z, Y, X, 3), got {np.shape(self.color)}")

    def __repr__(self) -> str:
        z, y, x = np.shape(self.density)
        lower, upper = (", ".join(f"{v:.4g}" for v in np.asarray(c).tolist()) for c in (self.lower, self.upper))
        return f"<DensityGrid: {x} x {y} x {z} cells, box ({lower}) to ({upper})>"

    @classmethod
    def load(cls, path: str | os.PathLike[str], color: str | os.PathLike[str] | None = None) -> DensityGrid:
        """Load a density, and the ``color`` of another file, from grid volumes of Mitsuba (.vol), as `save` writes
        them. Raises `NergError` for other files."""
        values, lower, upper = read_vol(path)
        if values.shape[-1] != 1:
            raise NergError(f'"{path}" has {values.shape[-1]} channels and is no density')
        return cls(values[..., 0], lower, upper, None if color is None else read_vol(color)[0])

    def save(self, path: str | os.PathLike[str], color: str | os.PathLike[str] | None = None) -> None:
        """Write the density to ``path``, and the colour to ``color``, as grid volumes of Mitsuba (.vol).

        Raises `NergError` if the grid has no colour that is to be written, or a file cannot be written.
        """
        if color is not None and self.color is None:
            raise NergError(f"this DensityGrid has no {parameter('color')} to write")
        for file, values in ((color, self.color), (path, self.density)):
            if file is not None:
                check_writable(Path(file), ".vol")
                write_volume(Path(file), np.asarray(values), self.lower, self.upper)

    def volumes(self, to_world: Any = None) -> dict[str, GridVolume]:
        """Return the properties ``density`` and ``color`` of the integrator ``nerg``."""
        corners = np.asarray(self.lower, float), np.asarray(self.upper, float)
        out = {"density": GridVolume(np.asarray(self.density), *corners, to_world)}
        if self.color is not None:
            out["color"] = GridVolume(np.asarray(self.color), *corners, to_world)
        return out


# ---- Elements that Mitsuba does not know ----


@dataclass(frozen=True, eq=False)
class GridVolume:
    """A grid volume of ``values`` (Z, Y, X) or (Z, Y, X, 3) between two corners (3,) in the frame that ``to_world``
    maps to the scene."""

    values: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    to_world: Any = None

    def load(self) -> dict[str, Any]:
        """Return the volume in memory, as a dict for `mi.load_dict`."""
        import mitsuba as mi

        world: Any = mi.ScalarTransform4d() if self.to_world is None else self.to_world
        in_box = world @ mi.ScalarTransform4d().translate(self.lower.tolist()).scale((self.upper - self.lower).tolist())
        grid = mi.VolumeGrid(np.ascontiguousarray(self.values if self.values.ndim == 4 else self.values[..., None]))
        return {"type": "gridvolume", "grid": grid, "raw": True, "to_world": in_box}

    def place(self, path: Path) -> dict[str, Any]:
        """Write the volume to ``path`` (.vol), and return it as a dict."""
        write_volume(path, self.values, self.lower, self.upper)
        world = {} if self.to_world is None else {"to_world": self.to_world}
        return {"type": "gridvolume", "filename": str(path), "use_grid_bbox": True, "raw": True, **world}


@dataclass(frozen=True, eq=False)
class FieldVolume:
    """A radiance field, a gaze field or splats, as an object or a file, for the property ``role`` of the integrator."""

    field: Any
    role: str
    to_world: Any = None

    @property
    def plugin(self) -> str:
        """Name of the volume plugin."""
        if self.role == "gaze":
            return "gazefield"
        if isinstance(self.field, (str, os.PathLike)):
            return choose_plugin(self.field)
        return "splats" if isinstance(self.field, Splats) else "nerf"

    @property
    def path(self) -> Path | None:
        """The file of the field."""
        if isinstance(self.field, TrainedField):
            return self.field.path
        return Path(self.field) if isinstance(self.field, (str, os.PathLike)) else None

    def load(self) -> Any:
        """Return the volume in memory."""
        if isinstance(self.field, (str, os.PathLike)):
            return self.describe(Path(self.field))
        volume = get_plugin_class(self.plugin)
        if isinstance(self.field, Splats):
            return volume.from_network(self.field, self.to_world)
        return volume.from_network(self.field.network, self.to_world, self.field.name)

    def place(self, path: Path) -> dict[str, Any]:
        """Write the field to ``path``, and return the volume as a dict."""
        if isinstance(self.field, Splats):
            write_ply_splats(path, self.field)
        else:
            self.field.save(path)
        return self.describe(path)

    def describe(self, path: Path) -> dict[str, Any]:
        """Return the volume of the file ``path`` as a dict."""
        world = {} if self.to_world is None else {"to_world": self.to_world}
        return {"type": self.plugin, "filename": os.path.abspath(path), **world}


# ---- Meshes ----


def _bsdf(mesh: MeshFile) -> dict[str, Any]:
    """Return the two-sided material of a mesh: its colours, or grey."""
    colored = mesh.colors is not None or mesh.face_colors is not None
    name = "face_color" if mesh.colors is None else "vertex_color"
    texture = {"reflectance": {"type": "mesh_attribute", "name": name}} if colored else {}
    return {"type": "twosided", "bsdf": {"type": "diffuse", **texture}}


def load_mesh_child(path: str | os.PathLike[str]) -> dict[str, Any] | MeshFile:
    """Load a mesh file as a two-sided child of a scene, with its colours or in grey.

    Unused parts of the file are reported in Mitsuba's log.

    Parameters
    ----------
    path : path-like
        Mesh file.

    Returns
    -------
    dict or MeshFile
        A dict for ``mi.load_dict``; the mesh if Mitsuba cannot read the file as it is.

    Raises
    ------
    NergError
        The file does not exist or is damaged.
    """
    import mitsuba as mi

    mesh = read_mesh_file(path)
    log: Any = mi.Log  # missing in the stubs
    for note in mesh.notes:
        log(mi.LogLevel.Warn, f"{path}: {note}")
    if mesh.is_readable_by_mitsuba and mesh.normals is not None:
        return {"type": Path(path).suffix.lower()[1:], "filename": str(path), "bsdf": _bsdf(mesh)}
    return mesh


def load_mesh(mesh: MeshFile, name: str) -> Any:
    """Return a mesh in memory as a Mitsuba shape with the id ``name``."""
    from nerg_mi.transport.mitsuba_mesh import add_attribute, make_mesh

    mesh = with_shading_normals(mesh)
    shape = make_mesh(mesh.vertices, mesh.faces, name, mesh.normals, bsdf=_bsdf(mesh))
    attribute, colors = ("face_color", mesh.face_colors) if mesh.colors is None else ("vertex_color", mesh.colors)
    if colors is not None:
        add_attribute(shape, attribute, colors)
    return shape


def is_trimesh(value: object) -> bool:
    """Return whether ``value`` is a mesh or a scene of trimesh, which is not imported for this test."""
    return type(value).__module__.split(".")[0] == "trimesh" and (hasattr(value, "faces") or hasattr(value, "graph"))


def from_trimesh(shape: trimesh.Trimesh | trimesh.Scene, name: str) -> dict[str, MeshFile]:
    """Convert a mesh or a scene of trimesh to meshes by name, with the colours of vertices, faces or textures.

    Coordinates are not changed. Raises `NergError` for a scene without triangles, and for vertices that are not finite.
    """
    if hasattr(shape, "faces"):
        return {name: _convert_mesh(shape, name)}
    meshes = {}
    for node in shape.graph.nodes_geometry:  # pyright: ignore[reportAttributeAccessIssue] of a scene
        to_scene, geometry = shape.graph[node]  # pyright: ignore[reportAttributeAccessIssue] of a scene
        mesh = shape.geometry[geometry]  # pyright: ignore[reportAttributeAccessIssue] of a scene
        if hasattr(mesh, "faces"):
            # trimesh ignores the last row.
            check_rigid_transforms(to_scene, f'the transform of the node "{node}"', tolerance=np.inf)
            meshes[str(node)] = _convert_mesh(mesh.copy().apply_transform(to_scene), str(node))
    if not meshes:
        raise NergError("the trimesh.Scene contains no mesh with faces; add one")
    return meshes


def _convert_mesh(mesh: Any, name: str) -> MeshFile:
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not len(faces):
        raise NergError(f'the mesh "{name}" has no faces')
    if not np.isfinite(vertices).all():
        raise NergError(f'the mesh "{name}" has vertices that are not finite')
    visual = mesh.visual
    if visual.kind == "texture":
        visual = visual.to_color()
    linear = lambda colors: decode_srgb(np.asarray(colors)[:, :3] / 255.0)
    colors = linear(visual.vertex_colors) if visual.kind == "vertex" else None
    face_colors = linear(visual.face_colors) if visual.kind == "face" else None
    return MeshFile(vertices, faces, np.arange(len(faces)), colors=colors, face_colors=face_colors)


# ---- Shapes (files, dicts, scenes, objects) as children of a scene ----


SCENE_KEYS = ("type", "integrator", "camera")
"""What the content of a scene contains besides shapes and lights."""


def to_scene_children(shapes: object, name: str = "shape", taken: Collection[str] = ()) -> dict[str, Any]:
    """Convert shapes to children of a scene; the variant must be active.

    Parameters
    ----------
    shapes : object
        A mesh file, a scene file, a mesh or scene of trimesh, a dict for ``mi.load_dict``, a Mitsuba shape or scene, or
        several of these in a list or in a dict by name.
    name : str
        Name of shapes that have none.
    taken : collection of str
        Names of other children of the scene.

    Returns
    -------
    dict of str to object
        The children by name: dots, ``$`` and control characters are underscores, and names that occur again have a
        number.

    Raises
    ------
    NergError
        ``shapes`` is something else.
    """
    children: dict[str, Any] = {}
    for key, child in _list_children(shapes, name):
        # Mitsuba divides keys at dots, and replaces what begins with $.
        key = unique = re.sub(r"[.$\n\t]", "_", clean_text(key)) or name
        number = 1
        while unique in SCENE_KEYS or unique in taken or unique in children:
            number += 1
            unique = f"{key}_{number}"
        children[unique] = child
    return children


def _list_children(shapes: object, name: str) -> list[tuple[str, Any]]:
    """List shapes with their names, which may repeat."""
    import mitsuba as mi

    if shapes is None:
        return []
    if isinstance(shapes, (str, os.PathLike)):
        if Path(shapes).suffix.lower() != ".xml":
            return [(name, load_mesh_child(shapes))]
        from .scene_loading import load_scene

        return _list_scene_children(load_scene(Path(shapes)), name)
    if is_trimesh(shapes):
        return list(from_trimesh(shapes, name).items())  # pyright: ignore[reportArgumentType] which is_trimesh has checked
    if isinstance(shapes, (MeshFile, mi.Object)) and not isinstance(shapes, mi.Scene):
        return [(name, shapes)]
    if isinstance(shapes, mi.Scene):
        return _list_scene_children(shapes, name)
    if isinstance(shapes, Mapping):
        if shapes.get("type") == "scene":
            left_out = ("integrator", "sensor")
            return [
                (key, child)
                for key, child in shapes.items()
                if not isinstance(child, str) and find_tag(child) not in left_out
            ]
        if "type" in shapes:
            return [(name, dict(shapes))]
        return [pair for key, child in shapes.items() for pair in _list_children(child, str(key))]
    if isinstance(shapes, (list, tuple)):
        return [pair for i, child in enumerate(shapes) for pair in _list_children(child, f"{name}_{i}")]
    raise NergError(
        "shapes must be mesh files, scene files, meshes of trimesh, dicts for mi.load_dict or Mitsuba objects, "
        f"got {type(shapes).__name__}"
    )


def _list_scene_children(scene, name: str) -> list[tuple[str, Any]]:
    """List the shapes of a scene with their names, and its emitters that are not shapes."""
    shapes = list(scene.shapes())
    named = [(shape.id() or f"{name}_{i}", shape) for i, shape in enumerate(shapes)]
    if len(dict(named)) < len(shapes):
        named = [(f"{name}_{i}", shape) for i, shape in enumerate(shapes)]
    lights = [light for light in scene.emitters() if not any(s.is_emitter() and s.emitter() is light for s in shapes)]
    return [*named, *((f"{name}_light_{i}", light) for i, light in enumerate(lights))]


# ---- The content of a scene in memory ----


def load_content(content: Mapping[str, Any]) -> Any:
    """Load the content of a scene with Mitsuba. Raises `NergError` if Mitsuba rejects it."""
    import mitsuba as mi

    with translate_mitsuba_errors():
        # Merged meshes would lose their names.
        return mi.load_dict(_load_values(content), optimize=False)


def _load_values(content: Mapping[str, Any]) -> dict[str, Any]:
    kind, name = content.get("type"), content.get("filename")
    if not isinstance(kind, str):
        raise NergError(
            'a dict for mi.load_dict needs the name of a plugin as "type", such as "sphere", but has '
            f"{', '.join(map(str, content)) if kind is None else repr(kind)}"
        )
    # Mitsuba would crash.
    if (key := next((key for key, value in content.items() if value is None), None)) is not None:
        raise NergError(f'"{key}" of the dict of a "{kind}" is None; give it a value, or leave it out')
    if kind in ("obj", "ply") and isinstance(name, (str, os.PathLike)):
        file = resolve_scene_file(str(name))
        # Mitsuba reports missing files.
        if os.path.exists(file):
            check_mesh(file, kind)
    for key, value in content.items():
        # Mitsuba applies transposed matrices as they are. That of a texture is smaller.
        if hasattr(value, "matrix") and (pose := np.array(value.matrix, float)).size == 16:
            check_rigid_transforms(pose.reshape(4, 4), f'"{key}" of the dict of a "{kind}"', tolerance=np.inf)

    def load(name: str, value: Any) -> Any:
        if isinstance(value, MeshFile):
            return load_mesh(value, name)
        if isinstance(value, (FieldVolume, GridVolume)):
            return value.load()
        return _load_values(value) if isinstance(value, Mapping) else value

    return {name: load(name, value) for name, value in content.items()}


def load_objects(content: Mapping[str, Any]) -> dict[str, Any]:
    """Load parts of a scene with Mitsuba, by name; numbers, texts and objects of Mitsuba are returned as they are."""
    import mitsuba as mi

    with translate_mitsuba_errors():
        loaded = _load_values({"type": "scene", **content})
        return {name: mi.load_dict(v) if isinstance(v := loaded[name], dict) else v for name in content}


def make_kde_volume(rays: Rays, align: np.ndarray | None) -> Any:
    """Return the volume of the density of ``rays``, which ``align`` (4, 4) transforms to the scene."""
    import mitsuba as mi

    props: Any = mi.Properties("gazekde")
    if align is not None:
        props["to_world"] = mi.ScalarTransform4d(align)
    return get_plugin_class("gazekde")(props, rays)


def has_nerg(content: Mapping[str, Any]) -> bool:
    """Whether the content of a scene has the integrator ``nerg``."""
    return any(isinstance(child, Mapping) and child.get("type") == "nerg" for child in content.values())


# ---- The content of a scene as files ----

_TAGS = dict(PLUGINS)
_SPECIAL_TAGS = {"BSDF": "bsdf", "ReconstructionFilter": "rfilter", "PhaseFunction": "phase"}


def find_tag(child: object) -> str:
    """Return the tag of a child of a scene in a scene file, such as "shape"; "" if there is none."""
    import mitsuba as mi

    if isinstance(child, MeshFile):
        return "shape"
    if isinstance(child, (FieldVolume, GridVolume)):
        return "volume"
    if not isinstance(child, Mapping) or "type" not in child:
        return ""
    plugin = str(child["type"])
    if plugin in _TAGS:
        return _TAGS[plugin]
    kind = mi.PluginManager.instance().plugin_type(plugin).name
    return "" if kind == "Unknown" else _SPECIAL_TAGS.get(kind, kind.lower())


def write_content(path: Path, content: Mapping[str, Any], comment: str) -> list[Path]:
    """Write the content of a scene as the scene file ``path``.

    Volumes and fields in memory become files next to it, whose names begin with that of the scene, and meshes become
    files of the folder ``NAME.meshes``. Names of files are relative to its folder where possible. Meshes that are
    objects of Mitsuba are written in grey, since their material cannot be read.

    Returns
    -------
    list of Path
        The written files, the scene first.

    Raises
    ------
    NergError
        An object of Mitsuba cannot be written, or a file cannot be written.
    """
    writer = _ContentWriter(path)
    write_text(path, format_document(writer.make_nodes(content), comment))
    return [path, *writer.written]


def format_content(content: Mapping[str, Any]) -> str:
    """Return the text of a scene file with the content of a scene and absolute file names.

    Raises `NergError` if a part of it has no file.
    """
    return format_document(_ContentWriter(None).make_nodes(content), "")


class _ContentWriter:
    """Makes elements of a scene file, and writes what they refer to; without a ``path`` nothing is written."""

    def __init__(self, path: Path | None) -> None:
        self.path, self.written = path, []

    def make_nodes(self, content: Mapping[str, Any]) -> list[Node]:
        return [self.make_node(name, value, is_top=True) for name, value in content.items() if name != "type"]

    def make_node(self, name: str, value: Any, is_top: bool = False) -> Node:
        from nerg_mi.transport.mitsuba_mesh import is_mesh, write_ply

        if isinstance(value, MeshFile):
            file = self._file(name, ".ply", is_mesh=True)
            write_mesh(file, with_shading_normals(value))
            self.written.append(file)
            return self._make_plugin(name, {"type": "ply", "filename": str(file), "bsdf": _bsdf(value)}, is_top)
        if isinstance(value, FieldVolume) and (file := value.path) is not None:
            return self._make_plugin(name, value.describe(file), is_top)
        if isinstance(value, (FieldVolume, GridVolume)):
            suffix = ".vol" if isinstance(value, GridVolume) else ".ply" if value.plugin == "splats" else ".safetensors"
            file = self._file(name, suffix)
            self.written.append(file)
            return self._make_plugin(name, value.place(file), is_top)
        if isinstance(value, Mapping):
            return self._make_plugin(name, value, is_top)
        if is_mesh(value):
            # A mesh of Mitsuba does not tell the parameters of its material.
            file = self._file(name, ".ply", is_mesh=True)
            with replace_atomically(file) as temporary:
                write_ply(value, temporary)
            self.written.append(file)
            grey = {"type": "twosided", "bsdf": {"type": "diffuse"}}
            return self._make_plugin(name, {"type": "ply", "filename": str(file), "bsdf": grey}, is_top)
        return self._make_property(name, value)

    def _file(self, name: str, suffix: str, is_mesh: bool = False) -> Path:
        safe = make_portable_name("".join(c if c.isalnum() or c in "-_" else "_" for c in name))
        if self.path is None:
            raise NergError(f'"{name}" of the scene has no file; write the scene and its objects by its method save')
        stem = self.path.absolute().with_suffix("")
        # A scene may have hundreds of meshes.
        prefix = make_folder(f"{stem}.meshes") / safe if is_mesh else Path(f"{stem}.{safe}")
        # Some file systems ignore case.
        taken, path, number = {str(file).casefold() for file in self.written}, Path(f"{prefix}{suffix}"), 0
        while str(path).casefold() in taken:
            number += 1
            path = Path(f"{prefix}_{number}{suffix}")
        return path

    def _make_plugin(self, name: str, value: Mapping[str, Any], is_top: bool) -> Element:
        kind = str(value.get("type", ""))
        if kind in ("rgb", "spectrum"):
            numbers = value["value"]
            return prop(kind, name, numbers if isinstance(numbers, (str, float, int)) else format_numbers(numbers))
        if kind == "ref":
            return element("ref", name=name, id=value["id"])
        tag = find_tag(value)
        if not tag:
            raise NergError(f'"{name}" of the scene is the plugin "{kind}", which Mitsuba does not know')
        children = [self.make_node(key, child) for key, child in value.items() if key not in ("type", "id")]
        # Mitsuba gives the name in a dict to an object as its id; the integrator and sensors have no other name.
        identity = {"id": check_attribute(str(value.get("id", name)))} if is_top else {"name": check_attribute(name)}
        return element(tag, *children, type=kind, **identity)

    def _make_property(self, name: str, value: Any) -> Element:
        if isinstance(value, (bool, np.bool_)):
            return prop("boolean", name, "true" if value else "false")
        if isinstance(value, (int, np.integer)):
            return prop("integer", name, int(value))
        if isinstance(value, (float, np.floating)):
            return prop("float", name, format_numbers([float(value)]))
        if isinstance(value, (str, os.PathLike)):
            text = os.fspath(value)
            if name == "filename":
                text = relative_path(Path(text), None if self.path is None else self.path.parent)
            return prop("string", name, check_attribute(text))
        if hasattr(value, "matrix"):
            return transform(matrix(np.array(value.matrix, float).reshape(4, 4)), name=name)
        if isinstance(value, (Sequence, np.ndarray)) or hasattr(value, "__len__"):
            numbers = np.ravel(to_numbers(value, f'"{name}" of the scene'))
            if len(numbers) == 3:
                return prop("vector", name, format_numbers(numbers))
        raise NergError(
            f'"{name}" of the scene is an object of Mitsuba ({type(value).__name__}), which cannot be written to a '
            "file; make the scene with dicts, files or meshes of trimesh in its place"
        )
