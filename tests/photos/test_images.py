"""Tests of `nerg_mi.photos.images`."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.files.images import write_bitmap_exr, write_exr
from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions
from nerg_mi.photos.dataset import open_dataset
from nerg_mi.photos.images import (
    PhotoView,
    apply_lens,
    load_usable_views,
    load_view,
    make_pinhole_camera,
    read_depth,
    read_image,
    read_mask,
    read_photo,
    read_split,
    split_holdout,
    undistort_photo,
)
from nerg_mi.photos.photo_set import Photos
from nerg_mi.photos.posed import DepthFile, MaskFile, PosedFrame
from nerg_mi.photos.transforms import read_transforms
from tests.photos.written_sets import (
    COUNT,
    METRES_ALONG_RAYS,
    OPENCV,
    H,
    W,
    cameras,
    colmap_bin,
    colmap_txt,
    expected_rays,
    instant_ngp,
    nerfstudio,
    opengl,
    picture,
    rewrite,
)

# ---- Loading of images, masks and depth at a size, and the split ----


@pytest.fixture
def dataset(tmp_path, rgb):
    """Ten frames of 12 x 8 pixels, RGBA, with depth."""
    rng = np.random.default_rng(0)
    frames, pictures = [], []
    for k in range(10):
        picture = rng.integers(1, 256, (8, 12, 4), np.uint8)
        rgb.Bitmap(picture, rgb.Bitmap.PixelFormat.RGBA).write(str(tmp_path / f"{k:02d}.png"))
        np.save(tmp_path / f"{k:02d}.npy", np.full((8, 12), k + 1.0, np.float32))
        pose = np.eye(4)
        pose[0, 3] = k
        frames.append(
            {"file_path": f"{k:02d}.png", "transform_matrix": pose.tolist(), "depth_file_path": f"{k:02d}.npy"}
        )
        pictures.append(picture)
    content = {
        "w": 12.0,
        "h": 8.0,
        "fl_x": 10.0,
        **METRES_ALONG_RAYS,
        "aabb": [[0, 0, 0], [8, 4, 2]],
        "frames": frames[::-1],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    return tmp_path, np.array(pictures)


def test_pixels_are_unchanged(dataset):
    folder, pictures = dataset
    views, unused = load_usable_views(read_transforms(folder / "transforms.json").frames, depth=True)
    assert not unused and all(v.pixels.dtype == np.uint8 for v in views)
    assert np.array_equal(np.array([v.pixels for v in views]), pictures)
    assert np.allclose(views[2].color * 255, pictures[2], atol=1e-4)
    assert views[3].depth.shape == (8, 12) and np.all(views[3].depth == 4)


@pytest.mark.parametrize("width, height", [(6, 4), (3, 2), (5, 3), (12, 8), (7, 5)])
def test_downscaling_averages_areas(dataset, width, height):
    """Compared with the average of a fine oversampling, with colours weighted by alpha."""
    folder, pictures = dataset
    view = load_view(read_transforms(folder / "transforms.json").frames[0], width=width)
    rgba = pictures[0] / 255.0
    rgba[..., :3] *= rgba[..., 3:]
    fine = np.repeat(np.repeat(rgba, height, axis=0), width, axis=1)
    mean = fine.reshape(height, 8, width, 12, 4).mean(axis=(1, 3))
    mean[..., :3] /= mean[..., 3:]
    assert view.color.shape == (height, width, 4)
    assert np.allclose(view.color, mean, atol=1e-5)
    assert view.camera.intrinsics.fx == pytest.approx(10 * width / 12)


def test_invalid_widths_are_refused(dataset):
    frames = read_transforms(dataset[0] / "transforms.json").frames
    assert load_view(frames[0], width=3).color.shape == (2, 3, 4)
    for width in (13, 0):
        with pytest.raises(NergError):
            load_view(frames[0], width)


def test_invalid_depth_error_names_file(dataset):
    folder, _ = dataset
    np.save(folder / "00.npy", np.zeros((3, 3), np.float32))
    views, unused = load_usable_views(read_transforms(folder / "transforms.json").frames, depth=True)
    assert len(views) == 9 and unused[0].name == "00.png" and "00.npy" in unused[0].reason


def test_photos_are_objects(ring):
    loaded = Photos.load(ring)
    assert Photos.open(loaded) is loaded and len(loaded) == COUNT
    frame = loaded.to_dataframe("pandas")
    assert frame["photo"].tolist() == [f.name for f in loaded.frames]
    poses = np.stack([f.to_world for f in loaded.frames])
    np.testing.assert_array_equal(frame[["x", "y", "z"]], poses[:, :3, 3])
    np.testing.assert_array_equal(frame[["dx", "dy", "dz"]], -poses[:, :3, 2])
    # Photos in memory and their folder are the same data set, with the same held-out views.
    ours, files = read_split(loaded), read_split(ring)
    assert [f.name for f in ours.held_out] == [f.name for f in files.held_out] and ours.rule == files.rule
    moved = read_split(loaded.transform(np.diag([2.0, 2, 2, 1])))
    np.testing.assert_allclose(moved.posed.centers, 2 * files.posed.centers)


def test_every_kth_of_the_sorted_frames_is_held_out(dataset):
    frames = read_transforms(dataset[0] / "transforms.json").frames
    train, held = split_holdout(frames, 4)
    assert [f.name for f in held] == ["00.png", "04.png", "08.png"]
    assert len(train) == 7 and not {f.name for f in train} & {f.name for f in held}
    assert split_holdout(frames, 0) == (frames, [])
    with pytest.raises(ValueError, match="holdout"):
        split_holdout(frames, 1)


# ---- Images, depth and masks in all file formats, with known values ----


def to_srgb(x):
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_is_unchanged(tmp_path, rgb, dtype, channels):
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


def test_colour_of_multilayer_exr(tmp_path):
    import OpenEXR

    values = {k: np.full((2, 3), v, np.float32) for k, v in {"R": 0.1, "G": 0.2, "B": 0.3, "depth.T": 7.0}.items()}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, dict(values)) as file:
        file.write(str(tmp_path / "a.exr"))
    assert np.allclose(read_image(tmp_path / "a.exr"), to_srgb(np.array([0.1, 0.2, 0.3])), atol=1e-3)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"depth.T": values["depth.T"], "x.Y": values["R"]}) as file:
        file.write(str(tmp_path / "b.exr"))
    with pytest.raises(ValueError, match="b.exr.*R, G and B"):
        read_image(tmp_path / "b.exr")


def test_unreadable_image_errors_name_file(tmp_path, rgb):
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
def test_depth_channel_of_exr_is_selected_by_name(tmp_path, names):
    rng, depth = np.random.default_rng(0), np.full((2, 3), 2.5, np.float32)
    grey = list(names) == ["R", "G", "B"]
    channels = {n: depth if grey or n == names[-1] else rng.random((2, 3)).astype(np.float32) for n in names}
    write_exr(tmp_path / "a.exr", channels)
    assert np.array_equal(read_depth(DepthFile(tmp_path / "a.exr")), depth)
    write_exr(tmp_path / "b.exr", {n: rng.random((2, 3)).astype(np.float32) for n in "RGB"})
    with pytest.raises(NergError, match="b.exr"):
        read_depth(DepthFile(tmp_path / "b.exr"))


def test_negative_depth_is_refused(tmp_path):
    path = tmp_path / "d.npy"
    np.save(path, -np.arange(6.0).reshape(2, 3))
    with pytest.raises(NergError, match="d.npy.*negative.*negate"):
        read_depth(DepthFile(path, 1.0))
    np.save(path, np.full((2, 3), -1.0))
    assert not read_depth(DepthFile(path, 1.0)).any()  # a value for unknown depth


def test_unreadable_depth_error_names_file(tmp_path, rgb):
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
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png", is_inverted=True), (2, 3)), ~white)
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
def test_alpha_of_uniform_mask_is_mask(tmp_path, rgb, color, channels):
    alpha = np.array([[0, 255, 3], [0, 100, 200]], np.uint8)
    values = np.dstack([*(channels - 1) * [np.full_like(alpha, color)], alpha])
    formats = {2: rgb.Bitmap.PixelFormat.YA, 4: rgb.Bitmap.PixelFormat.RGBA}
    rgb.Bitmap(values, formats[channels]).write(str(tmp_path / "a.png"))
    assert np.array_equal(read_mask(MaskFile(tmp_path / "a.png"), (2, 3)), alpha > 127)
    with pytest.raises(ValueError, match="3 x 2 pixels.*4 x 4"):
        read_mask(MaskFile(tmp_path / "a.png"), (4, 4))
    if channels == 4 and color:
        # Transparent white is excluded, as is opaque black.
        mixed = np.array([[[255, 255, 255, 255], [255, 255, 255, 0], [0, 0, 0, 255]]], np.uint8)
        rgb.Bitmap(mixed, formats[4]).write(str(tmp_path / "b.png"))
        assert np.array_equal(read_mask(MaskFile(tmp_path / "b.png"), (1, 3)), [[True, False, False]])


# EXIF orientation -> row and column of the stored pixel for each upright pixel, with 2 rows and 3 columns stored.
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


def save_with_orientation(path, values, orientation):
    """Save a photo with an EXIF orientation."""
    image = pytest.importorskip("PIL.Image")
    notes = image.Exif()
    notes[0x0112] = orientation
    image.fromarray(values).save(path, exif=notes, quality=100)


def camera(path, shape, ignores_exif=False):
    return PosedFrame(path.name, path, np.eye(4), {"w": shape[1], "h": shape[0]}, ignores_exif=ignores_exif)


@pytest.mark.parametrize("orientation", range(5, 9))
def test_rotated_photo_matches_its_camera(tmp_path, rgb, orientation):
    """As stored, or upright, depending on the camera's width and height, at any size."""
    path, stored = tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (2, 3, 3)).astype(np.uint8)
    save_with_orientation(path, stored, orientation)
    upright = np.array([[stored[at] for at in row] for row in UPRIGHT[orientation]])
    assert np.array_equal(read_photo(camera(path, (2, 3))), stored)
    assert np.array_equal(read_photo(camera(path, (3, 2))), upright)
    assert np.array_equal(read_photo(camera(path, (1200, 800), ignores_exif=True)), upright)


@pytest.mark.parametrize("orientation, shape", [(2, (2, 3)), (3, (2, 3)), (4, (2, 3)), (6, (4, 4)), (8, (4, 4))])
def test_ambiguous_orientation_is_refused(tmp_path, rgb, orientation, shape):
    """Square photos, or rotations by 180 degrees, where the shape does not change. COLMAP poses refer to the
    stored pixels.
    """
    path, stored = tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (*shape, 3)).astype(np.uint8)
    save_with_orientation(path, stored, orientation)
    with pytest.raises(NergError, match=f"a.png.*EXIF orientation {orientation}.*it is unknown"):
        read_photo(camera(path, shape))
    with pytest.raises(NergError, match="it is unknown"):
        read_photo(PosedFrame("a.png", path, np.eye(4), {"fl_x": 3.0}))
    assert np.array_equal(read_photo(camera(path, shape, ignores_exif=True)), stored)


def test_photos_without_rotation(tmp_path, rgb):
    """No EXIF data, an upright photo, an invalid orientation, damaged EXIF data."""
    stored = np.random.default_rng(0).integers(0, 256, (4, 4, 3)).astype(np.uint8)
    rgb.Bitmap(stored).write(str(tmp_path / "a.png"))
    assert np.array_equal(read_photo(camera(tmp_path / "a.png", (4, 4))), stored)
    for orientation in (1, 0, 9):
        save_with_orientation(tmp_path / "a.jpg", stored, orientation)
        assert read_photo(camera(tmp_path / "a.jpg", (4, 4))).shape == (4, 4, 3)
    raw = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(raw.replace(b"MM\0*", b"XX\0*").replace(b"II*\0", b"XX*\0"))
    assert read_photo(camera(tmp_path / "a.jpg", (4, 4))).shape == (4, 4, 3)


# ---- Held-out frames of a data set, and coordinates ----


def test_blender_style_folders_keep_their_split(tmp_path, rgb):
    """Omitted suffixes, RGBA, the lens as an angle, and one file per subset."""
    parts = {"train": range(5), "val": range(5, 6), "test": range(6, 9)}
    angle = 0.9
    for part, numbers in parts.items():
        (tmp_path / part).mkdir()
        frames = []
        for k in numbers:
            rgba = np.dstack([picture(k), np.full((H, W), 40 * (k % 6), np.uint8)])
            rgb.Bitmap(rgba, rgb.Bitmap.PixelFormat.RGBA).write(str(tmp_path / part / f"r_{k}.png"))
            frames.append(
                {"file_path": f"./{part}/r_{k}", "rotation": 0.1, "transform_matrix": opengl(cameras()[k]).tolist()}
            )
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    data = open_dataset(tmp_path)
    assert [v.name for v in data.train] == [f"./train/r_{k}" for k in range(5)]
    assert [v.name for v in data.held_out] == [f"./test/r_{k}" for k in range(6, 9)]
    assert (
        data.source["held_out"]["how"] == "transforms_test.json"
        and data.box_source == "the region that all views share"
    )
    plain = Intrinsics(W, H, *2 * [W / 2 / np.tan(angle / 2)], W / 2, H / 2)
    for view, k in zip(data.train, parts["train"]):
        _, d = expected_rays(plain, cameras()[k])
        assert np.abs(pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T - d).max() < 1e-6
        assert np.array_equal(view.pixels[..., 3], np.full((H, W), 40 * (k % 6)))
    (tmp_path / "transforms_test.json").unlink()
    assert open_dataset(tmp_path).source["held_out"]["how"] == "transforms_val.json"


def test_frames_held_out_are_never_trained_on(ring):
    """Frames that a test file shares with the training file are removed from the latter."""
    content = json.loads((ring / "transforms.json").read_text())
    (ring / "transforms_test.json").write_text(json.dumps({**content, "frames": content["frames"][:2]}))
    data = open_dataset(ring)
    assert (len(data.train), len(data.held_out)) == (7, 2)
    assert not {v.name for v in data.train} & {v.name for v in data.held_out}
    assert sum("held out" in u.reason for u in data.unused) == 2
    assert [v.name for v in open_dataset(ring, holdout=5).held_out] == ["./images/0.png", "./images/5.png"]


def test_lists_of_file_names_split(ring):
    rewrite(
        ring, lambda c: c.update(train_filenames=[f"images/{k}.png" for k in range(5)], test_filenames=["images/8.png"])
    )
    data = open_dataset(ring)
    assert (len(data.train), [v.name for v in data.held_out]) == (5, ["./images/8.png"])
    assert "3 frames" in data.notes[0]


def test_coordinates_of_a_nerfstudio_training(tmp_path, rgb):
    """dataparser_transforms.json starts from the original coordinates, not from those of transforms.json."""
    nerfstudio(tmp_path, rgb, OPENCV)
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(json.dumps({"transform": np.column_stack([turn, [1, 2, 3]]).tolist(), "scale": 0.25}))
    data = open_dataset(tmp_path, holdout=0, coordinates=str(path))
    for view, pose in zip(data.train, cameras()):
        assert np.allclose(view.camera.center, 0.25 * (turn @ pose[:, 3] + [1, 2, 3]))
        assert np.allclose(view.camera.to_world[:3, :3], turn @ opengl(pose)[:3, :3])


def tilt(content, turn):
    """Rotate all frames of a transforms file by the rotation ``turn``."""
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3] = turn @ pose[:3]
        frame["transform_matrix"] = pose.tolist()


def test_upright_coordinates_have_up_along_z(ring):
    level = open_dataset(ring, holdout=0)
    assert level.up_note.startswith("up is +z") and np.allclose(level.source["up"], [0, 0, 1], atol=0.02)
    turn = Rotation.from_euler("xyz", [100, -30, 70], degrees=True).as_matrix()
    rewrite(ring, lambda c: tilt(c, turn))
    tipped = open_dataset(ring, holdout=0)
    assert "upright" in tipped.up_note and "degrees from +z" in tipped.up_note
    assert np.allclose(tipped.source["up"], turn[:, 2], atol=0.02)
    data = open_dataset(ring, holdout=0, coordinates="upright")
    assert data.up_note.startswith("up is +z to 0.0") and np.allclose(data.source["up"], [0, 0, 1], atol=1e-5)
    back = np.array(data.source["to_file"])
    for a, b, c in zip(data.train, tipped.train, level.train):
        assert np.allclose(back @ a.camera.to_world, b.camera.to_world, atol=1e-6)
        assert np.allclose(a.camera.to_world[2], c.camera.to_world[2], atol=0.02)


def test_disagreeing_cameras_are_refused(ring):
    def roll(content):
        for k, frame in enumerate(content["frames"]):
            axis = np.eye(4)
            axis[:3, :3] = Rotation.from_euler("z", 80 * (-1) ** k * (k % 3), degrees=True).as_matrix()
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ axis).tolist()

    rewrite(ring, roll)
    data = open_dataset(ring, holdout=0)
    assert data.up_note.startswith("the cameras do not agree") and "up" not in data.source
    with pytest.raises(NergError, match='"file"'):
        open_dataset(ring, holdout=0, coordinates="upright")


def test_separate_held_out_frames_are_rotated_too(ring):
    turn = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    rewrite(ring, lambda c: tilt(c, turn))
    content = json.loads((ring / "transforms.json").read_text())
    test = {**content, "frames": content["frames"][6:]}
    (ring / "transforms_test.json").write_text(json.dumps(test))
    data = open_dataset(ring, coordinates="upright")
    split = open_dataset(ring, holdout=0, coordinates="upright")
    everywhere = {v.name: v.camera.to_world for v in split.train}
    assert len(data.held_out) == 3
    for view in [*data.train, *data.held_out]:
        assert np.allclose(view.camera.to_world, everywhere[view.name], atol=1e-6)


@pytest.mark.parametrize("write", [instant_ngp, colmap_bin, colmap_txt])
def test_unused_files_are_noted_once(tmp_path, rgb, monkeypatch, write):
    """The number of photos without a pose, and other files and folders of the capture, but not used ones."""
    write(tmp_path, rgb, OPENCV)
    assert read_split(tmp_path).posed.notes == []
    for name in ("images/new.png", "images/other.JPG", "images/notes.txt", "images/.hidden.png", "mesh.ply", ".cache"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "images_2").mkdir()
    if write is colmap_bin:
        # COLMAP uses one folder of photos per camera, and separate folders for models that were not merged.
        (tmp_path / "images/right").mkdir()
        (tmp_path / "images/right/z.jpg").write_bytes(b"")
        shutil.copytree(tmp_path / "sparse/0", tmp_path / "sparse/1")
    monkeypatch.chdir(tmp_path.parent)
    assert read_split(tmp_path.name).posed.notes == read_split(tmp_path).posed.notes
    *models, stray, rest = read_split(tmp_path).posed.notes
    extra, names = (1, "new.png, other.JPG, z.jpg") if write is colmap_bin else (0, "new.png, other.JPG")
    assert stray.startswith(f"{2 + extra} of {11 + extra} photos have no pose") and stray.endswith(names)
    assert ["of 2 COLMAP models" in note for note in models] == [True] * extra
    assert rest == f'unused in "{tmp_path.name}": images_2, mesh.ply'


def test_used_files_are_not_noted(ring):
    content = json.loads((ring / "transforms.json").read_text())
    frames = content["frames"]
    for k, f in enumerate(frames):
        f["mask_path"], f["depth_file_path"] = f"images/mask_{k}.png", f"images/depth_{k}.png"
        for key in ("mask_path", "depth_file_path"):
            (ring / f[key]).write_bytes(b"")
    (ring / "transforms.json").write_text(json.dumps({**content, "frames": frames[:6]}))
    (ring / "transforms_test.json").write_text(json.dumps({**content, "frames": frames[6:]}))
    assert read_split(ring).posed.notes == []


@pytest.mark.parametrize("name", [".", "..", "images", "images/.", "images/..", "", "/", "no/../1.png"])
def test_folder_is_not_a_photo(ring, name):
    content = json.loads((ring / "transforms.json").read_text())
    content["frames"][0]["file_path"] = name
    (ring / "transforms.json").write_text(json.dumps(content))
    assert len(read_split(ring).posed.unused) == 1


# ---- Undistorted photos and distorted renderings, compared with a smooth sky that is known in all directions ----

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


def picture_undistort(intrinsics):
    return sky(pixel_directions(intrinsics) @ POSE[:3, :3].T).astype(np.float32)


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_photo_matches_its_sensor(name, rgb):
    """The directions are those of the sensor, not computed by the tested module."""
    i = LENSES[name]
    image, mask, sensor = undistort_photo(PhotoView("a", PosedCamera(i, POSE), picture_undistort(i)))
    rays = rgb.load_dict(sensor)
    x, y = np.meshgrid((np.arange(90) + 0.5) / 90, (np.arange(70) + 0.5) / 70)
    ray, _ = rays.sample_ray(0.0, 0.5, rgb.Point2f(x.ravel(), y.ravel()), rgb.Point2f(0.5, 0.5))
    expected = sky(ray.d.numpy().T.reshape(70, 90, 3))
    assert mask.mean() > 0.9 and image.shape == (70, 90, 3)
    assert np.abs(image - expected)[mask].max() < 1e-3
    assert np.all(image[~mask] == 0)


def test_photo_without_distortion_is_unchanged():
    photo = picture_undistort(PLAIN)
    image, mask, sensor = undistort_photo(PhotoView("a", PosedCamera(PLAIN, POSE), photo))
    assert np.array_equal(image, photo) and mask.all() and sensor["film"]["width"] == 90


def test_invisible_pixels_are_masked():
    """A pincushion photo shows less than a pinhole image of its size; the mask is compared pixel by pixel."""
    i = replace(PLAIN, k1=0.3)
    _, mask, _ = undistort_photo(PhotoView("a", PosedCamera(i, POSE), picture_undistort(i)))
    d = pixel_directions(PLAIN)
    x, y = d[..., 0] / -d[..., 2], d[..., 1] / d[..., 2]
    grow = 1 + 0.3 * (x * x + y * y)
    u, v = 80 * x * grow + 44, 80 * y * grow + 36.5
    expected = (u >= 0.5) & (u <= 89.5) & (v >= 0.5) & (v <= 69.5)
    assert np.array_equal(mask, expected) and 0.5 < mask.mean() < 0.95


def test_transparent_pixels_do_not_bleed():
    i = LENSES["barrel"]
    color = np.concatenate([picture_undistort(i), np.ones((70, 90, 1), np.float32)], axis=2)
    color[:, 45:] = [1, 0, 1, 0]
    image, mask, _ = undistort_photo(PhotoView("a", PosedCamera(i, POSE), color))
    clear = mask & (image[..., 3] > 0.5)
    plain = undistort_photo(PhotoView("a", PosedCamera(i, POSE), picture_undistort(i))).image
    assert np.abs(image[..., :3] - plain)[clear].max() < 0.15
    assert np.all(image[..., 3][:, 50:] < 0.3)


@pytest.mark.parametrize("name", LENSES)
def test_distorted_rendering_equals_photo(name):
    i = LENSES[name]
    camera = PosedCamera(i, POSE)
    source = make_pinhole_camera(camera, oversample=2.0)
    bent, mask = apply_lens(picture_undistort(source.intrinsics), source, camera)
    assert mask.all() and bent.shape == (70, 90, 3)
    assert np.abs(bent - picture_undistort(i)).max() < 1e-3


def test_wide_fisheye_is_covered_up_to_pinhole_limit():
    i = Intrinsics(80, 80, 26.0, 26.0, 40.0, 40.0, fisheye=True)
    camera = PosedCamera(i, POSE)
    source = make_pinhole_camera(camera)
    bent, mask = apply_lens(picture_undistort(source.intrinsics), source, camera)
    angle = np.degrees(np.arccos(-pixel_directions(i)[..., 2]))
    assert np.all(mask[angle < 75]) and not np.any(mask[angle > 88])
    assert np.abs(bent - picture_undistort(i))[angle < 75].max() < 5e-3


def test_apply_lens_errors():
    camera = PosedCamera(LENSES["barrel"], POSE)
    source = make_pinhole_camera(camera)
    with pytest.raises(ValueError, match="pixels"):
        apply_lens(np.zeros((3, 3, 3)), source, camera)
    with pytest.raises(ValueError, match="same pose"):
        apply_lens(picture_undistort(source.intrinsics), source, PosedCamera(LENSES["barrel"], np.eye(4)))
