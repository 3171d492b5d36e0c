"""The sRGB transfer function, and composited samples as linear radiance."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.maths.color import composite_to_linear, decode_srgb, encode_srgb, srgb_to_linear


def iec(c):
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def test01_srgb(rgb):
    c = np.concatenate([np.linspace(0, 1, 101), [0.04045, np.nextafter(np.float32(0.04045), 1)]])
    x = rgb.Float(c)
    dr.enable_grad(x)
    y = srgb_to_linear(x)
    dr.backward(dr.sum(y))
    assert np.allclose(y.numpy(), iec(c), atol=2e-6)
    slope = (iec(c + 1e-6) - iec(c - 1e-6)) / 2e-6
    assert np.allclose(dr.grad(x).numpy()[1:-2], slope[1:-2], rtol=1e-3)
    # Mitsuba's own conversion, as a second opinion
    bitmap = rgb.Bitmap(np.repeat(c[None, :, None], 3, 2).astype(np.float32))
    bitmap.set_srgb_gamma(True)
    linear = np.array(bitmap.convert(component_format=rgb.Struct.Type.Float32, srgb_gamma=False))
    assert np.allclose(linear[0, :, 0], y.numpy(), atol=1e-5)


@pytest.mark.parametrize("space", ["srgb", "linear", "spectrum"])
def test02_rgb(rgb, space):
    α, c = 0.25, np.array([0.1, 0.4, 0.9])
    out = np.array(composite_to_linear(rgb.Color3f((α * c).tolist()), rgb.Float(α), space)).ravel()
    assert np.allclose(out, α * (iec(c) if space == "srgb" else c), atol=1e-6)


@pytest.mark.parametrize("space", ["srgb", "linear"])
def test03_mono_is_the_luminance(mono, space):
    α, c = 0.25, np.array([0.1, 0.4, 0.9])
    out = composite_to_linear(mono.Color3f((α * c).tolist()), mono.Float(α), space)
    assert len(out) == 1
    linear = iec(c) if space == "srgb" else c
    assert np.isclose(np.array(out).ravel()[0], α * linear @ [0.212671, 0.715160, 0.072169], rtol=1e-5)


@pytest.mark.parametrize("α", [0.0, 1e-38, 1e-20, 1e-6])
def test04_no_opacity_no_nan(rgb, α):
    total, alpha = rgb.Color3f(α * 0.5), rgb.Float(α)
    dr.enable_grad(total, alpha)
    out = composite_to_linear(total, alpha, "srgb")
    assert np.allclose(np.array(out), α * iec(np.array(0.5)), rtol=1e-4)
    dr.backward(dr.sum(out), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    assert np.all(np.isfinite(np.array(dr.grad(total)))) and np.all(np.isfinite(np.array(dr.grad(alpha))))


@pytest.mark.parametrize("alpha", [0.02, 0.5, 1.0])
def test05_derivatives_of_a_composite_are_those_of_its_colour(rgb, alpha):
    """With respect to the weighted sum and to the opacity it is divided by: central differences of a lin(C / a)."""
    shares = np.array([0.01, 0.03, 0.05, 0.3, 0.9])
    value = lambda total, a: a * iec(total / a)
    total, a = rgb.Float((shares * alpha).tolist()), rgb.Float(alpha)
    dr.enable_grad(total, a)
    a_lanes = a + dr.zeros(rgb.Float, 5)
    out = composite_to_linear(rgb.Color3f(total, 0, 0), a_lanes, "srgb")
    assert np.allclose(np.array(dr.detach(out))[0], value(shares * alpha, alpha), rtol=1e-5)
    weights = np.array([1, 2, 3, 4, 5.0])
    dr.backward(dr.sum(out[0] * rgb.Float(weights.tolist())))
    h = 1e-7
    by_total = (value(shares * alpha + h, alpha) - value(shares * alpha - h, alpha)) / (2 * h) * weights
    by_alpha = ((value(shares * alpha, alpha + h) - value(shares * alpha, alpha - h)) / (2 * h) * weights).sum()
    assert np.allclose(dr.grad(total).numpy(), by_total, rtol=1e-4)
    assert np.isclose(dr.grad(a).numpy()[0], by_alpha, rtol=1e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test06_numpy_values_there_and_back(dtype):
    c = np.concatenate([np.linspace(0, 1, 101), [0.04045, -0.01]]).astype(dtype)
    linear = decode_srgb(c)
    assert linear.dtype == dtype and np.allclose(linear[:-1], iec(c[:-1].astype(float)), rtol=1e-5)
    assert np.allclose(encode_srgb(linear), c, atol=1e-6) and encode_srgb(linear).dtype == dtype
    # Values that the standard's own tables give.
    assert decode_srgb(np.array(0.5)) == pytest.approx(0.214041, abs=1e-6)
    assert encode_srgb(np.array(0.5)) == pytest.approx(0.735357, abs=1e-6)
