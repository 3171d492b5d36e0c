"""Directions of a lens's pixels on the device: projected again by OpenCV's formulas they are the pixels that were asked
for."""

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.photos.cameras import Intrinsics
from nerg_mi.train.radiance_data import LensTable
from tests.reference import opencv

PLAIN = Intrinsics(24, 18, 20.0, 21.0, 11.0, 9.5)
# Far stronger than lenses are: the iteration only arrives in its steps where every term of its derivative is right.
STRONG = {
    "radial": replace(PLAIN, k1=0.6, k2=0.4, k3=0.3),
    "barrel": replace(PLAIN, k1=-0.35, k2=0.25, k3=-0.1),
    "tangential": replace(PLAIN, p1=0.07, p2=0.08),
    "both": replace(PLAIN, k1=0.5, p1=-0.12, p2=0.15),
    "rational": replace(PLAIN, k1=0.9, k2=0.6, k3=0.3, k4=0.5, k5=0.3, k6=0.2),
    "denominator": replace(PLAIN, k4=-0.35, k5=-0.2, k6=-0.1),
}
FISHEYES = {
    "rising": replace(PLAIN, fx=9.0, fy=8.5, k1=0.05, k2=0.02, k3=0.01, k4=0.002, fisheye=True),
    "flat": replace(PLAIN, fx=9.0, fy=8.5, k1=-0.06, k2=0.015, k3=-0.002, fisheye=True),
    "wide": replace(PLAIN, fx=5.5, fy=5.5, k1=-0.02, k4=1e-5, fisheye=True),
}


def pixels(lens):
    row, column = np.divmod(np.arange(lens.width * lens.height), lens.width)
    return column, row


def directions(lenses, which):
    """Directions (N, 3), x right, y down, z forward, of all pixels of one of several lenses."""
    column, row = pixels(lenses[which])
    frame = np.full(len(row), which)
    d = LensTable(ns, lenses).directions(*(ns.UInt32(v.astype(np.uint32)) for v in (frame, column, row)))
    x, y, z = (np.broadcast_to(np.array(v, np.float64), len(row)) for v in d)
    return np.stack([x, -y, -z], axis=1)


def projected(lens, d):
    project = opencv.fisheye_project if lens.fisheye else opencv.project
    k = (lens.k1, lens.k2, lens.k3, lens.k4) if lens.fisheye else lens.distortion
    # OpenCV counts from the first pixel's centre.
    return project(d, lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5, k)


@pytest.mark.parametrize("name", STRONG)
def test_pinholes(name):
    lens = STRONG[name]
    d = directions([lens], 0)
    assert np.allclose(d[:, 2], 1)
    assert np.abs(projected(lens, d) - np.stack(pixels(lens), axis=1)).max() < 5e-5
    assert np.abs(d - directions([PLAIN], 0)).max() > 0.05


@pytest.mark.parametrize("name", FISHEYES)
def test_fisheyes(name):
    lens = FISHEYES[name]
    d = directions([lens], 0)
    assert np.allclose(np.linalg.norm(d, axis=1), 1, atol=1e-6) and d[:, 2].min() < 0.3
    assert np.abs(projected(lens, d) - np.stack(pixels(lens), axis=1)).max() < 5e-5


@pytest.mark.parametrize("name", FISHEYES)
def test_angles_of_fisheyes_are_right_to_rounding(name):
    """The polynomial of the angle is the pixel's radius, in the median to a unit in the last place."""
    lens = FISHEYES[name]
    column, row = pixels(lens)
    d = directions([lens], 0)
    t = np.arctan2(np.hypot(d[:, 0], d[:, 1]), d[:, 2])
    radius = t * (1 + lens.k1 * t**2 + lens.k2 * t**4 + lens.k3 * t**6 + lens.k4 * t**8)
    error = np.abs(radius - np.hypot((column + 0.5 - lens.cx) / lens.fx, (row + 0.5 - lens.cy) / lens.fy))
    assert np.median(error) < 2.0**-23 and error.max() < 1e-6


def test_the_pixel_on_the_axis_looks_along_it():
    lens = replace(FISHEYES["rising"], cx=11.5, cy=9.5)
    d = directions([lens], 0).reshape(18, 24, 3)
    assert np.allclose(d[9, 11], [0, 0, 1])


def test_beyond_its_end_a_fisheye_shows_its_last_direction():
    """The polynomial θ - θ³/12 rises to θ = 2, where the image radius is 4/3; its inverse has no finite slope there."""
    lens = replace(PLAIN, fx=6.0, fy=6.0, cx=12.0, cy=9.0, k1=-1 / 12, fisheye=True)
    column, row = pixels(lens)
    x, y = (column + 0.5 - 12) / 6, (row + 0.5 - 9) / 6
    r = np.hypot(x, y)
    d = directions([lens], 0)
    angle = np.arctan2(np.hypot(d[:, 0], d[:, 1]), d[:, 2])
    assert (r > 4 / 3).sum() > 50
    assert np.allclose(angle[r > 4 / 3], 2, atol=2e-3)
    inside = r < 1.3
    assert np.allclose(angle[inside] - angle[inside] ** 3 / 12, r[inside], atol=1e-5)
    assert np.allclose(np.arctan2(d[:, 1], d[:, 0]), np.arctan2(y, x), atol=1e-5)


@pytest.mark.parametrize("which", range(4))
def test_each_frame_has_its_own_lens(which):
    lenses = [PLAIN, STRONG["rational"], FISHEYES["rising"], STRONG["tangential"]]
    d = directions(lenses, which)
    assert np.abs(projected(lenses[which], d) - np.stack(pixels(lenses[which]), axis=1)).max() < 5e-5
