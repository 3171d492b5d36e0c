"""PNG files are whole or absent; Mitsuba's own writer ends well on a full disk."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from nerg_mi.files.images import write_png


def picture(rgb):
    return rgb.Bitmap(np.random.default_rng(1).integers(0, 256, (40, 50, 3)).astype(np.uint8))


def test_a_file_is_what_mitsuba_writes(tmp_path, rgb):
    picture(rgb).write(str(tmp_path / "theirs.png"))
    write_png(tmp_path / "new" / "ours.png", picture(rgb))
    assert (tmp_path / "new" / "ours.png").read_bytes() == (tmp_path / "theirs.png").read_bytes()


_LIMITED = """
import resource, sys
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from nerg_mi.files.images import write_png
from tests.files.test_png import picture
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
write_png(sys.argv[1], picture(mi))
"""


def test_a_picture_that_does_not_fit_leaves_the_old_one(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    env = {**os.environ, "PYTHONPATH": os.getcwd()}
    done = subprocess.run([sys.executable, "-c", _LIMITED, str(path)], capture_output=True, text=True, env=env)
    assert done.returncode == 1 and "largest size" in done.stderr
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.png"]


def test_text_by_another_library(tmp_path, rgb):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    text = {"Comment": '{"a": "b"}', "Title": "Läden", "Author": "Łukasz 店"}
    write_png(tmp_path / "a.png", picture(rgb), text)
    with image.open(tmp_path / "a.png") as found:
        found.load()
        # Mitsuba adds its version.
        assert {k: v for k, v in found.text.items() if k != "generated_by"} == text
        np.testing.assert_array_equal(np.asarray(found), np.array(picture(rgb)))
