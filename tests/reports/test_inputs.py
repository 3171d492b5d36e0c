"""Inputs of a report, recognised by their content: in any order, in folders, in memory, and unusable ones."""

from __future__ import annotations

import shutil

import pytest

from nerg_mi.environment.gaze import GazeField
from nerg_mi.errors import NergError
from nerg_mi.evaluation.held_out import GazeEvaluation
from nerg_mi.files.atomic import file_sha256
from nerg_mi.reports.inputs import open_evaluations, open_inputs
from nerg_mi.tracking.rays import Rays
from tests.evaluation.test_gaze import crowd
from tests.evaluation.test_gaze_report import scored


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


def test_inputs_are_sorted_in_any_order_and_in_folders(folder):
    files = [folder / n for n in ("shoppers.safetensors", "store.safetensors", "rays.npz", "gaze.eval")]
    for paths in (files, files[::-1], [folder], folder, [str(path) for path in files]):
        inputs = open_inputs(paths)
        assert inputs.gaze.path == files[0] and inputs.environment == files[1] and inputs.rays == files[2]
        assert inputs.evaluations == (files[3] / "gaze.json",)


def test_files_that_make_no_report_are_refused(folder, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    shutil.copy(folder / "shoppers.safetensors", tmp_path / "again.safetensors")
    cases = [
        ([folder / "rays.npz"], "there is none among these inputs; name its checkpoint"),
        ([folder / "nowhere"], "there is no file or folder"),
        ([empty], "contains no checkpoint, rays or evaluation"),
        ([folder, tmp_path / "again.safetensors"], "are both gaze fields; give one"),
        ([folder, folder / "notes.txt"], "cannot be shown in a scene"),
    ]
    for paths, why in cases:
        with pytest.raises(NergError, match=why):
            open_inputs(paths)


def test_duplicate_files_are_used_once(folder):
    assert open_inputs([folder, folder / "shoppers.safetensors"]).gaze.path == folder / "shoppers.safetensors"


def test_inputs_in_memory(folder):
    gaze, rays = GazeField.open(folder / "shoppers.safetensors"), Rays.load(folder / "rays.npz")
    evaluation = GazeEvaluation(list(scored((0.9, 0.85, 0.3))), [], "pos", 60, 30, [])
    inputs = open_inputs([evaluation, rays, gaze])
    assert inputs.gaze is gaze and inputs.load_rays() is rays and inputs.evaluations == (evaluation,)
    (results,), doubts = open_evaluations(inputs)
    assert (results.split, results.num_positions, doubts) == ("pos", 60, [])
    assert results.sha256 == file_sha256(folder / "shoppers.safetensors")
    with pytest.raises(NergError, match="are both rays"):
        open_inputs([gaze, rays, folder / "rays.npz"])
    with pytest.raises(NergError, match="got int"):
        open_inputs([gaze, 3])
