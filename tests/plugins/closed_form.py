"""An integrator that knows the answers: shapes in a box of constant density, by one ray cast and closed forms.

It shares no code with `nerg`: rays come from Mitsuba's sensors, distances from its ray casts, light on shapes from its
integrators. What it returns for a ray is what `nerg` should return for the same ray, whatever film, sensor or
integrator is around it.
"""

import drjit as dr

AOVS = ["depth.T", "opacity.Y", "position.X", "position.Y", "position.Z", "visibility.Y"]
TOLERANCE = 1e-3


def closed_form(mi, sigma, color, eye, lower=(-1, -1, -1), upper=(1, 1, 1), depth="expected", light=None):
    """The integrator: density `sigma` (0: vacuum) and `color` in a box; visibility by transmittance to the point `eye`
    (None: everything with a surface is visible). `light`: the integrator that lights shapes; None: they show their
    albedo."""

    def crossing(o, d, end):
        """Where a ray is in the box, up to `end`."""
        a, b = (mi.Point3f(lower) - o) / d, (mi.Point3f(upper) - o) / d
        start = dr.maximum(dr.max(dr.minimum(a, b)), 0)
        return start, dr.maximum(dr.minimum(dr.min(dr.maximum(a, b)), end), start)

    class ClosedForm(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.light = mi.load_dict({"type": light}) if light else None

        def aov_names(self):
            return AOVS

        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(mi.Ray3f(ray), active)
            hit, t = si.is_valid(), si.t
            a, b = crossing(ray.o, ray.d, t)
            T = dr.exp(-sigma * (b - a))
            front = 1 - T
            opacity = dr.select(hit, 1, front)
            if depth == "expected":
                first = a - T * b + front / sigma if sigma else mi.Float(0)
                z = dr.select(hit, first + T * t, first) / dr.select(opacity > 0, opacity, 1)
            else:
                # Where half of the ray's own opacity is reached, and the shape if the box lets through more than half.
                inside = a - dr.log(1 - 0.5 * opacity) / sigma if sigma else mi.Float(dr.inf)
                z = dr.select(hit & (T > 0.5), t, inside)
            z = dr.select(opacity > 0, z, 0)

            surface = opacity >= 0.5
            p = ray.o + ray.d * z
            visible = mi.Float(1)
            if eye is not None:
                # The point looked for lies in front of the surface: by the tolerance, and as far as light goes into it.
                paths = 1.0 if depth == "expected" else dr.log(2)
                fuzz = dr.select(front > 0.5, dr.minimum(paths / sigma, z / 64), 0) if sigma else 0
                v = p - ray.d * (TOLERANCE + fuzz) - mi.Point3f(eye)
                distance = dr.norm(v)
                sight = mi.Ray3f(mi.Point3f(eye), v / distance)
                sight.maxt = distance
                a, b = crossing(sight.o, sight.d, distance)
                visible = dr.select(scene.ray_test(sight, surface), 0, dr.exp(-sigma * (b - a)))
            if self.light is not None:
                behind, seen, _ = self.light.sample(scene, sampler, ray, None, active)
            else:
                behind, seen = dr.select(hit, si.bsdf().eval_diffuse_reflectance(si, hit), 0), hit
            L = T * behind + front * mi.Color3f(color)
            p = dr.select(surface, p, 0)
            return L, seen | (opacity > 0), [z, opacity, p.x, p.y, p.z, dr.select(surface, visible, 0)]

        def to_string(self):
            return "ClosedForm[]"

    return ClosedForm(mi.Properties())


def nerg(mi, sigma, color, eye, lower=(-1, -1, -1), upper=(1, 1, 1), depth="expected", light=None, **kwargs):
    """The same as a description of `nerg`."""
    out = {
        "type": "nerg",
        "aovs": "depth,opacity,position,visibility",
        "depth": depth,
        "visibility": "transmittance",
        "tolerance": TOLERANCE,
        **kwargs,
    }
    if light not in (None, "path"):
        out["light"] = {"type": light}
    if sigma:
        size = [u - l for l, u in zip(lower, upper)]
        box = mi.ScalarTransform4f().translate(list(lower)).scale(size)
        out["density"] = {"type": "constvolume", "value": sigma, "to_world": box}
        out["color"] = {"type": "constvolume", "value": {"type": "rgb", "value": list(color)}}
    if eye is not None:
        to_world = mi.ScalarTransform4f().look_at(list(eye), [0.1, 0.2, 0.3], [0, 1, 0])
        out["observer"] = {"type": "perspective", "to_world": to_world}
    return out
