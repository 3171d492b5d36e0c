"""Shapes, alone and together with a field: exact depths, compositing, shadowing, gaze on surfaces, and their light."""

import numpy as np
import pytest

from nerg_mi.evaluation.study import traced_operations

from .scenes import camera, channels, constant, named, observed, observer_at, render, with_gaze

EVERYTHING = "depth,opacity,position,visibility,observer_depth"


def sphere(mi, *center, radius=0.5, color=(0.2, 0.5, 0.8)):
    return {
        "type": "sphere",
        "center": list(center),
        "radius": radius,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}},
    }


def square(mi, z, size=1.0, x=0.0):
    to_world = mi.ScalarTransform4f().translate([x, 0, z]).scale([size, size, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}


def gaze_only(files, aovs, **kwargs):
    return {
        "type": "nerg",
        "gaze": {"type": "gazefield", "filename": str(files / "gaze.safetensors")},
        "aovs": aovs,
        **kwargs,
    }


def rays(mi, sensor):
    """Origins and directions, float64 (N, 3), through the pixels' centres of ``sensor``."""
    s = mi.load_dict(sensor)
    w, h = s.film().crop_size()
    y, x = np.mgrid[:h, :w].reshape(2, -1) + 0.5
    ray, _ = s.sample_ray(0, 0.5, mi.Point2f(x / w, y / h), 0.5)
    return np.array(ray.o, float).T, np.array(ray.d, float).T


def center_only(mi, sensor):
    # One sample at the centre of every pixel.
    return {**sensor, "sampler": {"type": "stratified", "sample_count": 1, "jitter": False}}


@pytest.mark.parametrize("depth", ["expected", "median", "refined"])
def test01_a_sphere_alone_is_met_where_geometry_says(rgb, depth):
    sensor = center_only(rgb, camera(rgb))
    integrator = {"type": "nerg", "aovs": EVERYTHING, "depth": depth}
    out = channels(rgb, integrator, sensor, s=sphere(rgb, 0, 0, 0))
    o, d = rays(rgb, sensor)
    b = (o * d).sum(-1)
    root = b * b - (o * o).sum(-1) + 0.25
    expected = np.where(root > 0, -b - np.sqrt(np.maximum(root, 0)), 0).reshape(12, 12)
    assert np.allclose(out["depth.T"], expected, atol=2e-5) and (expected > 0).sum() > 20
    assert np.array_equal(out["opacity.Y"], (expected > 0).astype(float))
    p = np.stack([out[f"position.{c}"] for c in "XYZ"], -1)
    assert np.allclose(np.linalg.norm(p[expected > 0], axis=-1), 0.5, atol=1e-4)
    # The camera is the observer.
    assert np.array_equal(out["visibility.Y"], out["opacity.Y"])


def test02_albedo_without_emitters_and_paths_with_them(rgb):
    sensor = camera(rgb, fov=10)
    image = render(rgb, {"type": "nerg", "aovs": ""}, sensor, s=sphere(rgb, 0, 0, 0))
    assert np.allclose(image[..., :3], [0.2, 0.5, 0.8], atol=1e-5)
    # Under a constant sky a convex body shows albedo times radiance, by path tracing.
    lit = render(
        rgb,
        {"type": "nerg", "aovs": ""},
        sensor,
        spp=64,
        s=sphere(rgb, 0, 0, 0),
        e={"type": "constant", "radiance": 2.0},
    )
    assert np.allclose(lit[..., :3].mean((0, 1)), [0.4, 1.0, 1.6], rtol=0.02)
    dark = render(rgb, {"type": "nerg", "aovs": "", "radiance": False}, sensor, s=sphere(rgb, 0, 0, 0))
    assert not dark[..., :3].any()


def test03_the_nested_integrator_lights_shapes_and_its_aovs_follow(rgb):
    sensor, light = camera(rgb), {"type": "constant", "radiance": 1.0}
    nested = {"type": "aov", "aovs": "n:sh_normal,far:depth", "img": {"type": "direct"}}
    integrator = {"type": "nerg", "aovs": "opacity,depth", "nested": nested}
    names = rgb.load_dict(integrator).aov_names()
    assert names[:2] == ["opacity.Y", "depth.T"] and "n.X" in names and "far.T" in names
    out = channels(rgb, integrator, sensor, s=sphere(rgb, 0, 0, 0), e=light)
    hit = out["opacity.Y"] > 0
    assert np.allclose(out["far.T"][hit], out["depth.T"][hit], atol=1e-5)
    plain = render(rgb, {"type": "direct"}, sensor, spp=256, s=sphere(rgb, 0, 0, 0), e=light)
    ours = render(
        rgb, {"type": "nerg", "aovs": "", "i": {"type": "direct"}}, sensor, spp=256, s=sphere(rgb, 0, 0, 0), e=light
    )
    assert np.allclose(ours[..., :3], plain[..., :3], atol=0.1) and np.allclose(ours.mean(), plain.mean(), rtol=0.02)


@pytest.mark.parametrize("sigma", [0.3, 3.0])
def test04_the_field_in_front_attenuates_a_shape(rgb, sigma):
    """Closed forms: unit cube of constant density with a wall through its middle."""
    integrator = constant(
        sigma, aovs="depth,opacity", color={"type": "constvolume", "value": {"type": "rgb", "value": [0, 0, 1]}}
    )
    wall = {
        **square(rgb, 0.5, 2.0),
        "bsdf": {"type": "twosided", "b": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1, 0, 0]}}},
    }
    sensor = camera(rgb, (0.5, 0.5, -2), (0.5, 0.5, 0), fov=1e-3, size=1, near_clip=0.01)
    T = np.exp(-sigma * 0.5)
    near = 2 - 0.01
    first = near * (1 - T) + (1 - T) / sigma - 0.5 * T
    median = near + np.log(2) / sigma if T < 0.5 else near + 0.5
    for kind, depth in (("expected", first + T * (near + 0.5)), ("median", median), ("refined", median)):
        image = render(rgb, {**integrator, "depth": kind}, sensor, w=wall)
        out = named(rgb, image, integrator)
        assert out["opacity.Y"][0, 0] == 1
        assert out["depth.T"][0, 0] == pytest.approx(depth, rel=1e-5)
        assert image[0, 0, :3] == pytest.approx([T, 0, 1 - T], abs=1e-5)


def test05_a_shape_hides_the_field_and_the_field_a_shape(rgb):
    sensor = camera(rgb, (0.5, 0.5, -2), (0.5, 0.5, 0), fov=1e-3, size=1, near_clip=0.01)
    field = constant(1e6, aovs="depth,opacity,density_evals")
    front, behind = (channels(rgb, field, sensor, w=square(rgb, z, 2.0)) for z in (-0.5, 1.5))
    assert front["depth.T"][0, 0] == pytest.approx(1.49) and front["density_evals.Y"][0, 0] == 0
    assert behind["depth.T"][0, 0] == pytest.approx(1.99, abs=1e-4)


@pytest.mark.parametrize("kind", ["depth", "transmittance", "map"])
@pytest.mark.parametrize("with_field_too", [False, True])
def test06_shapes_hide_from_the_observer(rgb, kind, with_field_too):
    """A square at z = 0 between an observer in front and a wall at z = 1, seen from the side."""
    sensor = camera(rgb, (3.0, 0, -1), (0, 0, 1), fov=40, size=24)
    integrator = {
        "type": "nerg",
        "aovs": EVERYTHING,
        "visibility": kind,
        "falloff": 0.0,
        "observer": observer_at(rgb, 0, 0, -1),
    }
    if with_field_too:
        # A thin veil in front of it all: far too thin to hide anything.
        box = rgb.ScalarTransform4f().translate([-4, -4, -0.9]).scale([8, 8, 0.5])
        integrator |= {"density": {"type": "constvolume", "value": 1e-4, "to_world": box}}
    out = channels(rgb, integrator, sensor, wall=square(rgb, 1.0, 3.0), lid=square(rgb, 0.0, 0.5))
    on_wall = np.abs(out["position.Z"] - 1) < 1e-3
    # Its shadow is twice its size. A map knows edges to about a row.
    reach = np.maximum(np.abs(out["position.X"]), np.abs(out["position.Y"]))
    hidden, seen = on_wall & (reach < 0.95), on_wall & (reach > 1.05)
    assert hidden.sum() > 10 and seen.sum() > 50
    assert (out["visibility.Y"][hidden] < 1e-3).all() and (
        out["visibility.Y"][seen] > (0.95 if kind == "map" else 0.999)
    ).all()
    if kind == "depth":
        distance = np.sqrt(out["position.X"] ** 2 + out["position.Y"] ** 2 + 4)
        assert np.allclose(out["observer_depth.T"][hidden], distance[hidden] / 2, atol=1e-2)


@pytest.mark.parametrize("kind", ["depth", "transmittance", "map"])
def test07_no_shape_shadows_itself_at_grazing_angles(rgb, kind):
    for angle in (0, 60, 85, 89):
        a = np.radians(angle)
        observer = observer_at(rgb, float(2 * np.sin(a)), 0, float(1 - 2 * np.cos(a)))
        integrator = {
            "type": "nerg",
            "aovs": "visibility,position",
            "visibility": kind,
            "falloff": 0.0,
            "observer": observer,
        }
        out = channels(rgb, integrator, camera(rgb, (0, 0, -2), (0, 0, 1), fov=30), wall=square(rgb, 1.0, 3.0))
        assert (out["visibility.Y"] > 0.999).all(), angle


def test08_gaze_on_a_shape_is_equation_1(rgb, files):
    aovs = "gaze,emit,capture,visibility,position"
    sensor = camera(rgb)
    integrator = gaze_only(files, aovs, observer=observer_at(rgb, -2, 0.3, -2), falloff=0.0)
    out = channels(rgb, integrator, sensor, s=sphere(rgb, 0, 0, 0))
    seen = out["visibility.Y"] == 1
    p = rgb.Point3f(*[np.ascontiguousarray(out[f"position.{c}"][seen]) for c in "XYZ"])
    p_o = rgb.Point3f(-2, 0.3, -2)
    import drjit as dr

    gaze = observed(rgb, integrator["gaze"], p_o)
    expected = gaze.evaluate(p, p_o, dr.normalize(p - p_o), True)
    assert seen.sum() > 10
    for name, value in zip(("gaze.Y", "emit.Y", "capture.Y"), expected):
        assert np.allclose(out[name][seen], np.array(value), rtol=2e-4)


def test09_without_a_volume_no_march_without_shapes_no_cast(rgb):
    def operations(integrator, **more):
        scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb), **more})
        rgb.render(scene, spp=1)
        return traced_operations(lambda: rgb.render(scene, spp=1))

    shape = {"s": sphere(rgb, 0, 0, 0)}
    shapes = operations({"type": "nerg"}, **shape)
    field, both = operations(constant()), operations(constant(), **shape)
    out = channels(rgb, {"type": "nerg", "aovs": "depth,density_evals,color_evals"}, **shape)
    assert not out["density_evals.Y"].any() and not out["color_evals.Y"].any()
    # Both cost what each costs, but for the pixel filter and the camera.
    assert shapes < field < both and both < field + shapes


def test10_a_map_follows_shapes_that_move(rgb):

    integrator = {
        "type": "nerg",
        "aovs": "visibility",
        "visibility": "map",
        "falloff": 0.0,
        "observer": observer_at(rgb, 0, 0, -1),
    }
    sensor = camera(rgb, (3.0, 0, -1), (0, 0, 1), fov=40, size=24)
    scene = rgb.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": sensor,
            "wall": square(rgb, 1.0, 3.0),
            "lid": {"type": "disk", "to_world": rgb.ScalarTransform4f().scale(0.5)},
        }
    )
    look = lambda: np.array(rgb.render(scene, spp=1))[..., -1]
    first, again = look(), traced_operations(lambda: rgb.render(scene, spp=1))
    kept = scene.integrator().cache.peek("map")[0]
    assert np.array_equal(look(), first) and scene.integrator().cache.peek("map")[0] is kept
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("lid.to_world"))
    params[key] = rgb.Transform4f().translate([100, 0, 0])
    params.update()
    assert traced_operations(lambda: rgb.render(scene, spp=1)) > again
    assert (look() > 0.95).sum() > (first > 0.95).sum() + 100


def test11_a_map_keeps_gaze(rgb, files):
    """Looked up, gaze is that of the network but for interpolation, and costs no evaluation; weights are still
    differentiable."""
    import drjit as dr

    base = dict(observer=observer_at(rgb, -2, 0.3, -2), falloff=0.0)
    aovs = "gaze,visibility,gaze_evals"
    sensor = camera(rgb)
    exact = channels(rgb, gaze_only(files, aovs, **base), sensor, s=sphere(rgb, 0, 0, 0))
    kept = channels(rgb, gaze_only(files, aovs, visibility="map", **base), sensor, s=sphere(rgb, 0, 0, 0))
    assert exact["gaze_evals.Y"].max() == 2 and kept["gaze_evals.Y"].max() == 2
    # Where entries look past the ball, the network is asked.
    assert 0 < kept["gaze_evals.Y"].sum() < 0.3 * exact["gaze_evals.Y"].sum()
    both = (exact["visibility.Y"] == 1) & (kept["visibility.Y"] > 0.999)
    assert both.sum() > 10
    assert np.allclose(kept["gaze.Y"][both], exact["gaze.Y"][both], rtol=0.02, atol=1e-5)

    scene = rgb.load_dict(
        {
            "type": "scene",
            "integrator": gaze_only(files, aovs, visibility="map", **base),
            "sensor": sensor,
            "s": sphere(rgb, 0, 0, 0),
        }
    )
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("emit_head.0"))
    before = np.array(rgb.render(scene, spp=1))
    dr.enable_grad(params[key])
    params.update()
    image = rgb.render(scene, params, spp=1)
    dr.backward(dr.sum(image[..., 3], axis=None))
    assert dr.any(params[key].grad != 0, axis=None)
    # New weights are noticed.
    params[key] = dr.detach(params[key]) * 200
    params.update()
    after = np.array(rgb.render(scene, spp=1))
    assert np.abs(after[..., 3] - before[..., 3]).max() > 0.1


@pytest.mark.parametrize("depth", ["expected", "median"])
def test12_depth_follows_a_moving_shape(rgb, depth):
    """Derivative of depth with respect to a mesh's position, against central differences; also through a veil."""
    import drjit as dr

    mesh = rgb.load_dict({"type": "cube", "to_world": rgb.ScalarTransform4f().rotate([0.3, 1, 0.2], 30).scale(0.4)})
    sensor = center_only(rgb, camera(rgb, size=6, fov=8))
    for integrator in ({"type": "nerg", "aovs": "depth", "depth": depth}, constant(0.2, aovs="depth", depth=depth)):
        scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "cube": mesh})
        params = rgb.traverse(scene)
        key = "cube.vertex_positions"
        start = rgb.Point3f(dr.unravel(rgb.Point3f, rgb.Float(params[key])))

        def image(z, scene=scene, params=params, key=key, start=start):
            params[key] = dr.ravel(start + rgb.Vector3f(0, 0, z))
            params.update()
            return rgb.render(scene, params, spp=1)[..., 3]

        z = rgb.Float(0)
        dr.enable_grad(z)
        value = image(z)
        dr.forward(z)
        forward = np.array(dr.grad(value))
        z = rgb.Float(0)
        dr.enable_grad(z)
        dr.backward(dr.sum(image(z), axis=None))
        h = 1e-2
        differences = (np.array(image(rgb.Float(h)), float) - np.array(image(rgb.Float(-h)), float)) / (2 * h)
        params[key] = dr.ravel(start)
        params.update()
        assert np.abs(differences).max() > 0.2
        assert np.allclose(forward, differences, rtol=0.03, atol=3e-3)
        assert float(dr.grad(z)[0]) == pytest.approx(differences.sum(), rel=0.02)


def test13_nothing_met_is_the_background(rgb):
    image = render(rgb, {"type": "nerg", "background": 0.25, "aovs": "depth,opacity"}, s=sphere(rgb, 50, 0, 0))
    assert np.allclose(image[..., :3], 0.25) and not image[..., 3:].any()
    nested = render(
        rgb, {"type": "nerg", "background": 0.25, "aovs": "", "n": {"type": "path"}}, s=sphere(rgb, 50, 0, 0)
    )
    assert np.allclose(nested[..., :3], 0.25)


def test14_a_gaze_field_over_a_field_and_a_shape_in_it(rgb, files):
    """A ball put into a trained field hides what is behind it and carries gaze itself."""
    integrator = with_gaze(
        files, "depth,opacity,gaze,visibility,position", falloff=0.0, observer=observer_at(rgb, -2, 0.3, -2)
    )
    bare = channels(rgb, integrator)
    ball = channels(rgb, integrator, s=sphere(rgb, 0.5, 0.4, -1.6, radius=0.2))
    on_ball = (
        np.abs(
            np.sqrt((ball["position.X"] - 0.5) ** 2 + (ball["position.Y"] - 0.4) ** 2 + (ball["position.Z"] + 1.6) ** 2)
            - 0.2
        )
        < 1e-3
    )
    assert on_ball.sum() > 5 and (ball["opacity.Y"][on_ball] == 1).all()
    assert (ball["depth.T"][on_ball] < 1.5).all()
    untouched = ~on_ball & (ball["visibility.Y"] == bare["visibility.Y"])
    assert np.allclose(ball["depth.T"][~on_ball], bare["depth.T"][~on_ball], atol=1e-5) and untouched.any()
    assert (ball["gaze.Y"][on_ball & (ball["visibility.Y"] > 0)] > 0).all()
