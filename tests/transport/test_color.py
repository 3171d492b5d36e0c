"""From composited samples to linear radiance."""
import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.color import composite_to_linear, srgb_to_linear


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
