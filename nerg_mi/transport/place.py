"""What a ray meets in a place that consists of a medium, of shapes, or of both.

A shape hides the medium behind it; the medium in front attenuates the shape. What reaches a shape is
absorbed there, all of it, at the exact distance of the ray cast: a shape is a jump of the optical depth
to infinity, and every kind of depth means the same with and without one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.types import Bool, Float, Point3f, Ray3f, Vector3f

from .march.depth import DEPTHS, escape_distance, surface_depth
from .march.march import scouted_march
from .march.settings import MarchResult, MarchSettings
from .media.protocol import Medium

if TYPE_CHECKING:
    import mitsuba as mi


@dataclass
class SceneRay:
    """A ray for a place without shapes, which needs no Mitsuba: origin, unit direction and greatest distance, in the
    scene's frame."""

    o: Point3f
    d: Vector3f
    maxt: Float


@dataclass
class View:
    """What one ray meets. Attached to whatever carries derivatives."""

    # The medium's part; None without a medium.
    march: MarchResult | None
    # Whether a shape ends the ray, and its distance in scene units, infinite without one.
    hit: Bool
    distance: Float
    # Opacity of everything: 1 where a shape is hit.
    opacity: Float
    # Opacity of the medium in front of the shape.
    front: Float
    # Mitsuba's preliminary intersection; None without shapes.
    cast: mi.PreliminaryIntersection3f | None
    # What `depth` does.
    find_depth: Callable[[str, Bool], Float]

    def depth(self, kind: str, active: Bool) -> Float:
        """Depth of ``kind`` (a name in ``depth.DEPTHS``) in scene units from the ray's origin; 0 where nothing is
        met."""
        return self.find_depth(kind, active)

    def meets(self, surface_opacity: float) -> Bool:
        """Whether there is a surface: matter at all, and as much of it as ``surface_opacity``, which may be 0."""
        return (self.opacity > 0) & (self.opacity >= surface_opacity)

    def penetration(self, kind: str, depth: Float) -> Float:
        """How far light goes into the matter before the surface at ``depth`` (of ``kind``), in scene units; 0 on a
        shape."""
        return 0 if self.march is None else escape_distance(kind, self.march, depth)


class Place:
    """A medium, the shapes of a Mitsuba scene, or both: all that rays are traced through.

    Positions and distances are the scene's. ``medium``: or None; ``scene``: the scene whose shapes are met, or None,
    which is what ``self.scene`` is for a scene without any. Holds nothing that a change of the medium's parameters or
    of a shape would make wrong. Raises ``NergError`` for shapes that `check_shape` refuses.
    """

    def __init__(self, medium: Medium | None, scene: mi.Scene | None = None):
        self.medium = medium
        shapes = [] if scene is None else scene.shapes()
        self.scene = scene if len(shapes) > 0 else None
        for shape in shapes:
            check_shape(shape)

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box of all shapes, in scene units."""
        return float(np.linalg.norm(np.subtract(*self.corners())))

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the bounding box of all shapes, (3,) each. There must be shapes."""
        corners = [corners_of(shape) for shape in ([] if self.scene is None else self.scene.shapes())]
        return np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)

    def bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper corner (3,) of the medium and the shapes; of a medium without an end those of its inner cube.
        None where there is neither."""
        corners = [] if self.medium is None else [self.medium.bounds()]
        corners += [] if self.scene is None else [self.corners()]
        return (np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)) if corners else None

    def extent(self, *points: ArrayLike) -> float:
        """Length of the diagonal of a box around what there is and ``points`` (3,), in scene units."""
        return float(np.linalg.norm(np.ptp([*(self.bounds() or ()), *(np.asarray(p, float) for p in points)], axis=0)))

    def trace(self, ray: Ray3f | SceneRay, active: Bool, settings: MarchSettings, **options: Any) -> View:
        """What ``ray`` meets up to its ``maxt``; without shapes a ``SceneRay`` will do.

        ``settings``: of the march; ``options``: those of ``march.march``. Differentiable in the ray, in the medium's
        parameters and, through the distances of ray casts, in the positions of shapes (not over their silhouettes).
        """
        Float = type(ray.maxt)
        end = ray.maxt
        hit, distance, cast = dr.mask_t(Float)(False), Float(dr.inf), None
        if self.scene is not None:
            cast, distance = _cast(self.scene, ray, active)
            hit = active & (distance < end)
            distance = dr.select(hit, distance, dr.inf)
        if self.medium is None:
            opacity = dr.select(hit, Float(1), 0)
            at_shape = lambda kind, active: dr.select(active & hit, distance, 0)
            return View(None, hit, distance, opacity, Float(0), cast, at_shape)

        medium = self.medium
        local = medium.local(ray.o, ray.d)
        t0, t1 = dr.maximum(local.t_near, 0), dr.minimum(dr.minimum(local.t_far, end), distance)
        result = scouted_march(medium, local, t0, t1, active, settings, **options)
        front = result.opacity
        if self.scene is None:
            in_medium = lambda kind, active: surface_depth(kind, result, medium, local, t0, t1, active, settings)
            return View(result, hit, distance, front, front, None, in_medium)

        def in_both(kind, active):
            some = active & (front > 0)
            inside = surface_depth(kind, result, medium, local, t0, t1, some, settings, backed=hit)
            through = DEPTHS.find(kind).with_shape(result, front, inside, hit, distance)
            return dr.select(active & hit, through, dr.select(some, inside, 0))

        return View(result, hit, distance, dr.select(hit, 1, front), front, cast, in_both)


def as_place(subject: Medium | Place) -> Place:
    """``subject`` itself, or the place that consists of this medium alone."""
    return subject if isinstance(subject, Place) else Place(subject)


def check_shape(shape: Any, of: str = "", merged: bool = False) -> None:
    """Raise `NergError` for a mesh without faces and for a shape that is not finite, or reaches beyond `FARTHEST`.

    ``of``: what a message says of the scene that it is in. ``merged``: whether meshes that Mitsuba has merged, whose
    boxes are unset, are looked at by their vertices, which are computed for it.
    """
    if shape.is_mesh() and shape.face_count() == 0:
        # Mitsuba 3.9.1 builds a scene of it, but cannot shade what it does not meet.
        raise NergError(f'the mesh "{shape.id()}"{of} has no faces; take it out of the scene')
    if merged or shape.bbox().valid() or not shape.is_mesh():
        name = f'shape "{shape.id()}"' if shape.id() else shape.class_name()
        check_coordinates(np.array(corners_of(shape), float), f"the corners of the {name}{of}")


def corners_of(shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the bounding box of ``shape``, (3,) each, in scene units."""
    box = shape.bbox()
    # Boxes of NaN are not valid, either.
    if box.valid() or not shape.is_mesh():
        return np.array(box.min), np.array(box.max)
    # Mitsuba 3.9.1 leaves the boxes of meshes that it has merged unset.
    import mitsuba as mi

    vertices = np.asarray(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
    return vertices.min(0), vertices.max(0)


def _cast(scene: Any, ray: Ray3f, active: Bool) -> tuple[mi.PreliminaryIntersection3f, Float]:
    """The nearest intersection with a shape, and its distance with derivatives where any are tracked."""
    import mitsuba as mi

    ray = mi.Ray3f(ray)
    with dr.suspend_grad():
        cast = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    distance = cast.t
    if dr.grad_enabled(ray.o, ray.d) or scene.shapes_grad_enabled():
        distance = cast.compute_surface_interaction(ray, mi.RayFlags.Minimal, active).t
    return cast, distance
