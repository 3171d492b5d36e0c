"""A surface unrolled into a square, and values on it as a texture: charts by xatlas, an optional extra."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError

from .mesh import Mesh
from .refinement import Refined
from .target import mitsuba_mesh

GUTTER = 4
"""Pixels by which colours go on beyond the border of a chart, for filters that look there."""

MOST_FACES = 400_000
"""A mesh of more triangles is not unrolled."""


@dataclass(frozen=True, eq=False)
class Charts:
    """``vertex`` (W,): of which vertex of the mesh each corner on the square is; ``uv`` (W, 2), from 0 to 1, v down the
    picture; ``faces`` (F, 3) of such corners, in the mesh's order."""

    vertex: np.ndarray
    uv: np.ndarray
    faces: np.ndarray


def unroller() -> Any:
    """The package xatlas; `ImportError` with the remedy where it is not installed."""
    try:
        import xatlas
    except ImportError:
        raise ImportError('a texture needs xatlas, which is not installed: pip install "nerg-mi[bake]"') from None
    return xatlas


def unroll(mesh: Mesh, pixels: int) -> Charts:
    """``mesh`` cut into charts that fill a square of ``pixels`` a side without overlaps. Needs xatlas; raises
    `NergError` for meshes that are too large."""
    xatlas = unroller()
    if len(mesh.faces) > MOST_FACES:
        raise NergError(
            f"a mesh of {len(mesh.faces):,} triangles is not unrolled into a texture, but up to {MOST_FACES:,}; leave "
            "out --texture for colours of vertices"
        )
    # In a unit in which nothing of it vanishes in single precision.
    unit = (mesh.vertices - mesh.vertices.mean(axis=0)) / (mesh.diagonal or 1.0)
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_mesh(unit.astype(np.float32), mesh.faces.astype(np.uint32))
    pack.padding, pack.resolution, pack.bruteForce = 2, pixels, False
    # Of a resolution and no scale xatlas may need several squares; a scale is found with which one is enough.
    texels = 0.8 * pixels / np.sqrt(float((mesh.area / (mesh.diagonal or 1.0) ** 2).sum()))
    for _ in range(40):
        pack.texels_per_unit = float(texels)
        atlas.generate(xatlas.ChartOptions(), pack, False)
        if atlas.atlas_count == 1 and max(atlas.width, atlas.height) <= pixels:
            break
        texels *= 0.85
    else:
        raise NergError(f"the surface does not fit on {pixels} x {pixels} pixels; give a larger --texture")
    vertex, faces, uv = atlas[0]
    # xatlas divides by its own size, which may be less than the square's.
    size = np.array([atlas.width, atlas.height], np.float64)
    return Charts(vertex.astype(np.int64), uv.astype(np.float64) * size / pixels, faces.astype(np.int64))


def texture(charts: Charts, refined: Refined, values: np.ndarray, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """``(values (pixels, pixels), known (pixels, pixels) bool)`` of ``values`` (V,) on the vertices of ``refined``, of
    whose whole mesh ``charts`` are; linear in every triangle, and carried on over a gutter around charts."""
    import drjit as dr
    import mitsuba as mi
    from scipy.ndimage import distance_transform_edt

    corners = np.einsum("fij,fjk->fik", refined.place, charts.uv[charts.faces[refined.parent]])
    flat = np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=2).reshape(-1, 3)
    # A texel shows what lies under its centre, which is found as all else is: by a ray.
    sheet = mitsuba_mesh(flat, np.arange(len(flat)).reshape(-1, 3), "charts")
    scene: Any = mi.load_dict({"type": "scene", "charts": sheet})
    center = (np.arange(pixels) + 0.5) / pixels
    u, v = (c.ravel() for c in np.meshgrid(center, center))
    above = mi.Point3f(np.stack([u, v, np.ones_like(u)]).astype(np.float32))
    with dr.suspend_grad():
        found = scene.ray_intersect_preliminary(mi.Ray3f(above, mi.Vector3f(0, 0, -1)), coherent=True)
        hit, face = np.array(found.is_valid()).astype(bool), np.array(found.prim_index).astype(np.int64)
        b, c = (np.array(x, np.float64) for x in (found.prim_uv.x, found.prim_uv.y))
    face = np.where(hit, face, 0)
    of_corners = values[refined.mesh.faces[face]]
    out = np.where(hit, of_corners[:, 0] * (1 - b - c) + of_corners[:, 1] * b + of_corners[:, 2] * c, 0.0)
    out, hit = out.reshape(pixels, pixels), hit.reshape(pixels, pixels)
    if not hit.any():
        raise NergError(f"no pixel of a texture of {pixels} x {pixels} shows the surface; give a larger --texture")
    nearest = distance_transform_edt(~hit, return_indices=True)
    assert nearest is not None, "both were asked for"
    apart, near = nearest
    out = out[near[0], near[1]]
    return out, np.asarray(apart) <= GUTTER
