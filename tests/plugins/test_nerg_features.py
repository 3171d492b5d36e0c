"""Geometry features as AOVs: accumulated along the ray, and at the surface."""

import numpy as np
import pytest

from .scenes import camera, channels, constant, render, with_field

STEP = 0.05


def block(out, name):
    keys = sorted((k for k in out if k.startswith(name + ".")), key=lambda k: int(k.split(".")[1]))
    return np.stack([out[k] for k in keys], -1)


def test01_accumulated_features_are_the_sum_of_weights_times_features(rgb, files):
    """Against a float64 sum over the same steps of the field's own densities and features."""
    integrator = with_field(files, aovs="features,opacity,depth", step=STEP, color_cutoff=0.0, stop=0.0)
    sensor = {**camera(rgb, size=4), "sampler": {"type": "stratified", "sample_count": 1, "jitter": False}}
    out = channels(rgb, integrator, sensor)
    features = block(out, "features").reshape(16, -1)
    medium = rgb.load_dict(integrator["field"]).medium()
    assert features.shape[-1] == medium.feature_count

    s = rgb.load_dict(sensor)
    y, x = np.mgrid[:4, :4].reshape(2, -1) + 0.5
    ray, _ = s.sample_ray(0, 0.5, rgb.Point2f(x / 4, y / 4), 0.5)
    local = medium.local(ray.o, ray.d)
    near, far = np.maximum(np.array(local.t_near, float), 0), np.array(local.t_far, float)
    T, total, t = np.ones(16), np.zeros_like(features, float), near.copy()
    while (t < far).any():
        inside = t < far
        end = np.minimum(t + STEP, far)
        middle = rgb.Float(np.where(inside, (t + end) / 2, 0).astype(np.float32))
        p = local.o + local.d * middle
        sigma, f = medium.density_features(p, rgb.Bool(inside))
        occupied = np.ones(16, bool)
        if medium.occupancy is not None:
            occupied = np.array(medium.occupancy.empty_cells(medium.to_unit(p), True)) == 0
        alpha = np.where(inside & occupied, -np.expm1(-np.array(sigma, float) * (end - t)), 0)
        total += (T * alpha)[:, None] * np.stack([np.array(v, float) for v in f], -1)
        T *= 1 - alpha
        t = end
    assert np.abs(total).max() > 0.05
    # Steps may begin a little apart behind leaps over empty cells.
    assert np.median(np.abs(features - total)) < 2e-4 * np.abs(total).max()
    assert np.abs(features - total).max() < 0.05 * np.abs(total).max()


def test02_colour_is_the_same_with_and_without_features(rgb, files):
    plain = render(rgb, with_field(files, aovs="opacity,depth"))
    both = render(rgb, with_field(files, aovs="opacity,depth,features"))
    assert np.allclose(both[..., :5], plain[..., :5], atol=1e-6)
    dark = render(rgb, with_field(files, aovs="opacity,depth,features", radiance=False))
    assert not dark[..., :3].any() and np.allclose(dark[..., 5:], both[..., 5:], atol=1e-6)


def test03_the_snapshot_is_the_field_at_the_surface(rgb, files):
    out = channels(rgb, with_field(files, aovs="position,features_at,opacity"))
    surface = out["opacity.Y"] >= 0.5
    medium = rgb.load_dict(with_field(files)["field"]).medium()
    p = rgb.Point3f(*[np.ascontiguousarray(out[f"position.{c}"][surface]) for c in "XYZ"])
    expected = np.stack([np.array(f) for f in medium.density_features(p, True)[1]], -1)
    got = block(out, "features_at")
    assert surface.sum() > 10 and np.allclose(got[surface], expected, atol=2e-3 * np.abs(expected).max())
    assert not got[~surface].any()


def test04_a_shape_has_none_and_hides_those_behind(rgb, files):
    wall = {
        "type": "rectangle",
        "to_world": rgb.ScalarTransform4f().look_at([0.5, 0.4, -2], [0.5, 0.4, -3], [0, 1, 0]).scale(9),
    }
    out = channels(rgb, with_field(files, aovs="features,features_at,opacity"), w=wall)
    assert (out["opacity.Y"] == 1).all() and not block(out, "features").any() and not block(out, "features_at").any()


def test05_derivatives_reach_the_field(rgb, files):
    import drjit as dr

    # Primal and gradient must look through the same points of the pixels.
    sensor = {**camera(rgb, size=4), "sampler": {"type": "stratified", "sample_count": 1, "jitter": False}}
    integrator = with_field(files, aovs="features,features_at", radiance=False, step=STEP, color_cutoff=0.0)
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("field.density_net.1"))
    start = rgb.TensorXf(params[key])

    def loss(value):
        params[key] = value
        params.update()
        image = rgb.render(scene, params, spp=1)
        return dr.sum(image[..., 3:] * image[..., 3:], axis=None)

    value = rgb.TensorXf(start)
    dr.enable_grad(value)
    dr.backward(loss(value))
    gradient = np.array(dr.grad(value))
    direction = gradient / np.linalg.norm(gradient)
    h = 1e-3
    ends = [float(np.array(loss(start + s * h * rgb.TensorXf(direction.astype(np.float32)))).item()) for s in (1, -1)]
    assert np.linalg.norm(gradient) > 0
    assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(np.linalg.norm(gradient), rel=0.03)


def test06_only_fields_have_features(rgb):
    with pytest.raises(RuntimeError, match='"features".*"field"'):
        rgb.load_dict(constant(aovs="features"))
