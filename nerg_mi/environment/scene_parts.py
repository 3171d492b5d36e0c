"""What a scene file shows of an environment: a field, a mesh, hit points, or directions alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.formats.meshes import DEFAULT_GREY, MeshFile, read_mesh_file, with_shading_normals
from nerg_mi.formats.splats import choose_plugin
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.transport.geometry import HEADLIGHT

from .contents import GridVolume
from .hits import NO_DATA_GREY, read_hit_volume, shade_hits
from .rendering_files import write_mesh
from .scene_writer import Comment, Node, SceneContent, element, prop


def show_field(path: Path, output: Path | None) -> SceneContent:
    """Return the content of a scene that shows a radiance field or Gaussian splats."""
    plugin = choose_plugin(path)
    volume = element("volume", prop("string", "filename", "$field"), name="field", type=plugin)
    kind = "Gaussian splats" if plugin == "splats" else "radiance field"
    return SceneContent(integrator_children=(volume,), files={"field": path}, subject=f"The {kind} {path.name}")


def show_mesh(path: Path, output: Path | None) -> SceneContent:
    """Return the content of the scene file ``output``, or of a scene in memory, that shows a mesh.

    A mesh that Mitsuba cannot show as it is, is converted to a file next to ``output``. Raises `NergError` if that is
    the mesh itself.
    """
    mesh = read_mesh_file(path)
    shaded, shown, written = with_shading_normals(mesh), path, ()
    if not mesh.is_readable_by_mitsuba or shaded is not mesh:
        if output is None:
            return show_mesh_in_memory(shaded)
        shown = output.with_name(f"{output.stem}.mesh.ply")
        if resolve_path(shown) == resolve_path(path):
            raise NergError(f'"{path}" would be overwritten by a converted mesh; give the scene another name')
        write_mesh(shown, shaded)
        written = (shown,)
    kind = shown.suffix.lower().lstrip(".")
    bsdf = element("bsdf", element("bsdf", _mesh_color(mesh), type="diffuse"), type="twosided")
    shape = element("shape", prop("string", "filename", "$place"), bsdf, type=kind, id="place")
    return SceneContent(
        integrator_children=_HEADLIGHT,
        scene_children=(shape,),
        files={"place": shown},
        subject=f"The mesh {path.name}",
        written=written,
    )


_HEADLIGHT = (Comment("Without emitters, a headlight shows the mesh."), prop("float", "headlight", HEADLIGHT))


def show_mesh_in_memory(mesh: MeshFile) -> SceneContent:
    """Return the content of a scene in memory that shows a mesh."""
    return SceneContent(integrator_children=_HEADLIGHT, shapes={"place": mesh}, subject="A mesh")


def _mesh_color(mesh: MeshFile) -> Node:
    """Return the colours of the mesh, or grey."""
    if mesh.colors is None and mesh.face_colors is None:
        return prop("rgb", "reflectance", DEFAULT_GREY)
    name = "face_color" if mesh.colors is None else "vertex_color"
    return element("texture", prop("string", "name", name), name="reflectance", type="mesh_attribute")


def colors_path(output: Path) -> Path:
    """Return the file next to the scene ``output`` for the colours of hit points."""
    return output.with_name(f"{output.stem}.color.vol")


def show_hits(path: Path, output: Path | None) -> SceneContent:
    """Return the content of the scene file ``output`` that shows a volume of hit points, whose colours are written next
    to it, or of a scene in memory."""
    density, lower, upper = read_hit_volume(path)
    if output is None:
        return show_hits_in_memory(density, lower, upper)
    colors = colors_path(output)
    color, end = shade_hits(density, lower, upper)
    write_volume(colors, color, lower, end)
    # Interpolation rounds the edges of voxels; it moves surfaces by less than half a voxel from where a training looked
    # for them (`nerg_mi.environment.hits.make_volume_dict`).
    box, raw = prop("boolean", "use_grid_bbox", "true"), prop("boolean", "raw", "true")
    file = lambda name: prop("string", "filename", f"${name}")
    return SceneContent(
        integrator_children=(
            element("volume", file("density"), box, name="density", type="gridvolume"),
            element("volume", file("color"), box, raw, name="color", type="gridvolume"),
            prop("rgb", "background", NO_DATA_GREY),
        ),
        files={"density": path, "color": colors},
        subject=f"The hit points of rays in {path.name}, in grey shaded by surface orientation",
        written=(colors,),
    )


def show_hits_in_memory(density: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> SceneContent:
    """Return the content of a scene in memory that shows a volume of hit points."""
    color, end = shade_hits(density, lower, upper)
    return SceneContent(
        integrator_children=(prop("rgb", "background", NO_DATA_GREY),),
        volumes={"density": GridVolume(density, lower, upper), "color": GridVolume(color, lower, end)},
        subject="The hit points of rays, in grey shaded by surface orientation",
    )


def show_directions(radius: float) -> SceneContent:
    """Return the content of a scene without geometry: a sphere around the observer, in cells of 15 degrees."""
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
        element("point", name="center", value="$eye"),
        prop("float", "radius", f"{radius:g}"),
        prop("boolean", "flip_normals", "true"),
        element("bsdf", cells, type="diffuse"),
        type="sphere",
        id="nowhere",
    )
    subject = "There is no geometry: a sphere around the observer shows directions, in cells of 15 degrees"
    return SceneContent(scene_children=(sphere,), spp=16, subject=subject)
