"""Tests of `nerg_mi.evaluation.study_truth`."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nerg_mi.cli import main
from nerg_mi.evaluation import study_scenes, study_subject, study_truth
from nerg_mi.evaluation.study import list_rows, measure_rows
from nerg_mi.evaluation.study_subject import open_subject, read_splat_extent
from nerg_mi.evaluation.study_truth import compute_errors
from nerg_mi.formats.splats import write_ply_splats
from tests.formats.splats.writers import random_splats
from tests.reference import march_numpy

# ---- Errors of pictures whose distance from the truth is known ----


def test_errors_of_synthetic_pictures():
    n = 1000
    one, none = np.ones(n), np.zeros(n)
    truth = study_truth.StudyTruth(np.full((n, 3), 0.5), one, 2 * one, one, np.linspace(1, 2, n), "", {})
    seen = {
        "color": np.full((n, 3), 0.6),
        "opacity": one,
        "depth": np.where(np.arange(n) < 100, 2.5, 2.0),
        "visibility": one,
        "gaze": np.linspace(1, 2, n),
    }
    off = compute_errors(seen, truth, (2 * one, np.arange(n) >= 250))
    assert math.isclose(off["color_rmse"], 0.1, rel_tol=1e-9) and math.isclose(off["color_psnr"], 20, rel_tol=1e-9)
    assert math.isclose(off["depth_mae"], 0.05) and off["depth_p99"] == pytest.approx(0.5)
    assert off["visibility_mae"] == 0 and off["visibility_wrong"] == pytest.approx(0.25)
    assert off["gaze_mae"] == 0 and abs(off["gaze_kld"]) < 1e-12
    # Errors of both signs; half visible counts as visible.
    half = np.where(np.arange(n) % 2, 0.4, 0.6)
    off = compute_errors({"opacity": 0.5 + half, "visibility": half}, truth, (2 * one, one > 0))
    assert math.isclose(off["opacity_mae"], 0.1) and off["visibility_wrong"] == pytest.approx(0.5)
    # A miss counts with its full depth; channels that are not rendered have no error.
    off = compute_errors({"depth": none, "color": none[:, None]}, truth)
    assert off["depth_mae"] == 2 and "color_rmse" not in off and "gaze_mae" not in off


# ---- References against closed forms and brute force ----

NAMES = list(study_scenes.SCENES)


def rays(scene, count=24, seed=0):
    """Float64 rays from the scene's camera towards points of the cube, and one that misses."""
    rng = np.random.default_rng(seed)
    o = np.broadcast_to(np.asarray(scene.camera, float), (count, 3))
    d = rng.uniform(0.05, 0.95, (count, 3)) - o
    d[-1] = (0, -1, 0)
    return o, d / np.linalg.norm(d, axis=-1, keepdims=True)


@pytest.mark.parametrize("name", NAMES)
def test_references_are_the_limit_of_a_float64_march(name):
    scene = study_scenes.SCENES[name]
    o, d = rays(scene, 12)
    seen = study_truth.trace_rays(scene, o, d)
    color, medians = seen.color(o, d), seen.quantile(0.5)
    for i in range(len(o) - 1):
        near, far = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        jumps = scene.breaks(o[i : i + 1], d[i : i + 1])[0]
        # Steps end at the discontinuities, so that midpoints do not straddle them.
        borders = np.unique(np.concatenate([np.linspace(near, far, 20001), jumps[(jumps > near) & (jumps < far)]]))
        tau, expected, median, total, _ = march_numpy.march(
            lambda p: scene.density(*p.T, study_scenes.NUMPY_FUNCTIONS) + 0 * p[:, 0],
            o[i],
            d[i],
            borders,
            study_scenes.evaluate_color,
        )
        assert math.isclose(seen.tau[i], tau, rel_tol=1e-6)
        assert math.isclose(seen.expected[i], expected, rel_tol=1e-6) and math.isclose(medians[i], median, rel_tol=1e-6)
        assert np.allclose(color[i], total, atol=2e-5)


def test_a_truncated_trace_equals_the_front_of_a_full_one():
    for scene in study_scenes.SCENES.values():
        o, d = rays(scene, 8)
        seen = study_truth.trace_rays(scene, o, d)
        half = study_truth.trace_rays(scene, o, d, seen.quantile(0.5))
        assert np.allclose(half.opacity, seen.opacity / 2, rtol=1e-9)


def test_target_points_are_on_the_faces_of_solids():
    # A shift beyond the face would show a strip beyond the terminator, a smaller one would hide a strip before it.
    subject = open_subject("sphere", "auto", 96, 64)
    t, visible = subject.find_exact_hits(1)
    o, d = subject.record_rays(1)
    seen = study_truth.trace_rays(subject.analytic, o, d)
    thick = np.isfinite(t) & (seen.tau > 12)
    for kind in ("expected", "median"):
        truth = study_truth.compute_truth(
            subject.analytic,
            None,
            o,
            d,
            depth=kind,
            visibility="transmittance",
            falloff=0.1,
            tolerance=1e-9,
            surface_opacity=0.5,
        )
        assert thick.sum() > 100 and np.array_equal(truth.visibility[thick] > 0.999, visible[thick]), kind


@pytest.mark.parametrize("visibility", ["depth", "transmittance"])
def test_only_surfaces_are_visible(visibility):
    scene = study_scenes.SCENES["ramp"]
    o, d = rays(scene, 64)
    truth = study_truth.compute_truth(
        scene, None, o, d, depth="expected", visibility=visibility, falloff=0.1, tolerance=1e-3, surface_opacity=0.9
    )
    thin = truth.opacity < 0.9
    assert 5 < thin.sum() < 60 and (truth.opacity[thin] > 0.1).any() and truth.opacity[-1] == 0
    assert (truth.visibility[thin] == 0).all() and (truth.visibility[~thin] > 0).any() and (truth.gaze == 0).all()


@pytest.mark.parametrize("x", [0, 1e-300, 1e-6, 9.9e-3, 1.01e-2, 1, 50, 1e9])
def test_mean_share(x):
    value = study_truth.mean_depth_fraction(np.array([x]))[0]
    if x < 1e-5:
        assert abs(value - 0.5) < 1e-6
    else:
        assert math.isclose(value, 1 / x - (1 / math.expm1(x) if x < 700 else 0), rel_tol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_integrator_agrees_with_the_reference(name):
    subject = open_subject(name, "auto", 12, 8)
    truth = subject.get_truth(1, "expected", "depth")
    off = compute_errors(
        subject.render_channels(subject.make_integrator({"depth": "expected", "step": subject.extent / 2048}), 1, 1),
        truth,
    )
    # Finite steps find thin or hard matter late.
    bound = 1e-3 if subject.is_opaque else 2e-6
    assert off["depth_mae"] < bound and off["opacity_mae"] < bound and off["color_rmse"] < max(20 * bound, 1e-4)
    assert off["visibility_mae"] < 30 * bound and off["gaze_mae"] < 30 * bound


def test_a_grid_tends_to_its_density():
    subject = open_subject("fog", "auto", 12, 8)
    truth = subject.get_truth(1, "expected", "depth")
    off = [
        compute_errors(
            subject.render_channels(
                subject.make_integrator({"quadrature": "cells", "depth": "expected"}, resolution=r), 1, 1
            ),
            truth,
        )["depth_mae"]
        for r in (8, 32)
    ]
    assert off[1] < off[0] / 6 < 1e-2


# ---- The study of a scene of shapes alone: its reference and its results ----

SCENE = """<scene version="3.0.0">
  <integrator type="nerg">
    <sensor name="observer" type="perspective">
      <transform name="to_world"><lookat origin="-3, 1, 1" target="0, 0, 0" up="0, 0, 1"/></transform></sensor>
    <float name="falloff" value="{falloff}"/><string name="depth" value="median"/>
  </integrator>
  <sensor type="perspective"><float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="1, -4, 2" target="0, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><rfilter type="box"/>
      <string name="component_format" value="float32"/>
      <string name="pixel_format" value="rgb"/></film></sensor>
  <shape type="cube"><transform name="to_world">
    <rotate x="0.3" y="1" z="0.5" angle="40"/><scale value="0.6"/></transform></shape>
  <shape type="cube"><transform name="to_world"><scale x="3" y="3" z="0.1"/><translate z="-1.2"/></transform></shape>
  {more}
</scene>"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "boxes.xml"
    path.write_text(SCENE.format(falloff=0.0, more=""))
    return path


def test01_first_hits_are_those_of_a_ray_caster(rgb, scene):
    subject = study_subject.open_subject(str(scene), "auto", 24, 16)
    o, d = subject.record_rays(3)
    loaded = subject.scene
    ray = rgb.Ray3f(*(kind(np.ascontiguousarray(v.T, np.float32)) for kind, v in ((rgb.Point3f, o), (rgb.Vector3f, d))))
    expected = np.array(loaded.ray_intersect_preliminary(ray).t, float)
    result = subject.find_first_hits(3)
    assert np.array_equal(np.isfinite(result), np.isfinite(expected)) and np.isfinite(result).sum() > 200
    hit = np.isfinite(result)
    assert np.allclose(result[hit], expected[hit], rtol=1e-5)


def test02_rays_do_not_slip_between_triangles():
    corners = np.array([[[0, 0, 1], [1, 0, 1], [1, 1, 1]], [[0, 0, 1], [1, 1, 1], [0, 1, 1]]], float)
    s = np.linspace(0.01, 0.99, 99)
    o = np.stack([s, s, 0 * s], -1)
    assert (study_truth.find_first_hit(corners, o, np.tile([0, 0, 1.0], (99, 1))) == 1).all()
    away = study_truth.find_first_hit(corners, o, np.tile([0, 0, -1.0], (99, 1)))
    parallel = study_truth.find_first_hit(corners, o, np.tile([1.0, 0, 0], (99, 1)))
    assert np.isinf(away).all() and np.isinf(parallel).all()


@pytest.mark.parametrize("falloff", [0.0, 0.7])
@pytest.mark.parametrize("visibility", ["depth", "transmittance"])
def test03_the_integrator_agrees_with_the_reference(rgb, scene, falloff, visibility):
    scene.write_text(SCENE.format(falloff=falloff, more=""))
    subject = study_subject.open_subject(str(scene), "auto", 24, 16)
    seen = subject.render_channels(subject.make_integrator({"visibility": visibility}), 1, 1)
    truth = subject.get_truth(1, "median", visibility)
    assert np.array_equal(seen["opacity"], truth.opacity)
    assert np.allclose(seen["depth"], truth.depth, atol=2e-5)
    assert np.mean(np.abs(seen["visibility"] - truth.visibility) > 1e-3) < 0.01
    distance, visible = subject.find_exact_hits(1)
    # A small tolerance, because the query is not exactly on the surface.
    shown = truth.visibility > 0.5 if falloff == 0 or visibility == "transmittance" else None
    if shown is not None:
        assert np.mean(shown != visible) < 0.02 and 0.1 < visible[np.isfinite(distance)].mean() < 0.95


def test05_shapes_without_triangles_are_refused(tmp_path, scene, capsys):
    scene.write_text(SCENE.format(falloff=0.0, more='<shape type="sphere"/>'))
    with pytest.raises(SystemExit):
        main(["study", str(scene), "--output", str(tmp_path / "out"), "--quick", "-m", "llvm_ad_rgb"])
    assert "a study of shapes supports only meshes, and this scene has a Sphere" in " ".join(
        capsys.readouterr().err.split()
    )


# ---- Gaussian splats as a subject of a study: their settings and their reference ----

SPLATS_SCENE = """<scene version="3.0.0"><integrator type="nerg"><volume name="field" type="splats">
    <string name="filename" value="a.ply"/><string name="color_space" value="linear"/>
    <transform name="to_world"><rotate x="1" angle="30"/><scale value="2"/></transform></volume></integrator>
  <sensor type="perspective"><transform name="to_world"><lookat origin="0, 0, -8" target="0, 0, 0" up="0, 1, 0"/>
    </transform><film type="hdrfilm"><rfilter type="box"/></film></sensor></scene>"""


@pytest.fixture
def subject(rgb, tmp_path):
    write_ply_splats(tmp_path / "a.ply", random_splats(30, degree=0))
    (tmp_path / "scene.xml").write_text(SPLATS_SCENE)
    return open_subject(str(tmp_path / "scene.xml"), "auto", 12, 8)


def test_splat_extent_changes_only_the_cut_off(subject):
    first, other = subject.make_integrator(), subject.make_integrator({"extent": 5.0})
    assert read_splat_extent(first) == 3 and read_splat_extent(other) == 5
    assert np.allclose(other.medium.to_world.matrix, first.medium.to_world.matrix, atol=1e-6)
    assert other.medium.color_space == "linear" and other.medium.arrays.count == 30
    assert study_truth.apply_splat_extent({"stop": 0.5}) == {"stop": 0.5}


@pytest.mark.nightly
def test_splat_settings_trade_error_for_time(subject):
    rows = [r for r in list_rows(subject) if r.group in ("default", "stop", "extent")]
    assert {r.group for r in list_rows(subject)} >= {"stop", "extent", "depth", "visibility", "together"}
    assert not {r.group for r in list_rows(subject)} & {"coarse", "paper", "dt_gamma"}
    rows = [r for r in rows if r.name in ("default", "extent 2", "extent 5")]
    result = {row["setting"]: row for row in measure_rows(subject, rows, 1, 4)}
    error = {name: row["color_rmse"] for name, row in result.items()}
    assert error["extent 5"] < 0.1 * error["default"] and error["default"] < 0.3 * error["extent 2"]
    assert result["extent 2"]["density_evals"] < result["extent 5"]["density_evals"]
    assert result["extent 2"]["extent"] == 2 and result["default"]["steps"] == ""
    assert subject.get_truth(1, "median", "depth").convergence["depth_mae"] < 1e-4
