"""Tests of `nerg_mi.environment.gaze`."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment import gaze as gaze_api
from nerg_mi.environment.environment import Environment, identify_file
from nerg_mi.environment.gaze import GazeField
from nerg_mi.evaluation.gaze import FieldDensity
from nerg_mi.formats.fields import save_gaze
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions
from tests.evaluation.gaze_fields import made
from tests.plugins import fields

BOX = Box((-1, -1, -1), (1, 1, 1))
EYES = np.array([(0.1, -0.2, 0.3), (-0.4, 0.3, -0.1)])
ROOM = """<scene version="3.0.0">
  <shape type="rectangle"><transform name="to_world"><scale value="0.9"/><translate z="-0.9"/></transform></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.2"/><translate x="0.5"/></transform></shape></scene>"""
ALIGN = np.array([[0, -0.5, 0, 0.1], [0.5, 0, 0, -0.2], [0, 0, 0.5, 0.05], [0, 0, 0, 1]])
TURN = 2 * ALIGN[:3, :3]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A room in every kind of file, and gaze fields that were trained in it."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("gaze")
    (folder / "room.xml").write_text(ROOM)
    mesh = mi.load_string(ROOM).shapes()[1]
    mesh.write_ply(str(folder / "block.ply"))
    fields.radiance(folder / "field.safetensors", density_scale=30.0)
    solid = np.zeros((8, 8, 8), np.float32)
    solid[:2] = 200.0
    write_volume(folder / "hits.vol", solid, (-1, -1, -1), (1, 1, 1))
    field = made("default recipe", BOX)
    room = {"scene_file": identify_file(folder / "room.xml")}
    save_gaze(field, folder / "gaze.safetensors", room)
    save_gaze(field, folder / "aligned.safetensors", {**room, "align": ALIGN.tolist()})
    save_gaze(field, folder / "unknown.safetensors", {})
    save_gaze(made("default recipe", BOX, geometry="none"), folder / "none.safetensors", {"geometry": "none"})
    return folder


def some_rays(count=30):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(count, 3))
    return EYES[np.arange(count) % 2], d / np.linalg.norm(d, axis=1, keepdims=True)


def test01_the_whole_sphere_integrates_to_one(folder):
    """Above the room there is no surface, and the density is positive there."""
    gaze, d = nerg.GazeField.load(folder / "gaze.safetensors"), fibonacci_directions(1 << 13)
    assert isinstance(gaze, GazeField)
    for eye in EYES:
        density = gaze.density(eye, d)
        assert density.shape == (len(d),) and density.dtype == np.float32 and density.min() > 0
        assert density.mean() * 4 * np.pi == pytest.approx(1, abs=0.01)


def test02_the_density_is_the_gaze_of_a_scene_where_there_are_surfaces(folder):
    gaze, d = nerg.GazeField.load(folder / "gaze.safetensors"), fibonacci_directions(400)
    scene = nerg.make_scene(gaze=gaze, shapes=folder / "room.xml")
    for eye in EYES:
        traced = nerg.trace(scene, eye, d, ["gaze", "opacity"])
        hit = traced.opacity > 0.5
        assert 40 < hit.sum() < 300 and (traced.gaze[~hit] == 0).all()
        density = gaze.density(eye, d, tolerance=5e-3)
        np.testing.assert_allclose(density[hit], traced.gaze[hit], rtol=1e-4)
        np.testing.assert_allclose(gaze.density(eye, d, environment=scene, tolerance=5e-3), density, rtol=1e-4)


def test03_origins_and_directions_are_broadcast(folder):
    gaze, (o, d) = nerg.GazeField.load(folder / "gaze.safetensors"), some_rays()
    density = gaze.density(o, 3 * d)
    np.testing.assert_allclose(density[::2], gaze.density(tuple(EYES[0]), d[::2]), rtol=1e-5)
    np.testing.assert_allclose(gaze.density(o[:2], d[0])[:1], density[:1], rtol=1e-5)
    with pytest.raises(nerg.NergError, match="number of origins must be 1 or that of the directions \\(30\\), got 2"):
        gaze.density(o[:2], d)
    with pytest.raises(nerg.NergError, match="directions must not be zero, but row 1 is"):
        gaze.density(EYES, [(1, 0, 0), (0, 0, 0)])
    with pytest.raises(nerg.NergError, match="tolerance must lie in"):
        gaze.density(o, d, tolerance=2)


def test04_the_alignment_is_applied(folder):
    gaze, aligned = (nerg.GazeField.load(folder / f"{name}.safetensors") for name in ("gaze", "aligned"))
    o, d = some_rays()
    inside = gaze.density(o @ ALIGN[:3, :3].T + ALIGN[:3, 3], d @ TURN.T)
    np.testing.assert_allclose(aligned.density(o, d), inside, rtol=1e-3)
    assert np.ptp(inside) > 1e-2


def test05_every_kind_of_geometry(folder):
    """A file, and the same in memory, equal the evaluation."""

    gaze, (o, d) = nerg.GazeField.load(folder / "unknown.safetensors"), some_rays(6)
    for name, load in (
        ("room.xml", Environment.open),
        ("block.ply", Environment.open),
        ("field.safetensors", Environment.open),
        ("hits.vol", Environment.open),
    ):
        expected = FieldDensity(gaze.network, load(folder / name).medium)
        result = gaze.density(o, d, environment=str(folder / name), tolerance=5e-3)
        for eye in (0, 1):
            np.testing.assert_allclose(result[eye::2], expected(EYES[eye], d[eye::2])[0], rtol=1e-4)
        if name == "field.safetensors":
            memory = nerg.RadianceField.load(folder / name)
            np.testing.assert_array_equal(gaze.density(o, d, environment=memory, tolerance=5e-3), result)


def test06_a_scene_may_move_the_field(folder):
    gaze, (o, d) = nerg.GazeField.load(folder / "unknown.safetensors"), some_rays(6)
    field = nerg.RadianceField.load(folder / "field.safetensors")
    moved = nerg.make_scene(field, gaze, to_world=np.linalg.inv(ALIGN))
    expected = gaze.density(o, d, environment=nerg.make_scene(field, gaze))
    np.testing.assert_allclose(gaze.density(o, d, environment=moved), expected, rtol=2e-3)


def test07_missing_geometry_is_an_error_that_names_the_option(folder, tmp_path):
    gaze, (o, d) = nerg.GazeField.load(folder / "gaze.safetensors"), some_rays(2)
    shutil.copy(folder / "gaze.safetensors", tmp_path)
    lonely = nerg.GazeField.load(tmp_path / "gaze.safetensors")
    with pytest.raises(nerg.NergError, match=r'room.xml", which the field .* does not exist; give .* with environment'):
        lonely.density(o, d)
    (tmp_path / "room.xml").write_text(ROOM.replace("0.5", "0.4"))
    with pytest.raises(nerg.NergError, match=r'room.xml" is not the file that .* was trained in; .* with environment'):
        lonely.density(o, d)
    with pytest.raises(nerg.NergError, match=r"does not store the geometry .*; give .* with environment"):
        nerg.GazeField.load(folder / "unknown.safetensors").density(o, d)
    in_memory = GazeField(gaze.network, gaze.provenance)
    with pytest.raises(nerg.NergError, match=r'environment of its training, "room.xml", .* with environment'):
        in_memory.density(o, d)
    located = GazeField(gaze.network, gaze.provenance, environment=Environment.open(folder / "room.xml"))
    np.testing.assert_array_equal(located.density(o, d), gaze.density(o, d))


def test08_other_objects_are_no_geometry(folder):
    gaze, (o, d) = nerg.GazeField.load(folder / "gaze.safetensors"), some_rays(2)
    for geometry, message in (
        (3, "got int"),
        (gaze, "contains a gaze field and is no environment"),
        (folder / "gaze.safetensors", "contains a gaze field and is no environment"),
        (folder / "nowhere.ply", "nowhere.ply"),
    ):
        with pytest.raises(nerg.NergError, match=message):
            gaze.density(o, d, environment=geometry)


def test09_a_field_without_surfaces_needs_no_geometry(folder):
    gaze, (o, d) = nerg.GazeField.load(folder / "none.safetensors"), some_rays(6)
    expected = FieldDensity(gaze.network, None)(EYES, d)[np.arange(6) % 2, np.arange(6)]
    np.testing.assert_allclose(gaze.density(o, d, tolerance=5e-3), expected, rtol=1e-4)
    np.testing.assert_array_equal(gaze.density(o, d, environment=folder / "block.ply"), gaze.density(o, d))


def test10_another_geometry_is_reported(folder):
    class Listener:
        def __init__(self):
            self.warnings, self.shares = [], []

        def message(self, text): ...

        def warn(self, text):
            self.warnings.append(text)

        def progress(self, share, text=""):
            self.shares.append((share, text))

    gaze, (o, d) = nerg.GazeField.load(folder / "gaze.safetensors"), some_rays(2)
    listener = Listener()
    gaze.density(o, d, environment=folder / "room.xml", progress=listener)
    assert not any("was not trained in" in text for text in listener.warnings)
    assert listener.shares == [(1.0, "observer 2 of 2")]
    gaze.density(o, d, environment=folder / "block.ply", progress=listener)
    assert sum("was not trained in" in text for text in listener.warnings) == 1


def test11_a_changed_file_is_read_again(folder, tmp_path):
    gaze, (o, d) = nerg.GazeField.load(folder / "unknown.safetensors"), some_rays(6)
    path = tmp_path / "room.xml"
    path.write_text(ROOM)
    before = gaze.density(o, d, environment=path)
    np.testing.assert_array_equal(gaze.density(o, d, environment=path), before)
    path.write_text(ROOM.replace('value="0.2"', 'value="0.35"'))
    assert np.abs(gaze.density(o, d, environment=path) / before - 1).max() > 1e-3


def test12_another_variant_is_refused(folder, monkeypatch):
    gaze, (o, d) = nerg.GazeField.load(folder / "gaze.safetensors"), some_rays(2)
    import drjit.cuda.ad as other

    monkeypatch.setattr(gaze_api, "get_array_module", lambda: other)
    with pytest.raises(nerg.NergError, match="another Mitsuba variant"):
        gaze.density(o, d)
