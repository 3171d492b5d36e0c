"""Heads and gaze in the space of motion capture systems."""

import math
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers import registry
from nerg_mi.tracking.readers.columns import ColumnMap
from tests.refusals import mentions
from tests.tracking.readers.examples import dropped, motive, read, write_c3d, write_heads

# ---- Gaze: Qualisys, and Neon in motion capture ----

QTM_HEADER = "FILE_VERSION\t2.0.0\nGAZE_VECTOR_NAME\tann (L)\nNO_OF_SAMPLES\t5\nFREQUENCY\t50\n"
QTM_HEADER += "TIME_STAMP\t2026-11-22, 10:00:00.000\t1234.5\nSTART_OFFSET\t0.04\nHW_SYNC\tYES\nFILTER\tNO\n"
QTM_NAMES = "X Pos\tY Pos\tZ Pos\tX Vec\tY Vec\tZ Vec\n"


def look(k: int, side: int = 0) -> tuple[list[float], list[float]]:
    """A person who walks along x at 1 m/s, 1.6 m high, and turns 2 degrees per sample from x to the left, 10 degrees
    down; the eyes are 60 mm apart, and ``side`` is 1 for the left one, -1 for the right one."""
    turn, down = math.radians(2 * k), math.radians(10)
    ahead = [math.cos(down) * math.cos(turn), math.cos(down) * math.sin(turn), -math.sin(down)]
    return [20 * k - side * 30 * math.sin(turn), side * 30 * math.cos(turn), 1600], ahead


def qtm_row(*cells) -> str:
    return "\t".join(str(c) for c in cells) + "\n"


def write_qtm(path, *, header=QTM_HEADER, names=QTM_NAMES, before=lambda k: (), side=0, lost=(), count=5):
    rows = [
        qtm_row(*before(k), *(["", "", "", 0, 0, 0] if k in lost else [*look(k, side)[0], *look(k, side)[1]]))
        for k in range(count)
    ]
    path.write_text(header + names + "".join(rows))
    return path


def assert_direction(rays, samples, start=-0.04):
    assert np.allclose(rays.t, [start + 0.02 * k for k in samples])
    origin, ahead = zip(*(look(k) for k in samples))
    assert np.allclose(rays.origin, np.array(origin) / 1000) and np.allclose(rays.direction, ahead)


@pytest.mark.parametrize("names", [QTM_NAMES, ""])
@pytest.mark.parametrize("timed", [True, False])
def test_optional_columns_and_times(tmp_path, names, timed):
    before = (lambda k: (k + 1, 3 + 0.02 * k)) if timed else (lambda k: ())
    named = "Sample\tTime\t" + names if names and timed else names
    rays = read("qualisys", write_qtm(tmp_path / "ann_g.tsv", names=named, before=before, lost=(2,)))
    assert_direction(rays, [0, 1, 3, 4], 3 if timed else -0.04)
    assert rays.persons == ("ann",)
    assert dropped(rays) == {"no eye was seen": [[9 + bool(names) + 2] * 2]}
    # Without any information about time.
    bare = write_qtm(tmp_path / "bo_g.tsv", header="", names=named, before=before)
    if timed:
        assert len(read("qualisys", bare)) == 5
    else:
        with pytest.raises(NergError, match="bo_g.tsv has no times"):
            read("qualisys", bare)


def test_two_eyes_are_one_ray(tmp_path):
    left = write_qtm(tmp_path / "ann_g_1.tsv", side=1, lost=(1, 3))
    right = write_qtm(tmp_path / "ann_g_2.tsv", side=-1, lost=(3, 4), count=7)
    rays = read("qualisys", tmp_path)
    assert rays.persons == ("ann",) and np.allclose(rays.t, [-0.04, -0.02, 0.0, 0.04])
    assert rays.metadata["rows_read"] == 5
    # Midway between both eyes; if one was not tracked, the other.
    for at, (k, side) in enumerate(((0, 0), (1, -1), (2, 0), (4, 1))):
        assert np.allclose(1000 * rays.origin[at], look(k, side)[0]) and np.allclose(rays.direction[at], look(k)[1])
    assert dropped(rays) == {"no eye was seen": [[13, 13]]}
    assert [s["file"] for s in rays.metadata["sources"]] == ["ann_g_2.tsv", "ann_g_1.tsv"]
    # A single eye is read alone, and other files belong to other participants.
    assert np.allclose(1000 * read("qualisys", right).origin[0], look(0, -1)[0])
    assert read("qualisys", left, write_qtm(tmp_path / "bo_g.tsv")).persons == ("ann", "bo")
    assert len(read("qualisys", write_qtm(tmp_path / "other.tsv"))) == 5


def test_truncated_line(tmp_path):
    path = write_qtm(tmp_path / "ann_g.tsv", count=300)
    text = path.read_text().split("\n")
    text[20] = text[20][:20]
    path.write_text("\n".join(text))
    with pytest.raises(NergError, match="ann_g.tsv.*21"):
        read("qualisys", path)
    assert_direction(read("qualisys", path, skip_bad_lines=True), [k for k in range(300) if k != 11])


def test_up_axis_and_invalid_input(tmp_path):
    rays = read("qualisys", write_qtm(tmp_path / "ann_g.tsv"), up="y")
    assert np.allclose(rays.origin[0], [0, -1.6, 0])
    (tmp_path / "bo_g.tsv").write_text("MARKER_NAMES\ta\n1\t2\t3\n")
    with pytest.raises(NergError, match="bo_g.tsv has no gaze vectors"):
        read("qualisys", tmp_path / "bo_g.tsv")
    (tmp_path / "empty").mkdir()
    with pytest.raises(NergError, match="no gaze vectors .*empty"):
        read("qualisys", tmp_path / "empty")


NEON_NAMES = (
    "timestamp [ns],LF_X,gaze_origin_X,gaze_origin_Y,gaze_origin_Z,gaze_dir_X,gaze_dir_Y,gaze_dir_Z,head_dir_X\n"
)


def test_neon_in_motion_capture(tmp_path):
    """As the tool writes it: pandas' index first, markers next to the gaze, empty if the glasses were not located."""
    path = tmp_path / "ann" / "gaze_in_mocap_space.csv"
    path.parent.mkdir()
    rows = [[k, 1_700_000_000_000_000_000 + 5_000_000 * k, 7, *look(k)[0], *look(k)[1], 1] for k in range(4)]
    rows[2][3:] = [""] * 7
    path.write_text("," + NEON_NAMES + "".join(",".join(map(str, r)) + "\n" for r in rows))
    rays = read("neon_mocap", path, up="z")
    assert rays.persons == ("ann",) and np.allclose(rays.t - 1.7e9, [0, 0.005, 0.015], atol=1e-6)
    origin, ahead = zip(*(look(k) for k in (0, 1, 3)))
    assert np.allclose(rays.origin, np.array(origin) / 1000) and np.allclose(rays.direction, ahead)
    assert dropped(rays) == {"the glasses' markers were not seen": [[4, 4]]}
    # Another file name is that of the participant; metres with y up.
    other = path.rename(path.with_name("bo.csv"))
    metres = read("neon_mocap", other, up="y", units="m")
    assert metres.persons == ("bo",) and np.allclose(metres.origin[1], np.array(origin[1])[[0, 2, 1]] * (1, -1, 1))
    with pytest.raises(NergError, match='specify it .up="z"'):
        read("neon_mocap", other)
    for old, new, message in (
        ("timestamp [ns]", "time", '"timestamp .ns.".*LF_X'),
        ("gaze_dir", "dir", "no columns gaze_dir"),
    ):
        other.write_text(NEON_NAMES.replace(old, new) + "0\n")
        with pytest.raises(NergError, match=message):
            read("neon_mocap", other, up="z")


# ---- Heads tracked with Motive ----

MOTIVE_N = 12
MOTIVE_T = 0.01 * np.arange(MOTIVE_N)
PLACE = np.c_[0.1 * np.arange(MOTIVE_N), np.full(MOTIVE_N, 1.6), -2 + 0.05 * np.arange(MOTIVE_N)]
TURN = Rotation.from_euler("YX", np.c_[10.0 * np.arange(MOTIVE_N), np.full(MOTIVE_N, -20.0)], degrees=True)


def write_motive(path, **extra):
    path.write_text(motive(MOTIVE_T, **{"bodies": {"Head": (PLACE, TURN)}, **extra}))
    return path


def in_rays(v):
    return np.c_[v[:, 0], -v[:, 2], v[:, 1]]


@pytest.mark.parametrize("forward, axis", [(None, [0, 0, -1]), ("-z", [0, 0, -1]), ("x", [1, 0, 0])])
def test_motive_heads(tmp_path, forward, axis):
    rays = read("motive", write_motive(tmp_path / "ann.csv"), forward=forward)
    assert np.allclose(rays.t, MOTIVE_T) and rays.persons == ("ann",)
    assert np.allclose(rays.origin, in_rays(PLACE)) and np.allclose(rays.direction, in_rays(TURN.apply(axis)))
    assert ("complaints" in rays.metadata) == (forward is None)
    unused = rays.metadata["unused_columns"]
    assert unused[0] == "Head Rigid Body Mean Marker Error" and len(unused) == 4 and "Frame" not in unused


def test_units_up_and_lost_samples(tmp_path):
    place = 1000 * PLACE[:, [0, 2, 1]] * [1, -1, 1]
    place[3:5] = np.nan
    turn = Rotation.from_matrix(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ TURN.as_matrix())
    path = write_motive(tmp_path / "ann.csv", bodies={"Head": (place, turn)}, units="Millimeters")
    rays = read("motive", path, up="z")
    selected = np.r_[0:3, 5:MOTIVE_N]
    assert np.allclose(rays.origin, in_rays(PLACE)[selected])
    assert np.allclose(rays.direction, in_rays(TURN.apply([0, 0, -1]))[selected])
    assert dropped(rays) == {"the rigid body was not tracked": [[11, 12]]}


def test_which_body_is_the_head(tmp_path):
    other = PLACE + 5, TURN
    both = write_motive(tmp_path / "a.csv", bodies={"Trolley": other, "HMD 1": (PLACE, TURN)})
    assert np.allclose(read("motive", both).origin, in_rays(PLACE))
    assert np.allclose(read("motive", both, rigid_body="Trolley").origin, in_rays(PLACE + 5))
    unclear = write_motive(tmp_path / "b.csv", bodies={"A": other, "B": other})
    for options in ({}, {"rigid_body": "C"}):
        with pytest.raises(NergError, match="rigid bodies A, B"):
            read("motive", unclear, **options)
    # A repeated name is one body with repeated columns.
    path = tmp_path / "c.csv"
    path.write_text(motive(MOTIVE_T, {"Head": other, "head": other}).replace("head", "Head"))
    with pytest.raises(NergError, match="several columns called 'Head Rigid Body"):
        read("motive", path)


@pytest.mark.parametrize(
    "name, options", [("unity", {}), ("table", {"columns": ColumnMap.parse("origin=X,Y,Z ypr=a,b")})]
)
def test_other_readers_name_it(tmp_path, name, options):
    with pytest.raises(NergError, check=mentions("preset")):
        read(name, write_motive(tmp_path / "ann.csv"), **options)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("Rotation Type,Quaternion", "Rotation Type,XYZ", "rotation type 'XYZ'; export it again with Quaternion"),
        ("Space,Global", "Space,Local", "coordinate space 'Local'"),
        ("Units,Meters", "Units,Inches", "length units 'Inches'"),
        ("Format Version,1.23,", "", "not an export of Motive"),
        ("Frame,Time", "Frames,Time", "not an export of Motive"),
        (",Type,", ",Kind,", "no lines of types"),
        ("0,0.0,", "0,0.0,9,", "line 8: 17 cells, the header has 16|line 8: 14 cells, the header has 13"),
    ],
)
def test_other_exports_are_refused(tmp_path, old, new, message):
    path = write_motive(tmp_path / "ann.csv")
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(NergError, match=message):
        read("motive", path)


# ---- C3D files: heads from markers ----

needs_c3d = pytest.mark.skipif(find_spec("c3d") is None, reason="c3d is not installed")

# A head that looks along x, with y to its left, in metres: ears, nose, and the headband of Plug-in Gait.
HEAD = {
    "Left_Ear": (0, 0.075, 0),
    "Right_Ear": (0, -0.075, 0),
    "Nose": (0.12, 0, 0),
    "LFHD": (0.08, 0.06, 0.05),
    "RFHD": (0.08, -0.06, 0.05),
    "LBHD": (-0.1, 0.06, 0.05),
    "RBHD": (-0.1, -0.06, 0.05),
    "C7": (-0.05, 0, -0.3),
}
BAND = ["LFHD", "RFHD", "LBHD", "RBHD"]
HEAD |= {f"{name[0]}_HD{name[1]}": HEAD[name] for name in BAND}  # as Qualisys calls them


def turned(n=12, seed=0):
    """Heads (n) in all directions: rotations and positions."""
    rng = np.random.default_rng(seed)
    return Rotation.from_quat(rng.normal(size=(n, 4))), rng.uniform([-4, -4, 1.2], [4, 4, 1.9], (n, 3))


def positions(names, turn, place):
    return np.stack([turn.apply(HEAD[name]) + place for name in names], axis=1)


@needs_c3d
@pytest.mark.parametrize(
    "names, keypoints, centre, unused",
    [
        (["C7", "LFHD", "RFHD", "LBHD", "RBHD"], None, (-0.01, 0, 0.05), ["C7"]),
        (["Nose", "Left_Ear", "Right_Ear", "LFHD"], None, (0, 0, 0), ["LFHD"]),
        (["L_HDF", "R_HDF", "L_HDB", "R_HDB"], None, (-0.01, 0, 0.05), []),
        (["LFHD", "RFHD", "C7"], ("LFHD", "RFHD", "LFHD+RFHD+C7"), (0.08, 0, 0.05), []),
    ],
)
@pytest.mark.parametrize("unit, size", [("mm", 1e-3), ("m", 1.0)])
def test_heads_in_all_directions(tmp_path, names, keypoints, centre, unused, unit, size):
    turn, place = turned()
    write_c3d(tmp_path / "ann.c3d", names, positions(names, turn, place) / size, units=unit)
    rays = read("c3d", tmp_path / "ann.c3d", **({"keypoints": keypoints} if keypoints else {}))
    forward = np.array([1.0, 0, 0])
    if keypoints:
        front = np.mean([HEAD[name] for name in ("LFHD", "RFHD", "C7")], axis=0) - centre
        forward = front / np.linalg.norm(front)
    assert np.abs(rays.direction - turn.apply(forward)).max() < 1e-5
    assert np.abs(rays.origin - turn.apply(centre) - place).max() < 1e-5
    assert np.allclose(rays.t, np.arange(12) / 100) and rays.persons == ("ann",)
    assert "complaints" not in rays.metadata
    assert rays.metadata.get("unused_columns", []) == unused


@needs_c3d
@pytest.mark.parametrize("up", ["+Y", "-Y"])
def test_participants_axes_and_missing_markers(tmp_path, up):
    """Two participants in one file with y up; missing markers at exactly zero and at a fill value."""
    turn, place = turned()
    names = ["LFHD", "RFHD", "LBHD", "RBHD"]
    ann = positions(names, turn, place)
    bo = positions(names, turn.inv(), place + 1)
    ann[3, 1], bo[5, 2] = np.nan, 0
    both = np.concatenate([ann, bo], axis=1)
    upright = 1000 * np.stack([both[..., 0], both[..., 2], -both[..., 1]], axis=-1)
    upright[7, 6] = -9999
    labels = [f"{person}:{name}" for person in ("Ann", "Bo") for name in names]
    write_c3d(tmp_path / "trial.c3d", labels, upright, up=up, rate=50)
    rays = read("c3d", tmp_path / "trial.c3d")
    assert rays.persons == ("Ann", "Bo") and rays.metadata["source_frame"]["up"] == "y"
    assert dropped(rays) == {"a keypoint of the head is missing": [[4, 4], [6, 6], [8, 8]]}
    mine = rays.person == 1
    present = ~np.isin(np.arange(12), [5, 7])
    assert np.abs(rays.direction[mine] - turn.inv().apply([1, 0, 0])[present]).max() < 1e-5
    assert np.allclose(rays.t[mine], np.arange(12)[present] / 50)


@needs_c3d
def test_files_without_unit_axis_or_rate(tmp_path):
    path, present = tmp_path / "ann.c3d", positions(BAND, *turned())
    write_c3d(path, BAND, present, units=None, up=None, frames=40)
    said = read("c3d", path, units="m").metadata["complaints"]
    assert "the up axis; z is assumed" in said[0] and "ends after 12 of the 40 frames" in said[1]
    wide = read("c3d", path, units="mm", up="z").metadata["complaints"]
    assert "0.00012 m apart" in wide[1]


@needs_c3d
@pytest.mark.parametrize(
    "labels, units, options, message",
    [
        (BAND, None, {}, "(units)"),
        (BAND, "in", {}, 'has the unit "in"'),
        (["A", "B"], "mm", {}, "its markers are A, B; name those"),
        ([], "mm", {}, "has no markers"),
        (["A", "B"], "mm", {"keypoints": ("A", "B", "C")}, "no known head markers"),
    ],
)
def test_files_without_head_markers_are_refused(tmp_path, labels, units, options, message):
    present = positions(BAND, *turned())[:, : len(labels)]
    write_c3d(tmp_path / "ann.c3d", labels or ["A"], present, units=units)
    with pytest.raises(NergError, match=message):
        read("c3d", tmp_path / "ann.c3d", **options)


@needs_c3d
@pytest.mark.parametrize("tilt", [10, 40, -25])
def test_tilted_headbands_give_a_warning(tmp_path, tilt):
    """A walker who looks ahead with a tilted headband, corrected by the proposed pitch."""
    names, path = ["LFHD", "RFHD", "LBHD", "RBHD"], tmp_path / "ann.c3d"
    turn = Rotation.from_euler("z", np.linspace(0, 300, 30)[:, None], degrees=True)
    band = turn * Rotation.from_euler("y", -tilt, degrees=True)
    write_c3d(path, names, 1000 * positions(names, band, np.full((30, 3), 1.6)), units="mm  mm  mm", frames=31)
    said = read("c3d", path).metadata.get("complaints", [])
    assert said == [] if tilt == 10 else f"point {tilt} degrees up (median)" in said[0]
    assert tilt == 10 or f"pitch={-tilt} makes them level" in said[0]
    assert np.abs(read("c3d", path, pitch=-tilt).direction - turn.apply([1, 0, 0])).max() < 1e-5


@needs_c3d
@pytest.mark.parametrize("length", [1, 100, 600, 700])
def test_truncated_files(tmp_path, length):
    write_heads(tmp_path / "ann.c3d")
    data = (tmp_path / "ann.c3d").read_bytes()
    (tmp_path / "ann.c3d").write_bytes(data[:length])
    with pytest.raises(NergError, match=r"ann\.c3d"):
        registry.read_rays("c3d", tmp_path / "ann.c3d")
