"""Where eyes are: the sensor's centre, whatever the near plane, and for every member of a batch."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport import observer
from nerg_mi.transport.observer import Known


def camera(mi, origin, target=(0, 0, 0), kind="perspective", **kwargs):
    d = {
        "type": kind,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 4, "height": 4},
        **kwargs,
    }
    return d


def rays_of(mi, sensor, n=16):
    rng = np.random.default_rng(0)
    xy = mi.Point2f(rng.random((2, n)).astype(np.float32))
    return sensor.sample_ray(mi.Float(0), mi.Float(0.5), xy, mi.Point2f(0.5), True)[0]


@pytest.mark.parametrize("kind", ["perspective", "thinlens", "panorama"])
def test01_center_is_not_the_near_plane(rgb, kind):
    extra = {"aperture_radius": 0.1, "focus_distance": 3.0} if kind == "thinlens" else {}
    extra |= {} if kind == "panorama" else {"near_clip": 1.0}
    sensor = rgb.load_dict(camera(rgb, [1, 2, 3], kind=kind, **extra))
    assert np.allclose(np.array(observer.center(sensor)).ravel(), [1, 2, 3], atol=1e-6)
    observer.require_center(sensor, "x")
    got = np.array(observer.center_of_ray([sensor], rays_of(rgb, sensor)))
    assert np.allclose(got.reshape(3, -1).T, [1, 2, 3], atol=1e-6)


@pytest.mark.parametrize("kind", ["orthographic", "distant", "irradiancemeter"])
def test02_sensors_without_a_center(rgb, kind):
    if kind == "irradiancemeter":
        shape = rgb.load_dict({"type": "rectangle", "s": {"type": "irradiancemeter", "film": {"type": "hdrfilm"}}})
        sensor = shape.sensor()
    else:
        sensor = rgb.load_dict(
            {"type": kind, "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}}
        )
    with pytest.raises(ValueError, match='"observer"'):
        observer.require_center(sensor, "the camera")
    with pytest.raises(ValueError, match="no centre"):
        observer.center_of_ray([sensor], rays_of(rgb, rgb.load_dict(camera(rgb, [0, 0, 1]))))


def batch(mi, *cameras):
    d = {"type": "batch", "film": {"type": "hdrfilm", "width": 4 * len(cameras), "height": 4}}
    return mi.load_dict(d | {f"c{i}": c for i, c in enumerate(cameras)})


@pytest.mark.parametrize("near", [0.01, 1.0, 8.0])
def test03_rays_of_a_batch_find_their_camera(rgb, near):
    origins = [[0, 0, 3], [0.5, 0, 3], [-3, 1, 0], [0, 0, -3]]
    sensor = batch(rgb, *(camera(rgb, o, near_clip=near) for o in origins))
    ray = rays_of(rgb, sensor, 200)
    got = np.array(observer.center_of_ray([sensor], ray)).T
    # The ray's own camera: its line passes through exactly one of the centres.
    o, d = np.array(ray.o).T, np.array(ray.d).T
    v = o[:, None] - np.array(origins)
    along = (v * d[:, None]).sum(-1, keepdims=True)
    own = np.linalg.norm(v - along * d[:, None], axis=-1).argmin(-1)
    assert len(set(own)) == 4 and np.allclose(got, np.array(origins)[own], atol=1e-5)


def test04_same_center(rgb):
    a, b = rgb.load_dict(camera(rgb, [1, 2, 3], near_clip=1.0)), rgb.load_dict(camera(rgb, [1, 2, 3.001]))
    turned = rgb.load_dict(camera(rgb, [1, 2, 3], target=(5, 0, 1), fov=70))
    assert observer.same_center([a], observer.center(turned)) and not observer.same_center([a], observer.center(b))
    assert not observer.same_center([a, b], observer.center(a)) and not observer.same_center([], observer.center(a))
    ortho = rgb.load_dict({"type": "orthographic"})
    assert not observer.same_center([ortho], observer.center(ortho))
    assert observer.same_center([batch(rgb, camera(rgb, [1, 2, 3]), camera(rgb, [1, 2, 3]))], observer.center(a))


def test05_no_sensor(rgb):
    ray = rays_of(rgb, rgb.load_dict(camera(rgb, [0, 0, 1])))
    with pytest.raises(ValueError, match='"observer"'):
        observer.center_of_ray([], ray)


def test06_center_is_attached_to_the_placement(rgb):
    sensor = rgb.load_dict(camera(rgb, [1, 2, 3]))
    params = rgb.traverse(sensor)
    x = rgb.Float(0)
    dr.enable_grad(x)
    params["to_world"] = rgb.Transform4f().translate([x, 2 * x, 0]) @ rgb.Transform4f(params["to_world"])
    params.update()
    c = observer.center(sensor)
    dr.backward(c.x + c.y)
    assert np.isclose(dr.grad(x).numpy()[0], 3)


@pytest.mark.parametrize("near", [0.5, 1.5])
def test_cameras_on_one_line_are_told_apart_by_where_their_rays_start(rgb, near):
    """Both look along the line that both stand on: a ray on it starts on the near plane of its own."""
    sensor = batch(rgb, camera(rgb, [0, 0, 3], near_clip=near), camera(rgb, [0, 0, 1], [0, 0, -1], near_clip=near))
    for z in (3, 1):
        ray = rgb.Ray3f(rgb.Point3f(0, 0, z - near), rgb.Vector3f(0, 0, -1))
        assert np.allclose(np.array(observer.center_of_ray([sensor], ray)).ravel(), [0, 0, z], atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_each_lane_has_what_belongs_to_the_nearest(rgb, count):
    rng = np.random.default_rng(count)
    centers, p = rng.normal(size=(count, 3)), rng.normal(size=(60, 3))
    known = [Known(rgb.Point3f(*map(float, c)), rgb.Float(k)) for k, c in enumerate(centers)]
    lanes = rgb.Point3f(np.ascontiguousarray(p.T, np.float32))
    found = observer.select_nearest(known, lanes, lambda value: value).numpy()
    assert np.array_equal(np.broadcast_to(found, 60), np.linalg.norm(p[:, None] - centers, axis=2).argmin(axis=1))
