"""Rays of a file and of a dataset, as a scene shows them."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene import load_scene
from nerg_mi.workflows import scene
from nerg_mi.workflows.scene import write_scene
from nerg_mi.workflows.scene_commands import SceneOptions
from tests.workflows.recorder import Recorder

pytest.importorskip("pyarrow", reason="datasets need the extra parquet")
from tests.rays.dataset.making import DAY, assert_same, write_dataset


def test_a_file_is_shown_as_it_is(tmp_path):
    rays = Rays(np.zeros(1), np.zeros(1, int), ("Ada",), np.zeros((1, 3)), np.eye(3)[:1], np.ones(1))
    rays.save(tmp_path / "rays.npz")
    found = scene.load_scene_rays(tmp_path / "rays.npz", tmp_path / "a.xml", Recorder())
    assert found.file == tmp_path / "rays.npz" and found.made == () and found.of_person("Ada") is found.rays
    none = scene.load_scene_rays(None, tmp_path / "a.xml", Recorder())
    assert none.rays is None and none.file is None and none.of_person("Ada") is None


def test_a_sample_of_a_dataset_is_kept_beside_the_scene(tmp_path, monkeypatch):
    """A sample misses most moments of a person, all of whose rays are read for an eye."""
    _, rays = write_dataset(tmp_path)
    recorder = Recorder()
    whole = scene.load_scene_rays(tmp_path / "shop.rays", tmp_path / "a.xml", recorder)
    assert whole.file == tmp_path / "a.rays.npz" and whole.made == (whole.file,)
    assert_same(Rays.load(whole.file), rays)
    assert any(f"{len(rays):,} rays" in line for line in recorder.messages)
    monkeypatch.setattr(scene, "MOST", 100)
    some = scene.load_scene_rays(tmp_path / "shop.rays", tmp_path / "a.xml", recorder)
    assert some.rays is not None and len(some.rays) == 100 == len(Rays.load(whole.file))
    own = some.of_person("p1_0")
    assert own is not None and own.persons == ("p1_0",)
    assert len(own) == int((rays.person == rays.persons.index("p1_0")).sum())


def test_a_scene_of_a_dataset(rgb, tmp_path):
    """Named by its place as well; the scene renders, and a person is found in it."""
    write_dataset(tmp_path)
    options = SceneOptions(person="p2_1", time=DAY + 2 * 43_200 + 3.0, geometry="none")
    made = write_scene([tmp_path / "shop.rays" / "place=shop"], tmp_path / "a.xml", options)
    assert made.quantity == "kde" and tmp_path / "a.rays.npz" in made.files
    assert made.observer is not None and load_scene(made.path, {"spp": "1"}).sensors()
    with pytest.raises(NergError, match="Eve"):
        write_scene([tmp_path / "shop.rays"], tmp_path / "b.xml", SceneOptions(person="Eve", time=1.0))


def test_a_name_that_is_taken_by_a_folder(tmp_path):
    write_dataset(tmp_path, files=1)
    (tmp_path / "a.rays.npz").mkdir()
    with pytest.raises(NergError, match=r"a\.rays\.npz"):
        scene.check_rays(tmp_path / "shop.rays", tmp_path / "a.xml")
