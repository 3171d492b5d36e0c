"""What a ray sees of an analytic scene, in float64: closed forms, and Gauss-Legendre where there is none.

Independent of ``transport``: nothing is stepped. Opacity α = 1 - exp(-τ); the first moment ∫ t σ T dt; the median,
where the optical depth reaches -log(1 - α/2). Between breaks of constant density σ a piece of length δ and optical
depth x = σδ absorbs 1 - e^{-x} at the mean distance 1/σ - δ/expm1(x) into it. Smooth profiles have τ in closed form and
a moment by composite Gauss-Legendre quadrature (32 panels of 16 nodes: the integrands are analytic, so it is exact to
rounding).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.maths.geometry import box_interval
from nerg_mi.transport.observer_gaze import ObservedGaze

from .scenes import COLOR_BASE, COLOR_SLOPE, NUMPY, AnalyticScene

PANELS, NODES = 32, 16
SOLID = 1.0
"""Density (1/unit) that counts as a solid in a scene of hard surfaces; the vacuum between has 1e-4."""
FUZZ = 1 / 64
"""Most that a surface is moved towards the camera for being soft, as a share of its depth."""


@dataclass(frozen=True)
class Seen:
    """Along rays (N,): optical depth, first moment ∫ t σ T dt, the median's distance (0 where nothing absorbs), and the
    mean free path 1/σ where T = 1/2 (0 where that is not reached)."""

    tau: np.ndarray
    moment: np.ndarray
    median: np.ndarray
    free_path: np.ndarray

    @property
    def opacity(self) -> np.ndarray:
        return -np.expm1(-self.tau)

    @property
    def expected(self) -> np.ndarray:
        """Mean distance of absorption, 0 where nothing absorbs."""
        some = self.opacity > 0
        return np.where(some, self.moment / np.where(some, self.opacity, 1), 0)

    def depth(self, kind: str) -> np.ndarray:
        """Of the kinds that the integrator knows; the refined depth is the median, found better."""
        return self.expected if kind == "expected" else self.median

    def color(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of the scenes' affine colour, black behind."""
        place = o * self.opacity[:, None] + d * self.moment[:, None]
        return COLOR_BASE * self.opacity[:, None] + place @ COLOR_SLOPE.T


def box_distances(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where float64 rays (N, 3) enter and leave the unit cube, from the origin on; equal on a miss."""
    near, far = box_interval(o, d, np.zeros(3), np.ones(3))
    near = np.maximum(near, 0)
    miss = ~(near < far)
    return np.where(miss, 0, near), np.where(miss, 0, far)


def trace(scene: AnalyticScene, o: np.ndarray, d: np.ndarray, end: np.ndarray | None = None) -> Seen:
    """What float64 rays ``o + t d`` (N, 3) see of ``scene``, up to the distances ``end`` (N,)."""
    near, far = box_distances(o, d)
    if end is not None:
        far = np.clip(far, near, np.maximum(end, near))
    return (_pieces if scene.optical_depth is None else _profile)(scene, o, d, near, far)


def first_solid(scene: AnalyticScene, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance (N,) at which float64 rays meet the solid of a scene that is constant between breaks: matter denser than
    `SOLID`; inf on a miss."""
    start, length, sigma = _intervals(scene, o, d, *box_distances(o, d))
    solid = (sigma > SOLID) & (length > 0)
    return np.where(solid.any(-1), start[np.arange(len(o)), np.argmax(solid, -1)], np.inf)


def _intervals(scene, o, d, near, far):
    """Starts, lengths and densities (N, K) of the pieces between breaks."""
    t = np.concatenate([near[:, None], scene.breaks(o, d), far[:, None]], -1)
    t = np.sort(np.clip(t, near[:, None], far[:, None]), -1)
    start, length = t[:, :-1], np.diff(t, axis=-1)
    p = o[:, None] + d[:, None] * (start + length / 2)[..., None]
    return start, length, scene.density(p[..., 0], p[..., 1], p[..., 2], NUMPY)


def _pieces(scene, o, d, near, far) -> Seen:
    start, length, sigma = _intervals(scene, o, d, near, far)
    tau = sigma * length
    before = np.cumsum(tau, -1) - tau
    share = mean_share(tau)
    moment = (np.exp(-before) * -np.expm1(-tau) * (start + length * share)).sum(-1)
    total = tau.sum(-1)

    row = np.arange(len(o))

    def crossing(goal):
        """Distance, and length per optical depth there, at which the optical depths ``goal`` are reached."""
        i = np.argmax((before + tau >= goal[:, None]) & (tau > 0), -1)
        slope = length[row, i] / np.where(tau[row, i] > 0, tau[row, i], 1)
        return start[row, i] + slope * (goal - before[row, i]), slope

    median = crossing(_half_of_opacity(total))[0]
    free_path = crossing(np.full(len(o), np.log(2)))[1]
    return Seen(total, moment, np.where(total > 0, median, 0), np.where(total >= np.log(2), free_path, 0))


def _half_of_opacity(tau: np.ndarray) -> np.ndarray:
    """Optical depth at which half of the opacity of ``tau`` is reached."""
    return -np.log1p(0.5 * np.expm1(-tau))


def mean_share(x: np.ndarray) -> np.ndarray:
    """1/x - 1/expm1(x), with its series where that cancels."""
    small = x < 1e-2
    y = np.clip(np.where(small, 1, x), None, 700)
    large = 1 / np.where(small, 1, x) - 1 / np.expm1(y)
    return np.where(small, 0.5 - x / 12 + x**3 / 720, large)


def _profile(scene, o, d, near, far) -> Seen:
    x, w = np.polynomial.legendre.leggauss(NODES)
    edges = (np.arange(PANELS)[:, None] + 0.5 + 0.5 * x) / PANELS
    length = far - near
    moment = np.zeros(len(o))
    for share, weight in zip(edges.ravel(), np.tile(w, PANELS)):
        t = near + length * share
        p = o + d * t[:, None]
        sigma = scene.density(p[:, 0], p[:, 1], p[:, 2], NUMPY)
        moment += weight * t * sigma * np.exp(-scene.optical_depth(o, d, near, t))
    moment *= length / (2 * PANELS)
    total = np.where(length > 0, scene.optical_depth(o, d, near, far), 0)

    def crossing(goal):
        low, high = near.copy(), far.copy()
        for _ in range(60):
            middle = 0.5 * (low + high)
            short = scene.optical_depth(o, d, near, middle) < goal
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return high

    p = o + d * crossing(np.log(2))[:, None]
    reached = total >= np.log(2)
    sigma = np.where(reached, scene.density(p[:, 0], p[:, 1], p[:, 2], NUMPY), 1)
    return Seen(
        total, moment, np.where(total > 0, crossing(_half_of_opacity(total)), 0), np.where(reached, 1 / sigma, 0)
    )


@dataclass(frozen=True)
class Truth:
    """A reference picture, a row a ray or pixel: ``color`` (N, 3) linear, the others (N,); ``gaze`` is 0 throughout
    without a gaze field.

    ``source``: what it is; ``convergence``: how much it changed when its step was halved, by name of error (empty for
    closed forms).
    """

    color: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray
    visibility: np.ndarray
    gaze: np.ndarray
    source: str
    convergence: dict


def compute_truth(
    scene: AnalyticScene,
    gaze: ObservedGaze | None,
    o,
    d,
    *,
    depth: str,
    visibility: str,
    falloff: float,
    tolerance: float,
    surface_opacity: float,
) -> Truth:
    """The reference of ``nerg``'s channels for rays (N, 3), as its manual page defines them.

    ``gaze``: for the scene's observer (a single-precision network, evaluated at float64 positions), or None.
    """
    seen = trace(scene, o, d)
    t = seen.depth(depth)
    surface = seen.opacity >= surface_opacity
    p_d = o + d * t[:, None]
    p_o = np.asarray(scene.observer, float)
    # The point looked for lies in front of the surface, by the tolerance and by how far light goes into it: one mean
    # free path to the expected depth of thick matter, ln 2 of it to the median.
    paths = 1 if depth == "expected" else np.log(2)
    in_front = tolerance + np.minimum(paths * seen.free_path, t * FUZZ)
    distance, r_o = towards(p_o, p_d - d * in_front[:, None])
    start = np.broadcast_to(p_o, o.shape)
    p_od = p_d
    if visibility == "transmittance":
        share = np.exp(-trace(scene, start, r_o, distance).tau)
    else:
        met = trace(scene, start, r_o)
        d_o = np.where(met.opacity >= surface_opacity, met.depth(depth), np.inf)
        excess = distance - d_o - tolerance
        share = 1 - (np.clip(excess / falloff, 0, 1) if falloff > 0 else (excess > 0))
        blocked = excess > 0
        p_od = np.where(blocked[:, None], p_o + r_o * np.where(blocked, d_o, 0)[:, None], p_d)
    share = np.where(surface, share, 0)
    density = np.zeros(len(o)) if gaze is None else evaluate_gaze(gaze, p_od, p_o, towards(p_o, p_d)[1]) * share
    return Truth(seen.color(o, d), seen.opacity, t, share, density, "float64 closed form", {})


def towards(p_o, p):
    """Distance (N,) and unit direction (N, 3) from ``p_o`` to ``p``."""
    v = p - p_o
    distance = np.linalg.norm(v, axis=-1)
    return distance, v / np.where(distance > 0, distance, 1)[:, None]


def evaluate_gaze(gaze: ObservedGaze, p_od, p_o, r_o) -> np.ndarray:
    """Gaze density (N,) in 1/sr at points (N, 3) seen along unit ``r_o`` (N, 3) from ``p_o``, one of the observers of
    ``gaze``."""
    import mitsuba as mi

    def points(kind, v):
        return kind(np.ascontiguousarray(np.broadcast_to(v, p_od.shape).T, np.float32))

    return np.array(
        gaze.evaluate(points(mi.Point3f, p_od), points(mi.Point3f, p_o), points(mi.Vector3f, r_o), True)[0], float
    )
