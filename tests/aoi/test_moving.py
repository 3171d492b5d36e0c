"""Tests of `nerg_mi.aoi.moving` and `nerg_mi.tracking.objects`: a room whose objects move, against float64 NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.aoi.moving import to_object_frame
from nerg_mi.aoi.settings import AoiSampling, VisitRules
from nerg_mi.aoi.statistics import statistics
from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Similarity
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tracking.objects import ObjectPoses
from nerg_mi.tracking.rays import Rays
from tests.recorder import Recorder

ROOM = np.array([[0.0, 0, 0], [6, 4, 3]])
BOX = np.array([[3.0, 0.6, 0.8], [3.4, 1.4, 1.6]])  # moves and turns
BOOK = np.array([[4.4, 1.2, 1.0], [4.6, 2.2, 1.9]])  # is taken away
SIGN = np.array([[5.0, 1.0, 0.9], [5.1, 3.0, 2.1]])  # stays
RULES = VisitRules(min_visit=0.05)
STEP = 0.1
TIMES = np.array([0.0, 2.0, 4.0, 4.5, 9.0])
PLACES = np.array([[3.0, 1.0, 0], [3.0, 2.4, 0], [3.3, 2.4, 0.2], [3.3, 1.8, 0.2], [3.3, 1.8, 0.2]])
TURNS = np.array([20.0, 80, 140, 100, 100])  # degrees about z
TAKEN = 6.0
MEASURES = ("share", "dwell", "visits", "hit_ratio", "distance", "visible", "share_when_visible", "time_to_first_visit")
FREE = {"resamples": 199, "show_names": True, "rules": RULES}


def cube(corners):
    import mitsuba as mi

    half, middle = (corners[1] - corners[0]) / 2, corners.mean(axis=0)
    return {"type": "cube", "to_world": mi.ScalarTransform4f().translate(middle.tolist()).scale(half.tolist())}


def room(scale=1.0):
    from nerg_mi.environment.scene_loading import activate_mitsuba

    activate_mitsuba()
    return {name: cube(c * scale) for name, c in (("room", ROOM), ("box", BOX), ("book", BOOK), ("sign", SIGN))}


def poses(**options):
    away = np.full(3, np.nan)
    turns = Rotation.from_euler("z", TURNS[:, None], degrees=True).as_quat()
    return ObjectPoses.from_arrays(
        ["box"] * 5 + ["book"] * 2,
        [*TIMES, 0.0, TAKEN],
        [*PLACES, [0, 0, 0], away],
        [*turns, [0, 0, 0, 1], [0, 0, 0, 1]],
        max_gap=2.0,
        **options,
    )


AREAS = {
    "the box": {"shape": "box"},
    "book": {"min": BOOK[0].tolist(), "max": BOOK[1].tolist()},  # an area and a shape of the same name
    "sign": {"shape": "sign"},
    "things": {"parts": ["the box", "book"]},
}


def people(count=3, each=75, seed=1):
    """Participants who look east; with directions that last three samples, so that there are visits."""
    rng = np.random.default_rng(seed)
    n = count * each
    origin = np.column_stack([rng.uniform(0.3, 2.0, n), rng.uniform(0.5, 3.5, n), rng.uniform(1.3, 1.7, n)])
    target = np.column_stack([np.full(n, 4.2), rng.uniform(0.4, 3.2, n), rng.uniform(0.7, 2.2, n)])
    origin, target = (np.repeat(v[::3], 3, axis=0) for v in (origin, target))
    return Rays.from_arrays(
        origin,
        target - origin,
        times=np.tile(STEP * np.arange(each), count),
        participants=np.repeat([f"p{k}" for k in range(count)], each),
    )


def locate(name, t):
    """Return rotation and translation of an object at a time, None if it is absent."""
    if name == "book":
        return (np.eye(3), np.zeros(3)) if t < TAKEN else None
    if name != "box":
        return np.eye(3), np.zeros(3)
    angle = np.radians(np.interp(t, TIMES, TURNS) - TURNS[0])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    place = np.array([np.interp(t, TIMES, PLACES[:, k]) for k in range(3)])
    return turn, place - turn @ PLACES[0]


def first_hit(o, d, t):
    """Return the first surface on a ray at a time, and its distance."""
    result = ("", np.inf)
    for name, corners in (("room", ROOM), ("box", BOX), ("book", BOOK), ("sign", SIGN)):
        if (pose := locate(name, t)) is None:
            continue
        turn, move = pose
        p, v = turn.T @ (o - move), turn.T @ d
        with np.errstate(divide="ignore"):
            sides = np.sort((corners - p) / v, axis=0)
        near, far = sides[0].max(), sides[1].min()
        at = far if name == "room" else near
        if near < far and 0 < at < result[1]:
            result = name, float(at)
    return result


def surface_points(name):
    """Return the points of a shape or box at which visibility is tested, at rest, with normals of boxes."""
    from nerg_mi.aoi.areas import Areas
    from nerg_mi.aoi.placed import open_placed_areas

    placed = open_placed_areas(room(), None, Areas.load(AREAS))
    return next(aoi for aoi in placed.aois if aoi.name == name).sample_points(8)


def is_visible(name, area, o, facing, t, margin=0.03):
    if (pose := locate(name, t)) is None:
        return False
    turn, move = pose
    for point, normal in zip(*surface_points(area)):
        to_point = turn @ point + move - o
        distance = np.linalg.norm(to_point)
        faces = not normal.any() or (turn @ normal) @ to_point < 0
        if faces and to_point @ facing >= np.cos(np.radians(20)) * distance:
            if first_hit(o, to_point / distance, t)[1] >= distance - margin:
                return True
    return False


def expect(rays):
    """Return all measures of each area, by plain loops."""
    looks = [first_hit(o, d, t) for o, d, t in zip(rays.origin, rays.direction, rays.t)]
    members = {"the box": ("box",), "book": ("book",), "sign": ("sign",), "things": ("box", "book")}
    names = {"box": "the box", "book": "book", "sign": "sign"}
    seen = {
        name: [is_visible(name, names[name], o, d, t) for o, d, t in zip(rays.origin, rays.direction, rays.t)]
        for name in names
    }
    measures = {}
    for area, parts in members.items():
        rows = []
        for code in range(len(rays.persons)):
            mine = np.flatnonzero(rays.person == code)
            mine = mine[np.argsort(rays.t[mine])]
            on = [k for k in mine if looks[k][0] in parts]
            could = [k for k in mine if looks[k][0] in parts or any(seen[part][k] for part in parts)]
            starts = [k for n, k in enumerate(on) if n == 0 or rays.t[k] - rays.t[on[n - 1]] > STEP + 0.15 + 1e-6]
            first = rays.t[on[0]] - rays.t[mine[0]] if on else np.nan
            rows.append((len(on), len(could), len(starts), first, sum(looks[k][1] for k in on), len(mine)))
        hits, could, visits, first, distance, total = np.array(rows, float).T
        measures[area] = {
            "share": (hits / total).mean(),
            "dwell": STEP * hits.mean(),
            "visits": visits.mean(),
            "hit_ratio": (visits > 0).mean(),
            "time_to_first_visit": np.nanmean(first),
            "distance": distance.sum() / hits.sum(),
            "visible": (could / total).mean(),
            "share_when_visible": hits.sum() / could.sum(),
        }
    return measures


@pytest.mark.usefixtures("rgb")
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_all_measures_equal_those_of_float64(scale):
    rays = people()
    align = None if scale == 1 else Similarity(np.diag([scale, scale, scale, 1.0]))
    scaled = {name: {**area} for name, area in AREAS.items()}
    scaled["book"] = {"min": (BOOK[0] * scale).tolist(), "max": (BOOK[1] * scale).tolist()}
    result = statistics(
        [rays, room(scale)],
        scaled,
        align=align,
        objects=poses(),
        aoi_visibility=True,
        fov=40.0,
        sampling=AoiSampling(aoi_samples=8),
        **FREE,
    )
    expected = expect(rays)
    for row in result.aois:
        for name, value in expected[row["aoi"]].items():
            assert row[name] == pytest.approx(value, rel=1e-4), (row["aoi"], name)
    shares = [row["share"] for row in result.aois]
    assert min(shares) > 0.03
    still = statistics([rays, room()], AREAS, **FREE)
    assert not np.allclose([row["share"] for row in still.aois], shares, atol=0.01)


@pytest.mark.usefixtures("rgb")
def test_objects_at_rest_change_nothing():
    rays = people()
    rest = ObjectPoses.from_arrays(["box", "book"], [0.0, 0.0], [[5, 5, 5], [0, 0, 0]], max_gap=100.0)
    options = {"aoi_visibility": True, "sampling": AoiSampling(cell_size=0.001, aoi_samples=8)} | FREE
    still, moved = (statistics([rays, room()], AREAS, objects=o, **options) for o in (None, rest))
    for a, b in zip(still.aois, moved.aois):
        for name in MEASURES:
            assert b[name] == pytest.approx(a[name], rel=1e-4), (a["aoi"], name)


@pytest.mark.usefixtures("rgb")
def test_parts_give_the_same_tables(tmp_path):
    rays = people()
    options = {"objects": poses(), "aoi_visibility": True, "sampling": AoiSampling(aoi_samples=4)} | FREE
    whole, parts = (
        statistics([rays, room()], AREAS, parallel=p, **options) for p in (Parallel(), Parallel(store=tmp_path / "s"))
    )
    assert whole.aois == parts.aois and whole.transitions == parts.transitions


@pytest.mark.usefixtures("rgb")
def test_areas_move_without_an_environment():
    # Two looks along x, at a box in the air that moves out of the way after a second.
    rays = Rays.from_arrays(np.zeros((4, 3)), [[1.0, 0, 0]] * 4, times=[0.0, 0.5, 2.0, 2.5])
    air = {"kite": [[2, -0.5, -0.5], [3, 0.5, 0.5]], "cloud": [[5, -2, -2], [6, 2, 2]]}
    steps = ObjectPoses.from_arrays(["kite"] * 4, [0, 1, 1, 3], [[0, 0, 0], [0, 0, 0], [0, 9, 0], [0, 9, 0]], max_gap=5)
    result = statistics(rays, air, objects=steps, aoi_visibility=True, **FREE)
    rows = {row["aoi"]: row for row in result.aois}
    assert rows["kite"]["share"] == rows["cloud"]["share"] == pytest.approx(0.5)
    assert rows["kite"]["distance"] == pytest.approx(2) and rows["cloud"]["distance"] == pytest.approx(5)
    assert rows["kite"]["visible"] == pytest.approx(0.5)


@pytest.mark.usefixtures("rgb")
def test_a_volume_occludes_objects():
    import mitsuba as mi

    to_world = mi.ScalarTransform4f().translate([4, -1, -1]).scale([1, 2, 2])
    fog = {"type": "nerg", "density": {"type": "constvolume", "value": 500.0, "to_world": to_world}}
    scene = {"type": "scene", "integrator": fog, "box": cube(np.array([[2.0, -0.2, -0.2], [2.4, 0.2, 0.2]]))}
    rays = Rays.from_arrays(np.zeros((8, 3)), [[1.0, 0, 0]] * 8, times=np.arange(8) / 4)
    # In front of the volume, behind it from 0.5 to 1.25 s, and in front of it again.
    places = [[k, 0, 0] for k in (0, 0, 4, 4, 1, 1)]
    jumps = ObjectPoses.from_arrays(["box"] * 6, [0, 0.5, 0.5, 1.25, 1.25, 2], places)
    areas = {"box": {"shape": "box"}, "fog": [[4, -1, -1], [5, 1, 1]]}
    rows = {row["aoi"]: row for row in statistics([rays, scene], areas, objects=jumps, **FREE).aois}
    assert rows["box"]["share"] == pytest.approx(5 / 8) and rows["fog"]["share"] == pytest.approx(3 / 8)
    assert rows["box"]["distance"] == pytest.approx((2 * 2 + 3 * 3) / 5, rel=1e-3)
    assert rows["fog"]["distance"] == pytest.approx(4, abs=0.02)


@pytest.mark.usefixtures("rgb")
def test_gaze_on_an_object_lies_on_its_surface_at_rest():
    rays = people()
    on_box = to_object_frame(rays, poses(), "box", room())
    looks = [first_hit(o, d, t) for o, d, t in zip(rays.origin, rays.direction, rays.t)]
    assert len(on_box) == sum(name == "box" for name, _ in looks)
    hit = on_box.hit
    offset = np.abs(np.concatenate([hit - BOX[0], hit - BOX[1]], axis=1)).min(axis=1)
    assert offset.max() < 1e-4 and (hit > BOX[0] - 1e-4).all() and (hit < BOX[1] + 1e-4).all()
    distance = np.linalg.norm(hit - on_box.origin, axis=1)
    assert np.allclose(distance, [d for name, d in looks if name == "box"], atol=1e-4)
    assert np.allclose(on_box.origin + distance[:, None] * on_box.direction, hit)
    # Without an environment, all samples while it is there.
    assert len(to_object_frame(rays, poses(), "book")) == (rays.t < TAKEN).sum()
    for name in ("chair", "book"):
        with pytest.raises(NergError):
            to_object_frame(replace(rays, t=rays.t + 100), poses(), name)


# ---- Tables, gaps and clocks ----

ONE = Rays.from_arrays(np.zeros((6, 3)), [[1.0, 0, 0]] * 6, times=np.arange(6.0))


def unknown_at(**options):
    """Return the times of `ONE` at which the pose of the only object is unknown, and those at which it is present."""
    motion = ObjectPoses.from_arrays(**options).find_motion("a", ONE)
    return np.flatnonzero(motion.is_unknown).tolist(), np.flatnonzero(motion.is_present).tolist()


def test_gaps_are_interpolated_up_to_the_limit():
    away = [np.nan] * 3
    moves = {"objects": ["a", "a"], "times": [0.5, 4.5], "positions": [[0, 0, 0], [4, 0, 0]]}
    assert unknown_at(**moves, max_gap=4.0) == ([], [0, 1, 2, 3, 4, 5])
    assert unknown_at(**moves, max_gap=3.9) == ([1, 2, 3, 4], [0, 5])
    assert unknown_at(**moves, max_gap=0.2) == ([0, 1, 2, 3, 4, 5], [])
    # One that has not moved, or is taken away, keeps its pose.
    assert unknown_at(**moves | {"positions": [[4, 0, 0]] * 2}) == ([], [0, 1, 2, 3, 4, 5])
    assert unknown_at(**moves | {"positions": [[4, 0, 0], away]}) == ([], [0, 1, 2, 3, 4])
    back = {"objects": ["a"] * 3, "times": [0, 2, 4], "positions": [[0, 0, 0], away, [1, 1, 1]]}
    assert unknown_at(**back) == ([], [0, 1, 4, 5])
    motion = ObjectPoses.from_arrays(**moves, max_gap=9.0).find_motion("a", ONE)
    assert np.allclose(motion.translation[:, 0], [0, 0.5, 1.5, 2.5, 3.5, 4])


def test_tables_are_read(tmp_path):
    file = tmp_path / "poses.csv"
    half = np.sqrt(0.5)
    file.write_text(
        f"participant,time_ms,object,position_z,position_x,position_y,qw,qx,qy,qz\n,,a,0,1,0,1,0,0,0\n"
        f"p1,1000,a,0,2,0,{half},0,0,{half}\n,0,a,0,1,0,1,0,0,0\n,2000,a,,,,,,,\n"
    )
    rays = Rays.from_arrays(
        np.zeros((4, 3)), [[1.0, 0, 0]] * 4, times=[1, 1.5] * 2, participants=["p1", "p1", "p2", "p2"]
    )
    motion = ObjectPoses.load(file).find_motion("a", rays)
    assert motion.is_present.all()
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert np.allclose(motion.rotation, [quarter, quarter, np.eye(3), np.eye(3)])
    # The point (1, 0, 0) of its pose in the environment is at (2, 0, 0).
    assert np.allclose(motion.move(np.array([[1.0, 0, 0]]))[:, 0, 0], [2, 2, 1, 1])
    file.write_text(
        "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z\n"
        f"77,1000000000,1,0,0,1,0,0,0\n77,2000000000,2,0,0,{half},0,0,{half}\n"
    )
    poses = ObjectPoses.load(file)
    assert poses.names == ("77",) and poses.times.tolist() == [1, 2]
    assert np.allclose(poses.find_motion("77", replace(rays, t=rays.t + 0.5)).rotation[1::2], quarter)
    for text in (
        "time,object,x,y\n0,a,1,0\n",
        "time,x,y,z\n0,1,0,0\n",
        "object,x,y,z\na,1,0,0\n",
        "time,object,x,y,z\n",
        "time,object,x,y,z\n0,a,1,,0\n",
        "time,object,x,y,z\n0,a,,,\n",
        "time,object,x,y,z,qw,qx,qy,qz\n0,a,1,0,0,1,1,0,0\n",
        "time,object,x,y,z,qw,qx,qy,qz\n0,a,1,0,0,,,,\n",
        "time,object,x,y,z\n0,a,1e99,0,0\n",
    ):
        file.write_text(text)
        with pytest.raises(NergError):
            ObjectPoses.load(file)


def test_frames_with_a_scale_and_a_mirror_are_transformed():
    # From a left-handed frame with y up in centimetres.
    matrix = np.array([[0.01, 0, 0, 1], [0, 0, 0.01, 2], [0, 0.01, 0, 3], [0, 0, 0, 1]])
    turns = Rotation.from_euler("y", [[0], [50]], degrees=True)
    places = np.array([[100.0, 0, 0], [300, 50, 70]])
    point = np.array([120.0, 30, -40])
    moved = turns[1].apply(point - places[0]) + places[1]
    to_rays = lambda p: matrix[:3, :3] @ p + matrix[:3, 3]
    made = ObjectPoses.from_arrays(["a"] * 2, [0, 1], places, turns.as_quat()).transform(matrix)
    motion = made.find_motion("a", ONE)
    assert np.allclose(motion.move(to_rays(point)[None])[1, 0], to_rays(moved))


@pytest.mark.usefixtures("rgb")
def test_clocks_and_gaps_are_options():
    recorder, made = Recorder(), poses()
    expected = statistics([people(), room()], AREAS, objects=replace(made, max_gap=0.5), **FREE)
    late = replace(made.shift(-7.5), max_gap=3.0)
    options = {"pose_gap": 0.5, "clock_offset": 7.0, "progress": recorder}
    result = statistics([people(), room()], AREAS, objects=late.shift(0.5), **options, **FREE)
    assert result.aois == expected.aois != statistics([people(), room()], AREAS, objects=made, **FREE).aois
    assert {"pose_gap": 0.5, "clock_offset": 7.0}.items() <= result.provenance.settings.items()
    # Samples and poses start together without an offset.
    off = statistics([people(), room()], AREAS, objects=made.shift(1.25), progress=recorder, **FREE)
    (reported,) = [text for text in recorder.messages if "clock_offset" in text]
    assert off.aois != expected.aois and "-1.25 s" in reported
    with pytest.raises(NergError, match="objects"):
        statistics([people(), room()], AREAS, clock_offset=1.0)


@pytest.mark.usefixtures("rgb")
def test_bad_poses_are_named():
    rays, options = people(each=9), FREE
    for names in (["lamp"], ["box", "the box"]):
        with pytest.raises(NergError, match=names[-1]):
            made = ObjectPoses.from_arrays(names, [0.0] * len(names), [[0, 0, 0]] * len(names))
            statistics([rays, room()], AREAS, objects=made, **options)
    with pytest.raises(NergError, match="clocks"):
        statistics([rays, room()], AREAS, objects=poses().shift(1e6), **options)
    with pytest.raises(NergError, match="objects"):
        statistics(room(), AREAS, objects=poses(), observers=[[1, 1, 1.6]], **options)
    recorder = Recorder()
    partial = ObjectPoses.from_arrays(["box"] * 2, [0.0, 0.1], [[0, 0, 0], [1, 0, 0]], max_gap=0.25)
    statistics([rays, room()], AREAS, objects=partial, progress=recorder, **options)
    assert any("box" in text and "15 of 27" in text for text in recorder.warnings)
