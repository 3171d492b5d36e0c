"""Observers and shapes: occlusion, how it is decided, and images of a field with shapes."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.evaluation.study import count_traced_operations
from nerg_mi.transport.mitsuba_mesh import pack_positions, positions_key, unpack_positions

from .scenes import (
    GAZE,
    attach,
    camera,
    channels,
    constant,
    hidden_scene,
    look_at,
    make_observer,
    named,
    observed,
    picture,
    plugin,
    points,
    put,
    render,
    scene_with,
    sphere,
    square,
    still,
    stored,
    straight,
    with_gaze,
)

# ---- Occlusion from observers ----


@pytest.mark.parametrize("near_clip", [0.01, 1.0])
def test01_observer_at_the_camera_changes_nothing(rgb, files, near_clip):
    sensor = camera(rgb, near_clip=near_clip)
    a = render(rgb, with_gaze(files, GAZE), sensor, spp=2)
    b = render(rgb, with_gaze(files, GAZE, observer=make_observer(rgb, 0.5, 0.4, -3, near_clip=0.5)), sensor, spp=2)
    assert np.array_equal(a, b)
    out = named(rgb, a, with_gaze(files, GAZE))
    assert set(np.unique(out["visibility.Y"])) <= {0, 0.5, 1} and out["gaze.Y"].max() > 0


def test03_cameras_without_a_center_need_an_observer(rgb, files):
    sensor = {**camera(rgb, kind="orthographic"), "near_clip": 0.1}
    scene = scene_with(rgb, with_gaze(files, "gaze"), sensor)
    with pytest.raises(ValueError, match="no centre; give.*observer"):
        scene.integrator().render(scene, scene.sensors()[0])
    out = channels(rgb, with_gaze(files, "gaze", observer=make_observer(rgb, 1, 0, -3)), sensor)
    assert out["gaze.Y"].any()
    assert render(rgb, with_gaze(files, "depth"), sensor).shape[-1] == 4


def sides(out, margin=0.06):
    """Points of the back wall that the wall with the gap hides from the observer, and points that it certainly does not
    hide."""
    # The observer's line to (x, y, 0.8) passes z = -0.05 .. 0.05 at x (0.85 .. 0.95) / 1.7.
    x = out["position.X"]
    hidden, visible = x * 0.95 / 1.7 < 0.3 - margin, x * 0.85 / 1.7 > 0.3 + margin
    assert hidden.sum() > 20 and visible.sum() > 5
    return hidden, visible, np.linalg.norm(points(out) - (0, 0, -0.9), axis=-1)


@pytest.mark.parametrize(
    "kind, depth", [("depth", "expected"), ("depth", "median"), ("map", "median"), ("transmittance", "median")]
)
def test04_behind_an_opaque_wall(rgb, kind, depth):
    out = hidden_scene(rgb, depth=depth, visibility=kind, falloff=0.0, map_height=256)
    assert np.allclose(out["position.Z"], 0.8, atol=0.02)
    hidden, visible, ray = sides(out, 0.06 if kind == "depth" else 0.08)
    assert np.allclose(out["visibility.Y"][hidden], 0, atol=1e-6)
    assert np.allclose(out["visibility.Y"][visible], 1, atol=1e-6)
    if kind == "depth":
        assert np.allclose(out["observer_depth.T"][visible], ray[visible], atol=0.03)
        assert np.allclose(out["observer_depth.T"][hidden], (ray * 0.85 / 1.7)[hidden], atol=0.03)


def test05_falloff_is_a_ramp(rgb):
    # Hidden surfaces are 1.7 / 0.85 times as far as the occluder.
    out = hidden_scene(rgb, falloff=2.0, tolerance=0.05)
    hidden, _, ray = sides(out)
    expected = 1 - np.clip((ray - out["observer_depth.T"] - 0.05) / 2, 0, 1)
    # The target lies in front of the surface by slightly more than the tolerance.
    assert np.allclose(out["visibility.Y"][hidden], expected[hidden], atol=0.04)
    assert 0.3 < expected[hidden].min() and expected[hidden].max() < 0.8


def test06_everything_is_visible_without_occlusion(rgb):
    out = hidden_scene(rgb, occlusion=False)
    assert (out["visibility.Y"] == 1).all()
    assert np.allclose(out["observer_depth.T"], sides(out)[2], rtol=1e-5)


def test10_coarse_prepass_changes_nothing(rgb):
    aovs = "depth,opacity,visibility,position,observer_depth"
    a, b = (hidden_scene(rgb, coarse=c, falloff=0.0, aovs=aovs) for c in (1.0, 4.0))
    # Steps end elsewhere: a pixel at the shadow's edge can change.
    same = a["visibility.Y"] == b["visibility.Y"]
    assert np.mean(~same) < 0.06
    for c in ("depth.T", "opacity.Y", "observer_depth.T"):
        assert np.allclose(a[c][same], b[c][same], rtol=1e-2, atol=5e-3), c


# σ = 50: the observer's light penetrates by two steps, and by a factor of 1/cos less in depth. None: a shape.
@pytest.mark.parametrize("sigma", [1e4, 50.0, None])
@pytest.mark.parametrize("kind", ["depth", "map", "transmittance"])
@pytest.mark.parametrize("angle", [0, 70, 85, 89])
def test30_no_self_occlusion_at_grazing_angles(rgb, kind, sigma, angle):
    eye = [2 * np.sin(np.deg2rad(angle)), 0.0, 2 - 2 * np.cos(np.deg2rad(angle))]
    observer = {"type": "perspective", "to_world": look_at(rgb, eye, (0, 0, 2))}
    how = {"aovs": "visibility", "visibility": kind, "falloff": 0.0, "radiance": False, "map_height": 256}
    shapes = {"wall": square(rgb, 2.0, 10.0)} if sigma is None else {}
    if sigma is not None:
        to_world = rgb.ScalarTransform4f().translate([-10, -10, 2]).scale([20, 20, 0.5])
        how |= {"density": {"type": "constvolume", "value": sigma, "to_world": to_world}, "step": 0.01}
    out = channels(rgb, plugin("nerg", observer=observer, **how), camera(rgb, (0, 0.1, 0), (0, 0, 2), fov=20), **shapes)
    assert out["visibility.Y"].min() > 0.999


@pytest.mark.parametrize("kind", ["depth", "map"])
def test31_observer_ray_without_surface_is_visible(rgb, kind):
    """Also if any opacity counts as a surface: the target of rays just past a sphere is in the open."""
    eye = (-2, 0.5, -2.5)
    how = {"aovs": "visibility,observer_depth,position", "surface_opacity": 0.0, "visibility": kind}
    integrator = plugin("nerg", observer=make_observer(rgb, *eye), **how)
    out = channels(rgb, integrator, camera(rgb, (0.3, 0.2, -3), fov=12), ball={"type": "sphere", "radius": 0.8})
    p = points(out)
    assert ((p * (eye - p)).sum(-1) > 0).all()
    assert (out["visibility.Y"] > 0.999).all() and (out["observer_depth.T"] > 2).all()


@pytest.mark.parametrize("kind", ["depth", "transmittance", "map"])
@pytest.mark.parametrize("veiled", [False, True])
def test06_shapes_occlude_the_observer(rgb, kind, veiled):
    """A square at z = 0 between an observer in front and a wall at z = 1, seen from the side; also through a haze that
    is too thin to hide anything."""
    how = {"aovs": "position,visibility,observer_depth", "visibility": kind, "falloff": 0.0}
    if veiled:
        box = rgb.ScalarTransform4f().translate([-4, -4, -0.9]).scale([8, 8, 0.5])
        how["density"] = {"type": "constvolume", "value": 1e-4, "to_world": box}
    integrator = plugin("nerg", observer=make_observer(rgb, 0, 0, -1), **how)
    shapes = {"wall": square(rgb, 1.0, 3.0), "lid": square(rgb, 0.0, 0.5)}
    out = channels(rgb, integrator, camera(rgb, (3.0, 0, -1), (0, 0, 1), fov=40, size=24), **shapes)
    on_wall = np.abs(out["position.Z"] - 1) < 1e-3
    # Its shadow is twice its size. A map resolves edges to about a row.
    scale = np.maximum(np.abs(out["position.X"]), np.abs(out["position.Y"]))
    hidden, seen = on_wall & (scale < 0.95), on_wall & (scale > 1.05)
    assert hidden.sum() > 10 and seen.sum() > 50
    assert (out["visibility.Y"][hidden] < 1e-3).all()
    assert (out["visibility.Y"][seen] > (0.95 if kind == "map" else 0.999)).all()
    if kind == "depth":
        distance = np.linalg.norm(points(out) - (0, 0, -1), axis=-1)
        assert np.allclose(out["observer_depth.T"][hidden], distance[hidden] / 2, atol=1e-2)


# ---- Shapes, alone and with a field: exact depths, compositing, and gaze on surfaces ----


def gaze_only(files, aovs, **kwargs):
    return plugin("nerg", gaze=stored("gazefield", files / "gaze.safetensors"), aovs=aovs, falloff=0.0, **kwargs)


@pytest.mark.parametrize("sigma", [0.3, 3.0])
def test04_field_attenuates_a_shape_behind_it(rgb, sigma):
    """Closed forms: unit cube of constant density with a wall through its middle."""
    blue, red = ({"type": "rgb", "value": value} for value in ([0, 0, 1], [1, 0, 0]))
    integrator = constant(sigma, aovs="depth,opacity", color={"type": "constvolume", "value": blue})
    bsdf = {"type": "twosided", "b": {"type": "diffuse", "reflectance": red}}
    T, near = np.exp(-sigma * 0.5), 2 - 0.01
    first = near * (1 - T) + (1 - T) / sigma - 0.5 * T
    median = near + np.log(2) / sigma if T < 0.5 else near + 0.5
    for kind, depth in (("expected", first + T * (near + 0.5)), ("median", median), ("refined", median)):
        wall = square(rgb, 0.5, 2.0) | {"bsdf": bsdf}
        image = render(rgb, {**integrator, "depth": kind}, straight(rgb, "perspective"), w=wall)
        assert image[0, 0] == pytest.approx([T, 0, 1 - T, depth, 1], rel=1e-5, abs=1e-5)


def test05_shapes_and_field_occlude_each_other(rgb):
    field = constant(1e6, aovs="depth,opacity,density_evals")
    front, behind = (channels(rgb, field, straight(rgb, "perspective"), w=square(rgb, z, 2.0)) for z in (-0.5, 1.5))
    assert front["depth.T"][0, 0] == pytest.approx(1.49) and front["density_evals.Y"][0, 0] == 0
    assert behind["depth.T"][0, 0] == pytest.approx(1.99, abs=1e-4)


def test08_gaze_on_a_shape_is_equation_1(rgb, files):
    eye = (-2, 0.3, -2)
    integrator = gaze_only(files, "gaze,emit,capture,visibility,position", observer=make_observer(rgb, *eye))
    out = channels(rgb, integrator, s=sphere(rgb, 0, 0, 0))
    seen = out["visibility.Y"] == 1
    p, p_o = rgb.Point3f(np.ascontiguousarray(points(out)[seen].T)), rgb.Point3f(*eye)
    expected = observed(rgb, integrator["gaze"], p_o).evaluate(p, p_o, dr.normalize(p - p_o), True)
    assert seen.sum() > 10
    for name, value in zip(("gaze.Y", "emit.Y", "capture.Y"), expected):
        assert np.allclose(out[name][seen], np.array(value), rtol=2e-4)


def test09_no_march_without_volume_and_no_cast_without_shapes(rgb):
    def operations(integrator, **overrides):
        scene = scene_with(rgb, integrator, **overrides)
        rgb.render(scene, spp=1)
        return count_traced_operations(lambda: rgb.render(scene, spp=1))

    shape = {"s": sphere(rgb, 0, 0, 0)}
    shapes = operations({"type": "nerg"}, **shape)
    field, both = operations(constant()), operations(constant(), **shape)
    out = channels(rgb, {"type": "nerg", "aovs": "depth,density_evals,color_evals"}, **shape)
    assert not out["density_evals.Y"].any() and not out["color_evals.Y"].any()
    # The cost is the sum of both, except for the pixel filter and the camera.
    assert shapes < field < both and both < field + shapes


def test11_map_stores_gaze(rgb, files):
    """Interpolated gaze equals that of the network up to interpolation, without evaluations; weights are still
    differentiable."""
    network, table = (
        gaze_only(files, "gaze,visibility,gaze_evals", visibility=kind, observer=make_observer(rgb, -2, 0.3, -2))
        for kind in ("depth", "map")
    )
    scene = scene_with(rgb, table, s=sphere(rgb, 0, 0, 0))
    before = picture(rgb, scene)
    exact, selected = channels(rgb, network, s=sphere(rgb, 0, 0, 0)), named(rgb, before, table)
    assert exact["gaze_evals.Y"].max() == 2 and selected["gaze_evals.Y"].max() == 2
    # Where entries are past the sphere, the network is evaluated.
    assert 0 < selected["gaze_evals.Y"].sum() < 0.3 * exact["gaze_evals.Y"].sum()
    both = (exact["visibility.Y"] == 1) & (selected["visibility.Y"] > 0.999)
    assert both.sum() > 10
    assert np.allclose(selected["gaze.Y"][both], exact["gaze.Y"][both], rtol=0.02, atol=1e-5)

    params, key = rgb.traverse(scene), "integrator.gaze.emit_head.0"
    attach(params, key)
    dr.backward(dr.sum(rgb.render(scene, params, spp=1)[..., 3], axis=None))
    assert dr.any(params[key].grad != 0, axis=None)
    # New weights take effect.
    put(params, key, dr.detach(params[key]) * 200)
    assert np.abs(picture(rgb, scene)[..., 3] - before[..., 3]).max() > 0.1


@pytest.mark.parametrize("veiled", [False, True])
@pytest.mark.parametrize("depth", ["expected", "median"])
def test12_depth_follows_a_moving_shape(rgb, depth, veiled):
    """Derivative of depth with respect to a mesh's position, against central differences; also through a haze."""
    mesh = rgb.load_dict({"type": "cube", "to_world": rgb.ScalarTransform4f().rotate([0.3, 1, 0.2], 30).scale(0.4)})
    how = {"aovs": "depth", "depth": depth}
    integrator = constant(0.2, **how) if veiled else plugin("nerg", **how)
    scene = scene_with(rgb, integrator, still(camera(rgb, size=6, fov=8)), cube=mesh)
    params, key = rgb.traverse(scene), f"cube.{positions_key()}"
    start = rgb.Point3f(unpack_positions(params[key]))

    def image(z):
        put(params, key, pack_positions(start + rgb.Vector3f(0, 0, z)))
        return rgb.render(scene, params, spp=1)[..., 3]

    z, h = rgb.Float(0), 1e-2
    dr.enable_grad(z)
    value = image(z)
    dr.forward(z)
    forward = np.array(dr.grad(value))
    z = rgb.Float(0)
    dr.enable_grad(z)
    dr.backward(dr.sum(image(z), axis=None))
    differences = (np.array(image(rgb.Float(h)), float) - np.array(image(rgb.Float(-h)), float)) / (2 * h)
    assert np.abs(differences).max() > 0.2
    assert np.allclose(forward, differences, rtol=0.03, atol=3e-3)
    assert float(dr.grad(z)[0]) == pytest.approx(differences.sum(), rel=0.02)


def test14_gaze_on_a_shape_inside_a_field(rgb, files):
    """A sphere inside a trained field hides what is behind it and has gaze itself."""
    aovs, center = "depth,opacity,gaze,visibility,position", (0.5, 0.4, -1.6)
    integrator = with_gaze(files, aovs, falloff=0.0, observer=make_observer(rgb, -2, 0.3, -2))
    bare, ball = channels(rgb, integrator), channels(rgb, integrator, s=sphere(rgb, *center, radius=0.2))
    on_ball = np.abs(np.linalg.norm(points(ball) - center, axis=-1) - 0.2) < 1e-3
    assert on_ball.sum() > 5 and (ball["opacity.Y"][on_ball] == 1).all()
    assert (ball["depth.T"][on_ball] < 1.5).all()
    untouched = ~on_ball & (ball["visibility.Y"] == bare["visibility.Y"])
    assert np.allclose(ball["depth.T"][~on_ball], bare["depth.T"][~on_ball], atol=1e-5) and untouched.any()
    assert (ball["gaze.Y"][on_ball & (ball["visibility.Y"] > 0)] > 0).all()
