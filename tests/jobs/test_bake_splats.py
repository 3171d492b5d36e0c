"""Gaze that is written back to Gaussian splats: from files to a file."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.colors import color_values
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.splats.files import read_splats
from nerg_mi.jobs.bake_splats import COLUMN, bake_splats
from nerg_mi.jobs.options.bake import BakeOptions
from nerg_mi.maths.harmonics import C0
from tests.formats.splats.writers import random_splats, write_inria
from tests.jobs.recorder import Recorder
from tests.plugins import fields

OPTIONS = {"mode": "llvm_ad_rgb", "observer": (0.0, 0.0, -3.0)}


@pytest.fixture
def place(tmp_path):
    """A few balls that do not hide each other, and a gaze field."""
    splats = random_splats(30, size=0.02)
    write_inria(tmp_path / "place.ply", splats, shuffled=True)
    fields.gaze(tmp_path / "gaze.safetensors")
    return tmp_path


def bake(place, output="out.ply", reporter=None, **more):
    options = BakeOptions(gaze=place / "gaze.safetensors", **(OPTIONS | more))
    return bake_splats(place / "place.ply", [place / output], options, reporter or Recorder())


def test01_each_gaussian_has_what_the_field_says_and_all_else_is_kept(rgb, place):
    told = Recorder()
    found = bake(place, reporter=told)
    given, back = read_splats(place / "place.ply"), read_splats(place / "out.ply")
    assert found.files == (place / "out.ply",) and "30 are looked at by 1 observer;" in told.messages[0]
    to = given.centers - np.array(OPTIONS["observer"])
    distance = np.linalg.norm(to, axis=1)
    w = to / distance[:, None]
    own = np.einsum("nji,nj->ni", given.axes(), w) / given.scales
    area = np.linalg.norm(own, axis=1) * given.scales.min(axis=1)
    field = load_gaze(place / "gaze.safetensors", ns)[0]
    array = lambda rows: ns.Array3f(np.ascontiguousarray(np.asarray(rows, np.float32).T))
    origins = array(np.tile(OPTIONS["observer"], (30, 1)))
    gaze = np.array(field.evaluate(array(given.centers), origins, array(w), ns.Bool(True))[0])
    assert np.allclose(found.attention, gaze * area / distance**2, rtol=1e-3)
    assert np.allclose(back.extra[COLUMN], found.attention, rtol=1e-6)
    assert np.array_equal(back.extra["label"], given.extra["label"]) and back.degree == 0
    for name in ("centers", "scales", "rotations", "opacities"):
        assert np.allclose(getattr(back, name), getattr(given, name), rtol=1e-5, atol=1e-6)
    # The hottest is nine tenths of the map's last colour.
    hot = 0.5 + C0 * back.harmonics[found.attention.argmax(), 0]
    assert np.abs(hot - color_values("inferno", np.ones(1))[0]).max() < 0.1


def test02_people_on_a_path_and_places_in_other_units(rgb, place):
    (place / "walk.csv").write_text("x,y,z,weight\n0,0,-3,1\n0,0,-3,3\n0,3,0,0\n")
    (place / "align.json").write_text("[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]")
    one = bake(place)
    many = bake(place, observer=None, path=place / "walk.csv", align=place / "align.json", top=0.5, decades=2.0)
    assert many.observers == 3 and np.allclose(many.attention, 4 * one.attention, rtol=1e-5)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"smooth": 0.1}, "--smooth is of surfaces with triangles"),
        ({"shapes": ("a",)}, "--shape is of surfaces"),
        ({"source": "rays"}, "nerg train gaze RAYS --field SPLATS"),
        ({"gaze": None}, "name one by --gaze"),
        ({"source": "eyes"}, 'got "eyes"'),
        ({"observer": None}, "nobody looks"),
        ({"observer": (1e4, 0.0, 0.0), "top": -1.0}, "--top must be positive"),
    ],
)
def test03_what_splats_have_not(rgb, place, options, said):
    given = BakeOptions(**({"gaze": place / "gaze.safetensors"} | OPTIONS | options))
    with pytest.raises(NergError, match=said):
        bake_splats(place / "place.ply", [place / "out.ply"], given)
    with pytest.raises(NergError, match="end in .ply"):
        bake(place, "out.glb")
    assert not (place / "out.ply").exists()
