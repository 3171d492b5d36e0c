"""Bakes from files to sums: a field's people, rays, units, and options that contradict each other."""

from importlib.resources import files

import numpy as np
import pytest
from nerg_mi.scenes import store

from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.bake import bake
from nerg_mi.workflows.scene_commands import BakeOptions
from tests.surfaces.meshes import box
from tests.workflows.recorder import Recorder

GAZE = files(store) / "shoppers.safetensors"


@pytest.fixture
def room(tmp_path):
    v, f = box((0, 0, 0), (8, 6, 3))
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    return tmp_path / "room.ply"


def rays(n=40, people=2):
    d = np.tile([1.0, 0, 0], (n, 1))
    return Rays(np.arange(n) / 10, np.arange(n) % people, tuple("abc"[:people]), np.full((n, 3), 1.5), d, np.ones(n))


def test01_the_field_of_people_where_they_were(rgb, room):
    told = Recorder()
    options = BakeOptions(gaze=GAZE, observers=2, angle=6.0, detail=2.0, mode="llvm_ad_rgb")
    found = bake(room, (), options, told, rays=rays())
    assert found.summary["source"] == "field" and found.summary["lookers"] == 1
    assert abs(found.unaccounted) < 1e-3 and found.escaped < 1e-6
    assert np.isclose((found.density * found.mesh.vertex_area).sum(), found.on_surface)
    assert any("unaccounted" in m for m in told.messages) and told.steps[0][0] == 0


def test02_rays_alone_in_shares_and_seconds(rgb, room):
    share = bake(room, (), BakeOptions(cone=0.0, detail=2.0, mode="llvm_ad_rgb"), rays=rays())
    assert share.summary["source"] == "rays" and np.isclose(share.on_surface, 1) and share.escaped == 0
    seconds = bake(room, (), BakeOptions(cone=0.0, detail=2.0, unit="seconds", mode="llvm_ad_rgb"), rays=rays())
    # Of two people twenty rays each, 0.2 seconds apart.
    assert np.isclose((seconds.density * seconds.mesh.vertex_area).sum(), 8.0)
    assert np.allclose(seconds.density, 8 * share.density)
    # All of it lies on the wall that is looked at.
    assert np.isclose(share.share[(share.mesh.corners[:, :, 0] == 8).all(axis=1)].sum(), 1)


def test03_units_of_the_place_are_not_metres(rgb, tmp_path):
    """Twice as many units a metre: the same share on the same square metres."""
    (tmp_path / "align.json").write_text("[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]")
    v, f = box((0, 0, 0), (8, 6, 3))
    for name, scale in (("a", 1), ("b", 2)):
        write_columns(tmp_path / f"{name}.ply", dict(zip("xyz", scale * v.T)), f)
    options = {"cone": 1.5, "detail": 0.9, "smooth": 0.3, "mode": "llvm_ad_rgb"}
    first = bake(tmp_path / "a.ply", (), BakeOptions(**options), rays=rays())
    second = bake(tmp_path / "b.ply", (), BakeOptions(**options, align=tmp_path / "align.json"), rays=rays())
    assert np.allclose(first.density, second.density, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "whose gaze is it"),
        ({"source": "eyes"}, "--from"),
        ({"gaze": GAZE}, "nobody looks"),
        ({"gaze": GAZE, "observer": (1, 2, 3), "unit": "seconds"}, "add --from rays"),
        ({"unit": "hours"}, "--unit"),
        ({"gaze": GAZE, "observer": (1, 2, 3), "smooth": -1.0}, "--smooth must lie in"),
        ({"gaze": GAZE, "observer": (1, 2, 3), "cone": 99.0}, "--cone must lie in"),
        ({"gaze": GAZE, "observer": (1, 2, 3), "top": 0.0}, "--top must lie in"),
        ({"gaze": GAZE, "observer": (1, 2, 3), "cmap": "jet"}, "no perceptually uniform"),
    ],
)
def test04_options_that_contradict_each_other(rgb, room, options, said):
    with pytest.raises(NergError, match=said):
        bake(room, (), BakeOptions(**options, mode="llvm_ad_rgb"))


def test05_rays_do_not_look_from_elsewhere_and_one_person_has_no_halves(rgb, room):
    with pytest.raises(NergError, match="look with a gaze field"):
        bake(room, (), BakeOptions(observer=(1, 2, 3), mode="llvm_ad_rgb"), rays=rays())
    with pytest.raises(NergError, match="two people at least"):
        bake(room, (), BakeOptions(halves=True, detail=3.0, mode="llvm_ad_rgb"), rays=rays(people=1))


def test06_what_is_not_asked_for_is_not_made(rgb, room, monkeypatch):
    """No smoothing, no Laplacian; no texture, no xatlas."""
    from nerg_mi.surfaces import laplacian
    from nerg_mi.workflows import bake as outputs

    def never(*given, **more):
        raise AssertionError("nobody asked for this")

    monkeypatch.setattr(laplacian, "laplacian", never)
    monkeypatch.setattr(outputs, "unroll", never)
    bake(room, [room.with_name("a.glb")], BakeOptions(detail=3.0, mode="llvm_ad_rgb"), rays=rays())
    with pytest.raises(AssertionError):
        bake(room, (), BakeOptions(detail=3.0, smooth=0.1, mode="llvm_ad_rgb"), rays=rays())


def test07_a_mesh_in_millimetres_is_told(rgb, tmp_path):
    v, f = box((0, 0, 0), (8000, 6000, 3000))
    write_columns(tmp_path / "mm.ply", dict(zip("xyz", v.T)), f)
    (tmp_path / "align.json").write_text("[[1e3,0,0,0],[0,1e3,0,0],[0,0,1e3,0],[0,0,0,1]]")
    told, mended = Recorder(), Recorder()
    options = {"detail": 5e3, "cone": 0.0, "mode": "llvm_ad_rgb"}
    bake(tmp_path / "mm.ply", (), BakeOptions(**options), told, rays=rays(4))
    assert any("10,440 m across" in said and "--align" in said for said in told.warnings)
    options["detail"] = 5.0
    bake(tmp_path / "mm.ply", (), BakeOptions(**options, align=tmp_path / "align.json"), mended, rays=rays(4))
    assert not mended.warnings
