"""Loading pictures at a size, splitting them, and finding the scene box."""
import json

import numpy as np
import pytest

from nerg_mi.capture.bounds import scene_box
from nerg_mi.capture.cameras import Camera
from nerg_mi.capture.dataset import open_dataset
from nerg_mi.capture.images import load_views, read_image, split_holdout
from nerg_mi.formats.transforms import Intrinsics, read_transforms


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
        frames.append({"file_path": f"{k:02d}.png", "transform_matrix": pose.tolist(), "depth_file_path": f"{k:02d}.npy"})
        pictures.append(picture)
    content = {"w": 12.0, "h": 8.0, "fl_x": 10.0, "aabb": [[0, 0, 0], [8, 4, 2]], "frames": frames[::-1]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    return tmp_path, np.array(pictures)


def test_pixels_are_kept_as_stored(dataset):
    folder, pictures = dataset
    views = load_views(read_transforms(folder).frames, depth=True)
    assert np.allclose(np.array([v.color for v in views]) * 255, pictures, atol=1e-3)
    assert views[3].depth.shape == (8, 12) and np.all(views[3].depth == 4)


@pytest.mark.parametrize("width, height", [(6, 4), (3, 2), (5, 3), (12, 8), (7, 5)])
def test_downscaling_averages_areas(dataset, width, height):
    """Against an average over a fine oversampling, colours weighted by alpha."""
    folder, pictures = dataset
    view = load_views(read_transforms(folder).frames[:1], width=width)[0]
    rgba = pictures[0] / 255.0
    rgba[..., :3] *= rgba[..., 3:]
    fine = np.repeat(np.repeat(rgba, height, axis=0), width, axis=1)
    mean = fine.reshape(height, 8, width, 12, 4).mean(axis=(1, 3))
    mean[..., :3] /= mean[..., 3:]
    assert view.color.shape == (height, width, 4)
    assert np.allclose(view.color, mean, atol=1e-5)
    assert view.camera.intrinsics.fx == pytest.approx(10 * width / 12)


def test_downscale_and_width_errors(dataset):
    frames = read_transforms(dataset[0]).frames
    assert load_views(frames[:1], downscale=4)[0].color.shape == (2, 3, 4)
    for arguments in ({"width": 13}, {"downscale": 0.5}, {"width": 3, "downscale": 2}, {"width": 0}):
        with pytest.raises(ValueError):
            load_views(frames, **arguments)


def test_linear_images_become_srgb(tmp_path, rgb):
    rgb.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write(str(tmp_path / "a.exr"))
    assert np.allclose(read_image(tmp_path / "a.exr"), 0.7354, atol=1e-3)


def test_unreadable_image_is_named(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match="a.png"):
        read_image(tmp_path / "a.png")


def test_wrong_depth_is_named(dataset):
    folder, _ = dataset
    np.save(folder / "00.npy", np.zeros((3, 3), np.float32))
    with pytest.raises(ValueError, match="00.npy"):
        load_views(read_transforms(folder).frames, depth=True)


def test_every_kth_of_the_sorted_frames_is_held_out(dataset):
    frames = read_transforms(dataset[0]).frames
    train, held = split_holdout(frames, 4)
    assert [f.name for f in held] == ["00.png", "04.png", "08.png"]
    assert len(train) == 7 and not {f.name for f in train} & {f.name for f in held}
    assert split_holdout(frames, 0) == (frames, [])
    with pytest.raises(ValueError, match="holdout"):
        split_holdout(frames, 1)


def test_dataset_records_its_split_and_box(dataset):
    data = open_dataset(dataset[0], holdout=5)
    assert data.source["held_out"]["frames"] == ["00.png", "05.png"]
    assert len(data.source["sha256"]) == 64
    assert np.allclose(data.box.lower, -0.1) and np.allclose(data.box.upper, [8.1, 4.1, 2.1])
    given = open_dataset(dataset[0], aabb=(0, 0, 0, 1, 1, 1))
    assert np.allclose(given.box.side, 1.025)


def test_own_test_frames_are_held_out(dataset):
    folder, _ = dataset
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms_test.json").write_text(json.dumps({**content, "frames": content["frames"][:2]}))
    data = open_dataset(folder)
    assert (len(data.train), len(data.held_out)) == (10, 2)
    assert len(open_dataset(folder, holdout=5).train) == 8


def looking(center, at):
    z = np.subtract(center, at) / np.linalg.norm(np.subtract(center, at))
    x = np.cross([0, 0.3, 1.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), center
    return Camera(Intrinsics(10, 10, 10.0, 10.0, 5.0, 5.0), pose)


def test_scene_box_around_an_object_and_in_a_room():
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    around = [looking(np.array([1, 2, 3]) + 4 * d, [1, 2, 3]) for d in directions]
    box, _ = scene_box(around)
    assert np.allclose(box.center, [1, 2, 3], atol=1e-6) and box.side == pytest.approx(10)
    assert scene_box(around, object_only=True)[0].side == pytest.approx(4)
    inside = [looking(c, c + d) for c, d in zip(rng.uniform(0, 4, (20, 3)), directions)]
    box, how = scene_box(inside)
    assert "around the cameras" in how
    assert np.all(np.array(box.lower) < 0) and np.all(np.array(box.upper) > 4)
