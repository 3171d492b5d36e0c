"""Depth tracing outside of a render: closed forms, both kinds of arrays, batches that do not matter."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import default_settings, trace_depth
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.volume_medium import VolumeMedium


@pytest.fixture
def slab(rgb):
    """The unit cube of density 3."""
    return VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 3.0}))


@pytest.fixture
def wall(rgb):
    """Opaque from x = 0.5 on, empty before."""
    data = np.zeros((4, 4, 4, 1), np.float32)
    data[:, :, 2:] = 1000
    return VolumeMedium(rgb.load_dict({"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest"}))


O = np.array([[-1.0, 0.3, 0.4], [-1.0, 0.3, 0.4], [0.25, 0.5, 0.5]], np.float32)
D = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0]], np.float32)


def test_constant_density_in_closed_form(slab):
    depth, opacity = trace_depth(slab, O, D)
    assert depth.dtype == opacity.dtype == np.float32
    alpha = 1 - np.exp(-3)
    np.testing.assert_allclose(opacity, [alpha, 0, 1 - np.exp(-3 * 0.75)], rtol=1e-5, atol=1e-7)
    half = lambda a: -np.log(1 - 0.5 * a) / 3
    np.testing.assert_allclose(depth, [1 + half(alpha), 0, half(opacity[2])], atol=1e-4)


def test_expected_depth_in_closed_form(slab):
    depth, _ = trace_depth(slab, O[:1], D[:1], kind="expected")
    mean = 1 / 3 - np.exp(-3) / (1 - np.exp(-3))
    assert depth[0] == pytest.approx(1 + mean, abs=1e-4)


def test_a_wall_is_where_it_stands(wall):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(200, 3))
    d[:, 0] = np.abs(d[:, 0]) + 0.5
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = np.tile([0.1, 0.5, 0.5], (200, 1))
    depth, opacity = trace_depth(wall, o, d)
    hit = np.abs(0.5 + d[:, 1:] * (0.4 / d[:, :1]) - 0.5).max(axis=1) < 0.49
    assert hit.sum() > 50
    np.testing.assert_allclose(depth[hit], 0.4 / d[hit, 0], atol=default_settings(wall).step)
    assert (opacity[hit] > 0.999).all()


@pytest.mark.parametrize("batch", [1, 2, 100])
def test_batches_and_kinds_of_arrays_agree(slab, rgb, batch):
    ns = namespace("llvm")
    expected = trace_depth(slab, O, D)
    found = trace_depth(slab, O, D, batch=batch)
    jit = trace_depth(slab, ns.Array3f(O.T), ns.Array3f(D.T), batch=batch)
    for e, f, j in zip(expected, found, jit):
        np.testing.assert_array_equal(f, e)
        assert dr.is_array_v(j)
        np.testing.assert_array_equal(np.array(j), e)


def test_a_field_scaled_by_ten_is_ten_times_as_far(rgb):
    ns = namespace("llvm")
    config = RadianceConfig(grid=HashGridConfig(levels=2, log2_rows=8, base=4, finest=8), width=16, density_scale=20.0)
    field = RadianceField.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 1, march_step=1 / 64)
    scaled = FieldMedium(field, Similarity(np.diag([10.0, 10, 10, 1])))
    near, a = trace_depth(FieldMedium(field), O[:1], D[:1])
    far, b = trace_depth(scaled, 10 * O[:1], D[:1])
    assert a[0] > 0.5
    np.testing.assert_allclose(far, 10 * near, rtol=1e-4)
    np.testing.assert_allclose(a, b, rtol=1e-4)


def test_no_gradient_is_left_behind(slab):
    ns = namespace("llvm")
    o = ns.Array3f(O.T)
    dr.enable_grad(o)
    depth, opacity = trace_depth(slab, o, ns.Array3f(D.T))
    assert not dr.grad_enabled(depth) and not dr.grad_enabled(opacity)


def test_settings_are_used(slab):
    coarse, _ = trace_depth(slab, O[:1], D[:1], MarchSettings(step=0.5), kind="expected")
    fine, _ = trace_depth(slab, O[:1], D[:1], kind="expected")
    # A constant density is integrated exactly whatever the step.
    assert coarse[0] == pytest.approx(fine[0], abs=1e-4)


def test_what_does_not_fit_is_named(slab):
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        trace_depth(slab, O, D[:2])
    with pytest.raises(ValueError, match="median"):
        trace_depth(slab, O, D, kind="first")
    with pytest.raises(ValueError, match="at least 1 ray"):
        trace_depth(slab, O, D, batch=0)
