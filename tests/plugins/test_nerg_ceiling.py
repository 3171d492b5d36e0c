"""A roof that cameras above it look through."""

import drjit as dr
import numpy as np
import pytest

from .scenes import camera, channels, constant, observer_at
from .test_nerg_shapes import center_only, rays, sphere, square

SIGMA, HEIGHT = 3.0, 0.6
ABOVE = {"origin": (0.4, 3.0, 0.5), "target": (0.5, 0.0, 0.5)}


def above(mi):
    """A camera over the unit cube, y up."""
    sensor = camera(mi, **ABOVE)
    sensor["to_world"] = mi.ScalarTransform4f().look_at(list(ABOVE["origin"]), list(ABOVE["target"]), [0, 0, 1])
    return center_only(mi, {**sensor, "fov": 12})


def cut(**more):
    return constant(SIGMA, ceiling=HEIGHT, up=[0.0, 2.0, 0.0], aovs="depth,opacity,position", **more)


def test01_matter_above_is_left_out_and_depths_count_from_the_camera(rgb):
    out = channels(rgb, cut(depth="median", step=1e-3), above(rgb))
    o, d = rays(rgb, above(rgb))
    t0, t1 = ((o[:, 1] - y) / -d[:, 1] for y in (HEIGHT, 0.0))
    opacity = (1 - np.exp(-SIGMA * (t1 - t0))).reshape(12, 12)
    # Where half of what is absorbed below the plane is.
    depth = t0.reshape(12, 12) - np.log1p(-opacity / 2) / SIGMA
    assert np.allclose(out["opacity.Y"], opacity, atol=1e-4) and np.allclose(out["depth.T"], depth, atol=1e-4)
    position = o + d * depth.reshape(-1, 1)
    found = np.stack([out[f"position.{c}"] for c in "XYZ"], axis=-1).reshape(-1, 3)
    assert np.allclose(found, position, atol=2e-4)


def test02_who_stands_below_sees_all(rgb):
    sensor = camera(rgb, origin=(0.5, 0.3, -3), target=(0.5, 0.8, 0.5))
    whole = channels(rgb, constant(SIGMA, aovs="depth,opacity"), sensor)
    same = channels(rgb, constant(SIGMA, aovs="depth,opacity", ceiling=HEIGHT, up=[0.0, 1.0, 0.0]), sensor)
    assert all(np.array_equal(whole[k], same[k]) for k in whole) and whole["opacity.Y"].max() > 0.5


def test03_shapes_above_hide_nothing_from_the_camera_but_all_from_the_observer(rgb):
    sensor = camera(rgb, origin=(0.1, 0, -3), target=(0, 0, 0))
    lid, floor = sphere(rgb, 0, 0, -1, radius=0.4), square(rgb, 1.0, size=5.0)
    given = {"type": "nerg", "aovs": "depth,visibility", "observer": observer_at(rgb, 0, 0, -3), "up": [0.0, 0.0, -1.0]}
    middle = lambda out, name: out[name][6, 6]
    whole = channels(rgb, given, sensor, lid=lid, floor=floor)
    out = channels(rgb, {**given, "ceiling": 0.5}, sensor, lid=lid, floor=floor)
    assert middle(whole, "depth.T") < 2 and middle(whole, "visibility.Y") == 1
    assert middle(out, "depth.T") == pytest.approx(4, abs=0.02) and middle(out, "visibility.Y") == 0


def test04_depths_have_the_derivatives_of_the_cameras_ray(rgb):
    sensor = above(rgb)
    scene = rgb.load_dict({"type": "scene", "sensor": sensor, "integrator": cut(step=1e-3)})
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("sensor.to_world"))
    # Straight up by h, all depths grow as those to any fixed plane do.
    h = rgb.Float(0)
    dr.enable_grad(h)
    params[key] = rgb.Transform4f().translate(rgb.Vector3f(0, h, 0)) @ rgb.Transform4f(sensor["to_world"])
    params.update()
    depth = rgb.render(scene, params, spp=1)[:, :, 3]
    dr.forward(h)
    o, d = rays(rgb, sensor)
    # Matter begins at the plane, so that its expected depth moves by the ray's length a unit of height.
    assert np.allclose(np.ravel(dr.grad(depth)), 1 / -d[:, 1], rtol=1e-3)


@pytest.mark.parametrize(
    "given, why",
    [
        ({"ceiling": "high"}, "ceiling"),
        ({"up": [0.0, 0.0, 0.0], "ceiling": 1.0}, "up"),
        ({"up": 1.0}, '"up" must be three'),
    ],
)
def test05_what_is_no_plane_is_refused(rgb, given, why):
    with pytest.raises(RuntimeError, match=why):
        rgb.load_dict({"type": "nerg", **given})
