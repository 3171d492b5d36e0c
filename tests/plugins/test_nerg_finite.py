"""No derivative is NaN: where there is nothing and where all is solid, without a fall-off, with observers on what they
look at."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.ranges import VALUES

from .scenes import GAZE, camera, constant, observer_at

# In front of the fog, on it, in it, on the ball, and at the camera.
EYES = ((-2.0, 0.3, -2.0), (0.0, 0.0, -1.0), (0.1, 0.2, 0.3), (0.0, 0.9, -0.3), (0.5, 0.4, -3.0))


@pytest.mark.nightly
@pytest.mark.parametrize(
    "visibility, depth, eyes", [("depth", "median", EYES), ("transmittance", "expected", EYES[2::2])]
)
def test01_extremes(rgb, files, visibility, depth, eyes):
    """Of all AOVs, summed, with respect to density, falloff, gaze weights, and where observer, camera and a shape
    are."""
    place = rgb.ScalarTransform4f().translate(-1).scale(2)
    integrator = {
        "type": "nerg",
        "density": {"type": "constvolume", "value": 1.0, "to_world": place},
        "aovs": GAZE,
        "step": 0.2,
        "gaze": {"type": "gazefield", "filename": str(files / "gaze.safetensors")},
        "visibility": visibility,
        "depth": depth,
        "observer": observer_at(rgb, *EYES[0]),
        "surface_opacity": 0.0,
        "falloff": 1.0,
    }
    ball = {"type": "sphere", "center": [0, 0.9, 0], "radius": 0.3}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb, size=4), "ball": ball})
    params = rgb.traverse(scene)
    poses, others = (
        ["sensor.to_world", "ball.to_world"],
        ["integrator.gaze.grid.table", "integrator.gaze.capture_head.0"],
    )
    start = {key: rgb.Transform4f(params[key]) for key in poses}
    weights = {key: type(params[key])(params[key]) for key in others}
    for sigma in (0.0, 1e-30, 1e9):
        for eye in eyes:
            x = rgb.Float(0)
            dr.enable_grad(x)
            params["integrator.density.value.value"] = rgb.Float(sigma) + x
            params["integrator.falloff"] = x
            params["integrator.observer.to_world"] = rgb.Transform4f().translate(rgb.Vector3f(*eye) + x)
            for key in poses:
                params[key] = rgb.Transform4f().translate(rgb.Vector3f(x, 0.5 * x, -x)) @ start[key]
            for key in others:
                params[key] = weights[key] + x
            params.update()
            picture = rgb.render(scene, params, spp=1)
            assert np.isfinite(picture.numpy()).all(), (sigma, eye)
            dr.backward(dr.sum(picture, axis=None))
            assert np.isfinite(dr.grad(x).numpy().item()), (sigma, eye)


@pytest.mark.parametrize("visibility", ["depth", "map", "transmittance"])
@pytest.mark.parametrize("setting", [{"tolerance": 1e20}, {"tolerance": VALUES.high}])
def test_observer_depth_is_finite_whatever_the_tolerance(rgb, setting, visibility):
    aovs = "observer_depth,visibility,position"
    integrator = constant(
        1.0, aovs=aovs, visibility=visibility, map_height=16, observer=observer_at(rgb, -3, 0.5, 0.5), **setting
    )
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb, size=6)})
    picture = np.array(rgb.render(scene, spp=1, seed=0))
    assert picture[..., 3].max() > 1e17 and np.all(np.isfinite(picture))
