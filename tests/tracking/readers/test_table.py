"""Tests of tables with a column map."""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers.base import RaysBuilder
from nerg_mi.tracking.readers.columns import ColumnMap
from nerg_mi.tracking.readers.table import TableOptions, add_tables, find_tracking
from tests.tracking.readers.examples import dropped, read


def read_table(path, columns, **options):
    return read("table", path, columns=ColumnMap.parse(columns), **options)


def test_table_of_another_frame(tmp_path):
    path = tmp_path / "unity.csv.gz"
    with gzip.open(path, "wt") as out:
        out.write("id,ms,px,py,pz,dx,dy,dz,ok\n")
        out.write(
            "bo,0,100,160,300,0,0,2,1\nann,500,0,170,0,0,-1,0,0.2\nann,1000,0,170,0,1,0,0,.9\nann,1500,0,170,0,,,,1\n"
        )
    mapping = "origin=px,py,pz direction=dx,dy,dz t=ms person=id confidence=ok"
    rays = read_table(path, mapping, up="y", handedness="left", units="cm", tick=1e-3, min_confidence=0.5)
    assert np.allclose(rays.origin, [[1, 3, 1.6], [0, 0, 1.7]])
    assert np.allclose(rays.direction, [[0, 1, 0], [1, 0, 0]])
    assert np.allclose(rays.t, [0, 1]) and [rays.persons[p] for p in rays.person] == ["bo", "ann"]
    assert {d["reason"]: d["rows"] for d in rays.metadata["dropped"]} == {
        "direction is missing": [[5, 5]],
        "confidence below 0.5 (option min_confidence)": [[3, 3]],
    }
    assert rays.metadata["source_frame"] == {"up": "y", "handedness": "left", "units": "cm"}
    by_file = read_table(path, mapping, person_from="filename")
    assert by_file.persons == ("unity",)


@pytest.mark.parametrize(
    "kinds, expected",
    [("head head", "head"), ("eye head", "mixed"), ("unknown unknown", "eye"), ("0 1", "eye"), ("head ok", "head")],
)
def test_tables_may_state_what_was_tracked(tmp_path, kinds, expected):
    """As those do that are written from the data frames of rays."""
    path, columns = tmp_path / "log.csv", "origin=x,y,z direction=dx,dy,dz"
    path.write_text("x,y,z,dx,dy,dz,tracking\n" + "".join(f"1,1,1.6,1,0,0,{kind}\n" for kind in kinds.split()))
    assert read_table(path, columns).tracking == expected
    assert read_table(path, columns, tracking="eye").tracking == "eye"


def write(path, header, rows):
    path.write_text(header + "\n" + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows))
    return path


@pytest.fixture(scope="module")
def heads():
    """Origins and rotations of 20 heads."""
    rng = np.random.default_rng(1)
    return rng.uniform(0, 3, (20, 3)), Rotation.from_quat(rng.normal(size=(20, 4)))


@pytest.mark.parametrize("kind", ["xyzw", "wxyz", "matrix"])
@pytest.mark.parametrize("forward", ["z", "-z", "x"])
def test_poses_of_any_kind_give_the_same_rays(tmp_path, heads, kind, forward):
    origin, turn = heads
    names = {"xyzw": "a,b,c,d", "wxyz": "a,b,c,d", "matrix": ",".join(f"m{i}" for i in range(16))}[kind]
    if kind == "matrix":
        m = np.tile(np.eye(4), (20, 1, 1))
        m[:, :3, :3], m[:, :3, 3] = 2.5 * turn.as_matrix(), origin  # a scale is no part of the pose
        path = write(tmp_path / "t.csv", names, m.reshape(20, 16))
        mapping = f"matrix={names}"
    else:
        q = np.roll(turn.as_quat(), 1 if kind == "wxyz" else 0, axis=1)
        path = write(tmp_path / "t.csv", "x,y,z," + names, np.hstack([origin, q]))
        mapping = f"origin=x,y,z {kind}={names}"
    rays = read_table(path, mapping, up="y", handedness="left", forward=forward)
    ahead = np.array({"z": (0, 0, 1.0), "-z": (0, 0, -1.0), "x": (1.0, 0, 0)}[forward])
    assert np.allclose(rays.origin, origin[:, [0, 2, 1]]) and np.allclose(
        rays.direction, turn.apply(ahead)[:, [0, 2, 1]]
    )
    assert rays.metadata["forward"] == forward


def test_eyes_in_the_heads_frame(tmp_path, heads):
    origin, turn = heads
    eye, gaze = np.array([0.03, 0.0, 0.08]), np.array([0.1, -0.2, 1.0])
    rows = np.hstack([origin, turn.as_quat(), np.tile(np.r_[eye, gaze], (20, 1))])
    path = write(tmp_path / "t.csv", "x,y,z,a,b,c,d,ex,ey,ez,gx,gy,gz", rows)
    rays = read_table(path, "origin=x,y,z xyzw=a,b,c,d eye=ex,ey,ez direction=gx,gy,gz")
    assert np.allclose(rays.origin, origin + turn.apply(eye))
    assert np.allclose(rays.direction, turn.apply(gaze / np.linalg.norm(gaze)))


@pytest.mark.parametrize(
    "frame, angles, want",  # want: in our frame
    [
        (dict(up="y", handedness="left"), (90, 0, 30), (1, 0, 0)),  # Unity: to the right of forward z, our y
        (dict(up="y", handedness="left"), (0, 30, 0), (0, 3**0.5 / 2, -0.5)),  # Unity: down
        (dict(up="z"), (90, 0, 0), (0, 1, 0)),  # ROS: to the left of forward x
        (dict(up="z"), (0, 30, 0), (3**0.5 / 2, 0, -0.5)),  # ROS: down
        (dict(up="y"), (90, 0, 0), (-1, 0, 0)),  # OpenXR: to the left of forward -z, our y
        (dict(up="y"), (0, 30, 0), (0, 3**0.5 / 2, 0.5)),  # OpenXR: up
    ],
)
def test_angles_turn_by_the_convention_of_the_frame(tmp_path, frame, angles, want):
    path = write(tmp_path / "t.csv", "x,y,z,a,b,c", [(0, 0, 0, *angles), (0, 0, 0, *angles)])
    assert np.allclose(read_table(path, "origin=x,y,z ypr=a,b,c", **frame).direction, want)
    assert np.allclose(read_table(path, "origin=x,y,z ypr=a,b", **frame).direction, want)
    path = write(tmp_path / "r.csv", "x,y,z,a,b,c", [(0, 0, 0, *np.radians(angles))])
    assert np.allclose(read_table(path, "origin=x,y,z ypr=a,b,c", radians=True, **frame).direction, want)


def test_rows_with_invalid_poses_are_dropped(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("x,y,z,a,b,c,d\n0,0,0,0,0,0,1\n0,0,0,0,0,0,0\n0,0,0,nan,0,0,1\n")
    assert dropped(read_table(path, "origin=x,y,z xyzw=a,b,c,d")) == {"direction is missing": [[3, 4]]}
    path = write(tmp_path / "m.csv", ",".join("abcdefghijkl"), [np.eye(4)[:3].ravel(), np.ones(12)])
    assert list(dropped(read_table(path, MATRIX)).values()) == [[[3, 3]]]


def test_cohorts_persons_and_validity(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(
        "x,y,z,a,b,c,who,group,ok\n"
        + "0,0,0,1,0,0,bo,new,Valid\n0,0,0,1,0,0,ann,,VALID\n0,0,0,1,0,0,,new,valid\n0,0,0,1,0,0,bo,new,lost\n"
    )
    builder = RaysBuilder()
    columns = ColumnMap.parse("origin=x,y,z direction=a,b,c person=who cohort=group")
    add_tables([path], TableOptions(columns=columns), builder, ["ok"])
    rays = builder.build()
    assert rays.persons == ("ann", "bo") and list(rays.person) == [1, 0]
    assert rays.cohorts == ("unknown", "new") and list(rays.cohort) == [1, 0]
    assert {d["reason"]: d["rows"] for d in rays.metadata["dropped"]} == {
        "ok is not valid (option valid)": [[5, 5]],
        "person is missing": [[4, 4]],
    }
    again = tmp_path / "rays.npz"
    rays.save(again)
    back = type(rays).load(again)
    assert back.cohorts == rays.cohorts and np.array_equal(back.cohort, rays.cohort) and back.metadata == rays.metadata
    assert list(back.select([1]).cohort) == [0]


@pytest.mark.parametrize(
    "columns, options, message",
    [
        ("direction=a,b,c", {"person_from": "shoe"}, '"column" or "filename"'),
        ("ypr=a,b,c", {"forward": "ahead"}, 'forward is "ahead"'),
        ("direction=a,b,c", {"units": "inch"}, 'unit "inch"'),
        ("ypr=a,b,c", {"forward": "z"}, "both z"),
        ("azel=a,b", {"forward": "z"}, "both z"),
    ],
)
def test_refusals(tmp_path, columns, options, message):
    path = write(tmp_path / "t.csv", "x,y,z,a,b,c", [(0, 0, 0, 1, 0, 0)])
    with pytest.raises(NergError, match=message):
        read_table(path, f"origin=x,y,z {columns}", **options)
    with pytest.raises(NergError, match="needs a column map"):
        read("table", path)


def test_parquet_and_csv_are_equal(tmp_path, heads):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed (pip install pyarrow)")
    import pyarrow.parquet as pq

    origin, turn = heads
    names = list("xyzabcd")
    values = np.hstack([origin, turn.as_quat()])
    path = write(tmp_path / "t.csv", ",".join(names), values)
    people = [f"p{i % 3}" for i in range(19)] + [None]
    pq.write_table(pa.table({**dict(zip(names, values.T)), "who": people}), tmp_path / "t.parquet")
    mapping = "origin=x,y,z xyzw=a,b,c,d"
    one, two = read_table(path, mapping), read_table(tmp_path / "t.parquet", mapping + " person=who")
    assert np.array_equal(one.direction[:19], two.direction) and two.persons == ("p0", "p1", "p2")
    assert two.metadata["dropped"] == [
        {"reason": "person is missing", "file": "t.parquet", "count": 1, "rows": [[20, 20]]}
    ]


# Expected: 30 degrees to the right of forward and 20 up, in the frame of rays (z up, x right, y forward).
AZIMUTH, ELEVATION = 30.0, 20.0
MEANT = np.array([0.46984631, 0.81379768, 0.34202014])  # cos 20 sin 30, cos 20 cos 30, sin 20


@pytest.mark.parametrize(
    "frame, azel, yawpitch",
    [
        # Unity: yaw right, pitch down. OpenXR: yaw left, pitch up. ROS with forward y here: yaw left, pitch up.
        ({"up": "y", "handedness": "left"}, "az,el", "az,-el"),
        ({"up": "y"}, "az,el", "-az,el"),
        ({"up": "z", "forward": "y"}, "az,el", "-az,el"),
    ],
)
@pytest.mark.parametrize("radians", [False, True])
def test_angles_are_directions(tmp_path, frame, azel, yawpitch, radians):
    unit = np.pi / 180 if radians else 1.0
    path = tmp_path / "a.csv"
    path.write_text(f"x,y,z,az,el\n0,0,0,{AZIMUTH * unit},{ELEVATION * unit}\n0,0,0,{AZIMUTH * unit},\n")
    for columns in (f"azel={azel}", f"yawpitch={yawpitch}"):
        rays = read("table", path, columns=ColumnMap.parse(f"origin=x,y,z {columns}"), radians=radians, **frame)
        assert np.allclose(rays.direction, [MEANT]) and rays.metadata["degrees"] is not radians


def test_angles_with_a_pose_are_in_the_head_frame(tmp_path):
    """The head looks to the right (x); the gaze is 30 degrees further to the right, and 20 up."""
    head = Rotation.from_euler("Y", 90, degrees=True).as_quat()  # of Unity: to the right
    path = tmp_path / "a.csv"
    path.write_text("x,y,z,qx,qy,qz,qw,az [deg],el [deg]\n" + ",".join(map(str, [1, 2, 3, *head, 30, 20])) + "\n")
    columns = ColumnMap.parse('origin=x,y,z xyzw=qx,qy,qz,qw "azel=az [deg],el [deg]"')
    rays = read("table", path, columns=columns, up="y", handedness="left")
    assert np.allclose(rays.direction, [[MEANT[1], -MEANT[0], MEANT[2]]]) and np.allclose(rays.origin, [[1, 3, 2]])


@pytest.mark.parametrize("kind", ["vector", "quaternion"])
def test_heads_and_eyes_with_gaze_in_the_world(tmp_path, heads, kind):
    """A direction together with ``head`` is not changed: the head is only used for the checks."""
    origin, turn = heads
    gaze, aside = np.tile([0.0, 3, 4], (20, 1)), turn.apply([3.1, 0, 0])
    head = turn.apply([0, 0, 1]) if kind == "vector" else turn.as_quat()
    names = [f"h{i}" for i in range(head.shape[1])]
    path = write(
        tmp_path / "a.csv",
        "x,y,z,a,b,c,l,m,n,o,p,q," + ",".join(names),
        np.hstack([origin, gaze, origin - aside, origin + aside, head]),
    )
    columns = f"origin=x,y,z direction=a,b,c eyes=l,m,n,o,p,q head={','.join(names)}"
    rays = read_table(path, columns, up="y", handedness="left", units="cm")
    assert np.allclose(rays.direction, [0, 0.8, 0.6]) and np.allclose(rays.head, turn.apply([0, 0, 1])[:, [0, 2, 1]])
    assert rays.metadata["eye_distance"] == {"a": 0.062}


MATRIX = "matrix=" + ",".join("abcdefghijkl")


def test_mirrored_matrices_are_dropped(tmp_path, heads):
    origin, turn = heads
    m = np.concatenate([turn.as_matrix(), origin[:, :, None]], axis=2)
    m[4, :, 2] *= -1
    rays = read_table(write(tmp_path / "m.csv", ",".join("abcdefghijkl"), m.reshape(20, 12)), MATRIX)
    mirrored = "the head's matrix is mirrored (its determinant is negative)"
    assert len(rays) == 19 and dropped(rays) == {mirrored: [[6, 6]]}


FULL_MATRIX = ",".join(f"m{k}" for k in range(16))


def write_matrices(path, heads):
    origin, turn = heads
    m = np.tile(np.eye(4), (20, 1, 1))
    m[:, :3, :3], m[:, :3, 3] = turn.as_matrix(), origin + 1
    return m, lambda m: write(path, FULL_MATRIX, m.reshape(-1, 16))


def test_matrices_with_another_last_row_are_refused(tmp_path, heads):
    m, save = write_matrices(tmp_path / "m.csv", heads)
    with pytest.raises(NergError, match=r"m\.csv.*line 2: it is transposed"):
        read_table(save(np.swapaxes(m, 1, 2)), f"matrix={FULL_MATRIX}")
    m[5, 3] = 0.3, 0.2, 0.1, 0.7
    with pytest.raises(NergError, match=r"m\.csv.*'m0'.*line 7.*0\.3, 0\.2, 0\.1, 0\.7"):
        read_table(save(m), f"matrix={FULL_MATRIX}")
    with pytest.raises(NergError, match="line 7"):
        read_table(save(m), f"matrix={FULL_MATRIX}", skip_bad_lines=True)
    m[5] = 0  # nothing was tracked
    rays = read_table(save(m), f"matrix={FULL_MATRIX}")
    assert len(rays) == 19 and list(dropped(rays).values()) == [[[7, 7]]]


def test_matrices_and_quaternions_that_are_no_rotations_are_dropped_by_name(tmp_path, heads):
    m, save = write_matrices(tmp_path / "m.csv", heads)
    m[3, :3, 1] *= 1.3
    rays = read_table(save(m), f"matrix={FULL_MATRIX}")
    assert [(rows, "not a scaled rotation" in reason) for reason, rows in dropped(rays).items()] == [([[5, 5]], True)]
    q = heads[1].as_quat()
    q[3, 3] += 0.5
    path = write(tmp_path / "q.csv", "x,y,z,a,b,c,d", np.hstack([heads[0] + 1, q]))
    rays = read_table(path, "origin=x,y,z xyzw=a,b,c,d")
    assert [(rows, "quaternion" in reason) for reason, rows in dropped(rays).items()] == [([[5, 5]], True)]


def test_matrices_of_twelve_values_in_another_order(tmp_path, heads):
    m, _ = write_matrices(tmp_path / "m.csv", heads)
    names = ",".join(FULL_MATRIX.split(",")[:12])
    save = lambda m: write(tmp_path / "m.csv", names, m.reshape(-1, 12))
    has_doubt = lambda rays: any("m0, m1" in text for text in rays.metadata.get("complaints", []))
    assert not has_doubt(read_table(save(m[:, :3]), f"matrix={names}"))
    # The position of a transposed matrix is in the row that is missing.
    assert has_doubt(read_table(save(np.swapaxes(m, 1, 2)[:, :3]), f"matrix={names}"))
    for other in (np.swapaxes(m[:, :3], 1, 2), np.hstack([m[:, :3, :3].reshape(-1, 9), m[:, :3, 3]])):
        with pytest.raises(NergError, match="none of 20 rows"):
            read_table(save(other), f"matrix={names}")
    assert not has_doubt(read_table(save(np.tile(np.eye(4)[:3], (20, 1, 1))), f"matrix={names}"))


def test_vectors_in_one_cell(tmp_path, heads):
    origin, turn = heads
    vector = lambda v: '"(' + ", ".join(map(repr, map(float, v))) + ')"'
    rows = [f"{vector(o + 1)},{vector(q)},{k}" for k, (o, q) in enumerate(zip(origin, turn.as_quat()))]
    for name, text in (("quoted", "\n".join(rows)), ("bare", "\n".join(rows).replace('"', ""))):
        path = tmp_path / f"{name}.csv"
        path.write_text("Position,Rotation,t\n" + text)
        rays = read_table(path, "origin=Position xyzw=Rotation t=t")
        np.testing.assert_allclose(rays.origin, origin + 1)
        np.testing.assert_allclose(rays.direction, turn.apply([1, 0, 0]), atol=1e-12)
        assert "unused_columns" not in rays.metadata
        names = "Rotation.w,Rotation.x,Rotation.y,Rotation.z"
        same = read_table(path, f"origin=Position.x,Position.y,Position.z wxyz={names} t=t")
        np.testing.assert_allclose(same.direction, rays.direction)
        with pytest.raises(NergError, match="'Rotation'.*is not 3 numbers"):
            read_table(path, "origin=Position direction=Rotation t=t")
    with pytest.raises(NergError, match="wxyz needs 4 .*c.x"):
        read_table(path, "origin=Position wxyz=Rotation")


def test_fill_values_in_the_heads_frame(tmp_path, heads):
    """Fill values are detected before the rotation of the head."""
    origin, turn = heads
    gaze = np.tile([0.0, 0, 1], (20, 1))
    gaze[3:5], gaze[7] = -1, 0
    path = write(tmp_path / "t.csv", "x,y,z,a,b,c,d,gx,gy,gz", np.hstack([origin + 1, turn.as_quat(), gaze]))
    rays = read_table(path, "origin=x,y,z xyzw=a,b,c,d direction=gx,gy,gz")
    assert dropped(rays) == {"direction is the fill value -1, -1, -1": [[5, 6]], "direction is zero": [[9, 9]]}


@pytest.mark.parametrize(
    "columns, rows, num_valid",
    [
        ("xyzw=a,b,c,d", [(0, 0, 0, 1), (-1, -1, -1, -1), (0, 0, 0, 0), (-9999,) * 4, (0.5, 0.5, 0.5, 0.5)], 2),
        ("ypr=a,b,c", [(0, 0, 0), (-9999,) * 3, (-1, -1, -1), (999, 999, 999), (-32768,) * 3], 2),
        ("azel=a,b", [(0, 0), (-1, -1), (-9999, -9999), (999, 999), (3.402823e38,) * 2], 2),
        ("yawpitch=a,b", [(0, 0), (-9999, -9999), (-999, -999), (99999, 99999), (20, 20)], 2),
        ("direction=a,b,c", [(0, 0, 1), (3.402823e38,) * 3, (-32768,) * 3, (-1, -1, -1), (1, 2, 3)], 2),
    ],
)
def test_fill_values_of_poses_and_angles(tmp_path, columns, rows, num_valid):
    names = "x,y,z," + columns.split("=")[1]
    path = write(tmp_path / "t.csv", names, [(1, 2, 1.6, *row) for row in rows])
    rays = read_table(path, f"origin=x,y,z {columns}")
    assert len(rays) == num_valid and sum(d["count"] for d in rays.metadata["dropped"]) == 3


def test_columns_of_validity_of_a_map(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("x,y,z,a,b,c,isValid\n" + "".join(f"{k},0,1.6,1,0,0,{k % 2}\n" for k in range(10)))
    columns = "origin=x,y,z direction=a,b,c"
    rays = read_table(path, columns, tick=0.1)
    assert len(rays) == 10 and "'isValid' may mark valid rows by their names" in rays.metadata["complaints"][0]
    rays = read_table(path, columns, tick=0.1, valid="isValid=1")
    assert len(rays) == 5 and "complaints" not in rays.metadata and "unused_columns" not in rays.metadata
    with pytest.raises(NergError, match="has no column other"):
        read_table(path, columns, valid="other=1")


@pytest.mark.parametrize("time", ["time [ms]", "stamp_ms", "tNs", "seconds", None])
def test_times_that_the_names_contradict_are_reported(tmp_path, time):
    path, unit = (
        tmp_path / "t.csv",
        {"time [ms]": 1e-3, "stamp_ms": 1e-3, "tNs": 1e-9, "seconds": 1.0, None: None}[time],
    )
    path.write_text(f"x,y,z,a,b,c,{time}\n0,0,0,1,0,0,0\n0,0,0,1,0,0,20\n")
    columns = "origin=x,y,z direction=a,b,c" + (f' "t={time}"' if time else "")
    said = read_table(path, columns).metadata.get("complaints", [])
    assert len(said) == (unit != 1.0) and all("tick" in text for text in said)  # noqa: RUF069 (stored)
    assert "complaints" not in read_table(path, columns, tick=unit or 0.02).metadata


@pytest.mark.parametrize(("suffix", "units"), [(" [mm]", "mm"), ("_cm", "cm"), ("(m)", "m"), ("", "m")])
def test_lengths_that_the_names_contradict_are_reported(tmp_path, suffix, units):
    path = tmp_path / "t.csv"
    path.write_text(",".join([*(f"p{a}{suffix}" for a in "xyz"), "a,b,c,t\n0,0,0,1,0,0,0\n"]))
    columns = " ".join([f'"origin={",".join(f"p{a}{suffix}" for a in "xyz")}"', "direction=a,b,c t=t"])
    said = read_table(path, columns).metadata.get("complaints", [])
    assert len(said) == (units != "m") and all(f'units="{units}"' in text for text in said)
    assert "complaints" not in read_table(path, columns, units=units).metadata


@pytest.mark.parametrize("role", ["ypr=a,b,c", "azel=a,b", "yawpitch=a,b"])
def test_radians_that_are_read_as_degrees_are_reported(tmp_path, role):
    def said(scale, **options):
        rows = "".join(f"0,0,1.6,{scale * k / 24},{-scale * k / 48},0,{k}\n" for k in range(24))
        (tmp_path / "t.csv").write_text("x,y,z,a,b,c,t\n" + rows)
        return read_table(tmp_path / "t.csv", f"origin=x,y,z {role} t=t", **options).metadata.get("complaints", [])

    assert ["radians" in text for text in said(1.5)] == [True]
    assert not said(1.5, radians=True) and not said(85.0) and not said(0.0)


@pytest.mark.parametrize("tick", [1.0, 1e-3])
def test_clock_times_need_no_tick(tmp_path, tick):
    (tmp_path / "t.csv").write_text("x,y,z,a,b,c,t\n0,0,0,1,0,0,12:00:00.5\n0,0,0,1,0,0,12:00:01\n")
    assert np.allclose(
        read_table(tmp_path / "t.csv", "origin=x,y,z direction=a,b,c t=t", tick=tick).t, [43200.5, 43201]
    )


@pytest.mark.parametrize(
    "columns, tracking",
    [
        ("origin=x,y,z direction=a,b,c", "eye"),
        ("origin=x,y,z xyzw=q,r,s,t", "head"),
        ("origin=x,y,z xyzw=q,r,s,t direction=a,b,c", "eye"),
        ("origin=x,y,z direction=HeadForward.x,HeadForward.y,HeadForward.z", "head"),
        ("origin=x,y,z direction=hmd_dir_x,hmd_dir_y,hmd_dir_z", "head"),
        ("origin=x,y,z direction=head_gaze_x,head_gaze_y,head_gaze_z", "eye"),
        ("origin=x,y,z direction=camera_x,camera_y,camera_z head=a,b,c", "eye"),
        ("origin=x,y,z azel=a,b", "eye"),
    ],
)
def test_maps_tell_heads_from_eyes(columns, tracking):
    assert find_tracking(ColumnMap.parse(columns)) == tracking


def test_what_was_tracked_can_be_stated(tmp_path):
    (tmp_path / "a.csv").write_text("t,x,y,z,a,b,c\n0,1,2,3,1,0,0\n")
    columns = "origin=x,y,z direction=a,b,c t=t"
    assert read_table(tmp_path / "a.csv", columns, tracking="head").tracking == "head"
    with pytest.raises(NergError, match="tracking must be eye or head"):
        TableOptions(tracking="ear")
