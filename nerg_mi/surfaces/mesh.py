"""Triangle meshes as attention is put on them: read from scenes, connected, refined, unrolled into a texture, and
cast at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, import_extra
from nerg_mi.maths.arrays import copy_aligned, to_vector
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.medium import Medium
from nerg_mi.transport.observer import ObserverSettings

# ---- Mesh ----
#
# Triangle meshes as attention is put on them: connected where they touch, and without faces that are none.


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
        """Area (F,) of the triangles, square scene units."""
        return triangle_areas(self.corners)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals (F, 3), to the side that sees the corners counter-clockwise; 0 of faces without area."""
        across = _across(self.corners)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        return across / np.where(length > 0, length, 1)

    @cached_property
    def vertex_area(self) -> np.ndarray:
        """A third of the area of the triangles around each vertex, (V,): the integral of its hat function."""
        return np.bincount(self.faces.ravel(), np.repeat(self.area / 3, 3), len(self.vertices))

    @property
    def diagonal(self) -> float:
        """Diagonal of the box around all vertices."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))


@dataclass(frozen=True)
class Repairs:
    """What of a mesh was put right: ``merged`` vertices that lay on others, and faces left out: ``flat`` ones without
    area, and ``repeated`` ones with the corners of another."""

    merged: int
    num_degenerate_faces: int
    repeated: int

    @property
    def summary(self) -> str | None:
        """What was done, None where nothing was."""
        said = [
            f"{number:,} {what}"
            for number, what in (
                (self.merged, "vertices that lie on others merged"),
                (self.num_degenerate_faces, "faces without area left out"),
                (self.repeated, "faces that repeat others left out"),
            )
            if number
        ]
        return ", ".join(said) or None


def triangle_areas(corners: np.ndarray) -> np.ndarray:
    """Area (...) of triangles (..., 3, 3)."""
    return 0.5 * np.linalg.norm(_across(corners), axis=-1)


def _across(corners: np.ndarray) -> np.ndarray:
    a, b, c = (corners[..., k, :] for k in range(3))
    return np.cross(b - a, c - a)


def weld_mesh(vertices: np.ndarray, faces: np.ndarray, what: str = "the mesh") -> tuple[Mesh, np.ndarray, Repairs]:
    """The mesh of ``vertices`` (V, 3) and ``faces`` (F, 3) with one vertex for each place, ``(mesh, index, repairs)``.

    Files repeat vertices along edges where normals or colours jump; surfaces that touch there are one surface, and
    smoothing goes on over it. Only vertices of exactly equal coordinates are one: plates a hair apart stay apart. Faces
    without area receive nothing and faces with the corners of another would receive it twice: both are left out.
    ``index`` (F',): which of ``faces`` the mesh's are. Raises `NergError`, about ``what``, for vertices that are not
    finite, and where no face is left.
    """
    # A zero may be negative, and is the same place.
    vertices = np.ascontiguousarray(vertices, np.float64).reshape(-1, 3) + 0.0
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    check_coordinates(vertices, f"the vertices of {what}")
    kept = np.unique(faces)
    one, number = _unique_rows(vertices[kept])
    place = vertices[kept[one]]
    of = np.zeros(len(vertices), np.int64)
    of[kept] = number
    joined = of[faces]
    a, b, c = (joined[:, k] for k in range(3))
    whole = (a != b) & (b != c) & (c != a)
    # Products of tiny edges vanish before the edges do.
    extent = float(np.abs(place - place.mean(0)).max(initial=0)) or 1.0
    whole[whole] = triangle_areas(place[joined[whole]] / extent) > 0
    first, _ = _unique_rows(np.sort(joined[whole], axis=1))
    index = np.flatnonzero(whole)[np.sort(first)]
    if not len(index):
        raise NergError(f"{what} has no face with an area; export it again, as triangles")
    left, corner = np.unique(joined[index], return_inverse=True)
    mesh = Mesh(place[left], corner.reshape(-1, 3).astype(np.int64))
    flat = int(len(faces) - whole.sum())
    return mesh, index, Repairs(len(kept) - len(place), flat, int(whole.sum() - len(index)))


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(first, number)`` of rows (N, 3) that are equal: the first of each kind, and the kind (N,) of each."""
    order = np.lexsort(rows.T[::-1])
    new = np.r_[True, (rows[order[1:]] != rows[order[:-1]]).any(axis=1)] if len(rows) else np.zeros(0, bool)
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum(new) - 1
    return order[new], number


# ---- Shapes of Mitsuba scenes as triangles ----

Triangles = tuple[np.ndarray, np.ndarray]  # vertices (V, 3) float64 and faces (F, 3) int64


def shape_triangles(shape: Any) -> Triangles | None:
    """Those of a shape of a Mitsuba scene, in the scene; None of a shape that has none."""
    if not shape.is_mesh():
        return None
    vertices = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    return vertices, np.array(shape.faces_buffer(), np.int64).reshape(-1, 3)


# ---- Triangles cut until none of their edges is longer than attention is to be resolved ----
#
# An edge that is too long is halved in all triangles that have it, so that no vertex comes to lie in the middle of an
# edge of a neighbour: a surface stays as connected as it was. Triangles of one, two or three such edges become two,
# three or four (Bank, Sherman, Weiser 1983, "red" and "green").

MOST_REFINED_FACES = 8_000_000  # a refined mesh has so many faces at most


@dataclass(frozen=True, eq=False)
class RefinedMesh:
    """``mesh`` cut of another: ``parent`` (F,) the face of that which each face lies in, and ``place`` (F, 3, 3), of
    each of its corners the barycentric coordinates there."""

    mesh: Mesh
    parent: np.ndarray
    barycentric: np.ndarray


def refine(mesh: Mesh, longest: float) -> RefinedMesh:
    """``mesh`` with edges of at most ``longest`` scene units. Raises `NergError` for more than `MOST_REFINED_FACES`
    faces."""
    vertices, faces = mesh.vertices, mesh.faces
    parent, place = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    while True:
        edges, of_face = _edges(faces)
        ends = vertices[edges]
        long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > longest
        if not long.any():
            return RefinedMesh(Mesh(vertices, faces), parent, place)
        middle = np.full(len(edges), -1)
        middle[long] = len(vertices) + np.arange(np.count_nonzero(long))
        cut = middle[of_face]
        if len(faces) + np.count_nonzero(cut >= 0) > MOST_REFINED_FACES:
            raise NergError(
                f"edges of at most {longest:.3g} scene units make more than {MOST_REFINED_FACES:,} faces; give a "
                "larger --detail"
            )
        vertices = np.concatenate([vertices, 0.5 * (ends[long, 0] + ends[long, 1])])
        faces, parent, place = _cut(vertices, faces, cut, parent, place)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2), and the number (F, 3) of that from each corner of a face to the next."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    # One number a pair sorts in a tenth of the time that rows take.
    count = int(faces.max()) + 1
    key, number = np.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    return np.stack([key // count, key % count], axis=1), number.reshape(-1, 3)


def _cut(vertices, faces, cut, parent, place):
    """Faces, parents and places after their edges were halved; ``cut`` (F, 3): the vertex in the middle of each edge,
    -1 of those that stay."""
    halves = 0.5 * (place + np.roll(place, -1, axis=1))
    known = np.concatenate([faces, cut], axis=1)
    where = np.concatenate([place, halves], axis=1)
    out: list[tuple[np.ndarray, np.ndarray]] = []
    marks = cut >= 0
    number = marks.sum(axis=1)
    # Corners 0, 1, 2, and 3, 4, 5 in the middle of the edges behind them.
    out.append(_taken(np.flatnonzero(number == 0), ((0, 1, 2),)))
    out.append(_taken(np.flatnonzero(number == 3), ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))))
    for k in range(3):
        a, b, c = k, (k + 1) % 3, (k + 2) % 3
        only = np.flatnonzero((number == 1) & marks[:, k])
        out.append(_taken(only, ((a, 3 + a, c), (3 + a, b, c))))
        # The edge behind c stays, and the quadrangle beside it is cut along its shorter diagonal.
        both = np.flatnonzero((number == 2) & ~marks[:, c])
        corner = vertices[known[both]]
        first = np.linalg.norm(corner[:, a] - corner[:, 3 + b], axis=1)
        short = first <= np.linalg.norm(corner[:, 3 + a] - corner[:, c], axis=1)
        out.append(_taken(both, ((3 + a, b, 3 + b),)))
        out.append(_taken(both[short], ((a, 3 + a, 3 + b), (a, 3 + b, c))))
        out.append(_taken(both[~short], ((a, 3 + a, c), (3 + a, 3 + b, c))))
    rows, corners = (np.concatenate(part) for part in zip(*out))
    order = np.argsort(rows, kind="stable")
    rows, corners = rows[order], corners[order]
    return known[rows[:, None], corners], parent[rows], where[rows[:, None], corners]


def _taken(rows: np.ndarray, triangles) -> tuple[np.ndarray, np.ndarray]:
    """Each of ``triangles``, three corners, for each of ``rows``."""
    corners = np.tile(np.array(triangles), (len(rows), 1))
    return np.repeat(rows, len(triangles)), corners


# ---- A surface among all that may hide it, as rays are cast at it ----

SURFACE_OPACITY = 0.5  # opacity of a medium from which on a ray ends in it

NEAR = 1e-5
"""What a ray meets so near before a point, as a share of the distance, does not hide it: its own face, a neighbour."""


@dataclass(frozen=True, eq=False)
class RayEnds:
    """Where N rays end: ``face`` (N,) of the surface, or -1; ``place`` (N, 3), barycentric coordinates on it;
    ``elsewhere`` (N,) bool: at something else."""

    face: np.ndarray
    barycentric: np.ndarray
    elsewhere: np.ndarray


class SurfaceTarget:
    """``mesh``, which receives attention, ``others``, meshes that hide it, and a ``medium`` that both stand in, with
    ``place``, in which all of it is traced.

    ``settings``: of an observer's rays; by default those of the integrator ``nerg`` with nothing set, and ``falloff``
    0, by which a point is either seen or not.
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
        self._shape = mitsuba_mesh(mesh.vertices, mesh.faces, "surface")
        hiding = {f"other_{k}": mitsuba_mesh(v, f, f"other_{k}") for k, (v, f) in enumerate(occluders or ())}
        scene: Any = mi.load_dict({"type": "scene", "surface": self._shape, **hiding}, optimize=False)
        # What a scene is made of is given to it, and may come out as another object.
        self._shape = next(shape for shape in scene.shapes() if shape.id() == "surface")
        self.geometry = SceneGeometry(medium, scene)
        self.settings = settings or ObserverSettings(
            march=default_march_settings(self.geometry), surface_opacity=SURFACE_OPACITY
        )

    @property
    def has_binary_visibility(self) -> bool:
        """Whether what is met hides all that is behind it: shapes alone, without a medium, and without a fall-off."""
        return self.geometry.medium is None and self.falloff == 0

    def is_visible(self, observer: np.ndarray, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Whether ``eye`` (3,) sees ``points`` (N, 3) of the surface, which lie in its ``faces`` (N,); of `sharp`
        targets. A point is seen where the ray at it ends at its own face, however obliquely, or not before it."""
        mi = variant_types()
        to = points - observer
        distance = np.linalg.norm(to, axis=1)
        d = to_vector(mi.Vector3f, to / np.where(distance > 0, distance, 1)[:, None])
        o = mi.Point3f(np.asarray(observer, np.float64).tolist())
        # A position that is a constant of the kernel would be compiled anew for every observer.
        dr.make_opaque(o)
        count = len(points)
        with dr.suspend_grad():
            view = self.geometry.trace(mi.Ray3f(o, d), dr.full(mi.Bool, True, count), self.settings.march)
            assert view.shape_intersection is not None, "a target has shapes"
            own = (view.shape_intersection.shape == mi.ShapePtr(self._shape)) & (
                view.shape_intersection.prim_index == mi.UInt32(copy_aligned(faces, np.uint32).ravel())
            )
            seen = ~view.hits_shape | own | (view.shape_distance >= mi.Float(copy_aligned(distance * (1 - NEAR)).ravel()))
        return np.broadcast_to(np.array(seen).astype(bool), (count,)) & (distance > 0)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> RayEnds:
        """Where rays with ``origins`` (N, 3) and unit ``directions`` (N, 3) end."""
        mi = variant_types()
        o, d = (to_vector(mi.Point3f, v) for v in (origins, directions))
        count = len(origins)
        with dr.suspend_grad():
            view = self.geometry.trace(mi.Ray3f(o, mi.Vector3f(d)), dr.full(mi.Bool, True, count), self.settings.march)
            assert view.shape_intersection is not None, "a target has shapes"
            before = view.medium_opacity >= self.settings.surface_opacity
            on = view.hits_shape & ~before & (view.shape_intersection.shape == mi.ShapePtr(self._shape))
            uv, prim = view.shape_intersection.prim_uv, view.shape_intersection.prim_index
            dr.eval(on, uv, prim, view.hits_shape, before)
        on_it = np.array(on).astype(bool)
        met = np.broadcast_to(np.array(view.hits_shape | before).astype(bool), (count,))
        u, v = (np.array(c, np.float64) for c in (uv.x, uv.y))
        place = np.stack([1 - u - v, u, v], axis=1)
        face = np.where(on_it, np.array(prim).astype(np.int64), -1)
        return RayEnds(face, np.where(on_it[:, None], place, 0.0), met & ~on_it)


def mitsuba_mesh(vertices: np.ndarray, faces: np.ndarray, name: str, bsdf: Mapping[str, Any] | None = None) -> Any:
    """Triangles as a Mitsuba mesh of the variant in use, with the id ``name`` and the ``bsdf`` of a dict."""
    import mitsuba as mi

    props = mi.Properties()
    props.set_id(name)
    if bsdf is not None:
        props["bsdf"] = mi.load_dict(dict(bsdf))
    mesh: Any = mi.Mesh(name, len(vertices), len(faces), props=props)
    params: Any = mi.traverse(mesh)
    params["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    params.update()
    return mesh


# ---- Charts ----
#
# A surface unrolled into a square, and values on it as a texture: charts by xatlas, an optional extra.

GUTTER = 4  # pixels by which colours go on beyond the border of a chart, for filters that look there
TEXTURE_ROWS = 256  # rows of a texture that are computed at once
MOST_CHART_FACES = 400_000  # a mesh of more triangles is not unrolled


@dataclass(frozen=True, eq=False)
class Charts:
    """``vertex`` (W,): of which vertex of the mesh each corner on the square is; ``uv`` (W, 2), from 0 to 1, v down the
    picture; ``faces`` (F, 3) of such corners, in the mesh's order."""

    vertex: np.ndarray
    uv: np.ndarray
    faces: np.ndarray


def import_xatlas() -> Any:
    """The package xatlas; `ImportError` with the remedy where it is not installed."""
    return import_extra("xatlas", "a texture needs xatlas", "bake")


def unwrap_uv(mesh: Mesh, pixels: int) -> Charts:
    """``mesh`` cut into charts that fill a square of ``pixels`` a side without overlaps. Needs xatlas; raises
    `NergError` for meshes that are too large."""
    xatlas = import_xatlas()
    if len(mesh.faces) > MOST_CHART_FACES:
        raise NergError(
            f"a mesh of {len(mesh.faces):,} triangles is not unrolled into a texture, but up to "
            f"{MOST_CHART_FACES:,}; leave "
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


def iter_texture_rows(
    charts: Charts, refined: RefinedMesh, values: np.ndarray, pixels: int
) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """``values`` (V,) on the vertices of ``refined``, of whose whole mesh ``charts`` are, as a square texture.

    Yields ``(rows, values (n, pixels), known (n, pixels) bool)``, some rows at a time: the memory of a whole texture of
    8192 x 8192 would be 5 GB. Values are linear in every triangle, and carried on over a gutter around charts. Raises
    `NergError`, at the end, where no texel shows the surface.
    """
    import mitsuba as mi
    from scipy.ndimage import distance_transform_edt

    corners = np.einsum("fij,fjk->fik", refined.barycentric, charts.uv[charts.faces[refined.parent]])
    flat = np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=2).reshape(-1, 3)
    # A texel shows what lies under its centre, which is found as all else is: by a ray.
    sheet = mitsuba_mesh(flat, np.arange(len(flat)).reshape(-1, 3), "charts")
    scene: Any = mi.load_dict({"type": "scene", "charts": sheet})
    center = (np.arange(pixels) + 0.5) / pixels
    is_empty = True
    for start in range(0, pixels, TEXTURE_ROWS):
        stop = min(start + TEXTURE_ROWS, pixels)
        # The rows around them too, from which a gutter may reach in.
        first, last = max(start - GUTTER, 0), min(stop + GUTTER, pixels)
        u, v = (c.ravel() for c in np.meshgrid(center, center[first:last]))
        above = mi.Point3f(np.stack([u, v, np.ones_like(u)]).astype(np.float32))
        with dr.suspend_grad():
            found = scene.ray_intersect_preliminary(mi.Ray3f(above, mi.Vector3f(0, 0, -1)), coherent=True)
            hit, face = np.array(found.is_valid()).astype(bool), np.array(found.prim_index).astype(np.int64)
            b, c = np.where(hit, np.array(found.prim_uv), 0).astype(np.float64)
        of_corners = values[refined.mesh.faces[np.where(hit, face, 0)]]
        out = np.where(hit, of_corners[:, 0] * (1 - b - c) + of_corners[:, 1] * b + of_corners[:, 2] * c, 0.0)
        out, hit = out.reshape(-1, pixels), hit.reshape(-1, pixels)
        if hit.any():
            is_empty = False
            nearest = distance_transform_edt(~hit, return_indices=True)
            assert nearest is not None, "both were asked for"
            distance, index = nearest
            out, hit = out[index[0], index[1]], np.asarray(distance) <= GUTTER
        rows = slice(start, stop)
        inside = slice(start - first, stop - first)
        yield rows, out[inside], hit[inside]
    if is_empty:
        raise NergError(f"no pixel of a texture of {pixels} x {pixels} shows the surface; give a larger --texture")
