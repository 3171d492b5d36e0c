"""Reading transforms files: what is understood, what is listed, what is refused."""
import json

import numpy as np
import pytest

from nerg_mi.formats.transforms import read_transforms

POSE = np.eye(4).tolist()


@pytest.fixture
def write(tmp_path):
    """`write(content, images)`: a transforms file beside empty files of the names given."""

    def make(content, images=("b.png", "a.png"), name="transforms.json"):
        for image in images:
            (tmp_path / image).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / image).write_bytes(b"")
        (tmp_path / name).write_text(json.dumps(content))
        return tmp_path

    return make


def frame(name, **keys):
    return {"file_path": name, "transform_matrix": POSE, **keys}


def test_shared_intrinsics_prefer_the_focal_length(write):
    t = read_transforms(write({"w": 20.0, "h": 10.0, "fl_x": 30.0, "camera_angle_x": 1.0, "cx": 9.0, "k1": 0.1,
                               "frames": [frame("b.png"), frame("a.png")]}))
    assert [f.name for f in t.frames] == ["a.png", "b.png"]
    i = t.frames[0].intrinsics(20, 10)
    assert (i.fx, i.fy, i.cx, i.cy, i.distortion[:4]) == (30.0, 30.0, 9.0, 5.0, (0.1, 0, 0, 0))
    half = t.frames[0].intrinsics(10, 5)
    assert (half.fx, half.cx, half.width) == (15.0, 4.5, 10)


def test_intrinsics_of_a_frame_overrule_shared_ones(write):
    t = read_transforms(write({"fl_x": 30.0, "frames": [frame("a.png", fl_x=40.0), frame("b.png")]}))
    assert [f.intrinsics(8, 8).fx for f in t.frames] == [40.0, 30.0]


def test_blender_style(write):
    folder = write({"camera_angle_x": np.pi / 2, "frames": [frame("./train/r_0")]}, ["train/r_0.png"], "transforms_train.json")
    t = read_transforms(folder)
    assert t.frames[0].image.name == "r_0.png"
    assert np.isclose(t.frames[0].intrinsics(800, 800).fx, 400)


def test_missing_images_are_listed(write):
    t = read_transforms(write({"fl_x": 1.0, "frames": [frame("a.png"), frame("gone.png")]}))
    assert len(t.frames) == 1 and t.missing == ["gone.png"]


def test_scene_box(write):
    content = {"fl_x": 1.0, "aabb": [[0, 0, 0], [1, 2, 3]], "frames": [frame("a.png")]}
    assert np.array_equal(read_transforms(write(content)).aabb, [[0, 0, 0], [1, 2, 3]])


def mirrored():
    return np.diag([-1.0, 1, 1, 1]).tolist()


@pytest.mark.parametrize(
    "content, message",
    [
        ({"frames": [frame("gone.png")], "fl_x": 1.0}, "gone.png"),
        ({"fl_x": 1.0}, '"frames"'),
        ({"fl_x": 1.0, "frames": [{"transform_matrix": POSE}]}, "frame 0"),
        ({"fl_x": 1.0, "frames": [{"file_path": "a.png"}]}, "a.png"),
        ({"fl_x": 1.0, "frames": [{"file_path": "a.png", "transform_matrix": mirrored()}]}, "a.png.*mirrored"),
        ({"fl_x": 1.0, "camera_model": "OPENCV_FISHEYE", "frames": [frame("a.png")]}, "OPENCV_FISHEYE"),
        ({"fl_x": 1.0, "frames": [frame("a.png", depth_file_path="d.npy")]}, "d.npy"),
        ({"fl_x": 1.0, "aabb": [[0, 0, 0], [1, 0, 1]], "frames": [frame("a.png")]}, "aabb"),
    ],
)
def test_bad_files_are_named(write, content, message):
    with pytest.raises(ValueError, match=message):
        read_transforms(write(content))


def test_bad_intrinsics_name_the_frame(write):
    t = read_transforms(write({"frames": [frame("a.png")]}))
    with pytest.raises(ValueError, match="a.png.*focal length"):
        t.frames[0].intrinsics(8, 8)
    t = read_transforms(write({"w": 8, "h": 4, "fl_x": 3.0, "frames": [frame("a.png")]}))
    with pytest.raises(ValueError, match="a.png.*8 x 8"):
        t.frames[0].intrinsics(8, 8)


def test_broken_json_is_named(tmp_path):
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(ValueError, match="not valid JSON"):
        read_transforms(tmp_path)
    with pytest.raises(FileNotFoundError, match="neither"):
        read_transforms(tmp_path / "nowhere")


def test_the_fox(recorded):
    """Real photos: 17 of the 67 listed images do not exist."""
    t = read_transforms(recorded("fox"))
    assert (len(t.frames), len(t.missing)) == (50, 17)
    i = t.frames[0].intrinsics(1080, 1920)
    assert (i.fx, i.fy, i.k2) == (1375.52, 1374.49, -0.0805099)
