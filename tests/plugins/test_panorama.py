"""The sensor is the inverse of Mitsuba's envmap, in rgb and mono, rotated, moved, cropped, and from XML."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.geometry import pixel_directions, pixel_solid_angles

from .scenes import camera, picture, put, scene_with, still

WIDTH, HEIGHT = 12, 7


def turned(mi):
    return mi.ScalarTransform4f().translate([1, -2, 3]).rotate([0.6, 0, 0.8], 70).rotate([0, 1, 0], 200)


def panorama(mi, to_world=None, random=False, **film):
    sensor = camera(mi, kind="panorama", film={"width": WIDTH, "height": HEIGHT} | film)
    sensor["to_world"] = to_world if to_world is not None else mi.ScalarTransform4f()
    return sensor if random else still(sensor)


def scene(mi, image, sensor, to_world=None):
    turn = to_world if to_world is not None else mi.ScalarTransform4f()
    sky = {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "to_world": turn}
    return scene_with(mi, {"type": "path"}, sensor, sky=sky)


def noise(channels=3):
    return np.random.default_rng(5).random((HEIGHT, WIDTH, channels)).astype(np.float32)


@pytest.mark.parametrize("moved", [False, True])
def test01_returns_the_pixels_of_an_envmap(rgb, moved):
    to_world = turned(rgb) if moved else None
    image = noise()
    got = picture(rgb, scene(rgb, image, panorama(rgb, to_world), to_world))
    # Including the rows at the poles; single precision rotates directions by 1e-7 / POLE there.
    assert np.allclose(got, image, atol=5e-3)
    assert np.allclose(got[1:-1], image[1:-1], atol=1e-4)


def test03_constant_sky_with_random_samples(rgb_and_mono):
    mi = rgb_and_mono
    sensor = panorama(mi, turned(mi), random=True)
    got = np.array(mi.render(scene(mi, np.full((HEIGHT, WIDTH, 3), 0.7), sensor), spp=16))
    assert np.allclose(got, 0.7, atol=1e-6)


def test04_smooth_sky_with_random_samples(rgb):
    # A linear function of direction, on a fine map: pixels agree although samples are spread over them.
    v = pixel_directions(256, 129)
    sensor = panorama(rgb, random=True, width=32, height=17)
    got = np.array(rgb.render(scene(rgb, 1 + v, sensor), spp=256))
    assert np.allclose(got, 1 + pixel_directions(32, 17), atol=0.05)


def test05_rays_match_the_numpy_mapping(rgb_and_mono):
    mi = rgb_and_mono
    sensor = mi.load_dict(panorama(mi, turned(mi)))
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH, (np.arange(HEIGHT) + 0.5) / HEIGHT)
    sample = mi.Point2f(mi.Float(x.ravel().astype(np.float32)), mi.Float(y.ravel().astype(np.float32)))
    turn = np.array(turned(mi).matrix, dtype=float)[:3, :3]
    expected = pixel_directions(WIDTH, HEIGHT).reshape(-1, 3) @ turn.T
    for ray, weight in (
        sensor.sample_ray(0.0, 0.5, sample, mi.Point2f(0.5), True),
        sensor.sample_ray_differential(0.0, 0.5, sample, mi.Point2f(0.5), True),
    ):
        assert np.allclose(np.array(ray.d).T, expected, atol=2e-4)
        assert np.allclose(np.array(ray.o).T, [1, -2, 3], atol=1e-6)
        assert np.allclose(np.array(weight), 1)
        assert np.all(np.array(ray.maxt) > 1e30)


def test06_differentials_are_the_neighbouring_pixels(rgb):
    sensor = rgb.load_dict(panorama(rgb))
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, rgb.Point2f(3.5 / WIDTH, 2.5 / HEIGHT), rgb.Point2f(0), True)
    v = pixel_directions(WIDTH, HEIGHT)
    assert np.allclose(np.array(ray.d_x).ravel(), v[2, 4], atol=1e-6)
    assert np.allclose(np.array(ray.d_y).ravel(), v[3, 3], atol=1e-6)


def test07_crop_window(rgb):
    image = noise()
    crop = dict(crop_offset_x=3, crop_offset_y=1, crop_width=5, crop_height=4)
    loaded = scene(rgb, image, panorama(rgb, **crop))
    got = picture(rgb, loaded)
    assert np.allclose(got, image[1:5, 3:8], atol=1e-4)
    assert np.array_equal(loaded.sensors()[0].pixel_solid_angles(), pixel_solid_angles(WIDTH, HEIGHT)[1:5, 3:8])


def test09_xml_equals_dict(rgb):
    from_xml = rgb.load_string(
        f"""<sensor version="3.0.0" type="panorama">
            <transform name="to_world"><lookat origin="1, 2, 3" target="2, 2, 3" up="0, 1, 0"/></transform>
            <film type="hdrfilm"><integer name="width" value="{WIDTH}"/><integer name="height" value="{HEIGHT}"/></film>
        </sensor>"""
    )
    look = rgb.ScalarTransform4f().look_at(origin=[1, 2, 3], target=[2, 2, 3], up=[0, 1, 0])
    from_dict = rgb.load_dict(panorama(rgb, look))
    for sensor in (from_xml, from_dict):
        # The middle of the image looks at the target, and integrators find the centre.
        ray, _ = sensor.sample_ray(0.0, 0.5, rgb.Point2f(0.5), rgb.Point2f(0), True)
        assert np.allclose(np.array(ray.d).ravel(), [1, 0, 0], atol=1e-6)
        assert np.allclose(np.array(sensor.world_transform() @ rgb.Point3f(0)).ravel(), [1, 2, 3])
    assert "Panorama[" in str(from_xml)


def test10_sensor_moves_through_traverse(rgb):
    image = noise()
    loaded = scene(rgb, image, panorama(rgb))
    params = rgb.traverse(loaded)
    put(params, "sensor.to_world", rgb.Transform4f().rotate([0, 1, 0], 180))
    got = picture(rgb, loaded)
    assert np.allclose(got[1:-1], np.roll(image, WIDTH // 2, axis=1)[1:-1], atol=1e-4)
    params["sensor.to_world"] = rgb.Transform4f().scale(2)
    with pytest.raises(ValueError, match='"to_world"'):
        params.update()


def test11_invalid_values_are_refused(rgb):
    with pytest.raises(RuntimeError, match='"to_world"'):
        rgb.load_dict(panorama(rgb, rgb.ScalarTransform4f().scale([1, 2, 1])))
    with pytest.raises(RuntimeError, match='"height"'):
        rgb.load_dict(panorama(rgb, height=1))
    with pytest.raises(RuntimeError, match="unreferenced"):
        rgb.load_dict({**panorama(rgb), "fov": 45.0})


def test12_no_aperture_and_point_bbox(rgb):
    sensor = rgb.load_dict(panorama(rgb, turned(rgb)))
    assert not sensor.needs_aperture_sample()
    assert dr.allclose(sensor.bbox().min, [1, -2, 3]) and dr.allclose(sensor.bbox().max, [1, -2, 3])
