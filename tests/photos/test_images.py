"""Loading pictures, masks and depth at a size, and splitting them."""

import json

import numpy as np
import pytest

from nerg_mi.files.images import write_bitmap_exr
from nerg_mi.photos.images import load_usable, load_view, read_image, split_holdout
from nerg_mi.photos.transforms import read_transforms
from tests.photos.written_sets import METRES_ALONG_RAYS


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


def test_pixels_are_kept_as_stored(dataset):
    folder, pictures = dataset
    views, unused = load_usable(read_transforms(folder / "transforms.json").frames, depth=True)
    assert not unused and all(v.pixels.dtype == np.uint8 for v in views)
    assert np.array_equal(np.array([v.pixels for v in views]), pictures)
    assert np.allclose(views[2].color * 255, pictures[2], atol=1e-4)
    assert views[3].depth.shape == (8, 12) and np.all(views[3].depth == 4)


@pytest.mark.parametrize("width, height", [(6, 4), (3, 2), (5, 3), (12, 8), (7, 5)])
def test_downscaling_averages_areas(dataset, width, height):
    """Against an average over a fine oversampling, colours weighted by alpha."""
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


def test_downscale_and_width_errors(dataset):
    frames = read_transforms(dataset[0] / "transforms.json").frames
    assert load_view(frames[0], downscale=4).color.shape == (2, 3, 4)
    for arguments in ({"width": 13}, {"downscale": 0.5}, {"width": 3, "downscale": 2}, {"width": 0}):
        with pytest.raises(ValueError):
            load_view(frames[0], **arguments)


def test_linear_images_become_srgb(tmp_path, rgb):
    write_bitmap_exr(tmp_path / "a.exr", rgb.Bitmap(np.full((2, 2, 3), 0.5, np.float32)))
    assert np.allclose(read_image(tmp_path / "a.exr"), 0.7354, atol=1e-3)


def test_unreadable_image_is_named(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match="a.png"):
        read_image(tmp_path / "a.png")


def test_wrong_depth_is_named(dataset):
    folder, _ = dataset
    np.save(folder / "00.npy", np.zeros((3, 3), np.float32))
    views, unused = load_usable(read_transforms(folder / "transforms.json").frames, depth=True)
    assert len(views) == 9 and unused[0].name == "00.png" and "00.npy" in unused[0].reason


def test_every_kth_of_the_sorted_frames_is_held_out(dataset):
    frames = read_transforms(dataset[0] / "transforms.json").frames
    train, held = split_holdout(frames, 4)
    assert [f.name for f in held] == ["00.png", "04.png", "08.png"]
    assert len(train) == 7 and not {f.name for f in train} & {f.name for f in held}
    assert split_holdout(frames, 0) == (frames, [])
    with pytest.raises(ValueError, match="holdout"):
        split_holdout(frames, 1)
