"""Target surfaces of a bake: a mesh, shapes of a scene, or the surface of a radiance field."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from nerg_mi.environment.contents import from_trimesh, is_trimesh
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.radiance import RadianceField
from nerg_mi.environment.trained import TrainedField
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.files.values import normalize_name
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import refuse_unsupported_splats
from nerg_mi.formats.surfaces import extract_mesh
from nerg_mi.progress import Reporter
from nerg_mi.transport.mitsuba_mesh import Triangles, read_triangles

from .mesh import Mesh, RefinedMesh, refine, weld_mesh

TARGET_FACES = 100_000
"""Default number of triangles after subdivision."""


@dataclass(frozen=True, eq=False)
class BakeTarget:
    """Target surface.

    Attributes
    ----------
    mesh
        All target shapes as one mesh, as given.
    names
        Names of the shapes.
    shape
        Index (F,) into ``names`` for each face.
    index
        Number (F,) of each face within its shape.
    occluders
        Shapes that only occlude.
    """

    mesh: Mesh
    names: tuple[str, ...]
    shape: np.ndarray
    index: np.ndarray
    occluders: tuple[Triangles, ...] = ()


def read_target(
    surface: Any, scene: Environment | None, shapes: tuple[str, ...], resolution: int, reporter: Reporter
) -> BakeTarget:
    """Read the target surface: a mesh, shapes of a scene or a radiance field, in memory or as a file.

    ``scene`` is the opened ``surface`` if that is a scene, of which ``shapes`` selects some; the others only occlude.
    Raises `NergError`.
    """
    path = Path(surface) if isinstance(surface, (str, os.PathLike)) else None
    name = path or Path(surface.name if isinstance(surface, TrainedField) else "environment")
    occluders: tuple[Triangles, ...] = ()
    if scene is not None:
        meshes, occluders = _read_shapes(scene.shapes, name, shapes)
    elif shapes:
        raise NergError(f'{parameter("shapes")} applies to scenes, and "{name}" is not one; leave it out')
    elif isinstance(surface, TrainedField) or name.suffix.lower() == ".safetensors":
        body = extract_mesh(_open_field(surface, name, reporter), resolution)
        assert body.faces is not None, "a mesh has faces"
        meshes = {name.stem: (body.vertices, body.faces)}
    elif path is not None:
        refuse_unsupported_splats(path)
        body = read_mesh_file(path)
        for note in body.notes:
            reporter.message(f"{path}: {note}")
        meshes = {path.stem: (body.vertices, body.faces)}
    elif is_trimesh(surface):
        bodies = from_trimesh(cast("Any", surface), "environment")
        meshes = {shape: (body.vertices, body.faces) for shape, body in bodies.items()}
    else:
        meshes, occluders = _read_shapes(Environment.open(surface).shapes, name, ())
    return _merge_shapes(name, meshes, occluders, reporter)


def _open_field(surface: Any, name: Path, reporter: Reporter) -> RadianceNetwork:
    """Return the radiance field whose surface is extracted."""
    kind = surface.kind if isinstance(surface, TrainedField) else read_metadata(name).get("kind")
    if kind != "radiance":
        raise NergError(
            f'"{name}" is not a radiance field; give the target surface first, and the gaze field with '
            f"{parameter('gaze')}"
        )
    field = RadianceField.open(surface).network
    reporter.progress(0.02, "extracting the surface of the field")
    field.require_density(f'"{name}"')
    return field


def refine_target(receivers: BakeTarget, longest: float | None, scale: float) -> RefinedMesh:
    """Subdivide the target to edges of at most ``longest`` metres, or to about `TARGET_FACES` triangles.

    ``scale`` is the number of scene units per metre.
    """
    mesh = receivers.mesh
    if longest is not None:
        return refine(mesh, longest * scale)
    # Edge length of this number of equilateral triangles; halving edges makes triangles up to four times smaller.
    return refine(mesh, float(np.sqrt(4 * mesh.area.sum() / (np.sqrt(3) * TARGET_FACES)) * 1.5))


def _read_shapes(
    every: Mapping[str, Any], path: Path, shapes: tuple[str, ...]
) -> tuple[dict[str, Triangles], tuple[Triangles, ...]]:
    # Mitsuba does not return shapes in a fixed order.
    every, shapes = dict(sorted(every.items())), tuple(map(normalize_name, shapes))
    missing = [name for name in shapes if name not in every]
    if missing:
        remedy = f"it has {', '.join(every)}" if every else "it has no shapes"
        raise NergError(f'the scene "{path}" has no shape "{missing[0]}"; {remedy}')
    if not every:
        raise NergError(f'the scene "{path}" has no shapes; give a mesh, a radiance field or splats as the target')
    targets, occluders = {}, []
    for name, shape in every.items():
        if not shape.is_mesh():
            raise NergError(
                f'the shape "{name}" of "{path}" is a {shape.class_name()}, which has no triangles; replace it by '
                "a mesh"
            )
        triangles = read_triangles(shape)
        if shapes and name not in shapes:
            occluders.append(triangles)
        else:
            targets[name] = triangles
    return targets, tuple(occluders)


def _merge_shapes(
    path: Path, meshes: dict[str, Triangles], occluders: tuple[Triangles, ...], reporter: Reporter
) -> BakeTarget:
    """Merge all shapes into one mesh with shared vertices where they touch."""
    first = np.cumsum([0, *(len(v) for v, _ in meshes.values())])
    vertices = np.concatenate([v for v, _ in meshes.values()])
    faces = np.concatenate([f + start for (_, f), start in zip(meshes.values(), first)])
    counts = [len(f) for _, f in meshes.values()]
    mesh, index, repairs = weld_mesh(vertices, faces, f'the mesh "{path}"')
    if repairs.summary:
        reporter.message(f"{path.name}: {repairs.summary}")
    shape = np.repeat(np.arange(len(counts)), counts)
    number = np.concatenate([np.arange(n) for n in counts])
    return BakeTarget(mesh, tuple(meshes), shape[index], number[index], occluders)
