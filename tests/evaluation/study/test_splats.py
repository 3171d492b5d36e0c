"""Gaussian splats as a subject of a study: what is set of them, and what they are compared with."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.evaluation import study_truth
from nerg_mi.evaluation.study import measure, settings
from nerg_mi.evaluation.study_subject import extent, open_subject
from nerg_mi.formats.splats import write_ply_splats
from tests.formats.splats.writers import random_splats

SCENE = """<scene version="3.0.0"><integrator type="nerg"><volume name="field" type="splats">
    <string name="filename" value="a.ply"/><string name="color_space" value="linear"/>
    <transform name="to_world"><rotate x="1" angle="30"/><scale value="2"/></transform></volume></integrator>
  <sensor type="perspective"><transform name="to_world"><lookat origin="0, 0, -8" target="0, 0, 0" up="0, 1, 0"/>
    </transform><film type="hdrfilm"><rfilter type="box"/></film></sensor></scene>"""


@pytest.fixture
def subject(rgb, tmp_path):
    write_ply_splats(tmp_path / "a.ply", random_splats(30, degree=0))
    (tmp_path / "scene.xml").write_text(SCENE)
    return open_subject(str(tmp_path / "scene.xml"), "auto", 12, 8)


def test_a_field_is_cut_off_elsewhere_and_else_the_same(subject):
    first, other = subject.integrator(), subject.integrator({"extent": 5.0})
    assert extent(first) == 3 and extent(other) == 5
    assert np.allclose(other.medium.to_world.matrix, first.medium.to_world.matrix, atol=1e-6)
    assert other.medium.color_space == "linear" and other.medium.arrays.count == 30
    assert study_truth.cut_off({"stop": 0.5}) == {"stop": 0.5}


@pytest.mark.nightly
def test_settings_that_gaussians_know_buy_error_with_time(subject):
    rows = [r for r in settings(subject) if r.group in ("default", "stop", "extent")]
    assert {r.group for r in settings(subject)} >= {"stop", "extent", "depth", "visibility", "together"}
    assert not {r.group for r in settings(subject)} & {"coarse", "paper", "dt_gamma"}
    rows = [r for r in rows if r.name in ("default", "extent 2", "extent 5")]
    found = {row["setting"]: row for row in measure(subject, rows, 1, 4)}
    error = {name: row["color_rmse"] for name, row in found.items()}
    assert error["extent 5"] < 0.1 * error["default"] and error["default"] < 0.3 * error["extent 2"]
    assert found["extent 2"]["density_evals"] < found["extent 5"]["density_evals"]
    assert found["extent 2"]["extent"] == 2 and found["default"]["steps"] == ""
    assert subject.truth(1, "median", "depth").convergence["depth_mae"] < 1e-4
