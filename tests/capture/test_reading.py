"""Pictures, depth and masks of every kind of file, written here with known numbers."""

import numpy as np
import pytest

from nerg_mi.capture.posed import DepthFile, MaskFile
from nerg_mi.capture.reading import read_depth, read_image, read_mask
from nerg_mi.files.exr import write_bitmap_exr


def to_srgb(x):
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_is_kept_as_stored(tmp_path, rgb, dtype, channels):
    values = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (5, 7, channels)).astype(dtype)
    formats = {1: rgb.Bitmap.PixelFormat.Y, 3: rgb.Bitmap.PixelFormat.RGB, 4: rgb.Bitmap.PixelFormat.RGBA}
    rgb.Bitmap(values, formats[channels]).write(str(tmp_path / "a.png"))
    out = read_image(tmp_path / "a.png")
    assert out.dtype == dtype and np.array_equal(out, np.repeat(values, 3, axis=2) if channels == 1 else values)


def test_jpeg(tmp_path, rgb):
    rgb.Bitmap(np.full((8, 8, 3), 77, np.uint8)).write(str(tmp_path / "a.jpg"))
    out = read_image(tmp_path / "a.jpg")
    assert out.dtype == np.uint8 and np.abs(out.astype(int) - 77).max() <= 1


def test_exr_is_linear_and_clipped(tmp_path, rgb):
    linear = np.array([[[0.001, 0.2, 0.5], [1.0, 3.0, -0.5]]], np.float32)
    write_bitmap_exr(tmp_path / "a.exr", rgb.Bitmap(linear))
    assert np.allclose(read_image(tmp_path / "a.exr"), to_srgb(np.clip(linear, 0, 1)), atol=1e-3)


def test_exr_with_alpha_is_premultiplied(tmp_path, rgb):
    straight = np.array([[[0.8, 0.4, 0.1, 0.5], [0.3, 0.2, 0.1, 1.0], [0, 0, 0, 0]]], np.float32)
    premultiplied = straight.copy()
    premultiplied[..., :3] *= straight[..., 3:]
    write_bitmap_exr(tmp_path / "a.exr", rgb.Bitmap(premultiplied, rgb.Bitmap.PixelFormat.RGBA))
    expected = np.concatenate([to_srgb(straight[..., :3]), straight[..., 3:]], axis=2)
    assert np.allclose(read_image(tmp_path / "a.exr"), expected, atol=1e-3)


def test_colour_of_an_exr_with_more_layers(tmp_path):
    import OpenEXR

    values = {k: np.full((2, 3), v, np.float32) for k, v in {"R": 0.1, "G": 0.2, "B": 0.3, "depth.T": 7.0}.items()}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, values) as file:
        file.write(str(tmp_path / "a.exr"))
    assert np.allclose(read_image(tmp_path / "a.exr"), to_srgb(np.array([0.1, 0.2, 0.3])), atol=1e-3)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"depth.T": values["depth.T"], "x.Y": values["R"]}) as file:
        file.write(str(tmp_path / "b.exr"))
    with pytest.raises(ValueError, match="b.exr.*R, G and B"):
        read_image(tmp_path / "b.exr")


def test_unreadable_and_broken_images_are_named(tmp_path, rgb):
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match="a.png"):
        read_image(tmp_path / "a.png")
    write_bitmap_exr(tmp_path / "b.exr", rgb.Bitmap(np.full((2, 2, 3), np.nan, np.float32)))
    with pytest.raises(ValueError, match="b.exr.*not finite"):
        read_image(tmp_path / "b.exr")


def test_depth_of_every_kind(tmp_path, rgb):
    depth = np.array([[0.5, 1.25, 0.0], [2.0, 60.0, 3.5]], np.float32)
    np.save(tmp_path / "a.npy", depth)
    write_bitmap_exr(tmp_path / "a.exr", rgb.Bitmap(depth))
    rgb.Bitmap((depth * 1000).astype(np.uint16)).write(str(tmp_path / "a.png"))
    for name, unit in (("a.npy", 1.0), ("a.exr", 1.0), ("a.png", 1e-3)):
        assert np.allclose(read_depth(DepthFile(tmp_path / name, unit)), depth, rtol=1e-6), name
    np.save(tmp_path / "b.npy", np.array([[np.nan, np.inf, -1.0, 2.0]]))
    assert np.array_equal(read_depth(DepthFile(tmp_path / "b.npy", 3.0)), [[0, 0, 0, 6]])


def test_depth_that_cannot_be_read_is_named(tmp_path, rgb):
    rgb.Bitmap(np.zeros((2, 2), np.uint8)).write(str(tmp_path / "a.png"))
    np.save(tmp_path / "b.npy", np.zeros((2, 2, 2)))
    (tmp_path / "c.tif").write_bytes(b"")
    (tmp_path / "d.npy").write_bytes(b"junk")
    for name, part in (("a.png", "16-bit"), ("b.npy", "one number"), ("c.tif", ".npy"), ("d.npy", "d.npy")):
        with pytest.raises(ValueError, match=f"{name}.*{part}" if part != name else name):
            read_depth(DepthFile(tmp_path / name))


def test_masks(tmp_path, rgb):
    mask = np.array([[0, 255, 1], [0, 0, 128]], np.uint8)
    rgb.Bitmap(mask).write(str(tmp_path / "a.png"))
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png"), (2, 3)), mask > 0)
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png", hides=True), (2, 3)), mask == 0)
    rgba = np.dstack([mask, mask, mask, np.full_like(mask, 255)])
    rgb.Bitmap(rgba, rgb.Bitmap.PixelFormat.RGBA).write(str(tmp_path / "b.png"))
    assert np.array_equal(read_mask(MaskFile(tmp_path / "b.png"), (2, 3)), mask > 0)
    with pytest.raises(ValueError, match="3 x 2 pixels.*4 x 4"):
        read_mask(MaskFile(tmp_path / "a.png"), (4, 4))
