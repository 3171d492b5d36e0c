"""From files and folders to the scene that a viewer shows."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.formats.gltf import shown_unlit
from nerg_mi.rendering.nested_scene import gaze_of_scene
from nerg_mi.workflows import demo
from nerg_mi.workflows.scene_commands import ViewOptions
from nerg_mi.workflows.view import place_to_view, write_variants
from tests.formats.splats.writers import random_splats, write_spz
from tests.workflows.recorder import Recorder

MESH = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def rays(tmp_path):
    path = tmp_path / "rays.npz"
    ahead = [[1.0, 0, 0]] * 3
    nerg.Rays([0, 1, 2], [0, 0, 0], ("Ada",), [[0, 0, 1.6]] * 3, ahead, np.ones(3)).save(path)
    return path


def test01_a_scene_with_nerg_is_taken_as_it_is(rgb, tmp_path, rays):
    store = demo.store_scene()
    place = place_to_view([store, rays], tmp_path / "new", ViewOptions(up=(0, 0, 2)))
    assert place.scene == store and not place.made and len(place.rays) == 3
    assert np.array_equal(place.up, [0, 0, 1]) and place.name == f"{store.name} + rays.npz"


def test02_of_others_a_scene_is_made(rgb, tmp_path):
    (tmp_path / "a.obj").write_text(MESH)
    told = Recorder()
    place = place_to_view([tmp_path / "a.obj"], tmp_path, ViewOptions(up=(0, 1, 0)), told)
    assert place.made and place.rays is None and np.allclose(place.up, [0, 1, 0])
    assert type(nerg.Scene.load(place.scene)).__name__ == "Scene"


def test03_a_folder_stands_for_what_is_in_it(rgb, tmp_path, rays):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(NergError, match="holds nothing"):
        place_to_view([run], tmp_path)
    (run / "a.obj").write_text(MESH)
    (run / "notes.txt").write_text("x")
    (run / "mesh.glb").write_bytes(b"".join(shown_unlit([("POSITION", np.eye(3, dtype="<f4"), False)], None)))
    assert place_to_view([run], tmp_path).name == "a.obj"
    for name in ("scene.xml", "other.xml"):
        shutil.copy(demo.store_scene().parent / "shapes.xml", run / name)
    for name in ("twin.ply", "twin_lights.ply", "display.xml"):
        shutil.copy(demo.store_scene().parent / name, run / name)
    (run / "scene.xml").unlink()
    with pytest.raises(NergError, match="name the one to view"):
        place_to_view([run], tmp_path)


def test03_splats_in_a_folder(rgb, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    write_spz(run / "a.spz", random_splats(9))
    place = place_to_view([run], tmp_path, ViewOptions(observer=(0.0, 0.0, -3.0)))
    assert place.made and place.name == "a.spz" and 'type="splats"' in place.scene.read_text()


def test04_two_of_a_kind_are_told(rgb, tmp_path, rays):
    shutil.copy(rays, tmp_path / "more.npz")
    with pytest.raises(NergError, match="both rays"):
        place_to_view([rays, tmp_path / "more.npz"], tmp_path)
    with pytest.raises(NergError, match="nothing to view"):
        place_to_view([], tmp_path)
    with pytest.raises(NergError, match="up must be a direction"):
        place_to_view([demo.store_scene()], tmp_path, ViewOptions(up=(0, 0, 0)))


def test05_a_place_of_a_dataset(rgb, tmp_path):
    """As everywhere, a dataset is named by its folder, or by that of a place in it."""
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")
    from tests.rays.dataset.making import write_dataset

    _, rays = write_dataset(tmp_path)
    (tmp_path / "a.obj").write_text(MESH)
    for name in ("shop.rays", "shop.rays/place=shop"):
        place = place_to_view([tmp_path / "a.obj", tmp_path / name], tmp_path, ViewOptions(up=(0, 0, 1)))
        assert place.rays is not None and len(place.rays) == len(rays) and place.made


@pytest.mark.nightly
def test06_several_gaze_fields_are_variants(rgb, tmp_path):
    store = demo.store_scene()
    run, told = tmp_path / "run", Recorder()
    run.mkdir()
    for name in ("a", "b"):
        shutil.copy(store.parent / "shoppers.safetensors", run / f"{name}.safetensors")
    place = place_to_view([store, run], tmp_path, reporter=told)
    assert list(place.variants) == ["shoppers", "a", "b"] and place.scene == place.variants["shoppers"]
    assert gaze_of_scene(place.variants["b"]) == (run / "b.safetensors").resolve() and place.made and not told.warnings
    # Where a name is taken, the folder's is put before it; a field of another place is told.
    shutil.copy(run / "a.safetensors", tmp_path / "a.safetensors")
    metadata = {"provenance": {"field_file": {"file": "x", "sha256": "y"}}}
    write_checkpoint(tmp_path / "c.safetensors", "gaze", {"a": np.zeros(1, np.float32)}, metadata)
    files = [run / "a.safetensors", tmp_path / "a.safetensors", tmp_path / "c.safetensors"]
    found = write_variants(store, files, tmp_path, told)
    assert list(found) == ["a", f"{tmp_path.name}/a", "c"]
    assert len(told.warnings) == 1 and "another place" in told.warnings[0]
    # Of fields alone a scene is made, in the place of their training.
    shutil.copy(store.parent / "store.safetensors", run / "store.safetensors")
    place = place_to_view([run], tmp_path)
    assert place.made and list(place.variants) == ["a", "b"]
