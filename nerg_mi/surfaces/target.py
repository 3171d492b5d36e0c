"""A surface among all that may hide it, as rays are cast at it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import aligned, vector_of
from nerg_mi.transport.media.protocol import Medium
from nerg_mi.transport.observer.settings import ObserverSettings
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import default_settings

from .mesh import Mesh

SURFACE_OPACITY = 0.5
"""Opacity of a medium from which on a ray ends in it."""

NEAR = 1e-5
"""What a ray meets so near before a point, as a share of the distance, does not hide it: its own face, a neighbour."""


@dataclass(frozen=True, eq=False)
class Ends:
    """Where N rays end: ``face`` (N,) of the surface, or -1; ``place`` (N, 3), barycentric coordinates on it;
    ``elsewhere`` (N,) bool: at something else."""

    face: np.ndarray
    place: np.ndarray
    elsewhere: np.ndarray


class Target:
    """``mesh``, which receives attention, ``others``, meshes that hide it, and a ``medium`` that both stand in, with
    ``place``, in which all of it is traced.

    ``settings``: of an observer's rays; by default those of the integrator ``nerg`` with nothing set, and ``falloff``
    0, by which a point is either seen or not.
    """

    def __init__(
        self,
        mesh: Mesh,
        others: list[tuple[np.ndarray, np.ndarray]] | None = None,
        medium: Medium | None = None,
        settings: ObserverSettings | None = None,
        falloff: float = 0.0,
    ):
        import mitsuba as mi

        self.mesh, self.falloff = mesh, falloff
        self._shape = mitsuba_mesh(mesh.vertices, mesh.faces, "surface")
        hiding = {f"other_{k}": mitsuba_mesh(v, f, f"other_{k}") for k, (v, f) in enumerate(others or ())}
        scene: Any = mi.load_dict({"type": "scene", "surface": self._shape, **hiding}, optimize=False)
        # What a scene is made of is given to it, and may come out as another object.
        self._shape = next(shape for shape in scene.shapes() if shape.id() == "surface")
        self.place = Place(medium, scene)
        self.settings = settings or ObserverSettings(
            march=default_settings(self.place), surface_opacity=SURFACE_OPACITY
        )

    @property
    def sharp(self) -> bool:
        """Whether what is met hides all that is behind it: shapes alone, without a medium, and without a fall-off."""
        return self.place.medium is None and self.falloff == 0

    def sees(self, eye: np.ndarray, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Whether ``eye`` (3,) sees ``points`` (N, 3) of the surface, which lie in its ``faces`` (N,); of `sharp`
        targets. A point is seen where the ray at it ends at its own face, however obliquely, or not before it."""
        import mitsuba as mi

        to = points - eye
        distance = np.linalg.norm(to, axis=1)
        d = vector_of(mi.Vector3f, to / np.where(distance > 0, distance, 1)[:, None])
        o = mi.Point3f(np.asarray(eye, np.float64).tolist())
        # A position that is a constant of the kernel would be compiled anew for every observer.
        dr.make_opaque(o)
        count = len(points)
        with dr.suspend_grad():
            view = self.place.trace(mi.Ray3f(o, d), dr.full(mi.Bool, True, count), self.settings.march)
            assert view.cast is not None, "a target has shapes"
            own = (view.cast.shape == mi.ShapePtr(self._shape)) & (
                view.cast.prim_index == mi.UInt32(aligned(faces, np.uint32))
            )
            seen = ~view.hit | own | (view.distance >= mi.Float(aligned(distance * (1 - NEAR))))
        return np.broadcast_to(np.array(seen).astype(bool), (count,)) & (distance > 0)

    def ends(self, origins: np.ndarray, directions: np.ndarray) -> Ends:
        """Where rays with ``origins`` (N, 3) and unit ``directions`` (N, 3) end."""
        import mitsuba as mi

        o, d = (vector_of(mi.Point3f, v) for v in (origins, directions))
        count = len(origins)
        with dr.suspend_grad():
            view = self.place.trace(mi.Ray3f(o, mi.Vector3f(d)), dr.full(mi.Bool, True, count), self.settings.march)
            assert view.cast is not None, "a target has shapes"
            before = view.front >= self.settings.surface_opacity
            on = view.hit & ~before & (view.cast.shape == mi.ShapePtr(self._shape))
            uv, prim = view.cast.prim_uv, view.cast.prim_index
            dr.eval(on, uv, prim, view.hit, before)
        on_it = np.array(on).astype(bool)
        met = np.broadcast_to(np.array(view.hit | before).astype(bool), (count,))
        u, v = (np.array(c, np.float64) for c in (uv.x, uv.y))
        place = np.stack([1 - u - v, u, v], axis=1)
        face = np.where(on_it, np.array(prim).astype(np.int64), -1)
        return Ends(face, np.where(on_it[:, None], place, 0.0), met & ~on_it)


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
