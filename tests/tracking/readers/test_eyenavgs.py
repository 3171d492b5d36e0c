"""Tests of `nerg_mi.tracking.readers.eyenavgs`."""

import math

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers import tables
from nerg_mi.tracking.readers.eyenavgs import read_scene_settings
from tests.tracking.readers.examples import csv_rows, dropped, read

# ---- EyeNavGS recordings of both sites ----

COMMON = [f"FOV{k}" for k in range(1, 5)] + [f"Position{a}" for a in "XYZ"] + [f"Quaternion{a}" for a in "XYZW"]
PLACE, TURN = [f"GazePos{a}" for a in "XYZ"], [f"GazeQ{a}" for a in "XYZW"]
RUTGERS = ["ViewIndex", *COMMON, *PLACE, *TURN, "Timestamp"]
NTHU = ["ViewIndex", *COMMON, *TURN, *PLACE, "timestep"]


# Of Rutgers: units per metre, the angle about x that makes the scene upright (degrees), and the play area's position.
PLACES = {
    "room": (2, -26.99, (0, 1.15, 0)),
    "playroom": (2.7, -22.62, (0, 0.88, 0)),
    "truck": (0.76, -10.28, (0, 2.1, -4)),
}


def numbers_of(path) -> np.ndarray:
    return np.array([[float(v) for v in row.values()] for row in csv_rows(path)])


def about_x(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def ahead(q) -> np.ndarray:
    """The direction of (0, 0, -1) rotated by unit quaternions (n, 4), x, y, z, w: minus the third matrix column."""
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return -np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1)


def upwards(v) -> np.ndarray:
    """Convert from y up to z up."""
    return np.stack([v[:, 0], -v[:, 2], v[:, 1]], axis=1)


@pytest.mark.parametrize(("place", "user"), [("room", "user101"), ("truck", "user102"), ("playroom", "user103")])
def test_recordings_equal_a_reference_computation(recorded, place, user):
    path = recorded("eyenavgs") / place / f"{user}_{place}.csv.gz"
    rays = read("eyenavgs", path)
    scale, degrees, start = PLACES[place]
    left, right = numbers_of(path)[0::2], numbers_of(path)[1::2]
    assert not left[:, 0].any() and (right[:, 0] == 1).all()  # these files are complete
    upright = about_x(degrees)
    middle = 0.5 * (left[:, 5:8] + right[:, 5:8])
    area = np.array([upright @ ((x - start) / scale + start) + start for x in middle])
    assert np.abs(rays.origin - upwards(area)).max() < 1e-3  # the rotation has four decimals
    sight = (ahead(left[:, 15:19]) + ahead(right[:, 15:19])) @ upright.T
    sight = upwards(sight / np.linalg.norm(sight, axis=1, keepdims=True))
    assert np.abs(rays.head - upwards(ahead(left[:, 8:12]) @ upright.T)).max() < 1e-3
    distances = np.median(np.linalg.norm(right[:, 5:8] - left[:, 5:8], axis=1)) / scale
    assert abs(rays.metadata["eye_distance"][user] - distances) < 1e-4 and 0.058 < distances < 0.07
    assert np.abs(rays.direction - sight).max() < 1e-3
    assert np.allclose(rays.t, 1e-3 * left[:, 19]) and rays.persons == (user,)
    content = rays.metadata
    assert content["place"] == place and content["units_per_metre"] == scale and content["dropped"] == []
    # In the splats' axes y is down and z forward, which the recorder has inverted.
    to_splat = np.array(content["place_from_rays"])
    assert np.allclose(rays.origin @ to_splat[:3, :3].T + to_splat[:3, 3], middle * (1, -1, -1), atol=1e-9)
    # Each eye's line of sight is 1.5 degrees off the gaze, towards the other eye.
    for eye in ("left", "right"):
        one = read("eyenavgs", path, eye=eye)
        across = np.cross(rays.direction, one.direction)
        off = np.degrees(np.arcsin(np.linalg.norm(across, axis=1)))
        assert abs(np.median(off) - 1.57) < 0.1 and np.percentile(off, 99) < 1.9
        assert (np.sum(across * np.cross(rays.direction, rays.origin - one.origin), axis=1) > 0).mean() > 0.99


@pytest.mark.parametrize("place", PLACES)
def test_all_recordings(recorded, place):
    """Frozen recordings, eye heights, eye distances, and upright heads."""
    folder = recorded("eyenavgs") / place
    rays = read("eyenavgs", folder)
    frozen, locked = {"room": (6, 5), "playroom": (8, 5), "truck": (4, 4)}[place]
    assert len(rays.persons) == 22 - frozen - locked
    for word, count in (("frozen", frozen), ("locked to the head", locked)):
        assert sum(f"gaze of the recording is {word}" in d["reason"] for d in rays.metadata["dropped"]) == count
    heights = [np.median(rays.origin[rays.person == p, 2]) for p in range(len(rays.persons))]
    assert 1.3 < min(heights) and max(heights) < 1.9 and 1.5 < np.median(heights) < 1.7
    scale, degrees, _ = PLACES[place]
    up = np.zeros(3)
    for path in sorted(folder.glob("*.gz"))[::5]:
        v = numbers_of(path)
        pairs = np.flatnonzero((v[:-1, 0] == 0) & (v[1:, 0] == 1))
        distances = np.linalg.norm(v[pairs, 5:8] - v[pairs + 1, 5:8], axis=1) / scale
        assert 0.055 < np.percentile(distances, 1) and np.percentile(distances, 99) < 0.075
        x, y, z, w = v[pairs, 8:12].T
        up += np.mean([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], axis=1)
    upright = about_x(degrees) @ up
    assert np.degrees(np.arccos(upright[1] / np.linalg.norm(upright))) < 8  # before: 10 to 27


# --- Generated recordings -------------------------------------------------------------------------------------------


def quaternion(degrees: float) -> list[float]:
    """Rotation about y, to the left."""
    return [0, math.sin(math.radians(degrees) / 2), 0, math.cos(math.radians(degrees) / 2)]


def write(
    folder, name="user7_room.csv", site=RUTGERS, gaze=lambda k: 2.0 * k, both_eyes=((0, 1) * 6), head=lambda k: 3.0 * k
):
    """Eyes 6.4 cm apart along x; both turn to the left, each 1.5 degrees towards the other."""
    rows = []
    for k, eye in enumerate(both_eyes):
        cells = {"ViewIndex": eye, "PositionX": 0.2 + 0.128 * (eye - 0.5), "PositionY": 0.4, "PositionZ": -0.6}
        cells |= dict(zip((f"Quaternion{a}" for a in "XYZW"), quaternion(head(k // 2))))
        cells |= dict(zip((f"GazeQ{a}" for a in "XYZW"), quaternion(gaze(k // 2) + (1.5 if eye else -1.5))))
        cells |= {"Timestamp": 14 * (k // 2), "timestep": 14 * (k // 2)}
        rows.append(",".join(str(cells.get(name, 0)) for name in site))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text("\n".join([",".join(site), *rows]) + "\n")
    return folder / name


def settings(folder, *rows, head=""):
    text = "\n".join([f"Scene_Name,Quaternion,Scale{head}", *(rows or ['room,"0, 0, 0, 1",2'])])
    (folder / "scene_setting.csv").write_text(text + "\n")


@pytest.mark.parametrize("site", [RUTGERS, NTHU])
def test_the_columns_of_both_sites(tmp_path, site):
    settings(tmp_path)
    (tmp_path / "scene_setting.csv").write_text("\ufeff" + (tmp_path / "scene_setting.csv").read_text() + "\n")
    rays = read("eyenavgs", write(tmp_path / "dataset/room", site=site))
    # Without a start, the origin is that of the splats.
    assert rays.persons == ("user7",) and np.allclose(rays.origin, [0.1, 0.3, 0.2])
    assert np.allclose(rays.t, 0.014 * np.arange(6))
    turned = np.radians(2.0 * np.arange(6))
    assert np.allclose(rays.direction, np.stack([-np.sin(turned), np.cos(turned), 0 * turned], axis=1))
    assert [s["file"] for s in rays.metadata["sources"]] == ["scene_setting.csv", "user7_room.csv"]
    one = read("eyenavgs", tmp_path / "dataset/room", eye="right")
    assert np.allclose(one.origin, [0.132, 0.3, 0.2])


@pytest.mark.parametrize("block", [1 << 16, 3, 1])
def test_rows_without_the_other_eye(tmp_path, monkeypatch, block):
    monkeypatch.setattr(tables, "BLOCK_ROWS", block)
    settings(tmp_path)
    rays = read("eyenavgs", write(tmp_path, both_eyes=(1, 0, 1, 0, 0, 1, 1, 0, 1, 0)))
    assert len(rays) == 3 and rays.metadata["rows_read"] == 7
    assert dropped(rays) == {"the other eye's row is missing": [[2, 2], [5, 5], [8, 8], [11, 11]]}


def test_frozen_gaze(tmp_path):
    settings(tmp_path, 'train,"0, 0, 0, 1",2')
    still = write(tmp_path, "user1_train.csv", gaze=lambda k: 5.0)
    with pytest.raises(NergError, match="user1_train.csv"):
        read("eyenavgs", still)
    # Spelling of one of the sites. A still head with still gaze may be one fixation.
    moving, resting = (
        write(tmp_path, "user2_trian.csv"),
        write(tmp_path, "user3_train.csv", gaze=abs, head=lambda k: 0.1 * k),
    )
    rays = read("eyenavgs", still, moving, resting)
    assert rays.persons == ("user2", "user3") and rays.metadata["place"] == "train"
    frozen = "the gaze of the recording is frozen: it is constant although the head turns"
    assert dropped(rays) == {frozen: [[k, k] for k in range(2, 13, 2)]}


def test_gaze_locked_to_the_head_is_dropped(tmp_path):
    """Gaze follows the head five rows later, unlike real eyes; a head that hardly turns is not informative."""
    settings(tmp_path)
    turn = lambda k: 40 * math.sin(0.02 * k)
    directions = lambda k: turn(k) + 12 * math.sin(0.4 * k)
    behind = write(tmp_path, "user1_room.csv", both_eyes=(0, 1) * 400, head=turn, gaze=lambda k: 8 + turn(k - 5))
    living = write(tmp_path, "user2_room.csv", both_eyes=(0, 1) * 400, head=turn, gaze=directions)
    resting = write(
        tmp_path, "user3_room.csv", both_eyes=(0, 1) * 400, head=lambda k: turn(k) / 4, gaze=lambda k: turn(k) / 4
    )
    rays = read("eyenavgs", behind, living, resting)
    assert rays.persons == ("user2", "user3") and len(rays) == 800
    (lost,) = rays.metadata["dropped"]
    assert "locked to the head" in lost["reason"] and lost["file"] == behind.name and lost["count"] == 400
    with pytest.raises(NergError, match="no recording has tracked eyes"):
        read("eyenavgs", behind)


def test_invalid_input_is_refused(tmp_path):
    path = write(tmp_path / "a/b")
    with pytest.raises(NergError, match="scene_setting.csv.*user7_room.csv"):
        read("eyenavgs", path)
    settings(tmp_path, 'room,"0, 0, 0, 1",2', 'nyc,"0, 0, 0, 1",1')
    with pytest.raises(NergError, match="user9_nyc.csv.*user7_room.csv"):
        read("eyenavgs", path, write(tmp_path, "user9_nyc.csv"))
    for cases, message in (
        (write(tmp_path, "user9_moon.csv"), '"moon"'),
        (tmp_path / "a", "there is no recording"),
        (tmp_path / "gone_room.csv", "gone_room.csv does not exist"),
    ):
        with pytest.raises(NergError, match=message):
            read("eyenavgs", cases)
    with pytest.raises(NergError, match='eye is "third"'):
        read("eyenavgs", path, eye="third")


def test_the_columns_of_another_format_are_checked_first(tmp_path):
    """Before the settings of the scene, which do not exist either."""
    path = tmp_path / "log.csv"
    path.write_text("t,PositionX,PositionY,PositionZ\n0,1,2,3\n")
    with pytest.raises(NergError, match="log.csv") as refusal:
        read("eyenavgs", path)
    text = str(refusal.value)
    assert "ViewIndex" in text and "Timestamp" in text and "nerg rays guess" in text
    assert "PositionX" not in text and "scene_setting" not in text


# ---- Scene settings of EyeNavGS ----


def test_conversion_to_splats_is_inverse(tmp_path):
    """A quarter turn about z, two units per metre, the play area one metre along x."""
    (tmp_path / "s.csv").write_text(
        'Scene_Name,Quaternion,Scale,Initial_Position\nhall,"0, 0, 0.70710678, 0.70710678",2,"1, 0, 3"\n'
    )
    setting = read_scene_settings(tmp_path / "s.csv")["hall"]
    assert setting.start == (1, 0, 3) and np.allclose(setting.upright_rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    x = np.array([[1.0, 0, 3], [3, 4, 5]])
    assert np.allclose(setting.to_play_area(x), [[1, 1, 6], [-1, 2, 7]])
    present = np.c_[setting.to_play_area(x), [1, 1]] @ setting.compute_splats_from_area().T
    assert np.allclose(present, np.c_[x * (1, -1, -1), [1, 1]])


@pytest.mark.parametrize("row", ['"0, 0, 0",2', '"0, 0, 0, 1",0', '"0, 0, 0, 0",1', "x,1", '"0, 0, 0, 1",2,"1, 0"'])
def test_invalid_scene_settings_are_refused(tmp_path, row):
    settings(tmp_path, f"room,{row}", head=",Initial_Position" * (row.count('"') > 2))
    with pytest.raises(NergError, match="2.*'room'.*0"):
        read_scene_settings(tmp_path / "scene_setting.csv")
