"""Rays of arrays and data frames, and back."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays


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
        ({"times": 0.0}, "times"),
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
    assert rays.filter(persons=["Ada"], start=1.0).participants == ("Ada",)


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
    rays = Rays.from_dataframe(table, {**columns, "confidence": "c"})
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
