"""The trainer's own pictures against a march in NumPy, pixel by pixel, and PSNR by its definition."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.radiance import RadianceConfig
from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import Camera, Intrinsics, pixel_directions
from nerg_mi.photos.images import View
from nerg_mi.train import radiance_trainer
from nerg_mi.train.radiance_sampling import StepTable
from nerg_mi.train.radiance_trainer import render_view

LENS = Intrinsics(13, 9, 12.0, 12.0, 6.5, 4.5)
STEP, NEAR = 0.1, 0.3


class Lump:
    """A soft ball in a box, brighter to the right, redder to the camera."""

    box, ns, config = Box((-1, -1, -1), (1, 1, 1)), ns, RadianceConfig()

    def density(self, p, active=True):
        return dr.select(active, 20 * dr.exp(-12 * dr.squared_norm(p)), 0)

    def density_features(self, p):
        return self.density(p), [p.x]

    def color(self, features, d):
        return ns.Array3f(0.5 + 0.4 * features[0], 0.5 - 0.3 * d.x, 0.25)


def view():
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.2, 2.5
    return View("v", Camera(LENS, pose), np.zeros((9, 13, 3), np.uint8))


def expected():
    """Colour, opacity and expected depth of all pixels: steps of the table, shifted by half, of constant density."""
    o = np.array([0.1, -0.2, 2.5])
    d = pixel_directions(LENS).reshape(-1, 3)
    edges = np.arange(0, 45) * STEP + STEP / 2
    t, middle = edges[:-1], edges[:-1] + STEP / 2
    p = o + d[:, None] * middle[:, None]
    sigma = 20 * np.exp(-12 * (p**2).sum(-1)) * (np.abs(p).max(-1) < 1) * (middle > NEAR)
    tau = sigma * STEP
    weight = np.exp(-(np.cumsum(tau, 1) - tau)) * -np.expm1(-tau)
    rgb = np.stack(
        [0.5 + 0.4 * p[..., 0], np.broadcast_to(0.5 - 0.3 * d[:, None, 0], tau.shape), np.full(tau.shape, 0.25)], -1
    )
    small = np.maximum(tau, 1e-9)
    share = np.where(tau > 1e-4, 1 / small - 1 / np.expm1(small), 0.5)
    opacity = weight.sum(1)
    depth = (weight * (t + STEP * share)).sum(1) / np.where(opacity > 0, opacity, 1)
    return (weight[..., None] * rgb).sum(1).reshape(9, 13, 3), opacity.reshape(9, 13), depth.reshape(9, 13)


@pytest.mark.parametrize("chunk", [2**22, 1000])
@pytest.mark.parametrize("every", [1, 2, 3])
def test_pictures(every, chunk, monkeypatch):
    monkeypatch.setattr(radiance_trainer, "_CHUNK", chunk)
    table = StepTable(ns, 0.0, 4.4, STEP, 0.0)
    seen = render_view(Lump(), lambda p, active: active, table, view(), NEAR, every=every, stop=0.0)
    color, opacity, depth = (v[every // 2 :: every, every // 2 :: every] for v in expected())
    assert seen.color.shape == color.shape and np.allclose(seen.color, color, atol=2e-5)
    assert np.allclose(seen.opacity, opacity, atol=2e-5) and 0.8 < opacity.max()
    assert np.allclose(seen.depth[opacity > 0.01], depth[opacity > 0.01], rtol=1e-4)


def test_a_deferred_field_has_the_colour_of_its_mean_features():
    """Which for one that is linear in them is the mean of colours."""
    lump = Lump()
    lump.config = RadianceConfig(deferred=True)
    table, anywhere = StepTable(ns, 0.0, 4.4, STEP, 0.0), lambda p, active: active
    seen = render_view(lump, anywhere, table, view(), NEAR, stop=0.0)
    assert np.allclose(seen.color, expected()[0], atol=2e-5)
    lump.color = lambda features, d: ns.Array3f(dr.square(features[0]))
    squares = render_view(lump, lambda p, a: a, StepTable(ns, 0.0, 4.4, STEP, 0.0), view(), NEAR, stop=0.0).color[
        ..., 0
    ]
    opacity = expected()[1]
    mean = (expected()[0][..., 0] - 0.5 * opacity) / 0.4 / np.where(opacity > 0, opacity, 1)
    assert np.allclose(squares, opacity * mean**2, atol=2e-5)


def test_a_background_shows_through():
    table = StepTable(ns, 0.0, 4.4, STEP, 0.0)
    color, opacity, _ = expected()
    seen = render_view(Lump(), lambda p, active: active, table, view(), NEAR, background=0.8, stop=0.0)
    assert np.allclose(seen.color, color + 0.8 * (1 - opacity[..., None]), atol=2e-5)


def test_empty_cells_and_pictures_of_nothing():
    table = StepTable(ns, 0.0, 4.4, STEP, 0.0)
    seen = render_view(Lump(), lambda p, active: active & False, table, view(), NEAR)
    assert not seen.color.any() and not seen.opacity.any() and not seen.depth.any() and seen.color.shape == (9, 13, 3)
