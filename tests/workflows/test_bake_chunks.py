"""Tests of `nerg_mi.workflows.bake_chunks`."""

import pickle
from dataclasses import replace
from importlib.resources import files

import drjit.llvm.ad as ns
import numpy as np
import pytest
from nerg_mi.scenes import store

from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import merge
from nerg_mi.surfaces.sources import Crowd, GazeSettings, RaySettings, TrackedRays
from nerg_mi.workflows import bake_chunks
from nerg_mi.workflows.bake_chunks import (
    BakeScene,
    SplatScene,
    check_values,
    cut,
    find_crowd,
    parts_of,
    read_path,
    read_receivers,
    splat_place,
    tracked_rays,
)
from nerg_mi.workflows.scene_commands import BakeOptions
from tests.plugins import fields
from tests.surfaces.meshes import box, joined
from tests.surfaces.test_splats import falling
from tests.surfaces.walls import wall
from tests.workflows.recorder import Recorder

# ---- Parts of a bake: the same wherever and however often they are computed ----


ROOM = joined(box((0, 0, 0), (8, 6, 3)))


def rays(n):
    d = np.random.default_rng(0).normal(size=(n, 3))
    return TrackedRays(np.full((n, 3), 1.5), d / np.linalg.norm(d, axis=1, keepdims=True), np.full(n, 1 / n))


def test01_parts_are_cut_alike_and_a_pickled_scene_gives_the_same(rgb, monkeypatch):
    monkeypatch.setattr(bake_chunks, "RAYS", 300)
    scene = BakeScene(ROOM, of_rays=RaySettings(cone=0.03, bundle=4))
    parts = list(parts_of(rays(1000)))
    assert [len(p) for p in parts] == [300, 300, 300, 100] and [p.first for p in parts] == [0, 300, 600, 900]
    first = [scene.sums(part) for part in parts]
    again = pickle.loads(pickle.dumps(scene))
    late = [again.sums(part) for part in reversed(parts)][::-1]
    assert np.array_equal(merge(first).vertex, merge(late).vertex)
    assert np.isclose(merge(first).face.sum(), 1)


def test02_observers_of_a_field(rgb):
    scene = BakeScene(ROOM, gaze=files(store) / "shoppers.safetensors", of_gaze=GazeSettings(angle=0.2))
    crowd = Crowd(np.array([(4.4, 2.8, 1.6)] * 5), np.full(5, 0.2))
    parts = list(parts_of(crowd))
    assert [len(p.weights) for p in parts] == [4, 1]
    found = scene.sums(parts[1])
    assert 0.5 < found.on_surface / found.weight < 1.5 and found.count == 1 and abs(found.escaped) < 1e-6


def test03_without_a_field_nobody_looks(rgb):
    with pytest.raises(NergError, match="there is no gaze field"):
        BakeScene(ROOM).sums(Crowd(np.ones((1, 3)), np.ones(1)))


# ---- Who looks ----


TURNED = Similarity(np.array([[0, -2, 0, 1], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]]))


def rays_lookers():
    n = 20
    t = np.arange(n) / 10
    return Rays(t, np.zeros(n), ("a",), np.stack([t, 0 * t, 0 * t + 1.6], 1), np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def test01_a_path(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n4,5,6\n")
    found = read_path(tmp_path / "a.csv")
    assert found.positions.tolist() == [[1, 2, 3], [4, 5, 6]] and found.weights.tolist() == [0.5, 0.5]
    (tmp_path / "b.csv").write_text("weight;x;y;z\n3;1;2;3\n1;4;5;6\n")
    assert read_path(tmp_path / "b.csv").weights.tolist() == [0.75, 0.25]


@pytest.mark.parametrize(
    "text, said",
    [
        ("x,y\n1,2\n", 'no column "z"'),
        ("x,y,z\n", "0 positions"),
        ("x,y,z\n1,2,nan\n", "positions of the path .* row 0 is"),
        ("x,y,z\n1,2,3\n1,2,1e200\n", r"coordinates from -1e\+07 to 1e\+07, and row 1 is \[1.0, 2.0, 1e\+200\]"),
        ("x,y,z\n-1.1e7,2,3\n", "row 0 is"),
        ("x,y,z,weight\n1,2,3,inf\n", "no numbers"),
        ("x,y,z,weight\n1,2,3,nan\n", "no numbers"),
        ("x,y,z,weight\n1,2,3,-1\n", "negative"),
    ],
)
def test02_paths_that_are_none(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(NergError, match=said):
        read_path(tmp_path / "a.csv")


def test03_people_stand_in_the_place():
    told = Recorder()
    found = find_crowd(BakeOptions(observers=4), rays_lookers(), TURNED, told)
    assert len(found.weights) == 4 and np.allclose(found.positions[:, 0], 1) and np.allclose(found.positions[:, 2], 3.2)
    # Metres are told, of which the place has two units each.
    assert f"{found.mean / 2:.2f} m away" in told.messages[0] and "1 people at 20 moments" in told.messages[0]
    who = tracked_rays(rays_lookers(), TURNED, "time")
    assert np.allclose(who.directions, [0, 1, 0]) and np.allclose(who.origins[:, 1], 2 * rays_lookers().origin[:, 0])
    assert np.isclose(who.weights.sum(), 1)


def test04_one_observer_or_nobody():
    assert find_crowd(BakeOptions(observer=(1, 2, 3)), None, TURNED, Recorder()).positions.tolist() == [[1, 2, 3]]
    for options, said in (
        (BakeOptions(), "nobody looks"),
        (BakeOptions(observer=(1, 2)), "three numbers"),
        (BakeOptions(observer=(1, 2, 3), path="a.csv"), "give one of them"),
    ):
        with pytest.raises(NergError, match=said):
            find_crowd(options, None, TURNED, Recorder())
    with pytest.raises(NergError, match="--weights"):
        check_values(BakeOptions(weights="money"))


# ---- What receives gaze ----


SCENE = """<scene version="3.0.0">
    <shape type="cube" id="sign"/>
    <shape type="rectangle" id="wall"><transform name="to_world"><translate z="5"/></transform></shape>
    {more}
</scene>
"""


def test01_a_mesh_is_cut_as_finely_as_asked_in_metres(rgb, tmp_path):
    v, f = box((0, 0, 0), (2, 2, 2))
    write_columns(tmp_path / "a.ply", dict(zip("xyz", v.T)), np.concatenate([f, f[:2, ::-1]]))
    told = Recorder()
    found = read_receivers(tmp_path / "a.ply", (), 16, ns, told)
    assert found.names == ("a",) and found.index.tolist() == list(range(12)) and not found.others
    assert told.messages == ["a.ply: 2 faces that repeat others left out"]
    # Two scene units a metre.
    assert cut(found, 0.25, 2.0).mesh.longest.max() <= 0.5
    assert 50_000 < len(cut(found, None, 1.0).mesh.faces) < 250_000


def test02_shapes_of_a_scene_receive_or_hide(rgb, tmp_path):
    (tmp_path / "a.xml").write_text(SCENE.format(more=""))
    both = read_receivers(tmp_path / "a.xml", (), 16, ns, Recorder())
    assert both.names == ("sign", "wall") and np.bincount(both.shape).tolist() == [12, 2]
    sign = read_receivers(tmp_path / "a.xml", ("sign",), 16, ns, Recorder())
    assert sign.names == ("sign",) and len(sign.mesh.faces) == 12 and len(sign.others) == 1
    with pytest.raises(NergError, match='"door"'):
        read_receivers(tmp_path / "a.xml", ("door",), 16, ns, Recorder())
    (tmp_path / "b.xml").write_text(SCENE.format(more='<shape type="sphere" id="ball"/>'))
    with pytest.raises(NergError, match='"ball" .* is a Sphere'):
        read_receivers(tmp_path / "b.xml", (), 16, ns, Recorder())
    (tmp_path / "c.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(NergError, match="has no shapes"):
        read_receivers(tmp_path / "c.xml", (), 16, ns, Recorder())


def test03_a_field_gives_its_surface(rgb, tmp_path):
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    fields.radiance(tmp_path / "f.safetensors")
    found = read_receivers(tmp_path / "f.safetensors", (), 8, ns, Recorder())
    assert found.names == ("f",) and len(found.mesh.faces) > 10
    with pytest.raises(NergError, match="--shape"):
        read_receivers(tmp_path / "f.safetensors", ("a",), 8, ns, Recorder())


# ---- Parts of a bake of splats: the same wherever and however often they are computed ----


RAYS = RaySettings(cone=0.03, bundle=4)


@pytest.fixture
def scene(tmp_path, rgb):
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    return SplatScene(tmp_path / "wall.ply", len(plain), of_rays=RAYS)


def test01_a_pickled_scene_gives_the_same_and_another_file_is_another_scene(scene):
    rays = falling(100, 0.5)
    first = scene.sums(rays)
    again = pickle.loads(pickle.dumps(scene))
    assert np.array_equal(again.sums(rays).face, first.face)
    assert len(first.face) == len(scene.nothing.face) == 2 * 64 and not len(first.vertex)
    write_ply_splats(scene.splats, wall(0.1, 0.4, 0.05))
    moved = replace(scene)
    assert not np.array_equal(moved.sums(rays).face, first.face)


def test02_without_a_field_nobody_looks(scene):
    with pytest.raises(NergError, match="there is no gaze field"):
        scene.sums(Crowd(np.ones((1, 3)), np.ones(1)))


def test03_how_far_apart_two_ideas_of_a_surface_may_be(rgb):
    assert np.isclose(splat_place(wall(0.0, 0.2)).tolerance, 2 * 1e-3)
