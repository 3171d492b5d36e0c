"""Photos made pinhole and renderings bent to a lens, against a smooth picture of the sky known in every direction."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.photos.cameras import Camera, Intrinsics, pixel_directions
from nerg_mi.photos.images import View, pinhole, through_lens, undistorted

PLAIN = Intrinsics(90, 70, 80.0, 80.0, 44.0, 36.5)
LENSES = {
    "barrel": replace(PLAIN, k1=-0.15, k2=0.03, p1=0.002, p2=-0.001),
    "pincushion": replace(PLAIN, k1=0.1),
    "oblong": replace(PLAIN, fy=84.0),
    "fisheye": replace(PLAIN, k1=0.02, k2=-0.004, fisheye=True),
}
POSE = np.array([[0, 0, 1.0, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])


def sky(d):
    """Smooth colours of world directions."""
    return np.stack(
        [
            0.5 + 0.3 * np.sin(4 * d[..., 0] + 2 * d[..., 1]),
            0.5 + 0.4 * np.cos(3 * d[..., 2] - d[..., 0]),
            0.5 + 0.3 * np.sin(5 * d[..., 1] * d[..., 2]),
        ],
        axis=-1,
    )


def picture(intrinsics):
    return sky(pixel_directions(intrinsics) @ POSE[:3, :3].T).astype(np.float32)


@pytest.mark.parametrize("name", LENSES)
def test_an_undistorted_photo_shows_what_its_sensor_renders(name, rgb):
    """The directions are those of the sensor's own rays, not of this module's idea of them."""
    i = LENSES[name]
    image, mask, sensor = undistorted(View("a", Camera(i, POSE), picture(i)))
    rays = rgb.load_dict(sensor)
    x, y = np.meshgrid((np.arange(90) + 0.5) / 90, (np.arange(70) + 0.5) / 70)
    ray, _ = rays.sample_ray(0.0, 0.5, rgb.Point2f(x.ravel(), y.ravel()), rgb.Point2f(0.5, 0.5))
    expected = sky(ray.d.numpy().T.reshape(70, 90, 3))
    assert mask.mean() > 0.9 and image.shape == (70, 90, 3)
    assert np.abs(image - expected)[mask].max() < 1e-3
    assert np.all(image[~mask] == 0)


def test_an_undistorted_photo_of_a_plain_lens_is_the_photo():
    photo = picture(PLAIN)
    image, mask, sensor = undistorted(View("a", Camera(PLAIN, POSE), photo))
    assert np.array_equal(image, photo) and mask.all() and sensor["film"]["width"] == 90


def test_what_the_photo_does_not_show_is_masked():
    """A pincushion photo holds less than the pinhole picture of its size; the mask says so pixel by pixel."""
    i = replace(PLAIN, k1=0.3)
    _, mask, _ = undistorted(View("a", Camera(i, POSE), picture(i)))
    d = pixel_directions(PLAIN)
    x, y = d[..., 0] / -d[..., 2], d[..., 1] / d[..., 2]
    grow = 1 + 0.3 * (x * x + y * y)
    u, v = 80 * x * grow + 44, 80 * y * grow + 36.5
    expected = (u >= 0.5) & (u <= 89.5) & (v >= 0.5) & (v <= 69.5)
    assert np.array_equal(mask, expected) and 0.5 < mask.mean() < 0.95


def test_transparent_pixels_lend_no_colour():
    i = LENSES["barrel"]
    color = np.concatenate([picture(i), np.ones((70, 90, 1), np.float32)], axis=2)
    color[:, 45:] = [1, 0, 1, 0]
    image, mask, _ = undistorted(View("a", Camera(i, POSE), color))
    clear = mask & (image[..., 3] > 0.5)
    assert np.abs(image[..., :3] - undistorted(View("a", Camera(i, POSE), picture(i))).image)[clear].max() < 0.15
    assert np.all(image[..., 3][:, 50:] < 0.3)


@pytest.mark.parametrize("name", LENSES)
def test_a_rendering_bent_to_the_lens_equals_the_photo(name):
    i = LENSES[name]
    camera = Camera(i, POSE)
    source = pinhole(camera, oversample=2.0)
    bent, mask = through_lens(picture(source.intrinsics), source, camera)
    assert mask.all() and bent.shape == (70, 90, 3)
    assert np.abs(bent - picture(i)).max() < 1e-3


def test_a_wide_fisheye_is_covered_as_far_as_a_pinhole_reaches():
    i = Intrinsics(80, 80, 26.0, 26.0, 40.0, 40.0, fisheye=True)
    camera = Camera(i, POSE)
    source = pinhole(camera)
    bent, mask = through_lens(picture(source.intrinsics), source, camera)
    angle = np.degrees(np.arccos(-pixel_directions(i)[..., 2]))
    assert np.all(mask[angle < 75]) and not np.any(mask[angle > 88])
    assert np.abs(bent - picture(i))[angle < 75].max() < 5e-3


def test_errors_of_through_lens():
    camera = Camera(LENSES["barrel"], POSE)
    source = pinhole(camera)
    with pytest.raises(ValueError, match="pixels"):
        through_lens(np.zeros((3, 3, 3)), source, camera)
    with pytest.raises(ValueError, match="same place"):
        through_lens(picture(source.intrinsics), source, Camera(LENSES["barrel"], np.eye(4)))
