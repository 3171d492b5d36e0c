"""Figures of the gaze of a scene's observer."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.bands import render_aovs
from nerg_mi.errors import NergError
from nerg_mi.figures import occlusion
from nerg_mi.figures.occlusion import draw_sphere, draw_triptych
from nerg_mi.figures.settings import Style
from nerg_mi.transport.geometry import pixel_directions
from tests.pictures import SCENE
from tests.recorder import Recorder
from tests.watched import write_scene


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_the_sphere_shows_the_gaze_of_the_observer(rgb, scene_file):
    """Compared with rays of the API from the observer's eye, in directions of the panorama that the test rotates."""
    figure = draw_sphere(scene_file, width=64, spp=1, projection="equirectangular", vmax=0.5)
    assert "integral" in figure.axes[0].get_title().replace("\n", " ")
    assert figure.axes[-1].get_ylabel().replace("\n", " ") == "gaze density [1/sr]"
    shown = figure.axes[0].images[0].get_array()
    assert shown.shape == (32, 64, 3)
    eye = np.array([0.2, 0.1, -2.5])
    # The view is level, towards the middle of the scene, and up is y. The right of a Mitsuba camera is its -x.
    ahead = -eye * (1, 0, 1)
    ahead /= np.linalg.norm(ahead)
    up = np.array([0.0, 1.0, 0.0])
    local = pixel_directions(64, 32)
    world = local[..., :1] * np.cross(up, ahead) + local[..., 1:2] * up + local[..., 2:] * ahead
    seen = nerg.trace(nerg.Scene.load(str(scene_file)), eye, world.reshape(-1, 3), ["depth", "opacity", "gaze"])
    hit = (seen.opacity.reshape(32, 64) > 0.9) & (seen.gaze.reshape(32, 64) > 0.3)
    void = seen.opacity.reshape(32, 64) < 0.1
    assert hit.sum() > 20 and void.sum() > 500
    # The paper's pale hatching where no surface is hit, and dark or saturated colours on surfaces.
    grey = np.ptp(shown, axis=-1) < 0.01
    rows = np.rint((np.arange(32) + 0.5) / 32 * 31).astype(int)
    inner = lambda m: m & np.roll(m, 1, 0) & np.roll(m, -1, 0) & np.roll(m, 1, 1) & np.roll(m, -1, 1)
    assert grey[inner(void)[rows]].mean() > 0.95 and grey[inner(hit)[rows]].mean() < 0.2


def test_wrong_options_of_a_scene_figure_are_refused(scene_file):
    for options, said in (
        ({"projection": "globe"}, 'projection must be "mollweide" or "equirectangular"'),
        ({"sensor": 7}, "has 1 sensor"),
        ({"style": Style(cmap="jet")}, '"jet" is no'),
    ):
        with pytest.raises(NergError, match=said):
            draw_sphere(scene_file, width=64, **options)
    with pytest.raises(NergError, match="defaults applies to scene files"):
        draw_sphere(nerg.Scene.load(scene_file), width=64, defaults={"eye": "0, 0, 2"})


def test_another_integrator_is_refused(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    with pytest.raises(NergError, match='needs the integrator "nerg"'):
        draw_sphere(tmp_path / "scene.xml")


def test_figures_of_scenes_in_memory_equal_those_of_their_files(rgb, scene_file, tmp_path):
    scene, values = nerg.Scene.load(scene_file, eye="0.2, 0.1, 2.5"), {"eye": "0.2, 0.1, 2.5"}
    for draw, settings in ((draw_sphere, {"width": 64}), (draw_triptych, {})):
        of_file = draw(scene_file, defaults=values, spp=1, **settings)
        for source in (scene, scene.mitsuba):
            figure = draw(source, spp=1, **settings)
            assert np.array_equal(figure.axes[0].images[0].get_array(), of_file.axes[0].images[0].get_array())


# ---- Occlusion of any scene with an observer ----


def test_a_triptych_has_one_scale(rgb, scene_file, monkeypatch):
    views, render = [], occlusion.render_layers
    monkeypatch.setattr(occlusion, "render_layers", lambda *args: views.append(render(*args)) or views[-1])
    recorder, behind = Recorder(), {"eye": "0.2, 0.1, 2.5"}
    figure = draw_triptych(scene_file, progress=recorder, spp=2, defaults=behind)
    # Three pictures, the scale, and the swatch for unknown values.
    assert len(figure.axes) == 5 and [s for s, _ in recorder.steps] == sorted(s for s, _ in recorder.steps)
    observer_view, without, with_ = views
    # Occlusion only decreases gaze; visible surfaces keep their gaze.
    assert (without.values >= with_.values - 1e-6).all() and (without.values > with_.values + 1e-3).any()
    assert (without.color == with_.color).all() and observer_view.values.shape == with_.values.shape
    # The last picture is that of the camera.
    scene = nerg.Scene.load(scene_file, **behind)
    again = render_aovs(scene_file, scene.mitsuba, scene.resolve_sensor(), ["gaze", "opacity"], spp=2)
    assert (again.aovs["gaze"] == with_.values).all() and observer_view.values.max() > 0


@pytest.mark.parametrize("draw", [draw_sphere, draw_triptych])
def test_figures_of_extrapolated_observers_say_so_once(rgb, scene_file, draw):
    for eye, count in (("0.2, 0.1, 0.9", 0), ("0.2, 0.1, 2.5", 1)):
        recorder = Recorder()
        draw(scene_file, progress=recorder, spp=1, defaults={"eye": eye}, vmax=0.5)
        assert sum("extrapolated" in text for text in recorder.warnings) == count


def test_a_scene_whose_camera_is_the_observer_is_refused(rgb, scene_file):
    text = scene_file.read_text()
    a, b = text.index("        <sensor name"), text.index('        <string name="aovs"')
    alone = scene_file.with_name("alone.xml")
    alone.write_text(text[:a] + text[b:])
    with pytest.raises(NergError, match="has no observer other than its camera, so"):
        draw_triptych(alone)
