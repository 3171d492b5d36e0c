"""Images of which not all pixels are traced."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.viewer.lattice import Lattice

SIZES = [(8, 6), (7, 5), (1, 4), (5, 1)]


def traced_pixels(width, height, pixels_per_ray):
    """Whether each pixel (height, width) is traced."""
    y, x = np.mgrid[:height, :width]
    return {1: x >= 0, 2: (x + y) % 2 == 0, 4: (x % 2 == 0) & (y % 2 == 0)}[pixels_per_ray]


def interpolate(lattice, image, **options):
    """``image`` (height, width) from its values at the rays of ``lattice``."""
    import drjit as dr
    import mitsuba as mi

    x, y = (v.numpy() for v in lattice.locate(dr.arange(mi.UInt32, lattice.num_rays)))
    is_inside = (x < lattice.width) & (y < lattice.height)
    values = np.where(is_inside, image[np.minimum(y, lattice.height - 1), np.minimum(x, lattice.width - 1)], np.nan)
    rows, columns = (mi.UInt32(v.ravel().astype(np.uint32)) for v in np.indices(image.shape))
    (pixels,) = lattice.interpolate([mi.Float(values.astype(np.float32))], columns, rows, **options)
    return pixels.numpy().reshape(image.shape)


@pytest.mark.parametrize("pixels_per_ray", [1, 2, 4])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_each_pixel_of_the_lattice_has_one_ray(rgb, size, pixels_per_ray):
    import drjit as dr
    import mitsuba as mi

    lattice = Lattice(*size, pixels_per_ray)
    x, y = (v.numpy() for v in lattice.locate(dr.arange(mi.UInt32, lattice.num_rays)))
    count = np.zeros((size[1], size[0] + 1), int)
    np.add.at(count, (y, x), 1)
    np.testing.assert_array_equal(count[:, :-1], traced_pixels(*size, pixels_per_ray))


@pytest.mark.parametrize("pixels_per_ray", [1, 2, 4])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_traced_pixels_keep_their_values_and_ramps_are_exact(rgb, size, pixels_per_ray):
    y, x = np.mgrid[: size[1], : size[0]].astype(float)
    lattice, ramp = Lattice(*size, pixels_per_ray), 0.25 * x - 0.5 * y
    noise = np.random.default_rng(0).random(x.shape).astype(np.float32)
    is_traced = traced_pixels(*size, pixels_per_ray)
    np.testing.assert_array_equal(interpolate(lattice, noise)[is_traced], noise[is_traced])
    assert np.isfinite(interpolate(lattice, noise)).all()
    np.testing.assert_allclose(interpolate(lattice, ramp)[1:-1, 1:-1], ramp[1:-1, 1:-1], atol=1e-6)


def test_edges_stay_sharp(rgb):
    for axis in (0, 1):
        image = (np.indices((6, 8))[axis] > 2).astype(float)
        np.testing.assert_array_equal(interpolate(Lattice(8, 6, 2), image), image)


@pytest.mark.parametrize("pixels_per_ray", [2, 4])
def test_classes_are_not_mixed(rgb, pixels_per_ray):
    classes, lattice = np.random.default_rng(0).choice([1, 10, 100], (6, 8)), Lattice(8, 6, pixels_per_ray)
    assert np.isin(interpolate(lattice, classes, has_mean=False), classes).all()
    assert not np.isin(interpolate(lattice, classes), classes).all()
