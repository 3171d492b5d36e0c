"""What files are, by what is in them, and what goes together."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene_writer import document
from nerg_mi.train.geometry import file_identity
from nerg_mi.workflows.scene_places import kind_of_file, place_of_files, recognise
from tests.formats.splats.writers import random_splats, write_inria
from tests.workflows.recorder import Recorder

ONE = {"a": np.zeros(1, np.float32)}


def rays(hit):
    end = None if not hit else [[2.0, 0, 0]]
    return Rays([0.0], [0], ("a",), [[0.0, 0, 0]], [[1.0, 0, 0]], [1.0], end)


@pytest.fixture
def folder(tmp_path):
    write_checkpoint(tmp_path / "field.safetensors", "radiance", ONE, {"provenance": {"up": [0, 0, 1]}})
    place = {"field_file": file_identity(tmp_path / "field.safetensors")}
    align = np.diag([2.0, 2, 2, 1]).tolist()
    write_checkpoint(tmp_path / "gaze.safetensors", "gaze", ONE, {"provenance": {**place, "align": align}})
    write_checkpoint(tmp_path / "nowhere.safetensors", "gaze", ONE, {"provenance": {"geometry": "none"}})
    write_checkpoint(tmp_path / "odd.safetensors", "sound", ONE, {})
    rays(True).save(tmp_path / "hits.npz")
    rays(False).save(tmp_path / "rays.npz")
    for name in ("a.ply", "a.obj", "a.xml", "a.vol", "a.pth", "a.jpg"):
        (tmp_path / name).write_text("x")
    return tmp_path


def test_kinds(folder):
    kinds = {
        "field.safetensors": "field",
        "gaze.safetensors": "gaze",
        "rays.npz": "rays",
        "a.ply": "mesh",
        "a.obj": "mesh",
        "a.xml": "scene",
        "a.vol": "hits",
    }
    assert {name: kind_of_file(folder / name) for name in kinds} == kinds
    for name, said in (
        ("odd.safetensors", "holds a sound field"),
        ("a.pth", 'make fields of it with "nerg import"'),
        ("a.jpg", "is none of these"),
        ("a.png", "there is no file"),
    ):
        with pytest.raises(NergError, match=said):
            kind_of_file(folder / name)


def test_splats_are_a_field_and_a_mesh_is_not(folder):
    write_inria(folder / "place.ply", random_splats(3))
    given = recognise([folder / "place.ply", folder / "nowhere.safetensors"], None, Recorder())
    assert given.kind == "field" and given.field_about == {}
    place = place_of_files(given, folder / "scene.xml")
    (volume,) = place.make(folder, {}).inside
    assert place.words == "The Gaussian splats place.ply" and 'type="splats"' in document([volume], "h")
    assert kind_of_file(folder / "a.ply") == "mesh"


def test_the_place_of_a_gaze_field_is_beside_it(folder):
    given = recognise([folder / "gaze.safetensors"], None, Recorder())
    assert (given.kind, given.place) == ("field", folder / "field.safetensors")
    assert given.align.scale == pytest.approx(2) and given.field_about["provenance"] == {"up": [0, 0, 1]}
    assert recognise([folder / "nowhere.safetensors"], None, Recorder()).kind == "none"
    (folder / "field.safetensors").rename(folder / "moved.safetensors")
    with pytest.raises(NergError, match="does not exist; put"):
        recognise([folder / "gaze.safetensors"], None, Recorder())
    told = Recorder()
    given = recognise([folder / "gaze.safetensors", folder / "moved.safetensors"], None, told)
    assert given.place == folder / "moved.safetensors" and not told.warnings


def test_another_place_is_warned_of(folder):
    for gaze, said in (("gaze", "in another file than"), ("nowhere", "without a place")):
        told = Recorder()
        recognise([folder / "a.ply", folder / f"{gaze}.safetensors"], None, told)
        assert said in told.warnings[0]


def test_rays_alone(folder):
    kind = lambda name, geometry=None: recognise([folder / name], geometry, Recorder()).kind
    assert (kind("hits.npz"), kind("rays.npz"), kind("hits.npz", "none")) == ("hits", "none", "none")


def test_provenance_is_not_believed(folder):
    for about in ({"field_file": {"file": "a.ply", "sha256": "0"}}, {}):
        write_checkpoint(folder / "b.safetensors", "gaze", ONE, {"provenance": json.loads(json.dumps(about))})
        with pytest.raises(NergError, match="nerg scene PLACE GAZE"):
            recognise([folder / "b.safetensors"], None, Recorder())
