"""Gaze that is written back to Gaussian splats: from files to a file."""

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.style import color_values
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.splats import read_splats, write_ply_splats
from nerg_mi.maths.sphere import C0
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows import bake_chunks
from nerg_mi.workflows.bake_splats import COLUMN, bake_splats
from nerg_mi.workflows.scene_commands import BakeOptions
from tests.formats.splats.writers import random_splats, write_inria
from tests.plugins import fields
from tests.surfaces.walls import wall
from tests.workflows.recorder import Recorder

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
    assert found.files == (place / "out.ply",) and "30 are looked at by 1 observer;" in told.messages[1]
    assert told.messages[0].endswith("place.ply: columns that are not used: label")
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
        ({"texture": 512}, "--texture"),
        ({"shapes": ("a",)}, "--shape is of surfaces"),
        ({"source": "rays"}, "rays by --rays"),
        ({"source": "field", "gaze": None}, "--field SPLATS"),
        ({"unit": "seconds"}, "add --from rays"),
        ({"source": "eyes"}, 'got "eyes"'),
        ({"observer": None}, "nobody looks"),
    ],
)
def test03_what_splats_have_not(rgb, place, options, said):
    given = BakeOptions(**({"gaze": place / "gaze.safetensors"} | OPTIONS | options))
    with pytest.raises(NergError, match=said):
        bake_splats(place / "place.ply", [place / "out.ply"], given)
    with pytest.raises(NergError, match=".ply"):
        bake(place, "out.glb")
    assert not (place / "out.ply").exists()


def looks(n=600):
    """Rays of two people from before a wall of a square metre, at it."""
    rng = np.random.default_rng(0)
    d = np.concatenate([rng.normal(0, 0.12, (n, 2)), np.ones((n, 1))], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return Rays(np.arange(n) / 10, np.arange(n) % 2, ("a", "b"), np.tile([0.0, 0, -1], (n, 1)), d, np.ones(n))


def test04_rays_themselves_in_parts_and_in_one_go(rgb, tmp_path, monkeypatch):
    """Shares, seconds, halves, smoothed; the files are the same to the byte."""
    monkeypatch.setattr(bake_chunks, "RAYS", 200)
    write_ply_splats(tmp_path / "wall.ply", wall(0.0, 1.0, 0.03, 0.0005))
    looks().save(tmp_path / "rays.npz")
    common = {"rays": tmp_path / "rays.npz", "mode": "llvm_ad_rgb", "bundle": 4, "halves": True, "smooth": 0.05}
    for folder, more in (("one", {}), ("parts", {"store": tmp_path / "store"})):
        told = Recorder()
        outputs = [tmp_path / folder / f"a{suffix}" for suffix in (".ply", ".json")]
        found = bake_splats(tmp_path / "wall.ply", outputs, BakeOptions(**common, **more), told)
    for name in ("a.ply", "a.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
    summary = json.loads((tmp_path / "one" / "a.json").read_text())
    assert abs(summary["on_splats"] + summary["escaped"] - 1) < 1e-3 and summary["on_splats"] > 0.9
    assert 0.7 < summary["halves_cc"] <= 1 and summary["lookers"] == 600
    assert any("lies on Gaussians" in line for line in told.messages)
    # Where they look most: a Gaussian of the law, the cone and the smoothing.
    most = 1 / (2 * np.pi * (0.12**2 + np.radians(1.5) ** 2 + 0.05**2))
    middle = np.linalg.norm(found.splats.centers[:, :2], axis=1) < 0.06
    assert np.isclose(np.median(found.attention[middle]), most, rtol=0.15)
    seconds = bake_splats(tmp_path / "wall.ply", (), BakeOptions(**common, unit="seconds", store=tmp_path / "store"))
    assert np.allclose(seconds.attention, 120 * found.attention, rtol=0.01) and seconds.summary["unit"].endswith(
        "[s/m^2]"
    )


def test05_a_field_smoothed_and_in_parts(rgb, place):
    (place / "walk.csv").write_text("x,y,z\n0,0,-3\n0,1,-3\n1,0,-3\n")
    common = {"observer": None, "path": place / "walk.csv"}
    one, parts = bake(place, "one.ply", **common), bake(place, "two.ply", store=place / "store", **common)
    assert np.array_equal(one.attention, parts.attention)
    # Balls that are apart and turned anyhow have nobody to share with.
    smoothed = bake(place, "three.ply", smooth=0.01, **common)
    assert np.median(np.abs(smoothed.attention / one.attention - 1)) < 0.01
