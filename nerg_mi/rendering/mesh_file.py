"""Meshes and volumes that Mitsuba is going to read, looked at before: its readers believe the counts and indices in a
file, and fill the memory or end the process where these are wrong."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import map_bytes, open_file, reading
from nerg_mi.formats.meshes import BYTES, MeshFile, read_mesh_file
from nerg_mi.formats.ply import PLY_MAGIC, parse_ply, write_columns


def check_mesh(path: str | os.PathLike, kind: str, colored: bool = False) -> None:
    """Raise `NergError` for a file that Mitsuba's plugin ``kind`` ("ply", "obj") does not read as a mesh, or not as the
    one that it is; ``colored``: whether a texture is to show its colours."""
    mesh = read_mesh_file(path, suffix=f".{kind}")
    reason = mesh.unreadable or (
        "an alpha, or their format, hides its colours" if colored and mesh.hides_colors else ""
    )
    if reason:
        raise NergError(
            f'Mitsuba does not read the mesh "{path}" as it is meant: {reason}; export it otherwise, or take what '
            f'"nerg scene {path} -o scene.xml" makes of it'
        )


def check_points(path: str | os.PathLike) -> None:
    """Raise `NergError` for a PLY file that holds less than its header says, or no vertices."""
    raw = map_bytes(path, "PLY file", BYTES, PLY_MAGIC, "export it again")
    with reading(path, "PLY file", "export it again"):
        tables = parse_ply(np.frombuffer(raw, np.uint8)).tables
        if "vertex" not in tables or not tables["vertex"].count:
            raise ValueError("it has no vertices")


def write_mesh(path: str | os.PathLike, mesh: MeshFile) -> None:
    """Write ``mesh`` as a PLY file that Mitsuba shows: triangles, with the attributes ``vertex_color`` or
    ``face_color``, linear in 0..1, where there are colours."""
    columns = dict(zip("xyz", mesh.vertices.T))
    if mesh.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), mesh.normals.T))
    tint = lambda colors: {} if colors is None else {f"color_{k}": colors[:, k] for k in range(3)}
    write_columns(path, columns | tint(mesh.colors), mesh.faces, tint(mesh.face_colors))


def check_vol(path: str | os.PathLike) -> None:
    """Raise `NergError` for a volume (Mitsuba's .vol) with counts below 1, or with fewer values than it announces."""
    path = Path(path)
    with open_file(path, "volume") as file:
        head = file.read(48)
        magic, version, kind, *size = struct.unpack("<3sB5i", head[:24])
        if magic != b"VOL" or version != 3:
            raise ValueError("it is no volume of Mitsuba's version 3")
        if kind != 1:
            raise ValueError(f"its values are of kind {kind}, and only float32 (1) is read")
        if min(size) < 1:
            raise ValueError("it has {} x {} x {} voxels of {} channels".format(*size))
        # Python's integers do not overflow.
        needed = 48 + 4 * size[0] * size[1] * size[2] * size[3]
        if path.stat().st_size < needed:
            raise ValueError(f"it has {path.stat().st_size:,} bytes, and its header asks for {needed:,}")
