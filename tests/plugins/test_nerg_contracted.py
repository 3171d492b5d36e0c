"""A field without an end through the integrator: depths in scene units beyond the box, and an observer's view of it."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.formats.fields import save_radiance
from nerg_mi.maths.geometry import Box, ContractedBox

from .scenes import camera, channels, observer_at

BOX = ContractedBox(Box((-2, -2, -2), (2, 2, 2)), 16)


@pytest.fixture
def field(tmp_path):
    """σ = 0.25 / m², m the largest coordinate in half edges (2 units), at least 1."""
    config = RadianceConfig(
        HashGridConfig(levels=2, log2_rows=8, base=4, finest=16), width=16, geometry=3, sh_degree=2, density_scale=0.25
    )
    made = RadianceField.random(config, BOX, ns, march_step=0.02, march_growth=1 / 128)
    made.set_parameters({k: dr.zeros(type(v), v.shape) for k, v in made.parameters().items() if "density" in k})
    save_radiance(made, tmp_path / "f.safetensors", {})
    return {"type": "nerf", "filename": str(tmp_path / "f.safetensors")}


def median(start: float, toward: float) -> float:
    """Distance along z, from ``start`` on the axis on, within which half of all that is absorbed is, by a sum in
    float64."""
    t = np.arange(0, 32 - toward * start, 1e-4)
    tau = np.cumsum(0.25 / np.maximum(np.abs(start + toward * t) / 2, 1) ** 2 * 1e-4)
    return float(t[np.searchsorted(tau, -np.log1p(0.5 * np.expm1(-tau[-1])))])


def test_depth_beyond_the_box_is_that_of_the_scene(rgb, field):
    integrator = {"type": "nerg", "field": field, "aovs": "depth,opacity", "jitter": False}
    assert rgb.load_dict(integrator).settings.dt_gamma == 1 / 128
    assert 1 + median(1, 1) > 2
    # From within the inner cube out of it, and from outside through it.
    for start in (1, -5):
        out = channels(rgb, integrator, camera(rgb, (0, 0, start), (0, 0, 9), fov=0.5, size=4, near_clip=1e-4))
        np.testing.assert_allclose(out["depth.T"], median(start, 1), rtol=5e-4)


def test_uniform_steps_can_be_asked_for(rgb, field):
    integrator = {"type": "nerg", "field": field, "aovs": "depth", "dt_gamma": 0.0, "step": 0.01, "jitter": False}
    out = channels(rgb, integrator, camera(rgb, (0, 0, 1), (0, 0, 9), fov=0.5, size=4, near_clip=1e-4))
    np.testing.assert_allclose(out["depth.T"], median(1, 1), rtol=5e-4)


def test_what_an_observer_sees_beyond_the_box(rgb, field):
    """The observer looks toward the point that the camera sees, and meets a surface of its own before or behind it."""
    integrator = {
        "type": "nerg",
        "field": field,
        "aovs": "position,observer_depth",
        "observer": observer_at(rgb, 0, 0, -5),
        "jitter": False,
    }
    out = channels(rgb, integrator, camera(rgb, (0, 0, 1), (0, 0, 9), fov=0.5, size=4, near_clip=1e-4))
    np.testing.assert_allclose(out["position.Z"], 1 + median(1, 1), rtol=5e-4)
    np.testing.assert_allclose(out["observer_depth.T"], median(-5, 1), rtol=5e-4)
