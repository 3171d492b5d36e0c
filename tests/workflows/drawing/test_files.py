"""Quantities in EXR files."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import find_stored
from nerg_mi.files.images import write_exr
from nerg_mi.workflows.draw_files import read_stored, shared_note

RNG = np.random.default_rng(0)
COLOR, GAZE = RNG.random((6, 8, 3)).astype(np.float32), RNG.random((6, 8)).astype(np.float32)
OPACITY = np.where(np.arange(8) < 3, 0.2, 0.9).astype(np.float32) * np.ones((6, 1), np.float32)


def write(path, text=None, **more):
    write_exr(path, {name: COLOR[..., k] for k, name in enumerate("RGB")} | {"gaze.Y": GAZE} | more, text)
    return path


def test_colour_values_and_mask(tmp_path):
    found = read_stored(write(tmp_path / "a.exr", **{"opacity.Y": OPACITY}), find_stored("gaze"))
    np.testing.assert_array_equal(found.color, COLOR)
    np.testing.assert_array_equal(found.values, GAZE)
    np.testing.assert_array_equal(found.mask, np.tile(np.arange(8) >= 3, (6, 1)))
    assert read_stored(write(tmp_path / "b.exr"), find_stored("gaze.Y")).mask.all()


def test_what_gaze_rests_on(tmp_path):
    text = {"gaze.basis": "made of 5 rays of 2 people", "kde.basis": "made of 3 rays of 1 person"}
    path = write(tmp_path / "a.exr", text, **{"kde.Y": GAZE, "depth.T": GAZE})
    bases = [read_stored(path, find_stored(channel)).basis for channel in ("gaze", "kde.Y", "depth")]
    assert bases == [*text.values(), ""] and read_stored(write(tmp_path / "b.exr"), find_stored("gaze")).basis == ""
    assert shared_note("ab", bases[:1] * 2) == bases[0]
    assert shared_note("ab", ["x", ""]) == "a: x; b: not known"


def test_what_is_refused(tmp_path):
    with pytest.raises(NergError, match='has no "depth"; it has R, G, B, gaze.Y'):
        read_stored(write(tmp_path / "a.exr"), find_stored("depth"))
    with pytest.raises(NergError, match="holds no quantities"):
        read_stored(tmp_path / "a.png", find_stored("gaze"))
