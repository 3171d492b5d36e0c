r"""Attention on surfaces, integrated over their area.

An observer at p_o looks in the direction ω with the density g(ω), in 1/sr. The probability of looking at a surface S is
the integral of g over the directions in which S is visible. As an integral over the points y of the surface it is

    A = ∫_S g V(y, p_o) max(0, -n · ω) / |y - p_o|² dA,    ω = (y - p_o) / |y - p_o|,

by the change of variables dω = |cos θ| dA / d² (Veach 1997, section 8.2.2.2, "three-point form"), where n is the normal
at y and V the visibility of ``transport.occlusion``. Unlike pixels, the points move with the surface: A is
differentiable with respect to the position of the surface, and none of its own edges need to be sampled. Derivatives do
not include the moving edges of *other* occluders; they include the fall-off behind them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f, variant_types
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.mitsuba_mesh import count_faces, gather_corners, is_mesh
from nerg_mi.transport.observer import ObserverSettings, distance_and_direction
from nerg_mi.transport.occlusion import trace_from_observer

if TYPE_CHECKING:
    import mitsuba as mi


Density = Callable[[Point3f, Point3f, Vector3f, Bool], Float]
"""Gaze density in 1/sr: maps surface points ``p_od``, an observer ``p_o``, unit directions ``r_o`` and the active
lanes to a density (``ObservedGaze.evaluate(...)[0]``, or any other function).
"""


@dataclass
class Patches:
    """Small flat patches of a surface, one per lane, in the scene."""

    p: Point3f  # centroids
    n: Vector3f  # unit normals
    area: Float  # square scene units

    def translate(self, offset: Vector3f) -> Patches:
        """Return the patches shifted by ``offset``."""
        return Patches(self.p + offset, self.n, self.area)


def make_patches(mesh: mi.Shape, divisions: int = 4) -> Patches:
    """Divide each triangle of a Mitsuba mesh into ``divisions``² congruent patches: the centroid rule, of second order.

    The normals are the face normals, on the side that sees the vertices counter-clockwise. The patches are
    differentiable with respect to the vertices of the mesh, or ``to_world`` of a rectangle. Raises `NergError`
    if the shape is not a mesh, ``ValueError`` if ``divisions`` is below 1.
    """
    mi = variant_types()
    if not is_mesh(mesh):
        raise NergError(f'"{mesh.id()}" is not a mesh; use a mesh shape (cube, rectangle, ply, obj)')
    if divisions < 1:
        raise ValueError(f"divisions must be at least 1, got {divisions}")
    # Barycentric coordinates of the centroids of the parts of a triangle
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(divisions) for j in range(divisions - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(divisions) for j in range(divisions - i - 1)]
    centre = np.array(upright + turned, np.float32) / divisions
    index = dr.arange(mi.UInt32, count_faces(mesh) * len(centre))
    face, piece = index // len(centre), index % len(centre)
    a, b, c = gather_corners(mesh, face)
    u, v = (dr.gather(mi.Float, mi.Float(np.ascontiguousarray(centre[:, k])), piece) for k in range(2))
    across = dr.cross(b - a, c - a)
    double_area = dr.norm(across)
    flat = double_area > 0
    n = dr.select(flat, across / dr.select(flat, double_area, 1), mi.Vector3f(0, 0, 1))
    return Patches(a + u * (b - a) + v * (c - a), n, 0.5 * double_area / len(centre))


def attention_per_sr(
    scene: SceneGeometry | None,
    density: Density,
    p_o: Point3f,
    p: Point3f,
    n: Vector3f,
    falloff: Float | float = 0.0,
    settings: ObserverSettings | None = None,
    two_sided: bool = False,
    penetration: Float | float = 0.0,
) -> Float:
    """Compute the visible attention of observers on points, per solid angle (1/sr).

    This is `attention_per_area` without the Jacobian from solid angle to area; see there for the parameters.

    Parameters
    ----------
    penetration : Float or float
        Distance along the normal, in scene units, by which the surface of a medium may begin before ``p``.
    """
    mi = variant_types()
    distance, r_o, cosine = _compute_facing(p_o, p, n)
    n = dr.select(two_sided & (cosine < 0), -n, n)
    active = ((cosine != 0) if two_sided else (cosine > 0)) & (distance > 0)
    p_od, visibility = p, mi.Float(1)
    if scene is not None:
        settings = settings or ObserverSettings(march=default_march_settings(scene))
        # As seen by a camera in front of the surface, so that the tolerance is applied above it.
        ray = mi.Ray3f(p + n, -n)
        hit = trace_from_observer(
            scene, ray, p, p_o, penetration, active, mi.Float(falloff), settings, needs_depth=False
        )
        p_od, visibility = hit.p_od, hit.visibility
        active &= visibility > 0
    return dr.select(active, density(p_od, p_o, r_o, active) * visibility, 0)


def _compute_facing(p_o: Point3f, p: Point3f, n: Vector3f) -> tuple[Float, Vector3f, Float]:
    """Return distance and direction from ``p_o`` to ``p``, and the cosine between the direction and the normal
    ``n``."""
    distance, r_o = distance_and_direction(p_o, p)
    return distance, r_o, -dr.dot(n, r_o)


def attention_per_area(
    scene: SceneGeometry | None,
    density: Density,
    p_o: Point3f,
    p: Point3f,
    n: Vector3f,
    falloff: Float | float = 0.0,
    settings: ObserverSettings | None = None,
    two_sided: bool = False,
) -> Float:
    """Compute the attention of observers on points, per area (1 / square scene unit).

    Lanes are pairs of an observer and a point. The result is differentiable in all arguments, in the parameters of the
    density and in ``falloff``, but not across the edges of ``scene``.

    Parameters
    ----------
    scene : SceneGeometry or None
        Occluders: shapes, a field, or both; None: no occlusion.
    density : Density
        Gaze density of the observers.
    p_o : Point3f
        Observers.
    p, n : Point3f, Vector3f
        Points and unit normals.
    falloff : Float or float
        Fall-off distance d_f of the visibility in scene units.
    settings : ObserverSettings, optional
        As of the integrator.
    two_sided : bool
        Count both sides of the surface. A closed surface hides its own back, which therefore has no attention.
    """
    g = attention_per_sr(scene, density, p_o, p, n, falloff, settings, two_sided)
    distance, _, cosine = _compute_facing(p_o, p, n)
    cosine = dr.abs(cosine) if two_sided else cosine
    is_facing = (cosine > 0) & (distance > 0)
    square = dr.square(dr.select(is_facing, distance, 1))
    return dr.select(is_facing, g * cosine / square, 0)


def attention_per_patch(
    scene: SceneGeometry | None,
    density: Density,
    observers: Point3f,
    surface: Patches,
    falloff: Float | float = 0.0,
    settings: ObserverSettings | None = None,
    two_sided: bool = False,
) -> Float:
    """Compute the probability that each observer looks at each patch, all patches of the first observer first.

    ``observers`` has one lane per observer; the other parameters are those of `attention_per_area`.
    """
    mi = variant_types()
    num_patches, num_observers = dr.width(surface.p, surface.n, surface.area), dr.width(observers)
    index = dr.arange(mi.UInt32, num_patches * num_observers)
    observer_index, patch_index = index // num_patches, index % num_patches
    p_o = dr.gather(mi.Point3f, mi.Point3f(observers), observer_index)
    p = dr.gather(mi.Point3f, mi.Point3f(surface.p), patch_index)
    n = dr.gather(mi.Vector3f, mi.Vector3f(surface.n), patch_index)
    area = dr.gather(mi.Float, mi.Float(surface.area), patch_index)
    return area * attention_per_area(scene, density, p_o, p, n, falloff, settings, two_sided)


def attention_on(
    scene: SceneGeometry | None,
    density: Density,
    observers: Point3f,
    surface: Patches,
    falloff: Float | float = 0.0,
    settings: ObserverSettings | None = None,
    two_sided: bool = False,
) -> Float:
    """Compute the probability that each observer looks at ``surface`` (one lane per observer).

    The parameters are those of `attention_per_area`. Evaluates observers x patches lanes at once. The error is of order
    1 / k² at a distance of k patch diameters.
    """
    each = attention_per_patch(scene, density, observers, surface, falloff, settings, two_sided)
    return dr.block_sum(each, dr.width(each) // dr.width(observers))
