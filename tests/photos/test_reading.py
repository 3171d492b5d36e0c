"""Pictures, depth and masks of every kind of file, written here with known numbers."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.images import write_bitmap_exr, write_exr
from nerg_mi.photos.images import read_depth, read_image, read_mask, read_photo
from nerg_mi.photos.posed import DepthFile, Frame, MaskFile


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


@pytest.mark.parametrize("names", [["V"], ["A", "B", "G", "R", "ViewLayer.Depth.Z"], ["R", "G", "B", "depth.T"], "RGB"])
def test_depth_of_an_exr_is_the_channel_of_that_name(tmp_path, names):
    rng, depth = np.random.default_rng(0), np.full((2, 3), 2.5, np.float32)
    grey = list(names) == ["R", "G", "B"]
    channels = {n: depth if grey or n == names[-1] else rng.random((2, 3)).astype(np.float32) for n in names}
    write_exr(tmp_path / "a.exr", channels)
    assert np.array_equal(read_depth(DepthFile(tmp_path / "a.exr")), depth)


def test_an_exr_of_which_no_channel_is_the_depth_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    write_exr(tmp_path / "a.exr", {n: rng.random((2, 3)).astype(np.float32) for n in "RGB"})
    with pytest.raises(NergError, match="a.exr"):
        read_depth(DepthFile(tmp_path / "a.exr"))


def test_depth_that_cannot_be_read_is_named(tmp_path, rgb):
    rgb.Bitmap(np.zeros((2, 2), np.uint8)).write(str(tmp_path / "a.png"))
    np.save(tmp_path / "b.npy", np.zeros((2, 2, 2)))
    (tmp_path / "c.tif").write_bytes(b"")
    (tmp_path / "d.npy").write_bytes(b"junk")
    for name, part in (("a.png", "16-bit"), ("b.npy", "one number"), ("c.tif", ".npy"), ("d.npy", "d.npy")):
        with pytest.raises(ValueError, match=f"{name}.*{part}" if part != name else name):
            read_depth(DepthFile(tmp_path / name))


@pytest.mark.parametrize(
    "values",
    [
        np.array([[0, 255, 3], [1, 127, 128]], np.uint8),
        np.array([[0, 1, 0], [0, 0, 1]], np.uint8),
        np.array([[0, 65535, 700], [9, 0, 40000]], np.uint16),
        np.array([[0, 255, 0], [0, 0, 255]], np.uint16),
    ],
    ids=["8-bit", "labels", "16-bit", "8-in-16-bit"],
)
def test_masks_are_white_above_half(tmp_path, rgb, values):
    white = np.array([[0, 1, 0], [0, 0, 1]], bool)
    rgb.Bitmap(values).write(str(tmp_path / "a.png"))
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png"), (2, 3)), white)
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png", hides=True), (2, 3)), ~white)
    opaque = np.full_like(values, np.iinfo(values.dtype).max)
    rgb.Bitmap(np.dstack([*3 * [values], opaque]), rgb.Bitmap.PixelFormat.RGBA).write(str(tmp_path / "b.png"))
    assert np.array_equal(read_mask(MaskFile(tmp_path / "b.png"), (2, 3)), white)


def test_a_mask_stored_as_jpeg(tmp_path, rgb):
    mask = np.zeros((24, 32), np.uint8)
    mask[5:17, 9:21] = 255
    rgb.Bitmap(mask).write(str(tmp_path / "a.jpg"), quality=60)
    stored = np.array(rgb.Bitmap(str(tmp_path / "a.jpg")))
    assert ((stored > 0) & (stored < 30)).any()
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.jpg"), mask.shape), mask > 0)


@pytest.mark.parametrize("color", [255, 0])
@pytest.mark.parametrize("channels", [2, 4])
def test_alpha_of_a_mask_of_one_colour_is_the_mask(tmp_path, rgb, color, channels):
    alpha = np.array([[0, 255, 3], [0, 100, 200]], np.uint8)
    values = np.dstack([*(channels - 1) * [np.full_like(alpha, color)], alpha])
    formats = {2: rgb.Bitmap.PixelFormat.YA, 4: rgb.Bitmap.PixelFormat.RGBA}
    rgb.Bitmap(values, formats[channels]).write(str(tmp_path / "a.png"))
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png"), (2, 3)), alpha > 127)


def test_alpha_and_colour_of_a_mask(tmp_path, rgb):
    """Transparent white is left out, as is opaque black."""
    color, alpha = np.array([[255, 255, 0]], np.uint8), np.array([[255, 0, 255]], np.uint8)
    rgb.Bitmap(np.dstack([*3 * [color], alpha]), rgb.Bitmap.PixelFormat.RGBA).write(str(tmp_path / "a.png"))
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png"), (1, 3)), [[True, False, False]])


def test_a_mask_of_another_size_is_refused(tmp_path, rgb):
    rgb.Bitmap(np.zeros((2, 3), np.uint8)).write(str(tmp_path / "a.png"))
    with pytest.raises(ValueError, match="3 x 2 pixels.*4 x 4"):
        read_mask(MaskFile(tmp_path / "a.png"), (4, 4))


# EXIF orientation (where the first row and column of the stored pixels are shown) -> the stored pixel, its row and
# column, that each upright one is, for stored pixels of 2 rows and 3 columns.
UPRIGHT = {
    1: [[(0, 0), (0, 1), (0, 2)], [(1, 0), (1, 1), (1, 2)]],
    2: [[(0, 2), (0, 1), (0, 0)], [(1, 2), (1, 1), (1, 0)]],
    3: [[(1, 2), (1, 1), (1, 0)], [(0, 2), (0, 1), (0, 0)]],
    4: [[(1, 0), (1, 1), (1, 2)], [(0, 0), (0, 1), (0, 2)]],
    5: [[(0, 0), (1, 0)], [(0, 1), (1, 1)], [(0, 2), (1, 2)]],
    6: [[(1, 0), (0, 0)], [(1, 1), (0, 1)], [(1, 2), (0, 2)]],
    7: [[(1, 2), (0, 2)], [(1, 1), (0, 1)], [(1, 0), (0, 0)]],
    8: [[(0, 2), (1, 2)], [(0, 1), (1, 1)], [(0, 0), (1, 0)]],
}


def save_turned(path, values, orientation):
    """A photo whose EXIF notes say that it is to be turned."""
    image = pytest.importorskip("PIL.Image")
    notes = image.Exif()
    notes[0x0112] = orientation
    image.fromarray(values).save(path, exif=notes, quality=100)


def camera(path, shape, ignores_exif=False):
    return Frame(path.name, path, np.eye(4), {"w": shape[1], "h": shape[0]}, ignores_exif=ignores_exif)


@pytest.mark.parametrize("orientation", range(5, 9))
def test_a_turned_photo_has_the_pixels_that_its_camera_describes(tmp_path, rgb, orientation):
    """As stored, or upright, by the camera's width and height, at any size."""
    path, stored = tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (2, 3, 3)).astype(np.uint8)
    save_turned(path, stored, orientation)
    upright = np.array([[stored[at] for at in row] for row in UPRIGHT[orientation]])
    assert np.array_equal(read_photo(camera(path, (2, 3))), stored)
    assert np.array_equal(read_photo(camera(path, (3, 2))), upright)
    assert np.array_equal(read_photo(camera(path, (1200, 800), ignores_exif=True)), upright)


@pytest.mark.parametrize("orientation, shape", [(2, (2, 3)), (3, (2, 3)), (4, (2, 3)), (6, (4, 4)), (8, (4, 4))])
def test_a_turned_photo_of_which_nothing_tells_is_refused(tmp_path, rgb, orientation, shape):
    """Square, or turned by half, where width and height are equal: poses of COLMAP are of the stored pixels."""
    path, stored = tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (*shape, 3)).astype(np.uint8)
    save_turned(path, stored, orientation)
    with pytest.raises(NergError, match=f"a.png.*EXIF orientation .{orientation}.*nothing tells"):
        read_photo(camera(path, shape))
    with pytest.raises(NergError, match="nothing tells"):
        read_photo(Frame("a.png", path, np.eye(4), {"fl_x": 3.0}))
    assert np.array_equal(read_photo(camera(path, shape, ignores_exif=True)), stored)


def test_photos_that_are_not_to_be_turned(tmp_path, rgb):
    """No notes, notes of an upright photo, an orientation that there is not, damaged notes."""
    stored = np.random.default_rng(0).integers(0, 256, (4, 4, 3)).astype(np.uint8)
    rgb.Bitmap(stored).write(str(tmp_path / "a.png"))
    assert np.array_equal(read_photo(camera(tmp_path / "a.png", (4, 4))), stored)
    for orientation in (1, 0, 9):
        save_turned(tmp_path / "a.jpg", stored, orientation)
        assert read_photo(camera(tmp_path / "a.jpg", (4, 4))).shape == (4, 4, 3)
    raw = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(raw.replace(b"MM\0*", b"XX\0*").replace(b"II*\0", b"XX*\0"))
    assert read_photo(camera(tmp_path / "a.jpg", (4, 4))).shape == (4, 4, 3)
