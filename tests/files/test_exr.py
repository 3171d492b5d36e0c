"""EXR files hold the channels that they were given, also where Dr.Jit has one thread."""

from __future__ import annotations

import resource
import subprocess
import sys

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.images import read_exr, threads_for_mitsuba, write_bitmap_exr, write_exr
from tests.pictures import mitsuba_bitmap


def test_channels_come_back_in_another_reader(tmp_path, rgb):
    random = np.random.default_rng(1)
    names = ("R", "G", "B", "depth.T", "position.X", "position.Y", "position.Z", "n.R", "n.G", "n.B", "gaze.Y")
    channels = {name: random.normal(size=(7, 5)).astype(np.float32) for name in names}
    channels["depth.T"][2, 3] = np.inf
    write_exr(tmp_path / "a.exr", channels, {"seed": "3"})
    bitmap = mitsuba_bitmap(tmp_path / "a.exr")
    read = dict(zip([f.name for f in bitmap.struct_()], np.moveaxis(np.array(bitmap), 2, 0)))
    assert read.keys() == channels.keys()
    assert all(np.array_equal(read[name], channels[name]) for name in names)
    assert bitmap.metadata()["seed"] == "3"


def test_a_bitmap_is_written_as_mitsuba_writes_it(tmp_path, rgb):
    pixels = np.random.default_rng(2).random((6, 4, 3)).astype(np.float32)
    with threads_for_mitsuba():
        rgb.Bitmap(pixels).write(str(tmp_path / "theirs.exr"))
    write_bitmap_exr(tmp_path / "ours.exr", rgb.Bitmap(pixels))
    theirs, ours = (mitsuba_bitmap(tmp_path / f"{name}.exr") for name in ("theirs", "ours"))
    assert np.array_equal(np.array(theirs), np.array(ours))
    assert ours.pixel_format() == theirs.pixel_format() == rgb.Bitmap.PixelFormat.RGB


def test_an_attribute_of_the_format_is_refused(tmp_path):
    with pytest.raises(ValueError, match="dataWindow"):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2), np.float32)}, {"dataWindow": "x"})


@pytest.mark.parametrize("shape", [(1, 3), (16, 5), (50, 40)])
def test_a_file_that_is_cut_off_is_not_taken_for_a_picture(tmp_path, shape):
    """OpenEXR says nothing where the end does not fit, which is all of a small picture."""
    random = np.random.default_rng(3)
    channels = {"R": random.random(shape, np.float32), "A": random.random(shape).astype(np.float16)}
    path = tmp_path / "a.exr"
    write_exr(path, channels, {"seed": "3"})
    whole = path.stat().st_size
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    for size in (0, 7, whole // 2, whole - 1, whole):
        path.write_bytes(b"old")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            if size < whole:
                with pytest.raises(NergError, match="largest size"):
                    write_exr(path, channels, {"seed": "3"})
            else:
                write_exr(path, channels, {"seed": "3"})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        assert path.stat().st_size == (3 if size < whole else whole) and [p.name for p in tmp_path.iterdir()] == [
            "a.exr"
        ]


_ONE_THREAD = """
import sys
import nerg_mi, mitsuba as mi, drjit as dr, numpy as np
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from nerg_mi.files.images import write_bitmap_exr
write_bitmap_exr(sys.argv[1], mi.Bitmap(np.ones((64, 64, 3), np.float32)))
"""


_READ = """
import sys
import nerg_mi, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from nerg_mi.rendering.scene import load_scene
load_scene(sys.argv[1])
assert dr.thread_count() == 1
"""


def test_a_scene_with_an_exr_file_is_read_with_one_thread(tmp_path):
    # Nor does its reader.
    write_exr(tmp_path / "sky.exr", {c: np.ones((8, 16), np.float32) for c in "RGB"})
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{sky}<sensor type="perspective"/></scene>')
    subprocess.run([sys.executable, "-c", _READ, str(tmp_path / "scene.xml")], check=True, timeout=120)


def test_one_thread_is_enough(tmp_path):
    # Mitsuba's writer never returns here.
    subprocess.run([sys.executable, "-c", _ONE_THREAD, str(tmp_path / "a.exr")], check=True, timeout=120)
    assert (tmp_path / "a.exr").stat().st_size > 0


@pytest.mark.parametrize("kind", [np.float32, np.float16])
@pytest.mark.parametrize(
    "names",
    [
        "R G B",
        "R G B A",
        "Y",
        "Y A",
        "Z",
        "depth.T",
        "R G B depth.T",
        "A B C",
        "rgba.R rgba.G rgba.B rgba.A",
        "r g b",
        "albedo.R albedo.G albedo.B nn.X nn.Y nn.Z",
        "X Y Z",
        "Z Y X A B",
        "Blue Aqua Cat",
        "left.R right.R left.G B",
    ],
)
def test_pictures_are_read_as_mitsuba_reads_them(rgb, tmp_path, names, kind):
    from nerg_mi.photos.images import open_bitmap

    values = np.random.default_rng(0).random((len(names.split()), 4, 3)).astype(kind)
    write_exr(tmp_path / "a.exr", dict(zip(names.split(), values)))
    mine, theirs = open_bitmap(tmp_path / "a.exr", "image"), mitsuba_bitmap(tmp_path / "a.exr")
    assert mine.pixel_format() == theirs.pixel_format() and mine.component_format() == theirs.component_format()
    if mine.pixel_format() == rgb.Bitmap.PixelFormat.MultiChannel:
        assert [f.name for f in mine.struct_()] == [f.name for f in theirs.struct_()]
    assert np.array_equal(np.array(mine), np.array(theirs)) and np.array(mine).shape == np.array(theirs).shape
    for ask in ("premultiplied_alpha", "srgb_gamma", "has_alpha"):
        assert getattr(mine, ask)() == getattr(theirs, ask)(), ask


def test_damaged_exr_files_are_told_with_their_name(tmp_path):
    write_exr(tmp_path / "a.exr", {c: np.random.default_rng(0).random((8, 8)).astype(np.float32) for c in "RGB"})
    raw = (tmp_path / "a.exr").read_bytes()
    for cut in (0, 3, 20, 200, len(raw) - 5):
        (tmp_path / "b.exr").write_bytes(raw[:cut])
        with pytest.raises(NergError, match="b.exr"):
            read_exr(tmp_path / "b.exr")
    write_exr(tmp_path / "c.exr", {c: np.zeros((2, 2), np.float32) for c in ("Y", "RY", "BY")})
    with pytest.raises(NergError, match="c.exr.*luminance"):
        read_exr(tmp_path / "c.exr")
