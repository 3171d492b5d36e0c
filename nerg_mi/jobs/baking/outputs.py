"""Files of a bake: meshes with colours (.ply, .glb), a table of faces (.csv), and a summary (.json)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, overlay
from nerg_mi.figures.style import Provenance
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.images import encode_png
from nerg_mi.files.tables import write_csv, write_json
from nerg_mi.formats.gltf import Attribute, shown_unlit
from nerg_mi.formats.ply import write_columns
from nerg_mi.maths.color import decode_srgb
from nerg_mi.surfaces.mesh import Mesh, Refined, texture, unroll, unroller

from .receivers import Receivers

SUFFIXES = (".ply", ".glb", ".csv", ".json")
"""Files that are written."""

_BARE = 0.3  # linear grey of a surface that nobody looks at


@dataclass(frozen=True, eq=False)
class Baked:
    """What is written: ``refined`` surface with ``density`` (V,) of its vertices in ``unit``, and ``share`` (F,) of its
    faces; ``receivers`` as they were given; ``scale``: scene units a metre."""

    receivers: Receivers
    refined: Refined
    density: np.ndarray
    share: np.ndarray
    unit: str
    scale: float
    heat: Heat
    about: Provenance
    summary: Mapping[str, Any]

    def of_given_faces(self) -> np.ndarray:
        """Share (F',) of the faces that were given."""
        return np.bincount(self.refined.parent, self.share, len(self.receivers.mesh.faces))


def write_output(baked: Baked, path: Path, pixels: int | None) -> None:
    """Write ``baked`` to ``path``, by its suffix; ``pixels`` a side of a texture, None for none."""
    WRITERS[path.suffix.lower()](baked, path, pixels)


def _ply(baked: Baked, path: Path, pixels: int | None) -> None:
    mesh, normals = baked.refined.mesh, vertex_normals(baked.refined.mesh)
    colors = np.rint(255 * _colors(baked, baked.density, normals)).astype(np.uint8)
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    columns: dict[str, np.ndarray] = dict(zip(names, [*mesh.vertices.T, *normals.T, *colors.T]))
    columns["value"] = baked.density
    comments = [f"value: {baked.unit}", f"nerg_mi {baked.about.json()}"]
    write_columns(path, columns, mesh.faces, comments=comments)


def _glb(baked: Baked, path: Path, pixels: int | None) -> None:
    extras = {"unit": baked.unit, "top": baked.heat.top, "provenance": json.loads(baked.about.json())}
    mesh = baked.refined.mesh
    normals = vertex_normals(mesh)
    if pixels is None:
        rgba = np.full((len(mesh.vertices), 4), 65535, "<u2")
        rgba[:, :3] = np.rint(65535 * decode_srgb(_colors(baked, baked.density, normals)))
        attributes: list[Attribute] = [
            ("POSITION", mesh.vertices.astype("<f4"), False),
            ("NORMAL", normals.astype("<f4"), False),
            ("COLOR_0", rgba, True),
            ("_VALUE", baked.density.astype("<f4"), False),
        ]
        write_bytes(path, *shown_unlit(attributes, mesh.faces, extras=extras))
        return
    import mitsuba as mi

    whole = baked.receivers.mesh
    charts = unroll(whole, pixels)
    values, known = texture(charts, baked.refined, baked.density, pixels)
    picture = np.where(known[..., None], _shown(baked.heat, values), 0.0)
    image = encode_png(mi.Bitmap(np.rint(255 * picture).astype(np.uint8)), {"Comment": baked.about.json()})
    attributes = [
        ("POSITION", whole.vertices[charts.vertex].astype("<f4"), False),
        ("NORMAL", vertex_normals(whole)[charts.vertex].astype("<f4"), False),
        ("TEXCOORD_0", charts.uv.astype("<f4"), False),
    ]
    write_bytes(path, *shown_unlit(attributes, charts.faces, extras=extras, image=image))


def _csv(baked: Baked, path: Path, pixels: int | None) -> None:
    given, square = baked.receivers, baked.scale**2
    shares, area, center = baked.of_given_faces(), given.mesh.area, given.mesh.corners.mean(axis=1)
    factor = float(baked.summary["factor"])
    columns = ("shape", "face", "x", "y", "z", "area_m2", "value", "share")

    def row(k: int) -> tuple:
        value = factor * shares[k] / area[k] * square
        numbers = (f"{v:.9g}" for v in (*center[k], area[k] / square, value, shares[k]))
        return given.names[given.shape[k]], int(given.index[k]), *numbers

    write_csv(path, (dict(zip(columns, row(k))) for k in range(len(center))), columns)


def _json(baked: Baked, path: Path, pixels: int | None) -> None:
    write_json(path, dict(baked.summary), allow_nan=False)


WRITERS = {".ply": _ply, ".glb": _glb, ".csv": _csv, ".json": _json}


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Unit normals (V, 3): means of the faces' around each vertex, by area; of opposite ones any."""
    weighted = mesh.normals * mesh.area[:, None]
    sums = np.stack([np.bincount(mesh.faces.ravel(), np.repeat(c, 3), len(mesh.vertices)) for c in weighted.T], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(length > 0, sums / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def _colors(baked: Baked, values: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """sRGB (V, 3) of vertices: heat over grey that shades by the normal, so that an unlit mesh shows its shape."""
    shade = 0.75 + 0.25 * normals @ np.array([0.48, 0.36, 0.8])
    return _shown(baked.heat, values, shade)


def _shown(heat: Heat, values: np.ndarray, shade: np.ndarray | float = 1.0) -> np.ndarray:
    grey = np.broadcast_to(np.asarray(_BARE * np.asarray(shade))[..., None], (*values.shape, 3))
    if values.ndim == 1:
        return overlay(grey[None], values[None], heat)[0]
    return overlay(grey, values, heat)


def check_texture(paths: list[Path], pixels: int | None) -> None:
    """Raise `NergError` where a texture is asked for and no file takes one, `ImportError` where nothing makes it."""
    if pixels is None:
        return
    if not any(path.suffix.lower() == ".glb" for path in paths):
        raise NergError("--texture belongs to glTF; let the name of an output end in .glb")
    unroller()
