"""A scene of shapes alone as the subject of a study: its truth is float64 ray casts at their triangles."""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import Place
from nerg_mi.transport.observer_gaze import ObservedGaze

from .reference import Truth, evaluate_gaze, towards

# Rays tested against all triangles at once.
CHUNK = 64
# The mean of so many samples a pixel is the colour that pictures are compared with.
COLOR_SPP = 256


def triangles(scene) -> np.ndarray:
    """Corners (N, 3, 3), float64, of all shapes of a Mitsuba scene. Raises NergError for a shape that is no mesh."""
    import mitsuba as mi

    found = []
    for shape in scene.shapes():
        if not shape.is_mesh():
            raise NergError(
                f"a study of shapes needs meshes, and this scene has a {shape.class_name()}: give it as triangles"
            )
        params = mi.traverse(shape)
        corners = np.array(params["vertex_positions"], float).reshape(-1, 3)
        found.append(corners[np.array(params["faces"], int).reshape(-1, 3)])
    return np.concatenate(found)


def first_hit(corners: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance (N,) at which rays ``o + t d`` (N, 3), t > 0, first meet one of the triangles (M, 3, 3); inf on a miss.

    Möller and Trumbore 1997, in float64. Edges count as inside to rounding, so that no ray slips between neighbours.
    """
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    out = np.empty(len(o))
    for begin in range(0, len(o), CHUNK):
        origin, way = o[begin : begin + CHUNK, None], d[begin : begin + CHUNK, None]
        p = np.cross(way, v)
        det = (p * u).sum(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            first = (s * p).sum(-1) / det
            q = np.cross(s, u)
            second = (q * way).sum(-1) / det
            t = (q * v).sum(-1) / det
            hit = (first >= -1e-12) & (second >= -1e-12) & (first + second <= 1 + 1e-12) & (t > 0) & (det != 0)
        out[begin : begin + CHUNK] = np.where(hit, t, np.inf).min(-1)
    return out


def observed_gaze(subject, p_o: np.ndarray) -> ObservedGaze:
    """The gaze field of ``subject`` for the observer at ``p_o`` (3,)."""
    import mitsuba as mi

    # The integral is the integrator's own, of all directions: over ray casts, which are exact to single precision, and
    # tested against ``first_hit``.
    integrator = subject.integrator({"integral_tolerance": 0.0})
    place = Place(None, subject.scene)
    return integrator.gaze.at([mi.Point3f(*p_o.tolist())], place, integrator.observer_settings)


def compute_truth_of_shapes(subject, seed: int, visibility: str, color: np.ndarray) -> Truth:
    """The reference of ``nerg``'s channels for shapes alone, as its manual page defines them.

    ``color``: (N, 3), what the colours of the picture tend to.
    """
    o, d = subject.rays(seed)
    t = subject.first_hits(seed)
    hit = np.isfinite(t)
    depth = np.where(hit, t, 0)
    p_d, p_o = o + d * depth[:, None], subject.eye()
    distance, r_o = towards(p_o, p_d - d * subject.tolerance)
    met = first_hit(subject.corners, np.broadcast_to(p_o, o.shape), r_o)
    p_od = p_d
    if visibility == "transmittance":
        share = (met >= distance).astype(float)
    else:
        falloff = float(subject.base["falloff"])
        excess = distance - met - subject.tolerance
        share = 1 - (np.clip(excess / falloff, 0, 1) if falloff > 0 else (excess > 0))
        blocked = excess > 0
        p_od = np.where(blocked[:, None], p_o + r_o * np.where(blocked, met, 0)[:, None], p_d)
    share = np.where(hit, share, 0)
    gaze = np.zeros(len(o))
    if subject.has_gaze:
        gaze = evaluate_gaze(observed_gaze(subject, p_o), p_od, p_o, towards(p_o, p_d)[1]) * share
    source = f"float64 ray casts; colour the mean of {COLOR_SPP} samples a pixel"
    return Truth(color, hit.astype(float), depth, share, gaze, source, {})
