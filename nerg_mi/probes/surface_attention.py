r"""Attention received by a surface, in area form.

An observer at p_o looks into the direction ω with the density g(ω), in 1/sr. The probability that the look lands on a
surface S is the integral of g over the directions in which S is seen. Over the surface's own points y it reads

    A = ∫_S g V(y, p_o) max(0, -n · ω) / |y - p_o|² dA,    ω = (y - p_o) / |y - p_o|,

with the change of variables dω = |cos θ| dA / d² (Veach 1997, section 8.2.2.2, "three-point form"), n the normal at y,
and V the visibility of ``transport.occlusion``. Unlike pixels, the points move with the surface: A has derivatives
with respect to where the surface is, without any edge of its own that would have to be sampled. The moving edges of
what *else* hides it are not seen by derivatives; the fall-off behind them is.
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
from nerg_mi.transport.observer import ObserverSettings, distance_and_direction
from nerg_mi.transport.occlusion import trace_from_observer

if TYPE_CHECKING:
    import mitsuba as mi


Density = Callable[[Point3f, Point3f, Vector3f, Bool], Float]
"""Of ``p_od``, ``p_o``, ``r_o`` and the active lanes: gaze in 1/sr of an observer at ``p_o`` along the unit direction
``r_o``, who sees the surface ``p_od`` there (``ObservedGaze.evaluate(...)[0]``, or anything else)."""


@dataclass
class Patches:
    """Small flat pieces of a surface, one a lane, in the scene."""

    p: Point3f  # centroids
    n: Vector3f  # unit normals
    area: Float  # square scene units

    def translate(self, offset: Vector3f) -> Patches:
        """The same pieces, shifted by ``offset``."""
        return Patches(self.p + offset, self.n, self.area)


def make_patches(mesh: mi.Mesh, divisions: int = 4) -> Patches:
    """A Mitsuba mesh, each triangle cut into ``divisions``² congruent ones: the centroid rule, of second order.

    Normals are the faces' own, to the side that sees the vertices counter-clockwise. Attached to the
    ``vertex_positions`` of the mesh, or the ``to_world`` of a rectangle. Raises `NergError` for what is not a mesh,
    ``ValueError`` for no divisions.
    """
    mi = variant_types()
    if not isinstance(mesh, mi.Mesh):
        raise NergError(f'"{mesh.id()}" is not a mesh; attention is received by meshes (cube, rectangle, ply, obj)')
    if divisions < 1:
        raise ValueError(f"a triangle is cut into at least 1 piece a side, got divisions={divisions}")
    # Not its parameters: a rectangle is a mesh that has no others than its transform.
    positions, faces = mesh.vertex_positions_buffer(), mi.UInt32(mesh.faces_buffer())
    centre = _centroids(divisions)
    count = len(faces) // 3
    index = dr.arange(mi.UInt32, count * len(centre))
    face, piece = index // len(centre), index % len(centre)
    corners = [dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, faces, 3 * face + k)) for k in range(3)]
    a, b, c = corners
    u, v = (dr.gather(mi.Float, mi.Float(np.ascontiguousarray(centre[:, k])), piece) for k in range(2))
    across = dr.cross(b - a, c - a)
    twice = dr.norm(across)
    flat = twice > 0
    n = dr.select(flat, across / dr.select(flat, twice, 1), mi.Vector3f(0, 0, 1))
    return Patches(a + u * (b - a) + v * (c - a), n, 0.5 * twice / len(centre))


def _centroids(n: int) -> np.ndarray:
    """Barycentric u, v (n², 2) of the centroids of a triangle's n² congruent parts."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(n) for j in range(n - i - 1)]
    return np.array(upright + turned, np.float32) / n


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
    """Attention per solid angle, in 1/sr, that the observer ``p_o`` gives ``p`` with normal ``n`` after occlusion.

    Arguments as of ``arriving``, which is this times the Jacobian from solid angle to area. ``penetration``: how far,
    along the normal, what is seen of ``p`` may begin before it, in scene units.
    """
    mi = variant_types()
    distance, r_o, cosine = _faced(p_o, p, n)
    n = dr.select(two_sided & (cosine < 0), -n, n)
    active = ((cosine != 0) if two_sided else (cosine > 0)) & (distance > 0)
    p_od, seen = p, mi.Float(1)
    if scene is not None:
        settings = settings or ObserverSettings(march=default_march_settings(scene))
        # Looked for a tolerance above the surface, as if a camera stood there.
        ray = mi.Ray3f(p + n, -n)
        found = trace_from_observer(scene, ray, p, p_o, penetration, active, mi.Float(falloff), settings, needs_depth=False)
        p_od, seen = found.p_od, found.visibility
        active &= seen > 0
    return dr.select(active, density(p_od, p_o, r_o, active) * seen, 0)


def _faced(p_o: Point3f, p: Point3f, n: Vector3f) -> tuple[Float, Vector3f, Float]:
    """Distance and direction from ``p_o`` to ``p``, and the cosine under which its normal ``n`` faces ``p_o``."""
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
    """Attention per area, in 1 / square scene unit, that arrives at ``p`` with normal ``n`` from the observer ``p_o``.

    ``place``: what may stand in between (shapes, a field, both; None: nothing). ``falloff`` d_f in scene units,
    ``settings``: as of the integrator. A closed surface hides its own back, which therefore receives nothing;
    ``two_sided`` counts both sides of an open one. Lanes are pairs; differentiable in all of them, in the density's
    parameters and in ``falloff``, but not over the edges of ``place``.
    """
    g = attention_per_sr(scene, density, p_o, p, n, falloff, settings, two_sided)
    distance, _, cosine = _faced(p_o, p, n)
    cosine = dr.abs(cosine) if two_sided else cosine
    facing = (cosine > 0) & (distance > 0)
    square = dr.square(dr.select(facing, distance, 1))
    return dr.select(facing, g * cosine / square, 0)


def attention_per_patch(
    scene: SceneGeometry | None,
    density: Density,
    observers: Point3f,
    surface: Patches,
    falloff: Float | float = 0.0,
    settings: ObserverSettings | None = None,
    two_sided: bool = False,
) -> Float:
    """Share of each observer's look that each patch receives, all patches of the first observer first.

    Arguments as of ``arriving``; ``observers``: a lane an observer.
    """
    mi = variant_types()
    count, people = dr.width(surface.p, surface.n, surface.area), dr.width(observers)
    index = dr.arange(mi.UInt32, count * people)
    who, where = index // count, index % count
    p_o = dr.gather(mi.Point3f, mi.Point3f(observers), who)
    p = dr.gather(mi.Point3f, mi.Point3f(surface.p), where)
    n = dr.gather(mi.Vector3f, mi.Vector3f(surface.n), where)
    area = dr.gather(mi.Float, mi.Float(surface.area), where)
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
    """Probability (a lane an observer) that the look of each of ``observers`` lands on ``surface``.

    Arguments as of ``arriving``. Makes observers x patches lanes at once. Exact as patches shrink against their
    distance from the observer: at a distance of k patch diameters the error is of the order 1 / k².
    """
    each = attention_per_patch(scene, density, observers, surface, falloff, settings, two_sided)
    return dr.block_sum(each, dr.width(each) // dr.width(observers))
