"""The study of scenes with gaze fields of every kind: the default recipe's is normalised over the observer's sphere."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.evaluation import study_truth as study_shapes
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.train.gaze_data import box_exit
from nerg_mi.workflows.study import StudyOptions, run_study
from tests.evaluation.gaze_fields import KINDS, saved

BOX = Box((-3, -3, -3), (3, 3, 3))
SCENE = """<scene version="3.0.0">
  <integrator type="nerg">
    {medium}<volume name="gaze" type="gazefield"><string name="filename" value="gaze.safetensors"/></volume>
    <sensor name="observer" type="perspective">
      <transform name="to_world"><lookat origin="-2, 1, 1" target="0, 0, 0" up="0, 0, 1"/></transform></sensor>
    <float name="falloff" value="0.3"/><string name="aovs" value="depth,opacity,gaze,visibility"/>
  </integrator>
  <sensor type="perspective"><float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="1, -4, 2" target="0, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><rfilter type="box"/>
      <string name="component_format" value="float32"/>
      <string name="pixel_format" value="rgb"/></film></sensor>
  {shapes}
</scene>"""
SHAPES = """<shape type="cube"><transform name="to_world">
    <rotate x="0.3" y="1" z="0.5" angle="40"/><scale value="0.6"/></transform></shape>
  <shape type="cube"><transform name="to_world"><scale x="3" y="3" z="0.1"/><translate z="-1.2"/></transform></shape>"""
MEDIUM = """<volume name="density" type="constvolume"><float name="value" value="400"/>
    <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/></transform></volume>"""


def scene(folder, kind: str, shapes: bool):
    path = folder / "scene.xml"
    path.write_text(SCENE.format(medium="" if shapes else MEDIUM, shapes=SHAPES if shapes else ""))
    saved(folder / "gaze.safetensors", kind, BOX)
    return path


@pytest.mark.parametrize("kind", KINDS)
def test01_shapes_agree_with_their_reference(rgb, tmp_path, kind):
    subject = open_subject(str(scene(tmp_path, kind, True)), "auto", 24, 16)
    seen = subject.channels(subject.integrator(), 1, 1)
    known = subject.truth(1, "median", "depth")
    assert np.ptp(known.gaze) > 1e-2
    off = np.abs(seen["gaze"] - known.gaze) > 1e-3 * known.gaze.max()
    assert off.mean() < 0.01


@pytest.mark.parametrize("kind", ["normalised", "default recipe"])
def test02_the_integral_is_that_of_exact_geometry(rgb, tmp_path, kind):
    """The reference takes the integrator's integral; here it is found again, by float64 intersections with the
    triangles."""
    subject = open_subject(str(scene(tmp_path, kind, True)), "auto", 8, 8)
    eye = subject.eye()
    observed = study_shapes.observed_gaze(subject, eye)
    field = subject.integrator().gaze.field
    d = fibonacci_directions(4096)
    t = study_shapes.first_hit(subject.corners, np.broadcast_to(eye, d.shape), d)
    escaped = np.isinf(t)
    t[escaped] = box_exit(BOX, np.broadcast_to(eye, d.shape)[escaped], d[escaped])
    assert 0.1 < escaped.mean() < 0.9
    points = lambda kind, v: kind(np.ascontiguousarray(np.broadcast_to(v, d.shape).T, np.float32))
    emit, capture = field.unnormalized(
        points(rgb.Point3f, eye + d * t[:, None]),
        points(rgb.Point3f, eye),
        points(rgb.Vector3f, d),
        True,
        escaped=rgb.Bool(escaped),
    )
    expected = 4 * np.pi * np.array(emit * capture, float).mean()
    assert float(observed.integrals(rgb.Point3f(*eye.tolist()))[0][0]) == pytest.approx(expected, rel=3e-3)


@pytest.mark.nightly
@pytest.mark.parametrize("shapes", [True, False], ids=["shapes", "medium"])
def test03_the_study_of_a_default_recipe(rgb, tmp_path, shapes):
    path = scene(tmp_path, "default recipe", shapes)
    only = "transmittance" if shapes else "paper, 64 steps$|jitter"
    options = StudyOptions(width=12, height=8, quick=True, only=only, mode="llvm_ad_rgb")
    report = run_study(path, tmp_path / "out", options).report
    rows = {r["setting"]: r for r in report["rows"]}
    assert len(rows) >= 2 and all(r["gaze_mae"] < 0.05 and np.isfinite(r["gaze_kld"]) for r in rows.values())
    assert rows["default"]["gaze_mae"] < 1e-3


@pytest.mark.parametrize("kind", ["default recipe", "ensemble"])
def test04_the_papers_marching_is_divided_by_the_same_integral(rgb, tmp_path, kind):
    """In an opaque box both rules meet the same surfaces; what they say of them is then the same density."""
    from nerg_mi.evaluation.study import as_in_the_paper

    subject = open_subject(str(scene(tmp_path, kind, False)), "auto", 24, 16)
    made = subject.integrator({"aovs": "depth,opacity,gaze,visibility,gaze_evals", "depth": "expected"})
    # First: afterwards the field would face the observer whatever the paper's marching does.
    theirs = subject.channels(as_in_the_paper(made, subject.sensor, subject.tolerance, 4096), 1, 1)
    ours = subject.channels(made, 1, 1)
    both = (ours["visibility"] > 0.8) & (theirs["visibility"] > 0.8) & (ours["opacity"] > 0.99)
    assert both.sum() > 10
    attended = lambda seen: seen["gaze"][both] / seen["visibility"][both]
    np.testing.assert_allclose(attended(theirs), attended(ours), rtol=0.05)
    assert (theirs["gaze_evals"][both] == (4 if kind == "ensemble" else 2)).all()
