"""Rays of arrays and data frames, and back."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.dataframes import make_dataframe
from nerg_mi.tracking.filters import split_by_person
from nerg_mi.tracking.quality import check_rays
from nerg_mi.tracking.rays import Rays, write_rays_file
from nerg_mi.tracking.selection import filter_rays


def arrays(n=50):
    rng = np.random.default_rng(1)
    origins, directions = rng.uniform(-1, 2, (n, 3)), rng.normal(size=(n, 3))
    return origins, directions, np.arange(n) / 10, np.array(["Ada", "Bob"])[np.arange(n) % 2]


def make_rays(**more):
    origins, directions, times, names = arrays()
    return Rays.from_arrays(origins, directions, times=times, participants=names, **more)


def test_values_are_those_of_the_arrays():
    origins, directions, times, names = arrays()
    rays = make_rays(hits=origins + directions, cohorts=np.where(names == "Ada", "new", "old"), heads=2 * directions)
    assert np.array_equal(rays.origin, origins) and np.array_equal(rays.t, times)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(rays.direction, unit, atol=1e-12)
    np.testing.assert_allclose(rays.head, unit, atol=1e-6)
    assert rays.hit is not None and np.array_equal(rays.hit, origins + directions)
    assert [rays.persons[k] for k in rays.person] == names.tolist() and (rays.confidence == 1).all()
    assert rays.cohorts == ("new", "old") and rays.cohort is not None and np.array_equal(rays.cohort, rays.person)


def test_frames_are_converted():
    unity = Rays.from_arrays([[1, 2, 3]], [[0, 0, 1]], times=[0], up="y", handedness="left", units="cm")
    np.testing.assert_allclose(unity.origin, [[0.01, 0.03, 0.02]])
    np.testing.assert_allclose(unity.direction, [[0, 1, 0]], atol=1e-15)
    with pytest.raises(NergError, match='"w up'):
        Rays.from_arrays([[1, 2, 3]], [[0, 0, 1]], times=[0], up="w")


def test_invalid_rows_are_dropped_and_counted():
    origins, directions, times, names = arrays(6)
    origins[0, 1], directions[1], times[2] = np.nan, 0, np.inf
    people = np.array([*names[:3], None, *names[4:]], object)
    rays = Rays.from_arrays(origins, directions, times=times, participants=people)
    assert len(rays) == 2 and rays.metadata["rows_read"] == 6
    assert {d["reason"]: d["count"] for d in rays.metadata["dropped"]} == {
        "origin is missing": 1,
        "direction is zero": 1,
        "time is missing": 1,
        "person is missing": 1,
    }


@pytest.mark.parametrize(
    "changes, name",
    [
        ({"origins": np.zeros((3, 2))}, "origins"),
        ({"directions": np.zeros((2, 3))}, "directions"),
        ({"times": [0.0]}, "origins"),
        ({"times": 0.0}, r"^times must have the shape \(N,\)"),
        ({"participants": ["a"]}, "participants"),
        ({"hits": np.zeros(3)}, "hits"),
        ({"origins": "here"}, "origins"),
    ],
)
def test_wrong_shapes_name_the_argument(changes, name):
    values = {"origins": np.zeros((3, 3)), "directions": np.ones((3, 3)), "times": [0.0, 1.0, 2.0], **changes}
    with pytest.raises(NergError, match=name):
        Rays.from_arrays(**values)


def test_selections():
    rays = make_rays()
    assert rays.participants == ("Ada", "Bob") and rays[rays.person == 1].participants == ("Bob",)
    for selection, times in ((slice(2, 4), [0.2, 0.3]), ([3, 1], [0.3, 0.1]), (5, [0.5]), (rays.t > 4.7, [4.8, 4.9])):
        np.testing.assert_allclose(rays[selection].t, times)
    assert len(rays[[]]) == 0 and len(rays[np.zeros(50, bool)]) == 0
    with pytest.raises(NergError, match="mask"):
        rays[np.ones(3, bool)]
    with pytest.raises(NergError, match="str"):
        rays["Ada"]
    assert filter_rays(rays, persons=["Ada"], start=1.0).participants == ("Ada",)


def test_reprs_tell_what_there_is():
    rays = make_rays(hits=np.ones((50, 3)))
    assert "50 of 2 participants" in repr(rays) and "hits" in repr(rays) and "\n" not in repr(rays)
    html = Rays.from_arrays(*arrays()[:2], times=arrays()[2], participants="<b>")._repr_html_()
    assert html is not None and "&lt;b&gt;" in html and "<b>" not in html and "eye height" in html
    assert rays[[]]._repr_html_() is None and "0 of 0" in repr(rays[[]])


# ---- Data frames ----


def make_table(library, rays):
    pytest.importorskip(library, reason=f"{library} is not installed")
    return rays.to_dataframe(library)


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_data_frames_round_trip(library):
    rays = make_rays(hits=np.ones((50, 3)), cohorts="all")
    again = Rays.from_dataframe(make_table(library, rays))
    assert again.persons == rays.persons and again.cohorts == ("all",)
    for name, column in rays.columns().items():
        np.testing.assert_allclose(again.columns()[name], column, atol=1e-15, err_msg=name)


def test_columns_have_roles_and_others_are_reported():
    pandas = pytest.importorskip("pandas")
    origins, directions, times, names = arrays(4)
    table = pandas.DataFrame(origins, columns=["x", "y", "z"])
    table[["u", "v", "w"]] = directions
    table["who"], table["note"], table["c"] = names, "-", 0.5
    table["when"] = pandas.to_datetime("2026-01-01") + pandas.to_timedelta(times, "s")
    table.loc[1, "who"] = None
    columns = {"time": "when", "participant": "who", "origin": ["x", "y", "z"], "direction": ["u", "v", "w"]}
    rays = Rays.from_dataframe(table, {**columns, "confidence": "c", "hit": None})
    assert len(rays) == 3 and rays.metadata["unused_columns"] == ["note"] and (rays.confidence == 0.5).all()  # noqa: RUF069 (stored)
    np.testing.assert_allclose(rays.t - rays.t[0], times[[0, 2, 3]], atol=1e-6)
    for wrong, said in (
        ({**columns, "eye": "x"}, '"eye"'),
        ({"time": "when"}, '"origin"'),
        ({**columns, "time": "moment"}, '"moment"'),
        ({**columns, "hit": ["x", "y", "z"]}, '"x"'),
        ({**columns, "direction": ["u", "v"]}, "three columns"),
        ({**columns, "time": "note"}, '"note"'),
    ):
        with pytest.raises(NergError, match=said):
            Rays.from_dataframe(table, wrong)
    with pytest.raises(NergError, match="from_arrays"):
        Rays.from_dataframe(origins)


def test_unknown_libraries_are_named():
    with pytest.raises(NergError, match='"numpy"'):
        make_rays().to_dataframe("numpy")


# ---- Times, names and columns of several libraries ----

POSES = ([[1.0, 1.0, 1.6]] * 3, [[1.0, 0.0, 0.0]] * 3)


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_times_of_arrays_and_data_frames_are_equal(library):
    pytest.importorskip(library)
    times = np.array(["2026-01-01T00:00:00", "2026-01-01T00:00:00.016", "2026-01-01T00:00:00.033"], "datetime64[ms]")
    expected = [1767225600, 1767225600.016, 1767225600.033]
    table = make_dataframe({"time": times, **vectors()}, library)
    column = table["time"]
    for rays in (
        Rays.from_arrays(*POSES, times=times),
        Rays.from_arrays(*POSES, times=column),
        Rays(times, [0] * 3, ("Ada",), *POSES, [1.0] * 3),
        Rays.from_dataframe(table),
    ):
        np.testing.assert_allclose(rays.t, expected, rtol=0, atol=1e-6)
    durations = times - times[0]
    np.testing.assert_allclose(Rays.from_arrays(*POSES, times=durations).t, [0, 0.016, 0.033], atol=1e-9)


def vectors(n=3):
    columns = {f"origin_{a}": np.ones(n) for a in "xyz"}
    return columns | {f"direction_{a}": np.full(n, float(a == "x")) for a in "xyz"}


def test_values_that_are_no_numbers_name_the_argument():
    for name, value in {"times": ["a", "b", "c"], "confidence": [1j] * 3, "origins": [["1", "2", "3"]] * 3}.items():
        values = {"origins": POSES[0], "directions": POSES[1], "times": [0, 1, 2], name: value}
        with pytest.raises(NergError, match=name):
            Rays.from_arrays(**values)
    with pytest.raises(NergError, match='"origin" of rays'):
        Rays([0], [0], ("Ada",), np.array([["2026-01-01"] * 3], "datetime64[D]"), [[1, 0, 0]], [1])
    with pytest.raises(NergError, match="no index into persons"):
        Rays([0], [0.5], ("Ada", "Bob"), [[0, 0, 0]], [[1, 0, 0]], [1])
    assert Rays.from_arrays(*POSES, times=[0, 1, 2], confidence=[True, False, True]).confidence.tolist() == [1, 0, 1]


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_ids_with_a_gap(library):
    pytest.importorskip(library)
    for ids in ([1, None, 2], [1.0, None, 2.0], ["1", None, "2"]):
        table = make_dataframe({"time": [0.0, 1.0, 2.0], "participant": ids, **vectors()}, library)
        rays = Rays.from_dataframe(table)
        assert rays.persons == ("1", "2") and rays.t.tolist() == [0, 2]
        assert Rays.from_arrays(*POSES, times=[0, 1, 2], participants=table["participant"]).persons == ("1", "2")
        assert len(filter_rays(rays, persons=[1])) == len(filter_rays(rays, persons=["1.0"])) == 1


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_tracking_of_arrays_and_data_frames(library):
    pytest.importorskip(library)
    heads = make_rays(tracking="head")
    assert heads.tracking == "head" and "head" in repr(heads)
    assert make_rays().tracking == "unknown" and make_rays(heads=arrays()[1]).tracking == "eye"
    assert "heads" in dict(check_rays(heads).lines)["tracking"]
    assert Rays.from_dataframe(heads.to_dataframe(library)).tracking == "head"
    assert "tracking" not in make_rays().to_dataframe("pandas")
    table = make_dataframe({"time": [0.0, 1.0, 2.0], "tracking": ["eye", "head", "eye"], **vectors()}, library)
    assert Rays.from_dataframe(table).tracking == "mixed"
    assert Rays.from_dataframe(table, tracking="eye").tracking == "eye"
    kinds = {"time": [0.0] * 3, "tracking": ["eye", "head", "eye"], "participant": list("aba")}
    mixed = make_dataframe({**vectors(), **kinds}, library)
    for rays in (Rays.from_dataframe(mixed), Rays.from_dataframe(Rays.from_dataframe(mixed).to_dataframe(library))):
        assert [rays[rays.person == k].tracking for k in range(2)] == ["eye", "head"]
    with pytest.raises(NergError, match="'gaze'"):
        make_rays(tracking="gaze")
    with pytest.raises(NergError, match="tracking.*'gaze'"):
        Rays.from_dataframe(make_dataframe({"time": [0.0] * 3, "tracking": ["gaze"] * 3, **vectors()}, library))


COMPOSED, DECOMPOSED = "J\u00f6rg", "Jo\u0308rg"


def test_two_forms_of_a_name_are_one_participant(tmp_path):
    rays = Rays.from_arrays(*POSES, times=[0, 1, 2], participants=[COMPOSED, DECOMPOSED, "Ada"])
    assert rays.persons == ("Ada", COMPOSED)
    built = Rays([0, 1, 2], [2, 0, 1], (COMPOSED, "Ada", DECOMPOSED), *POSES, [1] * 3)
    assert built.persons == (COMPOSED, "Ada") and built.person.tolist() == [0, 0, 1]
    assert len(filter_rays(rays, persons=[DECOMPOSED])) == 2
    train, test = split_by_person(rays, test_persons=[DECOMPOSED])
    assert test.tolist() == [True, True, False] and train.sum() == 1
    path = tmp_path / "rays.npz"
    write_rays_file(path, rays.columns(), {**rays.metadata, "persons": ["Ada", DECOMPOSED]})
    assert Rays.load(path).persons == ("Ada", COMPOSED)


def test_the_index_of_a_data_frame_is_no_column():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"time": [0.0, 1.0, 2.0], **vectors()})
    with pytest.raises(NergError, match='no column "time"; its index has this name.*reset_index'):
        Rays.from_dataframe(frame.set_index("time"), {"time": "time", "origin": list(vectors())[:3], "direction": []})


def test_repeated_columns_of_data_frames():
    pandas, pyarrow = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    names = ["time", "note", *vectors(), "note"]
    values = [[0.0, 1.0, 2.0], list("abc"), *vectors().values(), list("abc")]
    frame = pandas.concat([pandas.Series(v) for v in values], axis=1, keys=names)
    for table in (frame, pyarrow.Table.from_arrays([pyarrow.array(v) for v in values], names=names)):
        assert Rays.from_dataframe(table).metadata["unused_columns"] == ["note"]
        with pytest.raises(NergError, match='2 columns called "note"'):
            Rays.from_dataframe(table, {"time": "note", "origin": names[2:5], "direction": names[5:8]})


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
@pytest.mark.parametrize("kind", ["list", "mapping", "capitals", "text"])
def test_vectors_in_one_column(library, kind):
    pytest.importorskip(library)
    origins, directions, times, _ = arrays(5)
    cells = {
        "list": origins.tolist(),
        "mapping": [dict(zip("xyz", v)) for v in origins.tolist()],
        "capitals": [dict(zip("ZXY", (v[2], *v[:2]))) for v in origins.tolist()],
        "text": [f"({', '.join(map(repr, v))})" for v in origins.tolist()],
    }[kind]
    table = make_dataframe({"time": times, "o": [*cells[:4], None], "d": directions.tolist()}, library)
    rays = Rays.from_dataframe(table, {"time": "time", "origin": "o", "direction": ["d"]})
    np.testing.assert_allclose(rays.origin, origins[:4])
    np.testing.assert_allclose(rays.direction, directions[:4] / np.linalg.norm(directions[:4], axis=1, keepdims=True))


def test_cells_that_are_no_vectors_are_named():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({0: [[1, 2, 3], [1, 2]], 1: [[1, 0, 0]] * 2, 2: [0.0, 1.0]})
    with pytest.raises(NergError, match=r'row 1 of the column "0" is .*\[1, 2\]'):
        Rays.from_dataframe(frame, {"time": 2, "origin": 0, "direction": 1})


def test_names_of_columns_with_levels_and_numbers():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"time": [0.0, 1.0, 2.0], **vectors()})
    names = [("clock", "t"), *(("eye", a) for a in "xyz"), *(("gaze", a) for a in "xyz")]
    levels = frame.set_axis(pandas.MultiIndex.from_tuples(names), axis=1)
    by_tuples = {"time": ("clock", "t"), "origin": names[1:4], "direction": names[4:]}
    by_text = {"time": "clock_t", "origin": ["eye_x", "eye_y", "eye_z"], "direction": ["gaze_x", "gaze_y", "gaze_z"]}
    for columns in (by_tuples, by_text):
        assert Rays.from_dataframe(levels, columns).t.tolist() == [0, 1, 2]
    numbers = frame.set_axis(range(7), axis=1)
    assert Rays.from_dataframe(numbers, {"time": 0, "origin": [1, 2, 3], "direction": [4, 5, 6]}).t.tolist() == [
        0,
        1,
        2,
    ]
    greek = frame.rename(columns={"time": "t [\u03bcs]"})
    micro = {"time": "t [\u00b5s]", "origin": list(vectors())[:3], "direction": list(vectors())[3:]}
    assert Rays.from_dataframe(greek, micro).t.tolist() == [0, 1, 2]


def test_lazy_frames_are_collected():
    polars = pytest.importorskip("polars")
    table = polars.DataFrame({"time": [0.0, 1.0, 2.0], **vectors()}).lazy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(Rays.from_dataframe(table)) == 3


@pytest.mark.parametrize("columns", [3, ["time", "origin"], "time"])
def test_columns_are_a_mapping(columns):
    polars = pytest.importorskip("polars")
    with pytest.raises(NergError, match="columns must map roles to names, got .*; pass {"):
        Rays.from_dataframe(polars.DataFrame({"time": [0.0, 1.0, 2.0], **vectors()}), columns)
