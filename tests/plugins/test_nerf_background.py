"""A background network behind a field, as `nerg` shows it: composited with the field in its own colour space."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import Background, BackgroundConfig
from nerg_mi.formats.fields import load_radiance

from . import fields
from .scenes import camera, render


def srgb_to_linear(c):
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0.04045) + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("scale, density", [(1.0, 1e-9), (2.5, 1e-9), (1.0, 0.4)])
def test01_seen_behind_the_field(rgb, tmp_path, scale, density):
    grid = HashGridConfig(levels=2, log2_rows=8, base=4, finest=16, dimensions=2)
    behind = Background.random(BackgroundConfig(3.0, grid, 16, sh_degree=2), ns)
    table = np.random.default_rng(0).normal(size=len(behind.grid.table)).astype(np.float32)
    behind.grid.table = ns.Float(table)
    fields.radiance(tmp_path / "field.safetensors", density_scale=density)
    field = fields.radiance(tmp_path / "behind.safetensors", density_scale=density, background=behind)
    again, meta = load_radiance(tmp_path / "behind.safetensors", ns)
    assert again.background.config == behind.config and np.array_equal(again.background.grid.table.numpy(), table)

    to_world = rgb.ScalarTransform4f().scale(scale)
    sensor = {
        **camera(rgb, (0.5 * scale, 0.4 * scale, -2.5 * scale), size=8),
        "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
    }
    volume = lambda name: {"type": "nerf", "filename": str(tmp_path / name), "to_world": to_world}
    nerg = lambda name, **k: {"type": "nerg", "field": volume(name), "aovs": "opacity", "color_cutoff": 0.0, **k}
    image = render(rgb, nerg("behind.safetensors"), sensor)
    without = render(rgb, nerg("field.safetensors"), sensor)
    alpha = image[..., 3:4]
    assert np.allclose(alpha, without[..., 3:4])

    uv = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2) + 0.5) / 8
    ray, _ = rgb.load_dict(sensor).sample_ray(0, 0.5, rgb.Point2f(uv.T.astype(np.float32)), rgb.Point2f(0.5))
    shown = np.array(field.background(ns.Array3f(np.array(ray.o) / scale), ns.Array3f(np.array(ray.d)))).T.reshape(
        8, 8, 3
    )
    # C, out of α lin(C / α)
    safe = np.where(alpha > 0, alpha, 1)
    ratio = without[..., :3] / safe
    ratio = np.where(ratio <= 0.0031308, 12.92 * ratio, 1.055 * np.maximum(ratio, 0.0031308) ** (1 / 2.4) - 0.055)
    expected = srgb_to_linear(alpha * ratio + (1 - alpha) * shown)
    assert np.allclose(image[..., :3], expected, rtol=1e-3, atol=1e-5) and np.ptp(shown) > 0.05
    # An environment of the scene takes its place.
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.4, 0.8]}}
    assert np.allclose(
        render(rgb, nerg("behind.safetensors"), sensor, sky=sky),
        render(rgb, nerg("field.safetensors"), sensor, sky=sky),
    )
