"""Properties of all marches, for densities over seventeen orders of magnitude, and convergence with the step length."""

import functools
import math

import drjit as dr
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nerg_mi.transport.depth import DEPTHS, MarchContext
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import ColorShader, LocalRay
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.reference import march_numpy as reference

PIECES = 8
# The fixture `rgb` is the module mitsuba, which has no state to reset between examples.
few = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
density = st.one_of(st.just(0.0), st.floats(-8, 9).map(lambda e: 10**e))
densities = st.lists(density, min_size=PIECES, max_size=PIECES).map(np.float32)


class Along:
    """A medium whose density depends on z in [0, 1] only: ``f(z)``, with white colour."""

    occupancy = cells = step = hits = None
    is_density_separate = False

    def __init__(self, mi, f, *parameters):
        self.mi, self.f, self._parameters = mi, f, list(parameters)

    def parameters(self):
        return self._parameters

    def density(self, p, active):
        return dr.select(active, self.f(p.z), 0)

    def density_features(self, p, active):
        return self.density(p, active), []

    def color(self, features, p, w, active):
        return self.mi.Color3f(1)


def pieces(mi, table):
    """Constant density in ``PIECES`` equal parts of [0, 1]."""
    table = table if dr.is_array_v(table) else mi.Float(table)
    pick = lambda z: dr.gather(mi.Float, table, dr.minimum(mi.UInt32(z * PIECES), PIECES - 1))
    return Along(mi, pick, table)


def through(mi, medium, controls, **overrides):
    z = mi.Vector3f(0, 0, 1)
    # Opaque, so that all examples share their kernels.
    t0, t1 = dr.opaque(mi.Float, 0), dr.opaque(mi.Float, 1)
    ray = LocalRay(mi.Point3f(0), z, z, t0, t1)
    return ray, march(medium, ray, t0, t1, True, controls, **overrides)


def exact(table, borders=None):
    """``(opacity, expected, median)`` of piecewise constant density in float64."""
    table = np.asarray(table, float)
    borders = np.linspace(0, 1, PIECES + 1)
    tau, expected, median, _, _ = reference.march(
        lambda p: table[np.minimum((p[:, 2] * PIECES).astype(int), PIECES - 1)], (0, 0, 0), (0, 0, 1), borders
    )
    return -math.expm1(-tau), expected, median


def one(x):
    return float(np.array(x).ravel()[0])


WHOLE = MarchSettings(1 / PIECES, stop=0)


# ------------------------------------------------------------------------
#  Properties
# ------------------------------------------------------------------------


@given(table=densities)
@few
def test01_march_matches_float64_reference(rgb, table):
    ray, r = through(rgb, pieces(rgb, table), WHOLE)
    opacity, expected, median = exact(table)
    assert np.isclose(one(r.opacity), opacity, rtol=2e-6)
    if opacity > 0:
        assert np.isclose(one(r.expected_depth), expected, rtol=2e-6, atol=1e-12)
        result = DEPTHS.find("median").inside(
            MarchContext(r, pieces(rgb, table), ray, ray.t_near, ray.t_far, True, WHOLE)
        )
        # With almost no absorption behind the median, rounding of the optical depth moves it.
        tau = lambda t: np.interp(
            t, np.linspace(0, 1, PIECES + 1), np.concatenate([[0], np.cumsum(table.astype(float) / PIECES)])
        )
        assert np.isclose(one(result), median, rtol=1e-5) or np.isclose(tau(one(result)), tau(median), rtol=1e-5)


@given(table=densities, cutoff=st.sampled_from([0.0, 1e-4]))
@few
def test02_weights_sum_to_opacity(rgb, table, cutoff):
    _, r = through(
        rgb, pieces(rgb, table), MarchSettings(1 / 64, stop=0, color_cutoff=cutoff), color=ColorShader(rgb.Color3f)
    )
    # Matter that is fainter than the cut-off in total has no colour.
    if one(r.opacity) > 64 * cutoff:
        assert np.isclose(one(r.color.x), one(r.opacity), rtol=2e-6)


@given(table=densities, order=st.permutations(range(PIECES)))
@few
def test03_permuting_steps_preserves_opacity(rgb, table, order):
    a, b = (one(through(rgb, pieces(rgb, t), WHOLE)[1].opacity) for t in (table, table[list(order)]))
    assert np.isclose(a, b, rtol=1e-6)


@given(table=densities, parts=st.integers(2, 9))
@few
def test04_splitting_steps_preserves_everything(rgb, table, parts):
    _, a = through(rgb, pieces(rgb, table), WHOLE)
    _, b = through(rgb, pieces(rgb, table), MarchSettings(1 / PIECES / parts, stop=0))
    assert np.isclose(one(a.opacity), one(b.opacity), rtol=3e-6)
    # Boundaries of parts can be rounded across a boundary of pieces, by one floating-point spacing.
    slip = 2.0**-22 * float(table.max()) * math.exp(-min(one(a.tau), 80))
    assert np.isclose(one(a.expected_depth), one(b.expected_depth), rtol=1e-5, atol=min(slip, 1) * 1e-3 + 1e-6)


@given(first=density, last=density, n=st.integers(1, 40), kind=st.just("linear"))
@few
def test05_the_linear_rule_is_exact_in_opacity_for_linear_densities(rgb, first, last, n, kind):
    a, b = dr.opaque(rgb.Float, first), dr.opaque(rgb.Float, last)
    _, r = through(rgb, Along(rgb, lambda z: dr.lerp(a, b, z), a, b), MarchSettings(1 / n, stop=0, quadrature=kind))
    assert np.isclose(one(r.opacity), -math.expm1(-(first + last) / 2), rtol=1e-5)


@given(table=densities, gain=st.floats(1, 1e6))
@few
def test06_opacity_is_monotonic(rgb, table, gain):
    a, b = (one(through(rgb, pieces(rgb, t), WHOLE)[1].opacity) for t in (table, table * np.float32(gain)))
    assert b >= a * (1 - 1e-6)


@given(
    table=densities,
    kind=st.sampled_from(DEPTHS.names()),
    quadrature=st.sampled_from(["constant", "linear"]),
    stop=st.sampled_from([0.0, 1e-6, 1e-2]),
)
@few
def test07_depth_lies_in_the_box(rgb, table, kind, quadrature, stop):
    controls = MarchSettings(1 / 20, stop=stop, quadrature=quadrature)
    medium = pieces(rgb, table)
    ray, r = through(rgb, medium, controls)
    depth = one(DEPTHS.find(kind).inside(MarchContext(r, medium, ray, ray.t_near, ray.t_far, True, controls)))
    assert 0 <= depth <= 1 + 1e-6
    assert depth == 0 if not table.any() else True


@given(table=densities)
@few
def test08_derivatives_with_respect_to_each_density(rgb, table):
    # ∂α/∂σ_i = δ exp(-τ) for every i; the derivatives of depths are finite.
    x = rgb.Float(table)
    dr.enable_grad(x)
    _, r = through(rgb, pieces(rgb, x), WHOLE)
    dr.backward(r.opacity, flags=dr.ADFlag.ClearVertices)
    slope = math.exp(-float(table.astype(float).sum()) / PIECES) / PIECES
    assert np.allclose(np.array(dr.grad(x)), slope, rtol=1e-4, atol=1e-6)
    for y in (r.expected_depth, dr.select(dr.isfinite(r.median_depth), r.median_depth, 0)):
        dr.set_grad(x, 0)
        dr.backward(y, flags=dr.ADFlag.ClearVertices)
        assert np.all(np.isfinite(np.array(dr.grad(x))))


@given(
    direction=st.tuples(*[st.one_of(st.sampled_from([0.0, 1e-38, 1e-20, -1e-30]), st.floats(-1, 1, width=32))] * 3),
    origin=st.tuples(*[st.one_of(st.sampled_from([0.0, 1.0, 0.5, -1.0]), st.floats(-2, 3, width=32))] * 3),
)
@few
def test09_arbitrary_rays(rgb, direction, origin):
    d = np.array(direction)
    if np.linalg.norm(d) < 1e-3:
        d = d + (0, 0, 1)
    d = np.float32(d / np.linalg.norm(d)).astype(float)
    d[np.abs(d) < np.finfo(np.float32).tiny] = 0  # Dr.Jit's threads may flush subnormal numbers to zero
    hit = reference.box(np.float32(origin).astype(float), d, (0, 0, 0), (1, 1, 1))
    length = 0 if hit is None else max(hit[1] - max(hit[0], 0), 0)
    medium = _cube(rgb)
    ray = medium.ray_to_local(
        rgb.Point3f(*[dr.opaque(rgb.Float, float(v)) for v in origin]),
        rgb.Vector3f(*[dr.opaque(rgb.Float, float(v)) for v in d]),
    )
    r = march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, MarchSettings(1 / 16, stop=0))
    assert np.isclose(one(r.opacity), -math.expm1(-3 * length), rtol=1e-4, atol=1e-5)
    assert np.isfinite(one(r.expected_depth))


@functools.cache
def _cube(mi):
    return VolumeMedium(mi.load_dict({"type": "constvolume", "value": 3.0}))


# ------------------------------------------------------------------------
#  Order of convergence
# ------------------------------------------------------------------------


def smooth(z, exp, sin):
    return 4 * exp(-2 * z) * (1.2 + sin(9 * z))


def smooth_reference():
    borders = np.linspace(0, 1, 40001)
    f = lambda p: smooth(p[:, 2], np.exp, np.sin)
    tau, expected, median, _, _ = reference.march(f, (0, 0, 0), (0, 0, 1), borders)
    return np.array([tau, expected, median])


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test10_second_order_in_smooth_densities(rgb, quadrature):
    want = smooth_reference()
    errors = []
    for n in (8, 16, 32, 64):
        medium = Along(rgb, lambda z: smooth(z, dr.exp, dr.sin))
        controls = MarchSettings(1 / n, stop=0, quadrature=quadrature)
        ray, r = through(rgb, medium, controls)
        median = DEPTHS.find("median").inside(MarchContext(r, medium, ray, ray.t_near, ray.t_far, True, controls))
        errors.append(np.abs(np.array([one(r.tau), one(r.expected_depth), one(median)]) - want))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    # Optical depth and expected depth converge with the expected order at each halving. The median varies within its
    # step.
    assert np.all(orders[:, :2] > 1.7), orders
    assert errors[-1][2] < errors[0][2] / 32, errors


def test11_cells_do_not_depend_on_the_step(rgb):
    data = np.random.default_rng(3).exponential(2, (4, 4, 4)).astype(np.float32)
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True}))
    ray = medium.ray_to_local(
        rgb.Point3f(0.2, 0.3, -1), rgb.Vector3f(*(np.array([0.1, 0.2, 1]) / math.sqrt(1.05)).tolist())
    )
    tau = [
        one(
            march(
                medium,
                ray,
                ray.t_near,
                ray.t_far,
                True,
                MarchSettings(1 / n, stop=0, quadrature="cells", cell_step=1 / n),
            ).tau
        )
        for n in (1, 4, 16, 64)
    ]
    assert np.allclose(tau, tau[0], rtol=5e-6)


def test12_steps_shorter_than_a_sheet_find_it(rgb):
    # A volume without an occupancy bound is marched without skipping: a sheet is found wherever it lies within the
    # steps.
    start = rgb.Float(np.linspace(0, 0.01, 500, dtype=np.float32))
    medium = Along(rgb, lambda z: dr.select((z >= 0.03) & (z < 0.0301), 1e9, 1e-8))
    z = rgb.Vector3f(0, 0, 1)
    ray = LocalRay(rgb.Point3f(0, 0, start), z, z, rgb.Float(0), rgb.Float(0.05))
    for step, minimum in ((5e-5, 1), (9.5e-5, 1), (2e-4, 0.45)):
        r = march(medium, ray, dr.zeros(rgb.Float, 500), rgb.Float(0.05), True, MarchSettings(step))
        has_surface = np.array(r.opacity) > 0.5
        assert has_surface.mean() >= minimum
        assert np.allclose((np.array(r.expected_depth) + np.array(start))[has_surface], 0.03, atol=1.01 * step)
