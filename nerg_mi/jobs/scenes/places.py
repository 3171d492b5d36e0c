"""Each kind of place as a part of a written scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import reading
from nerg_mi.formats.meshes import GREY, MeshFile, read_mesh_file
from nerg_mi.formats.splats import plugin_of_field, read_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.rendering.files import check_vol, write_mesh
from nerg_mi.rendering.nested_scene import nested_place
from nerg_mi.rendering.scene_writer import Comment, Node, Place, element, prop, relative_name, value_of
from nerg_mi.train.geometry import NOWHERE, shade_hits

from .files import GivenFiles

LAMP = 2.5
"""Intensity of a lamp at distance 1 from what it is to light well: about half of white on grey."""


@dataclass(frozen=True)
class WrittenPlace:
    """A place for a scene file in a folder: ``make(folder, lamps)`` gives its parts, with names of files as that folder
    has them and, where it has no light of its own, with lamps at ``$camera`` and ``$eye`` (names of `<default>`s) of
    that intensity. ``words``: what it is, for a comment; ``contracted``: whether it has no end; ``files`` written;
    ``notes`` on its file: sentences on what is not used, and on what was guessed."""

    make: Callable[[Path, dict[str, float]], Place]
    words: str
    contracted: bool = False
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def place_of_files(given: GivenFiles, output: Path) -> WrittenPlace:
    """The place in ``given``; what has to be written for it stands beside ``output``: the colours of hit points, and a
    mesh that Mitsuba does not show as it is.

    Raises `NergError` for files that cannot be used.
    """
    if given.kind == "field":
        contracted = "reach" in given.field_about.get("box", {})
        # A file that cannot be used is refused before a scene names it.
        splats = read_splats(_file(given)) if given.splats else None
        notes = () if splats is None else (*splats.guesses, *splats.notes)
        make = lambda folder, lamps: _field(_file(given), folder)
        return WrittenPlace(make, _words(given), contracted, notes=notes)
    if given.kind == "mesh":
        return _mesh(_file(given), output, _words(given))
    if given.kind == "scene":
        path = _file(given)
        nested_place(path, output.parent)
        return WrittenPlace(lambda folder, lamps: nested_place(path, folder), _words(given))
    if given.kind == "hits":
        return _hits(_file(given), output, _words(given))
    return WrittenPlace(lambda folder, lamps: _nowhere(lamps), _words(given))


def _words(given: GivenFiles) -> str:
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


def _file(given: GivenFiles) -> Path:
    assert given.place is not None
    return given.place


def _name(path: Path, folder: Path) -> str:
    return value_of(relative_name(path, folder))


def _field(path: Path, folder: Path) -> Place:
    volume = element("volume", prop("string", "filename", "$field"), name="field", type=plugin_of_field(path))
    return Place(inside=(volume,), files={"field": _name(path, folder)})


def mesh_of(output: Path) -> Path:
    """The file of a mesh that Mitsuba does not show as it is, beside the scene file ``output``."""
    return output.with_name(f"{output.stem}.mesh.ply")


def _mesh(path: Path, output: Path, words: str) -> WrittenPlace:
    mesh, shown = read_mesh_file(path), path
    if not mesh.is_plain:
        shown = mesh_of(output)
        if shown.resolve() == path.resolve():
            raise NergError(f'"{path}" would be written over by what Mitsuba shows of it; give the scene another name')
        write_mesh(shown, mesh)
    kind = shown.suffix.lower().lstrip(".")
    color = _mesh_color(mesh)
    light = element("integrator", prop("integer", "max_depth", 5), type="path")

    def make(folder: Path, lamps: dict[str, float]) -> Place:
        bsdf = element("bsdf", element("bsdf", color, type="diffuse"), type="twosided")
        shape = element("shape", prop("string", "filename", "$place"), bsdf, type=kind, id="place")
        return Place(
            inside=(Comment("What lights the shape."), light),
            beside=(
                shape,
                Comment("A mesh brings no light: lamps where the camera and the observer are."),
                *_lamps(lamps),
            ),
            files={"place": _name(shown, folder)},
            spp=64,
        )

    return WrittenPlace(make, words, files=() if mesh.is_plain else (shown,), notes=mesh.notes)


def _mesh_color(mesh: MeshFile) -> Node:
    """The mesh's own colours, or grey."""
    if mesh.colors is None and mesh.face_colors is None:
        return prop("rgb", "reflectance", GREY)
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


def colors_of(output: Path) -> Path:
    """The file of the colours of hit points, beside the scene file ``output``."""
    return output.with_name(f"{output.stem}.color.vol")


def _hits(path: Path, output: Path, words: str) -> WrittenPlace:
    check_vol(path)
    colors = colors_of(output)
    with reading(path, "place of hit points"):
        shape = np.fromfile(path, "<i4", 4, offset=8)
        lower, upper = np.fromfile(path, "<f4", 6, offset=24).astype(float).reshape(2, 3)
        density = np.fromfile(path, "<f4", int(np.prod(shape, dtype=np.int64)), offset=48)
    if shape[3] != 1 or not (np.isfinite([lower, upper]).all() and (lower < upper).all()):
        raise NergError(f'"{path}" is no place of hit points; give one that "nerg train gaze --geometry hits" wrote')
    color, end = shade_hits(density.reshape(shape[2], shape[1], shape[0]), lower, upper)
    write_volume(colors, color, lower, end)

    def make(folder: Path, lamps: dict[str, float]) -> Place:
        # As `train.geometry.volume_dict` has it: interpolation would bring every surface nearer.
        nearest, box = prop("string", "filter_type", "nearest"), prop("boolean", "use_grid_bbox", "true")
        density = element(
            "volume", prop("string", "filename", "$density"), box, nearest, name="density", type="gridvolume"
        )
        file = prop("string", "filename", "$color")
        raw = prop("boolean", "raw", "true")
        color = element("volume", file, box, raw, name="color", type="gridvolume")
        return Place(inside=(density, color), files={"density": _name(path, folder), "color": _name(colors, folder)})

    return WrittenPlace(make, words, files=(colors,))


def _nowhere(lamps: dict[str, float]) -> Place:
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
        prop("float", "radius", f"{NOWHERE:g}"),
        prop("boolean", "flip_normals", "true"),
        element("bsdf", cells, type="diffuse"),
        type="sphere",
        id="nowhere",
    )
    return Place(beside=(sphere,), spp=16)
