"""Tests of `nerg_mi.rays.readers.skeleton`."""

import gzip

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers import skeleton
from nerg_mi.rays.readers.skeleton import iterate_skeleton, read_skeleton, write_skeleton

# ---- Head poses of skeletons, and bodies for given ones ----


def heads(n=200, seed=0):
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3))
    d[0], d[1] = (0, 0, -1), (0, 0, 1)  # straight down and up
    return rng.uniform([0, 0, 1.2], [8, 6, 1.9], (n, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


def poses_of(body, ears=(skeleton.LEFT_EAR, skeleton.RIGHT_EAR), nose=skeleton.NOSE, pitch=0.0):
    return skeleton.head_poses(*(body[:, k] for k in (*ears, nose)), pitch=pitch)


def test_body_gives_exactly_its_head_pose():
    origin, direction = heads()
    body = skeleton.keypoints_from_head(origin, direction)
    o, d = poses_of(body)
    assert np.abs(o - origin).max() < 1e-6 and np.abs(d - direction).max() < 1e-6
    assert np.isfinite(body).all() and body[..., 2].min() > -0.05
    # The left ear is on the left of where the head looks.
    side = body[2:, skeleton.LEFT_EAR] - body[2:, skeleton.RIGHT_EAR]
    left = np.cross([0, 0, 1.0], direction[2:])
    assert np.all(np.sum(side * left, axis=1) > 0)
    assert np.allclose(np.linalg.norm(side, axis=1), skeleton.EAR_DISTANCE)


def test_unseen_keypoints_and_bad_heads():
    origin, direction = heads(3)
    body = skeleton.keypoints_from_head(origin, direction)
    body[0, skeleton.NOSE] = np.nan
    body[1, skeleton.NOSE] = 0.5 * (body[1, skeleton.LEFT_EAR] + body[1, skeleton.RIGHT_EAR])
    _, d = poses_of(body)
    assert np.isnan(d[:2]).all() and np.isfinite(d[2]).all()
    with pytest.raises(ValueError, match="head pose 1"):
        skeleton.keypoints_from_head(origin, direction * [[1], [0], [1]])


def test_other_keypoints_and_pitch():
    origin, direction = (v[2:] for v in heads(40))  # those that can be turned up
    body = skeleton.keypoints_from_head(origin, direction)
    swapped = body[:, ::-1]
    o, d = poses_of(swapped, ears=(21 - skeleton.LEFT_EAR, 21 - skeleton.RIGHT_EAR), nose=21 - skeleton.NOSE)
    assert np.allclose(o, origin) and np.allclose(d, direction)
    _, up = poses_of(body, pitch=10)
    elevation = lambda v: np.degrees(np.arcsin(v[:, 2]))
    low = elevation(direction) < 75
    assert np.allclose(elevation(up)[low] - elevation(direction)[low], 10)


def test_a_body_is_the_same_on_both_sides():
    origin, heading = np.array([[2.0, 3.0, 1.58], [0.0, -1.0, 0.79], [0.5, 0.0, 1.7]]), np.array([0.3, 2.0, -1.1])
    direction = np.stack([np.cos(heading), np.sin(heading), np.zeros(3)], axis=1)
    body = skeleton.keypoints_from_head(origin, direction)
    left = np.cross([0, 0, 1.0], direction)
    pairs = np.array(
        [
            (skeleton.LEFT_EAR, skeleton.RIGHT_EAR),
            (4, 15),
            (0, 12),
            (3, 14),
            (5, 16),
            (6, 17),
            (7, 18),
            (8, 19),
            (9, 20),
        ]
    )
    # Mirrored in the plane through the middle of the ears in which the head looks.
    aside = np.einsum("nkj,nj->nk", body - origin[:, None], left)[..., None]
    mirrored = body - 2 * aside * left[:, None]
    assert np.allclose(body[:, pairs[:, 0]], mirrored[:, pairs[:, 1]], atol=1e-12)
    assert (aside[:, pairs[:, 0], 0] > 0.01).all()
    assert np.allclose(aside[:, [10, skeleton.NOSE, 21]], 0)
    # The eyes lie between the ears; heels, knees, hips and shoulders one above the other, in proportion to the height.
    eyes, ears = (
        np.linalg.norm(body[:, i] - body[:, j], axis=1) for i, j in ((4, 15), (skeleton.LEFT_EAR, skeleton.RIGHT_EAR))
    )
    assert (eyes < 0.6 * ears).all()
    heights = body[:, [5, 7, 6, 8], 2] / origin[:, 2:]
    assert (np.diff(heights, axis=1) > 0.1).all() and np.allclose(heights, heights[0])


@pytest.mark.parametrize(
    "origin, bad", [((0, 0, 1.6), False), ((1, 0, 0), False), ((np.nan, 1, 1.6), True), ((1, 1, np.inf), True)]
)
def test_a_head_may_be_at_zero_but_not_nowhere(origin, bad):
    if bad:
        with pytest.raises(ValueError, match="head pose 0"):
            skeleton.keypoints_from_head([origin], [(1, 0, 0)])
    else:
        assert np.allclose(poses_of(skeleton.keypoints_from_head([origin], [(1, 0, 0)]))[0], [origin])


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
    rows = read_skeleton(path)
    assert list(rows.ids) == ids and np.array_equal(rows.times, times) and np.array_equal(rows.lines, np.arange(1, 8))
    assert np.allclose(rows.keypoints, keypoints, atol=5.1e-7, equal_nan=True)
    first = path.read_bytes()
    write_skeleton(path, ids, times, keypoints)
    assert path.read_bytes() == first  # no clock in the file
    assert [len(run.ids) for run in iterate_skeleton(path, chunk=3)] == [3, 3, 1]


def test_reads_the_published_layout(tmp_path):
    numbers = [float(i) for i in range(66)]
    numbers[4] = float("nan")
    path = tmp_path / "2023.csv"
    path.write_text(f"person 1|1698822000|{numbers}\n\n")
    rows = read_skeleton(path)
    assert rows.ids[0] == "person 1" and rows.times[0] == 1698822000
    assert np.array_equal(rows.keypoints[0, 11], [33, 34, 35]) and np.isnan(rows.keypoints[0, 1, 1])


@pytest.mark.parametrize(
    "line, message",
    [
        ("a|1", "line 2: 2 fields"),
        ("a|one|[" + ", ".join(["0"] * 66) + "]", "2.*'one'"),
        ("a|1|[0, 1]", "line 2: 2 numbers, expected 66"),
        ("a|1|" + ", ".join(["0"] * 66), "line 2: .* not enclosed"),
        ("a|1|[" + ", ".join(["0"] * 65 + ["x"]) + "]", "line 2: 'x' is not a number"),
    ],
)
def test_names_the_broken_line(tmp_path, poses, line, message):
    path = tmp_path / "day.csv"
    write_skeleton(path, *(v[:1] for v in poses))
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(ValueError, match=message):
        read_skeleton(path)


def test_writer_refuses(tmp_path, poses):
    ids, times, keypoints = poses
    path = tmp_path / "day.csv"
    with pytest.raises(ValueError, match="one pose for each id"):
        write_skeleton(path, ids[:3], times, keypoints)
    with pytest.raises(ValueError, match="integers"):
        write_skeleton(path, ids, times * 0.5, keypoints)
    with pytest.raises(ValueError, match="rename the person"):
        write_skeleton(path, ["a|b"] + ids[1:], times, keypoints)
    path.write_text("")
    with pytest.raises(ValueError, match="no poses"):
        read_skeleton(path)


def test_reads_gzip_of_others(tmp_path):
    path = tmp_path / "day.gz"
    with gzip.open(path, "wt") as out:
        out.write("a|1|[" + ", ".join(["1.5"] * 66) + "]\n")
    assert read_skeleton(path).keypoints.shape == (1, 22, 3)


def test_bad_lines_are_told_and_left_out(tmp_path, poses):
    path, bad_lines = tmp_path / "day.csv", []
    write_skeleton(path, *poses)
    good = path.read_text().splitlines(keepends=True)
    zeros = ", ".join(["0"] * 65)
    bad = [
        f"a|1|[{zeros}, x]\n",
        "a|1\n",
        f"a|1.5|[{zeros}, 0]\n",
        f"a|{1 << 63}|[{zeros}, 0]\n",
        f"a|1|{zeros}, 0\n",
        good[0][:300],
    ]
    path.write_text("".join(line for pair in zip(good, [*bad[:-1], "", ""]) for line in pair) + bad[-1])
    for keypoints in (None, (21, 2, 13)):
        bad_lines.clear()
        (rows,) = iterate_skeleton(path, keypoints=keypoints, on_bad=lambda line, why: bad_lines.append(line))
        assert (
            list(rows.ids) == poses[0]
            and rows.lines.tolist() == [1, 3, 5, 7, 9, 11, 12]
            and sorted(bad_lines) == [2, 4, 6, 8, 10, 13]
        )
    with pytest.raises(NergError, match="4.*2.*--skip-bad-lines"):
        read_skeleton(path)


@pytest.mark.parametrize("keypoints", [None, (0, 1, 2)])
def test_numbers_that_only_python_spells_so(tmp_path, keypoints):
    path = tmp_path / "day.csv"
    path.write_text("a|1|[" + ", ".join(["1_0"] * 66) + "]\n")
    (rows,) = iterate_skeleton(path, keypoints=keypoints)
    assert rows.keypoints[0, 0].tolist() == [10, 10, 10]
