"""Tests of `nerg_mi.viewer.source`."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

import nerg_mi as nerg
from nerg_mi.environment.nested_scene import GAZE_PROPERTY, find_field_file
from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.formats.gltf import encode_unlit_glb
from nerg_mi.viewer.source import open_viewer_scene, write_variants
from tests.formats.splats.writers import random_splats, write_spz
from tests.recorder import Recorder
from tests.tracking.dataset.making import write_dataset

MESH = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def rays_file(tmp_path):
    path = tmp_path / "rays.npz"
    ahead = [[1.0, 0, 0]] * 3
    nerg.Rays([0, 1, 2], [0, 0, 0], ("Ada",), [[0, 0, 1.6]] * 3, ahead, np.ones(3)).save(path)
    return path


def test01_a_scene_with_nerg_is_used_unchanged(rgb, tmp_path, rays_file):
    store = SCENE_FILE
    place = open_viewer_scene([store, rays_file], tmp_path / "new", up=(0, 0, 2))
    assert place.scene == store and not place.made and len(place.rays) == 3
    assert np.array_equal(place.up, [0, 0, 1]) and place.name == f"{store.name} + rays.npz"


def test02_other_files_get_a_new_scene(rgb, tmp_path):
    (tmp_path / "a.obj").write_text(MESH)
    recorder = Recorder()
    place = open_viewer_scene([tmp_path / "a.obj"], tmp_path, up=(0, 1, 0), reporter=recorder)
    assert place.made and place.rays is None and np.allclose(place.up, [0, 1, 0])
    assert type(nerg.Scene.load(place.scene)).__name__ == "Scene"


def test03_a_folder_is_replaced_by_its_files(rgb, tmp_path, rays_file):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(NergError, match="contains nothing that the viewer can show; name"):
        open_viewer_scene([run], tmp_path)
    (run / "a.obj").write_text(MESH)
    (run / "notes.txt").write_text("x")
    (run / "mesh.glb").write_bytes(b"".join(encode_unlit_glb([("POSITION", np.eye(3, dtype="<f4"), False)], None)))
    assert open_viewer_scene([run], tmp_path).name == "a.obj"
    for name in ("scene.xml", "other.xml"):
        shutil.copy(SCENE_FILE.parent / "shapes.xml", run / name)
    for name in ("twin.ply", "twin_lights.ply", "display.xml"):
        shutil.copy(SCENE_FILE.parent / name, run / name)
    (run / "scene.xml").unlink()
    with pytest.raises(NergError, match="name one of them"):
        open_viewer_scene([run], tmp_path)


def test03_splats_in_a_folder_are_recognised(rgb, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    write_spz(run / "a.spz", random_splats(9))
    place = open_viewer_scene([run], tmp_path, observer=(0.0, 0.0, -3.0))
    assert place.made and place.name == "a.spz" and 'type="splats"' in place.scene.read_text()


def test04_two_files_of_one_kind_are_reported(rgb, tmp_path, rays_file):
    shutil.copy(rays_file, tmp_path / "more.npz")
    with pytest.raises(NergError, match="both rays"):
        open_viewer_scene([rays_file, tmp_path / "more.npz"], tmp_path)
    with pytest.raises(NergError, match="nothing to view"):
        open_viewer_scene([], tmp_path)
    with pytest.raises(NergError, match="up must be a direction"):
        open_viewer_scene([SCENE_FILE], tmp_path, up=(0, 0, 0))


def test05_one_place_of_a_dataset_is_shown(rgb, tmp_path):
    """As in all commands, a dataset is named by its folder, or by a folder of an environment in it."""
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")
    _, rays = write_dataset(tmp_path)
    (tmp_path / "a.obj").write_text(MESH)
    for name in ("shop.rays", "shop.rays/place=shop"):
        place = open_viewer_scene([tmp_path / "a.obj", tmp_path / name], tmp_path, up=(0, 0, 1))
        assert place.rays is not None and len(place.rays) == len(rays) and place.made


@pytest.mark.nightly
def test06_several_gaze_fields_are_variants(rgb, tmp_path):
    store = SCENE_FILE
    run, recorder = tmp_path / "run", Recorder()
    run.mkdir()
    for name in ("a", "b"):
        shutil.copy(store.parent / "shoppers.safetensors", run / f"{name}.safetensors")
    place = open_viewer_scene([store, run], tmp_path, reporter=recorder)
    assert list(place.variants) == ["shoppers", "a", "b"] and place.scene == place.variants["shoppers"]
    assert (
        find_field_file(place.variants["b"], GAZE_PROPERTY) == (run / "b.safetensors").resolve()
        and place.made
        and not recorder.warnings
    )
    # A repeated name gets the folder's name as a prefix; a field with another geometry is reported.
    shutil.copy(run / "a.safetensors", tmp_path / "a.safetensors")
    metadata = {"provenance": {"field_file": {"file": "x", "sha256": "y"}}}
    write_checkpoint(tmp_path / "c.safetensors", "gaze", {"a": np.zeros(1, np.float32)}, metadata)
    files = [run / "a.safetensors", tmp_path / "a.safetensors", tmp_path / "c.safetensors"]
    variants = write_variants(store, files, tmp_path, recorder)
    assert list(variants) == ["a", f"{tmp_path.name}/a", "c"]
    assert len(recorder.warnings) == 1 and "another scene" in recorder.warnings[0]
    # For fields alone a scene is made with the geometry of their training.
    shutil.copy(store.parent / "store.safetensors", run / "store.safetensors")
    place = open_viewer_scene([run], tmp_path)
    assert place.made and list(place.variants) == ["a", "b"]
