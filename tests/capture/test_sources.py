"""Which frames of a data set are held out, and the coordinates that are asked for."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.capture.cameras import pixel_directions
from nerg_mi.capture.dataset import open_dataset
from nerg_mi.capture.intrinsics import Intrinsics
from tests.capture.written_sets import OPENCV, H, W, cameras, expected_rays, nerfstudio, opengl, picture, rewrite


def test_blender_style_folders_keep_their_split(tmp_path, rgb):
    """Suffixes left out, RGBA, an angle for a lens, and three files that name the parts."""
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
        data.source["held_out"]["how"] == "transforms_test.json" and data.box_from == "the region that the views share"
    )
    plain = Intrinsics(W, H, *2 * [W / 2 / np.tan(angle / 2)], W / 2, H / 2)
    for view, k in zip(data.train, parts["train"]):
        _, d = expected_rays(plain, cameras()[k])
        assert np.abs(pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T - d).max() < 1e-6
        assert np.array_equal(view.pixels[..., 3], np.full((H, W), 40 * (k % 6)))
    (tmp_path / "transforms_test.json").unlink()
    assert open_dataset(tmp_path).source["held_out"]["how"] == "transforms_val.json"


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="COLMAP"):
        open_dataset(tmp_path)


def test_frames_held_out_are_never_trained_on(ring):
    """A test file that repeats frames of the training file takes them away from it."""
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
    """dataparser_transforms.json goes from the original coordinates, not from those of transforms.json."""
    nerfstudio(tmp_path, rgb, OPENCV)
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(json.dumps({"transform": np.column_stack([turn, [1, 2, 3]]).tolist(), "scale": 0.25}))
    data = open_dataset(tmp_path, holdout=0, coordinates=str(path))
    for view, pose in zip(data.train, cameras()):
        assert np.allclose(view.camera.center, 0.25 * (turn @ pose[:, 3] + [1, 2, 3]))
        assert np.allclose(view.camera.to_world[:3, :3], turn @ opengl(pose)[:3, :3])
