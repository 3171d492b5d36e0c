"""True values of the scenes of a study: media in closed form, shapes and splats, and errors relative to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.color import psnr_from_mse
from nerg_mi.maths.geometry import intersect_box_numpy
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.mitsuba_mesh import read_triangles
from nerg_mi.transport.observer_gaze import ObservedGaze

from . import metrics
from .study_scenes import COLOR_BASE, COLOR_SLOPE, NUMPY_FUNCTIONS, AnalyticScene

# ---- Reference ----
#
# True values along rays through an analytic scene in float64: closed forms, and Gauss-Legendre quadrature where there
# is none.
#
# Independent of ``transport``, without steps. Opacity is α = 1 - exp(-τ); the first moment is ∫ t σ T dt; the median is
# where the optical depth reaches -log(1 - α/2). Between breaks, a piece of constant density σ, length δ and optical
# depth x = σδ absorbs 1 - e^{-x} at the mean distance 1/σ - δ/expm1(x) from its start. Smooth profiles have τ in closed
# form and the moment by composite Gauss-Legendre quadrature (32 panels of 16 nodes; the integrands are analytic, so it
# is exact to rounding).

QUADRATURE_PANELS, QUADRATURE_NODES = 32, 16
SOLID_DENSITY = 1.0  # Density (1/unit) above which matter in a scene of hard surfaces is solid; the vacuum has 1e-4
MAX_SURFACE_SHIFT = 1 / 64  # Maximum shift of a soft surface towards the camera, relative to its depth


@dataclass(frozen=True)
class RayTruth:
    """True values along rays (N,).

    Attributes
    ----------
    tau : numpy.ndarray
        Optical depth.
    moment : numpy.ndarray
        First moment ∫ t σ T dt.
    crossing : callable
        Maps optical depths up to ``tau`` to the distances at which they are reached.
    free_path : numpy.ndarray
        Mean free path 1/σ where T = 1/2; 0 if that is not reached.
    """

    tau: np.ndarray
    moment: np.ndarray
    crossing: Callable[[np.ndarray], np.ndarray]
    free_path: np.ndarray

    @property
    def opacity(self) -> np.ndarray:
        return -np.expm1(-self.tau)

    @property
    def expected(self) -> np.ndarray:
        """Mean distance of absorption, 0 where nothing absorbs."""
        is_absorbing = self.opacity > 0
        return np.where(is_absorbing, self.moment / np.where(is_absorbing, self.opacity, 1), 0)

    def quantile(self, fraction: float) -> np.ndarray:
        """Distance at which this fraction of the ray's opacity is reached, 0 where nothing absorbs."""
        return np.where(self.tau > 0, self.crossing(-np.log1p(fraction * np.expm1(-self.tau))), 0)

    def depth(self, kind: str) -> np.ndarray:
        """Depth of a kind that the integrator supports."""
        return DEPTHS.find(kind).find_exact(self)

    def color(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of the affine colour of the scenes, with black behind."""
        mean_position = o * self.opacity[:, None] + d * self.moment[:, None]
        return COLOR_BASE * self.opacity[:, None] + mean_position @ COLOR_SLOPE.T


def intersect_unit_cube(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intersect float64 rays (N, 3) with the unit cube, from the origin on; both distances are equal on a miss."""
    near, far = intersect_box_numpy(o, d, np.zeros(3), np.ones(3))
    near = np.maximum(near, 0)
    miss = ~(near < far)
    return np.where(miss, 0, near), np.where(miss, 0, far)


def trace_rays(scene: AnalyticScene, o: np.ndarray, d: np.ndarray, end: np.ndarray | None = None) -> RayTruth:
    """Compute the true values along float64 rays ``o + t d`` (N, 3) through ``scene``, up to the distances ``end``
    (N,).
    """
    near, far = intersect_unit_cube(o, d)
    if end is not None:
        far = np.clip(far, near, np.maximum(end, near))
    return (_trace_pieces if scene.optical_depth is None else _trace_profile)(scene, o, d, near, far)


def find_first_solid(scene: AnalyticScene, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Find the distance (N,) to the first solid in a scene with constant density between breaks; inf on a miss.

    Solid is matter denser than `SOLID_DENSITY`.
    """
    start, length, sigma = _find_intervals(scene, o, d, *intersect_unit_cube(o, d))
    solid = (sigma > SOLID_DENSITY) & (length > 0)
    return np.where(solid.any(-1), start[np.arange(len(o)), np.argmax(solid, -1)], np.inf)


def _find_intervals(scene, o, d, near, far):
    """Return starts, lengths and densities (N, K) of the pieces between breaks."""
    t = np.concatenate([near[:, None], scene.breaks(o, d), far[:, None]], -1)
    t = np.sort(np.clip(t, near[:, None], far[:, None]), -1)
    start, length = t[:, :-1], np.diff(t, axis=-1)
    p = o[:, None] + d[:, None] * (start + length / 2)[..., None]
    return start, length, scene.density(p[..., 0], p[..., 1], p[..., 2], NUMPY_FUNCTIONS)


def _trace_pieces(scene, o, d, near, far) -> RayTruth:
    start, length, sigma = _find_intervals(scene, o, d, near, far)
    tau = sigma * length
    before = np.cumsum(tau, -1) - tau
    mean_depth = mean_depth_fraction(tau)
    moment = (np.exp(-before) * -np.expm1(-tau) * (start + length * mean_depth)).sum(-1)
    total = tau.sum(-1)

    row = np.arange(len(o))

    def crossing(goal):
        """Return the distance at which the optical depths ``goal`` are reached, and the length per optical depth
        there."""
        i = np.argmax((before + tau >= goal[:, None]) & (tau > 0), -1)
        slope = length[row, i] / np.where(tau[row, i] > 0, tau[row, i], 1)
        return start[row, i] + slope * (goal - before[row, i]), slope

    free_path = crossing(np.full(len(o), np.log(2)))[1]
    return RayTruth(total, moment, lambda goal: crossing(goal)[0], np.where(total >= np.log(2), free_path, 0))


def mean_depth_fraction(x: np.ndarray) -> np.ndarray:
    """Return 1/x - 1/expm1(x), by its series where the difference cancels."""
    small = x < 1e-2
    y = np.clip(np.where(small, 1, x), None, 700)
    large = 1 / np.where(small, 1, x) - 1 / np.expm1(y)
    return np.where(small, 0.5 - x / 12 + x**3 / 720, large)


def _trace_profile(scene, o, d, near, far) -> RayTruth:
    x, w = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    edges = (np.arange(QUADRATURE_PANELS)[:, None] + 0.5 + 0.5 * x) / QUADRATURE_PANELS
    length = far - near
    moment = np.zeros(len(o))
    for share, weight in zip(edges.ravel(), np.tile(w, QUADRATURE_PANELS)):
        t = near + length * share
        p = o + d * t[:, None]
        sigma = scene.density(p[:, 0], p[:, 1], p[:, 2], NUMPY_FUNCTIONS)
        moment += weight * t * sigma * np.exp(-scene.optical_depth(o, d, near, t))
    moment *= length / (2 * QUADRATURE_PANELS)
    total = np.where(length > 0, scene.optical_depth(o, d, near, far), 0)

    def crossing(goal):
        low, high = near.copy(), far.copy()
        for _ in range(60):
            middle = 0.5 * (low + high)
            short = scene.optical_depth(o, d, near, middle) < goal
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return high

    p = o + d * crossing(np.log(2))[:, None]
    is_reached = total >= np.log(2)
    sigma = np.where(is_reached, scene.density(p[:, 0], p[:, 1], p[:, 2], NUMPY_FUNCTIONS), 1)
    return RayTruth(total, moment, crossing, np.where(is_reached, 1 / sigma, 0))


@dataclass(frozen=True)
class StudyTruth:
    """Reference picture with one row per ray or pixel.

    ``color`` (N, 3) is linear, the others are (N,); ``gaze`` is 0 without a gaze field. ``source`` describes the
    reference, ``convergence`` its change, by error, when its step was halved (empty for closed forms).
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
) -> StudyTruth:
    """Compute the reference of the channels of ``nerg`` for rays (N, 3), as defined on its manual page.

    ``gaze`` is the gaze of the scene's observer (a single-precision network, evaluated at float64 positions), or None.
    """
    camera_ray = trace_rays(scene, o, d)
    t = camera_ray.depth(depth)
    surface = camera_ray.opacity >= surface_opacity
    p_d = o + d * t[:, None]
    p_o = np.asarray(scene.observer, float)
    # The target point is in front of the surface, by the tolerance and by the penetration depth of light.
    in_front = tolerance + np.minimum(DEPTHS.find(depth).mean_free_paths * camera_ray.free_path, t * MAX_SURFACE_SHIFT)
    distance, r_o = distance_and_direction(p_o, p_d - d * in_front[:, None])
    start = np.broadcast_to(p_o, o.shape)
    p_od = p_d
    if visibility == "transmittance":
        visible_fraction = np.exp(-trace_rays(scene, start, r_o, distance).tau)
    else:
        observer_ray = trace_rays(scene, start, r_o)
        d_o = np.where(observer_ray.opacity >= surface_opacity, observer_ray.depth(depth), np.inf)
        visible_fraction, p_od = _compare_depths(distance, d_o, tolerance, falloff, p_d, p_o, r_o)
    visible_fraction = np.where(surface, visible_fraction, 0)
    density = (
        np.zeros(len(o))
        if gaze is None
        else evaluate_gaze(gaze, p_od, p_o, distance_and_direction(p_o, p_d)[1]) * visible_fraction
    )
    return StudyTruth(
        camera_ray.color(o, d), camera_ray.opacity, t, visible_fraction, density, "float64 closed form", {}
    )


def _compare_depths(distance, d_o, tolerance: float, falloff: float, p_d, p_o, r_o) -> tuple[np.ndarray, np.ndarray]:
    """Compute the visibility (N,) from the ``distance`` (N,) to the points ``p_d`` and the distance ``d_o`` (N,) to the
    first surface.

    Also returns the points (N, 3) that the observer at ``p_o`` sees along ``r_o`` (N, 3).
    """
    excess = distance - d_o - tolerance
    visible_fraction = 1 - (np.clip(excess / falloff, 0, 1) if falloff > 0 else (excess > 0))
    blocked = excess > 0
    return visible_fraction, np.where(blocked[:, None], p_o + r_o * np.where(blocked, d_o, 0)[:, None], p_d)


def distance_and_direction(p_o, p):
    """Return the distance (N,) and unit direction (N, 3) from ``p_o`` to ``p``."""
    v = p - p_o
    distance = np.linalg.norm(v, axis=-1)
    return distance, v / np.where(distance > 0, distance, 1)[:, None]


def evaluate_gaze(gaze: ObservedGaze, p_od, p_o, r_o) -> np.ndarray:
    """Evaluate the gaze density (N,) in 1/sr at points (N, 3) seen along unit ``r_o`` (N, 3) from the observer
    ``p_o``."""
    mi = variant_types()
    surface, observer, direction = (
        to_vector(kind, np.broadcast_to(v, p_od.shape))
        for kind, v in ((mi.Point3f, p_od), (mi.Point3f, p_o), (mi.Vector3f, r_o))
    )
    return np.array(gaze.evaluate(surface, observer, direction, mi.Bool(True))[0], float)


# ---- Errors of a picture relative to the truth ----

MIN_SURFACE_OPACITY = 0.5  # Opacity from which a ray hits a surface
MIN_DEPTH_OPACITY = 1e-3  # Opacity from which depths are compared
KLD_EPS = 1e-6  # Relative to the mean; bounds the penalty of zero gaze where the truth is not zero (13.8 nats)

ERROR_NAMES = tuple(
    """
    color_rmse color_psnr opacity_mae depth_mae depth_median depth_p99 visibility_mae visibility_wrong gaze_mae gaze_kld
    surface_mae surface_p99
    """.split()
)


def compute_errors(
    channels: dict[str, np.ndarray], truth: StudyTruth, exact: tuple[np.ndarray, np.ndarray] | None = None
) -> dict[str, float]:
    """Compute the errors of rendered channels by name; missing channels are skipped.

    Parameters
    ----------
    channels : dict
        Rendered channels (N,), colour (N, 3).
    truth : StudyTruth
        Reference.
    exact : tuple, optional
        Exact distances (inf on a miss) and visibilities.

    Returns
    -------
    dict
        ``color_rmse``: linear radiance, over pixels and channels; ``color_psnr``: -20 log10 of it in dB; ``depth_mae``,
        ``depth_median``, ``depth_p99``: mean, median and 99th percentile of |depth - truth| in scene units, over rays
        of opacity >= `MIN_DEPTH_OPACITY`, where misses count with depth 0; ``visibility_mae``, ``gaze_mae`` (1/sr):
        over pixels that truly show a surface; ``gaze_kld``: nats, of both pictures as densities over those pixels.
        With ``exact``: ``surface_mae``, ``surface_p99``: |depth - exact| over exact hits; ``visibility_wrong``:
        fraction of these pixels with the wrong binary visibility (threshold 1/2).
    """
    out = {}
    if "color" in channels and np.any(channels["color"]):
        out["color_rmse"] = float(np.sqrt(np.mean((channels["color"] - truth.color) ** 2)))
        out["color_psnr"] = psnr_from_mse(out["color_rmse"] ** 2, 1e-24)
    if "opacity" in channels:
        out["opacity_mae"] = float(np.mean(np.abs(channels["opacity"] - truth.opacity)))
    traced = truth.opacity >= MIN_DEPTH_OPACITY
    if "depth" in channels and traced.any():
        off = np.abs(channels["depth"] - truth.depth)[traced]
        out["depth_mae"] = float(off.mean())
        out["depth_median"], out["depth_p99"] = np.percentile(off, [50, 99]).tolist()
    surface = truth.opacity >= MIN_SURFACE_OPACITY
    if "visibility" in channels and surface.any():
        out["visibility_mae"] = float(np.mean(np.abs(channels["visibility"] - truth.visibility)[surface]))
    if "gaze" in channels and np.any(truth.gaze[surface] > 0):
        out["gaze_mae"] = float(np.mean(np.abs(channels["gaze"] - truth.gaze)[surface]))
        out["gaze_kld"] = float(metrics.kld(truth.gaze[surface], channels["gaze"][surface], eps=KLD_EPS))
    if exact is not None:
        distance, visible = exact
        hit = np.isfinite(distance)
        if "depth" in channels:
            off = np.abs(channels["depth"] - np.where(hit, distance, 0))[hit]
            out["surface_mae"], out["surface_p99"] = float(off.mean()), float(np.percentile(off, 99))
        if "visibility" in channels:
            out["visibility_wrong"] = float(np.mean(((channels["visibility"] > 0.5) != visible)[hit]))
    return out


# ---- Scenes of shapes without a field: float64 ray casts at their triangles ----

CHUNK = 64  # Rays tested against all triangles at once
COLOR_SPP = 256  # Samples per pixel of the reference colour


def extract_triangles(scene) -> np.ndarray:
    """Extract the corners (N, 3, 3), float64, of all shapes of a Mitsuba scene. Raises `NergError` for a shape that is
    not a mesh.
    """
    parts = []
    for shape in scene.shapes():
        if not shape.is_mesh():
            raise NergError(
                f"a study of shapes supports only meshes, and this scene has a {shape.class_name()}; convert it to "
                "triangles"
            )
        vertices, faces = read_triangles(shape)
        parts.append(vertices[faces])
    return np.concatenate(parts)


def find_first_hit(triangles: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Find the distance (N,) at which rays ``o + t d`` (N, 3), t > 0, first hit one of the triangles (M, 3, 3); inf on
    a miss.

    Möller and Trumbore 1997, in float64. Edges count as inside up to rounding, so that no ray passes between
    neighbours.
    """
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    out = np.empty(len(o))
    for begin in range(0, len(o), CHUNK):
        origin, direction = o[begin : begin + CHUNK, None], d[begin : begin + CHUNK, None]
        p = np.cross(direction, v)
        det = (p * u).sum(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            first = (s * p).sum(-1) / det
            q = np.cross(s, u)
            second = (q * direction).sum(-1) / det
            t = (q * v).sum(-1) / det
            hit = (first >= -1e-12) & (second >= -1e-12) & (first + second <= 1 + 1e-12) & (t > 0) & (det != 0)
        out[begin : begin + CHUNK] = np.where(hit, t, np.inf).min(-1)
    return out


def make_observed_gaze(subject, p_o: np.ndarray) -> ObservedGaze:
    """Make the gaze field of ``subject`` for the observer at ``p_o`` (3,)."""
    import mitsuba as mi

    # Use the integral of the integrator over all directions: its ray casts are exact to single precision, and tested
    # against ``find_first_hit``.
    integrator = subject.make_integrator({"integral_tolerance": 0.0})
    environment = SceneGeometry(None, subject.scene)
    return integrator.gaze.for_observers([mi.Point3f(*p_o.tolist())], environment, integrator.observer_settings)


def compute_truth_of_shapes(subject, seed: int, visibility: str, color: np.ndarray) -> StudyTruth:
    """Compute the reference of the channels of ``nerg`` for shapes without a field, as defined on its manual page.

    ``color`` (N, 3) is the converged colour.
    """
    o, d = subject.record_rays(seed)
    t = subject.find_first_hits(seed)
    hit = np.isfinite(t)
    depth = np.where(hit, t, 0)
    p_d, p_o = o + d * depth[:, None], subject.observer_position()
    distance, r_o = distance_and_direction(p_o, p_d - d * subject.tolerance)
    first_hit = find_first_hit(subject.triangles, np.broadcast_to(p_o, o.shape), r_o)
    p_od = p_d
    if visibility == "transmittance":
        visible_fraction = (first_hit >= distance).astype(float)
    else:
        falloff = float(subject.base_params["falloff"])
        visible_fraction, p_od = _compare_depths(distance, first_hit, subject.tolerance, falloff, p_d, p_o, r_o)
    visible_fraction = np.where(hit, visible_fraction, 0)
    gaze = np.zeros(len(o))
    if subject.has_gaze:
        gaze = (
            evaluate_gaze(make_observed_gaze(subject, p_o), p_od, p_o, distance_and_direction(p_o, p_d)[1])
            * visible_fraction
        )
    source = f"float64 ray casts; colour the mean of {COLOR_SPP} samples per pixel"
    return StudyTruth(color, hit.astype(float), depth, visible_fraction, gaze, source, {})


# ---- Splats ----
#
# Parameters of Gaussian splats: they are not marched, but cut off at a number of standard deviations, and rays end
# where little light is left.

SPLAT_EXTENTS = (1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
SPLAT_STOPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
REFERENCE_EXTENTS = ({"extent": 8.0}, {"extent": 6.0})
"""Cut-off of the Gaussians in a reference, and in a second one that measures its convergence."""
SPLAT_SOURCE = f"render of Gaussians cut off at {REFERENCE_EXTENTS[0]['extent']:g} standard deviations"


def apply_splat_extent(params: Mapping) -> dict:
    """Remove ``extent`` from the integrator ``params`` and apply it: the field is replaced by one whose Gaussians are
    cut off there.
    """
    import mitsuba as mi

    result = dict(params)
    extent = result.pop("extent", None)
    if extent is not None:
        field = result["field"]
        medium = field.medium()
        to_world = mi.ScalarTransform4f(medium.to_world.matrix.tolist())
        splats = {"type": "splats", "filename": field.filename, "color_space": medium.color_space}
        result["field"] = mi.load_dict(splats | {"to_world": to_world, "extent": extent})
    return result
