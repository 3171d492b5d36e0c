"""Numbers, times and names of arrays and columns of several libraries."""

from __future__ import annotations

import datetime
import decimal

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.values import find_names, to_name, to_names, to_numbers, to_seconds, unify_names

pandas, polars, pyarrow = (pytest.importorskip(name) for name in ("pandas", "polars", "pyarrow"))

NAIVE = [datetime.datetime(2026, 1, 1, 12), datetime.datetime(2026, 1, 1, 12, 0, 0, 500000)]
ZONED = [t.replace(tzinfo=datetime.timezone(datetime.timedelta(hours=2))) for t in NAIVE]
NOON = 1767268800.0
HALF = datetime.timedelta(seconds=0.5)
LENGTH = np.timedelta64(500, "ms")
COMPOSED, DECOMPOSED = "J\u00f6rg", "Jo\u0308rg"

DATES = {
    "ns": np.array(NAIVE, "datetime64[ns]"),
    "us": np.array(NAIVE, "datetime64[us]"),
    "ms": np.array(NAIVE, "datetime64[ms]"),
    "pandas": pandas.Series(NAIVE),
    "pandas index": pandas.DatetimeIndex(NAIVE),
    "polars": polars.Series(NAIVE),
    "arrow": pyarrow.array(NAIVE),
    "objects": NAIVE,
    "timestamps": [pandas.Timestamp(t) for t in NAIVE],
}
ZONED_DATES = {
    "pandas": pandas.Series(ZONED),
    "pandas index": pandas.DatetimeIndex(ZONED),
    "pandas arrow": pandas.Series(ZONED).astype(pandas.ArrowDtype(pyarrow.timestamp("us", "UTC"))),
    "polars": polars.Series(ZONED),
    "arrow": pyarrow.chunked_array([ZONED]),
    "objects": ZONED,
}


@pytest.mark.parametrize("times", DATES.values(), ids=DATES)
def test_dates_are_seconds_since_1970(times):
    np.testing.assert_allclose(to_seconds(times, "times"), [NOON, NOON + 0.5], rtol=0, atol=1e-6)


@pytest.mark.parametrize("times", ZONED_DATES.values(), ids=ZONED_DATES)
def test_dates_with_a_zone_are_converted_to_utc(times):
    np.testing.assert_allclose(to_seconds(times, "times"), [NOON - 7200, NOON - 7199.5], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "times",
    [
        np.array([0, 500], "timedelta64[ms]"),
        np.array([0, 20], "timedelta64[25ms]"),
        pandas.Series([0 * HALF, HALF]),
        polars.Series([0 * HALF, HALF]),
        pyarrow.array([0 * HALF, HALF]),
        [0 * HALF, HALF],
        pandas.Series([0, 0.5], dtype="Float64"),
        [decimal.Decimal(0), decimal.Decimal("0.5")],
    ],
)
def test_durations_and_numbers_are_seconds(times):
    np.testing.assert_allclose(to_seconds(times, "times"), [0, 0.5])


@pytest.mark.parametrize(
    "times",
    [
        np.array(["1970-01-02", "NaT"], "datetime64[D]"),
        [datetime.date(1970, 1, 2), None],
        pandas.Series([pandas.Timestamp("1970-01-02", tz="UTC"), pandas.NaT]),
        polars.Series([datetime.date(1970, 1, 2), None]),
        pyarrow.array([86400, None]),
        pandas.Series([86400, None], dtype="Int64"),
        np.array([86400, pandas.NA], object),
        np.ma.masked_array([86400, 7], [False, True]),
        np.ma.masked_array(np.array(["1970-01-02", "1970-01-03"], "datetime64[s]"), [False, True]),
    ],
)
def test_missing_times_are_nan(times):
    np.testing.assert_allclose(to_seconds(times, "times"), [86400, np.nan])


def test_dates_outside_of_the_range_of_nanoseconds():
    assert to_seconds(np.array(["3000-01-01"], "datetime64[D]"), "times")[0] == pytest.approx(32503680000)


@pytest.mark.parametrize(
    "times, kind",
    [
        (["2026-01-01", "2026-01-02"], "text"),
        (pandas.Series(["1", "2"]), "text"),
        ([True, False], "truth values"),
        ([True, 1.5], ""),
        (np.array([True, 1.5], object), "bool"),
        ([1j, 2], "complex"),
        ([NAIVE[0], 1.0], "mix"),
        ([NAIVE[0], ZONED[0]], "mix"),
        ([datetime.time(1), datetime.time(2)], "time"),
        (np.array([1, 2], "timedelta64[M]"), "durations"),
        (np.array([1, 2], "timedelta64"), "durations"),
        (np.zeros(2, [("a", float)]), "records"),
        ([[1, 2], [3]], "equal rows"),
    ],
)
def test_other_times_are_refused_by_name(times, kind):
    if not kind:  # NumPy converts before anybody can look
        assert to_seconds(times, "times").tolist() == [1.0, 1.5]
        return
    with pytest.raises(NergError, match=f"times .*{kind}"):
        to_seconds(times, "times")


@pytest.mark.parametrize(
    "values", [*(v for k, v in DATES.items()), [HALF], ["1.5"], [1j], [True], [b"1"], [object()], [LENGTH]]
)
def test_numbers_are_no_dates_text_or_flags(values):
    for array in (values, np.array([*values, None], object)):
        with pytest.raises(NergError, match="origins must contain numbers"):
            to_numbers(array, "origins")


def test_flags_are_numbers_where_they_are_allowed():
    np.testing.assert_allclose(to_numbers([True, False], "confidence", flags=True), [1, 0])
    np.testing.assert_allclose(
        to_numbers(pandas.Series([True, None], dtype="boolean"), "confidence", flags=True), [1, np.nan]
    )


@pytest.mark.parametrize("name", ["Ann\u200b", "\ufeff Ann", "Ann\u2060\n", "\u00a0Ann "])
def test_spaces_of_any_kind_around_names_do_not_count(name):
    assert to_name(name) == "Ann" and to_names(["Ann", name], "participants").tolist() == ["Ann", "Ann"]
    assert to_name("A\u200bnn") == "A\u200bnn"


def test_tensors_with_derivatives_are_numbers():
    torch = pytest.importorskip("torch")
    tensor = torch.tensor([[1.0, 2.0]], requires_grad=True)
    for values in (tensor, tensor.bfloat16()):
        np.testing.assert_allclose(to_numbers(values, "origins"), [[1, 2]])


def test_iterators_are_read_once():
    assert to_numbers((x for x in (1, 2)), "origins").tolist() == [1, 2]
    assert to_seconds({"a": 1.5}.values(), "times").tolist() == [1.5]
    assert to_names(iter(["a", "b"]), "participants").tolist() == ["a", "b"]


def test_one_number_has_no_rows():
    assert to_numbers(3.0, "origins").shape == to_seconds(np.float32(3), "times").shape == ()


def test_numbers_keep_their_shape_and_type():
    array = np.arange(6.0).reshape(2, 3)
    assert to_numbers(array, "x") is array
    assert to_numbers(array.tolist(), "x", np.float32).dtype == np.float32
    assert to_numbers(np.array([[1, None]], object), "x").shape == (1, 2)
    assert np.isposinf(to_numbers([10**400], "x")).all()


@pytest.mark.parametrize(
    "values",
    [
        [1.0, np.nan, 3.0],
        pandas.Series([1, None, 3], dtype="Int64"),
        pandas.Series([1, None, 3]).astype("category"),
        np.array([1, pandas.NA, 3.0], object),
        np.array(["1.0", "", " 3 "]),
        pandas.Series(["1", pandas.NA, "3"], dtype="string"),
        polars.Series([1, None, 3]),
        polars.Series(["1", None, "3"]).cast(polars.Categorical),
        pyarrow.array([1, None, 3]),
        pyarrow.chunked_array([pyarrow.array(["1", None, "3"]).dictionary_encode()]),
        np.ma.masked_array([1, 2, 3], [False, True, False]),
        [decimal.Decimal("1.0"), None, decimal.Decimal(3)],
        [b"1", None, b"3"],
    ],
)
def test_ids_with_a_gap_are_whole_numbers(values):
    assert to_names(values, "participants").tolist() == ["1", "", "3"]


LARGE = 2**53


@pytest.mark.parametrize(
    "values",
    [
        pandas.array([LARGE + 1, None, LARGE], dtype="Int64"),
        pandas.Series([LARGE + 1, None, LARGE], dtype="int64[pyarrow]"),
        polars.Series([LARGE + 1, None, LARGE]),
        pyarrow.array([LARGE + 1, None, LARGE]),
        pyarrow.chunked_array([[LARGE + 1, None], [LARGE]]),
        [LARGE + 1, np.nan, LARGE],
    ],
)
def test_large_ids_with_a_gap_are_not_rounded(values):
    assert to_names(values, "participants").tolist() == [str(LARGE + 1), "", str(LARGE)]


@pytest.mark.parametrize("values", [[float(LARGE)], np.array([1.0, 2.0**24], np.float32), [None, -1e17]])
def test_ids_that_were_rounded_are_refused(values):
    with pytest.raises(NergError, match="participants .*rounded"):
        to_names(values, "participants")


@pytest.mark.parametrize("value", [None, 1.0, 7, {"a"}, "a"])
def test_one_id_has_no_rows(value):
    assert to_names(value, "participants").shape == ()


def test_ids_that_are_no_whole_numbers_are_kept():
    assert [to_name(v) for v in (1.5, "1.50", "01.0", "v1.0", "1.", 2**60)] == [
        "1.5",
        "1.50",
        "01.0",
        "v1.0",
        "1.",
        str(2**60),
    ]


def test_names_are_composed():
    assert to_names([COMPOSED, DECOMPOSED], "participants").tolist() == [COMPOSED, COMPOSED]
    names, index = unify_names(["Ada", DECOMPOSED, COMPOSED])
    assert names == ("Ada", COMPOSED) and index is not None and index.tolist() == [0, 1, 1]
    assert unify_names(["Ada", "Bob"]) == (("Ada", "Bob"), None)
    names, index = unify_names([1, "1", b"1", 1.0])
    assert names == ("1",) and index is not None and index.tolist() == [0] * 4


def test_choices_are_compared_in_the_compatible_form():
    assert find_names([DECOMPOSED, 1, "\u00b5"], ["1.0", "\u03bc", COMPOSED], "person") == [2, 0, 1]
    with pytest.raises(NergError, match="no cohort is called 'new'; there are old"):
        find_names(["new"], ["old"], "cohort")
    assert find_names(["ada"], ["Ada", "ada"], "person") == [1]
