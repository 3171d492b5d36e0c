"""The study of a scene of shapes alone: its reference, and what it finds."""

import csv

import numpy as np
import pytest

from nerg_mi.cli import main
from nerg_mi.evaluation import study_subject
from nerg_mi.evaluation import study_truth as study_shapes
from nerg_mi.transport.geometry import Place
from nerg_mi.workflows.demo import store_scene

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
    o, d = subject.rays(3)
    loaded = subject.scene
    ray = rgb.Ray3f(*(kind(np.ascontiguousarray(v.T, np.float32)) for kind, v in ((rgb.Point3f, o), (rgb.Vector3f, d))))
    expected = np.array(loaded.ray_intersect_preliminary(ray).t, float)
    found = subject.first_hits(3)
    assert np.array_equal(np.isfinite(found), np.isfinite(expected)) and np.isfinite(found).sum() > 200
    hit = np.isfinite(found)
    assert np.allclose(found[hit], expected[hit], rtol=1e-5)


def test01b_visibility_is_told_to_a_share_of_the_scenes_diagonal(rgb, scene):
    subject = study_subject.open_subject(str(scene), "auto", 24, 16)
    assert subject.extent > 8 and subject.tolerance == study_subject.EXACT * subject.extent
    assert subject.integrator().observer_settings.tolerance == pytest.approx(subject.tolerance)


def test01c_noise_of_the_true_colour_is_not_that_of_a_picture(rgb, scene, monkeypatch):
    subject, asked = study_subject.open_subject(str(scene), "auto", 12, 8), []
    channels = subject.channels
    monkeypatch.setattr(subject, "channels", lambda made, spp, seed: (asked.append(seed), channels(made, 1, seed))[1])
    subject.truth(1, "median", "depth")
    assert len(asked) == 1 and asked != [1]


def test02_rays_do_not_slip_between_triangles():
    corners = np.array([[[0, 0, 1], [1, 0, 1], [1, 1, 1]], [[0, 0, 1], [1, 1, 1], [0, 1, 1]]], float)
    s = np.linspace(0.01, 0.99, 99)
    o = np.stack([s, s, 0 * s], -1)
    assert (study_shapes.first_hit(corners, o, np.tile([0, 0, 1.0], (99, 1))) == 1).all()
    away = study_shapes.first_hit(corners, o, np.tile([0, 0, -1.0], (99, 1)))
    parallel = study_shapes.first_hit(corners, o, np.tile([1.0, 0, 0], (99, 1)))
    assert np.isinf(away).all() and np.isinf(parallel).all()


@pytest.mark.parametrize("falloff", [0.0, 0.7])
@pytest.mark.parametrize("visibility", ["depth", "transmittance"])
def test03_the_integrator_agrees_with_the_reference(rgb, scene, falloff, visibility):
    scene.write_text(SCENE.format(falloff=falloff, more=""))
    subject = study_subject.open_subject(str(scene), "auto", 24, 16)
    seen = subject.channels(subject.integrator({"visibility": visibility}), 1, 1)
    known = subject.truth(1, "median", visibility)
    assert np.array_equal(seen["opacity"], known.opacity)
    assert np.allclose(seen["depth"], known.depth, atol=2e-5)
    assert np.mean(np.abs(seen["visibility"] - known.visibility) > 1e-3) < 0.01
    distance, visible = subject.exact(1)
    # A hair of tolerance lies between what is asked and what is exactly so.
    shown = known.visibility > 0.5 if falloff == 0 or visibility == "transmittance" else None
    if shown is not None:
        assert np.mean(shown != visible) < 0.02 and 0.1 < visible[np.isfinite(distance)].mean() < 0.95


@pytest.mark.nightly
def test04_quick_run(tmp_path, scene, capsys):
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        main(
            ["study", str(scene), "--out", str(out), "--quick", "--width", "24", "--height", "16", "-m", "llvm_ad_rgb"]
        )
    assert not end.value.code
    rows = {r["setting"]: r for r in csv.DictReader((out / "study.csv").open())}
    assert {"default", "visibility transmittance", "visibility map 16", "no colour", "spp 2"} <= set(rows)
    assert not any(name.startswith("paper") or "steps" in name for name in rows)
    default = rows["default"]
    assert float(default["depth_mae"]) < 1e-5 and float(default["density_evals"]) == 0 and default["step"] == ""
    assert float(rows["visibility map 16"]["visibility_mae"]) > float(default["visibility_mae"])


def test05_shapes_without_triangles_are_refused(tmp_path, scene, capsys):
    scene.write_text(SCENE.format(falloff=0.0, more='<shape type="sphere"/>'))
    with pytest.raises(SystemExit):
        main(["study", str(scene), "--out", str(tmp_path / "out"), "--quick", "-m", "llvm_ad_rgb"])
    assert "a study of shapes needs meshes, and this scene has a Sphere" in " ".join(capsys.readouterr().err.split())


def test06_a_normalised_gaze_is_divided_by_the_integral_of_all_directions(rgb):
    subject = study_subject.open_subject(str(store_scene().with_name("shapes.xml")), "auto", 12, 8)
    p_o = rgb.Point3f(*subject.eye().tolist())

    def integral(tolerance):
        made = subject.integrator({"integral_tolerance": tolerance})
        return made.gaze.at([p_o], Place(None, subject.scene), made.observer_settings).integrals(p_o)[0][0]

    found = study_shapes.observed_gaze(subject, subject.eye()).integrals(p_o)[0][0]
    assert found == integral(0.0) != integral(2e-3)
