"""Tests of `nerg_mi.evaluation.study_subject`."""

from __future__ import annotations

import re

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation import study, study_run, study_scenes, study_subject
from nerg_mi.evaluation import study_truth as study_shapes
from nerg_mi.evaluation.study_subject import open_subject, read_parameters
from nerg_mi.fields.compilation import bound_voxel_bytes
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.train.gaze_data import compute_box_exit
from tests.evaluation.gaze_fields import KINDS, saved
from tests.plugins import fields
from tests.reference import march_numpy

# ---- The settings of an integrator as they are read back ----

NONE_OF_A_STUDY = {"aovs", "ceiling", "up"}


def test_settings_round_trip(rgb):
    options = {
        "occlusion": False,
        "radiance": False,
        "jitter": True,
        "step": 0.25,
        "dt_gamma": 0.125,
        "stop": 0.5,
        "color_cutoff": 0.25,
        "quadrature": "linear",
        "coarse": 2.0,
        "refined": False,
        "falloff": 0.75,
        "depth": "expected",
        "surface_opacity": 0.25,
        "visibility": "transmittance",
        "tolerance": 0.5,
        "map_height": 64,
        "directions": 4096,
        "integral_tolerance": 0.125,
        "headlight": 0.25,
        "background": [0.25, 0.5, 0.75],
    }
    density = {"type": "constvolume", "value": 3.0}
    first = rgb.load_dict({"type": "nerg", "density": density, **options})
    result = read_parameters(first)
    assert result == options
    assert read_parameters(rgb.load_dict({"type": "nerg", "density": density, **result})) == options
    # All parameters of the manual page are read.
    rows = re.findall(r"^ \* - ([\w, ]+)\n   - (?!:paramtype)", type(first).__doc__, re.MULTILINE)
    named = {name for row in rows for name in row.split(", ")}
    assert named - NONE_OF_A_STUDY == set(options) and NONE_OF_A_STUDY < named and np.isfinite(result["step"])


# ---- Subjects of a study: their surfaces, and the reference of a scene file ----

SCENE = """<scene version="3.0.0">
  <integrator type="nerg"><volume name="density" type="constvolume"><float name="value" value="40"/></volume>
    <sensor name="observer" type="perspective">
      <transform name="to_world"><lookat origin="{eye}" target="0.5, 0.5, 0.5" up="0, 0, 1"/></transform></sensor>
  </integrator>
  <sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="2.5, -1.5, 1.8" target="0.5, 0.5, 0.5" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><rfilter type="box"/><string name="component_format" value="float32"/></film></sensor>
</scene>"""

# The unit cube, which the medium fills.
TWIN = """<scene version="3.0.0"><shape type="cube">
  <transform name="to_world"><scale value="0.5"/><translate x="0.5" y="0.5" z="0.5"/></transform></shape></scene>"""


def test_the_twin_has_exact_visibility(rgb, tmp_path):
    eye = np.array([-2.0, -1.0, 3.0])
    (tmp_path / "scene.xml").write_text(SCENE.format(eye=", ".join(map(str, eye))))
    (tmp_path / "twin.xml").write_text(TWIN)
    subject = open_subject(str(tmp_path / "scene.xml"), "auto", 24, 16, surfaces=study_run.find_reference_scene)
    assert np.allclose(subject.observer_position(), eye)
    t, visible = subject.find_exact_hits(1)
    o, d = subject.record_rays(1)
    hit = np.isfinite(t)
    p = o[hit] + d[hit] * t[hit, None]
    face = np.argmax(np.abs(p - 0.5), axis=1)
    assert 50 < hit.sum() < hit.size and np.allclose(np.abs(p - 0.5).max(axis=1), 0.5, atol=1e-5)
    # A convex body hides its back faces: of the three in the picture x = 1, for an observer at x < 0.
    assert set(face) == {0, 1, 2} and np.array_equal(visible[hit], face != 0) and not visible[~hit].any()


def test_first_solid_matches_geometry():
    subject = open_subject("sphere", "auto", 24, 16)
    t, visible = subject.find_exact_hits(1)
    o, d = subject.record_rays(1)
    hit = np.isfinite(t)
    center, radius = study_scenes.SPHERE_CENTER, study_scenes.SPHERE_RADIUS
    p = o[hit] + d[hit] * t[hit, None]
    normal = (p - center) / radius
    assert hit.any() and np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-6)
    # A convex body hides its back faces from an observer.
    towards = np.asarray(subject.analytic.observer) - p
    assert np.array_equal(visible[hit], (towards * normal).sum(-1) > 0) and 0 < visible[hit].mean() < 1
    assert not visible[~hit].any() and open_subject("fog", "auto", 4, 4).find_exact_hits(1) is None


def test_a_scene_file_is_compared_with_its_limit(rgb, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text("""<scene version="3.0.0">
      <integrator type="nerg">
        <volume name="density" type="constvolume"><float name="value" value="4"/></volume></integrator>
      <sensor type="perspective"><float name="fov" value="30"/>
        <transform name="to_world"><lookat origin="0.5, 0.5, -2" target="0.5, 0.5, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="99"/><rfilter type="box"/>
          <string name="component_format" value="float32"/></film>
      </sensor></scene>""")
    subject = open_subject(str(path), "auto", 12, 8)
    truth = subject.get_truth(1, "median", "depth")
    assert truth.depth.shape == (96,) and not subject.has_gaze and subject.find_exact_hits(1) is None
    o, d = subject.record_rays(1)
    slab = study_scenes.SCENES["slab"]
    for i in range(0, 96, 13):
        hit = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        median = 0 if hit is None else march_numpy.slab(4.0, *hit)[2]
        assert abs(truth.depth[i] - median) < 1e-5
    assert slab.name == "slab" and truth.convergence["depth_mae"] < 1e-5
    full = path.read_text()
    bad = (
        full.replace('<integrator type="nerg">', '<integrator type="path">')
        .replace("<volume", "<!--")
        .replace("</volume>", "-->")
    )
    path.write_text(bad)
    with pytest.raises(ValueError, match='is not "nerg"'):
        open_subject(str(path), "file", 12, 8)
    path.write_text(
        full.replace('<integrator type="nerg">', '<integrator type="nerg"><float name="ceiling" value="1"/>')
    )
    with pytest.raises(ValueError, match='has a "ceiling"'):
        open_subject(str(path), "file", 12, 8)


PLACED_FIELD = """<scene version="3.0.0">
  <integrator type="nerg"><volume name="field" type="nerf"><string name="filename" value="field.safetensors"/>
    <transform name="to_world"><rotate z="1" angle="30"/><scale value="1.5"/></transform></volume></integrator>
  <sensor type="perspective"><float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="1, -5, 2" target="0, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><rfilter type="box"/><string name="component_format" value="float32"/></film></sensor>
</scene>"""


def test_a_compiled_field_is_a_row_in_the_place_of_its_field(rgb, tmp_path, monkeypatch):
    monkeypatch.setattr(study_subject, "VOXEL_RESOLUTIONS", (16, 32))
    fields.radiance(tmp_path / "field.safetensors", density_scale=20.0)
    (tmp_path / "scene.xml").write_text(PLACED_FIELD)
    subject = open_subject(str(tmp_path / "scene.xml"), "auto", 24, 16)
    compiled = [row for row in study.list_rows(subject) if row.voxels]
    assert {row.voxels for row in compiled} == {16, 32} == set(subject.voxel_resolutions)
    rows = [study.StudyRow("default", "default"), *(row for row in compiled if "," not in row.name)]
    default, coarse, fine = study.measure_rows(subject, rows, 1)
    assert default["depth_mae"] < fine["depth_mae"] < coarse["depth_mae"] < 0.2
    assert fine["depth_median"] < fine["depth_p99"] and fine["color_rmse"] < 0.05
    assert 0 < coarse["voxels_mb"] < fine["voxels_mb"] and "voxels_mb" not in default
    for row in (coarse, fine):
        assert 1e6 * row["voxels_mb"] <= bound_voxel_bytes(subject.base_params["field"].field, row["voxels"])
    # Voxels that would not fit into the memory are no rows.
    monkeypatch.setattr(study_subject, "_MAX_VOXEL_BYTES", 1e6 * coarse["voxels_mb"])
    assert open_subject(str(tmp_path / "scene.xml"), "auto", 24, 16).voxel_resolutions in ((), (16,))
    with pytest.raises(NergError, match="can be compiled"):
        open_subject("sphere", "auto", 12, 8).make_integrator(voxels=16)


# ---- Scenes with gaze fields of every kind ----

BOX = Box((-3, -3, -3), (3, 3, 3))
SCENE_GAZE = """<scene version="3.0.0">
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
    path.write_text(SCENE_GAZE.format(medium="" if shapes else MEDIUM, shapes=SHAPES if shapes else ""))
    saved(folder / "gaze.safetensors", kind, BOX)
    return path


@pytest.mark.parametrize("kind", KINDS)
def test01_shapes_agree_with_their_reference(rgb, tmp_path, kind):
    subject = open_subject(str(scene(tmp_path, kind, True)), "auto", 24, 16)
    seen = subject.render_channels(subject.make_integrator(), 1, 1)
    truth = subject.get_truth(1, "median", "depth")
    assert np.ptp(truth.gaze) > 1e-2
    off = np.abs(seen["gaze"] - truth.gaze) > 1e-3 * truth.gaze.max()
    assert off.mean() < 0.01


@pytest.mark.parametrize("kind", ["normalised", "default recipe"])
def test02_the_integral_is_that_of_exact_geometry(rgb, tmp_path, kind):
    """The reference uses the integrator's integral, which is verified here with float64 intersections."""
    subject = open_subject(str(scene(tmp_path, kind, True)), "auto", 8, 8)
    eye = subject.observer_position()
    observed = study_shapes.make_observed_gaze(subject, eye)
    field = subject.make_integrator().gaze.field
    d = fibonacci_directions(4096)
    t = study_shapes.find_first_hit(subject.triangles, np.broadcast_to(eye, d.shape), d)
    escaped = np.isinf(t)
    t[escaped] = compute_box_exit(BOX, np.broadcast_to(eye, d.shape)[escaped], d[escaped])
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
    report = study_run.study(path, width=12, height=8, quick=True, only=only).report
    rows = {r["setting"]: r for r in report["rows"]}
    assert len(rows) >= 2 and all(r["gaze_mae"] < 0.05 and np.isfinite(r["gaze_kld"]) for r in rows.values())
    assert rows["default"]["gaze_mae"] < 1e-3


@pytest.mark.parametrize("kind", ["default recipe", "ensemble"])
def test04_the_papers_marching_is_divided_by_the_same_integral(rgb, tmp_path, kind):
    """In an opaque box both marches find the same surfaces, so their densities are equal."""
    from nerg_mi.evaluation.study import PaperMarch, make_paper_integrator

    subject = open_subject(str(scene(tmp_path, kind, False)), "auto", 24, 16)
    made = subject.make_integrator({"aovs": "depth,opacity,gaze,visibility,gaze_evals", "depth": "expected"})
    # First, because afterwards the field would face the observer with any march.
    march = PaperMarch(4096)
    theirs = subject.render_channels(make_paper_integrator(made, subject.sensor, subject.tolerance, march), 1, 1)
    ours = subject.render_channels(made, 1, 1)
    both = (ours["visibility"] > 0.8) & (theirs["visibility"] > 0.8) & (ours["opacity"] > 0.99)
    assert both.sum() > 10
    attended = lambda seen: seen["gaze"][both] / seen["visibility"][both]
    np.testing.assert_allclose(attended(theirs), attended(ours), rtol=0.05)
    assert (theirs["gaze_evals"][both] == (4 if kind == "ensemble" else 2)).all()
