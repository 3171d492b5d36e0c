"""Meshes from files: PLY, OBJ and binary glTF, as triangles in scene units with z up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, mitsuba_says
from nerg_mi.formats.gltf import read_glb
from nerg_mi.rendering.mesh_file import check_obj, check_ply

Triangles = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) float64 and faces (F, 3) int64."""


def read_mesh(path: str | Path) -> Triangles:
    """The triangles of a mesh file, in its own units; of glTF, whose y is up, turned so that z is.

    A variant must be active. Raises `NergError` for what is missing, damaged or no mesh.
    """
    path = Path(path)
    if path.suffix.lower() not in READERS:
        raise NergError(f'"{path}" is no mesh that is read; give one that ends in {", ".join(READERS)}')
    if not path.is_file():
        raise MissingFile(f'there is no mesh "{path}"; correct its name')
    return READERS[path.suffix.lower()](path)


def shape_triangles(shape: Any) -> Triangles | None:
    """Those of a shape of a Mitsuba scene, in the scene; None of a shape that has none."""
    if not shape.is_mesh():
        return None
    vertices = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    return vertices, np.array(shape.faces_buffer(), np.int64).reshape(-1, 3)


def _by_mitsuba(kind: str, check: Callable[[Path], None]) -> Callable[[Path], Triangles]:
    def read(path: Path) -> Triangles:
        import mitsuba as mi

        check(path)
        with mitsuba_says():
            found = shape_triangles(mi.load_dict({"type": kind, "filename": str(path)}))
        assert found is not None, "a file of triangles has some"
        return found

    return read


def _glb(path: Path) -> Triangles:
    vertices, faces = read_glb(path)
    return np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1), faces


READERS: dict[str, Callable[[Path], Triangles]] = {
    ".ply": _by_mitsuba("ply", check_ply),
    ".obj": _by_mitsuba("obj", check_obj),
    ".glb": _glb,
}
"""Suffixes of meshes, and what reads them."""
