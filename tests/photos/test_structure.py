"""Tests of `nerg_mi.photos.structure`."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from nerg_mi.alignment.similarity import fit_similarity
from nerg_mi.errors import NergError
from nerg_mi.photos import structure
from nerg_mi.photos.colmap import read_colmap
from nerg_mi.photos.images import read_image
from nerg_mi.photos.structure import (
    MAX_EXHAUSTIVE,
    PhotoCopy,
    PhotoFolders,
    StructureSettings,
    assign_cameras,
    check_installed,
    copy_photos,
    encode_image,
    encode_small_image,
    fit_size,
    list_photos,
    reconstruct,
    select_pairs,
    small_file_name,
)
from tests.photos import rendered

# ---- Image pairs ----


def test_few_images_are_all_matched():
    assert select_pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert len(select_pairs(MAX_EXHAUSTIVE)) == MAX_EXHAUSTIVE * (MAX_EXHAUSTIVE - 1) // 2
    assert select_pairs(4, "exhaustive") == select_pairs(4) and select_pairs(0) == []


def test_many_images_are_matched_with_neighbours_and_landmarks():
    pairs = select_pairs(600)
    assert pairs == sorted(set(pairs)) and all(0 <= i < j < 600 for i, j in pairs)
    assert {(5, 6), (5, 15), (5, 21), (5, 37), (0, 590)} <= set(pairs) and (5, 16) not in pairs
    # The work grows with the number of images, and not with its square.
    assert len(pairs) < 600 * 16 + 60 * 60 and len(select_pairs(4000)) < 4000 * 19 + 60 * 60


def test_exhaustive_matching_can_be_requested():
    assert len(select_pairs(150, "exhaustive")) == 150 * 149 // 2 > len(select_pairs(150, "sequential"))
    with pytest.raises(NergError, match="matching must be auto"):
        select_pairs(4, "vocabulary")


# ---- Photos of a folder: upright copies, and reasons for unusable files ----


def ramp(width: int = 48, height: int = 32, seed: int = 0) -> Image.Image:
    """A smooth image, red towards the right and green towards the bottom; the seed determines its blue."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return Image.fromarray(np.stack([x, y, np.full_like(x, 20 * seed)], axis=-1).astype(np.uint8))


@pytest.fixture
def folders(tmp_path) -> PhotoFolders:
    made = PhotoFolders(tmp_path / "images", tmp_path / "small")
    made.images.mkdir()
    made.small_images.mkdir()
    return made


def copy_all(folder: Path, folders: PhotoFolders, longest: int = 24):
    steps = []
    pictures, unused = copy_photos(list_photos(folder)[0], folders, longest, lambda *now: steps.append(now))
    assert steps and steps[-1][0] == steps[-1][1] == len(steps)
    return pictures, {u.name: u.reason for u in unused}


@pytest.fixture
def folder(tmp_path) -> Path:
    out = tmp_path / "photos"
    out.mkdir()
    return out


def test_upright_photo_is_copied_byte_by_byte(folder, folders):
    ramp().save(folder / "b.JPG", quality=90)
    ramp(seed=2).convert("L").save(folder / "a c.png")
    pictures, unused = copy_all(folder, folders)
    assert [p.name for p in pictures] == ["a c.png", "b.JPG"] and not unused
    for k, p in enumerate(pictures):
        assert (folders.images / p.name).read_bytes() == (folder / p.name).read_bytes()
        assert p.size == (48, 32) and p.small_size == (24, 16)
        assert Image.open(folders.small_images / small_file_name(k)).size == (24, 16)
        assert p.focal is None


# Directions of red and green in the file, so that after rotation red increases to the right and green downwards.
@pytest.mark.parametrize("orientation", range(1, 9))
def test_photo_is_rotated_by_exif(orientation, folder, folders):
    """EXIF tag 0x0112: the file of an upright image is created with the inverse of the viewer's transform."""
    undo = {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }
    stored = ramp() if orientation == 1 else ramp().transpose(undo[orientation])
    notes = Image.Exif()
    notes[0x0112] = orientation
    stored.save(folder / "a.jpg", quality=98, exif=notes)
    (picture,), unused = copy_all(folder, folders)
    assert picture.size == (48, 32) and not unused
    # As the trainer reads it, which ignores the orientation.
    seen = read_image(folders.images / "a.jpg").astype(int)
    assert np.abs(seen - np.asarray(ramp())).mean() < 3
    assert Image.open(folders.images / "a.jpg").getexif().get(0x0112, 1) == 1


def test_exif_has_focal_length_and_camera(folder, folders):
    notes = Image.Exif()
    notes[0x010F], notes[0x0110] = "Maker", "Model"
    notes.get_ifd(0x8769)[0xA405] = 26
    notes.get_ifd(0x8769)[0x920A] = 4.25
    ramp(360, 240).save(folder / "a.jpg", exif=notes)
    (picture,), _ = copy_all(folder, folders)
    # An image with the aspect ratio of film, on which 36 mm are 360 pixels.
    assert picture.focal == pytest.approx(260, rel=1e-4) and picture.camera_key[:2] == ("Maker", "Model")
    assert float(picture.camera_key[2]) == 4.25  # noqa: RUF069 (text)


def test_unusable_photos_are_listed(folder, folders):
    ramp().save(folder / "a.jpg", quality=95)
    ramp().save(folder / "b.jpg", quality=95)
    ramp(seed=5).save(folder / "good.jpg")
    raw = (folder / "good.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(raw[: len(raw) // 2])
    (folder / "empty.png").write_bytes(b"")
    (folder / "text.jpg").write_text("image format is not supported")
    ramp().save(folder / "gif.jpg", "gif")
    ramp().save(folder / "bmp.jpg", "bmp")
    ramp(seed=1).save(folder / "png.jpg", "png")
    (folder / "heic.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    ramp().quantize(16).save(folder / "palette.png")
    pictures, unused = copy_all(folder, folders)
    used = ["a.jpg", "good.jpg", "palette.png", "png.jpg"]
    assert [p.name for p in pictures] == used and {p.name for p in folders.images.iterdir()} == set(used)
    assert Image.open(folders.images / "palette.png").mode == "RGB"
    assert unused.pop("b.jpg") == 'it is the same file as "a.jpg"' and 'the format "bmp"' in unused.pop("bmp.jpg")
    assert set(unused) == {"cut.jpg", "empty.png", "text.jpg", "gif.jpg", "heic.jpg"}
    assert all("cannot be read" in reason and name in reason for name, reason in unused.items())


def test_links_out_of_the_folder_are_followed_only_if_allowed(folder, folders, tmp_path):
    ramp().save(tmp_path / "private.jpg")
    ramp(seed=1).save(folder / "a.jpg")
    (folder / "b.jpg").symlink_to(tmp_path / "private.jpg")
    (folder / "c.jpg").symlink_to("a.jpg")
    pictures, unused = copy_all(folder, folders)
    assert [p.name for p in pictures] == ["a.jpg"] and "same file" in unused["c.jpg"]
    assert "outside of" in unused["b.jpg"] and "allow_outside" in unused["b.jpg"]
    names, _ = copy_photos(list_photos(folder)[0], folders, 24, lambda *now: None, allow_outside=True)
    assert [p.name for p in names] == ["a.jpg", "b.jpg"]


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes on Linux alone")
def test_invalid_names_are_listed(folder, folders):
    ramp().save(folder / "good.jpg")
    for k, name in enumerate((b"caf\xe9.jpg", b"two\nlines.jpg", b"\x1b[31m.jpg")):
        ramp(seed=k + 1).save(folder / os.fsdecode(name))
    pictures, unused = copy_all(folder, folders)
    assert [p.name for p in pictures] == ["good.jpg"]
    assert len(unused) == 3 and all("rename it" in reason for reason in unused.values())


def test_photos_are_as_large_as_their_bytes_warrant(folder, folders, monkeypatch):
    ramp().save(folder / "a.png")
    raw = (folder / "a.png").read_bytes()
    claim = raw[12:16] + struct.pack(">II", 8193, 8193) + raw[24:29]
    (folder / "b.png").write_bytes(raw[:12] + claim + zlib.crc32(claim).to_bytes(4, "big") + raw[33:])
    with (folder / "c.jpg").open("wb") as file:
        file.truncate((1 << 28) + 1)
    pictures, unused = copy_all(folder, folders)
    assert [p.name for p in pictures] == ["a.png"]
    assert "8,193 x 8,193 pixels" in unused["b.png"] and "reduce its size" in unused["b.png"]
    assert "268,435,457 bytes" in unused["c.jpg"]
    # Rotated photos are stored as JPEG, which does not support longer sides.
    Image.new("L", (65_501, 1)).save(folder / "d.png")
    assert "a side of 65,501 pixels" in copy_all(folder, folders)[1]["d.png"]
    # Pillow's limit is below the size of current telephone photos.
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert [p.name for p in copy_all(folder, folders)[0]] == ["a.png"]


def test_unusual_exif_is_ignored(folder, folders):
    """Of each type and size. Pillow's own rotation writes the EXIF data again, and fails for some."""
    entry = lambda *numbers: struct.pack(">HHII", *numbers)
    notes = [
        entry(0x0112, 3, 0xFFFFFFFF, 8) + entry(0x8769, 4, 1 << 30, 8),
        entry(0x0112, 11, 1, 0x7FC00000),
        entry(0x0112, 2, 4, 0x36363636),
        entry(0x8769, 4, 1, 8) + entry(0x0112, 5, 1, 8),
    ]
    for k, photo in enumerate(notes):
        head = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">H", len(photo) // 12)
        # The following bytes are the same EXIF data again.
        ramp(seed=k).save(folder / f"{k}.jpg", exif=head + photo + struct.pack(">I", 8))
    damaged = b"Exif\0\0MM\0*\xff\xff\xff\xff" + bytes(range(256))
    ramp(seed=4).save(folder / "4.jpg", exif=damaged)
    pictures, unused = copy_all(folder, folders)
    assert [p.size for p in pictures] == [(48, 32)] * 5 and not unused
    assert pictures[4].camera_key in ((), ("", "", ""))


def test_unsupported_images_are_listed(folder):
    ramp().save(folder / "a.jpg")
    for name in ("b.HEIC", ".c.jpg", "notes.txt"):
        (folder / name).write_bytes(b"x")
    photos, unsupported = list_photos(folder)
    assert [p.name for p in photos] == ["a.jpg"] and [o.name for o in unsupported] == ["b.HEIC"]
    assert "JPEG and PNG" in unsupported[0].reason


def test_pipe_is_refused(folder, folders):
    ramp().save(folder / "a.jpg")
    os.mkfifo(folder / "b.jpg")
    pictures, unused = copy_all(folder, folders)
    assert [p.name for p in pictures] == ["a.jpg"] and 'b.jpg" is a pipe' in unused["b.jpg"]


def test_folder_without_photos_is_refused(folder, tmp_path):
    with pytest.raises(NergError, match="specify the folder"):
        list_photos(folder)
    (folder / "images").mkdir()
    with pytest.raises(NergError, match='did you mean ".*images"'):
        list_photos(folder)
    (folder / "a.heic").write_bytes(b"x")
    with pytest.raises(NergError, match="convert them"):
        list_photos(folder)
    with pytest.raises(NergError, match="there is no folder of photos"):
        list_photos(tmp_path / "nowhere")


# ---- Copies of images, and shared cameras ----


def test_the_longer_side_is_bounded():
    assert fit_size((1080, 1920), 960) == (540, 960)
    assert fit_size((640, 480), 960) == (640, 480) and fit_size((5000, 2), 960) == (960, 1)
    assert small_file_name(7) == "000007.png"


def test_small_copies_are_averages():
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:, ::2] = 200
    small = np.asarray(Image.open(io.BytesIO(encode_small_image(Image.fromarray(pixels), (15, 10)))))
    assert small.shape == (10, 15, 3) and abs(small.astype(int) - 100).max() <= 12
    assert np.array_equal(
        np.asarray(Image.open(io.BytesIO(encode_small_image(Image.fromarray(pixels), (60, 40))))), pixels
    )


@pytest.mark.parametrize("suffix, kind", [(".png", "PNG"), (".JPG", "JPEG"), (".jpeg", "JPEG")])
def test_encoding_follows_suffix(suffix, kind):
    image = Image.fromarray(np.full((8, 9), 77, np.uint8))
    opened = Image.open(io.BytesIO(encode_image(image, suffix)))
    assert opened.format == kind and opened.mode == "RGB" and opened.size == (9, 8)


def test_pictures_of_one_size_share_a_camera():
    upright, across = ((3, 4), (3, 4)), ((4, 3), (4, 3))
    sizes = [upright, across, upright, upright]
    pictures = [PhotoCopy(str(k), *size) for k, size in enumerate(sizes)]
    assert assign_cameras(pictures) == [0, 1, 0, 0] and assign_cameras(pictures, share_cameras=False) == [0, 1, 2, 3]
    made = [PhotoCopy(str(k), *upright, camera_key=("maker", focal)) for k, focal in enumerate(["4.2", "4.2", "9"])]
    assert assign_cameras(made) == [0, 0, 1]


# ---- The subprocess: its input, and explanations of failures ----

PICTURES = [PhotoCopy(f"{k}.jpg", (400, 300), (200, 150), focal=380.0 if k else None) for k in range(4)]


@pytest.fixture
def installed(monkeypatch):
    monkeypatch.setattr(structure, "check_installed", lambda: None)


def ending(monkeypatch, program: str) -> None:
    """Replace the worker by another process."""
    started = structure.subprocess.Popen
    monkeypatch.setattr(
        structure.subprocess,
        "Popen",
        lambda command, **more: started([sys.executable, "-c", program, command[-1]], **more),
    )


def settings_passed(tmp_path: Path) -> str:
    with pytest.raises(NergError) as said:
        reconstruct(PICTURES, tmp_path, StructureSettings(), lambda *now: None)
    return str(said.value)


def test_without_pycolmap(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for call in (check_installed, lambda: reconstruct(PICTURES, tmp_path, StructureSettings(), lambda *now: None)):
        with pytest.raises(ImportError, match=r'"nerg-mi\[poses\]"'):
            call()


def test_settings_are_passed_to_colmap(installed, monkeypatch, tmp_path):
    ending(monkeypatch, "import os; os._exit(3)")
    settings_passed(tmp_path)
    job = json.loads((tmp_path / "job.json").read_text())
    # The focal length is that of the small images, the median over the photos of the camera.
    assert job["cameras"] == [{"size": [400, 300], "small": [200, 150], "focal": 190.0, "pictures": 4}]
    assert [p["camera"] for p in job["pictures"]] == [0] * 4 and job["lens"] is None and job["threads"] == -1


@pytest.mark.parametrize(
    "settings, said",
    [(StructureSettings(lens="fish"), "lens must be auto"), (StructureSettings(matching="a"), "matching must be auto")],
)
def test_wrong_settings(installed, settings, said, tmp_path):
    with pytest.raises(NergError, match=said):
        reconstruct(PICTURES, tmp_path, settings, lambda *now: None)


@pytest.mark.parametrize(
    "program, said",
    [
        ("import sys; sys.exit('E1 a.cc:1] Check failed: x\\n  @ trace')", "Check failed: x"),
        ("raise ValueError('some reason')", r"with exit code 1 \(ValueError: some reason\)"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "memory was short"),
        ("import os; os.abort()", f"with exit code {-signal.SIGABRT}"),
    ],
)
def test_failures_of_colmap_are_explained(installed, program, said, monkeypatch, tmp_path):
    ending(monkeypatch, program)
    words = settings_passed(tmp_path)
    assert re.search(said, words) and "\n" not in words


def test_subprocess_ends_with_parent(installed, monkeypatch, tmp_path):
    """Ctrl-C arrives while its lines are read."""
    program = "import os, sys, time; print([os.getpid(), 0, 1], flush=True); time.sleep(600)"
    ending(monkeypatch, program)
    processes = []

    def progress(pid, done, total):
        processes.append(pid)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(PICTURES, tmp_path, StructureSettings(), progress)
    with pytest.raises(ProcessLookupError):
        os.kill(processes[0], 0)


# ---- Reconstruction of photos with known poses, in the subprocess ----


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    pytest.importorskip("pycolmap")
    return rendered.write_photos(tmp_path_factory.mktemp("photos"))


def find_poses(photos, work):
    """Return a reconstruction, its model as it is read, and the progress reports."""
    folders, steps = PhotoFolders(work / "images", work / "small"), []
    folders.images.mkdir()
    folders.small_images.mkdir()
    pictures, _ = copy_photos(list_photos(photos)[0], folders, 320, lambda *now: None)
    made = reconstruct(pictures, work, StructureSettings(threads=1), lambda *now: steps.append(now))
    return made, made and read_colmap(work / "sparse" / "0", folders.images), steps


def pose_errors(poses, reference):
    """Return the rotation errors in degrees, the distances of centres relative to the extent of the reference, and the
    similarity that aligns both.
    """
    similarity = fit_similarity(poses[:, :3, 3], reference[:, :3, 3])
    turn = similarity[:3, :3] / np.cbrt(np.linalg.det(similarity[:3, :3]))
    distances = np.swapaxes(reference[:, :3, :3], 1, 2) @ turn @ poses[:, :3, :3]
    centers = reference[:, :3, 3]
    away = poses[:, :3, 3] @ similarity[:3, :3].T + similarity[:3, 3] - centers
    extent = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    angles = np.degrees(Rotation.from_matrix(distances).magnitude())
    return angles, np.linalg.norm(away, axis=1) / extent, similarity


@pytest.fixture(scope="module")
def first(photos, tmp_path_factory):
    """A folder, and the reconstruction of the photos in it."""
    work = tmp_path_factory.mktemp("first")
    return work, find_poses(photos, work)


def test_poses_and_lens_are_estimated(first):
    made, model, steps = first[1]
    assert made.models == [[f"{k}.png" for k in range(8)]] and 0 < made.error < 0.5 and made.num_points > 300
    assert list(dict.fromkeys(stage for stage, _, _ in steps)) == ["features", "matching", "mapping"]
    assert steps[-1] == ("mapping", 8, 8)
    poses = np.array([f.to_world for f in model.frames])
    assert np.allclose(poses, made.to_world)
    angles, distances, similarity = pose_errors(poses, rendered.poses())
    assert angles.max() < 1 and distances.max() < 0.01
    # The model is upright, and its points are on a floor and a box on it.
    truth = similarity[:3, :3] / np.cbrt(np.linalg.det(similarity[:3, :3]))
    assert np.degrees(np.arccos(truth[2, 2])) < 1 and made.up.is_reliable and made.up.plane_fraction > 0.3
    points = model.points @ similarity[:3, :3].T + similarity[:3, 3]
    low, high = np.quantile(points[:, 2], [0.02, 0.98])
    assert low == pytest.approx(0, abs=0.03) and high == pytest.approx(0.7, abs=0.05)
    lens = model.frames[0].intrinsics(320, 240)
    assert lens.fx == lens.fy == pytest.approx(rendered.FOCAL, rel=0.02) and abs(lens.k1) < 0.05
    assert len(made.point_positions) == len(made.point_colors) and made.point_colors.dtype == np.uint8


@pytest.mark.nightly
def test_equal_photos_give_equal_poses_whatever_their_size(photos, first, tmp_path):
    """The second run uses larger photos of the same scene, whose small copies have the same pixels."""
    from PIL import Image

    (tmp_path / "large").mkdir()
    for path in photos.iterdir():
        Image.open(path).resize((960, 720), Image.Resampling.NEAREST).save(tmp_path / "large" / path.name)
    work, models = [first[0], tmp_path / "b", tmp_path / "c"], [first[1][1]]
    for at, folder in zip(work[1:], (photos, tmp_path / "large")):
        at.mkdir()
        models.append(find_poses(folder, at)[1])
    files = [[(at / "sparse" / "0" / f"{k}.bin").read_bytes() for k in ("images", "points3D")] for at in work[:2]]
    assert files[0] == files[1]
    large, small = models[2].frames[0].intrinsics(960, 720), models[0].frames[0].intrinsics(320, 240)
    assert large.fx == pytest.approx(3 * small.fx, rel=0.02) and large.cx == 480
    angles, distances, _ = pose_errors(*(np.array([f.to_world for f in m.frames]) for m in (models[2], models[0])))
    assert angles.max() < 0.5 and distances.max() < 0.01


def test_unrelated_photos_give_no_model(tmp_path):
    pytest.importorskip("pycolmap")
    from PIL import Image

    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.fromarray(np.full((60, 80, 3), 80 * k, np.uint8)).save(tmp_path / "photos" / f"{k}.png")
    assert find_poses(tmp_path / "photos", tmp_path)[0] is None


def test_standard_output_is_json_lines(photos, tmp_path):
    """The output and errors of libraries go to the standard error."""
    command = [sys.executable, "-m", "nerg_mi.photos.structure_worker", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and done.stdout == "" and "job.json" in done.stderr
