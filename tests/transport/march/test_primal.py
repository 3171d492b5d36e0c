"""The march against closed forms and a float64 march: slabs of every density, grids, leaping, jitter, stopping."""

import math

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import ColorPainter
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.reference import march_numpy as reference

DIAGONAL = 3**0.5
DEFAULT = MarchSettings(DIAGONAL / 1024)


def slab(mi, sigma, near=0.0, length=1.0):
    """A box from z = ``near``, ``length`` deep and wide."""
    to_world = mi.ScalarTransform4f().translate([0, 0, near]).scale(length)
    return VolumeMedium(mi.load_dict({"type": "constvolume", "value": float(sigma), "to_world": to_world}))


def grid(mi, data, **kwargs):
    return VolumeMedium(mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(data.astype(np.float32)), **kwargs}))


def run(mi, medium, o, d, settings=DEFAULT, **kwargs):
    o, d = np.atleast_2d(np.asarray(o, np.float32)), np.atleast_2d(np.asarray(d, np.float32))
    ray = medium.local(mi.Point3f(o.T), mi.Vector3f(d.T))
    t0 = dr.maximum(ray.t_near, 0)
    return march(medium, ray, t0, ray.t_far, True, settings, **kwargs)


def one(x):
    return float(x.numpy()[0])


# ------------------------------------------------------------------------
#  Homogeneous slabs
# ------------------------------------------------------------------------


@pytest.mark.parametrize("near", [0, 1, 10])
@pytest.mark.parametrize("sigma", [1e-8, 1e-6, 1e-3, 1, 3, 1e3, 1e6, 1e9])
def test01_slab(rgb, sigma, near):
    r = run(rgb, slab(rgb, sigma, near), (0.5, 0.5, 0), (0, 0, 1))
    opacity, expected, median = reference.slab(sigma, near, near + 1)
    assert np.isclose(one(r.opacity), opacity, rtol=1e-5)
    assert np.isclose(one(r.expected_depth), expected, rtol=1e-5)
    if sigma > 1:
        assert np.isclose(one(r.half), near + math.log(2) / sigma, rtol=1e-5)
    else:
        assert one(r.half) == (np.inf if sigma < 0.69 else pytest.approx(near + math.log(2) / sigma))


@pytest.mark.parametrize("sigma", [10, 1e3, 1e6, 1e9])
def test02_depth_remaining_before_a_dense_slab(rgb, sigma):
    # With the face at the ray's origin the depth is 1/σ and nothing else.
    r = run(rgb, slab(rgb, sigma), (0.5, 0.5, 0), (0, 0, 1))
    assert np.isclose(one(r.expected_depth), reference.slab(sigma, 0, 1)[1], rtol=1e-5)


@pytest.mark.parametrize("size", [1e-3, 1, 1e6])
def test03_boxes_of_any_size(rgb, size):
    r = run(
        rgb, slab(rgb, 2 / size, size, size), (size / 2, size / 2, 0), (0, 0, 1), MarchSettings(size * DIAGONAL / 1024)
    )
    opacity, expected, _ = reference.slab(2, 1, 2)
    assert np.isclose(one(r.opacity), opacity, rtol=1e-5) and np.isclose(
        one(r.expected_depth) / size, expected, rtol=1e-5
    )


@pytest.mark.parametrize("distance", [100, 1000, 30000])
def test04_slabs_far_away(rgb, distance):
    # Positions are rounded to float32 there; optical depth must not be counted twice or lost for it.
    r = run(rgb, slab(rgb, 1e-3, distance), (0.5, 0.5, 0), (0, 0, 1))
    assert np.isclose(one(r.tau), 1e-3, rtol=2e-4)
    assert np.isclose(one(r.expected_depth), distance + 0.5, rtol=1e-5)


def test05_a_step_below_the_spacing_of_floats_loses_nothing(rgb):
    r = run(rgb, slab(rgb, 3, 1e5), (0.5, 0.5, 0), (0, 0, 1))
    assert np.isclose(one(r.opacity), 1 - math.exp(-3), rtol=0.02)


@pytest.mark.parametrize("sigma", [0, 1e-38])
def test06_vacuum(rgb, sigma):
    r = run(rgb, slab(rgb, sigma, 1), (0.5, 0.5, 0), (0, 0, 1))
    assert one(r.opacity) < 1e-30 and np.isfinite(one(r.expected_depth)) and one(r.half) == np.inf


def test07_misses_and_masks(rgb):
    medium = slab(rgb, 5, 1)
    r = run(rgb, medium, [(0.5, 0.5, 0), (2, 0.5, 0), (0.5, 0.5, 5), (0.5, 0.5, 1.75)], [(0, 0, 1)] * 4)
    assert np.allclose(r.opacity.numpy(), [1 - math.exp(-5), 0, 0, 1 - math.exp(-1.25)], rtol=1e-5)
    assert r.expected_depth.numpy()[1:3].tolist() == [0, 0]
    ray = medium.local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
    masked = march(medium, ray, rgb.Float([1, 1]), rgb.Float([2, 2]), rgb.Bool([True, False]), DEFAULT, count=True)
    assert masked.opacity.numpy()[1] == 0 < masked.opacity.numpy()[0] and masked.density_evals.numpy()[1] == 0
    empty = march(medium, ray, rgb.Float([1.5, 1.7]), rgb.Float([1.5, 1.6]), True, DEFAULT)
    assert empty.opacity.numpy().tolist() == [0, 0]


@pytest.mark.parametrize("sigma", [np.inf, 3e38])
def test08_infinite_density(rgb, sigma):
    r = run(rgb, slab(rgb, sigma, 1), (0.5, 0.5, 0), (0, 0, 1))
    assert (one(r.opacity), one(r.expected_depth), one(r.half)) == (1, 1, 1)


@pytest.mark.parametrize("samples", [1, 2, 4096])
def test09_any_number_of_steps_is_exact_in_constant_density(rgb, samples):
    r = run(rgb, slab(rgb, 3), (0.5, 0.5, -1), (0, 0, 1), MarchSettings(1 / samples), count=True)
    opacity, expected, _ = reference.slab(3, 1, 2)
    assert np.isclose(one(r.opacity), opacity, rtol=1e-5) and np.isclose(one(r.expected_depth), expected, rtol=1e-5)
    assert samples <= one(r.density_evals) <= samples + 1


# ------------------------------------------------------------------------
#  Grids, against the float64 march
# ------------------------------------------------------------------------


def rays(n=40, seed=1):
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o = (0.5 + 1.5 * o / np.linalg.norm(o, axis=-1, keepdims=True)).astype(np.float32)
    d = rng.uniform(0.1, 0.9, (n, 3)) - o
    return o, (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("gain, dt_gamma", [(1e-3, 0), (1, 0), (10, 0), (10, 0.01), (1e3, 0), (1e6, 0)])
def test10_gridvolume_equals_the_numpy_march(rgb, gain, dt_gamma):
    data = np.random.default_rng(0).exponential(1, (5, 4, 6)) * gain
    o, d = rays()
    settings = MarchSettings(1 / 64, dt_gamma=dt_gamma, stop=1e-9)
    medium = grid(rgb, data)
    r = run(rgb, medium, o, d, settings)
    for i in range(len(o)):
        o_i, d_i = o[i].astype(float), d[i].astype(float)
        near, far = reference.box(o_i, d_i, (0, 0, 0), (1, 1, 1))
        borders = reference.steps(max(near, 0), far, 1 / 64, dt_gamma)
        tau, expected, _, _, _ = reference.march(lambda p: reference.trilinear(data, p), o_i, d_i, borders)
        # The march may stop once it is opaque: compare opacities, and depth.
        assert np.isclose(r.opacity.numpy()[i], -math.expm1(-tau), rtol=2e-5)
        assert np.isclose(r.expected_depth.numpy()[i], expected, rtol=2e-5)


def test11_halving_the_step_converges_with_second_order(rgb):
    data = np.random.default_rng(3).exponential(2, (4, 4, 4))
    o, d = rays(30)
    fine = []
    for i in range(len(o)):
        near, far = reference.box(o[i].astype(float), d[i].astype(float), (0, 0, 0), (1, 1, 1))
        borders = np.linspace(near, far, 4001)
        fine.append(reference.march(lambda p: reference.trilinear(data, p), o[i], d[i], borders)[0])
    errors = []
    for n in (8, 16, 32, 64):
        tau = run(rgb, grid(rgb, data), o, d, MarchSettings(1 / n, stop=0)).tau.numpy()
        errors.append(np.sqrt(np.mean((tau - fine) ** 2)))
    # The midpoint rule is of second order but for the kinks of the interpolation and the last, shorter step.
    assert errors[3] < errors[0] / 16 and all(b < a for a, b in zip(errors, errors[1:]))


def test12_colour(rgb):
    data = np.random.default_rng(0).exponential(3, (4, 4, 4))
    tint = np.random.default_rng(1).random((3, 5, 4, 3))
    medium = VolumeMedium(
        rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data.astype(np.float32)), "raw": True}),
        rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(tint.astype(np.float32)), "raw": True}),
    )
    o, d = rays(20)
    r = run(rgb, medium, o, d, MarchSettings(1 / 64, stop=1e-9, color_cutoff=0), color=ColorPainter(rgb.Color3f))
    for i in range(len(o)):
        near, far = reference.box(o[i].astype(float), d[i].astype(float), (0, 0, 0), (1, 1, 1))
        total = reference.march(
            lambda p: reference.trilinear(data, p),
            o[i],
            d[i],
            reference.steps(near, far, 1 / 64),
            lambda p: reference.trilinear(tint, p),
        )[3]
        assert np.allclose(np.array(r.color)[:, i], total, rtol=5e-5)


# ------------------------------------------------------------------------
#  Controls
# ------------------------------------------------------------------------


@pytest.mark.parametrize("stop", [0, 1e-6, 1e-2])
def test13_early_stop(rgb, stop):
    medium = slab(rgb, 50, 1)
    full = run(rgb, medium, (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01, stop=stop), count=True)
    assert 1 - stop - 1e-6 <= one(full.opacity) <= 1
    steps = 100 if stop == 0 else math.ceil(-math.log(stop) / 0.5)
    assert abs(one(full.density_evals) - steps) <= 1
    assert abs(one(full.expected_depth) - 1.02) < 2e-3 + 2 * stop


@pytest.mark.parametrize("offset", [0.0, 1e-6, 0.25, 0.999999])
def test14_jitter_moves_borders_only(rgb, offset):
    # In constant density the borders of the steps do not matter, wherever the first one lies.
    for near in (0, 1, 50):
        r = run(rgb, slab(rgb, 3, near), (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01), offset=rgb.Float(offset))
        opacity, expected, _ = reference.slab(3, near, near + 1)
        assert np.isclose(one(r.opacity), opacity, rtol=2e-4), (near, offset)
        assert np.isclose(one(r.expected_depth), expected, rtol=2e-4)


def test15_jitter_equals_the_numpy_march(rgb):
    data = np.random.default_rng(0).exponential(5, (5, 4, 6))
    o, d = rays()
    shares = np.random.default_rng(2).uniform(0.01, 1, len(o)).astype(np.float32)
    r = run(rgb, grid(rgb, data), o, d, MarchSettings(1 / 16, stop=1e-9), offset=rgb.Float(shares))
    plain = run(rgb, grid(rgb, data), o, d, MarchSettings(1 / 16, stop=1e-9))
    for i in range(len(o)):
        near, far = reference.box(o[i].astype(float), d[i].astype(float), (0, 0, 0), (1, 1, 1))
        borders = reference.steps(near, far, 1 / 16, offset=float(shares[i]))
        tau = reference.march(lambda p: reference.trilinear(data, p), o[i], d[i], borders)[0]
        assert np.isclose(r.tau.numpy()[i], tau, rtol=3e-5)
    assert np.abs(r.tau.numpy() - plain.tau.numpy()).max() > 1e-3


def test16_until_ends_at_an_optical_depth(rgb):
    medium = slab(rgb, 4, 1)
    for goal in (1e-6, 0.1, 1.0, 3.9):
        r = run(rgb, medium, (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01), until=rgb.Float(goal), count=True)
        assert np.isclose(one(r.half), 1 + goal / 4, rtol=1e-5)
        assert one(r.density_evals) <= goal / 0.04 + 2
    assert one(run(rgb, medium, (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01), until=rgb.Float(4.5)).half) == np.inf


def field_with(bits, seed=0, gain=1.0):
    """A field of visible density, and the same without its occupancy grid."""
    import drjit.llvm.ad as ns

    config = RadianceConfig(
        HashGridConfig(levels=2, log2_rows=10, base=4, finest=16), width=16, geometry=3, sh_degree=2
    )
    out = []
    for occupancy in (OccupancyGrid(bits, ns, 0.01), None):
        f = RadianceField.random(config, Box((0, 0, 0), (1, 1, 1)), ns, seed, occupancy=occupancy)
        rng = np.random.default_rng(seed)
        f.set_parameters({"grid.table": ns.Float((gain * rng.normal(size=len(f.grid.table))).astype(np.float32))})
        out.append(FieldMedium(f))
    return out


class Masked:
    """A medium whose density is 0 in the empty cells of ``bits``; it is marched unskipped."""

    def __init__(self, medium, bits):
        self.medium, self.occupancy = medium, None
        self.bits = bits

    def __getattr__(self, name):
        return getattr(self.medium, name)

    def _full(self, p):
        import drjit.llvm.ad as ns

        grid = OccupancyGrid(self.bits, ns, 0)
        return grid.empty_cells(self.medium.to_unit(p)) == 0

    def density(self, p, active):
        return dr.select(self._full(p), self.medium.density(p, active), 0)

    def density_features(self, p, active):
        sigma, features = self.medium.density_features(p, active)
        return dr.select(self._full(p), sigma, 0), features


@pytest.mark.parametrize("dt_gamma", [0.0, 0.004])
@pytest.mark.parametrize("offset", [None, 0.37])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5, 1.0])
def test17_leaping_equals_marching_every_step(rgb, share, offset, dt_gamma):
    bits = np.random.default_rng(4).random((16, 16, 16)) < share
    leaping, plain = field_with(bits)
    o, d = rays(64, 5)
    d[0], o[0] = (0, 0, 1), (0.4, 0.6, -1)  # along an axis
    d[1], o[1] = (-1, 0, 0), (0.5, 0.6, 0.2)  # from inside
    settings = MarchSettings(1 / 200, dt_gamma=dt_gamma, stop=0)
    kwargs = dict(color=ColorPainter(rgb.Color3f), count=True, offset=None if offset is None else rgb.Float(offset))
    a = run(rgb, leaping, o, d, settings, **kwargs)
    b = run(rgb, Masked(plain, bits), o, d, settings, **kwargs)
    # Rounding of t may move a midpoint across the wall of a cell now and then. Growing steps start elsewhere
    # behind a leap, which is another sampling of the same place.
    error = np.abs(a.opacity.numpy() - b.opacity.numpy())
    if dt_gamma == 0:
        assert np.quantile(error, 0.9) < 2e-5 and error.mean() < 1e-4
    else:
        assert error.max() < 0.05 and error.mean() < 0.01
    counted = a.density_evals.numpy()
    if share == 0:
        assert not counted.any() and not a.tau.numpy().any()
    elif share == 1:
        assert np.allclose(counted, b.density_evals.numpy(), atol=1)
    else:
        # Evaluations are made in occupied cells only, which is the least there can be.
        assert counted.sum() < 1.15 * (share + 0.02) * b.density_evals.numpy().sum() + 10
        assert b.tau.numpy().sum() > 0


def test18_colour_only_where_the_weight_counts(rgb):
    bits = np.ones((4, 4, 4), bool)
    medium, _ = field_with(bits)
    o, d = rays(16)
    settings = {c: MarchSettings(1 / 64, color_cutoff=c) for c in (0, 1e-2, 1)}
    r = {c: run(rgb, medium, o, d, s, color=ColorPainter(rgb.Color3f), count=True) for c, s in settings.items()}
    assert np.array_equal(r[0].color_evals.numpy(), r[0].density_evals.numpy())
    assert 0 < r[1e-2].color_evals.numpy().sum() < r[0].color_evals.numpy().sum()
    assert not np.array(r[1].color).any() and not r[1].color_evals.numpy().any()
    assert all(np.array_equal(r[0].tau.numpy(), r[c].tau.numpy()) for c in r)


def test19_nothing_is_counted_unless_asked(rgb):
    r = run(rgb, slab(rgb, 1, 1), (0.5, 0.5, 0), (0, 0, 1))
    assert r.density_evals is None and r.color_evals is None and r.color is None


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test20_no_goal_falls_between_two_sums(rgb, quadrature):
    sigma, n = 2.9, 1000
    # Goals within some spacings of floats around the optical depth at each step's end.
    t = np.add.accumulate(np.concatenate([[np.float32(1)], np.full(n - 1, np.float32(1 / n))]), dtype=np.float32)[1:]
    goals = np.float32(sigma * (t.astype(float) - 1))[:, None]
    goals = (goals + np.arange(-8, 9) * np.spacing(goals)).astype(np.float32).ravel()
    medium = slab(rgb, sigma, 1)
    r = run(
        rgb,
        medium,
        np.tile(np.float32([0.5, 0.5, 0]), (len(goals), 1)),
        np.tile(np.float32([0, 0, 1]), (len(goals), 1)),
        MarchSettings(1 / n, quadrature=quadrature),
        until=rgb.Float(goals),
    )
    assert np.allclose(np.array(r.half), 1 + goals / sigma, rtol=1e-6)
