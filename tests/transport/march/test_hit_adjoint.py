"""Derivatives of splats against central differences, of the ray and of what Gaussians are."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.field.splats import Splats
from nerg_mi.transport.march.march import march
from nerg_mi.transport.march.settings import MarchSettings
from nerg_mi.transport.media.painting import ColorPainter
from tests.formats.splats.writers import random_splats
from tests.reference.splats import trace
from tests.transport.media.splats.scenes import medium_of, rays

# Ends nowhere, so that the sums are smooth but for the rims of Gaussians.
SETTINGS = MarchSettings(0.01, stop=0.0)
NAMES = ("centers", "scales", "rotations", "opacities", "harmonics")


def outputs(mi, medium, o, d):
    """A number that depends on all sums of a march."""
    ray = medium.local(o, d)
    result = march(medium, ray, mi.Float(0), ray.t_far, True, SETTINGS, color=ColorPainter(mi.Color3f))
    half = dr.select(dr.isfinite(result.half), result.half, 0)
    return dr.sum(result.opacity + 0.3 * result.expected_depth + dr.dot(result.color, [0.5, 0.2, 0.1]) + 0.1 * half)


def reference(splats, o, d):
    """The same in float64."""
    opacity, color, expected, _ = trace(splats, o, d, stop=0.0)
    t, weight, order = halves(splats, o, d)
    return float((opacity + 0.3 * expected + color @ [0.5, 0.2, 0.1]).sum() + 0.1 * t.sum())


def halves(splats, o, d):
    from tests.reference.splats import peaks

    t, absorbed = peaks(splats, o, d)
    absorbed = np.where(t >= 0, absorbed, 0)
    order = np.argsort(t, axis=1)
    through = np.cumprod(1 - np.take_along_axis(absorbed, order, 1), axis=1)
    at = np.argmax(through <= 0.5, axis=1)
    crossed = through[:, -1] <= 0.5
    return np.where(crossed, np.take_along_axis(t, order, 1)[np.arange(len(t)), at], 0), through, order


def changed(splats, name, value):
    return Splats(**{n: value if n == name else getattr(splats, n) for n in NAMES})


@pytest.fixture
def case():
    # Wide and thin: rims of Gaussians, where they jump by a hundredth, are met by no ray that a difference moves.
    return random_splats(14, degree=1, size=0.5), *rays(12, size=0.6)


def test_gradients_of_gaussians(rgb, case):
    splats, o, d = case
    medium = medium_of(splats)
    arrays = medium.arrays
    for value in arrays.parameters().values():
        dr.enable_grad(value)
    arrays.pack()
    loss = outputs(rgb, medium, rgb.Point3f(o.T), rgb.Vector3f(d.T))
    assert np.isclose(loss[0], reference(splats, o, d), rtol=1e-5)
    dr.backward(loss)
    rng = np.random.default_rng(0)
    for name, value in arrays.parameters().items():
        found = np.array(dr.grad(value)).reshape(getattr(splats, name).shape)
        direction = rng.normal(size=found.shape)
        base = getattr(splats, name).astype(np.float64)
        step = 1e-4
        ends = [reference(Double(splats, name, base + s * step * direction), o, d) for s in (1, -1)]
        wanted = (ends[0] - ends[1]) / (2 * step)
        assert np.isclose((found * direction).sum(), wanted, rtol=1e-2, atol=1e-2), name


class Double:
    """Splats in float64 for differences, with one array changed."""

    def __init__(self, splats, name, value):
        self.degree = splats.degree
        for n in NAMES:
            setattr(self, n, value if n == name else getattr(splats, n).astype(np.float64))

    def axes(self):
        from nerg_mi.field.splats import matrices_of

        return matrices_of(self.rotations / np.linalg.norm(self.rotations, axis=1, keepdims=True))


def test_gradients_of_rays_both_ways(rgb, case):
    splats, o, d = case
    medium, along = medium_of(splats), np.array([0.3, -0.5, 0.8])
    ends = [reference(splats, o + s * 1e-4 * along, d) for s in (1, -1)]
    wanted = (ends[0] - ends[1]) / 2e-4
    shift = rgb.Float(0)
    dr.enable_grad(shift)
    loss = outputs(rgb, medium, rgb.Point3f(o.T) + rgb.Vector3f(*along.tolist()) * shift, rgb.Vector3f(d.T))
    dr.backward(loss)
    assert np.isclose(dr.grad(shift)[0], wanted, rtol=1e-2)
    other = rgb.Float(0)
    dr.enable_grad(other)
    loss = outputs(rgb, medium, rgb.Point3f(o.T) + rgb.Vector3f(*along.tolist()) * other, rgb.Vector3f(d.T))
    assert np.isclose(dr.forward_to(loss) if other is None else forward(other, loss), wanted, rtol=1e-2)


def forward(value, loss):
    dr.forward(value)
    return dr.grad(loss)[0]
