"""Tests of `nerg_mi.tracking.readers.poses`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers import poses
from nerg_mi.tracking.readers.poses import FilledOriginFinder, PoseTrack, find_fill_values, is_aimed
from nerg_mi.tracking.readers.qualisys import iterate_gaze_vectors

# ---- Files of gaze vectors ----

HEAD = "FREQUENCY\t10\nSTART_OFFSET\t1\n"


def test_blocks_are_joined(tmp_path, monkeypatch):
    path = tmp_path / "a_g.tsv"
    path.write_text("\ufeff" + HEAD + "".join(f"{k}\t0\t1600\t1\t0\tNaN\n" for k in range(7)) + "\n\n")
    monkeypatch.setattr("nerg_mi.tracking.readers.qualisys._BLOCK", 3)
    blocks = list(iterate_gaze_vectors(path))
    times, vectors, samples, lines = (np.concatenate(v) for v in zip(*blocks))
    assert len(blocks) > 2 and np.allclose(times, 0.1 * np.arange(7) - 1) and samples.tolist() == list(range(7))
    assert lines.tolist() == list(range(3, 10)) and vectors[:, 0].tolist() == list(range(7))
    assert np.isnan(vectors[:, 5]).all()


def test_columns_in_any_order_with_prefixes(tmp_path):
    names = ["Sample", "Time", *(f"ann {a} Vec" for a in "XYZ"), *(f"ann {a} Pos" for a in "XYZ")]
    (tmp_path / "a_g.tsv").write_text("\t".join(names) + "\n1\t0.5\t1\t2\t3\t4\t5\t6\n")
    (block,) = iterate_gaze_vectors(tmp_path / "a_g.tsv")
    assert block.times.tolist() == [0.5] and block.vectors.tolist() == [[4, 5, 6, 1, 2, 3]]


@pytest.mark.parametrize("rate", ["FREQUENCY\tEXT\n", "FREQUENCY\t0\n", ""])
def test_unknown_times_are_refused(tmp_path, rate):
    (tmp_path / "a_g.tsv").write_text(rate + "1\t2\t3\t4\t5\t6\n")
    with pytest.raises(NergError, match="has no times"):
        list(iterate_gaze_vectors(tmp_path / "a_g.tsv"))


def test_bad_lines_count_as_samples(tmp_path):
    (tmp_path / "a_g.tsv").write_text(
        HEAD + "1\t2\t3\t4\t5\t6\n1\t2\t3\t4\t5\t6\t7\n1\t2\t3\t4\t5\tx\n1\t2\t3\t4\t5\t6\n"
    )
    reported = []
    (block,) = iterate_gaze_vectors(tmp_path / "a_g.tsv", lambda line, why: reported.append(line))
    assert reported == [4, 5] and np.allclose(block.times, [-1, -0.7]) and block.samples.tolist() == [0, 3]
    with pytest.raises(ValueError, match="4.*1.2.*7.*6"):
        list(iterate_gaze_vectors(tmp_path / "a_g.tsv"))


# ---- Poses between samples ----


def test_between_samples():
    """A quarter turn about z and two metres along x in a second, sampled ten times."""
    times = np.linspace(5, 6, 11)
    vectors = np.outer(times - 5, [0, 0, np.pi / 2])
    places = np.outer(times - 5, [2.0, 0, 0])
    track = PoseTrack.from_samples(times, vectors, places)
    t = np.array([5.0, 5.123, 6.0, 4.99, 6.01, np.nan])
    turn, place, lost = track.interpolate(t, 0.2)
    assert lost.tolist() == [False, False, False, True, True, True]
    assert np.allclose(turn[:3], Rotation.from_rotvec(np.outer(t[:3] - 5, [0, 0, np.pi / 2])).as_matrix())
    assert np.allclose(place[:3, 0], 2 * (t[:3] - 5)) and not place[:3, 1:].any()
    assert np.isfinite(turn).all() and np.isfinite(place).all()


def test_gaps():
    track = PoseTrack.from_samples(np.array([0.0, 0.05, 1.0]), np.zeros((3, 3)), np.zeros((3, 3)))
    assert track.interpolate(np.array([0.02, 0.14, 0.16, 0.5, 0.91]), 0.1)[2].tolist() == [
        False,
        False,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize("far", [1.1e7, -1e200, np.inf])
@pytest.mark.parametrize("key", ["times", "rotation_vectors", "positions"])
def test_samples_beyond_the_limit_are_dropped(far, key):
    samples = {"times": np.arange(4.0), "rotation_vectors": np.zeros((4, 3)), "positions": np.zeros((4, 3))}
    samples[key][2] = far * (1e14 if key == "times" and abs(far) < 1e100 else 1)
    with np.errstate(over="raise"):
        turn, place, lost = PoseTrack.from_samples(**samples).interpolate(np.array([0.1, 2.0, 2.9]), 0.2)
    assert np.isfinite(turn).all() and np.isfinite(place).all() and lost.tolist() == [False, True, False]


def test_samples_in_any_order_with_missing_values():
    times = np.array([3.0, 1.0, np.nan, 1.0, 2.0, 4.0])
    places = np.arange(18.0).reshape(6, 3)
    places[5, 1] = np.nan
    track = PoseTrack.from_samples(times, np.zeros((6, 3)), places)
    assert track.times.tolist() == [1, 2, 3] and track.positions[:, 0].tolist() == [3, 12, 0]
    assert PoseTrack.from_samples(times[:1], np.zeros((1, 3)), places[:1]) is None
    assert PoseTrack.from_samples(times[1:4], np.zeros((3, 3)), places[1:4]) is None


# ---- Head poses as rotations; see test_table.py for the meaning of angles ----


def test_quaternions_of_another_length_are_unusable():
    turn = Rotation.from_quat(np.random.default_rng(0).normal(size=(20, 4)))
    q = turn.as_quat() * 1.004  # as from averages or rounded values
    np.testing.assert_allclose(poses.rotations_from_quaternions(q), turn.as_matrix(), atol=1e-12)
    wxyz = np.roll(q, 1, axis=1)
    np.testing.assert_allclose(poses.rotations_from_quaternions(wxyz, "wxyz"), turn.as_matrix(), atol=1e-12)
    q[3], q[4, 1], q[5], q[6, 2] = 0, np.nan, 1.1 * q[5], q[6, 2] + 0.3
    assert np.isnan(poses.rotations_from_quaternions(q)[3:7]).all()
    (mask,) = poses.find_unusable_quaternions(q).values()
    assert np.flatnonzero(mask).tolist() == [5, 6]
    for bad, order in ((q[:, :3], "xyzw"), (q, "zyxw")):
        with pytest.raises(ValueError, match="expected"):
            poses.rotations_from_quaternions(bad, order)


def test_matrices_lose_their_scale_and_invalid_ones_are_nan():
    turn = Rotation.from_quat(np.random.default_rng(1).normal(size=(4, 4))).as_matrix()
    rows = np.concatenate([turn * 2, np.arange(12.0).reshape(4, 3, 1)], axis=2)
    rows[3, 0, 0] += 1
    R, place = poses.rotations_from_matrices(rows.reshape(4, 12))
    assert np.allclose(R[:3], turn[:3]) and np.isnan(R[3]).all() and np.array_equal(place.ravel(), np.arange(12.0))


@pytest.mark.parametrize("mirror", [-np.eye(3), np.diag([-1.0, 1, 1]), np.diag([1.0, 1, -2]), np.eye(3)[[1, 0, 2]]])
def test_mirrored_matrices_are_no_rotations(mirror):
    turn = Rotation.from_quat(np.random.default_rng(1).normal(size=(4, 4))).as_matrix()
    turn[2] = turn[2] @ mirror
    R, _ = poses.rotations_from_matrices(np.concatenate([turn, np.ones((4, 3, 1))], axis=2).reshape(4, 12))
    assert np.isnan(R[2]).all() and np.allclose(R[[0, 1, 3]], turn[[0, 1, 3]])


def test_axes_and_forward():
    for up, hand, forward in (("y", "left", "z"), ("-y", "right", "-z"), ("z", "right", "x")):
        assert poses.default_forward(up, hand) == forward
    assert poses.parse_axis("-y", "up").tolist() == [0, -1, 0]
    with pytest.raises(NergError, match='"w"'):
        poses.parse_axis("w", "up")


def test_azimuths_turn_right_in_every_frame():
    """Compare with a computation without cross products: in the frame of rays, right is x if forward is y."""
    from nerg_mi.tracking.readers.base import HANDEDNESSES, TrackingFrame

    a, e = np.radians([35.0, -12.0])
    for up in poses.AXES:
        for hand in HANDEDNESSES:
            to_rays = TrackingFrame(up, hand).to_rays()[:3, :3]
            for forward in (f for f in poses.AXES if f[-1] != up[-1]):
                result = poses.directions_from_azimuths(np.array([[35.0, -12.0]]), up, forward, hand)[0] @ to_rays.T
                ahead = to_rays @ poses.AXES[forward]
                heading = np.arctan2(ahead[0], ahead[1])  # clockwise from y, seen from above
                want = [np.cos(e) * np.sin(heading + a), np.cos(e) * np.cos(heading + a), np.sin(e)]
                assert np.allclose(result, want), (up, hand, forward)


# ---- Fill values in place of vectors ----


@pytest.mark.parametrize(
    "fill",
    [
        *(0, -1, 9999, -99, -32768, 32767, 65535, -2147483648, 4294967295, -999999, 3.402823e38, -3.4028235e38),
        *(65504, 1e5, 1e10, -1e11),
    ],
)
def test_fill_values(fill):
    v = np.array([[fill] * 3, [fill, fill, 0.5], [0.5] * 3, [np.inf] * 3, [fill, fill, fill + 1e-9]], float)
    nan = np.nan
    assert np.array_equal(find_fill_values(v)[:4], [fill, nan, nan, nan], equal_nan=True)
    assert np.isnan(find_fill_values(v)[4]) == (fill + 1e-9 != fill)  # noqa: RUF069 (that they differ)
    assert np.array_equal(find_fill_values(v[:3, :2]), [fill, fill, nan], equal_nan=True)


def test_rays_that_point_at_their_hits():
    o, d = np.tile([1.0, 1.6, 2.0], (3, 1)), np.array([[-1, -1.6, -2.0], [0, 0, 1.0], [np.nan, 0, 0]])
    assert is_aimed(o, d, np.zeros((3, 3))).tolist() == [True, False, False]


def places_of(*rows):
    return np.array(rows, float)


def test_filled_origins_far_from_a_person():
    find = FilledOriginFinder(1.0).find
    walk = places_of([1, 1.6, 2], [0, 0, 0], [1, 1.6, 2.1], [0, 0, 0], [1, 1.6, 2.2])
    assert find(walk, np.zeros(5, int)).tolist() == [False, True, False, True, False]
    # In a later block without another position.
    assert find(np.zeros((4, 3)), np.zeros(4, int)).all()


def test_origins_that_are_valid_positions():
    zeros = np.zeros((3, 3))
    assert not FilledOriginFinder(1.0).find(zeros, np.zeros(3, int)).any()  # somebody sits there
    track = places_of([0, 0, 0], [0, 0, 0], [0, 0, 0.01], [0, 0, 0.05], [2, 0, 2])
    assert not FilledOriginFinder(1.0).find(track, np.zeros(5, int)).any()  # a track begins there
    once = places_of([0, 0, 0], [1, 1.6, 1], [1, 1.6, 1.1])
    assert not FilledOriginFinder(1.0).find(once, np.zeros(3, int)).any()
    # In another unit of length.
    near = places_of([0, 0, 0], [0, 0, 0], [50, 0, 0])
    assert not FilledOriginFinder(0.001).find(near, np.zeros(3, int)).any()
    assert FilledOriginFinder(1.0).find(near, np.zeros(3, int)).tolist() == [True, True, False]


def test_persons_are_tested_separately():
    """One person sits at the origin, another walks, and a third is at the origin only before other positions."""
    origins = FilledOriginFinder(1.0)
    origin = places_of([0, 0, 0], [1, 1, 1.6], [0, 0, 0], [0, 0, 0], [2, 1, 1.6], [0, 0, 0], [0, 0, 0])
    person = np.array([0, 1, 0, 1, 1, 1, 2])
    assert np.flatnonzero(origins.find(origin, person)).tolist() == [3, 5]
    assert origins.find(places_of([3, 3, 3], [0, 0, 0]), np.array([2, 2])).tolist() == [False, True]
    assert origins.undecided_counts == {2: 1}
