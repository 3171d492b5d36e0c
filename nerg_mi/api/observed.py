"""One observer of a scene: what they see of points, and the density of their gaze."""

from __future__ import annotations

from typing import Any

from nerg_mi.maths.types import variant_types

from .arrays import Floats
from .scene import Scene


class ObserverOf:
    """The observer of ``scene`` at ``position`` (3,), in scene units.

    The settings of the march, of depths and of visibility are those of the scene's integrator. What a normalised gaze
    field has to know of the observer is computed once.
    """

    def __init__(self, scene: Scene, position: Floats):
        import drjit as dr
        import mitsuba as mi

        self.scene, self.place, self.integrator = scene, scene.place, scene.integrator
        self.center: Any = mi.Point3f(position.tolist())
        # A position that is a constant of the kernel would be compiled anew for every observer.
        dr.make_opaque(self.center)
        self.gaze = None
        if scene.has_gaze:
            i = self.integrator
            self.gaze = i.gaze.at([self.center], self.place, i.observer_settings, i.cache)

    def density(self, p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
        """Gaze (Float, 1/sr) along the unit direction ``r_o``, in which the observer, who is at ``p_o`` in all lanes,
        sees the surface ``p_od``; as `nerg_mi.probes.surface_attention` wants it."""
        if self.gaze is None:
            raise ValueError("a scene without a gaze field has no gaze")
        return self.gaze.evaluate(p_od, p_o, r_o, active)[0]

    def sees(self, p: Any, with_gaze: bool) -> dict[str, Any]:
        """Of points ``p`` (Point3f): ``distance``, ``depth`` and ``visibility``, and ``gaze`` where wanted (Floats)."""
        import drjit as dr

        mi = variant_types()
        from nerg_mi.transport.observer import distance_and_direction
        from nerg_mi.transport.occlusion import trace_sight

        i = self.integrator
        distance, r_o = distance_and_direction(self.center, p)
        active = dr.full(mi.Bool, True, dr.width(p))
        ray = mi.Ray3f(self.center, r_o)
        sight = trace_sight(self.place, ray, p, self.center, 0, active, i.falloff, i.observer_settings, cache=i.cache)
        values = {"distance": distance, "depth": sight.depth, "visibility": sight.visibility}
        if with_gaze:
            seen = active & (sight.visibility > 0)
            p_o = self.center + dr.zeros(mi.Point3f, dr.width(p))
            gaze = self.density(sight.p_od, p_o, r_o, seen)
            values["gaze"] = dr.select(seen, gaze * sight.visibility, 0)
        return values
