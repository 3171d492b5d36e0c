"""Parts of a bake: the same wherever and however often they are computed."""

import pickle
from importlib.resources import files

import numpy as np
import pytest
from nerg_mi.scenes import store

from nerg_mi.errors import NergError
from nerg_mi.surfaces.laplacian import merge
from nerg_mi.surfaces.sources import Crowd, GazeSettings, RaySettings, TrackedRays
from nerg_mi.workflows import bake_chunks
from nerg_mi.workflows.bake_chunks import BakeScene, parts_of
from tests.surfaces.meshes import box, joined

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
