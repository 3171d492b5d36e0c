"""Differences of two files."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.style import color_values
from nerg_mi.files.images import write_exr
from nerg_mi.workflows.draw import draw

from .test_files import GAZE, OPACITY, write


def test_the_first_less_the_second(tmp_path):
    other = GAZE[::-1].copy()
    a = write(tmp_path / "a.exr", **{"opacity.Y": OPACITY})
    b = write(tmp_path / "b.exr", **{"opacity.Y": OPACITY, "gaze.Y": other})
    figure = draw("difference", [a, b], top=0.5)
    shown = figure.axes[0].images[0].get_array()
    mask = OPACITY > 0.5
    wanted = color_values("RdBu_r", np.clip(0.5 + (GAZE - other), 0, 1), kind="diverging")
    np.testing.assert_allclose(shown[mask], wanted[mask], atol=1e-6)
    assert np.ptp(shown[~mask], axis=-1).max() < 1e-9 and figure.axes[0].get_title() == "a less b"


def test_what_is_refused(tmp_path):
    a = write(tmp_path / "a.exr")
    write_exr(tmp_path / "b.exr", {"gaze.Y": np.ones((3, 4), np.float32)})
    for files, given, said in (
        ([a], {}, "two pictures, and 1 were given"),
        ([a, tmp_path / "b.exr"], {}, "8 x 6 and 4 x 3 pixels cannot be compared"),
        ([a, a], {"cmap": "viridis"}, "no diverging colour map"),
        ([a, a], {"top": -1.0}, "--top must lie in"),
        ([a, a, a], {}, "1 to 2 files, and 3 were given"),
    ):
        with pytest.raises(NergError, match=said):
            draw("difference", files, **given)
