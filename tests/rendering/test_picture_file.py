"""Pictures written in pieces are those written as a whole."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering.files import picture_rows
from tests.pictures import mitsuba_bitmap


@pytest.fixture
def pixels():
    return np.random.default_rng(4).uniform(-0.1, 1.2, (601, 20, 3)).astype(np.float32)


@pytest.mark.parametrize("step", [601, 300, 37])
def test_png_is_rounded_as_mitsuba_rounds_it(rgb, tmp_path, pixels, step):
    rgb.util.write_bitmap(str(tmp_path / "whole.png"), rgb.Bitmap(pixels), write_async=False)
    with picture_rows(tmp_path / "parts.png", 20, 601) as write:
        for top in range(0, 601, step):
            part = np.zeros((step, 20, 3), np.float32)
            rows = min(step, 601 - top)
            part[:rows] = pixels[top : top + rows]
            write(rgb.Bitmap(part), rows)
    assert np.array_equal(*(np.array(mitsuba_bitmap(tmp_path / f"{n}.png")) for n in ("whole", "parts")))


def test_exr_holds_every_row(rgb, tmp_path, pixels):
    with picture_rows(tmp_path / "parts.exr", 20, 601) as write:
        for top in range(0, 601, 100):
            write(rgb.Bitmap(pixels[top : top + 100]), min(100, 601 - top))
    assert np.array_equal(np.array(mitsuba_bitmap(tmp_path / "parts.exr")), pixels)


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_picture_with_rows_missing_is_none(rgb, tmp_path, pixels, name):
    with pytest.raises(ValueError, match="100 of 601|0 of 601"):
        with picture_rows(tmp_path / name, 20, 601) as write:
            write(rgb.Bitmap(pixels[:100]), 100)
    assert not list(tmp_path.iterdir())


def test_the_name_says_the_format(tmp_path):
    with pytest.raises(NergError, match=".exr or .png"):
        with picture_rows(tmp_path / "a.bmp", 2, 2):
            pass


@pytest.mark.parametrize("short_by", [1, 3000])
def test_a_file_that_ends_too_early_is_noticed(tmp_path, short_by):
    # As on a disk that is full; a limit holds for the whole process, hence in a child.
    script = """
import resource, signal, sys
import numpy as np
from nerg_mi.files.images import exr_rows
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
if sys.argv[2] != "0":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
pixels = np.random.default_rng(0).random((90, 40)).astype(np.float32)
with exr_rows(sys.argv[1], 40, 90) as write:
    for top in range(0, 90, 40):
        write({"Y": pixels[top : top + 40]})
"""
    run = [sys.executable, "-c", script, str(tmp_path / "a.exr")]
    subprocess.run([*run, "0"], check=True, timeout=120)
    size = (tmp_path / "a.exr").stat().st_size
    (tmp_path / "a.exr").unlink()
    failed = subprocess.run([*run, str(size - short_by)], capture_output=True, text=True, timeout=120)
    assert "NergError" in failed.stderr and "could not be written" in failed.stderr
    assert not list(tmp_path.iterdir())
