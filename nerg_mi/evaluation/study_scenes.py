"""Analytic scenes of a study, with their volumes and sensors."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.observer_gaze import GazeFieldInstance

# NumPy versions of the Dr.Jit functions that densities use
NUMPY_FUNCTIONS = SimpleNamespace(select=np.where, exp=np.exp)

# Linear radiance at the lower corner of the box, and its gradient along x, y, z.
COLOR_BASE = np.array([0.1, 0.2, 0.15])
COLOR_SLOPE = np.array([[0.8, 0.0, 0.1], [0.0, 0.3, 0.4], [0.2, 0.5, 0.0]])


@dataclass(frozen=True)
class AnalyticScene:
    """Matter in the unit cube, a camera and an observer; lengths in scene units.

    Attributes
    ----------
    density : callable
        ``density(x, y, z, ns)`` in 1/unit, with the functions of ``ns`` (`NUMPY_FUNCTIONS` or drjit).
    breaks : callable
        ``breaks(o, d)`` returns the distances (N, K) at which the density may jump along float64 rays (N, 3).
    optical_depth : callable or None
        ``optical_depth(o, d, a, b)`` between the distances a and b (N,) in closed form; None if the density is constant
        between the breaks.
    is_opaque : bool
        Whether surfaces are hard enough for binary visibility.
    """

    name: str
    density: Callable
    breaks: Callable
    optical_depth: Callable | None = None
    camera: tuple = (0.9, -1.5, 0.8)
    target: tuple = (0.5, 0.5, 0.45)
    observer: tuple = (-0.7, -0.9, 0.7)
    fov: float = 42.0
    is_opaque: bool = False


def evaluate_color(p: np.ndarray) -> np.ndarray:
    """Evaluate the linear radiance (..., 3) at points (..., 3)."""
    return COLOR_BASE + p @ COLOR_SLOPE.T


# ---- Slab, sphere, sheets: constant between breaks ----

SLAB_DENSITY = 6.0
SPHERE_DENSITY, SPHERE_CENTER, SPHERE_RADIUS = 60.0, 0.5, 0.35
SHEET_DENSITY, SHEET_VACUUM, SHEET_THICKNESS = 1e5, 1e-4, 4e-3
# Each covers the part of the plane y = const with x < x_max and z < z_max.
SHEETS = ((0.25, 0.5, 1.0), (0.5, 1.0, 0.55), (0.75, 1.0, 1.0))


def _slab(x, y, z, ns):
    return 0 * x + SLAB_DENSITY


def _sphere(x, y, z, ns):
    a, b, c = x - SPHERE_CENTER, y - SPHERE_CENTER, z - SPHERE_CENTER
    return ns.select(a * a + b * b + c * c < SPHERE_RADIUS**2, SPHERE_DENSITY, 0.0)


def _sphere_breaks(o, d):
    v = o - SPHERE_CENTER
    b, c = (v * d).sum(-1), (v * v).sum(-1) - SPHERE_RADIUS**2
    # Single-precision directions are unit vectors only to 1e-7.
    a = (d * d).sum(-1)
    root = np.sqrt(np.maximum(b * b - a * c, 0))
    return np.stack([(-b - root) / a, (-b + root) / a], -1)


def _sheets(x, y, z, ns):
    inside = y < -1
    for at, x_max, z_max in SHEETS:
        inside = inside | ((y >= at) & (y < at + SHEET_THICKNESS) & (x < x_max) & (z < z_max))
    return ns.select(inside, SHEET_DENSITY, SHEET_VACUUM)


def _sheets_breaks(o, d):
    planes = [(1, at) for at, *_ in SHEETS] + [(1, at + SHEET_THICKNESS) for at, *_ in SHEETS]
    planes += [(0, m) for _, m, _ in SHEETS if m < 1] + [(2, m) for *_, m in SHEETS if m < 1]
    return np.stack([_crossing(o[:, k], d[:, k], at) for k, at in planes], -1)


def _crossing(o, d, at):
    parallel = d == 0
    return np.where(parallel, 0.0, (at - o) / np.where(parallel, 1.0, d))


def _no_breaks(o, d):
    return np.empty((len(o), 0))


# ---- Fog: smooth profiles over height z ----

FOG_DENSITY, FOG_HEIGHT = 20.0, 0.15
RAMP_DENSITY = 12.0


def _fog(x, y, z, ns):
    return FOG_DENSITY * ns.exp(-z / FOG_HEIGHT)


def _fog_optical_depth(o, d, a, b):
    first = _fog(None, None, o[:, 2] + d[:, 2] * a, NUMPY_FUNCTIONS)
    x = d[:, 2] * (b - a) / FOG_HEIGHT
    small = np.abs(x) < 1e-6
    return first * (b - a) * np.where(small, 1 - x / 2, -np.expm1(-x) / np.where(small, 1, x))


def _ramp(x, y, z, ns):
    return RAMP_DENSITY * z


def _ramp_optical_depth(o, d, a, b):
    return RAMP_DENSITY * (b - a) * (o[:, 2] + d[:, 2] * 0.5 * (a + b))


SCENES = {
    s.name: s
    for s in (
        AnalyticScene("slab", _slab, _no_breaks),
        AnalyticScene("sphere", _sphere, _sphere_breaks, is_opaque=True, observer=(-0.9, -0.3, 0.7)),
        AnalyticScene(
            "sheets", _sheets, _sheets_breaks, is_opaque=True, camera=(0.75, -1.5, 0.95), observer=(0.2, -1.2, 0.3)
        ),
        AnalyticScene("fog", _fog, _no_breaks, _fog_optical_depth),
        AnalyticScene("ramp", _ramp, _no_breaks, _ramp_optical_depth),
    )
}
"""Scenes by their name in ``nerg study``."""


# ---- As Mitsuba objects ----


@functools.cache
def _make_volume_classes(variant: str):
    """Return the volume classes of a variant. Mitsuba classes cannot be derived from when this module is imported."""
    import drjit as dr
    import mitsuba as mi

    class UnitVolume(mi.Volume):
        def bbox(self):
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0), mi.ScalarPoint3f(1))

        def to_string(self):
            return f"{type(self).__name__}[]"

    class Density(UnitVolume):
        """A density function over the unit cube."""

        def __init__(self, function):
            super().__init__(mi.Properties())
            self._function = function

        def eval_1(self, it, active=True):
            return dr.select(active, self._function(it.p.x, it.p.y, it.p.z, dr), 0)

    class Affine(UnitVolume):
        """Colour that is affine in position."""

        def eval(self, it, active=True):
            rows = [
                b + s[0] * it.p.x + s[1] * it.p.y + s[2] * it.p.z
                for b, s in zip(COLOR_BASE.tolist(), COLOR_SLOPE.tolist())
            ]
            c = mi.Color3f(*rows)
            return mi.Spectrum(mi.luminance(c)) if mi.is_monochromatic else mi.Spectrum(c)

    class Gaze(UnitVolume):
        """A smooth, untrained gaze field over the unit cube, equal in every run."""

        def __init__(self, props):
            super().__init__(props)
            ns = namespace(variant)
            config = GazeConfig(
                HashGridConfig(levels=2, log2_rows=10, base=3, finest=6), width=16, geometry=7, sh_degree=2
            )
            field = ProductHead.random(config, Box((0, 0, 0), (1, 1, 1)), ns, seed=1)
            rows = dr.width(field.parameters()["grid.table"])
            table = 2 * np.random.default_rng(1).normal(size=rows).astype(np.float32)
            field.set_parameters({"grid.table": ns.Float(table)})
            self._gaze = GazeFieldInstance(field)

        def placed_gaze(self):
            return self._gaze

    return SimpleNamespace(density=Density, color=lambda: Affine(mi.Properties()), gaze=lambda: Gaze(mi.Properties()))


def make_volumes(scene: AnalyticScene, resolution: int = 0) -> dict:
    """Make ``density``, ``color`` and ``gaze`` of the integrator.

    With a ``resolution`` the density is a ``gridvolume`` with this number of voxels along an edge and the exact density
    at their centres.
    """
    import mitsuba as mi

    classes = _make_volume_classes(mi.variant())
    density = classes.density(scene.density)
    if resolution:
        x = (np.arange(resolution) + 0.5) / resolution
        z, y, x = np.meshgrid(x, x, x, indexing="ij")
        values = np.broadcast_to(scene.density(x, y, z, NUMPY_FUNCTIONS), x.shape)
        grid = mi.VolumeGrid(np.ascontiguousarray(values[..., None], np.float32))
        density = mi.load_dict({"type": "gridvolume", "grid": grid, "filter_type": "trilinear", "wrap_mode": "clamp"})
    return {"density": density, "color": classes.color(), "gaze": classes.gaze()}


def make_sensor(origin, target, fov: float, width: int, height: int) -> dict:
    """Make a perspective camera with a box filter and float32 channels, z up."""
    import mitsuba as mi

    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "far_clip": 1e3,
        "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 0, 1]),
        "sampler": {"type": "independent", "sample_count": 1},
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "component_format": "float32",
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
    }
