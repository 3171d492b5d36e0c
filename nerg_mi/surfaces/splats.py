r"""What the gaze of observers leaves on Gaussian splats, after occlusion: a density per area for each of them.

Rays of direction ω meet a Gaussian with centre c and covariance Σ where they are nearest to c by its own measure, which
for parallel rays is the plane through c with the normal Σ⁻¹ω: as seen from there, the Gaussian is a surface in that
plane. A flat one is its own disk from wherever it is seen, a ball a disk that faces the observer. Of an observer at p_o
who looks with the density g(ω), in 1/sr, it receives

    g(ω) V(c, p_o) C(ω) / |c - p_o|²,    C(ω) = |Σ^{-1/2} ω| min σ,    ω = (c - p_o) / |c - p_o|,

per area: the density of `nerg_mi.probes.surface_attention` at the centre, with the area under which the Gaussian is
seen, as a share of the largest under which it can be seen (C), in place of a cosine. V is the visibility of
`nerg_mi.probes.surface_attention.attended`, of a point that lies before the centre by the thickness of the Gaussian
too. Such densities are colours: rendered in place of them, they mix by the light that reaches the eye.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.field.splats import Splats, matrices_of
from nerg_mi.maths.arrays import aligned, vector_of
from nerg_mi.probes.surface_attention import attended
from nerg_mi.transport.observer.settings import ObserverSettings
from nerg_mi.transport.place import Place

from .gaze_source import Looker, MakeLooker, density_through, unhidden
from .splat_areas import shortest_axes, sides_of

BATCH = 1 << 18
"""Gaussians in one launch."""


def splat_densities(
    splats: Splats,
    place: Place,
    make: MakeLooker,
    eyes: np.ndarray,
    weights: np.ndarray,
    settings: ObserverSettings,
    cone: float = 0.0,
    falloff: float = 0.0,
) -> np.ndarray:
    """Gaze (2, N), float64, that each side of ``splats`` receives per square scene unit from observers at ``eyes``
    (M, 3) who count by ``weights`` (M,): a sum over them. Sides are those of `splat_areas.sides_of`.

    ``place``: what hides, the splats themselves among it, in their frame, traced with ``settings``; ``cone``: standard
    deviation in radian of the cone that gaze is seen through, ``falloff`` as of the integrator. From within its own
    width a Gaussian receives what it does from as far as it is wide.
    """
    out, every, axes = np.zeros((2, len(splats))), np.arange(len(splats)), shortest_axes(splats)
    with dr.suspend_grad():
        for eye, weight in zip(np.asarray(eyes, np.float64), weights):
            found = float(weight) * _of_one(splats, place, make(eye), eye, settings, cone, falloff)
            out[sides_of(splats.centers - eye, axes), every] += found
    return out


def _of_one(
    splats: Splats,
    place: Place,
    looker: Looker,
    eye: np.ndarray,
    settings: ObserverSettings,
    cone: float,
    falloff: float,
) -> np.ndarray:
    out = np.zeros(len(splats))
    for a in range(0, len(splats), BATCH):
        part = slice(a, a + BATCH)
        centers, scales = splats.centers[part].astype(np.float64), splats.scales[part].astype(np.float64)
        facing, normals, depth = _facing(centers - eye, matrices_of(splats.rotations[part]), scales)
        seen = _seen(place, looker, centers, normals, depth, settings, falloff)
        rows = np.flatnonzero(seen > 0)
        # Most of a place is hidden from wherever one stands, and gaze costs more than rays.
        if len(rows):
            to = centers[rows] - eye
            directions = to / np.linalg.norm(to, axis=1, keepdims=True)
            gaze = unhidden(looker, density_through(looker, cone), centers[rows], directions)
            out[a + rows] = seen[rows] * facing[rows] * gaze
    return out


def _facing(to: np.ndarray, axes: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(C(ω) / distance² (N,), the unit normals (N, 3) of what is seen, and its standard deviation along them (N,))``
    of Gaussians that lie ``to`` (N, 3) of an eye."""
    distance = np.linalg.norm(to, axis=1)
    w = to / np.where(distance > 0, distance, 1)[:, None]
    own = np.einsum("nji,nj->ni", axes, w)
    least, widest = scales.min(axis=1), scales.max(axis=1)
    # In units of the least deviation, so that squares of thin ones stay finite.
    once = own * (least[:, None] / scales)
    twice = once * (least[:, None] / scales)
    area = np.linalg.norm(once, axis=1)
    length = np.linalg.norm(twice, axis=1)
    across = twice / np.where(length > 0, length, 1)[:, None]
    depth = np.linalg.norm(across * scales, axis=1)
    normals = -np.einsum("nij,nj->ni", axes, across)
    near = np.maximum(distance, widest)
    return np.where(length > 0, area / near**2, 0.0), normals, depth


def _seen(
    place: Place,
    looker: Looker,
    centers: np.ndarray,
    normals: np.ndarray,
    depth: np.ndarray,
    settings: ObserverSettings,
    falloff: float,
) -> np.ndarray:
    """Visibility (N,) of ``centers`` on surfaces with ``normals``, which begin before them by ``depth``."""
    import mitsuba as mi

    p, n = vector_of(mi.Point3f, centers), vector_of(mi.Vector3f, normals)
    p_o = looker.center + dr.zeros(mi.Point3f, len(centers))
    uniform = lambda p_od, p_o, r_o, active: type(r_o.x)(1)
    before = mi.Float(aligned(depth))
    found = attended(place, uniform, p_o, p, n, falloff, settings, True, penetration=before)
    return np.broadcast_to(np.array(found, np.float64), (len(centers),))
