"""The measurement of visibility: exclusions, and that it distinguishes a good field from a wrong one."""

import numpy as np
from nerg_mi.scenes.store import SCENE_FILE

from benchmarks.store_visibility import PAIRS, measure, near_edges


def test01_pixels_near_discontinuities_are_excluded():
    depth = np.full((9, 12), 2.0)
    depth[:, 6:] = 3.0
    near = near_edges(depth, np.ones((9, 12), bool), margin=2)
    assert np.array_equal(np.flatnonzero(near[0]), [4, 5, 6, 7]) and np.all(near == near[0])
    visible = np.ones((9, 12), bool)
    visible[4, 4] = False
    assert near_edges(np.full((9, 12), 2.0), visible, margin=1).sum() == 5
    # A slope of 2 % per pixel is not an edge
    assert not near_edges(2.0 * 1.02 ** np.arange(12.0)[None].repeat(9, 0), np.ones((9, 12), bool), 2).any()


def test02_blocks_occlude_like_the_furniture(standins):
    row = measure(SCENE_FILE, "aisle 3, from the south", "median", "depth", standins, 48, 2)
    # Blocks of 13 cm instead of shelves with boards and gaps
    assert row["agree"] > 0.85 and row["median cm"] < 15 and row["no surface"] < 0.05
    assert np.isclose(row["agree"] + row["wrongly seen"] + row["wrongly hidden"], 1)


def test03_displaced_field_disagrees(standins, monkeypatch):
    camera, target, eye = PAIRS["aisle 3, from the south"]
    right = measure(SCENE_FILE, "aisle 3, from the south", "median", "depth", standins, 48, 2)
    # The field is evaluated for another eye than the twin
    monkeypatch.setitem(PAIRS, "moved", (camera, target, eye))
    from nerg_mi.scenes.store import twin

    visible = twin.is_visible
    monkeypatch.setattr(twin, "is_visible", lambda e, *a, **k: visible(np.asarray(e) + (1.7, 0, 0), *a, **k))
    wrong = measure(SCENE_FILE, "moved", "median", "depth", standins, 48, 2)
    assert wrong["agree"] < right["agree"] - 0.1
