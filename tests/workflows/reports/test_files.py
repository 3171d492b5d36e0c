"""What files are, found from the files: in any order, in folders, and what makes no report."""

from __future__ import annotations

import json
import shutil

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.workflows.report import place_words, sort_files
from tests.evaluation.gaze.test_evaluation import crowd
from tests.formats.splats.writers import random_splats, write_inria


@pytest.fixture(scope="module")
def folder(standins, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    for file in standins.values():
        shutil.copy(file, folder)
    crowd(100).save(folder / "rays.npz")
    (folder / "gaze.eval").mkdir()
    (folder / "gaze.eval" / "gaze.json").write_text("{}")
    (folder / "notes.txt").write_text("nothing of ours")
    return folder


def test_in_any_order_and_in_folders(folder):
    files = [folder / n for n in ("shoppers.safetensors", "store.safetensors", "rays.npz", "gaze.eval")]
    for given in (files, files[::-1], [folder], [*files[:2], files[2], files[3] / "gaze.json"]):
        found = sort_files(given)
        assert found.gaze == files[0] and found.scene.place == files[1] and found.rays == files[2]
        assert found.results == (files[3] / "gaze.json",) and found.scene.kind == "field"
        assert found.shown == [files[1], files[0]]


def test_inputs_have_their_checksums(folder):
    roles = {role: digest for role, _, digest in sort_files([folder]).inputs()}
    assert roles["rays"] == file_sha256(folder / "rays.npz") and roles["radiance field"] != roles["gaze field"]
    assert set(roles) == {"gaze field", "radiance field", "rays", "evaluation"}


def test_splats_are_called_so(folder, tmp_path):
    write_inria(tmp_path / "place.ply", random_splats(5))
    found = sort_files([folder / "shoppers.safetensors", tmp_path / "place.ply"])
    assert found.inputs()[1][0] == "splats" and place_words(found) == "Gaussian splats, place.ply."
    assert place_words(sort_files([folder])).startswith("A radiance field")


def test_what_makes_no_report(folder, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    shutil.copy(folder / "shoppers.safetensors", tmp_path / "again.safetensors")
    cases = [
        ([folder / "rays.npz"], "there is none among these files; name its checkpoint"),
        ([folder / "nowhere"], "there is no file or folder"),
        ([empty], "holds no checkpoint, rays or evaluation"),
        ([folder, tmp_path / "again.safetensors"], "are both a gaze; a report is of one of them"),
        ([folder, folder / "notes.txt"], "is none of these"),
    ]
    for given, why in cases:
        with pytest.raises(NergError, match=why):
            sort_files(given)


def test_what_is_named_twice_is_one(folder):
    assert sort_files([folder, folder / "shoppers.safetensors"]).gaze == folder / "shoppers.safetensors"
    assert json.loads((folder / "gaze.eval" / "gaze.json").read_text()) == {}
