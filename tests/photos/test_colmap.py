"""COLMAP models, built byte by byte and line by line here: cameras, poses, points, and what cannot be read."""

import hashlib
import struct
import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.photos import colmap
from nerg_mi.photos.colmap import model_files, read_colmap, read_image_poses

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
        # Observations, as many as the image's number: x, y, point.
        out += struct.pack("<Q", k) + b"".join(struct.pack("<ddq", 1.5, 2.5, -1) for _ in range(k))
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
            " ".join("1.5 2.5 -1" for _ in range(k)),
        ]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# 3D point list"]
    for k, p in enumerate(POINTS):
        lines.append(f"{k + 1} {show(p)} 10 20 30 {ERRORS[k]} " + " ".join(f"1 {j}" for j in range(TRACKS[k])))
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


NAMES = [f"room {k}/photo {k}.png" for k in range(1, 11)]


@pytest.fixture(params=["bin", "txt"])
def model(request, tmp_path):
    """A model of ten images, each with its own camera, beside empty image files."""
    for name in NAMES:
        (tmp_path / "images" / name).parent.mkdir(parents=True)
        (tmp_path / "images" / name).write_bytes(b"")
    folder = tmp_path / "sparse/0"
    folder.mkdir(parents=True)
    {"bin": write_bin, "txt": write_txt}[request.param](folder, NAMES)
    return folder


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
        # A point before COLMAP's camera (z forward, y down) is at the same place seen from ours (z back, y up).
        local = np.array([0.3, -0.2, 2.0])
        world = rotations[k].T @ (local - translations[k])
        ours = np.linalg.inv(frame.to_world) @ [*world, 1]
        assert np.allclose(ours[:3], local * [1, -1, -1], atol=1e-12)
        assert np.isclose(np.linalg.det(frame.to_world[:3, :3]), 1)
        assert frame.image.is_file()
    assert np.array_equal(posed.points, POINTS[TRUSTED])


def test_an_unsupported_camera_model_costs_its_images_only(model):
    posed = read_colmap(model, model.parents[1] / "images")
    assert [u.name for u in posed.unused] == [NAMES[9]] and '"FOV"' in posed.unused[0].reason
    assert "image_undistorter" in posed.unused[0].reason


def test_missing_images_and_masks_are_listed(model):
    images, masks = model.parents[1] / "images", model.parents[1] / "masks"
    (images / NAMES[0]).unlink()
    for k in (1, 2):
        (masks / NAMES[k]).parent.mkdir(parents=True)
    (masks / (NAMES[1] + ".png")).write_bytes(b"")
    (masks / NAMES[2]).write_bytes(b"")
    posed = read_colmap(model, images, masks)
    assert [f.name for f in posed.frames] == sorted(NAMES[1:3]) and not any(f.mask.hides for f in posed.frames)
    reasons = {u.name: u.reason for u in posed.unused}
    assert "does not exist" in reasons[NAMES[0]] and "mask" in reasons[NAMES[3]]


def test_a_zero_quaternion_is_listed(tmp_path):
    write_txt(tmp_path, ["a.png", "b.png"])
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"")
    text = (tmp_path / "images.txt").read_text().splitlines()
    words = text[1].split()
    text[1] = " ".join([words[0], "0", "0", "0", "0", *words[5:]])
    (tmp_path / "images.txt").write_text("\n".join(text))
    posed = read_colmap(tmp_path, tmp_path)
    assert [f.name for f in posed.frames] == ["b.png"] and "quaternion" in posed.unused[0].reason


@pytest.mark.parametrize(
    "name, record", [("cameras", "camera record"), ("images", "image record"), ("points3D", "point record")]
)
def test_a_binary_file_cut_short_is_told_with_its_place(tmp_path, name, record):
    (tmp_path / "a.png").write_bytes(b"")
    write_bin(tmp_path, ["a.png"])
    path = tmp_path / f"{name}.bin"
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(ValueError, match=f"{name}.bin.*ends in the middle of {record}"):
        read_colmap(tmp_path, tmp_path)


def test_an_unknown_model_number_ends_a_binary_file(tmp_path):
    write_bin(tmp_path, ["a.png"], {1: (99, "NEW", 40, 30, (1.0,))})
    with pytest.raises(ValueError, match="99.*model_converter"):
        read_colmap(tmp_path, tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_bad_line_of_text_is_numbered(tmp_path, name):
    (tmp_path / "a.png").write_bytes(b"")
    write_txt(tmp_path, ["a.png"])
    path = tmp_path / f"{name}.txt"
    path.write_text("# one line more\n" + path.read_text().splitlines()[0] + "\n1 SIMPLE x y\n")
    with pytest.raises(ValueError, match=f'line 3 of ".*{name}.txt"'):
        read_colmap(tmp_path, tmp_path)


def test_a_folder_without_a_model(tmp_path):
    assert model_files(tmp_path) is None
    with pytest.raises(FileNotFoundError, match="no COLMAP model"):
        read_colmap(tmp_path, tmp_path)


@pytest.mark.parametrize("write", [write_bin, write_txt])
def test_images_outside_of_the_capture_are_used_only_if_allowed(tmp_path, write):
    """The capture is the folder that holds ``images``, however deep the model lies beside them."""
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
    assert all("outside of the data set's folder" in u.reason and "--allow-outside" in u.reason for u in posed.unused)
    # They all lead to one file, which counts once.
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


@pytest.mark.parametrize("count", [2**63, 2**64 - 1, 10**9])
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_counts_beyond_the_file_are_told_with_its_name(tmp_path, name, count):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(b"")
    write_bin(tmp_path, ["a.png"])
    raw = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(struct.pack("<Q", count) + raw[8:])
    with pytest.raises(NergError, match=name):
        read_colmap(tmp_path, tmp_path / "images")


def test_observations_may_stand_on_a_long_line_and_nothing_else(tmp_path):
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
    monkeypatch.setattr(colmap, "_PIECE", 1 << 21)
    (tmp_path / "cameras.txt").write_bytes(bytes(1 << 23))
    with pytest.raises(NergError, match="1.*cameras.txt.*2,097,152"):
        read_colmap(tmp_path, tmp_path / "images")


def images_text(observations):
    """Ten images; ``observations(k)``: what follows the line of the k-th, a list of lines."""
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


def test_names_that_are_numbers_are_no_observations(tmp_path):
    write_txt(tmp_path, ["0001", "0002", "0003"])
    text = (tmp_path / "images.txt").read_text().splitlines()
    (tmp_path / "images.txt").write_text("\n".join(line for line in text if "-1" not in line or "000" in line))
    assert [name for name, _ in read_image_poses(tmp_path)[2]] == ["0001", "0002", "0003"]


def test_a_line_that_is_neither_is_refused(tmp_path):
    write_txt(tmp_path, NAMES)
    (tmp_path / "images.txt").write_text(images_text(lambda k: ["1.5 2.5 -1 3.5"]))
    with pytest.raises(NergError, match="line 2 of"):
        read_image_poses(tmp_path)


@pytest.mark.parametrize("name, what", [("cameras", "cameras"), ("images", "images"), ("points3D", "points")])
def test_a_text_file_with_another_count_than_its_header_is_noted(tmp_path, name, what):
    (tmp_path / "a.png").write_bytes(b"")
    write_txt(tmp_path, ["a.png"], {1: CAMERAS[1]})
    path, counts = tmp_path / f"{name}.txt", {"cameras": 1, "images": 1, "points3D": len(POINTS)}
    text = path.read_text()
    path.write_text(f"# Number of {what}: {counts[name]}, mean observations: 2\n{text}")
    assert read_colmap(tmp_path, tmp_path).notes == []
    path.write_text(f"# Number of {what}: 24, mean observations: 2\n{text}")
    (note,) = read_colmap(tmp_path, tmp_path).notes
    assert f"{name}.txt" in note and f"has {counts[name]} records" in note and "states 24" in note


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_file_with_more_than_its_header_states_is_refused(tmp_path, name):
    (tmp_path / "a.png").write_bytes(b"")
    write_bin(tmp_path, ["a.png", "b.png"])
    path = tmp_path / f"{name}.bin"
    raw = path.read_bytes()
    path.write_bytes(struct.pack("<Q", struct.unpack("<Q", raw[:8])[0] - 1) + raw[8:])
    with pytest.raises(NergError, match=f"{name}.bin.* more bytes than the"):
        read_colmap(tmp_path, tmp_path)


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
def test_more_than_is_read_is_refused_before_it_is_read(tmp_path, monkeypatch, write, name):
    (tmp_path / NAMES[0]).parent.mkdir()
    (tmp_path / NAMES[0]).write_bytes(b"")
    monkeypatch.setattr(colmap, "file_sha256", lambda path: pytest.fail("it was read to its end"))
    write(tmp_path, NAMES[:1], {} if name == "images" else {1: CAMERAS[1]})
    with monkeypatch.context() as limits, pytest.raises(NergError, match=f"{name}.* more than the 0 that are read"):
        limits.setattr(colmap, "POINTS" if name == "points3D" else "IMAGES", 0)
        read_colmap(tmp_path, tmp_path)
    path = next(tmp_path.glob(f"{name}.*"))
    with path.open("r+b") as out:
        out.truncate(64 << 30)
    with pytest.raises(NergError, match=f"{name}.* has 68,719,476,736 bytes, more than"):
        read_colmap(tmp_path, tmp_path)
