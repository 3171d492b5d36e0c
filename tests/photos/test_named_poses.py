"""Poses by names, without images."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.photos.colmap import describe_other_models, find_source, read_named_poses
from nerg_mi.photos.transforms import read_transforms


def write_transforms(path, poses):
    frames = [{"file_path": name, "transform_matrix": pose.tolist()} for name, pose in poses.items()]
    path.write_text(json.dumps({"frames": frames}))
    return path


def write_colmap(folder, poses):
    """A text model of OpenGL camera-to-world poses: COLMAP's are world-to-camera, y down and z forward."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    text = "# images\n"
    for k, (name, pose) in enumerate(poses.items()):
        x, y, z, w = Rotation.from_matrix((pose[:3, :3] @ np.diag([1, -1, -1])).T).as_quat()
        t = -(pose[:3, :3] @ np.diag([1, -1, -1])).T @ pose[:3, 3]
        text += f"{k + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {name}\n\n"
    (folder / "images.txt").write_text(text)
    return folder


def some_poses(n=4):
    rng = np.random.default_rng(1)
    poses = {}
    for k in range(n):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=k).as_matrix(), rng.normal(size=3)
        poses[f"images/scene_{k:04d}.jpg"] = pose
    return poses


def test_both_kinds_give_the_same_poses(tmp_path):
    poses = some_poses()
    a = read_named_poses(write_transforms(tmp_path / "transforms.json", poses))
    b = read_named_poses(write_colmap(tmp_path / "sparse", poses))
    for found in (a, b):
        assert found.names == list(poses) and np.allclose(found.to_world, list(poses.values()), atol=1e-12)
    assert a.path.name == "transforms.json" and b.path.name == "images.txt" and a.sha256 != b.sha256


def test_the_checksum_is_that_of_a_training(tmp_path):
    poses = some_poses(2)
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
def test_what_is_no_pose(tmp_path, frames, message):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": frames}))
    with pytest.raises(NergError, match=message):
        read_named_poses(path)


def test_a_model_whose_quaternion_is_zero(tmp_path):
    folder = write_colmap(tmp_path / "sparse", some_poses(1))
    (folder / "images.txt").write_text("1 0 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(NergError, match='image "a.jpg" of .*its quaternion is zero'):
        read_named_poses(folder)


@pytest.mark.parametrize("base", ["sparse", "colmap/sparse", "."])
@pytest.mark.parametrize("counts", [{"0": 2, "1": 5}, {"0": 5, "1": 2}, {"0": 1, "2": 3, "10": 4}, {"0": 3, ".": 3}])
def test_of_several_models_the_largest_is_taken(tmp_path, base, counts):
    for name, count in counts.items():
        write_colmap(tmp_path / base / name, some_poses(count))
    best = max(counts, key=lambda name: counts[name])
    assert find_source(tmp_path).resolve() == (tmp_path / base / best).resolve()
    (note,) = describe_other_models(tmp_path / base / best)
    assert f"of {len(counts)} COLMAP models" in note and f"({max(counts.values())} images) is used" in note


def test_binary_models_are_counted_by_their_header(tmp_path):
    for name, count in (("0", 2), ("1", 24)):
        (tmp_path / "sparse" / name).mkdir(parents=True)
        for file in ("cameras.bin", "images.bin"):
            (tmp_path / "sparse" / name / file).write_bytes(count.to_bytes(8, "little"))
    assert find_source(tmp_path).name == "1"
    assert describe_other_models(tmp_path / "sparse/0")[0].endswith('"0" (2 images) is used, and not "1" (24 images)')


def test_a_single_model_needs_no_note(tmp_path):
    assert describe_other_models(write_colmap(tmp_path / "sparse/0", some_poses(2))) == []


def test_notes_on_a_model_come_with_its_poses(tmp_path):
    for name, count in (("0", 2), ("1", 4)):
        write_colmap(tmp_path / "sparse" / name, some_poses(count))
    images = tmp_path / "sparse/1/images.txt"
    images.write_text("# Number of images: 24, mean observations per image: 0\n" + images.read_text())
    few, other = read_named_poses(find_source(tmp_path)).notes
    assert "has 4 records, but its header states 24" in few and '"1" (4 images) is used' in other
