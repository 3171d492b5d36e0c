"""What a study knows exactly of a scene file: the surfaces of the twin beside it."""

from __future__ import annotations

import numpy as np

from nerg_mi.evaluation.study.subject import open_subject

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
    subject = open_subject(str(tmp_path / "scene.xml"), "auto", 24, 16)
    assert np.allclose(subject.eye(), eye)
    t, visible = subject.exact(1)
    o, d = subject.rays(1)
    hit = np.isfinite(t)
    p = o[hit] + d[hit] * t[hit, None]
    face = np.argmax(np.abs(p - 0.5), axis=1)
    assert 50 < hit.sum() < hit.size and np.allclose(np.abs(p - 0.5).max(axis=1), 0.5, atol=1e-5)
    # A convex body hides the faces that look away: of the three in the picture x = 1, from an eye at x < 0.
    assert set(face) == {0, 1, 2} and np.array_equal(visible[hit], face != 0) and not visible[~hit].any()
