"""Tests of `nerg_mi.viewer.source`."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.formats.gltf import encode_unlit_glb
from nerg_mi.viewer.source import name_gaze, open_viewer_inputs
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
    place = open_viewer_inputs([store, rays_file], up=(0, 0, 2))
    assert place.load("") is place.scene and place.files[0] == store and len(place.rays) == 3
    assert np.array_equal(place.up, [0, 0, 1]) and place.name == f"{store.name} + rays.npz"


def test02_other_files_get_a_new_scene(rgb, tmp_path):
    (tmp_path / "a.obj").write_text(MESH)
    recorder = Recorder()
    place = open_viewer_inputs([tmp_path / "a.obj"], up=(0, 1, 0), reporter=recorder)
    assert place.scene is None and place.rays is None and np.allclose(place.up, [0, 1, 0])
    assert len(place.load("").mitsuba.sensors()) == 3 and place.files == [tmp_path / "a.obj"]


def test03_a_folder_is_replaced_by_its_files(rgb, tmp_path, rays_file):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(NergError, match="contains nothing that the viewer can show; name"):
        open_viewer_inputs([run])
    (run / "a.obj").write_text(MESH)
    (run / "notes.txt").write_text("x")
    (run / "mesh.glb").write_bytes(b"".join(encode_unlit_glb([("POSITION", np.eye(3, dtype="<f4"), False)], None)))
    assert open_viewer_inputs([run]).name == "a.obj"
    for name in ("scene.xml", "other.xml"):
        shutil.copy(SCENE_FILE.parent / "shapes.xml", run / name)
    for name in ("twin.ply", "twin_lights.ply", "display.xml"):
        shutil.copy(SCENE_FILE.parent / name, run / name)
    (run / "scene.xml").unlink()
    with pytest.raises(NergError, match="name one of them"):
        open_viewer_inputs([run])


def test03_splats_in_a_folder_are_recognised(rgb, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    write_spz(run / "a.spz", random_splats(9))
    place = open_viewer_inputs([run], observer=(0.0, 0.0, -3.0))
    assert place.name == "a.spz" and 'type="splats"' in place.describe("").to_xml()


def test04_two_files_of_one_kind_are_reported(rgb, tmp_path, rays_file):
    shutil.copy(rays_file, tmp_path / "more.npz")
    with pytest.raises(NergError, match="both rays"):
        open_viewer_inputs([rays_file, tmp_path / "more.npz"])
    with pytest.raises(NergError, match="nothing to view"):
        open_viewer_inputs([])
    with pytest.raises(NergError, match="up must be a direction"):
        open_viewer_inputs([SCENE_FILE], up=(0, 0, 0))


def test05_one_place_of_a_dataset_is_shown(rgb, tmp_path):
    """As in all commands, a dataset is named by its folder, or by a folder of an environment in it."""
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")
    _, rays = write_dataset(tmp_path)
    (tmp_path / "a.obj").write_text(MESH)
    for name in ("shop.rays", "shop.rays/place=shop"):
        place = open_viewer_inputs([tmp_path / "a.obj", tmp_path / name], up=(0, 0, 1))
        assert place.rays is not None and len(place.rays) == len(rays)
        with pytest.raises(NergError, match="objects in memory"):
            place.describe("")


@pytest.mark.nightly
def test06_several_gaze_fields_are_variants(rgb, tmp_path):
    store = SCENE_FILE
    run, recorder = tmp_path / "run", Recorder()
    run.mkdir()
    for name in ("a", "b"):
        shutil.copy(store.parent / "shoppers.safetensors", run / f"{name}.safetensors")
    place = open_viewer_inputs([store, run], reporter=recorder)
    assert list(place.gaze) == ["shoppers", "a", "b"] and place.load("shoppers") is place.scene
    names = [place.load(name).integrator.children["gaze"].filename for name in "ab"]
    assert names == [str(run / f"{name}.safetensors") for name in "ab"] and not recorder.warnings
    assert place.list_files("b") == [*place.list_files("shoppers"), run / "b.safetensors"]
    assert str((run / "b.safetensors").resolve()) in place.describe("b").to_xml()
    # A repeated name gets the folder's name as a prefix; a field with another geometry is reported.
    shutil.copy(run / "a.safetensors", tmp_path / "a.safetensors")
    fields = [nerg.GazeField.load(folder / "a.safetensors") for folder in (run, tmp_path)]
    fields.append(replace(fields[0], provenance={"field_file": {"file": "x", "sha256": "y"}}, path=None))
    assert list(name_gaze(fields, recorder)) == ["a", f"{tmp_path.name}/a", "gaze 2"]
    assert len(recorder.warnings) == 1 and "another scene" in recorder.warnings[0]
    # For fields alone a scene is made with the geometry of their training.
    shutil.copy(store.parent / "store.safetensors", run / "store.safetensors")
    place = open_viewer_inputs([run])
    assert place.scene is None and list(place.gaze) == ["a", "b"] and place.load("b").has_gaze


def test07_scenes_in_memory(rgb, tmp_path):
    """A scene of `make_scene` is loaded again, and described if all parts have files."""
    store, camera = SCENE_FILE.parent, nerg.Camera((7, 3, 2), (5, 4, 1), width=9, height=6)
    gaze = nerg.GazeField.load(store / "shoppers.safetensors")
    made = nerg.make_scene(store / "store.safetensors", gaze, camera=camera)
    place = open_viewer_inputs([made, replace(gaze, path=None)])
    assert list(place.gaze) == ["shoppers", "gaze 0"] and place.load("shoppers") is not made
    assert place.load("gaze 0").integrator.gaze.field is gaze.network
    (tmp_path / "described.xml").write_text(place.describe("shoppers").to_xml())
    assert nerg.Scene.load(tmp_path / "described.xml").has_gaze
    with pytest.raises(NergError, match="objects in memory"):
        place.describe("gaze 0")
    # The scene of the caller keeps its settings.
    loaded = nerg.Scene.load(SCENE_FILE, width=24)
    shown = open_viewer_inputs(loaded)
    assert shown.load("") is not loaded and int(shown.load("").mitsuba.sensors()[0].film().crop_size()[0]) == 24
