"""Tests of `nerg_mi.train.radiance_data`."""

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions, pixel_grid
from nerg_mi.photos.images import PhotoView
from nerg_mi.train.radiance_data import LensTable, PixelBank

# ---- The pixel bank against the views that it was made of ----

PLAIN = Intrinsics(24, 18, 20.0, 21.0, 11.0, 9.5)

LENSES = [
    PLAIN,
    replace(PLAIN, width=30, k1=0.06, k2=-0.08, p1=-1e-3, p2=2e-4),
    replace(PLAIN, k1=-0.2, k2=0.05, p1=0.01, p2=-0.01),
    replace(PLAIN, k1=0.4, k2=0.1, k3=0.02, k4=0.5, k5=0.05, k6=0.01),
    replace(PLAIN, height=31, k1=0.03, k2=-0.01, k3=2e-3, k4=-4e-4, fisheye=True),
    replace(PLAIN, fx=8.0, fy=8.0, k1=-0.05, fisheye=True),
]


# Far stronger than real lenses: the iteration only converges if every term of its derivative is correct.
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


def view(lens, rng, dtype=np.uint8, channels=3, depth=False, mask=False):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q * np.sign(np.linalg.det(q)), rng.normal(size=3)
    shape = lens.height, lens.width
    pixels = rng.integers(0, 256, (*shape, channels)).astype(np.uint8)
    pixels = (
        pixels
        if dtype == np.uint8
        else pixels.astype(np.uint16) * 257
        if dtype == np.uint16
        else pixels / np.float32(255)
    )
    distance = rng.uniform(0.5, 9, shape).astype(np.float32) * (rng.random(shape) > 0.2) if depth else None
    return PhotoView("v", PosedCamera(lens, pose), pixels, distance, rng.random(shape) > 0.3 if mask else None)


def expected(views):
    """Origins, directions, colours, alpha and depth of all unmasked pixels, view after view, in float64."""
    out = [[] for _ in range(5)]
    for v in views:
        use = np.ones(v.shape, bool) if v.mask is None else v.mask
        d = (pixel_directions(v.camera.intrinsics) @ v.camera.to_world[:3, :3].T)[use]
        color = v.color[use]
        depth = np.zeros(len(d)) if v.depth is None else v.depth[use]
        for to, x in zip(
            out,
            (
                np.broadcast_to(v.camera.center, d.shape),
                d,
                color[:, :3],
                color[:, 3] if v.has_alpha else np.ones(len(d)),
                depth,
            ),
        ):
            to.append(x)
    return [np.concatenate(x) for x in out]


def _radius(lens):
    return pixel_grid(lens).reshape(-1, 2) if lens is LENSES[5] else np.zeros((lens.width * lens.height, 2))


@pytest.mark.parametrize(
    "lenses", [[PLAIN], LENSES[:4], LENSES[4:], LENSES, list(STRONG.values()), [*FISHEYES.values(), STRONG["both"]]]
)
def test_rays_equal_those_of_the_cameras(lenses):
    rng = np.random.default_rng(0)
    views = [view(lens, rng) for lens in lenses]
    bank = PixelBank(ns, views)
    batch = bank.gather_batch(dr.arange(ns.UInt32, bank.size))
    o, d, rgb, _, _ = expected(views)
    assert np.allclose(batch.o.numpy().T, o, atol=1e-6)
    # The last lens ends within its picture, where its inverse has no finite slope.
    ends = np.linalg.norm(np.concatenate([_radius(lens) for lens in lenses]), axis=-1) > 0.99 * 1.7213
    error = np.abs(batch.d.numpy().T - d).max(axis=1)
    assert error[~ends].max() < 2e-6 and error.max() < 2e-3
    assert np.allclose(batch.rgb.numpy().T, rgb, atol=1e-7)
    assert batch.alpha is None and batch.depth is None


@pytest.mark.parametrize(
    "dtype, channels, depth, mask",
    [
        (np.uint8, 3, False, False),
        (np.uint8, 4, True, False),
        (np.uint8, 3, False, True),
        (np.uint16, 3, True, True),
        (np.float32, 4, False, False),
    ],
)
def test_colours_alpha_depth_and_masks(dtype, channels, depth, mask):
    rng = np.random.default_rng(1)
    views = [view(lens, rng, dtype, channels, depth, mask) for lens in LENSES[:3]]
    bank = PixelBank(ns, views)
    pick = np.random.default_rng(2).permutation(bank.size).astype(np.uint32)
    batch = bank.gather_batch(ns.UInt32(pick))
    o, d, rgb, alpha, distance = (x[pick] for x in expected(views))
    assert bank.size == sum(v.shape[0] * v.shape[1] if v.mask is None else int(v.mask.sum()) for v in views)
    tolerance = 1e-6 if dtype == np.uint8 else 5e-4
    assert np.abs(batch.d.numpy().T - d).max() < 2e-6 and np.allclose(batch.o.numpy().T, o, atol=1e-6)
    assert np.allclose(batch.rgb.numpy().T, rgb, atol=tolerance)
    if channels == 4:
        assert np.allclose(batch.alpha.numpy(), alpha, atol=tolerance)
    if depth:
        assert np.allclose(batch.depth.numpy(), distance, atol=9 / 65535)
        assert np.array_equal(batch.depth.numpy() > 0, distance > 0)
        assert not bank.has_full_depth


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_views_without_alpha_are_opaque(dtype):
    rng = np.random.default_rng(3)
    views = [view(PLAIN, rng, dtype, channels=4), view(PLAIN, rng, dtype)]
    bank = PixelBank(ns, views)
    count = PLAIN.width * PLAIN.height
    alpha = bank.gather_batch(dr.arange(ns.UInt32, bank.size)).alpha.numpy()
    assert bank.size == 2 * count and np.abs(alpha[count:] - 1).max() < 1e-6 and alpha[:count].min() < 0.1


def test_measured_depth_never_rounds_to_zero():
    v = view(PLAIN, np.random.default_rng(4))
    depth = np.full(v.shape, 1e-3, np.float32)
    depth[0, 0] = 1e4
    bank = PixelBank(ns, [replace(v, depth=depth)])
    assert bank.has_full_depth
    points = np.concatenate([p.numpy().T for p in bank.iter_surface_points(100)])
    assert len(points) == bank.size


def test_surface_points_lie_at_the_depth_of_their_rays():
    rng = np.random.default_rng(6)
    views = [view(lens, rng, depth=True, mask=True) for lens in LENSES[:2]]
    points = np.concatenate([p.numpy().T for p in PixelBank(ns, views).iter_surface_points(100)])
    o, d, _, _, depth = expected(views)
    truth = depth > 0
    assert not truth.all() and np.allclose(points, (o + d * depth[:, None])[truth], atol=2e-4)


def test_too_many_pixels_are_refused(monkeypatch):
    monkeypatch.setattr("nerg_mi.train.radiance_data._MAX_PIXELS", 100)
    with pytest.raises(ValueError, match="smaller width"):
        PixelBank(ns, [view(PLAIN, np.random.default_rng(5))])


# ---- Unproject ----
#
# Pixel directions on the device: OpenCV's formulas project them back to the pixels.


def pixels(lens):
    row, column = np.divmod(np.arange(lens.width * lens.height), lens.width)
    return column, row


def directions(lenses, which):
    """Directions (N, 3), x right, y down, z forward, of all pixels of one of several lenses."""
    column, row = pixels(lenses[which])
    frame = np.full(len(row), which)
    d = LensTable(ns, lenses).compute_directions(*(ns.UInt32(v.astype(np.uint32)) for v in (frame, column, row)))
    x, y, z = (np.broadcast_to(np.array(v, np.float64), len(row)) for v in d)
    return np.stack([x, -y, -z], axis=1)


def test_the_pixel_on_the_axis_looks_along_it():
    lens = replace(FISHEYES["rising"], cx=11.5, cy=9.5)
    d = directions([lens], 0).reshape(18, 24, 3)
    assert np.allclose(d[9, 11], [0, 0, 1])


def test_beyond_its_end_a_fisheye_shows_its_last_direction():
    """The polynomial θ - θ³/12 increases up to θ = 2, where the image radius is 4/3; its inverse has no finite slope
    there.
    """
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
