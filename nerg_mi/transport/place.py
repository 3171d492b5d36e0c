"""What a ray meets in a place that consists of a medium, of shapes, or of both.

A shape hides the medium behind it; the medium in front attenuates the shape. What reaches a shape is
absorbed there, all of it, at the exact distance of the ray cast: a shape is a jump of the optical depth
to infinity, and every kind of depth means the same with and without one.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError

from .march.depth import escape_distance, surface_depth
from .march.primal import MarchResult, scouted_march


@dataclass
class View:
    """What one ray meets. ``march``: the medium's part (None without one); ``hit``: whether a shape ends the ray;
    ``distance``: to that shape (infinite without one); ``opacity``: of everything, 1 where a shape is hit;
    ``front``: opacity of the medium in front of it; ``cast``: Mitsuba's preliminary intersection (None without shapes).
    """

    march: MarchResult | None
    hit: object
    distance: object
    opacity: object
    front: object
    cast: object
    _depth: object

    def depth(self, kind: str, active):
        """Depth of ``kind`` (``depth.KINDS``), 0 where nothing is met."""
        return self._depth(kind, active)

    def meets(self, surface_opacity: float):
        """Whether there is a surface: matter at all, and as much of it as ``surface_opacity``, which may be 0."""
        return (self.opacity > 0) & (self.opacity >= surface_opacity)

    def penetration(self, kind: str, depth):
        """How far light goes into the matter before the surface at ``depth``; 0 on a shape."""
        return 0 if self.march is None else escape_distance(kind, self.march, depth)


class Place:
    """``medium``: a ``media`` medium or None; ``scene``: the Mitsuba scene whose shapes are met, or None. Raises
    ``NergError`` for meshes that have no faces."""

    def __init__(self, medium, scene=None):
        self.medium = medium
        shapes = [] if scene is None else scene.shapes()
        self.scene = scene if len(shapes) > 0 else None
        for shape in shapes:
            if shape.is_mesh() and shape.face_count() == 0:
                # Mitsuba 3.9.1 builds a scene of it, but cannot shade what it does not meet.
                raise NergError(f'the mesh "{shape.id()}" has no faces; take it out of the scene')

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box of all shapes, in scene units."""
        return float(np.linalg.norm(np.subtract(*self.corners())))

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the bounding box of all shapes."""
        corners = [_corners(shape) for shape in self.scene.shapes()]
        return np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)

    def trace(self, ray, active, settings, *, far=dr.inf, **options) -> View:
        """Trace ``ray`` (a Mitsuba ray; its ``maxt`` counts) up to the distance ``far``.

        ``options``: those of ``march.march``. Differentiable in the ray, in the medium's parameters and, through
        the distances of ray casts, in the positions of shapes (not over their silhouettes).
        """
        Float = type(ray.maxt)
        end = dr.minimum(ray.maxt, far)
        hit, distance, cast = dr.mask_t(Float)(False), Float(dr.inf), None
        if self.scene is not None:
            cast, distance = self._cast(ray, active)
            hit = active & (distance < end)
            distance = dr.select(hit, distance, dr.inf)
        if self.medium is None:
            opacity = dr.select(hit, Float(1), 0)
            return View(
                None, hit, distance, opacity, Float(0), cast, lambda kind, active: dr.select(active & hit, distance, 0)
            )

        local = self.medium.local(ray.o, ray.d)
        t0, t1 = dr.maximum(local.t_near, 0), dr.minimum(dr.minimum(local.t_far, end), distance)
        result = scouted_march(self.medium, local, t0, t1, active, settings, **options)
        front = result.opacity
        if self.scene is None:
            return View(
                result,
                hit,
                distance,
                front,
                front,
                None,
                lambda kind, active: surface_depth(kind, result, self.medium, local, t0, t1, active, settings),
            )

        def depth(kind, active):
            inside = surface_depth(kind, result, self.medium, local, t0, t1, active & (front > 0), settings, backed=hit)
            # Half of the light, which is all absorbed, may pass the medium: the shape is then the median.
            through = distance
            if kind == "expected":
                through = dr.select(hit, (1 - front) * distance, 0) + front * inside
            elif kind in ("median", "refined"):
                through = dr.select(dr.isfinite(result.half), inside, distance)
            return dr.select(active & hit, through, dr.select(active & (front > 0), inside, 0))

        return View(result, hit, distance, dr.select(hit, 1, front), front, cast, depth)

    def _cast(self, ray, active):
        """The nearest intersection with a shape, and its distance with derivatives where any are tracked."""
        import mitsuba as mi

        ray = mi.Ray3f(ray)
        with dr.suspend_grad():
            cast = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        distance = cast.t
        if dr.grad_enabled(ray.o, ray.d) or self.scene.shapes_grad_enabled():
            distance = cast.compute_surface_interaction(ray, mi.RayFlags.Minimal, active).t
        return cast, distance

    def blocked(self, ray, active):
        """Whether a shape stands within ``ray.maxt``; False without shapes."""
        if self.scene is None:
            return dr.mask_t(type(ray.maxt))(False)
        return self.scene.ray_test(ray, active)


def _corners(shape):
    box = shape.bbox()
    if box.valid():
        return np.array(box.min), np.array(box.max)
    # Mitsuba 3.9.1 leaves the boxes of meshes that it has merged unset.
    import mitsuba as mi

    vertices = np.reshape(mi.traverse(shape)["vertex_positions"], (-1, 3))
    return vertices.min(0), vertices.max(0)
