"""Several pictures on one page: each whole, in its place, on one scale."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.figures.overlay import Heat, add_scale
from nerg_mi.figures.sheets import contact_sheet, shrink

RNG = np.random.default_rng(0)


def test_pictures_of_several_sizes():
    pictures = [RNG.random((90, 160, 3)), RNG.random((200, 100, 3)), RNG.random((50, 50, 3))]
    page = contact_sheet(pictures, ["first", "second", "third"])
    assert [a.get_title() for a in page.axes] == ["first", "second", "third"]
    for axes, picture in zip(page.axes, pictures):
        shown = axes.images[0].get_array()
        assert shown.shape == (200, 160, 3)
        h, w = picture.shape[:2]
        np.testing.assert_array_equal(shown[(200 - h) // 2 :][:h, (160 - w) // 2 :][:, :w], picture)
        assert np.count_nonzero(shown.min(axis=-1) < 1) == h * w


def test_one_scale():
    scale = lambda sheet: add_scale(sheet, Heat(2.0), "gaze [1/sr]", [(np.array([3.0]), np.ones(1, bool))])
    page = contact_sheet([RNG.random((90, 160, 3))] * 2, "ab", None, scale)
    assert len(page.axes) == 3 and page.axes[-1].get_ylabel() == "gaze [1/sr]" and len(page.axes[-1].patches) == 1


def test_shrinking_takes_means_of_squares():
    picture = RNG.random((95, 160, 3))
    assert shrink(picture, 160) is not None and np.array_equal(shrink(picture, 160), picture)
    small = shrink(picture, 50)
    assert small.shape == (23, 40, 3)
    np.testing.assert_allclose(small[3, 5], picture[12:16, 20:24].reshape(-1, 3).mean(axis=0))
    assert shrink(np.ones((1, 900, 3)), 100).shape == (1, 100, 3)


def test_none():
    with pytest.raises(ValueError, match="at least one picture"):
        contact_sheet([], [])
