"""Ensembles of gaze fields: what fits together, their arrays, their file."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.fields import gaze_base
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.fields.gaze_ensemble import GazeEnsemble
from nerg_mi.fields.gaze_log_density import LogGazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.maths.geometry import Box
from tests.fields.gaze.test_log_density import SMALL, made


def test_members_are_alike():
    with pytest.raises(ValueError, match="at least two"):
        GazeEnsemble([made()])
    other_box = LogGazeField.random(SMALL, Box((0, 0, 0), (1, 1, 1)), namespace("llvm"))
    for other in (made(replace(SMALL, variant="emit")), made(replace(SMALL, escaped="nearest")), other_box):
        with pytest.raises(ValueError, match="train them alike"):
            GazeEnsemble([made(), other])
    # Where people's heads were is each member's own.
    GazeEnsemble([made(), made(replace(SMALL, heads=((0, 0, 1), (1, 1, 2))))])


def test_arrays_are_the_members():
    ensemble = GazeEnsemble([made(seed=1), made(seed=2)])
    before = {k: np.array(v) for k, v in ensemble.parameters().items()}
    assert len(before) == 2 * len(made().parameters()) and not np.array_equal(
        before["0.grid.table"], before["1.grid.table"]
    )
    ensemble.set_parameters({"1.grid.table": ensemble.parameters()["1.grid.table"] * 0})
    after = {k: np.array(v) for k, v in ensemble.parameters().items()}
    assert not after["1.grid.table"].any()
    assert all(np.array_equal(before[k], after[k]) for k in before if k != "1.grid.table")


@pytest.mark.parametrize("half", [False, True])
def test_a_file_holds_all_members_and_the_support(half, tmp_path):
    """Counts and places are never rounded to fp16."""
    members = [made(seed=1), made(replace(SMALL, heads=((0, 0, 1), (1, 1, 2))), seed=2)]
    support = RaySupport.of(np.random.default_rng(0).uniform(0, 9, (5000, 3)), 0.25)
    save_gaze(GazeEnsemble(members, support), tmp_path / "g.safetensors", {"made": "here"}, half)
    again, meta = load_gaze(tmp_path / "g.safetensors", namespace("llvm"))
    assert meta["provenance"] == {"made": "here"} and meta["output"] == {"activation": "log", "normalized": True}
    assert [m.config for m in again.members] == [m.config for m in members] and again.box == members[0].box
    for name, value in GazeEnsemble(members).parameters().items():
        np.testing.assert_allclose(
            np.array(again.parameters()[name]), np.array(value), rtol=1e-3 if half else 0, atol=1e-3 if half else 0
        )
    np.testing.assert_array_equal(again.support.cells, support.cells)
    assert again.support.radius == 0.25


def test_a_single_field_keeps_its_support_too(tmp_path):
    field = made()
    save_gaze(field, tmp_path / "plain.safetensors", {})
    field.support = RaySupport.of([[1.0, 2, 3]], 0.5)
    save_gaze(field, tmp_path / "g.safetensors", {})
    assert load_gaze(tmp_path / "plain.safetensors", namespace("llvm"))[0].support is None
    assert load_gaze(tmp_path / "g.safetensors", namespace("llvm"))[0].support.cells.shape == (1, 5)


def test_ensembles_of_ensembles_are_refused(tmp_path):
    """When they are made, and in a file, however deep they lie in one another."""
    pair = GazeEnsemble([made(seed=1), made(seed=2)])
    for members in ([pair, pair], [made(), pair]):
        with pytest.raises(ValueError, match="give its members instead"):
            GazeEnsemble(members)
    about = pair.architecture()
    for _ in range(500):
        about = {"kind": "ensemble", "members": [about, about]}
    with pytest.raises(ValueError, match="is an ensemble itself, which this version does not read"):
        gaze_base.build(about, pair.box, NoArrays())


class NoArrays:
    """Arrays of a file that has none."""

    def member(self, index, about):
        return about, self
