"""The measurement of the inserted display, on a field that stands in for the store's: what it must find there, and that
it can tell a display in the wrong place."""

import numpy as np
import pytest

from benchmarks import store_twin
from nerg_mi.jobs.demo import store_scene
from tests.figures.standins import write_standins


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return write_standins(tmp_path_factory.mktemp("standins"))


def test01_distances_to_boxes():
    o, far = np.array([4.6, 0.0, 0.5]), 10.0
    d = np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1.0], [0, 0.6, 0.8]])
    # The body's front; away from it; past it; over the body into nothing.
    assert np.allclose(store_twin.box_entry(o, d), [4.65, np.inf, np.inf, np.inf])
    assert np.allclose(store_twin.box_entry(o + [0, 0, 0.7], d[:1]), 4.96)
    behind = np.array([[4.6, far, 0.5], [4.6, 4.7, 0.5], [4.6, 4.0, 0.5], [5.5, far, 0.5]])
    assert store_twin.shadowed(o, behind, 0.0, 0.15).tolist() == [True, False, False, False]


def test02_a_display_hides_what_it_must_and_nothing_else(files):
    got = store_twin.measure_display(store_scene().parent, 48, files)
    # The stand-in is marched in steps of 5 cm: tolerances are 10 cm, and more than the margins for the store's are
    # undecided.
    assert got["on"] > 20 and got["display_depth_right"] == 1 and got["display_visibility"] > 0.8
    assert got["off_depth_same"] == 1 and got["free"] > 500 and got["free_same"] > 0.99
    assert got["dark"] > 10 and got["dark_gaze_0"] > 0.9 and got["dark_gaze_before"] > 0
    assert got["bare_is_scene"] < 1e-2


def test03_a_display_elsewhere_is_noticed(files, monkeypatch):
    monkeypatch.setattr(store_twin, "BOXES", store_twin.BOXES + np.array([0.4, 0, 0]))
    got = store_twin.measure_display(store_scene().parent, 48, files)
    assert got["display_depth_right"] < 0.9 and got["dark_gaze_0"] < 0.8 and got["free_same"] < 0.99


def test04_a_display_in_the_store_of_shapes_hides_exactly(files):
    got = store_twin.measure_display(store_scene().parent, 32, files, shapes=True)
    assert got["on"] > 20 and got["display_depth_cm"] < 0.01 and got["display_visibility"] > 0.97
    assert got["dark"] > 20 and got["dark_gaze_0"] == 1 and got["dark_gaze_before"] > 0
    assert got["free"] > 300 and got["free_same"] == 1 and got["undecided"] < 20
