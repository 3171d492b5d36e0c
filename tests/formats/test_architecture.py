"""Sizes that checkpoints claim: in bounds, or said in a sentence that names the file."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import limits_of
from nerg_mi.formats.fields import FINEST, OCCUPANCY_CELLS, building, check_occupancy, check_sizes, number

GRID = {"levels": 2, "features": 2, "log2_rows": 8, "base": 4, "finest": 16, "dimensions": 3}


def test_sizes_in_bounds_pass_as_they_are():
    about = {"grid": GRID, "width": 4096, "density_hidden": 1, "geometry": 15, "other": "kept"}
    assert check_sizes(about) is about
    assert check_sizes({"grid": {"kind": "hashgrid", **GRID}})


def test_each_kind_of_gaze_field_has_its_own_bounds():
    """The word "geometry" of a log density is no size."""
    product, log = {"geometry": "surface"}, {"kind": "log_density", "geometry": "surface", "layers": 2}
    assert check_sizes(log, most=limits_of(log)) is log
    for about, name in ((product, "geometry"), ({**log, "layers": 65}, "layers"), ({**log, "prior": 0}, "prior")):
        with pytest.raises(ValueError, match=f'"{name}" of its architecture must be a whole number'):
            check_sizes(about, most=limits_of(about))
    assert not limits_of({"kind": "wavelet"}) and not limits_of({"kind": ["product"]}) and not limits_of("product")


@pytest.mark.parametrize(
    "about, words",
    [
        ([1], '"architecture"'),
        ({"width": 0}, '"width".*1.*4096.*0'),
        ({"width": True}, "not True"),
        ({"width": 2.0}, "not 2.0"),
        ({"width": 10**99}, r"\.\.\."),
        ({"grid": {**GRID, "levels": 65}}, '"levels".*1.*64'),
        ({"grid": {**GRID, "finest": FINEST + 1}}, '"finest"'),
        ({"grid": {**GRID, "finest": float("nan")}}, "must be a finite number"),
        ({"grid": "fine"}, '"grid"'),
        ({"grid": {**GRID, "kind": "octree"}}, "'octree'"),
    ],
)
def test_sizes_out_of_bounds_are_named(about, words):
    with pytest.raises(ValueError, match=words):
        check_sizes(about)


def test_numbers_are_finite_and_no_booleans():
    assert number({"a": 2}, "a", "thing") == 2
    for wrong in ({"a": True}, {"a": "2"}, {"a": float("inf")}, {"a": None}, [2]):
        with pytest.raises(ValueError, match='"a"'):
            number(wrong, "a", "thing")


def test_occupancy_has_a_largest_size():
    about = {"resolution": 400, "threshold": 0.5}
    assert check_occupancy(about) is about
    check_occupancy({**about, "resolution": 128, "bound": 16.0})
    for wrong in ({"resolution": 407}, {"resolution": 2.0}, {"resolution": 128, "bound": 2.0**40}):
        with pytest.raises(ValueError, match=f"{OCCUPANCY_CELLS:,} cells at most"):
            check_occupancy({**about, **wrong})


@pytest.mark.parametrize("error", [KeyError("box"), ValueError("x"), TypeError("x"), OverflowError("x")])
def test_what_building_raises_names_the_file(error):
    with pytest.raises(NergError, match='the checkpoint "a.safetensors" (lacks .box.|holds no usable field: x)') as e:
        with building("a.safetensors"):
            raise error
    assert e.value.__cause__ is error


def test_finished_sentences_and_faults_of_the_program_pass():
    own = NergError("as it is")
    with pytest.raises(NergError) as e, building("a"):
        raise own
    assert e.value is own
    with pytest.raises(ZeroDivisionError), building("a"):
        _ = 1 / 0
