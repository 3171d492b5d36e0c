"""Which frames of a data set are held out, and the coordinates that are asked for."""

import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.photos.cameras import Intrinsics, pixel_directions
from nerg_mi.photos.dataset import open_dataset
from nerg_mi.photos.images import read_split
from tests.photos.written_sets import (
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


def tip(content, turn):
    """Turn all frames of a transforms file by the rotation ``turn``."""
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3] = turn @ pose[:3]
        frame["transform_matrix"] = pose.tolist()


def test_upright_coordinates_have_up_along_z(ring):
    level = open_dataset(ring, holdout=0)
    assert level.up.startswith("up is +z") and np.allclose(level.source["up"], [0, 0, 1], atol=0.02)
    turn = Rotation.from_euler("xyz", [100, -30, 70], degrees=True).as_matrix()
    rewrite(ring, lambda c: tip(c, turn))
    tipped = open_dataset(ring, holdout=0)
    assert "--coordinates upright" in tipped.up and "degrees from +z" in tipped.up
    assert np.allclose(tipped.source["up"], turn[:, 2], atol=0.02)
    data = open_dataset(ring, holdout=0, coordinates="upright")
    assert data.up.startswith("up is +z to 0.0") and np.allclose(data.source["up"], [0, 0, 1], atol=1e-5)
    back = np.array(data.source["to_file"])
    for a, b, c in zip(data.train, tipped.train, level.train):
        assert np.allclose(back @ a.camera.to_world, b.camera.to_world, atol=1e-6)
        assert np.allclose(a.camera.to_world[2], c.camera.to_world[2], atol=0.02)


def test_cameras_that_do_not_agree_on_up_say_so(ring):
    def roll(content):
        for k, frame in enumerate(content["frames"]):
            about = np.eye(4)
            about[:3, :3] = Rotation.from_euler("z", 80 * (-1) ** k * (k % 3), degrees=True).as_matrix()
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ about).tolist()

    rewrite(ring, roll)
    data = open_dataset(ring, holdout=0)
    assert data.up.startswith("the cameras do not agree") and "up" not in data.source
    with pytest.raises(NergError, match='"file"'):
        open_dataset(ring, holdout=0, coordinates="upright")


def test_held_out_frames_of_a_file_of_their_own_are_turned_alike(ring):
    turn = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    rewrite(ring, lambda c: tip(c, turn))
    content = json.loads((ring / "transforms.json").read_text())
    test = {**content, "frames": content["frames"][6:]}
    (ring / "transforms_test.json").write_text(json.dumps(test))
    data = open_dataset(ring, coordinates="upright")
    whole = open_dataset(ring, holdout=0, coordinates="upright")
    everywhere = {v.name: v.camera.to_world for v in whole.train}
    assert len(data.held_out) == 3
    for view in [*data.train, *data.held_out]:
        assert np.allclose(view.camera.to_world, everywhere[view.name], atol=1e-6)


@pytest.mark.parametrize("write", [instant_ngp, colmap_bin, colmap_txt])
def test_what_a_capture_holds_and_is_not_used_is_named_once(tmp_path, rgb, monkeypatch, write):
    """Photos without a pose, counted; other files and folders of the capture; not those that are used."""
    write(tmp_path, rgb, OPENCV)
    assert read_split(tmp_path).posed.notes == []
    for name in ("images/new.png", "images/other.JPG", "images/notes.txt", "images/.hidden.png", "mesh.ply", ".cache"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "images_2").mkdir()
    monkeypatch.chdir(tmp_path.parent)
    assert read_split(tmp_path.name).posed.notes == read_split(tmp_path).posed.notes
    stray, rest = read_split(tmp_path).posed.notes
    assert stray.startswith("2 of 11 photos have no pose") and stray.endswith("new.png, other.JPG")
    assert rest == f'not used of "{tmp_path.name}": images_2, mesh.ply'


def test_files_of_frames_and_of_held_out_frames_are_no_leftovers(ring):
    content = json.loads((ring / "transforms.json").read_text())
    frames = content["frames"]
    for k, f in enumerate(frames):
        f["mask_path"], f["depth_file_path"] = f"images/mask_{k}.png", f"images/depth_{k}.png"
        for key in ("mask_path", "depth_file_path"):
            (ring / f[key]).write_bytes(b"")
    (ring / "transforms.json").write_text(json.dumps({**content, "frames": frames[:6]}))
    (ring / "transforms_test.json").write_text(json.dumps({**content, "frames": frames[6:]}))
    assert read_split(ring).posed.notes == []


def test_models_that_are_not_used_are_named(tmp_path, rgb):
    colmap_bin(tmp_path, rgb, OPENCV)
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "sparse/1")
    assert any("of 2 COLMAP models" in note for note in read_split(tmp_path).posed.notes)


def test_photos_of_another_camera_without_any_pose_are_counted(tmp_path, rgb):
    """COLMAP keeps the photos of each camera in a folder of its own."""
    colmap_bin(tmp_path, rgb, OPENCV)
    (tmp_path / "images/right").mkdir()
    for k in range(9):
        (tmp_path / f"images/right/{k}.jpg").write_bytes(b"")
    (note,) = read_split(tmp_path).posed.notes
    assert note.startswith("9 of 18 photos have no pose") and note.endswith(
        "0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg and 4 more"
    )
