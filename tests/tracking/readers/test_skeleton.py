"""Tests of `nerg_mi.tracking.readers.skeleton`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers import skeleton
from nerg_mi.tracking.readers.skeleton import (
    RIGHT_EAR,
    SKELETONS,
    iterate_skeleton,
    keypoints_from_head,
    parse_keypoints,
    write_skeleton,
)
from tests.tracking.readers.examples import dropped, read

# ---- Head poses from skeletons, and bodies for given head poses ----


def heads(n=200, seed=0):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3))
    d[0], d[1] = (0, 0, -1), (0, 0, 1)  # straight down and up
    return rng.uniform([0, 0, 1.2], [8, 6, 1.9], (n, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


def poses_of(body, ears=(skeleton.LEFT_EAR, skeleton.RIGHT_EAR), nose=skeleton.NOSE, pitch=0.0):
    return skeleton.head_poses(*(body[:, k] for k in (*ears, nose)), pitch=pitch)


def test_body_has_exactly_its_head_pose():
    origin, direction = heads()
    body = skeleton.keypoints_from_head(origin, direction)
    o, d = poses_of(body)
    assert np.abs(o - origin).max() < 1e-6 and np.abs(d - direction).max() < 1e-6
    assert np.isfinite(body).all() and body[..., 2].min() > -0.05
    # The left ear is on the left of the direction of the head.
    side = body[2:, skeleton.LEFT_EAR] - body[2:, skeleton.RIGHT_EAR]
    left = np.cross([0, 0, 1.0], direction[2:])
    assert np.all(np.sum(side * left, axis=1) > 0)
    assert np.allclose(np.linalg.norm(side, axis=1), skeleton.EAR_DISTANCE)


def test_missing_keypoints_and_invalid_heads():
    origin, direction = heads(3)
    body = skeleton.keypoints_from_head(origin, direction)
    body[0, skeleton.NOSE] = np.nan
    body[1, skeleton.NOSE] = 0.5 * (body[1, skeleton.LEFT_EAR] + body[1, skeleton.RIGHT_EAR])
    _, d = poses_of(body)
    assert np.isnan(d[:2]).all() and np.isfinite(d[2]).all()
    with pytest.raises(ValueError, match="head pose 1"):
        skeleton.keypoints_from_head(origin, direction * [[1], [0], [1]])


def test_body_is_symmetric():
    origin, heading = np.array([[2.0, 3.0, 1.58], [0.0, -1.0, 0.79], [0.5, 0.0, 1.7]]), np.array([0.3, 2.0, -1.1])
    direction = np.stack([np.cos(heading), np.sin(heading), np.zeros(3)], axis=1)
    body = skeleton.keypoints_from_head(origin, direction)
    left = np.cross([0, 0, 1.0], direction)
    both_eyes, ears = (4, 15), (skeleton.LEFT_EAR, skeleton.RIGHT_EAR)
    pairs = np.array([ears, both_eyes, (0, 12), (3, 14), (5, 16), (6, 17), (7, 18), (8, 19), (9, 20)])
    # Mirrored in the plane through the midpoint of the ears and the direction of the head.
    aside = np.einsum("nkj,nj->nk", body - origin[:, None], left)[..., None]
    mirrored = body - 2 * aside * left[:, None]
    assert np.allclose(body[:, pairs[:, 0]], mirrored[:, pairs[:, 1]], atol=1e-12)
    assert (aside[:, pairs[:, 0], 0] > 0.01).all()
    assert np.allclose(aside[:, [10, skeleton.NOSE, 21]], 0)
    # The eyes are between the ears; heels, knees, hips and shoulders are above each other, in proportion to the height.
    between_eyes, between_ears = (np.linalg.norm(body[:, i] - body[:, j], axis=1) for i, j in (both_eyes, ears))
    assert (between_eyes < 0.6 * between_ears).all()
    heights = body[:, [5, 7, 6, 8], 2] / origin[:, 2:]
    assert (np.diff(heights, axis=1) > 0.1).all() and np.allclose(heights, heights[0])


def test_head_may_be_at_the_origin():
    for origin in ((0, 0, 1.6), (1, 0, 0)):
        assert np.allclose(poses_of(skeleton.keypoints_from_head([origin], [(1, 0, 0)]))[0], [origin])
    for origin in ((np.nan, 1, 1.6), (1, 1, np.inf)):
        with pytest.raises(ValueError, match="head pose 0"):
            skeleton.keypoints_from_head([origin], [(1, 0, 0)])


# ---- Skeleton file ----


@pytest.fixture
def poses():
    keypoints = np.random.default_rng(0).uniform(-9, 9, (7, 22, 3))
    keypoints[3, 11] = np.nan
    return list("abcabca"), np.arange(7) * 40, keypoints


@pytest.mark.parametrize("name", ["day.csv", "day.csv.gz"])
def test_round_trip(tmp_path, poses, name):
    ids, times, keypoints = poses
    path = tmp_path / name
    write_skeleton(path, ids, times, keypoints)
    (rows,) = iterate_skeleton(path)
    assert list(rows.ids) == ids and np.array_equal(rows.times, times) and np.array_equal(rows.lines, np.arange(1, 8))
    assert np.allclose(rows.keypoints, keypoints, atol=5.1e-7, equal_nan=True)
    first = path.read_bytes()
    write_skeleton(path, ids, times, keypoints)
    assert path.read_bytes() == first  # no clock in the file
    assert [len(run.ids) for run in iterate_skeleton(path, block_lines=3)] == [3, 3, 1]


def test_reads_the_published_layout(tmp_path):
    numbers = [float(i) for i in range(66)]
    numbers[4] = float("nan")
    path = tmp_path / "2023.csv"
    path.write_text(f"person 1|1698822000|{numbers}\n\n")
    (rows,) = iterate_skeleton(path)
    assert rows.ids[0] == "person 1" and rows.times[0] == 1698822000
    assert np.array_equal(rows.keypoints[0, 11], [33, 34, 35]) and np.isnan(rows.keypoints[0, 1, 1])


def test_writer_refuses_invalid_input(tmp_path, poses):
    ids, times, keypoints = poses
    path = tmp_path / "day.csv"
    for wrong, message in (
        ((ids[:3], times, keypoints), "one pose for each id"),
        ((ids, times * 0.5, keypoints), "integers"),
        ((["a|b", *ids[1:]], times, keypoints), "rename the participant"),
    ):
        with pytest.raises(ValueError, match=message):
            write_skeleton(path, *wrong)


@pytest.mark.parametrize("keypoints", [None, (21, 2, 13)])
def test_bad_lines_are_reported_and_skipped(tmp_path, poses, keypoints):
    path, reported = tmp_path / "day.csv", {}
    write_skeleton(path, *poses)
    good, zeros = path.read_text().splitlines(keepends=True), ", ".join(["0"] * 65)
    bad = {
        f"a|1|[{zeros}, x]\n": "'x' is not a number",
        "a|1\n": ": 2 fields",
        f"a|1,5|[{zeros}, 0]\n": "'1,5' is not a number",
        f"a|{1 << 63}|[{zeros}, 0]\n": "too large",
        f"a|1|{zeros}, 0\n": "not enclosed",
        "a|1|[0, 1]\n": ": 2 numbers, expected 66",
        good[0][:300]: "not enclosed",
    }
    path.write_text("".join(line for pair in zip(good, bad) for line in pair))
    (rows,) = iterate_skeleton(path, keypoints=keypoints, on_bad_line=reported.__setitem__)
    assert list(rows.ids) == poses[0] and rows.lines.tolist() == [1, 3, 5, 7, 9, 11, 13]
    assert sorted(reported) == [2, 4, 6, 8, 10, 12, 14]
    assert all(why in reported[line] for line, why in zip(sorted(reported), bad.values()))
    with pytest.raises(NergError, match="4.*2.*skip_bad_lines"):
        list(iterate_skeleton(path))


def test_times_with_fractions(tmp_path):
    path, zeros = tmp_path / "day.csv", ", ".join(["0"] * 66)
    path.write_text("".join(f"a|{time}|[{zeros}]\n" for time in (0, "0.04", "8e-2")))
    np.testing.assert_array_equal(next(iterate_skeleton(path)).times, [0, 0.04, 0.08])
    path.write_text("".join(f"a|{time}|[{zeros}]\n" for time in ((1 << 53) + 1, -3)))
    assert next(iterate_skeleton(path)).times.tolist() == [(1 << 53) + 1, -3]


@pytest.mark.parametrize("keypoints", [None, (0, 1, 2)])
def test_numbers_in_python_notation(tmp_path, keypoints):
    path = tmp_path / "day.csv"
    path.write_text("a|1|[" + ", ".join(["1_0"] * 66) + "]\n")
    (rows,) = iterate_skeleton(path, keypoints=keypoints)
    assert rows.keypoints[0, 0].tolist() == [10, 10, 10]


# ---- Skeleton files as rays ----

# A head that looks along x, with y to its left and z up, in metres relative to the midpoint of the ears; and its trunk.
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
# From the conventions' documentation: nose, left and right eye, left and right ear.
FACES = {
    "coco17": (0, 1, 2, 3, 4),
    "body25": (0, 16, 15, 18, 17),
    "mediapipe33": (0, 2, 5, 7, 8),
    "kinect32": (27, 28, 30, 29, 31),
}


def bodies_of(name, n=20, seed=0):
    """Bodies (n, K, 3) in all directions, with random positions of the joints that do not define the pose; and their
    rotations and head positions."""
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
    assert ("facing direction of the trunk" if said else f"{SKELETONS[name].title}") in complaint
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


@pytest.mark.parametrize("name, has_confidence", [("coco17", 1.0), ("mediapipe33", 1.0), ("kinect32", 2.0)])
def test_missing_keypoints(tmp_path, name, has_confidence):
    """NaN, exact zeros and a confidence of 0 are missing; keypoints outside the head may be missing."""
    nose, _, _, left_ear, right_ear = FACES[name]
    keypoints, turn, _ = bodies_of(name)
    rows = np.concatenate([keypoints, np.full((*keypoints.shape[:2], 1), has_confidence)], axis=2)
    rows[3, nose, :3] = np.nan
    rows[4, left_ear, :3] = 0
    rows[5, right_ear, 3] = 0
    rows[6, 6] = 0
    rows[7, nose, 3] = 0.5 * has_confidence
    rows[8, right_ear, :2] = 0  # next to the camera, not at it
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 20, np.arange(20), rows)
    rays = read("skeleton", path)
    assert dropped(rays) == {"a keypoint of the head is missing": [[4, 6]]}
    present = ~np.isin(np.arange(20), [3, 4, 5])
    assert rays.confidence.tolist() == np.where(np.arange(20) == 7, 0.5, 1.0)[present].tolist()
    present[8] = False
    assert np.abs(rays.direction[np.isin(rays.t, np.flatnonzero(present))] - turn.apply(FORWARD)[present]).max() < 3e-5
    # The same without confidences, except for keypoints that only these mark as missing.
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


def test_bodies_relative_to_their_hips_give_a_warning(tmp_path):
    keypoints, _, _ = bodies_of("mediapipe33")
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 20, np.arange(20), keypoints - keypoints[:, 23:25].mean(axis=1, keepdims=True))
    assert "have their hips at the origin" in read("skeleton", path).metadata["complaints"][1]


def test_unknown_skeletons_are_refused(tmp_path):
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 2, np.arange(2), np.ones((2, 19, 3)))
    with pytest.raises(NergError, match="57.*nerg22.*22.*coco17.*17.*kinect25.*25"):
        read("skeleton", path)
    with pytest.raises(NergError, match="57.*coco17.*17"):
        read("skeleton", path, skeleton="coco17")
    with pytest.raises(NergError, match="nerg22.*coco17.*skeleton"):
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
    rays = read("skeleton22", path, tick=0.1)  # its former name
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
        with pytest.raises(NergError, match="keypoints needs three keypoints"):
            parse_keypoints(text)
