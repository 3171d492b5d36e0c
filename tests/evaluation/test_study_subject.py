"""Tests of `nerg_mi.evaluation.study_subject`."""

from __future__ import annotations

import re

import numpy as np
import pytest

from nerg_mi.evaluation import study_scenes
from nerg_mi.evaluation.study_subject import open_subject, parameters
from nerg_mi.workflows.study import twin_beside
from tests.reference import march_numpy

# ---- The settings of an integrator as they are read back ----


NONE_OF_A_STUDY = {"aovs", "ceiling", "up"}


def test_all_settings_are_read_back_and_make_the_same_integrator(rgb):
    given = {
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
        "background": [0.25, 0.5, 0.75],
    }
    density = {"type": "constvolume", "value": 3.0}
    first = rgb.load_dict({"type": "nerg", "density": density, **given})
    found = parameters(first)
    assert found == given
    assert parameters(rgb.load_dict({"type": "nerg", "density": density, **found})) == given
    # None is forgotten of those that the manual page names.
    rows = re.findall(r"^ \* - ([\w, ]+)\n   - (?!:paramtype)", type(first).__doc__, re.MULTILINE)
    named = {name for row in rows for name in row.split(", ")}
    assert named - NONE_OF_A_STUDY == set(given) and NONE_OF_A_STUDY < named and np.isfinite(found["step"])


# ---- Subject ----
#
# What a study knows of its subjects: where surfaces are, and the limit that a scene file is compared with.


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


def test_the_twin_says_what_the_observer_sees(rgb, tmp_path):
    eye = np.array([-2.0, -1.0, 3.0])
    (tmp_path / "scene.xml").write_text(SCENE.format(eye=", ".join(map(str, eye))))
    (tmp_path / "twin.xml").write_text(TWIN)
    subject = open_subject(str(tmp_path / "scene.xml"), "auto", 24, 16, surfaces=twin_beside)
    assert np.allclose(subject.eye(), eye)
    t, visible = subject.exact(1)
    o, d = subject.rays(1)
    hit = np.isfinite(t)
    p = o[hit] + d[hit] * t[hit, None]
    face = np.argmax(np.abs(p - 0.5), axis=1)
    assert 50 < hit.sum() < hit.size and np.allclose(np.abs(p - 0.5).max(axis=1), 0.5, atol=1e-5)
    # A convex body hides the faces that look away: of the three in the picture x = 1, from an eye at x < 0.
    assert set(face) == {0, 1, 2} and np.array_equal(visible[hit], face != 0) and not visible[~hit].any()


def test_solids_are_met_where_geometry_says():
    subject = open_subject("sphere", "auto", 24, 16)
    t, visible = subject.exact(1)
    o, d = subject.rays(1)
    hit = np.isfinite(t)
    center, radius = study_scenes.SPHERE_CENTER, study_scenes.SPHERE_RADIUS
    p = o[hit] + d[hit] * t[hit, None]
    normal = (p - center) / radius
    assert hit.any() and np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-6)
    # A convex body hides from an observer what faces away.
    towards = np.asarray(subject.analytic.observer) - p
    assert np.array_equal(visible[hit], (towards * normal).sum(-1) > 0) and 0 < visible[hit].mean() < 1
    assert not visible[~hit].any() and open_subject("fog", "auto", 4, 4).exact(1) is None


def test_a_scene_file_is_compared_with_its_own_limit(rgb, tmp_path):
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
    known = subject.truth(1, "median", "depth")
    assert known.depth.shape == (96,) and not subject.has_gaze and subject.exact(1) is None
    o, d = subject.rays(1)
    slab = study_scenes.SCENES["slab"]
    for i in range(0, 96, 13):
        hit = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        median = 0 if hit is None else march_numpy.slab(4.0, *hit)[2]
        assert abs(known.depth[i] - median) < 1e-5
    assert slab.name == "slab" and known.convergence["depth_mae"] < 1e-5
    whole = path.read_text()
    bad = (
        whole.replace('<integrator type="nerg">', '<integrator type="path">')
        .replace("<volume", "<!--")
        .replace("</volume>", "-->")
    )
    path.write_text(bad)
    with pytest.raises(ValueError, match='is not "nerg"'):
        open_subject(str(path), "file", 12, 8)
    path.write_text(
        whole.replace('<integrator type="nerg">', '<integrator type="nerg"><float name="ceiling" value="1"/>')
    )
    with pytest.raises(ValueError, match='has a "ceiling"'):
        open_subject(str(path), "file", 12, 8)
