"""Skeleton files as rays."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.skeleton import RIGHT_EAR, SKELETONS, keypoints_from_head, parse_keypoints, write_skeleton
from tests.rays.readers.reading import dropped, read
from tests.rays.readers.test_skeleton_skeleton_file import heads, poses_of

# A head that looks along x, with y to its left and z up, in metres from between the ears; and its trunk.
FORWARD = np.array([1.0, 0, 0])
HEAD = {
    "left_ear": (0, 0.075, 0),
    "right_ear": (0, -0.075, 0),
    "nose": (0.12, 0, 0),
    "left_eye": (0.09, 0.03, 0),
    "right_eye": (0.09, -0.03, 0),
    "head": (0, 0, 0),
    "left_shoulder": (0, 0.2, -0.25),
    "right_shoulder": (0, -0.2, -0.25),
    "pelvis": (0, 0, -0.7),
    "left_hip": (0.02, 0.1, -0.7),
    "right_hip": (0.02, -0.1, -0.7),
}
# Written out of the conventions' own lists: nose, left and right eye, left and right ear.
FACES = {
    "coco17": (0, 1, 2, 3, 4),
    "body25": (0, 16, 15, 18, 17),
    "mediapipe33": (0, 2, 5, 7, 8),
    "kinect32": (27, 28, 30, 29, 31),
}


def bodies_of(name, n=20, seed=0):
    """Bodies (n, K, 3) turned in all directions, of which the joints that are not oriented by lie anywhere; and how
    they are turned, and where the heads are."""
    rng = np.random.default_rng(seed)
    turn, place = Rotation.from_quat(rng.normal(size=(n, 4))), rng.uniform([-4, -4, 1.2], [4, 4, 1.9], (n, 3))
    keypoints = place[:, None] + rng.normal(0, 0.5, (n, SKELETONS[name].keypoints, 3))
    for joint, k in SKELETONS[name].joints.items():
        keypoints[:, k] = turn.apply(HEAD[joint]) + place
    for joint, k in zip(("nose", "left_eye", "right_eye", "left_ear", "right_ear"), FACES.get(name, ())):
        keypoints[:, k] = turn.apply(HEAD[joint]) + place
    return keypoints, turn, place


@pytest.mark.parametrize("name", [*FACES, "kinect25"])
def test_heads_in_all_directions(tmp_path, name):
    keypoints, turn, place = bodies_of(name)
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 20, np.arange(20), keypoints)
    said = name == "kinect25"
    rays = read("skeleton", path, skeleton=name if said else None)
    assert np.abs(rays.direction - turn.apply(FORWARD)).max() < 3e-5 and np.abs(rays.origin - place).max() < 1e-5
    assert rays.metadata["skeleton"] == name
    (complaint,) = rays.metadata["complaints"]  # the skeleton was taken by its number of keypoints, or has no face
    assert ("where the trunk faces" if said else f"taken for {SKELETONS[name].title}") in complaint
    if not said:
        by_eyes = read("skeleton", path, skeleton=name, keypoints=("left_ear", "right_ear", "left_eye+right_eye"))
        assert np.abs(by_eyes.direction - turn.apply(FORWARD)).max() < 3e-5
        assert "complaints" not in by_eyes.metadata
        up = read("skeleton", path, pitch=30)
        assert np.abs(up.direction - turn.apply([np.sqrt(0.75), 0, 0.5])).max() < 3e-5


def test_units_and_axes(tmp_path):
    """Azure Kinect: millimetres, x right, y down, z away from the camera."""
    keypoints, turn, place = bodies_of("kinect32")
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 20, np.arange(20), 1000 * keypoints[..., [0, 2, 1]] * [1, -1, 1])
    rays = read("skeleton", path, up="-y", units="mm")
    assert np.abs(rays.direction - turn.apply(FORWARD)).max() < 1e-5 and np.abs(rays.origin - place).max() < 1e-5
    mirrored = read("skeleton", path, up="-y", units="mm", handedness="left")
    assert np.allclose(mirrored.origin * [1, -1, 1], rays.origin)
    # In metres the heads would be 150 m wide.
    assert "are 150 m apart" in read("skeleton", path).metadata["complaints"][1]


@pytest.mark.parametrize("name, sure", [("coco17", 1.0), ("mediapipe33", 1.0), ("kinect32", 2.0)])
def test_keypoints_that_were_not_seen(tmp_path, name, sure):
    """NaN, exact zeros and a confidence of 0 are missing; what is not of the head may be."""
    nose, _, _, left_ear, right_ear = FACES[name]
    keypoints, turn, _ = bodies_of(name)
    rows = np.concatenate([keypoints, np.full((*keypoints.shape[:2], 1), sure)], axis=2)
    rows[3, nose, :3] = np.nan
    rows[4, left_ear, :3] = 0
    rows[5, right_ear, 3] = 0
    rows[6, 6] = 0
    rows[7, nose, 3] = 0.5 * sure
    rows[8, right_ear, :2] = 0  # beside the camera, not at it
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 20, np.arange(20), rows)
    rays = read("skeleton", path)
    assert dropped(rays) == {"a keypoint of the head is missing": [[4, 6]]}
    there = ~np.isin(np.arange(20), [3, 4, 5])
    assert rays.confidence.tolist() == np.where(np.arange(20) == 7, 0.5, 1.0)[there].tolist()
    there[8] = False
    assert np.abs(rays.direction[np.isin(rays.t, np.flatnonzero(there))] - turn.apply(FORWARD)[there]).max() < 3e-5
    # Without confidences the same, but for what only they say.
    write_skeleton(path, ["ann"] * 20, np.arange(20), rows[..., :3])
    assert dropped(read("skeleton", path)) == {"a keypoint of the head is missing": [[4, 5]]}


@pytest.mark.parametrize("fill", [-1, -9999, -32768, 3.402823e38])
def test_keypoints_that_are_fill_values(tmp_path, fill):
    keypoints, turn, _ = bodies_of("coco17")
    keypoints[3, 0], keypoints[4, 4], keypoints[5, 12] = fill, fill, fill
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 20, np.arange(20), keypoints)
    rays = read("skeleton", path)
    assert dropped(rays) == {"a keypoint of the head is missing": [[4, 5]]}
    assert np.abs(rays.direction - turn.apply(FORWARD)[np.isin(np.arange(20), rays.t)]).max() < 3e-5


def test_bodies_that_are_in_no_place(tmp_path):
    keypoints, _, _ = bodies_of("mediapipe33")
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 20, np.arange(20), keypoints - keypoints[:, 23:25].mean(axis=1, keepdims=True))
    assert "with their hips at the origin" in read("skeleton", path).metadata["complaints"][1]


def test_skeletons_that_are_none(tmp_path):
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 2, np.arange(2), np.ones((2, 19, 3)))
    with pytest.raises(NergError, match="57.*nerg22.*22.*coco17.*17.*kinect25.*25"):
        read("skeleton", path)
    with pytest.raises(NergError, match="57.*coco17.*17"):
        read("skeleton", path, skeleton="coco17")
    with pytest.raises(NergError, match="--skeleton.*nerg22.*coco17"):
        read("skeleton", path, skeleton="coco18")
    write_skeleton(path, ["ann"] * 2, np.arange(2), np.ones((2, 17, 3)))
    for place in (17, "chin", "left_ear+", "-1"):
        with pytest.raises(NergError, match="COCO-17.*0.*16"):
            read("skeleton", path, keypoints=(3, 4, place))
    with pytest.raises(NergError, match="3.*left_ear.*0"):
        read("skeleton", path, keypoints=(3, "left_ear", 0))
    path.write_text(path.read_text() + f"ann|3|[{', '.join(['1'] * 75)}]\n")
    with pytest.raises(NergError, match="3.*75.*51.*17"):
        read("skeleton", path)


def test_rays_of_the_papers_tracking(tmp_path):
    origin, direction = heads(50)
    body = keypoints_from_head(origin, direction)
    body[7, RIGHT_EAR] = np.nan
    path = tmp_path / "day.csv.gz"
    write_skeleton(path, [f"p{i % 3}" for i in range(50)], np.arange(50), body)
    rays = read("skeleton22", path, tick=0.1)  # as it was called
    keep = np.arange(50) != 7
    assert len(rays) == 49 and rays.persons == ("p0", "p1", "p2") and rays.hit is None
    assert np.allclose(rays.t, np.arange(50)[keep] * 0.1)
    assert np.abs(rays.direction - direction[keep]).max() < 2e-5  # micrometres in the file
    assert rays.metadata["dropped"] == [
        {"reason": "a keypoint of the head is missing", "file": "day.csv.gz", "count": 1, "rows": [[8, 8]]}
    ]
    assert rays.metadata["preset"] == "skeleton" and rays.metadata["skeleton"] == "nerg22"
    assert rays.metadata["unused_columns"] == [f"keypoint {k}" for k in range(22) if k not in (2, 11, 13)]
    assert "complaints" not in rays.metadata


def test_other_keypoints_and_pitch(tmp_path):
    origin, direction = (v[2:] for v in heads(40))
    body = keypoints_from_head(origin, direction)
    swapped = body[:, ::-1]
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 38, np.arange(38), swapped)
    rays = read("skeleton", path, keypoints=(19, 8, 10), pitch=10)
    assert np.allclose(rays.direction, poses_of(body, pitch=10)[1], atol=2e-5) and rays.metadata["pitch"] == 10
    path.write_text(path.read_text().replace(f"{swapped[3, 8, 0]:.6f}", "left"))
    with pytest.raises(ValueError, match="4.*'left'"):
        read("skeleton", path, keypoints=(19, 8, 10))


def test_keypoints_of_the_command_line():
    assert parse_keypoints("19,8,10") == (19, 8, 10)
    assert parse_keypoints("left_ear, 4,left_eye+right_eye") == ("left_ear", 4, "left_eye+right_eye")
    for text in ("1,2", "1,2,3,4", "a,,c"):
        with pytest.raises(NergError, match="--keypoints is three places"):
            parse_keypoints(text)
