"""Tests of `nerg_mi.maths.color`."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.maths.color import (
    color_corrected_psnr,
    composite_to_linear,
    decode_srgb,
    encode_srgb,
    fit_color_correction,
    psnr,
    psnr_from_mse,
    srgb_to_linear,
)

# ---- The sRGB transfer function, and composited samples as linear radiance ----


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
    # Mitsuba's own conversion, as a second reference
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
def test04_zero_opacity_gives_no_nan(rgb, α):
    total, alpha = rgb.Color3f(α * 0.5), rgb.Float(α)
    dr.enable_grad(total, alpha)
    out = composite_to_linear(total, alpha, "srgb")
    assert np.allclose(np.array(out), α * iec(np.array(0.5)), rtol=1e-4)
    dr.backward(dr.sum(out), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    assert np.all(np.isfinite(np.array(dr.grad(total)))) and np.all(np.isfinite(np.array(dr.grad(alpha))))


@pytest.mark.parametrize("alpha", [0.02, 0.5, 1.0])
def test05_composite_derivatives(rgb, alpha):
    """With respect to the weighted sum and to the opacity that divides it: central differences of a lin(C / a)."""
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
def test06_numpy_round_trip(dtype):
    c = np.concatenate([np.linspace(0, 1, 101), [0.04045, -0.01]]).astype(dtype)
    linear = decode_srgb(c)
    assert linear.dtype == dtype and np.allclose(linear[:-1], iec(c[:-1].astype(float)), rtol=1e-5)
    assert np.allclose(encode_srgb(linear), c, atol=1e-6) and encode_srgb(linear).dtype == dtype
    # Values of the standard's own tables.
    assert decode_srgb(np.array(0.5)) == pytest.approx(0.214041, abs=1e-6)
    assert encode_srgb(np.array(0.5)) == pytest.approx(0.735357, abs=1e-6)


# ---- Colour correction ----
#
# Colours fitted from one image to another: corrections are recovered, and the scored half is not used for the fit.

A = np.array([[0.8, 0.05, 0.0], [0.0, 0.9, -0.04], [0.02, 0.0, 1.1]])
B = np.array([0.05, -0.02, 0.01])


def pictures(width=61):
    color = np.random.default_rng(0).uniform(0.1, 0.8, (40, width, 3))
    return color, color @ A.T + B


def test_color_correction_is_recovered():
    color, truth = pictures()
    m = fit_color_correction(color, truth)
    assert np.allclose(m, np.c_[A, B], atol=0.01)
    # Regularised least squares, solved for one channel alone.
    x = np.c_[color.reshape(-1, 3), np.ones(color[..., 0].size)]
    weight = 1e-3 * len(x)
    rows = np.r_[x, np.sqrt(weight) * np.eye(4)]
    goal = np.r_[truth[..., 1].ravel(), np.sqrt(weight) * np.eye(4)[1]]
    assert np.allclose(m[1], np.linalg.lstsq(rows, goal, rcond=None)[0])


def test_undetermined_correction_is_identity():
    color, truth = pictures()
    zeros = np.zeros(color.shape[:2], bool)
    assert np.allclose(fit_color_correction(color, truth, mask=zeros), np.eye(3, 4))
    assert np.allclose(fit_color_correction(color, color), np.eye(3, 4))


def test_offset_scales_with_coverage():
    color, truth = pictures()
    coverage = (np.arange(61) % 2).astype(float) * np.ones((40, 1))
    before_black = truth * coverage[..., None]
    assert np.allclose(
        fit_color_correction(color * coverage[..., None], before_black, coverage), np.c_[A, B], atol=0.02
    )


def test_right_half_is_scored_after_fit_on_the_left():
    color, truth = pictures()
    assert psnr(color, truth) < 25 < 40 < color_corrected_psnr(color, truth)
    # The odd column belongs to the left half: errors there are not scored, errors to the right are.
    for column, scored in ((30, False), (31, True)):
        spoilt = truth.copy()
        spoilt[:, column] = 0
        assert (color_corrected_psnr(truth, spoilt) < 25) == scored
    # The fit does not use the scored half.
    changed = color.copy()
    changed[:, 31:] = truth[:, 31:]
    assert color_corrected_psnr(changed, truth) < 25


def test_masked_pixels_are_ignored():
    color, truth = pictures()
    mask = np.ones(color.shape[:2], bool)
    mask[:, ::3] = False
    spoilt = np.where(mask[..., None], truth, 0)
    assert color_corrected_psnr(color, spoilt, mask=mask) == pytest.approx(
        color_corrected_psnr(color, truth, mask=mask), abs=1e-9
    )
    assert np.isnan(color_corrected_psnr(color, truth, mask=mask & False))


# ---- PSNR of images: known errors, masks, and no error ----


def test_psnr():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-0.2, 1.2, (5, 4, 3)), rng.random((5, 4, 3))
    error = (np.clip(a, 0, 1) - b) ** 2
    assert psnr(a, b) == pytest.approx(-10 * np.log10(error.mean()))
    mask = rng.random((5, 4)) < 0.5
    assert psnr(a, b, mask) == pytest.approx(-10 * np.log10(error[mask].mean()))
    assert psnr(b, b) == pytest.approx(120) and np.isnan(psnr(a, b, mask & False))


def test_psnr_of_a_mean_squared_error():
    assert psnr_from_mse(0.01) == pytest.approx(20) and psnr_from_mse(1.0) == 0
    assert psnr_from_mse(0.0) == pytest.approx(120) and psnr_from_mse(0.0, 1e-24) == pytest.approx(240)
