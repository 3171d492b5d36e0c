"""Logs of headsets."""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking.probes import place_probes
from tests.refusals import mentions
from tests.tracking.readers.examples import SUPERMARKET, arett, csv, dropped, openxr, quest, read, sranipal, xyz

N = 12
RNG = np.random.default_rng(7)
PLACE, TURN = RNG.normal(size=(N, 3)) + [0, 1.6, 0], Rotation.from_quat(RNG.normal(size=(N, 4)))
LEFT, RIGHT = RNG.normal(size=(2, N, 3))
RIGHT_DOWN = Rotation.from_euler("YX", [90, 30], degrees=True)  # in Unity: to the right, then down

# ---- ARETT on HoloLens 2 ----


def test_arett(tmp_path):
    rng = np.random.default_rng(0)
    origin, direction = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    hit = origin + 3 * direction
    hit[2] = np.nan
    path = tmp_path / "p03.csv"
    path.write_text(arett(origin, direction, hit, [1 == 1, False, True, True, True], [True] * 4 + [False]))
    rays = read("arett", path)
    selected, unity = [0, 2, 3], [0, 2, 1]  # z of Unity is y of rays
    d = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    assert np.allclose(rays.origin, origin[selected][:, unity]) and np.allclose(rays.direction, d[selected][:, unity])
    assert np.allclose(rays.hit, hit[selected][:, unity], equal_nan=True) and rays.persons == ("p03",)
    assert np.allclose(rays.t, 1.7e9 + 0.033 * np.array(selected), atol=1e-6)
    assert dropped(rays) == {"gazeHasValue is not true": [[3, 3]], "isCalibrationValid is not true": [[6, 6]]}


# ---- HoloLens 2's StreamRecorder ----

# A head that is rotated by 90 degrees to the left, at some position: row by row, as the recorder writes it.
HOLOLENS_HEAD = np.array([[0.0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]])


def test_hololens(tmp_path):
    def line(t, seen, origin, direction, distance):
        hands = np.zeros(2 * (1 + 16 * 26))
        return ",".join(map(str, (t, *HOLOLENS_HEAD.ravel(), *hands, seen, *origin, 1, *direction, 0, distance)))

    path = tmp_path / "2026-01-02-101112_head_hand_eye.csv"
    path.write_text(
        "\n".join(
            [
                line(132500000000000000, 1, (1, 1.6, -2), (0, 0, -1), 2.5),
                line(132500000000200000, 0, (0, 0, 0), (0, 0, 0), 0),
                line(132500000000400000, 1, (1, 1.6, -2), (0, 1, 0), 0),
            ]
        )
    )
    rays = read("hololens", path)
    assert np.allclose(rays.t, [0, 0.04], atol=1e-5) and rays.persons == ("2026-01-02-101112",)
    assert np.allclose(rays.origin, [1, 2, 1.6]) and np.allclose(rays.direction, [[0, 1, 0], [0, 0, 1]])
    assert np.allclose(rays.head, [-1, 0, 0])  # from -z of the file's world to -x
    assert np.allclose(rays.hit, [[1, 4.5, 1.6], [np.nan] * 3], equal_nan=True) and dropped(rays) == {
        "the eyes were not seen": [[2, 2]]
    }


# ---- Gaze poses of OpenXR ----

TIMES = 7_000_000_000 + 11_111_111 * np.arange(N)


def test_openxr_forward_is_minus_z(tmp_path):
    path = tmp_path / "ann.csv"
    flags, active = np.full(N, 15), np.array(["1"] * N)
    flags[2], flags[3], flags[4], active[5] = 1, 2, 3, "0"
    path.write_text(openxr(TIMES, PLACE, TURN, flags, active))
    rays = read("openxr", path)
    selected = [0, 1, 4, *range(6, N)]
    # y up to z up: x, -z, y; the third column of a rotation by its quaternion's formula.
    x, y, z, w = TURN.as_quat()[selected].T
    back = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1)
    assert np.allclose(rays.direction, np.stack([-back[:, 0], back[:, 2], -back[:, 1]], axis=1))
    assert np.allclose(rays.origin, np.stack([PLACE[selected, 0], -PLACE[selected, 2], PLACE[selected, 1]], axis=1))
    assert np.allclose(rays.t, 0.011111111 * np.array(selected)) and rays.persons == ("ann",)
    assert dropped(rays) == {"the pose is not valid": [[4, 5]], "the gaze is not active": [[7, 7]]}


def test_openxr_bare_names(tmp_path):
    path = tmp_path / "ann.csv"
    path.write_text("time,x,y,z,qx,qy,qz,qw\n5000000000,1,1.6,-2,0,0,0,1\n")
    rays = read("openxr", path)
    assert np.allclose(rays.origin, [[1, 2, 1.6]]) and np.allclose(rays.direction, [[0, 1, 0]]) and rays.t[0] == 0
    path.write_text("x,y,z,qx,qy,qz,qw\n1,1.6,-2,0,0,0,1\n")
    with pytest.raises(NergError, match="has no column of time"):
        read("openxr", path)


# ---- OVREyeGaze and Unity's eye gaze device ----

# Eyes with almost equal directions.
EYE_TURNS = (TURN * Rotation.from_euler("y", 2, degrees=True), TURN * Rotation.from_euler("y", -2, degrees=True))
UNITY = [0, 2, 1]


@pytest.mark.parametrize("rig", [False, True])
def test_quest_both_eyes_in_the_world(tmp_path, rig):
    at = (RNG.normal(size=(N, 3)), Rotation.from_quat(RNG.normal(size=(N, 4)))) if rig else None
    confidences = np.full(N, 0.9), np.array([0.9, 0.2, *[0.8] * (N - 2)])
    path = tmp_path / "ann.csv"
    path.write_text(quest(0.02 * np.arange(N), LEFT, RIGHT, EYE_TURNS, confidences, at))
    rays = read("quest", path)
    # The direction of the head is midway between eyes that are rotated to either side.
    origin, direction = 0.5 * (LEFT + RIGHT), TURN.apply([0, 0, 1])
    if at is not None:
        origin, direction = at[0] + at[1].apply(origin), at[1].apply(direction)
    selected = np.arange(N) != 1
    assert np.allclose(rays.origin, origin[selected][:, UNITY]) and np.allclose(
        rays.direction, direction[selected][:, UNITY]
    )
    assert np.allclose(rays.confidence, [0.9, *[0.8] * (N - 2)]) and dropped(rays) == {
        "confidence below 0.5 (option min_confidence)": [[3, 3]]
    }
    assert len(read("quest", path, min_confidence=0.1)) == N


def test_quest_one_pose_of_the_gaze(tmp_path):
    path = tmp_path / "ann.csv"
    q = Rotation.from_euler("YX", [90, 30], degrees=True).as_quat()  # to the right, then down
    path.write_text(
        "time,gazePosition_x,gazePosition_y,gazePosition_z,gazeRotation_x,gazeRotation_y,gazeRotation_z,"
        "gazeRotation_w,user_id\n" + ",".join(map(str, [0, 1, 1.6, 2, *q, "bo"])) + "\n"
    )
    rays = read("quest", path)
    assert np.allclose(rays.direction, [[3**0.5 / 2, 0, -0.5]]) and np.allclose(rays.origin, [[1, 2, 1.6]])
    assert rays.persons == ("bo",)
    path.write_text("time,gazePosition_x\n")
    with pytest.raises(NergError, match="has no columns"):
        read("quest", path)


@pytest.mark.parametrize("rig", [False, True])
def test_quest_eyes_at_a_fill_value(tmp_path, rig):
    """A fill value of one eye drops the row at once; of both eyes, if the participant is otherwise elsewhere."""
    left, right = LEFT + [0, 3, 0], RIGHT + [0, 3, 0]
    left[2] = left[4] = right[4] = left[6] = right[6] = 0
    at = (RNG.normal(size=(N, 3)), Rotation.from_quat(RNG.normal(size=(N, 4)))) if rig else None
    (tmp_path / "a.csv").write_text(quest(0.02 * np.arange(N), left, right, EYE_TURNS, (np.ones(N), np.ones(N)), at))
    assert dropped(read("quest", tmp_path / "a.csv")) == {
        "origin is a repeated fill value": [[6, 6], [8, 8]],
        "origin is missing": [[4, 4]],
    }


# ---- SRanipal's values with heads in Unity's world ----

ORIGIN, LOOK = 30 * RNG.normal(size=(N, 3)), RNG.normal(size=(N, 3)) * 0.2 + [0, 0, 1]


def sranipal_world(origin, look):
    """Points of GetGazeRay in Unity, in the frame of rays: x, z, y."""
    o, d = np.empty((2, N, 3))
    for k in range(N):
        m = TURN[k].as_matrix()
        for i, j in enumerate((0, 2, 1)):
            o[k, i] = PLACE[k, j] + (m[j, 1] * origin[k, 1] + m[j, 2] * origin[k, 2] - m[j, 0] * origin[k, 0]) / 1000
            d[k, i] = m[j, 1] * look[k, 1] + m[j, 2] * look[k, 2] - m[j, 0] * look[k, 0]
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("style", ["verbose_data.{}.{}.{}", "{}_{}_{}", "{} {} [{}]"])
def test_sranipal_x_is_negated(tmp_path, style):
    path = tmp_path / "s1.csv"
    mask = np.full(N, 3)
    mask[4], mask[9] = 1, 0
    path.write_text(sranipal(20.0 * np.arange(N), PLACE, TURN, {"combined": (ORIGIN, LOOK, mask)}, style))
    rays = read("sranipal", path)
    origin, direction = (np.delete(v, [4, 9], axis=0) for v in sranipal_world(ORIGIN, LOOK))
    assert np.allclose(rays.origin, origin) and np.allclose(rays.direction, direction)
    assert np.allclose(rays.t, np.delete(0.02 * np.arange(N), [4, 9])) and rays.metadata["tick"] == 1e-3  # noqa: RUF069 (stored)
    assert dropped(rays) == {"no eye is valid": [[6, 6], [11, 11]]}


def test_sranipal_two_eyes_are_one_ray(tmp_path):
    """If one eye is lost, the other is used alone; a mask of 31 is fully valid."""
    left, right = (
        (ORIGIN + [31, 0, 0], LOOK, np.full(N, 31)),
        (ORIGIN - [31, 0, 0], LOOK + [0, 0.1, 0], np.full(N, 31)),
    )
    right[2][3] = 8
    right[1][5] = 0
    path = tmp_path / "s1.csv"
    path.write_text(sranipal(np.arange(N), PLACE, TURN, {"left": left, "right": right}, "{}_{}_{}"))
    rays = read("sranipal", path, tick=1.0)
    alone = np.isin(np.arange(N), [3, 5])[:, None]
    want = sranipal_world(np.where(alone, left[0], ORIGIN), np.where(alone, LOOK, LOOK + [0, 0.05, 0]))
    assert np.allclose(rays.origin, want[0]) and np.allclose(rays.direction, want[1])


def test_sranipal_names_of_the_sdks_example(tmp_path):
    """gaze_origin_L.x(mm), gaze_direct_L.x, eye_valid_L."""
    names = ["time_stamp(ms)", *(f"head_pos_{a}" for a in "xyz"), *(f"head_rot_{a}" for a in "xyzw")]
    for side in "LR":
        names += [f"gaze_origin_{side}.{a}(mm)" for a in "xyz"] + [f"gaze_direct_{side}.{a}" for a in "xyz"]
        names.append(f"eye_valid_{side}")
    row = [0, 1, 1.6, 2, 0, 0, 0, 1, 31, 0, 0, 0.6, 0, 0.8, 31, -31, 0, 0, 0.6, 0, 0.8, 31]
    (tmp_path / "a.csv").write_text(",".join(names) + "\n" + ",".join(map(str, row)) + "\n")
    rays = read("sranipal", tmp_path / "a.csv")
    assert np.allclose(rays.origin, [[1, 2, 1.6]]) and np.allclose(rays.direction, [[-0.6, 0.8, 0]])


def test_sranipal_missing_columns_are_reported(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,gaze_origin_mm_x\n")
    with pytest.raises(NergError, match="no gaze_origin_mm_{x,y,z} or no gaze_direction_normalized"):
        read("sranipal", path)
    both_eyes = {"combined": (ORIGIN, LOOK, np.full(N, 3))}
    path.write_text(sranipal(np.arange(N), PLACE, TURN, both_eyes).replace("time_stamp", "clock"))
    with pytest.raises(NergError, match="has no column of time"):
        read("sranipal", path)


# ---- Logs of Unity projects ----


@pytest.mark.parametrize("stem", ["gaze_dir", "gaze_direction", "Gaze_Forward"])
def test_unity(tmp_path, stem):
    head = ["timestamp", *xyz("gaze_origin_"), *xyz(f"{stem}_"), *xyz("hit_"), "status"]
    rows = "0,1,1.6,3,0,0,1,1,1.6,5,valid\n20,1,1.6,3,0,0,1,,,,INVALID\n40,1,1.6,3,0,0,2,,,,Valid\n"
    (tmp_path / "p7.csv.gz").write_bytes(gzip.compress(f"{','.join(head)}\n{rows}".encode()))
    rays = read("unity", tmp_path / "p7.csv.gz", tick=1e-3)
    assert np.allclose(rays.origin, [1, 3, 1.6]) and np.allclose(rays.direction, [0, 1, 0])
    assert rays.persons == ("p7",) and np.allclose(rays.t, [0, 0.04])
    assert np.allclose(rays.hit, [[1, 5, 1.6], [np.nan] * 3], equal_nan=True)
    assert list(dropped(rays).values()) == [[[3, 3]]] and rays.metadata["preset"] == "unity"


@pytest.mark.parametrize(
    ("name", "tick"), [("timestamp_ms", 1e-3), ("timeNs", 1e-9), ("Time (s)", 1.0), ("frame", 1.0)]
)
def test_times_with_a_unit_in_their_name_are_found(tmp_path, name, tick):
    head = [name, *xyz("gaze_origin_"), *xyz("gaze_dir_")]
    (tmp_path / "p.csv").write_text(csv(head, [[5 + 20 * k, 1, 1.6, 3, 0, 0, 1] for k in range(3)]))
    rays = read("unity", tmp_path / "p.csv", tick=tick)
    assert np.allclose(rays.t, np.arange(3) if name == "frame" else tick * np.array([5, 25, 45]))
    assert ["no column is the time" in text for text in rays.metadata.get("complaints", [])] == [True] * (
        name == "frame"
    )


def test_unity_local_and_head(tmp_path):
    path, q = tmp_path / "log.csv", RIGHT_DOWN.as_quat()
    head = ["time", "user_id", *xyz("head_pos_"), *xyz("head_rot_", "xyzw"), *xyz("gaze_origin_"), *xyz("gaze_dir_")]
    path.write_text(csv(head, [(0, 4, 1, 1.6, 2, *q, 0, 0, 0.1, 0, 0.5, 1)]))
    head = read("unity_head", path)
    assert np.allclose(head.origin, [1, 2, 1.6]) and np.allclose(head.direction, [3**0.5 / 2, 0, -0.5])
    local = read("unity_local", path)
    assert np.allclose(local.origin, head.origin + 0.1 * head.direction) and head.persons == ("4",)
    d = RIGHT_DOWN.apply([0, 0.5, 1]) / 1.25**0.5
    assert np.allclose(local.direction, d[[0, 2, 1]])
    # The head is kept for gaze in the head's frame and in the world, but not for heads as gaze.
    world = read("unity", path)
    assert np.allclose(local.head, head.direction) and np.allclose(world.head, head.direction) and head.head is None


def test_unity_missing_columns_are_reported(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,gaze_origin_x,gaze_origin_y,gaze_origin_z\n0,0,0,0\n")
    with pytest.raises(NergError, match="no columns gaze_dir_{x,y,z} or ", check=mentions("columns")):
        read("unity", path)
    head = "gaze_origin_x,gaze_origin_y,gaze_origin_z,gaze_dir_x,gaze_dir_y,gaze_dir_z"
    path.write_text(head + "\n0,0,0,0,0,1\n")
    (tmp_path / "b.csv").write_text("time," + head + "\n0,0,0,0,0,0,1\n")
    with pytest.raises(NergError, match="b.csv has other columns"):
        read("unity", path, tmp_path / "b.csv")


@pytest.mark.parametrize(
    "head",
    [
        "time,gazeOrigin_x,gazeOrigin_y,gazeOrigin_z,gazeDirection_x,gazeDirection_y,gazeDirection_z",
        "Time,GazeOriginX,GazeOriginY,GazeOriginZ,GazeDirX,GazeDirY,GazeDirZ",
        "time,origin_x,origin_y,origin_z,dir_x,dir_y,dir_z",
        "t,x,y,z,dx,dy,dz",
        "t,Position (x),Position (y),Position (z),Direction.x,Direction.y,Direction.z",
        "time [s],gaze origin x [m],gaze origin y [m],gaze origin z [m],gaze dir x,gaze dir y,gaze dir z",
    ],
)
def test_other_usual_names(tmp_path, head):
    path = tmp_path / "ann.csv"
    path.write_text(head + "\n0.5,1,1.6,3,0,0,2\n")
    rays = read("unity", path)
    assert np.allclose(rays.origin, [[1, 3, 1.6]]) and np.allclose(rays.direction, [[0, 1, 0]]) and rays.t[0] == 0.5  # noqa: RUF069 (stored)


@pytest.mark.parametrize(
    "names, turn",
    [
        ("t,x,y,z,qx,qy,qz,qw", RIGHT_DOWN.as_quat()),
        ("t,posX,posY,posZ,rotX,rotY,rotZ", (30, 90, 0)),
        ("t,head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z", (30, 90, 0)),
    ],
)
def test_heads_of_other_names(tmp_path, names, turn):
    (tmp_path / "ann.csv").write_text(csv(names, [(0, 1, 1.6, 2, *turn)]))
    rays = read("unity_head", tmp_path / "ann.csv")
    assert np.allclose(rays.direction, [3**0.5 / 2, 0, -0.5]) and np.allclose(rays.origin, [[1, 2, 1.6]])


UNITY_HEAD = "time,gaze_origin_x,gaze_origin_y,gaze_origin_z,gaze_dir_x,gaze_dir_y,gaze_dir_z"


def log(path, column, values):
    rows = (f"{0.02 * k},1,1.6,{k / 50},0,0,1,{value}" for k, value in enumerate(values))
    path.write_text(f"{UNITY_HEAD},{column}\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(
    "column, values, valid_rows",
    [
        ("gaze_status", [0, 1, 2, 2], [2, 3]),  # Varjo's codes
        ("isValid", ["True", "False", "true", ""], [0, 2]),
    ],
)
def test_validity(tmp_path, column, values, valid_rows):
    rays = read("unity", log(tmp_path / "a.csv", column, values))
    assert np.allclose(rays.t, 0.02 * np.array(valid_rows)) and sum(map(len, dropped(rays).values())) > 0


def test_values_of_validity_are_collected_from_all_files(tmp_path):
    files = log(tmp_path / "a.csv", "gaze_status", [1, 1]), log(tmp_path / "b.csv", "gaze_status", [1, 2])
    assert len(read("unity", *files)) == 1
    with pytest.raises(NergError, match="'gaze_status'.*1.*2"):
        read("unity", files[0])
    assert len(read("unity", files[0], valid="gaze_status=1")) == 2 and len(read("unity", files[0], valid="none")) == 2


def test_row_counter_is_no_participant(tmp_path):
    rays = read("unity", log(tmp_path / "ann.csv", "id", range(40)))
    assert rays.persons == ("ann",) and rays.metadata["unused_columns"] == ["id"]
    assert "'id' has another value in nearly every row" in rays.metadata["complaints"][0]
    few = read("unity", log(tmp_path / "ann.csv", "id", [k // 10 for k in range(40)]))
    assert few.persons == ("0", "1", "2", "3") and "complaints" not in few.metadata


# ---- Varjo's log ----


def test_varjo(tmp_path):
    q = ", ".join(f"{v:.6f}" for v in RIGHT_DOWN.as_quat())
    path = tmp_path / "2026-01-02.csv"
    path.write_text(
        "Frame;CaptureTime;HMDPosition;HMDRotation;GazeStatus;CombinedGazeForward;CombinedGazePosition\n"
        f"1;1700000000000000000;(1.000, 1.600, 2.000);({q});VALID;(0.000, 0.500, 1.000);(0.000, 0.000, 0.100)\n"
        f"2;1700000000005000000;(1.000, 1.600, 2.000);({q});INVALID;;\n"
        f"3;1700000000010000000;(1.000, 1.600, 2.000);({q});VALID;(0.000, 0.000, 1.000);(0.000, 0.000, 0.000)\n"
    )
    rays = read("varjo", path)
    assert np.allclose(rays.t, [0, 0.01], atol=1e-6) and dropped(rays) == {"GazeStatus is not VALID": [[3, 3]]}
    ahead = np.array([3**0.5 / 2, 0, -0.5])
    assert [s["file"] for s in rays.metadata["sources"]] == ["2026-01-02.csv"]
    assert np.allclose(rays.head, ahead, atol=1e-6)
    assert np.allclose(rays.direction[1], ahead, atol=1e-6) and np.allclose(
        rays.origin, [[1, 2, 1.6] + 0.1 * ahead, [1, 2, 1.6]], atol=1e-6
    )
    path.write_text(path.read_text().replace("(0.000, 0.500, 1.000)", "(0.000, oops)"))
    with pytest.raises(NergError, match="line 2, column 'CombinedGazeForward'"):
        read("varjo", path)


VARJO_HEAD = "CaptureTime;HMDPosition;HMDRotation;CombinedGazePosition;CombinedGazeForward;GazeStatus\n"
VARJO_ROW = "{};(0, 1.6, 0);(0, 0, 0, 1);(0, 0, 0);(0, 0, 1);{}\n"


def test_varjo_truncated_vector(tmp_path):
    """Errors in Varjo's cells are reported with line and column, or skipped and counted."""
    path, rows = tmp_path / "ann.csv", "".join(VARJO_ROW.format(i * 10**7, "VALID") for i in range(5))
    path.write_text(VARJO_HEAD + "1;(0, 1.6;(0, 0, 0, 1);(0, 0;(0, oops);VALID\n" + rows)
    with pytest.raises(NergError, match="2.*'HMDPosition'.*skip_bad_lines"):
        read("varjo", path)
    rays = read("varjo", path, skip_bad_lines=True)
    assert len(rays) == 5 and rays.t[0] == 0 and rays.metadata["rows_read"] == 6
    assert list(dropped(rays).values()) == [[[2, 2]]]
    path.write_text(VARJO_HEAD + rows + "50000000;(0, 1.6, 0);(0, 0")
    rays = read("varjo", path, skip_bad_lines=True)
    assert len(rays) == 5 and list(dropped(rays).values()) == [[[7, 7]]]


@pytest.mark.parametrize("status, valid_rows", [("2", 1), ("1", 0), ("valid", 1), ("3", None), ("Visible", None)])
def test_varjo_codes_of_the_status(tmp_path, status, valid_rows):
    path = tmp_path / "v.csv"
    path.write_text(VARJO_HEAD + VARJO_ROW.format(0, "VALID") + VARJO_ROW.format(10**7, status))
    if valid_rows is None:
        with pytest.raises(NergError, match=f"GazeStatus '{status.upper()}', whose meaning is uncertain"):
            read("varjo", path)
    else:
        assert len(read("varjo", path)) == 1 + valid_rows


# ---- Recordings of the VR supermarket ----


def test_real_supermarket(recorded):
    files = sorted(recorded("vr_supermarket").glob("*.csv.gz"))[:2]
    rays = read("vr_supermarket", *files)
    assert rays.persons == ("user10", "user11") and 0.85 < len(rays) / rays.metadata["rows_read"] < 0.97
    # The gaze ray points at the recorded hit: the frame is correct.
    hit = np.isfinite(rays.hit).all(axis=1)
    to_hit = rays.hit[hit] - rays.origin[hit]
    to_hit /= np.linalg.norm(to_hit, axis=1, keepdims=True)
    angle = np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(to_hit - rays.direction[hit], axis=1)))
    assert np.median(angle) < 1e-3 and np.percentile(angle, 99) < 0.05
    assert 0.97 < hit.mean() < 1
    # Gaze is near the direction of the head.
    assert np.median(np.einsum("ij,ij->i", rays.head, rays.direction)) > np.cos(np.radians(20))
    assert 1.2 < np.median(rays.origin[:, 2]) < 1.8  # z is up: eye heights
    probes = place_probes(rays, 0.25, count=64, min_rays=8, max_rays=100_000)
    assert 200 < np.median(probes.counts) < 2000


def test_supermarket_frame_eyes_and_openness(tmp_path):
    """A camera rotated by 90 degrees about Unity's y, compared with the formula by hand."""
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    pose = np.hstack([turn, [[1.0], [1.6], [2.0]]]).ravel()
    rows = [
        [*pose, 0, 0, 2, 0.01, 0, 0.1, "", "", "", *openness, 0.02 * k]
        for k, openness in enumerate([(0.9, 0.8), (0.9, 0.5), (1.2, 1.1), ("", 1)])
    ]
    path = tmp_path / "gaze_user7_x.csv"
    path.write_text(csv(SUPERMARKET, rows))
    rays = read("vr_supermarket", path)
    assert rays.persons == ("user7",) and np.allclose(rays.t, [0, 0.04]) and np.allclose(rays.confidence, [0.8, 1])
    assert np.allclose(rays.direction, (turn @ (0, 0, -1))[[0, 2, 1]]) and np.isnan(rays.hit).all()
    assert np.allclose(rays.head, (turn @ (0, 0, -1))[[0, 2, 1]])
    assert np.allclose(rays.origin, ((1, 1.6, 2) + turn @ (0.01, 0, -0.1))[[0, 2, 1]])
    assert dropped(rays) == {
        "an eye is closed: openness at most 0.5 (option min_openness)": [[3, 3]],
        "confidence is missing or outside [0, 1]": [[5, 5]],
    }
    assert len(read("vr_supermarket", path, min_openness=0.4)) == 3
    percent = [[*row[:21], 90, 80, row[23]] if k == 1 else row for k, row in enumerate(rows)]
    path.write_text(csv(SUPERMARKET, percent))
    assert [2 + 1, 2 + 1] in dropped(read("vr_supermarket", path))["confidence is missing or outside [0, 1]"]


def test_supermarket_matrices_that_are_no_rotations_are_dropped(tmp_path):
    stretch = [np.diag([1, 1, 1.3]) if k == 2 else np.eye(3) for k in range(6)]
    rows = [
        [*np.hstack([m, [[1.0], [1.6], [2.0]]]).ravel(), 0, 0, 1, 0, 0, 0, "", "", "", 1, 1, 0.02 * k]
        for k, m in enumerate(stretch)
    ]
    path = tmp_path / "gaze_user7_x.csv"
    path.write_text(csv(SUPERMARKET, rows))
    assert [("not a scaled rotation" in r, lines) for r, lines in dropped(read("vr_supermarket", path)).items()] == [
        (True, [[4, 4]])
    ]


def test_supermarket_mirrored_rows_and_fill_values(tmp_path):
    rows = []
    for k in range(6):
        turn = np.diag([1.0, 1, -1]) if k != 2 else np.eye(3)
        pose = np.hstack([turn, [[1.0], [1.6], [2.0 + k]]]).ravel()
        rows.append([*pose, *([-1, -1, -1] if k == 4 else [0, 0, 1]), 0, 0, 0, "", "", "", 1, 1, 0.02 * k])
    path = tmp_path / "gaze_user7_x.csv"
    path.write_text(csv(SUPERMARKET, rows))
    assert dropped(read("vr_supermarket", path)) == {
        "the head's matrix is mirrored against those of most rows": [[4, 4]],
        "direction is the fill value -1, -1, -1": [[6, 6]],
    }
