"""Triangle meshes that receive attention: welding, refinement, UV unwrapping, and ray casts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, import_extra, parameter
from nerg_mi.maths.arrays import copy_aligned, to_vector
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.medium import Medium
from nerg_mi.transport.mitsuba_mesh import make_mesh
from nerg_mi.transport.observer import ObserverSettings

# ---- Mesh ----


@dataclass(frozen=True, eq=False)
class Mesh:
    """``vertices`` (V, 3) float64 in scene units, and triangles ``faces`` (F, 3) int64."""

    vertices: np.ndarray
    faces: np.ndarray

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners of the triangles, (F, 3, 3)."""
        return self.vertices[self.faces]

    @cached_property
    def area(self) -> np.ndarray:
        """Area of the triangles, (F,), in square scene units."""
        return triangle_areas(self.corners)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals (F, 3), on the side from which the corners are counter-clockwise; 0 for degenerate faces."""
        across = _cross_products(self.corners)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        return across / np.where(length > 0, length, 1)

    @cached_property
    def vertex_area(self) -> np.ndarray:
        """Integral of the hat function of each vertex, (V,): a third of the area of its triangles."""
        return np.bincount(self.faces.ravel(), np.repeat(self.area / 3, 3), len(self.vertices))

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))


@dataclass(frozen=True)
class Repairs:
    """Repairs of a mesh: the numbers of merged vertices, of faces without area, and of duplicate faces that were
    removed."""

    num_merged_vertices: int
    num_degenerate_faces: int
    num_duplicate_faces: int

    @property
    def summary(self) -> str | None:
        """Description of the repairs, None if there were none."""
        parts = [
            f"{number:,} {what}"
            for number, what in (
                (self.num_merged_vertices, "duplicate vertices merged"),
                (self.num_degenerate_faces, "faces without area removed"),
                (self.num_duplicate_faces, "duplicate faces removed"),
            )
            if number
        ]
        return ", ".join(parts) or None


def triangle_areas(corners: np.ndarray) -> np.ndarray:
    """Return the area (...) of triangles (..., 3, 3)."""
    return 0.5 * np.linalg.norm(_cross_products(corners), axis=-1)


def _cross_products(corners: np.ndarray) -> np.ndarray:
    a, b, c = (corners[..., k, :] for k in range(3))
    return np.cross(b - a, c - a)


def weld_mesh(vertices: np.ndarray, faces: np.ndarray, label: str = "the mesh") -> tuple[Mesh, np.ndarray, Repairs]:
    """Create a mesh with unique vertices and without invalid faces. Return ``(Mesh, index, Repairs)``.

    Files duplicate vertices along edges where normals or colours are discontinuous; welding makes such surfaces
    connected, so that smoothing crosses these edges. Only vertices with exactly equal coordinates are merged. Faces
    without area, and duplicates of other faces, are removed.

    Parameters
    ----------
    vertices, faces
        Vertices (V, 3) and triangles (F, 3).
    label
        Name of the mesh in messages.

    Returns
    -------
    tuple
        The mesh, the indices (F',) of its faces in ``faces``, and the repairs.

    Raises
    ------
    NergError
        If vertices are not finite, or no face is left.
    """
    # Adding 0 converts negative zeros.
    vertices = np.ascontiguousarray(vertices, np.float64).reshape(-1, 3) + 0.0
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    check_coordinates(vertices, f"the vertices of {label}")
    used = np.unique(faces)
    unique, number = _unique_rows(vertices[used])
    positions = vertices[used[unique]]
    new_index = np.zeros(len(vertices), np.int64)
    new_index[used] = number
    joined = new_index[faces]
    a, b, c = (joined[:, k] for k in range(3))
    is_valid = (a != b) & (b != c) & (c != a)
    # Normalise to avoid underflow of the products of tiny edges.
    extent = float(np.abs(positions - positions.mean(0)).max(initial=0)) or 1.0
    is_valid[is_valid] = triangle_areas(positions[joined[is_valid]] / extent) > 0
    first, _ = _unique_rows(np.sort(joined[is_valid], axis=1))
    index = np.flatnonzero(is_valid)[np.sort(first)]
    if not len(index):
        raise NergError(f"{label} has no face with an area; export it again, as triangles")
    remaining, corner = np.unique(joined[index], return_inverse=True)
    mesh = Mesh(positions[remaining], corner.reshape(-1, 3).astype(np.int64))
    flat = int(len(faces) - is_valid.sum())
    return mesh, index, Repairs(len(used) - len(positions), flat, int(is_valid.sum() - len(index)))


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row of each group of equal rows (N, 3), and the group (N,) of each row."""
    order = np.lexsort(rows.T[::-1])
    new = np.r_[True, (rows[order[1:]] != rows[order[:-1]]).any(axis=1)] if len(rows) else np.zeros(0, bool)
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum(new) - 1
    return order[new], number


# ---- Refinement ----
#
# Edges that are too long are bisected in all of their triangles, so that no vertex lies in the middle of an edge of a
# neighbour and the surface stays connected. Triangles with one, two or three such edges are split into two, three or
# four ("red" and "green" refinement, Bank, Sherman, Weiser 1983).

MAX_REFINED_FACES = 8_000_000  # maximum number of faces of a refined mesh


@dataclass(frozen=True, eq=False)
class RefinedMesh:
    """A refined mesh: the parent face of each face, (F,), and the barycentric coordinates of its corners in the
    parent, (F, 3, 3)."""

    mesh: Mesh
    parent: np.ndarray
    barycentric: np.ndarray


def refine(mesh: Mesh, max_edge: float) -> RefinedMesh:
    """Refine ``mesh`` to edges of at most ``max_edge`` scene units.

    Raises `NergError` if the result has more than `MAX_REFINED_FACES` faces.
    """
    vertices, faces = mesh.vertices, mesh.faces
    parent, barycentric = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    while True:
        edges, of_face = _edges(faces)
        ends = vertices[edges]
        is_long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > max_edge
        if not is_long.any():
            return RefinedMesh(Mesh(vertices, faces), parent, barycentric)
        middle = np.full(len(edges), -1)
        middle[is_long] = len(vertices) + np.arange(np.count_nonzero(is_long))
        midpoint = middle[of_face]
        if len(faces) + np.count_nonzero(midpoint >= 0) > MAX_REFINED_FACES:
            raise NergError(
                f"edges of at most {max_edge:.3g} scene units make more than {MAX_REFINED_FACES:,} faces; use a "
                f"larger {parameter('max_edge')}"
            )
        vertices = np.concatenate([vertices, 0.5 * (ends[is_long, 0] + ends[is_long, 1])])
        faces, parent, barycentric = _split_faces(vertices, faces, midpoint, parent, barycentric)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (E, 2), and the index of the edge from each corner of a face to the next, (F, 3)."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    # Sorting one key per pair is ten times faster than sorting rows.
    count = int(faces.max()) + 1
    key, number = np.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    return np.stack([key // count, key % count], axis=1), number.reshape(-1, 3)


def _split_faces(vertices, faces, midpoint, parent, barycentric):
    """Split faces at the midpoints of their edges. Return faces, parents and barycentric coordinates.

    ``midpoint`` (F, 3) is the vertex in the middle of each edge, -1 for edges that are not split.
    """
    halves = 0.5 * (barycentric + np.roll(barycentric, -1, axis=1))
    all_vertices = np.concatenate([faces, midpoint], axis=1)
    all_barycentric = np.concatenate([barycentric, halves], axis=1)
    out: list[tuple[np.ndarray, np.ndarray]] = []
    is_split = midpoint >= 0
    number = is_split.sum(axis=1)
    # Vertices 0, 1, 2 are corners; 3, 4, 5 are the midpoints of the edges that start there.
    out.append(_repeat_triangles(np.flatnonzero(number == 0), ((0, 1, 2),)))
    out.append(_repeat_triangles(np.flatnonzero(number == 3), ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))))
    for k in range(3):
        a, b, c = k, (k + 1) % 3, (k + 2) % 3
        one_edge = np.flatnonzero((number == 1) & is_split[:, k])
        out.append(_repeat_triangles(one_edge, ((a, 3 + a, c), (3 + a, b, c))))
        # The edge that starts at c is not split; the adjacent quadrilateral is cut along its shorter diagonal.
        two_edges = np.flatnonzero((number == 2) & ~is_split[:, c])
        corner = vertices[all_vertices[two_edges]]
        first = np.linalg.norm(corner[:, a] - corner[:, 3 + b], axis=1)
        is_short = first <= np.linalg.norm(corner[:, 3 + a] - corner[:, c], axis=1)
        out.append(_repeat_triangles(two_edges, ((3 + a, b, 3 + b),)))
        out.append(_repeat_triangles(two_edges[is_short], ((a, 3 + a, 3 + b), (a, 3 + b, c))))
        out.append(_repeat_triangles(two_edges[~is_short], ((a, 3 + a, c), (3 + a, 3 + b, c))))
    rows, corners = (np.concatenate(part) for part in zip(*out))
    order = np.argsort(rows, kind="stable")
    rows, corners = rows[order], corners[order]
    return all_vertices[rows[:, None], corners], parent[rows], all_barycentric[rows[:, None], corners]


def _repeat_triangles(rows: np.ndarray, triangles) -> tuple[np.ndarray, np.ndarray]:
    """Repeat ``triangles`` for each of ``rows``."""
    corners = np.tile(np.array(triangles), (len(rows), 1))
    return np.repeat(rows, len(triangles)), corners


# ---- Ray casts ----

SELF_HIT_TOLERANCE = 1e-5
"""Relative distance within which a hit in front of a point does not occlude it, such as its own face or a neighbour."""


@dataclass(frozen=True, eq=False)
class RayEnds:
    """End points of N rays: face of the surface (N,) or -1, barycentric coordinates (N, 3), and whether the ray ends
    elsewhere (N,)."""

    face: np.ndarray
    barycentric: np.ndarray
    elsewhere: np.ndarray


class SurfaceTarget:
    """A mesh that receives attention, with everything that may occlude it.

    Parameters
    ----------
    mesh
        Mesh that receives attention.
    occluders
        Vertices and faces of other meshes.
    medium
        Medium that contains the meshes.
    settings
        Settings of an observer's rays. Default: those of the integrator ``nerg``.
    falloff
        Softness of occlusion boundaries; 0 for binary visibility.
    """

    def __init__(
        self,
        mesh: Mesh,
        occluders: list[tuple[np.ndarray, np.ndarray]] | None = None,
        medium: Medium | None = None,
        settings: ObserverSettings | None = None,
        falloff: float = 0.0,
    ):
        import mitsuba as mi

        self.mesh, self.falloff = mesh, falloff
        self._shape = make_mesh(mesh.vertices, mesh.faces, "surface")
        occluder_shapes = {f"other_{k}": make_mesh(v, f, f"other_{k}") for k, (v, f) in enumerate(occluders or ())}
        scene: Any = mi.load_dict({"type": "scene", "surface": self._shape, **occluder_shapes}, optimize=False)
        # The scene may wrap the shape in another object.
        self._shape = next(shape for shape in scene.shapes() if shape.id() == "surface")
        self.geometry = SceneGeometry(medium, scene)
        self.settings = settings or ObserverSettings(march=default_march_settings(self.geometry))

    @property
    def has_binary_visibility(self) -> bool:
        """Whether visibility is binary: shapes without a medium and without a fall-off."""
        return self.geometry.medium is None and self.falloff == 0

    def is_visible(self, observer: np.ndarray, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Return whether surface points (N, 3) in ``faces`` (N,) are visible to an observer at a position (3,).

        A point is visible if the ray towards it hits its own face, or nothing before the point. Requires binary
        visibility.
        """
        mi = variant_types()
        to_points = points - observer
        distance = np.linalg.norm(to_points, axis=1)
        d = to_vector(mi.Vector3f, to_points / np.where(distance > 0, distance, 1)[:, None])
        o = mi.Point3f(np.asarray(observer, np.float64).tolist())
        # A literal position would compile a new kernel for each observer.
        dr.make_opaque(o)
        count = len(points)
        with dr.suspend_grad():
            view = self.geometry.trace(mi.Ray3f(o, d), dr.full(mi.Bool, True, count), self.settings.march)
            assert view.shape_intersection is not None, "a target has shapes"
            is_own_face = (view.shape_intersection.shape == mi.ShapePtr(self._shape)) & (
                view.shape_intersection.prim_index == mi.UInt32(copy_aligned(faces, np.uint32).ravel())
            )
            is_seen = (
                ~view.hits_shape
                | is_own_face
                | (view.shape_distance >= mi.Float(copy_aligned(distance * (1 - SELF_HIT_TOLERANCE)).ravel()))
            )
        return np.broadcast_to(np.array(is_seen).astype(bool), (count,)) & (distance > 0)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> RayEnds:
        """Trace rays with ``origins`` and unit ``directions`` (N, 3) to their end points."""
        mi = variant_types()
        o, d = (to_vector(mi.Point3f, v) for v in (origins, directions))
        count = len(origins)
        with dr.suspend_grad():
            view = self.geometry.trace(mi.Ray3f(o, mi.Vector3f(d)), dr.full(mi.Bool, True, count), self.settings.march)
            assert view.shape_intersection is not None, "a target has shapes"
            hits_medium = view.medium_opacity >= self.settings.surface_opacity
            on_surface = view.hits_shape & ~hits_medium & (view.shape_intersection.shape == mi.ShapePtr(self._shape))
            uv, prim = view.shape_intersection.prim_uv, view.shape_intersection.prim_index
            dr.eval(on_surface, uv, prim, view.hits_shape, hits_medium)
        is_on_surface = np.array(on_surface).astype(bool)
        is_hit = np.broadcast_to(np.array(view.hits_shape | hits_medium).astype(bool), (count,))
        u, v = (np.array(c, np.float64) for c in (uv.x, uv.y))
        barycentric = np.stack([1 - u - v, u, v], axis=1)
        face = np.where(is_on_surface, np.array(prim).astype(np.int64), -1)
        return RayEnds(face, np.where(is_on_surface[:, None], barycentric, 0.0), is_hit & ~is_on_surface)


# ---- Textures ----
#
# UV unwrapping by xatlas, an optional dependency, and values as textures.

GUTTER_PIXELS = 4  # pixels by which values extend beyond the border of a chart, for texture filtering
TEXTURE_ROWS = 256  # number of texture rows per batch
MAX_CHART_FACES = 400_000  # maximum number of triangles for UV unwrapping


@dataclass(frozen=True, eq=False)
class Charts:
    """UV charts: mesh vertex of each UV vertex (W,), ``uv`` (W, 2) in 0..1 with v downwards, and ``faces`` (F, 3) of
    UV vertices in the order of the mesh."""

    vertex: np.ndarray
    uv: np.ndarray
    faces: np.ndarray


def import_xatlas() -> Any:
    """Import xatlas. Raises `ImportError` with a remedy if it is not installed."""
    return import_extra("xatlas", "a texture needs xatlas", "bake")


def unwrap_uv(mesh: Mesh, pixels: int) -> Charts:
    """Unwrap ``mesh`` into charts on a square of ``pixels`` per side without overlaps.

    Needs xatlas. Raises `NergError` for meshes that are too large.
    """
    xatlas = import_xatlas()
    if len(mesh.faces) > MAX_CHART_FACES:
        raise NergError(
            f"the mesh has {len(mesh.faces):,} triangles, but a texture supports at most {MAX_CHART_FACES:,}; omit "
            f"{parameter('texture_size')} to write vertex colours"
        )
    # Normalise to avoid underflow in single precision.
    unit = (mesh.vertices - mesh.vertices.mean(axis=0)) / (mesh.diagonal or 1.0)
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_mesh(unit.astype(np.float32), mesh.faces.astype(np.uint32))
    pack.padding, pack.resolution, pack.bruteForce = 2, pixels, False
    # Reduce the scale until all charts fit on one square.
    texels = 0.8 * pixels / np.sqrt(float((mesh.area / (mesh.diagonal or 1.0) ** 2).sum()))
    for _ in range(40):
        pack.texels_per_unit = float(texels)
        atlas.generate(xatlas.ChartOptions(), pack, False)
        if atlas.atlas_count == 1 and max(atlas.width, atlas.height) <= pixels:
            break
        texels *= 0.85
    else:
        raise NergError(
            f"the surface does not fit on {pixels} x {pixels} pixels; use a larger {parameter('texture_size')}"
        )
    vertex, faces, uv = atlas[0]
    # xatlas normalises by the size of its atlas, which may be smaller than the square.
    size = np.array([atlas.width, atlas.height], np.float64)
    return Charts(vertex.astype(np.int64), uv.astype(np.float64) * size / pixels, faces.astype(np.int64))


def iter_texture_rows(
    charts: Charts, refined: RefinedMesh, values: np.ndarray, pixels: int
) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Rasterise ``values`` (V,) on the vertices of ``refined`` to a square texture.

    Yields ``(rows, values (n, pixels), mask (n, pixels))`` in batches of rows, since a whole texture of 8192 x 8192
    would need 5 GB. Values are interpolated linearly in each triangle and extended over a gutter around the charts.
    Raises `NergError` if no texel shows the surface.
    """
    import mitsuba as mi
    from scipy.ndimage import distance_transform_edt

    corners = np.einsum("fij,fjk->fik", refined.barycentric, charts.uv[charts.faces[refined.parent]])
    flat = np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=2).reshape(-1, 3)
    # Find the triangle under the centre of each texel by a ray cast.
    sheet = make_mesh(flat, np.arange(len(flat)).reshape(-1, 3), "charts")
    scene: Any = mi.load_dict({"type": "scene", "charts": sheet})
    center = (np.arange(pixels) + 0.5) / pixels
    is_empty = True
    for start in range(0, pixels, TEXTURE_ROWS):
        stop = min(start + TEXTURE_ROWS, pixels)
        # Include neighbouring rows for the gutter.
        first, last = max(start - GUTTER_PIXELS, 0), min(stop + GUTTER_PIXELS, pixels)
        u, v = (c.ravel() for c in np.meshgrid(center, center[first:last]))
        origins = mi.Point3f(np.stack([u, v, np.ones_like(u)]).astype(np.float32))
        with dr.suspend_grad():
            intersection = scene.ray_intersect_preliminary(mi.Ray3f(origins, mi.Vector3f(0, 0, -1)), coherent=True)
            hit, face = (
                np.array(intersection.is_valid()).astype(bool),
                np.array(intersection.prim_index).astype(np.int64),
            )
            b, c = np.where(hit, np.array(intersection.prim_uv), 0).astype(np.float64)
        corner_values = values[refined.mesh.faces[np.where(hit, face, 0)]]
        out = np.where(hit, corner_values[:, 0] * (1 - b - c) + corner_values[:, 1] * b + corner_values[:, 2] * c, 0.0)
        out, hit = out.reshape(-1, pixels), hit.reshape(-1, pixels)
        if hit.any():
            is_empty = False
            nearest = distance_transform_edt(~hit, return_indices=True)
            assert nearest is not None, "distances and indices are requested"
            distance, index = nearest
            out, hit = out[index[0], index[1]], np.asarray(distance) <= GUTTER_PIXELS
        rows = slice(start, stop)
        batch = slice(start - first, stop - first)
        yield rows, out[batch], hit[batch]
    if is_empty:
        raise NergError(
            f"no pixel of a texture of {pixels} x {pixels} shows the surface; give a larger {parameter('texture_size')}"
        )
