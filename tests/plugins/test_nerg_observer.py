"""Observers: where they are, what is hidden from them, and how that is decided."""

import numpy as np
import pytest

from .scenes import GAZE, camera, channels, hidden_scene, look_at, named, observer_at, render, with_gaze


@pytest.mark.parametrize("near_clip", [0.01, 1.0])
def test01_an_observer_at_the_camera_is_none(rgb, files, near_clip):
    sensor = camera(rgb, near_clip=near_clip)
    a = render(rgb, with_gaze(files, GAZE), sensor, spp=2)
    b = render(rgb, with_gaze(files, GAZE, observer=observer_at(rgb, 0.5, 0.4, -3, near_clip=0.5)), sensor, spp=2)
    assert np.array_equal(a, b)
    out = named(rgb, a, with_gaze(files, GAZE))
    assert set(np.unique(out["visibility.Y"])) <= {0, 0.5, 1} and out["gaze.Y"].max() > 0


def test02_near_clip_does_not_move_the_observer(rgb, files):
    near, far = (channels(rgb, with_gaze(files, GAZE), camera(rgb, near_clip=n)) for n in (0.01, 1.0))
    seen = near["gaze.Y"] > 0
    assert seen.any() and np.allclose(near["position.X"], far["position.X"], atol=2e-2)
    # Depth is measured from the near plane, gaze and observer depth from the centre.
    assert (near["depth.T"][seen] - far["depth.T"][seen] > 0.9).all()
    assert np.allclose(near["observer_depth.T"][seen], far["observer_depth.T"][seen], rtol=2e-2)


def test03_cameras_without_a_centre_need_an_observer(rgb, files):
    sensor = {**camera(rgb, kind="orthographic"), "near_clip": 0.1}
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files, "gaze"), "sensor": sensor})
    with pytest.raises(ValueError, match="no centre to look from.*observer"):
        scene.integrator().render(scene, scene.sensors()[0])
    out = channels(rgb, with_gaze(files, "gaze", observer=observer_at(rgb, 1, 0, -3)), sensor)
    assert out["gaze.Y"].any()
    assert render(rgb, with_gaze(files, "depth"), sensor).shape[-1] == 4


@pytest.mark.parametrize("depth", ["expected", "median"])
def test04_behind_an_opaque_wall(rgb, depth):
    out = hidden_scene(rgb, depth=depth, falloff=0.0)
    x, z = out["position.X"], out["position.Z"]
    assert np.allclose(z, 0.8, atol=0.02)
    # The observer's line to (x, y, 0.8) passes z = -0.05 .. 0.05 at x (0.85 .. 0.95) / 1.7.
    hidden, visible = x * 0.95 / 1.7 < 0.3 - 0.06, x * 0.85 / 1.7 > 0.3 + 0.06
    assert hidden.sum() > 20 and visible.sum() > 5
    assert not out["visibility.Y"][hidden].any() and (out["visibility.Y"][visible] == 1).all()
    ray = np.sqrt(x**2 + out["position.Y"] ** 2 + 1.7**2)
    assert np.allclose(out["observer_depth.T"][visible], ray[visible], atol=0.03)
    assert np.allclose(out["observer_depth.T"][hidden], (ray * 0.85 / 1.7)[hidden], atol=0.03)


def test05_falloff_is_a_ramp(rgb):
    # Hidden surfaces lie 1.7 / 0.85 times as far as what the observer meets.
    out = hidden_scene(rgb, falloff=2.0, tolerance=0.05)
    x = out["position.X"]
    hidden = x * 0.95 / 1.7 < 0.3 - 0.06
    ray = np.sqrt(x**2 + out["position.Y"] ** 2 + 1.7**2)
    expected = 1 - np.clip((ray - out["observer_depth.T"] - 0.05) / 2, 0, 1)
    # The point looked for lies the tolerance and a little more in front of the surface.
    assert np.allclose(out["visibility.Y"][hidden], expected[hidden], atol=0.04)
    assert 0.3 < expected[hidden].min() and expected[hidden].max() < 0.8


def test06_without_occlusion_all_is_visible(rgb):
    out = hidden_scene(rgb, occlusion=False)
    assert (out["visibility.Y"] == 1).all()
    ray = np.sqrt(out["position.X"] ** 2 + out["position.Y"] ** 2 + (out["position.Z"] + 0.9) ** 2)
    assert np.allclose(out["observer_depth.T"], ray, rtol=1e-5)


def test07_no_shadow_acne_on_what_the_observer_sees(rgb):
    # Observer and camera on the same side of one flat wall, near each other and far apart.
    data = np.zeros((40, 2, 2), np.float32)
    data[30:] = 1e4
    density = {
        "type": "gridvolume",
        "grid": rgb.VolumeGrid(data),
        "filter_type": "nearest",
        "to_world": rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
    }
    for x in (0.01, 0.3, 0.9):
        integrator = {
            "type": "nerg",
            "density": density,
            "aovs": "visibility",
            "falloff": 0.0,
            "observer": observer_at(rgb, x, 0.1, -0.9),
        }
        out = channels(rgb, integrator, camera(rgb, (0, 0, -0.95), (0, 0, 1), fov=60, near_clip=1e-3))
        assert (out["visibility.Y"] == 1).all()


@pytest.mark.parametrize("origin", [(0.5, 0.4, -3), (0, 0, 0), (0.1, 0.2, 5), (1e4, 0, 0)])
def test08_observers_anywhere_give_finite_pictures(rgb, files, origin):
    for falloff in (0.0, 1e-30, 0.3, 1e30):
        out = render(rgb, with_gaze(files, GAZE, observer=observer_at(rgb, *origin), falloff=falloff))
        assert np.all(np.isfinite(out))


@pytest.mark.parametrize("visibility", ["depth", "map", "transmittance"])
def test09_kinds_of_visibility_agree_on_opaque_walls(rgb, visibility):
    out = hidden_scene(rgb, visibility=visibility, falloff=0.0, map_height=256)
    x = out["position.X"]
    hidden, visible = x * 0.95 / 1.7 < 0.3 - 0.08, x * 0.85 / 1.7 > 0.3 + 0.08
    assert hidden.sum() > 20 and visible.sum() > 5
    assert np.allclose(out["visibility.Y"][hidden], 0, atol=1e-6) and np.allclose(
        out["visibility.Y"][visible], 1, atol=1e-6
    )


def test10_coarse_steps_in_front_of_matter_change_nothing_behind(rgb):
    a, b = (
        hidden_scene(rgb, coarse=c, falloff=0.0, aovs="depth,opacity,visibility,position,observer_depth")
        for c in (1.0, 4.0)
    )
    # Steps end elsewhere: a pixel at the shadow's edge may change sides.
    assert np.mean(a["visibility.Y"] != b["visibility.Y"]) < 0.06
    same = a["visibility.Y"] == b["visibility.Y"]
    for c in ("depth.T", "opacity.Y", "observer_depth.T"):
        assert np.allclose(a[c][same], b[c][same], rtol=1e-2, atol=5e-3), c


@pytest.mark.parametrize("sigma", [1e4, 50.0])
@pytest.mark.parametrize("kind", ["depth", "map", "transmittance"])
@pytest.mark.parametrize("angle", [0, 70, 85, 89])
def test30_no_wall_hides_itself_from_an_oblique_observer(rgb, kind, sigma, angle):
    # σ = 50: the observer's light goes two steps deep, and by 1/cos less so in depth.
    to_world = rgb.ScalarTransform4f().translate([-10, -10, 2]).scale([20, 20, 0.5])
    eye = [2 * np.sin(np.deg2rad(angle)), 0.0, 2 - 2 * np.cos(np.deg2rad(angle))]
    integrator = {
        "type": "nerg",
        "density": {"type": "constvolume", "value": sigma, "to_world": to_world},
        "step": 0.01,
        "aovs": "visibility",
        "visibility": kind,
        "falloff": 0.0,
        "radiance": False,
        "map_height": 256,
        "observer": {"type": "perspective", "to_world": look_at(rgb, eye, (0, 0, 2))},
    }
    out = channels(rgb, integrator, camera(rgb, (0, 0.1, 0), (0, 0, 2), fov=20, size=12))
    assert out["visibility.Y"].min() > 0.999


@pytest.mark.parametrize("kind", ["depth", "map"])
def test31_an_observer_who_meets_nothing_is_not_blocked_by_it(rgb, kind):
    """Also where any opacity counts as a surface: rays that pass a ball by a hair find the point in front of it in the
    open."""
    integrator = {
        "type": "nerg",
        "aovs": "visibility,observer_depth,position",
        "surface_opacity": 0.0,
        "visibility": kind,
        "observer": observer_at(rgb, -2, 0.5, -2.5),
    }
    out = channels(rgb, integrator, camera(rgb, (0.3, 0.2, -3), fov=12), ball={"type": "sphere", "radius": 0.8})
    p = np.stack([out[f"position.{c}"] for c in "XYZ"], -1)
    faces = (p * ((-2, 0.5, -2.5) - p)).sum(-1) > 0
    assert faces.all() and (out["visibility.Y"] > 0.999).all() and (out["observer_depth.T"] > 2).all()
