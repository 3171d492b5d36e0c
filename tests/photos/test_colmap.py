"""Tests of `nerg_mi.photos.colmap`."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.photos import colmap
from nerg_mi.photos.cameras import PosedCamera, project
from nerg_mi.photos.colmap import (
    describe_other_models,
    estimate_up,
    find_model_files,
    find_pose_source,
    read_colmap,
    read_image_poses,
    read_named_poses,
    rotation_to_z,
)
from nerg_mi.photos.photo_set import Photos
from nerg_mi.photos.transforms import read_transforms

# ---- COLMAP models, written byte by byte and line by line: cameras, poses, points, and invalid files ----


# COLMAP's camera models: number, name, parameters.
CAMERAS = {
    1: (0, "SIMPLE_PINHOLE", 40, 30, (50.0, 20.5, 14.5)),
    2: (1, "PINHOLE", 40, 30, (50.0, 51.0, 20.5, 14.5)),
    3: (2, "SIMPLE_RADIAL", 40, 30, (50.0, 20.5, 14.5, 0.1)),
    4: (3, "RADIAL", 40, 30, (50.0, 20.5, 14.5, 0.1, 0.02)),
    5: (4, "OPENCV", 40, 30, (50.0, 51.0, 20.5, 14.5, 0.1, 0.02, 0.003, 0.004)),
    6: (5, "OPENCV_FISHEYE", 40, 30, (50.0, 51.0, 20.5, 14.5, 0.1, 0.02, 0.003, 0.004)),
    7: (6, "FULL_OPENCV", 40, 30, (50.0, 51.0, 20.5, 14.5, 0.1, 0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08)),
    8: (8, "SIMPLE_RADIAL_FISHEYE", 40, 30, (50.0, 20.5, 14.5, 0.1)),
    9: (9, "RADIAL_FISHEYE", 40, 30, (50.0, 20.5, 14.5, 0.1, 0.02)),
    10: (7, "FOV", 40, 30, (50.0, 51.0, 20.5, 14.5, 0.9)),
}


# fx, fy, k1, k2, p1, p2, k3, k4, k5, k6, fisheye of the first nine.
EXPECTED = {
    1: (50, 50, 0, 0, 0, 0, 0, 0, 0, 0, False),
    2: (50, 51, 0, 0, 0, 0, 0, 0, 0, 0, False),
    3: (50, 50, 0.1, 0, 0, 0, 0, 0, 0, 0, False),
    4: (50, 50, 0.1, 0.02, 0, 0, 0, 0, 0, 0, False),
    5: (50, 51, 0.1, 0.02, 0.003, 0.004, 0, 0, 0, 0, False),
    6: (50, 51, 0.1, 0.02, 0, 0, 0.003, 0.004, 0, 0, True),
    7: (50, 51, 0.1, 0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08, False),
    8: (50, 50, 0.1, 0, 0, 0, 0, 0, 0, 0, True),
    9: (50, 50, 0.1, 0.02, 0, 0, 0, 0, 0, 0, True),
}


def poses(count):
    """World-to-camera rotations (matrices) and translations."""
    rng = np.random.default_rng(0)
    return Rotation.random(count, random_state=1).as_matrix(), rng.normal(size=(count, 3))


def quaternion(matrix):
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    return w, x, y, z


POINTS = np.random.default_rng(2).normal(size=(6, 3))
TRACKS, ERRORS = [4, 3, 2, 5, 3, 7], [0.5, 1.0, 0.5, 9.0, 2.0, 0.1]
TRUSTED = [0, 1, 4, 5]


def observed_point(k):
    """Number of the point of an image's observation ``k``: every third has none, and one number is unknown."""
    return -1 if k % 3 == 0 else 99 if k == 7 else k % len(POINTS) + 1


def write_bin(folder, names, cameras=CAMERAS):
    rotations, translations = poses(len(names))
    out = struct.pack("<Q", len(cameras))
    for number, (model, _, w, h, p) in cameras.items():
        out += struct.pack("<iiQQ", number, model, w, h) + struct.pack(f"<{len(p)}d", *p)
    (folder / "cameras.bin").write_bytes(out)
    out = struct.pack("<Q", len(names))
    for k, name in enumerate(names):
        out += struct.pack("<i", k + 1) + struct.pack("<7d", *quaternion(rotations[k]), *translations[k])
        out += struct.pack("<i", k + 1) + name.encode() + b"\0"
        # Observations (x, y, point); their number is the index of the image.
        out += struct.pack("<Q", k) + b"".join(struct.pack("<ddq", 1.5, 2.5, observed_point(j)) for j in range(k))
    (folder / "images.bin").write_bytes(out)
    out = struct.pack("<Q", len(POINTS))
    for k, p in enumerate(POINTS):
        out += struct.pack("<Q3d3Bd", k + 1, *p, 10, 20, 30, ERRORS[k]) + struct.pack("<Q", TRACKS[k])
        out += b"".join(struct.pack("<ii", 1, j) for j in range(TRACKS[k]))
    (folder / "points3D.bin").write_bytes(out)


def write_txt(folder, names, cameras=CAMERAS):
    rotations, translations = poses(len(names))
    show = lambda values: " ".join(repr(float(v)) for v in values)
    lines = ["# Camera list", *(f"{n} {m} {w} {h} {show(p)}" for n, (_, m, w, h, p) in cameras.items())]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list"]
    for k, name in enumerate(names):
        lines += [
            f"{k + 1} {show(quaternion(rotations[k]))} {show(translations[k])} {k + 1} {name}",
            " ".join(f"1.5 2.5 {observed_point(j)}" for j in range(k)),
        ]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# 3D point list"]
    for k, p in enumerate(POINTS):
        lines.append(f"{k + 1} {show(p)} 10 20 30 {ERRORS[k]} " + " ".join(f"1 {j}" for j in range(TRACKS[k])))
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


NAMES = [f"room {k}/photo {k}.png" for k in range(1, 11)]


@pytest.mark.parametrize("comments", [True, False])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_byte_order_mark_of_a_text_model_is_no_content(tmp_path, comments, end):
    for folder, mark in (("plain", ""), ("marked", "\ufeff")):
        (tmp_path / folder).mkdir()
        write_txt(tmp_path / folder, NAMES)
        for file in (tmp_path / folder).iterdir():
            lines = file.read_text().splitlines()[0 if comments else 1 :]
            file.write_bytes((mark + end.join(lines) + end).encode())
    plain, marked = (read_named_poses(tmp_path / folder) for folder in ("plain", "marked"))
    assert marked.names == plain.names and len(marked.names) == len(NAMES)
    np.testing.assert_array_equal(marked.to_world, plain.to_world)
    (tmp_path / "marked" / "images.txt").write_text("1 2 3", encoding="utf-16")
    with pytest.raises(NergError, match="images.txt.*UTF-16"):
        read_named_poses(tmp_path / "marked")


@pytest.fixture(params=["bin", "txt"])
def model(request, tmp_path):
    """A model of ten images, each with its own camera, next to empty image files."""
    for name in NAMES:
        (tmp_path / "images" / name).parent.mkdir(parents=True)
        (tmp_path / "images" / name).write_bytes(b"")
    folder = tmp_path / "sparse/0"
    folder.mkdir(parents=True)
    {"bin": write_bin, "txt": write_txt}[request.param](folder, NAMES)
    return folder


def test_frames_have_their_reliable_points(model):
    posed = read_colmap(model, model.parents[1] / "images")
    for frame in posed.frames:
        k = NAMES.index(frame.name)
        expected = sorted({observed_point(j) - 1 for j in range(k)} & set(TRUSTED))
        assert np.allclose(frame.points.positions, POINTS[expected]), frame.name
    moved = posed.transform(np.array([[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1.0]]))
    before, after = posed.frames[-1].points, moved.frames[-1].points
    assert np.allclose(after.positions, before.positions[:, [1, 0, 2]] * [-2, 2, 2] + [1, 2, 3])
    assert np.array_equal(after.relative_errors, before.relative_errors) and len(before)


def test_cameras_poses_and_points(model):
    images = model.parents[1] / "images"
    posed = read_colmap(model, images)
    assert sorted(f.name for f in posed.frames) == [f.name for f in posed.frames] and len(posed.frames) == 9
    rotations, translations = poses(10)
    for frame in posed.frames:
        k = NAMES.index(frame.name)
        i = frame.intrinsics(40, 30)
        assert (i.fx, i.fy, *i.distortion, i.fisheye) == EXPECTED[k + 1], CAMERAS[k + 1][1]
        assert (i.cx, i.cy, i.width, i.height) == (20.5, 14.5, 40, 30)
        # A point has the same position for COLMAP's camera (z forward, y down) and for the OpenGL camera (z back, y
        # up).
        local = np.array([0.3, -0.2, 2.0])
        world = rotations[k].T @ (local - translations[k])
        ours = np.linalg.inv(frame.to_world) @ [*world, 1]
        assert np.allclose(ours[:3], local * [1, -1, -1], atol=1e-12)
        assert np.isclose(np.linalg.det(frame.to_world[:3, :3]), 1)
        assert frame.image.is_file()
    assert np.array_equal(posed.points, POINTS[TRUSTED])


def test_unsupported_camera_model_excludes_its_images(model):
    posed = read_colmap(model, model.parents[1] / "images")
    assert [u.name for u in posed.unused] == [NAMES[9]] and '"FOV"' in posed.unused[0].reason
    assert "image_undistorter" in posed.unused[0].reason


@pytest.mark.parametrize("write", [write_bin, write_txt])
@pytest.mark.parametrize(
    "model", [(14, "SIMPLE_FISHEYE", (50.0, 20.5, 14.5)), (15, "FISHEYE", (50.0, 51.0, 20.5, 14.5))]
)
def test_equidistant_fisheye(tmp_path, write, model):
    """Compared with the definition of COLMAP, and with its own projection where it is installed."""
    (tmp_path / "a.png").touch()
    number, name, parameters = model
    write(tmp_path, ["a.png"], {1: (number, name, 40, 30, parameters)})
    camera = PosedCamera(read_colmap(tmp_path, tmp_path).frames[0].intrinsics(40, 30), np.eye(4))
    points = np.array([[0.3, -0.2, 1.0], [2.0, 1.0, 0.5], [-0.1, 0.4, 3.0]])
    pixels, is_visible = project(points * [1, -1, -1], camera)
    radius = np.linalg.norm(points[:, :2], axis=1)
    expected = points[:, :2] * (np.arctan2(radius, points[:, 2]) / radius)[:, None]
    np.testing.assert_allclose(pixels, expected * [50, parameters[-3]] + [20.5, 14.5], rtol=1e-12)
    assert is_visible.all()
    try:
        import pycolmap
    except ImportError:
        return
    theirs = pycolmap.Camera(model=name, width=40, height=30, params=parameters).img_from_cam(points)
    np.testing.assert_allclose(pixels, theirs, rtol=1e-10)


@pytest.mark.parametrize("write", [write_bin, write_txt])
@pytest.mark.parametrize(
    "number, name, parameters",
    [(12, "SIMPLE_DIVISION", 4), (13, "DIVISION", 5), (16, "EUCM", 6), (17, "EQUIRECTANGULAR", 2)],
)
def test_other_models_exclude_their_images_alone(tmp_path, write, number, name, parameters):
    """COLMAP undistorts all but panoramas, which it leaves as they are."""
    for photo in ("a.png", "b.png"):
        (tmp_path / photo).touch()
    write(tmp_path, ["a.png", "b.png"], {1: (number, name, 40, 30, (50.0,) * parameters), 2: CAMERAS[2]})
    posed = read_colmap(tmp_path, tmp_path)
    assert [f.name for f in posed.frames] == ["b.png"] and f'"{name}"' in posed.unused[0].reason
    assert ("image_undistorter" in posed.unused[0].reason) == (name != "EQUIRECTANGULAR")


@pytest.mark.parametrize(
    "name, written",
    [
        ("IMG  0011  (copy).jpg", "IMG  0011  (copy).jpg"),
        ("4 5 7.jpg", "4 5 7.jpg"),
        ("a\tb.jpg", "a\tb.jpg"),
        (" a.jpg", " a.jpg"),
        ("a.jpg ", "a.jpg "),
        ("a b.jpg", "   a b.jpg  "),
        ("a.jpg", "\ta.jpg"),
        ("x 1/y  2.jpg", "x 1\\y  2.jpg"),
    ],
)
def test_spaces_in_names_of_text_models(tmp_path, name, written):
    """Spaces at the ends belong to the name if there is such a file."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    write_txt(tmp_path, [written], {1: CAMERAS[1]})
    posed = read_colmap(tmp_path, tmp_path)
    assert [f.image for f in posed.frames] == [tmp_path / name] and not posed.unused
    assert read_named_poses(tmp_path).names == [written.strip()]


@pytest.mark.parametrize("folder", [".", "sparse", "sparse/0"])
@pytest.mark.parametrize("has_images", [True, False])
def test_photos_next_to_a_model_are_used_and_reported(model, folder, has_images):
    root, images = model.parents[1], model.parents[1] / "images"
    for child in list(images.iterdir()):
        child.rename(root / folder / child.name)
    if not has_images:
        images.rmdir()
    posed = Photos.load(model)
    assert len(posed.frames) == 9 and posed.frames[0].image.is_relative_to(root / folder)
    assert posed.root == root / folder and any("photos are in" in note for note in posed.notes)


@pytest.mark.parametrize("focal", [50.0, 90.0])
def test_two_cameras_with_one_number_are_refused_unless_equal(model, focal):
    if (model / "cameras.txt").exists():
        with open(model / "cameras.txt", "a") as file:
            file.write(f"1 SIMPLE_PINHOLE 40 30 {focal} 20.5 14.5\n")
    else:
        raw = (model / "cameras.bin").read_bytes()
        record = struct.pack("<iiQQ3d", 1, 0, 40, 30, focal, 20.5, 14.5)
        (model / "cameras.bin").write_bytes(struct.pack("<Q", len(CAMERAS) + 1) + raw[8:] + record)
    read = lambda: read_colmap(model, model.parents[1] / "images")
    if focal == 50:
        assert len(read().frames) == 9
    else:
        with pytest.raises(NergError, match="number 1 .*model_merger"):
            read()


def test_missing_images_and_masks_are_listed(model):
    images, masks = model.parents[1] / "images", model.parents[1] / "masks"
    (images / NAMES[0]).unlink()
    for k in (1, 2):
        (masks / NAMES[k]).parent.mkdir(parents=True)
    (masks / (NAMES[1] + ".png")).write_bytes(b"")
    (masks / NAMES[2]).write_bytes(b"")
    posed = read_colmap(model, images, masks)
    assert [f.name for f in posed.frames] == sorted(NAMES[1:3]) and not any(f.mask.is_inverted for f in posed.frames)
    reasons = {u.name: u.reason for u in posed.unused}
    assert "does not exist" in reasons[NAMES[0]] and "mask" in reasons[NAMES[3]]


@pytest.mark.parametrize("name", ["images/a.png", "masks/a.png.png", "0/images.bin", "0/points3D.bin"])
def test_pipe_is_refused(tmp_path, name):
    for folder in ("0", "images", "masks"):
        (tmp_path / folder).mkdir()
    write_bin(tmp_path / "0", ["a.png", "b.png"])
    for folder in ("images", "masks"):
        for photo in ("a.png", "b.png"):
            (tmp_path / folder / (photo if folder == "images" else f"{photo}.png")).touch()
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    read = lambda: read_colmap(tmp_path / "0", tmp_path / "images", tmp_path / "masks")
    if name.startswith("0/"):
        with pytest.raises(NergError, match=f'{name}" is a pipe'):
            read()
    else:
        error = read()
        assert [f.name for f in error.frames] == ["b.png"] and f'{name}" is a pipe' in error.unused[0].reason


@pytest.mark.parametrize("numbers", ["0 0 0 0", "0.9 0.9 0.1 0.2", "nan 0 0 1"])
def test_invalid_quaternion_is_listed(tmp_path, numbers):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"")
    write_txt(tmp_path, ["a.png", "b.png"])
    text = (tmp_path / "images.txt").read_text().splitlines()
    words = text[1].split()
    text[1] = " ".join([words[0], numbers, *words[5:]])
    (tmp_path / "images.txt").write_text("\n".join(text))
    posed = read_colmap(tmp_path, tmp_path)
    assert [f.name for f in posed.frames] == ["b.png"] and "a.png" in posed.unused[0].name
    with pytest.raises(NergError, match='the pose of image "a.png" in .* is invalid'):
        read_named_poses(tmp_path)


def test_unknown_model_number_is_refused(tmp_path):
    write_bin(tmp_path, ["a.png"], {1: (99, "NEW", 40, 30, (1.0,))})
    with pytest.raises(ValueError, match="number 99.*image_undistorter"):
        read_colmap(tmp_path, tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_bad_line_of_text_is_numbered(tmp_path, name):
    (tmp_path / "a.png").write_bytes(b"")
    write_txt(tmp_path, ["a.png"])
    path = tmp_path / f"{name}.txt"
    path.write_text("# one line more\n" + path.read_text().splitlines()[0] + "\n1 SIMPLE x y\n")
    with pytest.raises(ValueError, match=f'line 3 of ".*{name}.txt"'):
        read_colmap(tmp_path, tmp_path)


def test_digits_joined_by_underscores_are_no_number(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    write_txt(tmp_path, ["a.png"])
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 20 10 9_5 9_5 10 5\n")
    with pytest.raises(NergError, match='line 1 of ".*cameras.txt"'):
        read_colmap(tmp_path, tmp_path)


def test_decimal_commas_of_text_are_named(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    write_txt(tmp_path, ["a.png"])
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 20 10 9,5 9,5 10 5\n")
    with pytest.raises(NergError, match='"1 PINHOLE 20 10 9,5 9,5 10 5".*with decimal points; export'):
        read_colmap(tmp_path, tmp_path)


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("missing", None, "there is no posed image set"),
        ("scan.zip", b"PK\x03\x04", "zip archive"),
        ("scan.mp4", b"\0\0\0\x18ftyp", "is no posed image set.*nerg poses"),
        ("a.jpg", "", "nerg poses.*ns-process-data"),
    ],
)
def test_what_is_no_posed_image_set_is_named(tmp_path, name, content, said):
    if content is not None:
        (tmp_path / name).write_bytes(content or b"")
    with pytest.raises(NergError, match=said):
        find_pose_source(tmp_path if content == "" else tmp_path / name)


def test_a_folder_without_a_model(tmp_path):
    assert find_model_files(tmp_path) is None
    with pytest.raises(FileNotFoundError, match="no COLMAP model"):
        read_colmap(tmp_path, tmp_path)


@pytest.mark.parametrize("write", [write_bin, write_txt])
def test_images_outside_of_the_capture_are_used_only_if_allowed(tmp_path, write):
    """The capture is the folder that contains ``images``, even if the model is deeper next to it."""
    home, out = tmp_path / "capture", tmp_path / "out"
    model = home / "colmap" / "sparse" / "0"
    for folder in (model, home / "images", out):
        folder.mkdir(parents=True)
    (out / "x.png").write_bytes(b"")
    (home / "images" / "a.png").write_bytes(b"")
    (home / "images" / "link.png").symlink_to(out / "x.png")
    write(model, ["a.png", "../../out/x.png", str(out / "x.png"), "link.png"])
    posed = read_colmap(model, home / "images")
    assert [f.name for f in posed.frames] == ["a.png"] and len(posed.unused) == 3
    assert all("outside of the data set's folder" in u.reason and "allow_outside" in u.reason for u in posed.unused)
    # All links refer to one file, which counts once.
    assert len(read_colmap(model, home / "images", allow_outside=True).frames) == 2


def test_masks_outside_of_the_capture_are_used_only_if_allowed(tmp_path):
    for folder in ("capture/sparse", "capture/images", "out"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "capture/images/a.png").write_bytes(b"")
    (tmp_path / "out/a.png.png").write_bytes(b"")
    (tmp_path / "capture/masks").symlink_to(tmp_path / "out")
    write_bin(tmp_path / "capture/sparse", ["a.png"])
    where = tmp_path / "capture/sparse", tmp_path / "capture/images", tmp_path / "capture/masks"
    with pytest.raises(NergError, match="outside of the data set's folder"):
        read_colmap(*where)
    assert read_colmap(*where, allow_outside=True).frames[0].mask is not None


def write_claimed_count(count):
    return lambda raw: struct.pack("<Q", count) + raw[8:]


@pytest.mark.parametrize("name, record", [("cameras", "camera"), ("images", "image"), ("points3D", "point")])
@pytest.mark.parametrize(
    "change, said",
    [
        (lambda raw: raw[:-4], "ends within {record} record"),
        *((write_claimed_count(count), "") for count in (2**63, 2**64 - 1, 10**9)),
        (lambda raw: write_claimed_count(struct.unpack("<Q", raw[:8])[0] - 1)(raw), "bytes after the"),
    ],
)
def test_binary_files_with_wrong_counts_are_refused(tmp_path, name, record, change, said):
    for photo in ("a.png", "b.png"):
        (tmp_path / photo).write_bytes(b"")
    write_bin(tmp_path, ["a.png", "b.png"])
    path = tmp_path / f"{name}.bin"
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(NergError, match=f"{name}.bin.*{said.format(record=record)}"):
        read_colmap(tmp_path, tmp_path)


def test_only_observations_may_have_long_lines(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(b"")
    write_txt(tmp_path, ["a.png"])
    images = (tmp_path / "images.txt").read_text()
    (tmp_path / "images.txt").write_text(images.rstrip("\n") + "\n" + "1.5 2.5 -1 " * 200_000 + "\n")
    assert len(read_colmap(tmp_path, tmp_path / "images").frames) == 1
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 40 30 " + "1 " * 700_000)
    with pytest.raises(NergError, match="line 1 .*cameras.txt.* characters"):
        read_colmap(tmp_path, tmp_path / "images")


def test_a_file_without_line_ends_is_read_in_pieces(tmp_path, monkeypatch):
    (tmp_path / "images").mkdir()
    write_txt(tmp_path, ["a.png"])
    monkeypatch.setattr(colmap, "_READ_CHARACTERS", 1 << 21)
    (tmp_path / "cameras.txt").write_bytes(bytes(1 << 23))
    with pytest.raises(NergError, match="1.*cameras.txt.*2,097,152"):
        read_colmap(tmp_path, tmp_path / "images")


def images_text(observations):
    """Ten images; ``observations(k)``: the lines after that of image k."""
    rotations, translations = poses(len(NAMES))
    show = lambda values: " ".join(repr(float(v)) for v in values)
    lines = []
    for k, name in enumerate(NAMES):
        lines += [f"{k + 1} {show(quaternion(rotations[k]))} {show(translations[k])} {k + 1} {name}", *observations(k)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "observations",
    [
        lambda k: [],
        lambda k: [""],
        lambda k: ["1.5 2.5 -1 3.5 4.5 7 5 6 8"],
        lambda k: [["1.5 2.5 -1"], [], ["", ""]][k % 3],
        lambda k: ["1 2 -1 3 4 -1 5 6 -1 7 8 -1", ""],
    ],
    ids=["none", "blank", "observations", "mixed", "whole-numbers"],
)
def test_text_with_and_without_lines_of_observations(tmp_path, observations):
    write_txt(tmp_path, NAMES)
    expected = read_image_poses(tmp_path)[2]
    (tmp_path / "images.txt").write_text(images_text(observations))
    listed = read_image_poses(tmp_path)[2]
    assert [name for name, _ in listed] == NAMES
    assert np.array_equal([p for _, p in listed], [p for _, p in expected])


def test_numeric_names_are_not_observations(tmp_path):
    write_txt(tmp_path, ["0001", "0002", "0003"])
    text = (tmp_path / "images.txt").read_text().splitlines()
    (tmp_path / "images.txt").write_text("\n".join(line for line in text if "-1" not in line or "000" in line))
    assert [name for name, _ in read_image_poses(tmp_path)[2]] == ["0001", "0002", "0003"]


def test_invalid_line_is_refused(tmp_path):
    write_txt(tmp_path, NAMES)
    (tmp_path / "images.txt").write_text(images_text(lambda k: ["1.5 2.5 -1 3.5"]))
    with pytest.raises(NergError, match="line 2 of"):
        read_image_poses(tmp_path)


@pytest.mark.parametrize("name, what", [("cameras", "cameras"), ("images", "images"), ("points3D", "points")])
def test_different_count_in_header_is_noted(tmp_path, name, what):
    (tmp_path / "a.png").write_bytes(b"")
    write_txt(tmp_path, ["a.png"], {1: CAMERAS[1]})
    path, counts = tmp_path / f"{name}.txt", {"cameras": 1, "images": 1, "points3D": len(POINTS)}
    text = path.read_text()
    path.write_text(f"# Number of {what}: {counts[name]}, mean observations: 2\n{text}")
    assert read_colmap(tmp_path, tmp_path).notes == []
    path.write_text(f"# Number of {what}: 24, mean observations: 2\n{text}")
    (note,) = read_colmap(tmp_path, tmp_path).notes
    assert f"{name}.txt" in note and f"has {counts[name]} records" in note and "states 24" in note


def test_gigabytes_of_observations_are_skipped(tmp_path, monkeypatch):
    write_bin(tmp_path, NAMES)
    expected = read_image_poses(tmp_path)
    files = [(tmp_path / f"{name}.bin").read_bytes() for name in ("cameras", "images")]
    assert expected[1] == hashlib.sha256(b"".join(hashlib.sha256(file).digest() for file in files)).hexdigest()
    many, (first, rest) = 1 << 27, (files[1][: 73 + len(NAMES[0])], files[1][81 + len(NAMES[0]) :])
    with (tmp_path / "images.bin").open("wb") as out:
        out.write(first + struct.pack("<Q", many))
        out.seek(24 * many, 1)
        out.write(rest)
    monkeypatch.setattr(colmap, "file_sha256", lambda path: "")
    tracemalloc.start()
    listed = read_image_poses(tmp_path)[2]
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
    assert [name for name, _ in listed] == NAMES
    assert np.array_equal([p for _, p in listed], [p for _, p in expected[2]])


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("write", [write_bin, write_txt])
def test_limits_are_checked_before_reading(tmp_path, monkeypatch, write, name):
    (tmp_path / NAMES[0]).parent.mkdir()
    (tmp_path / NAMES[0]).write_bytes(b"")
    monkeypatch.setattr(colmap, "file_sha256", lambda path: pytest.fail("it was read to its end"))
    write(tmp_path, NAMES[:1], {} if name == "images" else {1: CAMERAS[1]})
    with monkeypatch.context() as limits, pytest.raises(NergError, match=f"{name}.* the limit is 0"):
        limits.setattr(colmap, "MAX_POINTS" if name == "points3D" else "MAX_IMAGES", 0)
        read_colmap(tmp_path, tmp_path)
    path = next(tmp_path.glob(f"{name}.*"))
    with path.open("r+b") as out:
        out.truncate(64 << 30)
    with pytest.raises(NergError, match=f"{name}.* has 68,719,476,736 bytes; the limit is"):
        read_colmap(tmp_path, tmp_path)


# ---- Poses by image name, without images ----


def write_transforms(path, poses):
    frames = [{"file_path": name, "transform_matrix": pose.tolist()} for name, pose in poses.items()]
    path.write_text(json.dumps({"frames": frames}))
    return path


def write_colmap(folder, poses):
    """Write a text model from OpenGL camera-to-world poses. COLMAP's poses are world-to-camera, y down and z
    forward.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    text = "# images\n"
    for k, (name, pose) in enumerate(poses.items()):
        x, y, z, w = Rotation.from_matrix((pose[:3, :3] @ np.diag([1, -1, -1])).T).as_quat()
        t = -(pose[:3, :3] @ np.diag([1, -1, -1])).T @ pose[:3, 3]
        text += f"{k + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {name}\n\n"
    (folder / "images.txt").write_text(text)
    return folder


def make_poses(n=4):
    rng = np.random.default_rng(1)
    poses = {}
    for k in range(n):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=k).as_matrix(), rng.normal(size=3)
        poses[f"images/scene_{k:04d}.jpg"] = pose
    return poses


def test_transforms_and_colmap_give_same_poses(tmp_path):
    poses = make_poses()
    a = read_named_poses(write_transforms(tmp_path / "transforms.json", poses))
    b = read_named_poses(write_colmap(tmp_path / "sparse", poses))
    for loaded in (a, b):
        assert loaded.names == list(poses) and np.allclose(loaded.to_world, list(poses.values()), atol=1e-12)
    assert a.path.name == "transforms.json" and b.path.name == "images.txt" and a.sha256 != b.sha256


def test_checksum_equals_that_of_training(tmp_path):
    poses = make_poses(2)
    path = write_transforms(tmp_path / "transforms.json", poses)
    (tmp_path / "images").mkdir()
    for name in poses:
        (tmp_path / name).write_bytes(b"")
    assert read_named_poses(path).sha256 == read_transforms(path).sha256


@pytest.mark.parametrize(
    "frames, message",
    [
        ([], "lists no images"),
        ([{"file_path": "a.jpg"}], '0.*"file_path".*"transform_matrix"'),
        ([{"file_path": "a.jpg", "transform_matrix": [[1]]}], '"a.jpg".*4.*4'),
    ],
)
def test_invalid_pose_is_refused(tmp_path, frames, message):
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(NergError, match=message):
        read_named_poses(tmp_path / "transforms.json")


@pytest.mark.parametrize("base", ["sparse", "colmap/sparse", "."])
@pytest.mark.parametrize("counts", [{"0": 2, "1": 5}, {"0": 5, "1": 2}, {"0": 1, "2": 3, "10": 4}, {"0": 3, ".": 3}])
def test_largest_model_is_selected(tmp_path, base, counts):
    for name, count in counts.items():
        write_colmap(tmp_path / base / name, make_poses(count))
    best = max(counts, key=lambda name: counts[name])
    assert find_pose_source(tmp_path).resolve() == (tmp_path / base / best).resolve()
    (note,) = describe_other_models(tmp_path / base / best)
    assert f"of {len(counts)} COLMAP models" in note and f"({max(counts.values())} images) is used" in note


def test_binary_models_are_counted_by_their_header(tmp_path):
    assert describe_other_models(write_colmap(tmp_path / "other/sparse/0", make_poses(2))) == []
    for name, count in (("0", 2), ("1", 24)):
        (tmp_path / "sparse" / name).mkdir(parents=True)
        for file in ("cameras.bin", "images.bin"):
            (tmp_path / "sparse" / name / file).write_bytes(count.to_bytes(8, "little"))
    assert find_pose_source(tmp_path).name == "1"
    assert describe_other_models(tmp_path / "sparse/0")[0].endswith('"0" (2 images) is used, but not "1" (24 images)')


def test_notes_on_a_model_come_with_its_poses(tmp_path):
    for name, count in (("0", 2), ("1", 4)):
        write_colmap(tmp_path / "sparse" / name, make_poses(count))
    images = tmp_path / "sparse/1/images.txt"
    images.write_text("# Number of images: 24, mean observations per image: 0\n" + images.read_text())
    few, other = read_named_poses(find_pose_source(tmp_path)).notes
    assert "has 4 records, but its header states 24" in few and '"1" (4 images) is used' in other


# ---- Up direction of cameras and points with known ground truth ----

SOME = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()


def make_ring(
    count: int = 24, arc: float = 2 * np.pi, down: float = 30.0, roll: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Cameras on an arc around the z axis, pitched ``down`` by an angle in degrees and rolled by up to ``roll``."""
    rng, out = np.random.default_rng(seed), []
    for a in np.linspace(0, arc, count, endpoint=False):
        back = np.array([np.cos(a) * np.cos(np.radians(down)), np.sin(a) * np.cos(np.radians(down)), 0])
        back[2] = np.sin(np.radians(down))
        right = np.cross([0, 0, 1], back) / np.cos(np.radians(down))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-roll, roll))]).as_matrix()
        pose[:3, 3] = 3 * back + [0, 0, 1]
        out.append(pose)
    return np.array(out)


def rotate(poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    out = poses.copy()
    out[:, :3] = SOME @ poses[:, :3]
    return out, points @ SOME.T


def angle(up: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(up @ SOME[:, 2], -1, 1))))


EMPTY = np.zeros((0, 3))


@pytest.mark.parametrize("arc, max_pitch", [(2 * np.pi, 0.01), (np.pi, 1.0), (np.pi / 2, 4.0)])
def test_level_cameras_determine_up_at_any_pitch(arc, max_pitch):
    up = estimate_up(*rotate(make_ring(arc=arc), EMPTY))
    assert (
        angle(up.direction) < max_pitch and up.median_roll < max_pitch and up.plane_fraction is None and up.is_reliable
    )


def test_parallel_cameras_determine_up_by_image_tops():
    """Their horizontal axes agree, and leave the pitch undetermined."""
    up = estimate_up(*rotate(np.repeat(make_ring(1, down=10), 8, axis=0), EMPTY))
    assert angle(up.direction) == pytest.approx(10, abs=0.01)


def test_few_rolled_cameras_do_not_matter():
    poses = make_ring(30)
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    poses[::6, :3, :3] = poses[::6, :3, :3] @ quarter
    up = estimate_up(*rotate(poses, EMPTY))
    assert angle(up.direction) < 1 and up.is_reliable


def floor(count: int = 900, walls: int = 900) -> np.ndarray:
    rng = np.random.default_rng(3)
    ground = rng.uniform(-2, 2, (count, 3)) * [1, 1, 0.003]
    wall = rng.uniform(-2, 2, (walls, 3)) * [1, 0.003, 1] + [0, 2, 1]
    return np.concatenate([ground, wall, rng.uniform(-2, 2, (300, 3))])


def test_floor_is_more_precise_than_cameras():
    poses, points = rotate(make_ring(roll=20, seed=1), floor())
    by_hands, up = estimate_up(poses, EMPTY), estimate_up(poses, points)
    assert angle(up.direction) < 0.3 < angle(by_hands.direction)
    assert 0.35 < up.plane_fraction < 0.55 and up.plane_angle == pytest.approx(angle(by_hands.direction), abs=0.4)
    assert "plane of" in str(up) and "no level plane" in str(by_hands)


def test_walls_ceilings_and_lines_are_not_floors():
    poses = make_ring()
    walls = floor(count=0)
    ceiling = floor(walls=0) + [0, 0, 6]
    edge = np.random.default_rng(0).uniform(-2, 2, (900, 3)) * [1, 0.003, 0.003]
    for points in (walls, ceiling, edge):
        assert estimate_up(*rotate(poses, points)).plane_fraction is None


def test_disagreeing_cameras_are_unreliable():
    assert not estimate_up(*rotate(make_ring(roll=180), EMPTY)).is_reliable


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, 0, -0.8]])
def test_up_becomes_z(up):
    turn = rotation_to_z(np.array(up, float))
    assert np.allclose(turn @ up, [0, 0, 1]) and np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) > 0
