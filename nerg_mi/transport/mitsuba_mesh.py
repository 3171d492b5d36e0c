"""Mitsuba's mesh class: the only module that uses it, because its interface changes after Mitsuba 3.9.

Mitsuba 3.9 creates a mesh of zeros, whose flat buffers are then assigned; 3.10 builds it from arrays of shape (N, 3),
where several vertices can share a position. Which of the two is installed is told by the class, not by the version.
Vertices are read one by one, which is the same in both, follows shared positions, and carries derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.maths.types import Point3f, UInt32, variant_types

Triangles = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) float64, and faces (F, 3) int64."""


def _is_built_from_arrays() -> bool:
    """Whether meshes have the interface of Mitsuba 3.10."""
    return hasattr(variant_types().Mesh, "from_fields")


# ---- Creation ----


def make_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    name: str,
    normals: np.ndarray | None = None,
    texcoords: np.ndarray | None = None,
    **children: Mapping[str, Any],
) -> Any:
    """Create a Mitsuba mesh in the active variant.

    Parameters
    ----------
    vertices, faces
        Vertices (V, 3) in scene units, and their indices (F, 3).
    name
        Id of the shape.
    normals
        Shading normals (V, 3) of the vertices. None: flat faces.
    texcoords
        Texture coordinates (V, 2) of the vertices.
    children
        Nested plugins by name, such as ``bsdf`` and ``emitter``, as dicts for ``mi.load_dict``.
    """
    mi = variant_types()
    props = mi.Properties()
    props.set_id(name)
    for key, child in children.items():
        props[key] = mi.load_dict(dict(child))
    values = {"positions": vertices, "normals": normals, "texcoords": texcoords}
    fields = {key: np.ascontiguousarray(v, np.float32) for key, v in values.items() if v is not None}
    indices = np.ascontiguousarray(faces, np.uint32)
    if _is_built_from_arrays():
        # Otherwise Mitsuba computes smooth normals where there are none.
        props["face_normals"] = normals is None
        if normals is not None:
            # Mitsuba 3.9 normalises them at each intersection.
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            fields["normals"] = (normals / np.where(length > 0, length, 1)).astype(np.float32)
        mesh = mi.Mesh(props)
        mesh.from_fields(faces=mi.TensorXu(indices), **{key: mi.TensorXf(v) for key, v in fields.items()})
        return mesh
    mesh = mi.Mesh(
        name,
        len(vertices),
        len(indices),
        props=props,
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=texcoords is not None,
    )
    params = mi.traverse(mesh)
    for key, v in fields.items():
        params[f"vertex_{key}"] = v.ravel()
    params["faces"] = indices.ravel()
    params.update()
    return mesh


def add_attribute(mesh: Any, name: str, values: np.ndarray) -> None:
    """Add ``values`` (N, channels), one row per vertex or face, as the attribute ``vertex_...`` or ``face_...``."""
    values = np.ascontiguousarray(values, np.float32)
    if _is_built_from_arrays():
        mesh.add_attribute(name, variant_types().TensorXf(values))
    else:
        mesh.add_attribute(name, values.shape[1], values.ravel())


# ---- Content ----


def is_mesh(value: object) -> bool:
    """Return whether ``value`` is a Mitsuba mesh of the active variant."""
    return isinstance(value, variant_types().Mesh)


def count_faces(mesh: Any) -> int:
    return mesh.face_count()


def read_vertices(mesh: Any) -> np.ndarray:
    """Return the vertices (V, 3), float32, in scene coordinates."""
    return np.array(mesh.vertex_position(dr.arange(variant_types().UInt32, mesh.vertex_count()))).T


def read_triangles(mesh: Any) -> Triangles:
    """Return the vertices and faces in scene coordinates."""
    faces = mesh.face_indices(dr.arange(variant_types().UInt32, mesh.face_count()))
    return read_vertices(mesh).astype(np.float64), np.array(faces).T.astype(np.int64)


def gather_corners(mesh: Any, face: UInt32) -> list[Point3f]:
    """Gather the three corners of a face per lane, with derivatives with respect to whatever moves the vertices."""
    return [mesh.vertex_position(vertex) for vertex in mesh.face_indices(face)]


def read_attribute(mesh: Any, name: str) -> np.ndarray | None:
    """Return the first three channels of the attribute ``name`` of vertices or faces, (N, 3); None if the mesh has none
    of that name."""
    params = variant_types().traverse(mesh)
    count = mesh.face_count() if name.startswith("face") else mesh.vertex_count()
    return np.array(params[name]).reshape(count, -1)[:, :3] if name in params else None


def write_ply(mesh: Any, path: str | Path) -> None:
    """Write a mesh to a new binary PLY file."""
    mesh.write_ply(str(path))


# ---- Vertices among the parameters of ``mi.traverse`` ----


def positions_key() -> str:
    """Return the name of the parameter with the vertex positions of a mesh."""
    return "positions" if _is_built_from_arrays() else "vertex_positions"


def unpack_positions(value: Any) -> Point3f:
    """Convert the value of the parameter `positions_key` to points, one per lane."""
    mi = variant_types()
    return dr.unravel(mi.Point3f, mi.Float(value.array if dr.is_tensor_v(value) else value))


def pack_positions(points: Point3f) -> Any:
    """Convert points, one per lane, to a value of the parameter `positions_key`."""
    flat = dr.ravel(points)
    return variant_types().TensorXf(flat, (dr.width(points), 3)) if _is_built_from_arrays() else flat
