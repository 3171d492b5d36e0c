"""Places of jobs: one of each kind, found again for an evaluation, and alignments read from files."""

from __future__ import annotations

import json
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError
from nerg_mi.workflows.gaze_commands import GazeEvaluationOptions
from nerg_mi.workflows.geometry import make_place, place_of_training
from nerg_mi.workflows.options import PlaceOptions
from tests.plugins import fields
from tests.train.gaze.looks import BOX, around, looking_at

WALL = '<scene version="3.0.0"><shape type="cube"/></scene>'


@pytest.fixture
def rays():
    return looking_at((1.5, 0.4, 1.2))


def made(folder, kind, rays):
    """A place of a ``kind``, whose files are in ``folder``."""
    if kind == "field":
        fields.radiance(folder / "place.safetensors")
    (folder / "place.xml").write_text(WALL)
    options = {
        "field": PlaceOptions(field=folder / "place.safetensors"),
        "scene": PlaceOptions(scene=folder / "place.xml"),
        "hits": PlaceOptions(geometry="hits"),
        "none": PlaceOptions(geometry="none"),
    }[kind]
    return make_place(options, rays, (), folder / "place.vol", ns, voxel=0.2)


@pytest.mark.parametrize("kind", ["field", "scene", "hits", "none"])
def test_a_place_is_found_again_where_its_checkpoint_is(rays, tmp_path, kind):
    place = made(tmp_path, kind, rays)
    assert place.kind == kind and (place.radiance is not None) == (kind == "field")
    matrix = np.diag([2.0, 2, 2, 1])
    provenance = json.loads(json.dumps(place.about)) | {"align": matrix.tolist()}
    again = place_of_training(tmp_path / "gaze.safetensors", provenance, BOX, GazeEvaluationOptions(), ns)
    assert again.kind == kind and again.align.scale == pytest.approx(2)
    assert again.box == (BOX if kind == "none" else place.box)
    if kind == "none":
        return
    option = {"field": "field", "scene": "scene", "hits": "geometry"}[kind]
    elsewhere = GazeEvaluationOptions(**{option: tmp_path / "other"})
    with pytest.raises(NergError, match=f"does not exist; say where it is with --{option}"):
        place_of_training(tmp_path / "gaze.safetensors", provenance, BOX, elsewhere, ns)
    (tmp_path / "other").write_bytes(b"something else")
    with pytest.raises(NergError, match=f"is not the file .* give that one with --{option}"):
        place_of_training(tmp_path / "gaze.safetensors", provenance, BOX, elsewhere, ns)


def test_a_checkpoint_that_does_not_say_where_it_was_trained():
    with pytest.raises(NergError, match="does not say"):
        place_of_training(Path("gaze.safetensors"), {}, BOX, GazeEvaluationOptions(), ns)


def test_without_geometry_the_box_holds_whoever_looked(rays):
    views = around(5)
    for given, seen in ((rays, ()), (None, views), (rays, views)):
        place = make_place(PlaceOptions(geometry="none"), given, seen, None, ns)
        eyes = np.concatenate(([given.origin] if given else []) + [v.camera.center[None] for v in seen])
        np.testing.assert_allclose(place.box.lower, eyes.min(axis=0) - 2)
    with pytest.raises(NergError, match="made of rays and written"):
        make_place(PlaceOptions(geometry="hits"), None, views, None, ns)


def test_a_similarity_is_four_rows_of_a_file(tmp_path):
    path = tmp_path / "align.json"
    path.write_text(json.dumps(np.diag([3.0, 3, 3, 1]).tolist()))
    assert read_similarity(path, "--align", "rays to field").scale == pytest.approx(3)
    for wrong in ("[1, 2]", '{"a": 1}', json.dumps(np.diag([3.0, 2, 3, 1]).tolist())):
        path.write_text(wrong)
        with pytest.raises(NergError, match=r"--align-views.*align\.json"):
            read_similarity(path, "--align-views", "photos to field")
