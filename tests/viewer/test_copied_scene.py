"""A copied scene renders as what was viewed."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.viewer.points import Pace, View, refine
from nerg_mi.viewer.scene import Shown, copied

VIEW = View.of((6.9, 3.0, 2.0), (4.8, 4.2, 1.0), (0, 0, 1), 0.9, 1.5)
EYE = np.array([4.6, 3.1, 1.6])


@pytest.mark.nightly
def test01_pictures_are_alike(store, tmp_path):
    shown = Shown(VIEW, EYE, ("depth", "opacity", "gaze"), 96, 16, 0.05)
    path = tmp_path / "elsewhere" / "view.xml"
    path.parent.mkdir()
    path.write_text(copied(store, shown))
    copy = nerg.Scene.load(path)
    rendered = nerg.render(copy, quantities=["color", "gaze", "depth"])
    assert np.allclose(copy.observer, EYE) and rendered.color.shape == (1, 64, 96, 3)
    assert copy.integrator.aov_names()[-1].startswith("gaze")
    steps = refine(nerg.Scene.load(store), VIEW, EYE, ["color", "gaze", "depth", "opacity"], 96, 16, Pace())
    viewed = [p for p in steps if p is not None][-1].values
    for name in ("color", "gaze", "depth"):
        off = np.abs(rendered[name][0] - viewed[name]).mean() / viewed[name].mean()
        assert off < 0.05, name
    # And not of any view: another one is off by far.
    other = nerg.render(
        copy, quantities=["color"], camera=View.of((4, 3, 2), (2, 3, 1), (0, 0, 1), 0.9, 1.5).camera(96)
    )
    assert np.abs(other.color[0] - viewed["color"]).mean() / viewed["color"].mean() > 0.2


def test02_the_settings_are_those_that_were_viewed(store, tmp_path):
    path = tmp_path / "view.xml"
    path.write_text(copied(store, Shown(VIEW, EYE, ("depth",), 48, 3, 0.25)))
    scene = nerg.Scene.load(path, view_camera="1, 2, 1.5", view_observer="2, 2, 1.7")
    assert float(np.ravel(np.array(scene.integrator.falloff))[0]) == pytest.approx(0.25)
    assert scene.sensor(0).sampler().sample_count() == 3 and len(scene.mitsuba.sensors()) == 4
    assert np.allclose(scene.observer, [2, 2, 1.7])
    assert np.allclose(View.of_sensor(scene.sensor(0)).origin, [1, 2, 1.5])


def test03_shapes_and_no_observer(room, tmp_path):
    path = tmp_path / "view.xml"
    path.write_text(copied(room, Shown(VIEW, None, ("depth", "visibility"), 48, 1, 0.0)))
    scene = nerg.Scene.load(path)
    assert len(scene.mitsuba.shapes()) == 2 and np.allclose(scene.observer, [0, 0, 0.5])


@pytest.mark.parametrize("up", [(0, 0, 1), (0.1, -0.2, 2)])
def test04_what_is_cut_off_from_above(room, tmp_path, up):
    view, up = View.of((1.5, 0, 5), (1.5, 0.01, 0), (0, 0, 1), 0.3, 1.0), np.array(up, float)
    path = tmp_path / "view.xml"
    path.write_text(copied(room, Shown(view, None, ("depth",), 32, 1, 0.0, (0.5, up))))
    rendered = nerg.render(nerg.Scene.load(path), quantities=["depth"]).depth[0]
    steps = refine(nerg.Scene.load(room), view, None, ["depth"], 32, 1, Pace(), ceiling=Ceiling(0.5, up))
    viewed = [p for p in steps if p is not None][-1].values["depth"]
    # The floor, 5 below the camera, in place of the top of a box that is cut through; rays vary within a
    # pixel, which tells at its edges.
    assert (np.abs(rendered - viewed) < 0.03).mean() > 0.8 and rendered[16, 16] == pytest.approx(5, abs=0.02)
    # A copy of the copy that cuts nothing off shows the top again.
    again = tmp_path / "again.xml"
    again.write_text(copied(path, Shown(view, None, ("depth",), 32, 1, 0.0)))
    assert nerg.render(nerg.Scene.load(again), quantities=["depth"]).depth[0, 16, 16] == pytest.approx(4, abs=0.02)


def test05_without_an_integrator_there_is_nothing_to_copy(tmp_path, rgb):
    path = tmp_path / "a.xml"
    path.write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    with pytest.raises(NergError, match="0 integrators"):
        copied(path, Shown(VIEW, None, ("depth",), 48, 1, 0.0))
