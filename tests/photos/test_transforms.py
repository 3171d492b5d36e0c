"""Transforms files: accepted, listed and refused content."""

import copy
import functools
import json
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.photos.posed import DepthFile, MaskFile
from nerg_mi.photos.transforms import read_dataparser, read_frame_poses, read_transforms
from tests.photos.written_sets import POSE, frame


def test_frame_intrinsics_override_shared_ones(write):
    t = read_transforms(write({"fl_x": 30.0, "k1": 0.1, "frames": [frame("a.png", fl_x=40.0, k1=0.0), frame("b.png")]}))
    assert [f.intrinsics(8, 8).fx for f in t.frames] == [40.0, 30.0]
    assert [f.intrinsics(8, 8).k1 for f in t.frames] == [0.0, 0.1]


@pytest.mark.parametrize(
    "keys, expected",
    [
        ({"fl_x": 3.0, "k1": 0.1, "k4": 0.01, "camera_model": "OPENCV_FISHEYE"}, {"fisheye": 1, "k1": 0.1, "k4": 0.01}),
        ({"fl_x": 3.0, "k1": 0.1, "k4": 0.01, "is_fisheye": True}, {"fisheye": 1, "k1": 0.1, "k4": 0.01}),
        ({"fl_x": 3.0, "k4": 0.2, "camera_model": "FULL_OPENCV"}, {"fx": 3, "fy": 3, "k4": 0.2}),
        # instant-ngp uses angles in degrees, nerfstudio a list of coefficients.
        ({"x_fov": 90.0}, {"fx": 4, "fy": 4}),
        (
            {"fl_x": 3.0, "k1": 9.0, "distortion_params": [0.1, 0.2, 0.3, 0, 0.5, 0.6]},
            {"k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.5, "p2": 0.6},
        ),
        ({"fl_x": 30.0, "k1": 1e-320, "k3": -1e-300}, {"is_distorted": 0}),
    ],
)
def test_spellings_of_a_lens(write, keys, expected):
    i = read_transforms(write({**keys, "frames": [frame("a.png")]})).frames[0].intrinsics(8, 8)
    assert {name: float(getattr(i, name)) for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize("keys", [{"fl_x": 1e-300}, {"fl_x": 1e300}, {"cx": 1e300}, {"cy": -1e9}, {"k2": 1e200}])
def test_invalid_lenses_are_refused(write, keys):
    t = read_transforms(write({"fl_x": 30.0, **keys, "frames": [frame("a.png")]}))
    with pytest.raises(NergError, match="a.png"):
        t.frames[0].intrinsics(8, 8)


def test_blender_style(write):
    path = write(
        {"camera_angle_x": np.pi / 2, "frames": [frame("./train/r_0")]}, ["train/r_0.png"], "transforms_train.json"
    )
    t = read_transforms(path)
    assert t.frames[0].image.name == "r_0.png"
    assert np.isclose(t.frames[0].intrinsics(800, 800).fx, 400)


def test_masks_of_nerfstudio_and_instant_ngp(write):
    path = write(
        {"fl_x": 1.0, "frames": [frame("a.png", mask_path="m/a.png"), frame("b.jpg"), frame("c.png")]},
        ["a.png", "m/a.png", "b.jpg", "dynamic_mask_b.png", "c.png"],
    )
    folder = path.parent
    assert [f.mask for f in read_transforms(path).frames] == [
        MaskFile(folder / "m/a.png"),
        MaskFile(folder / "dynamic_mask_b.png", is_inverted=True),
        None,
    ]


def test_units_and_kinds_of_depth(write):
    images = ["a.png", "d.png", "d.npy", "d.exr"]

    def depth(name, key="depth_file_path", **keys):
        path = write({"fl_x": 1.0, **keys, "frames": [frame("a.png", **{key: name})]}, images)
        return read_transforms(path).frames[0].depth

    folder = write({}).parent
    assert depth("d.png") == DepthFile(folder / "d.png", 1e-3, True)
    assert depth("d.png", "depth_path", integer_depth_scale=0.01) == DepthFile(folder / "d.png", 0.01, True)
    assert depth("d.png", depth_unit_scale_factor=0.5, applied_scale=2.0).unit == pytest.approx(1.0)
    # As in nerfstudio: millimetres along the axis for all file formats, except EXR, which is that of Record3D.
    assert depth("d.npy") == DepthFile(folder / "d.npy", 1e-3, True)
    assert depth("d.npy", depth_unit_scale_factor=1.0) == DepthFile(folder / "d.npy", 1.0, True)
    assert depth("d.npy", depth_unit_scale_factor=0.5, applied_scale=2.0).unit == pytest.approx(1.0)
    assert depth("d.exr") == DepthFile(folder / "d.exr", 1.0, True)
    assert depth("d.exr", applied_scale=2.0, is_euclidean_depth=True) == DepthFile(
        folder / "d.exr", pytest.approx(2.0), False
    )
    assert depth("d.exr", depth_unit_scale_factor=1e-3).unit == pytest.approx(1e-3)
    assert depth("d.png", enable_depth_loading=False) is None


def test_unusable_frames_are_listed_with_reasons(write):
    names = [f"{c}.png" for c in "abfghijk"]
    path = write(
        {
            "fl_x": 1.0,
            "frames": [
                frame("a.png"),
                frame("b.png", transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist()),
                frame("f.png", mask_path="none.png"),
                frame("./a.png"),
                frame("g.png", camera_model="EQUIRECTANGULAR"),
                {"file_path": "h.png"},
                {"transform_matrix": POSE},
                frame("gone.png"),
                frame("i.png", fl_x="wide"),
                frame("j.png", transform_matrix=[[1, 2], [3]]),
                frame("k.png", mask_path=5),
                frame("..\\..\\etc\\hostname"),
            ],
        },
        names,
    )
    t = read_transforms(path)
    # Of two spellings of one file, the one that sorts first is used.
    assert [f.name for f in t.frames] == ["./a.png"]
    reasons = {u.name: u.reason for u in t.unused}
    for name, part in {
        "b.png": "mirrored",
        "f.png": "none.png",
        "a.png": "twice",
        "g.png": "EQUIRECTANGULAR",
        "h.png": "transform_matrix",
        "frame 6": "file_path",
        "gone.png": "does not exist",
        "i.png": "fl_x",
        "j.png": "its pose",
        "k.png": "mask_path",
        "..\\..\\etc\\hostname": "outside of the data set's folder",
    }.items():
        assert part in reasons.pop(name), name
    assert not reasons


def test_missing_depth_file_disables_depth(write):
    t = read_transforms(write({"fl_x": 1.0, "frames": [frame("a.png", depth_file_path="d.npy")]}))
    assert t.frames[0].depth is None and "a.png" in t.notes[0] and "d.npy" in t.notes[0]


@pytest.mark.parametrize("name", ["a.png", "A.png", "mask.png", "depth.png", "dynamic_mask_a.png"])
def test_pipe_is_refused(write, name):
    keys = {"mask_path": "mask.png"} if name == "mask.png" else {}
    entry = frame("A.png" if name == "a.png" else "a.png", depth_file_path="depth.png", **keys)
    path = write({"fl_x": 1.0, "frames": [entry, frame("b.png")]}, {"a.png", "b.png", "depth.png"} - {name.lower()})
    os.mkfifo(path.with_name(name))
    t = read_transforms(path)
    assert [f.name for f in t.frames] == ["b.png"] and f'{name}" is a pipe' in t.unused[0].reason


@pytest.mark.parametrize(
    "content, message",
    [
        ("{", "not valid JSON"),
        ('{"frames": ' + "[" * 200_000, "transforms.json.*nested"),
        ({"frames": [frame("gone.png")], "fl_x": 1.0}, "gone.png.*does not exist"),
        ({"fl_x": 3.0, "k4": 0.2, "frames": [frame("a.png")]}, "FULL_OPENCV"),
        ({"fl_x": 1.0}, '"frames"'),
        ({"fl_x": 1.0, "frames": []}, "no frames"),
        ({"fl_x": 1.0, "frames": [{"transform_matrix": POSE}]}, "frame 0"),
        ({"fl_x": 1.0, "aabb": [[0, 0, 0], [1, 0, 1]], "frames": [frame("a.png")]}, "aabb"),
        ({"fl_x": 1.0, "aabb": "wide", "frames": [frame("a.png")]}, "aabb"),
        ({"fl_x": 1.0, "applied_transform": [[1, 0], [2]], "frames": [frame("a.png")]}, "applied_transform"),
        (
            {"fl_x": 1.0, "applied_transform": np.diag([1, 1, 1, 2]).tolist(), "frames": [frame("a.png")]},
            "applied_transform",
        ),
        ({"fl_x": 1.0, "applied_scale": 0, "frames": [frame("a.png")]}, "applied_scale"),
        *(
            ({"fl_x": 30.0, **keys, "frames": [frame("a.png")]}, "transforms.json")
            for keys in (
                {"applied_scale": 1e-320},
                {"applied_scale": 10**400},
                {"applied_transform": [[1e300] * 4] * 3},
                {"aabb": [[10**400] * 3, [0, 0, 0]]},
                {"aabb": [[-1e300] * 3, [1e300] * 3]},
            )
        ),
    ],
)
def test_invalid_file_errors_name_file(write, content, message):
    path = write({})
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(NergError, match=message):
        read_transforms(path)


def test_original_coordinates_invert_applied_transform(write):
    """x_file = s (A x + t): a pose in original coordinates is transformed forth and back."""
    turn, shift, s = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.array([1.0, 2, 3]), 2.5
    pose = np.eye(4)
    pose[:3, 3] = [4, 5, 6]
    applied = np.eye(4)
    applied[:3, :3], applied[:3, 3] = turn, s * (turn @ pose[:3, 3] + shift)
    t = read_transforms(
        write(
            {
                "fl_x": 1.0,
                "applied_transform": np.column_stack([turn, shift]).tolist(),
                "applied_scale": s,
                "aabb": [[0, 0, 0], [1, 2, 3]],
                "frames": [frame("a.png", transform_matrix=applied.tolist())],
            }
        )
    )
    back = t.transform(t.to_original)
    assert np.allclose(back.frames[0].to_world, pose)
    assert np.allclose(back.to_original, np.eye(4)) and np.allclose(back.to_file @ t.to_original, np.eye(4))
    assert np.allclose(back.aabb[1] - back.aabb[0], np.array([2, 1, 3]) / s)


def test_dataparser_transforms(tmp_path):
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(json.dumps({"transform": [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], "scale": 0.5}))
    assert np.allclose(read_dataparser(path) @ [1, 1, 1, 1], [0, 1.5, 2, 1])
    rows, scaled = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], np.diag([2, 2, 2, 1]).tolist()
    for transform, scale in ((rows[:1], 0.5), ([*rows, [0, 0, 1, 1]], 0.5), (scaled, 1), (rows, 0)):
        path.write_text(json.dumps({"transform": transform, "scale": scale}))
        with pytest.raises(ValueError, match="dataparser_transforms.json"):
            read_dataparser(path)


def test_nerfstudio_file_lists_define_split(write):
    names = ["a.png", "b.png", "c.png", "d.png"]
    t = read_transforms(
        write(
            {
                "fl_x": 1.0,
                "frames": [frame(n) for n in names],
                "train_filenames": ["a.png", "./b.png"],
                "test_filenames": ["d.png"],
            },
            names,
        )
    )
    assert (t.held_out, t.unassigned) == (["d.png"], ["c.png"])


# A value of each key and of each part of a value is dropped, or replaced by these.
_WRONG = [
    None,
    True,
    0,
    -1,
    1e308,
    1e-308,
    10**400,
    np.nan,
    "",
    "x",
    "1e9",
    "\ud800",
    "../..",
    [],
    {},
    [[1]],
    [None] * 4,
]
_WRONG += [[["x"] * 4] * 4, np.ones((4, 4)).tolist(), [1, [2, 3]], [[[1]] * 3] * 3]


def _list_paths(value, path=()):
    """Paths of keys and indices to all parts of a JSON value, of lists to the first two."""
    keys = value if isinstance(value, dict) else range(min(len(value), 2)) if isinstance(value, list) else ()
    return [p for key in keys for p in ((*path, key), *_list_paths(value[key], (*path, key)))]


@pytest.mark.filterwarnings("error")
def test_mutated_files_are_read_or_refused(write):
    """A sample of all combinations; what is read is finite."""
    first = {
        "file_path": "a.png",
        "transform_matrix": np.eye(4).tolist(),
        "depth_file_path": "d.npy",
        "mask_path": "m.png",
    }
    numbers = dict.fromkeys(
        "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 camera_angle_x x_fov depth_unit_scale_factor".split(), 1.0
    )
    flags = dict.fromkeys("is_fisheye from_mitsuba is_euclidean_depth enable_depth_loading".split(), False)
    content = {**numbers, **flags, "w": 8, "h": 8, "camera_model": "OPENCV", "distortion_params": [0] * 6}
    content |= {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 1.0, "aabb": [[0, 0, 0], [1, 1, 1]]}
    content |= {"train_filenames": ["a.png"], "test_filenames": ["b.png"], "frames": [first, frame("b.png")]}
    path = write(content, ["a.png", "b.png", "d.npy", "m.png"])
    cases = [(p, k) for p in _list_paths(content) for k in range(len(_WRONG) + 1)]
    outcomes = Counter()
    for number in np.random.default_rng(0).permutation(len(cases))[:600]:
        keys, k = cases[number]
        changed = copy.deepcopy(content)
        parent = functools.reduce(lambda value, key: value[key], keys[:-1], changed)
        if k < len(_WRONG):
            parent[keys[-1]] = _WRONG[k]
        else:
            del parent[keys[-1]]
        path.write_text(json.dumps(changed))
        try:
            posed = read_transforms(path)
        except NergError as error:
            outcomes["refused"] += 1
            assert "\n" not in str(error)
        else:
            outcomes["read"] += 1
            assert all(np.isfinite(f.to_world).all() and np.isfinite(list(f.lens.values())).all() for f in posed.frames)
    assert min(outcomes.values()) > 50


@pytest.mark.parametrize(
    "stated, stored",
    [
        ("images/{}.png", "{}.png"),
        ("{}.png", "images/{}.png"),
        ("./train/{}", "{}.png"),
        ("/home/somebody/photos/{}.png", "images/{}.png"),
        ("C:\\photos\\{}.png", "{}.png"),
    ],
)
def test_photos_in_another_folder_are_used_and_reported(write, stated, stored):
    names = [stored.format(k) for k in "ab"]
    t = read_transforms(write({"fl_x": 1.0, "frames": [frame(stated.format(k)) for k in "ab"]}, names))
    assert [f.image for f in t.frames] == [t.root / name for name in names] and not t.unused
    assert any("2 photos" in note for note in t.notes)


def test_photos_of_equal_names_in_other_folders_are_missing(write):
    """Otherwise two poses would show the same photo."""
    frames = [frame("left/a.png"), frame("right/a.png"), frame("left/b.png")]
    t = read_transforms(write({"fl_x": 1.0, "frames": frames}, ["a.png", "b.png"]))
    assert [f.name for f in t.frames] == ["left/b.png"] and len(t.unused) == 2


def test_the_fox(recorded):
    """Real photos: 17 of the 67 listed images do not exist."""
    t = read_transforms(recorded("fox") / "transforms.json")
    assert (len(t.frames), len(t.unused)) == (50, 17)
    assert all(u.reason == "its image does not exist" for u in t.unused)
    i = t.frames[0].intrinsics(1080, 1920)
    assert (i.fx, i.fy, i.k2) == (1375.52, 1374.49, -0.0805099)


@pytest.mark.parametrize(
    "keys",
    [
        {"file_path": "../out/x.png"},
        {"mask_path": "../out/x.png"},
        {"depth_file_path": "../out/x.png"},
        {"file_path": "linked/x.png"},
        {"mask_path": "linked/x.png"},
        {"depth_path": "link.png"},
    ],
)
def test_files_outside_of_the_folder_are_used_only_if_allowed(tmp_path, keys):
    home, out = tmp_path / "set", tmp_path / "out"
    home.mkdir()
    out.mkdir()
    for path in (home / "a.png", home / "b.png", out / "x.png"):
        path.write_bytes(b"")
    (home / "linked").symlink_to(out)
    (home / "link.png").symlink_to(out / "x.png")
    (home / "transforms.json").write_text(
        json.dumps({"fl_x": 30.0, "frames": [frame("b.png"), {**frame("a.png"), **keys}]})
    )
    t = read_transforms(home / "transforms.json")
    assert [f.name for f in t.frames] == ["b.png"]
    assert "outside of the data set's folder" in t.unused[0].reason and "allow_outside" in t.unused[0].reason
    assert len(read_transforms(home / "transforms.json", allow_outside=True).frames) == 2


def test_links_within_the_folder_are_followed(tmp_path, write):
    path = write({"fl_x": 30.0, "frames": [frame("here/a.png")]}, ("images/a.png",))
    (tmp_path / "here").symlink_to(tmp_path / "images")
    outer = tmp_path.with_name(tmp_path.name + "-link")
    outer.symlink_to(tmp_path)
    assert len(read_transforms(path).frames) == len(read_transforms(outer / "transforms.json").frames) == 1


def test_absolute_path_outside_is_not_accessed(tmp_path, write, monkeypatch):
    path = write({"fl_x": 30.0, "frames": [frame("a.png"), frame("/etc/passwd"), frame("../../etc/hostname")]})
    accessed = []
    monkeypatch.setattr("pathlib.Path.is_file", lambda self: accessed.append(self) or self.name == "a.png")
    t = read_transforms(path)
    assert len(t.unused) == 2 and not [p for p in accessed if "etc" in str(p)]


@pytest.mark.parametrize(
    "keys",
    [
        {"transform_matrix": [[1e300, 0, 0, 0], [0, 1e300, 0, 0], [0, 0, 1e300, 0], [0, 0, 0, 1]]},
        {"transform_matrix": [[10**400] * 4] * 4},
        {"transform_matrix": [[1, 0, 0, 1e13], [0, 1, 0, 0], [0, 0, 1, 0]]},
        {"fl_x": 10**400},
        {"k1": [1]},
        {"file_path": "a\0b"},
        {"file_path": "x" * 5000},
        {"camera_model": ["OPENCV"]},
        {"mask_path": "y" * 5000},
        {"depth_file_path": "a.png", "depth_unit_scale_factor": float("inf")},
    ],
)
def test_invalid_numbers_and_names_exclude_frame(write, keys):
    t = read_transforms(write({"fl_x": 30.0, "frames": [frame("b.png"), {**frame("a.png"), **keys}]}))
    assert len(t.frames) == len(t.unused) == 1 and str(t.unused[0]).isprintable()


@pytest.mark.parametrize(
    "keys, turns",
    [
        *(
            (keys, [-1, 1, -1, 1])
            for keys in ({"from_mitsuba": True}, {"from_mitsuba": 1}, {"normal_mts_args": "-D x=1"})
        ),
        *((keys, [1, 1, 1, 1]) for keys in ({}, {"from_mitsuba": False}, {"from_mitsuba": None}, {"from_na": False})),
    ],
)
def test_mitsuba_cameras_are_converted(write, keys, turns):
    """They look along +z with x to the left; positions do not change, as in instant-ngp's nerf_matrix_to_ngp."""
    pose = np.array([[0.0, 0, 1, 3], [1, 0, 0, 4], [0, 1, 0, 5], [0, 0, 0, 1]])
    path = write({"fl_x": 1.0, **keys, "frames": [frame("a.png", transform_matrix=pose.tolist())]})
    expected = pose * turns
    assert np.allclose(read_transforms(path).frames[0].to_world, expected)
    assert np.allclose(read_frame_poses(path)[1][0][1], expected)


CHANGES = [
    {"from_na": True},
    {"camera_convention": "opencv"},
    {"coordinate_system": "OPENCV"},
    {"handedness": "left"},
    {"is_w2c": True},
    {"rolling_shutter": [0, 0, 1, 0]},
    {"white_transparent": True},
    {"skew": 0.1},
    {"distortion": [0.1, 0]},
    {"fisheye_crop_radius": 300},
    {"latlong": True},
    {"transform_type": "w2c"},
    {"flip_y": True},
    {"camera_type": "fisheye"},
    {"distortion_model": "OPENCV_FISHEYE"},
    {"color_space": "linear"},
    {"is_linear": True},
    {"invert_mask": True},
]


@pytest.mark.parametrize("keys", CHANGES, ids=lambda k: next(iter(k)))
def test_an_unknown_key_that_changes_meaning_is_refused(write, keys):
    """A key of the file is an error with the file name; a key of a frame excludes the frame."""
    key = next(iter(keys))
    path = write({"fl_x": 1.0, **keys, "frames": [frame("a.png")]})
    with pytest.raises(NergError, match=f'transforms.json.*"{key}"'):
        read_transforms(path)
    with pytest.raises(NergError, match=f'"{key}"'):
        read_frame_poses(path)
    t = read_transforms(write({"fl_x": 1.0, "frames": [frame("a.png", **keys), frame("b.png")]}))
    assert [f.name for f in t.frames] == ["b.png"] and f'"{key}"' in t.unused[0].reason


@pytest.mark.parametrize(
    "keys",
    [
        {
            "camera_convention": "OpenGL",
            "is_w2c": False,
            "rolling_shutter": [0, 0, 0, 0],
            "skew": 0.0,
            "depth_type": "z",
        },
        {"transform_type": "c2w", "flip_y": False, "camera_type": "perspective", "color_space": "sRGB"},
        {"is_linear": False, "invert_mask": False, "distortion_model": "PINHOLE", "mirror": None},
        {"transform_matrix_start": POSE, "transform_matrix_end": POSE},
        {"aabb_scale": 16, "scale": 0.3, "offset": [0, 0, 0], "sharpness": 9.0, "colmap_im_id": 7, "rotation": 0.1},
    ],
)
def test_harmless_keys_are_ignored(write, keys):
    t = read_transforms(write({"fl_x": 1.0, "frames": [frame("a.png", **keys)]}))
    assert np.array_equal(t.frames[0].to_world, np.eye(4)) and "a.png" in t.frames[0].name


def test_unknown_depth_keys_are_refused_with_depth(write):
    content = {"fl_x": 1.0, "depth_scale": 4000, "frames": [frame("a.png", depth_file_path="b.png")]}
    with pytest.raises(NergError, match='"depth_scale".*depth_unit_scale_factor'):
        read_transforms(write(content))


def test_unused_keys_are_noted_once(write):
    frames = [frame(n, time=0.5, sharpness=3.0) for n in ("a.png", "b.png")]
    t = read_transforms(write({"fl_x": 1.0, "aabb_scale": 4, "ply_file_path": "sparse_pc.ply", "frames": frames}))
    assert t.notes == ["unused keys of transforms.json: ply_file_path, time"]


@pytest.mark.parametrize("key", ["from_mitsuba", "is_fisheye", "is_equirectangular", "is_euclidean_depth"])
def test_flags_are_true_or_false(write, key):
    t = read_transforms(
        write({"fl_x": 1.0, "frames": [frame("a.png", depth_path="a.png", **{key: "false"}), frame("b.png")]})
    )
    assert f'"{key}" must be true or false' in t.unused[0].reason


@pytest.mark.parametrize(
    "listed, stored",
    [
        ("images\\a.png", "images/a.png"),
        (".\\images\\a.png", "images/a.png"),
        ("images/K\u00fcche.png", "images/Ku\u0308che.png"),
        ("images/Ku\u0308che.png", "images/K\u00fcche.png"),
        ("Images/A.PNG", "images/a.png"),
        ("images/a.jpg", "images/a.JPG"),
        ("IMAGES\\K\u00dcCHE", "images/Ku\u0308che.png"),
    ],
)
def test_names_of_other_systems_are_matched(write, listed, stored):
    """Names of images, masks and depth files, and lists of names."""
    keys = {"mask_path": listed, "depth_file_path": listed} if Path(listed).suffix else {}
    frames = [frame(listed, **keys), frame("b.png")]
    t = read_transforms(write({"fl_x": 1.0, "frames": frames, "test_filenames": [stored]}, [stored, "b.png"]))
    path = next(f for f in t.frames if f.name == listed)
    assert path.image.samefile(path.image.parent / Path(stored).name) and path.image.name == Path(stored).name
    if keys:
        assert path.mask.path == path.depth.path == path.image and t.held_out == [listed]


def test_ambiguous_names_are_refused(write):
    t = read_transforms(write({"fl_x": 1.0, "frames": [frame("A.png"), frame("b.png")]}, ["a.png", "a.PNG", "b.png"]))
    assert "a.PNG, a.png" in t.unused[0].reason
