"""Tests of `nerg_mi.alignment.check`."""

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.alignment.check import AlignmentCheck, check_alignment, record_fit
from nerg_mi.alignment.constraints import AlignmentFit
from nerg_mi.errors import NergError
from nerg_mi.formats.alignments import Interval, read_similarity
from nerg_mi.maths.geometry import Similarity
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.alignment import rooms

mi.set_variant("llvm_ad_rgb")
RAYS = rooms.people(600)


def moved(x, y, z):
    m = np.diag([2.0, 2, 2, 1])
    m[:3, 3] = np.array([x, y, z]) * 2
    return Similarity(m)


@pytest.fixture(scope="module")
def room():
    """The room at twice its size: shapes, and a floor that is the bottom of a box."""
    cube = lambda low, high: {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate(list(low + high)).scale(list(high - low)),
    }
    blocks = {f"b{k}": cube(low, high) for k, (low, high) in enumerate(rooms.BOXES)}
    scene = mi.load_dict({"type": "scene", "room": cube(np.zeros(3), rooms.SIZE), **blocks})
    return SceneGeometry(None, scene)


def test_correct_alignment_has_no_warnings(room):
    result = check_alignment(room, RAYS, moved(0, 0, 0))
    assert result == AlignmentCheck(0.0, 0.0, 0.0) and not result.list_warnings() and not result.is_impossible


def test_wrong_alignments_are_reported(room):
    assert check_alignment(room, RAYS, moved(100, 0, 0)).is_impossible
    below = check_alignment(room, RAYS, moved(0, 0, -2.0))
    assert below.below > 0.9 and "below the floor" in " ".join(below.list_warnings())


def test_heads_inside_a_medium_are_reported():
    solid = VolumeMedium(
        mi.load_dict({"type": "constvolume", "value": 500.0, "to_world": mi.ScalarTransform4f().scale([9, 9, 9])})
    )
    result = check_alignment(solid, RAYS, moved(0, 0, 0))
    assert result.inside > 0.9 and "inside solid objects" in " ".join(result.list_warnings())


def test_no_samples_give_no_warnings(room):
    assert check_alignment(room, RAYS.select(np.zeros(len(RAYS), bool)), moved(0, 0, 0)).list_warnings() == []


def test_negated_axis_is_reported():
    """A wall on one side, participants who look at it, and their mirror image."""
    place = mi.ScalarTransform4f().translate([20, 0, 0]).scale([0.1, 60, 60])
    wall = SceneGeometry(None, mi.load_dict({"type": "scene", "wall": {"type": "cube", "to_world": place}}))
    rays = replace(RAYS, direction=np.tile([0.8, 0.6, 0.0], (len(RAYS), 1)))
    assert check_alignment(wall, rays, moved(0, 0, 0)) == AlignmentCheck(0.0, 0.0, 0.0)
    mirrored = check_alignment(wall, replace(rays, direction=rays.direction * (-1, 1, 1)), moved(0, 0, 0))
    assert "with x of the directions negated" in mirrored.list_warnings()[-1] and mirrored.escaped > 0.9


# ---- The record of an alignment ----


def test_undetermined_alignments_are_reported_when_they_are_read(tmp_path):
    path, doubts = tmp_path / "alignment.json", []
    for turn in ((-4.0, 5.0), (-50.0, 130.0)):
        fit = AlignmentFit(np.eye(4), np.zeros(0), np.zeros(0), interval=Interval(turn, (1.0, 1.02), 0.4))
        result = record_fit("tracking", fit, {}, False)
        assert result.residuals["median_cm"] is None
        result.save(path)
        read_similarity(path, "--align", "rays to field", doubts.append)
    (doubt,) = doubts
    assert str(path) in doubt and "+130" in doubt and "turn" in doubt
    stored = json.loads(path.read_text())
    assert stored["uncertainty"] == {
        "level": 0.95,
        "turn_degrees": [-50, 130],
        "scale": [1, 1.02],
        "shift_cm": pytest.approx(40),
    }
    stored["uncertainty"]["scale"] = "wide"
    path.write_text(json.dumps(stored))
    with pytest.raises(NergError, match="not an interval"):
        read_similarity(path, "--align", "rays to field")


def written(path):
    fit = AlignmentFit(
        np.diag([2.0, 2, 2, 1]),
        np.arange(5.0),
        np.array([1.0, np.nan]),
        np.diag([1e-4] * 3 + [4e-4] * 3 + [1e-4]),
        metadata={"pairs": 5},
    )
    result = record_fit("pairs", fit, {"rays": {"file": "a.npz", "sha256": "00"}}, False)
    result.save(path)
    return result


def test_record_is_read_by_every_command(tmp_path):
    path = tmp_path / "alignment.json"
    result = written(path)
    assert read_similarity(path, "align", "rays to field").scale == pytest.approx(2)
    metadata = json.loads(path.read_text())
    assert metadata["evidence"] == {"kind": "pairs", "pairs": 5} and metadata["residuals"]["median_cm"] == 2
    assert metadata["uncertainty"]["cm"] == pytest.approx(100 * np.sqrt(12e-4) / 2)
    assert metadata["uncertainty"]["scale_percent"] == pytest.approx(1) and result.residuals["median_degrees"] == 1
    assert metadata["uncertainty"]["degrees"] == pytest.approx(np.degrees(np.sqrt(3e-4)))


@pytest.mark.parametrize(
    "change, why",
    [
        ({"version": 99}, "version 99"),
        ({"version": True}, "version True"),
        ({"kind": "x"}, "neither that"),
        ({"matrix": [[1, 2]]}, "align"),
        ({"matrix": np.diag([1.0, 2, 1, 1]).tolist()}, "align"),
    ],
)
def test_invalid_files_are_refused(tmp_path, change, why):
    path = tmp_path / "alignment.json"
    written(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(NergError, match=why):
        read_similarity(path, "--align", "rays to field")
