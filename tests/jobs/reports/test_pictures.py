"""Pictures of a report: one scale, and none where there is nothing to show."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.jobs.reports.pictures import gaze_top, pictures_of_rays, pictures_of_views
from tests.evaluation.gaze.test_evaluation import crowd


def view(gaze, **aovs):
    gaze = np.broadcast_to(np.asarray(gaze, float), (32, 48))
    mask = np.ones((32, 48), bool)
    mask[:4] = False
    return SimpleNamespace(color=np.full((32, 48, 3), 0.3), aovs={"gaze": gaze, **aovs}, mask=mask)


def three(own=0.5):
    return {"camera": view(0.2), "own": view(own), "sphere": view(0.1)}


def test_one_scale_for_all():
    assert gaze_top(three()) == pytest.approx(0.5)
    assert gaze_top({"camera": view(0.0)}) is None
    # Where there is no surface gaze does not count.
    assert gaze_top({"camera": view(np.where(np.arange(32)[:, None] < 4, 9.0, 0.0))}) is None


def test_which_pictures_there_are():
    assert set(pictures_of_views(three(), 0.5, None, True)) == {"color", "gaze", "own", "sphere"}
    assert set(pictures_of_views(three(), 0.5, None, False)) == {"own", "sphere"}
    assert set(pictures_of_views(three(), None, None, True)) == {"color"}
    spread = {**three(), "camera": view(0.2, gaze_std=np.full((32, 48), 0.05))}
    assert "spread" in pictures_of_views(spread, 0.5, (3.0, 4.0), True)


def test_they_are_png_files_with_words_and_the_same_again():
    one, two = (pictures_of_views(three(), 0.5, (3.0, 4.0), True) for _ in range(2))
    for name, picture in one.items():
        assert picture.png.startswith(b"\x89PNG") and picture.png == two[name].png
        assert picture.alt.endswith(".") and picture.caption.endswith(".")


def test_plans():
    found = pictures_of_rays(crowd(300), {"centres": [[-0.5, 0, 1.6]], "radius": 0.5})
    assert set(found) == {"plan", "layout"} and "held out" in found["layout"].caption
    assert "held out" not in pictures_of_rays(crowd(300), None)["layout"].caption
