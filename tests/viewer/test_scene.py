"""Tests of `nerg_mi.viewer.scene`."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.nested_scene import SceneDocument
from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.viewer.page import Page
from nerg_mi.viewer.points import BandPace, PinholeView, refine
from nerg_mi.viewer.scene import ParticipantsPanel, ViewSettings, copy_scene
from nerg_mi.viewer.serve import view
from tests.viewer.browser import require

# ---- Copied scenes ----

VIEW = PinholeView.look_at((6.9, 3.0, 2.0), (4.8, 4.2, 1.0), (0, 0, 1), 0.9, 1.5)
EYE = np.array([4.6, 3.1, 1.6])


@pytest.mark.nightly
def test01_copied_scene_renders_the_same_picture(store, tmp_path):
    shown = ViewSettings(VIEW, EYE, ("depth", "opacity", "gaze"), 96, 16, 0.05)
    path = tmp_path / "elsewhere" / "view.xml"
    path.parent.mkdir()
    path.write_text(copy_scene(SceneDocument.read(store), shown))
    copy = nerg.Scene.load(path)
    rendered = nerg.render(copy, quantities=["color", "gaze", "depth"])
    assert np.allclose(copy.observer, EYE) and rendered.color.shape == (1, 64, 96, 3)
    assert copy.integrator.aov_names()[-1].startswith("gaze")
    steps = refine(nerg.Scene.load(store), VIEW, EYE, ["color", "gaze", "depth", "opacity"], 96, 16, BandPace())
    viewed = [p for p in steps if p is not None][-1].values
    for name in ("color", "gaze", "depth"):
        off = np.abs(rendered[name][0] - viewed[name]).mean() / viewed[name].mean()
        assert off < 0.05, name
    # Another view differs by far.
    other = nerg.render(
        copy, quantities=["color"], camera=PinholeView.look_at((4, 3, 2), (2, 3, 1), (0, 0, 1), 0.9, 1.5).to_camera(96)
    )
    assert np.abs(other.color[0] - viewed["color"]).mean() / viewed["color"].mean() > 0.2


def test02_copied_scene_has_the_settings(store, tmp_path):
    path = tmp_path / "view.xml"
    path.write_text(copy_scene(SceneDocument.read(store), ViewSettings(VIEW, EYE, ("depth",), 48, 3, 0.25)))
    scene = nerg.Scene.load(path, view_camera="1, 2, 1.5", view_observer="2, 2, 1.7")
    assert float(np.ravel(np.array(scene.integrator.falloff))[0]) == pytest.approx(0.25)
    assert scene.resolve_sensor(0).sampler().sample_count() == 3 and len(scene.mitsuba.sensors()) == 4
    assert np.allclose(scene.observer, [2, 2, 1.7])
    assert np.allclose(PinholeView.from_sensor(scene.resolve_sensor(0)).origin, [1, 2, 1.5])


def test03_shapes_without_observer(room, tmp_path):
    path = tmp_path / "view.xml"
    path.write_text(copy_scene(SceneDocument.read(room), ViewSettings(VIEW, None, ("depth", "visibility"), 48, 1, 0.0)))
    scene = nerg.Scene.load(path)
    assert len(scene.mitsuba.shapes()) == 2 and np.allclose(scene.observer, [0, 0, 0.5])


@pytest.mark.parametrize("up", [(0, 0, 1), (0.1, -0.2, 2)])
def test04_hidden_ceiling_is_copied(room, tmp_path, up):
    view, up = PinholeView.look_at((1.5, 0, 5), (1.5, 0.01, 0), (0, 0, 1), 0.3, 1.0), np.array(up, float)
    path = tmp_path / "view.xml"
    path.write_text(copy_scene(SceneDocument.read(room), ViewSettings(view, None, ("depth",), 32, 1, 0.0, (0.5, up))))
    rendered = nerg.render(nerg.Scene.load(path), quantities=["depth"]).depth[0]
    steps = refine(nerg.Scene.load(room), view, None, ["depth"], 32, 1, BandPace(), ceiling=Ceiling(0.5, up))
    viewed = [p for p in steps if p is not None][-1].values["depth"]
    # The floor, 5 below the camera, instead of the top of the hidden box. Sample positions within a pixel
    # differ, which matters at edges.
    assert (np.abs(rendered - viewed) < 0.03).mean() > 0.8 and rendered[16, 16] == pytest.approx(5, abs=0.02)
    # A copy of the copy without a hidden ceiling shows the top again.
    again = tmp_path / "again.xml"
    again.write_text(copy_scene(SceneDocument.read(path), ViewSettings(view, None, ("depth",), 32, 1, 0.0)))
    assert nerg.render(nerg.Scene.load(again), quantities=["depth"]).depth[0, 16, 16] == pytest.approx(4, abs=0.02)


def test05_scene_without_integrator_is_refused(tmp_path, rgb):
    path = tmp_path / "a.xml"
    path.write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    with pytest.raises(NergError, match="0 integrators"):
        copy_scene(SceneDocument.read(path), ViewSettings(VIEW, None, ("depth",), 48, 1, 0.0))


# ---- Participants ----


@pytest.fixture
def running(room, tmp_path):
    require("viser")
    t = np.arange(0, 4, 0.01)
    origin = np.stack([-2 + 0 * t, -1 + 0.5 * t, np.full(400, 1.6)], axis=1)
    rays = nerg.Rays(t, np.zeros(400, int), ("Ada",), origin, np.tile([0.0, 0.8, -0.6], (400, 1)), np.ones(400))
    rays.save(tmp_path / "rays.npz")
    with view([room, tmp_path / "rays.npz"], port=0) as viewer:
        yield viewer


def test06_observer_follows_a_participant(running):
    page: Page = running.page
    people = ParticipantsPanel(page, page.session.tracks)
    # Paths are drawn on request, since many of them hide the scene.
    assert len(people._pose_handles) == 2 and people._path_handle is None
    people._show_paths.value = True
    people._draw_all()
    assert people._path_handle is not None
    people._time.value = 2.0
    people._followed.value = "Ada"
    people._draw_poses()
    assert np.allclose(page.session.observer, [-2, 0, 1.6], atol=0.03)
    assert np.allclose(people._pose_handles[0].position, page.session.observer)
    assert np.allclose(page.session.heading[:, 0], [0, 1, 0], atol=1e-6)
    people._rays_checkbox.value = people._probes_checkbox.value = True
    people._draw_all()
    page.session.worker.wait_idle(60)
    lines, probes = people._recording_handles["rays"].points, people._recording_handles["probes"].points
    # They end on the floor in front of her, which extends to y = 3.
    assert lines.shape == (400, 2, 3) and np.allclose(lines[:, 0], page.session.tracks.origins, atol=1e-5)
    hits = lines[:, :1, 1] + 1.6 * 0.8 / 0.6 < 3
    assert hits.any() and np.allclose(
        lines[:, 1] - lines[:, 0], np.where(hits, [0, 1.6 * 0.8 / 0.6, -1.6], [0, 0.8, -0.6]), atol=1e-3
    )
    assert len(probes) and (np.abs(probes[:, 0] + 2) < 1e-3).all() and page.problem == ""
    people._rays_checkbox.value = people._probes_checkbox.value = False
    people._draw_all()
    page.session.worker.wait_idle(60)
    assert not people._recording_handles
    people._show_paths.value = False
    people._draw_all()
    assert people._path_handle is None
