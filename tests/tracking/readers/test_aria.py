"""Tests of `nerg_mi.tracking.readers.aria`."""

import math
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.photos.posed import read_semidense
from nerg_mi.tracking.readers import aria
from nerg_mi.tracking.readers.aria import (
    GEN2,
    LEGACY,
    VERGENCE,
    Trajectory,
    compute_cpf_in_device,
    compute_gaze_in_cpf,
    find_schema,
    interpolate_poses,
    resolve_device,
)
from tests.tracking.readers.examples import ARIA_POSES, aria_pose, csv_rows, dropped, lines, read, slerp

# ---- Recordings of Project Aria's glasses ----

SAMPLE = "gen1/mps_sample"

ARIA_VERGENCE = f"{SAMPLE}/eye_gaze_vergence/generalized_gaze.csv"

GEN1 = [0.793353, 0, -0.608761], [0.607927, -0.052336, 0.792266], [0.071351, 0.002372, 0.008454]

ARIA_GEN2 = [-0.138127, -0.912873, -0.384166], [0.308866, -0.40824, 0.859034], [0.07107883, 0.005719893, 0.01155452]


def rays_by_hand(gaze, trajectory, cad, direction) -> dict[float, tuple[np.ndarray, np.ndarray]]:
    """Origins and directions in the world of the trajectory by time, of rows between two poses:
    T_world_device(t) inv(T_cpf_device) (0, d). Times up to some microseconds outside use the first or last pose."""
    y, z, t = (np.array(v, dtype=np.float64) for v in cad)
    y, z = y / np.linalg.norm(y), z / np.linalg.norm(z)
    device_to_cpf = np.eye(4)
    device_to_cpf[:3, :3], device_to_cpf[:3, 3] = np.column_stack([np.cross(y, z), y, z]), t
    cpf_to_device = np.linalg.inv(device_to_cpf)
    unit = lambda v: np.array(v) / np.linalg.norm(v)
    poses = [(int(r["tracking_timestamp_us"]), r) for r in csv_rows(trajectory)]
    times = np.array([time for time, _ in poses])
    quaternion = lambda r: unit([float(r[f"q{a}_world_device"]) for a in "xyzw"])
    place = lambda r: np.array([float(r[f"t{a}_world_device"]) for a in "xyz"])
    rays = {}
    for row in csv_rows(gaze):
        at = int(row["tracking_timestamp_us"])
        inside = min(max(at, times[0]), times[-1])
        if abs(inside - at) > 1000:
            continue
        i = min(max(np.searchsorted(times, inside, side="right") - 1, 0), len(times) - 2)
        (start, before), (end, after) = poses[i], poses[i + 1]
        s = (inside - start) / (end - start)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(slerp(quaternion(before), quaternion(after), s)).as_matrix()
        pose[:3, 3] = (1 - s) * place(before) + s * place(after)
        pose = pose @ cpf_to_device
        rays[at * 1e-6] = pose[:3, 3], pose[:3, :3] @ direction(row)
    return rays


def by_tangents(row) -> np.ndarray:
    """Legacy angles; or the crossing of the lines of two eyes at +-h, for any h."""
    tan = lambda name: math.tan(float(row[name]))
    if "yaw_rads_cpf" in row:
        v = np.array([tan("yaw_rads_cpf"), tan("pitch_rads_cpf"), 1.0])
    else:
        h, left, right = float(row["tx_left_eye_cpf"]), tan("left_yaw_rads_cpf"), tan("right_yaw_rads_cpf")
        z = 2 * h / (right - left)
        v = np.array([h + z * left, z * tan("pitch_rads_cpf"), z])
        v *= np.sign(z)  # for diverging lines, the line through their crossing
    return v / np.linalg.norm(v)


def by_turns(row) -> np.ndarray:
    """Rotate up about x, then to the left about y."""
    yaw, pitch = (float(row[f"{name}_rads_cpf"]) for name in ("yaw", "pitch"))
    up = np.array([[1, 0, 0], [0, math.cos(pitch), math.sin(pitch)], [0, -math.sin(pitch), math.cos(pitch)]])
    left = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    return left @ up @ [0, 0, 1]


def assert_as_by_hand(rays, result, turn=((1, 0, 0), (0, 1, 0), (0, 0, 1))):
    assert np.allclose(rays.t, list(result), atol=1e-7, rtol=0)
    origin, direction = (np.array(v) @ np.transpose(turn) for v in zip(*result.values()))
    assert np.abs(rays.origin - origin).max() < 1e-6 and np.abs(rays.direction - direction).max() < 1e-6


@pytest.mark.parametrize(
    "gaze", ["eye_gaze/generalized_eye_gaze.csv", "eye_gaze/eyegaze.csv", ARIA_VERGENCE[len(SAMPLE) + 1 :]]
)
def test_first_generation_equals_a_reference_computation(recorded, gaze):
    folder = recorded("aria") / SAMPLE
    rays = read("aria", folder / gaze)
    poses = folder / "trajectory" / "closed_loop_trajectory.csv.gz"
    assert_as_by_hand(rays, rays_by_hand(folder / gaze, poses, GEN1, by_tangents))
    assert len(rays) == 114 and rays.persons == ("mps_sample",)
    assert dropped(rays) == {"there is no pose of the glasses at that time": [[2, 8], [123, 124]]}
    assert rays.metadata["source_frame"]["up"] == "z" and rays.metadata["world"].startswith("ea7288b8")
    assert rays.metadata["floor"] == "unknown"
    ahead = rays_by_hand(folder / gaze, poses, GEN1, lambda row: np.array([0.0, 0, 1]))
    assert np.allclose(rays.head, [direction for _, direction in ahead.values()], atol=1e-5)


def test_digital_twin_equals_a_reference_computation(recorded):
    folder = recorded("aria") / "adt"
    rays = read("aria", folder)
    result = rays_by_hand(folder / "eyegaze.csv", folder / "aria_trajectory.csv", GEN1, by_tangents)
    # y is up. The first gaze is three microseconds before the first pose, and is kept.
    assert_as_by_hand(rays, result, np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    assert rays.metadata["source_frame"]["up"] == "y" and len(rays) == 6
    distance = np.linalg.norm(rays.hit - rays.origin, axis=1)
    assert np.isnan(distance[0]) and np.allclose(distance[1:], [0.511755, 0.688866, 0.682519, 0.67864, 0.677456])


def write_trajectory(path, times, *, world="w", gravity=(0, 0, -9.81), place=lambda k: (0.1 * k, 0, 1.6)):
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [
        aria_pose(us, world, place(k), gravity, [0.3 * math.sin(k), 0.1 * k, 0.2, 1.0]) for k, us in enumerate(times)
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in [ARIA_POSES, *rows]) + "\n")
    return path


def test_second_generation_equals_a_reference_computation(recorded, tmp_path):
    """The public sample has no trajectory: one is generated for its gaze."""
    gaze = tmp_path / "anna" / "eye_gaze" / "general_eye_gaze.csv"
    gaze.parent.mkdir(parents=True)
    shutil.copy(recorded("aria") / "gen2/mps_sample/eye_gaze/general_eye_gaze.csv", gaze)
    poses = write_trajectory(tmp_path / "anna/slam/closed_loop_trajectory.csv", range(1130880000, 1130940000, 7001))
    rays = read("aria", tmp_path / "anna")
    assert_as_by_hand(rays, rays_by_hand(gaze, poses, ARIA_GEN2, by_turns))
    assert len(rays) == 5 and rays.persons == ("anna",) and np.isnan(rays.hit).all()
    assert rays.metadata["gaze"] == [{"file": "anna/general_eye_gaze.csv", "schema": "gen2", "device": "DVT-LL"}]
    moved = read("aria", tmp_path / "anna", device="dvt_ss")
    assert np.allclose(np.linalg.norm(moved.origin - rays.origin, axis=1), 0.0038, atol=3e-4)


def test_eyes_of_the_second_generation_agree_with_the_combined_gaze(recorded):
    """The combined angles are those of the mean direction of the eyes if all angles are polar, and differ by 0.03
    degrees if all are tangents: the file itself determines the convention."""
    gaze = recorded("aria") / "gen2/mps_sample/eye_gaze/general_eye_gaze.csv"
    one = lambda row, side: by_turns({f"{a}_rads_cpf": row[f"{side}_{a}_rads_cpf"] for a in ("yaw", "pitch")})
    rows = csv_rows(gaze)
    fused = np.array([one(row, "left") + one(row, "right") for row in rows])
    fused /= np.linalg.norm(fused, axis=1, keepdims=True)
    schema = find_schema(gaze)
    _, direction, _ = compute_gaze_in_cpf(schema, np.array([[float(row[c]) for c in schema.columns] for row in rows]))
    assert np.abs(direction - fused).max() < 1e-7


def nearest_degrees(rays, points) -> np.ndarray:
    """Angles between every second ray and its nearest point."""
    out = []
    for origin, direction in zip(rays.origin[::2], rays.direction[::2]):
        to = points - origin
        cosine = to @ direction / np.linalg.norm(to, axis=1)
        out.append(math.degrees(math.acos(min(cosine.max(), 1.0))))
    return np.array(out)


@pytest.mark.parametrize(("gaze", "median"), [("", 0.2), ("eye_gaze_vergence/generalized_gaze.csv", 0.15)])
def test_gaze_hits_points_seen_by_the_glasses(recorded, tmp_path, gaze, median):
    """The nearest semi-dense point is some tenth of a degree away; with one angle negated, it is farther."""
    folder = recorded("aria") / SAMPLE
    points = read_semidense(folder / "trajectory" / "global_points.csv.gz")
    rays = read("aria", folder / gaze)
    angles = nearest_degrees(rays, points)
    assert np.median(angles) < median and np.percentile(angles, 90) < 0.7
    cases = folder / (gaze or "eye_gaze/generalized_eye_gaze.csv")
    for which, farther in (("pitch", 1.5), ("yaw", np.median(angles) * 1.3)):
        table = csv_rows(cases)
        for row in table:
            row.update({name: -float(value) for name, value in row.items() if f"{which}_rads" in name})
        copy = tmp_path / which / "eyegaze.csv"
        copy.parent.mkdir()
        copy.write_text("\n".join(",".join(map(str, r)) for r in [table[0], *(r.values() for r in table)]) + "\n")
        shutil.copy(folder / "trajectory" / "closed_loop_trajectory.csv.gz", copy.parent)
        assert np.median(nearest_degrees(read("aria", copy), points)) > farther


# --- Generated recordings -------------------------------------------------------------------------------------------

GAZE = "tracking_timestamp_us,yaw_rads_cpf,pitch_rads_cpf,depth_m".split(",")


def write_gaze(path, times, yaw=0.1, depth=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(lines(GAZE, lambda k: [times[k], yaw, 0.2, depth], count=len(times)))
    return path


def test_old_and_new_names_of_files_and_folders(tmp_path):
    """Personalized gaze precedes general gaze, in any folder of the recording."""
    times = [0, 10_000, 20_000]
    for person, gaze, poses in (
        ("ann", "eye_gaze/general_eye_gaze.csv", "slam/closed_loop_trajectory.csv"),
        ("bo", "eye_gaze/generalized_eye_gaze.csv", "trajectory/closed_loop_trajectory.csv"),
        ("cy/mps", "eye_gaze/general_eye_gaze.csv", "slam/closed_loop_trajectory.csv"),
        ("di", "eyegaze.csv", "aria_trajectory.csv"),
    ):
        write_gaze(tmp_path / person / gaze, times)
        write_trajectory(tmp_path / person / poses, range(0, 30_000, 1000))
    assert read("aria", *(tmp_path / p for p in ("ann", "bo", "cy", "di"))).persons == ("ann", "bo", "cy", "di")
    single = write_gaze(tmp_path / "bo/eye_gaze/calibrated_eye_gaze.csv", times[:2])
    (tmp_path / "bo").rename(tmp_path / "mps_bo_vrs")
    rays = read("aria", tmp_path / "mps_bo_vrs")
    assert len(rays) == 2 and rays.metadata["gaze"][0]["file"] == f"bo/{single.name}" and rays.persons == ("bo",)


def test_gaps_and_depths(tmp_path):
    write_gaze(tmp_path / "ann/eyegaze.csv", [0, 15_000, 100_000, 199_000, 200_900, 202_000], depth=2)
    write_trajectory(tmp_path / "ann/aria_trajectory.csv", [0, 10_000, 20_000, 190_000, 200_000])
    rays = read("aria", tmp_path / "ann")
    # Interpolation ends 0.05 s from a pose, and a millisecond after the last one.
    assert np.allclose(rays.t, [0, 0.015, 0.199, 0.2009])
    assert dropped(rays) == {"there is no pose of the glasses at that time": [[4, 4], [7, 7]]}
    assert np.allclose(np.linalg.norm(rays.hit - rays.origin, axis=1), 2)


def test_depth_of_diverging_eyes_is_unknown(tmp_path):
    """The lines cross behind the head, and the file has that distance without its sign; 4 m is the limit."""
    head = "tracking_timestamp_us,left_yaw_rads_cpf,right_yaw_rads_cpf,pitch_rads_cpf,depth_m"
    (tmp_path / "ann").mkdir()
    rows = ["0,-0.02,0.02,0,1.57", "1000,0.02,-0.02,0,1.57", "2000,-0.001,0.001,0,4.0", "3000,-0.1,1.6,0,1"]
    (tmp_path / "ann/generalized_gaze.csv").write_text("\n".join([head, *rows]) + "\n")
    write_trajectory(tmp_path / "ann/closed_loop_trajectory.csv", range(0, 9000, 1000))
    rays = read("aria", tmp_path / "ann")
    assert np.isfinite(rays.hit).all(axis=1).tolist() == [True, False, False]
    assert dropped(rays) == {"direction is missing": [[5, 5]]}  # a yaw of more than 90 degrees


def test_worlds(tmp_path):
    """The world with the most gaze is used, rows in others are counted, and a world of another recording is not."""
    gaze = write_gaze(tmp_path / "ann/eyegaze.csv", list(range(0, 100_000, 10_000)))
    poses = gaze.with_name("closed_loop_trajectory.csv")
    first = write_trajectory(tmp_path / "first.csv", range(0, 41_000, 1000), world="one").read_text()
    second = write_trajectory(tmp_path / "second.csv", range(50_000, 95_000, 1000), world="two").read_text()
    poses.write_text(first + second.split("\n", 1)[1])
    # 50 to 90 ms are in two; 0 to 40 in one; rows within 0.05 s of the gap between them are in neither.
    rays = read("aria", tmp_path / "ann", world="two")
    assert np.allclose(rays.t, [0.05, 0.06, 0.07, 0.08, 0.09])
    assert dropped(rays) == {"the pose is in another world, by its graph_uid (option world)": [[2, 6]]}
    assert rays.metadata["world"] == "two" and rays.metadata["other_worlds"] == {"one": 5}
    poses.write_text(first + "\n".join(second.split("\n")[1:30]) + "\n")
    rays = read("aria", tmp_path / "ann")
    assert rays.metadata["world"] == "one" and len(rays) == 5
    assert dropped(rays) == {
        "the pose is in another world, by its graph_uid (option world)": [[7, 9]],
        "there is no pose of the glasses at that time": [[10, 11]],
    }
    with pytest.raises(NergError, match='"three"'):
        read("aria", tmp_path / "ann", world="three")
    # Two recordings in different worlds have no common frame, unless one world is requested.
    write_gaze(tmp_path / "bo/eyegaze.csv", [0, 10_000])
    write_trajectory(tmp_path / "bo/closed_loop_trajectory.csv", range(0, 20_000, 1000), world="three")
    with pytest.raises(NergError, match="bo.eyegaze.csv was recorded in another world.*Multi-SLAM"):
        read("aria", tmp_path / "ann", tmp_path / "bo")
    both = read("aria", tmp_path / "ann", tmp_path / "bo", world="one")
    assert both.persons == ("ann",) and sum(d["count"] for d in both.metadata["dropped"]) == 7


def test_up_is_opposite_to_gravity(tmp_path):
    for up, gravity in (("y", (0, -9.81, 0)), ("-x", (9.8, 0, 0.02)), ("z", (0, 0, -9.81))):
        write_gaze(tmp_path / up / "eyegaze.csv", [0, 10_000])
        write_trajectory(tmp_path / up / "aria_trajectory.csv", range(0, 20_000, 1000), gravity=gravity)
        assert read("aria", tmp_path / up).metadata["source_frame"]["up"] == up
    with pytest.raises(NergError, match="y up in the world.*begins with z up"):
        read("aria", tmp_path / "z", tmp_path / "y")
    for gravity, message in (
        ((0, -7, -7), "is not along an axis"),
        ((0, 0, 0), "is not along an axis"),
        (("", "", ""), "no poses with gravity"),
    ):
        write_trajectory(tmp_path / "z/aria_trajectory.csv", range(0, 20_000, 1000), gravity=gravity)
        with pytest.raises(NergError, match=message):
            read("aria", tmp_path / "z")


def test_invalid_input_is_refused(tmp_path):
    gaze = write_gaze(tmp_path / "ann/eyegaze.csv", [0, 10_000])
    with pytest.raises(NergError, match="there is no trajectory"):
        read("aria", gaze)
    poses = write_trajectory(tmp_path / "ann/slam/open_loop_trajectory.csv", range(0, 20_000, 1000))
    for cases, message in (
        (gaze, "only has an open loop trajectory, which drifts"),
        (poses, "contains no gaze"),
        (tmp_path / "ann/slam", "no gaze file"),
        (tmp_path / "missing.csv", "missing.csv does not exist"),
    ):
        with pytest.raises(NergError, match=message):
            read("aria", cases)
    poses.rename(poses.with_name("closed_loop_trajectory.csv"))
    assert len(read("aria", gaze)) == 2
    gaze.write_text("time,x,y\n0,1,2\n")
    with pytest.raises(NergError, match="no columns of gaze angles"):
        read("aria", gaze)


def test_gaze_between_two_blocks_is_interpolated(tmp_path, monkeypatch):
    """Only the poses around gaze are stored, and those at the ends of a block, for any block size."""
    from nerg_mi.tracking.readers import tables

    times = [500 * k + 137 for k in range(60)]
    write_gaze(tmp_path / "ann/eyegaze.csv", times)
    write_trajectory(tmp_path / "ann/aria_trajectory.csv", range(0, 31_000, 300), place=lambda k: (math.sin(k), k, 1.6))
    complete = read("aria", tmp_path / "ann")
    monkeypatch.setattr(tables, "BLOCK_ROWS", 7)
    pieces = read("aria", tmp_path / "ann")
    assert np.array_equal(complete.origin, pieces.origin) and np.array_equal(complete.direction, pieces.direction)
    result = rays_by_hand(tmp_path / "ann/eyegaze.csv", tmp_path / "ann/aria_trajectory.csv", GEN1, by_tangents)
    assert_as_by_hand(complete, result)


# ---- Gaze angles and models of Aria's glasses ----


def test_schemas_are_found_by_header(tmp_path):
    legacy = "tracking_timestamp_us,yaw_rads_cpf,pitch_rads_cpf,depth_m"
    vergence = "tracking_timestamp_us,left_yaw_rads_cpf,right_yaw_rads_cpf,pitch_rads_cpf,depth_m,session_uid"
    gen2 = f"{vergence},yaw_rads_cpf,left_pitch_rads_cpf,right_pitch_rads_cpf"
    for header, schema in ((legacy, LEGACY), (vergence, VERGENCE), (gen2, GEN2), (f"{legacy},session_uid", LEGACY)):
        (tmp_path / "gaze.csv").write_text(header + "\n")
        assert find_schema(tmp_path / "gaze.csv") is schema


def test_directions_of_tangents():
    eighth = np.pi / 4
    eye, direction, distance = compute_gaze_in_cpf(
        LEGACY, np.array([[0, eighth, eighth, 3.0], [0, 0, 0, 0], [0, 0, 1.6, 1]])
    )
    assert np.allclose(direction[:2], [np.ones(3) / np.sqrt(3), [0, 0, 1]]) and np.isnan(direction[2]).any()
    assert distance[0] == 3 and np.isnan(distance[1]) and not eye.any()
    # To the left of the left eye, at 45 degrees: the mean of the tangents.
    _, direction, distance = compute_gaze_in_cpf(VERGENCE, np.array([[0, np.arctan(0.9), np.arctan(1.1), 0, 0.5]]))
    assert np.allclose(direction, [[np.sqrt(0.5), 0, np.sqrt(0.5)]]) and distance[0] == pytest.approx(0.5)


def test_polar_directions_and_eyes():
    both_eyes = [0.03, 0.001, 0.002, -0.034, 0.003, 0.002]
    eye, direction, distance = compute_gaze_in_cpf(
        GEN2, np.array([[0, np.pi / 4, np.pi / 4, *both_eyes], [0, 1.6, 0, *both_eyes]])
    )
    assert np.allclose(direction[0], [0.5, np.sqrt(0.5), 0.5]) and np.isnan(direction[1]).all()
    assert np.allclose(eye, [-0.002, 0.002, 0.002]) and np.isnan(distance).all()


@pytest.mark.parametrize("name", ["DVT-S", "DVT-L", "DVT-LL", "DVT-LS", "DVT-SL", "DVT-SS"])
def test_the_eyes_are_behind_the_camera(name):
    """The device frame is that of the left camera: some 7 cm to the left of the midpoint of the eyes, and ahead."""
    R, t = compute_cpf_in_device(name)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12) and np.isclose(np.linalg.det(R), 1)
    camera = -R.T @ t
    assert 0.066 < camera[0] < 0.072 and 0 < camera[1] < 0.007 and 0.008 < camera[2] < 0.012


def test_names_of_models():
    assert resolve_device(None, 1) == "DVT-L" and resolve_device(None, 2) == "DVT-LL"
    assert resolve_device("dvt_s", 1) == "DVT-S" and resolve_device("DVT-SL", 2) == "DVT-SL"
    for name, why in (("dvt-ss", "of another generation"), ("Neon", "not a model of Aria")):
        with pytest.raises(NergError, match=f'"{name}" is {why}.*DVT-S, DVT-L'):
            resolve_device(name, 1)


# ---- Trajectories of Aria's glasses ----


def write(path, row, count=50):
    path.write_text(lines(ARIA_POSES, row, count=count))
    return path


def test_only_poses_near_gaze_times_are_stored(tmp_path):
    path = write(tmp_path / "t.csv", lambda k: aria_pose(1000 * k, place=(k, 2 * k, 1.6)), count=1000)
    result = Trajectory(path, np.array([0.0205, np.nan, 0.4]), None)
    track = result.tracks["w"]
    assert result.lines == 1000 and len(track.times) < 10 and result.find_up_axis("w") == "z"
    _, place, lost = interpolate_poses(track, np.array([0.0205, 0.4]), 0.05)
    assert np.allclose(place, [[20.5, 41, 1.6], [400, 800, 1.6]]) and not lost.any()


def test_times_slightly_outside_of_a_track(tmp_path):
    track = Trajectory(write(tmp_path / "t.csv", lambda k: aria_pose(1000 * k)), np.array([0.01]), None).tracks["w"]
    assert interpolate_poses(track, np.array([-0.0009, -0.0011, 0.0499, 0.0501]), 0.05)[2].tolist() == [
        False,
        True,
        False,
        True,
    ]


def test_invalid_trajectories_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(aria, "_MAX_WORLDS", 8)
    for row, count, message in (
        (aria_pose, 1, "has 1 poses; interpolation needs"),
        (lambda k: aria_pose(k, turn=(0, 0, 0, 0)), 50, "two poses of one world"),
        (lambda k: aria_pose(k, gravity=(0, -0.1 * k, -9.81)), 50, "gravity of the world"),
        (lambda k: aria_pose(k, world=k), 50, "more than 8 worlds"),
    ):
        with pytest.raises(NergError, match=message):
            Trajectory(write(tmp_path / "t.csv", row, count), np.array([0.0]), None)
