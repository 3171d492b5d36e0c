"""Tests of `nerg_mi.workflows.draw_scenes`."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Style, find_overlay
from nerg_mi.ranges import RANGE
from nerg_mi.rendering.aovs import render_asked
from nerg_mi.transport.geometry import pixel_directions
from nerg_mi.workflows import draw_scenes as scenes
from nerg_mi.workflows.draw import draw
from nerg_mi.workflows.draw_scenes import cut_place, film, open_scene, upright_pose
from nerg_mi.workflows.scene_commands import ScaleOptions, SceneFigureOptions, SphereOptions
from tests.cli.test_render import SCENE
from tests.workflows.recorder import Recorder

from .scenes import MODE, write_scene

# ---- Options that kinds of figures share ----


def test_a_style_of_options():
    assert ScaleOptions(cmap="viridis", decades=3, hatching=False).style("a") == Style("viridis", 3, False, "a")
    for given, said in (({"top": 0.0}, "--top"), ({"decades": -1}, "--decades"), ({"cmap": "jet"}, '"jet" is no')):
        with pytest.raises(NergError, match=said):
            ScaleOptions(**given).style()


def test_a_scale_is_needed():
    find_overlay("visibility").check_limits(None)
    find_overlay("gaze").check_limits((0, 1))
    with pytest.raises(NergError, match='"gaze" is 0 wherever'):
        find_overlay("gaze").check_limits(None)


# ---- Scenes opened for figures: level poses, films, and what is refused ----


def camera(mi, origin, target, up):
    return mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().look_at(origin, target, up)})


@pytest.mark.parametrize(
    "target, up, level, heading",
    [
        ((4, 6, 0.5), (0, 0, 1), (0, 0, 1), (0.6, 0.8, 0)),  # looks down a little, z up
        ((1, 2.5, -9), (0, 1, 0), (0, 1, 0), (0, 0, -1)),  # y up
        ((1, 9, 3), (0, 0, -1), (0, 0, -1), (0, 1, 0)),  # upside down
    ],
)
def test_a_level_pose(rgb, target, up, level, heading):
    matrix = np.array(upright_pose(camera(rgb, (1, 2, 3), target, up)).matrix, float)
    np.testing.assert_allclose(matrix[:3, 3], (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 1], level, atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 2], heading, atol=1e-6)


def test_straight_down_there_is_some_heading(rgb):
    matrix = np.array(upright_pose(camera(rgb, (0, 0, 3), (0, 0, 0), (0, 1, 0))).matrix, float)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)


def test_a_film_that_is_too_large():
    assert film(30, 20)["rfilter"] == {"type": "box"}
    with pytest.raises(NergError, match="4,096.*4,096"):
        film(4096, 4096)
    # What the widest sphere needs, a gigabyte to draw, is allowed.
    (width,) = (f.metadata[RANGE].high for f in fields(SphereOptions) if f.name == "width")
    assert film(width, width // 2)["width"] == width


def test_another_integrator_is_refused(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    options = SceneFigureOptions(mode="llvm_ad_rgb")
    with (
        pytest.raises(NergError, match='needs the integrator "nerg"'),
        open_scene(tmp_path / "scene.xml", options, Recorder()),
    ):
        pass


# ---- The observer's sphere of a scene file ----


@pytest.fixture(scope="module")
def scene_sphere(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_it_shows_the_observers_gaze(rgb, scene_sphere):
    """Against the API's rays from the observer's eye, in directions of the panorama that it has turned itself."""
    import nerg_mi as nerg

    figure = draw("sphere", scene_sphere, width=64, spp=1, mode=MODE, projection="equirectangular", top=0.5)
    assert "integral" in figure.axes[0].get_title().replace("\n", " ")
    assert figure.axes[-1].get_ylabel().replace("\n", " ") == "gaze density [1/sr]"
    shown = figure.axes[0].images[0].get_array()
    assert shown.shape == (32, 64, 3)
    eye = np.array([0.2, 0.1, -2.5])
    # Level, towards the middle of the place: up is y. Right of a camera of Mitsuba's is -x of its own.
    ahead = -eye * (1, 0, 1)
    ahead /= np.linalg.norm(ahead)
    up = np.array([0.0, 1.0, 0.0])
    own = pixel_directions(64, 32)
    world = own[..., :1] * np.cross(up, ahead) + own[..., 1:2] * up + own[..., 2:] * ahead
    seen = nerg.trace(nerg.Scene.load(str(scene_sphere)), eye, world.reshape(-1, 3), ["depth", "opacity", "gaze"])
    met = (seen.opacity.reshape(32, 64) > 0.9) & (seen.gaze.reshape(32, 64) > 0.3)
    void = seen.opacity.reshape(32, 64) < 0.1
    assert met.sum() > 20 and void.sum() > 500
    # The paper's pale hatching where nothing is met, dark or hot colours where something is.
    grey = np.ptp(shown, axis=-1) < 0.01
    rows = np.rint((np.arange(32) + 0.5) / 32 * 31).astype(int)
    inner = lambda m: m & np.roll(m, 1, 0) & np.roll(m, -1, 0) & np.roll(m, 1, 1) & np.roll(m, -1, 1)
    assert grey[inner(void)[rows]].mean() > 0.95 and grey[inner(met)[rows]].mean() < 0.2


def test_what_is_refused(scene_sphere):
    for given, said in (
        ({"projection": "globe"}, 'no projection "globe"'),
        ({"sensor": 7}, "has 1 sensor"),
        ({"cmap": "jet"}, '"jet" is no'),
        ({"color": 1}, 'has no option "color"'),
    ):
        with pytest.raises(NergError, match=said):
            draw("sphere", scene_sphere, mode=MODE, width=64, **given)


# ---- Occlusion of any scene with an observer ----


@pytest.fixture(scope="module")
def scene_triptych(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_three_pictures_with_one_scale(rgb, scene_triptych, monkeypatch):
    seen = []
    see = scenes.OpenScene.see
    monkeypatch.setattr(scenes.OpenScene, "see", lambda self, *of: seen.append(see(self, *of)) or seen[-1])
    told = Recorder()
    behind = {"eye": "0.2, 0.1, 2.5"}
    figure = draw("triptych", scene_triptych, reporter=told, mode=MODE, spp=2, defaults=behind)
    # Three pictures, the scale, and the swatch for what is not known.
    assert len(figure.axes) == 5 and [s for s, _ in told.steps] == sorted(s for s, _ in told.steps)
    own, without, with_ = seen
    # Occlusion takes away, and only that; what is seen itself stays.
    assert (without.values >= with_.values - 1e-6).all() and (without.values > with_.values + 1e-3).any()
    assert (without.color == with_.color).all() and own.values.shape == with_.values.shape
    # The first is what a camera at the observer's place sees, with its own gaze.
    with scenes.open_scene(scene_triptych, SceneFigureOptions(mode=MODE, spp=2, defaults=behind), told) as opened:
        plain = opened.see(opened.camera(0), find_overlay("gaze"))
        again = render_asked(scene_triptych, opened.scene, opened.camera(0), ["gaze", "opacity"], spp=2)
    assert (plain.values == with_.values).all() and (again.aovs["gaze"] == with_.values).all()
    assert own.values.max() > 0


def test_a_scene_whose_camera_is_the_observer(rgb, scene_triptych, tmp_path):
    text = scene_triptych.read_text()
    a, b = text.index("        <sensor name"), text.index('        <string name="aovs"')
    alone = scene_triptych.with_name("alone.xml")
    alone.write_text(text[:a] + text[b:])
    with pytest.raises(NergError, match="has no observer beside its camera"):
        draw("triptych", alone, mode=MODE, defaults={})


# ---- A place cut at a height: boxes whose walls and heights are known ----


LOW, HIGH = np.array([-2.0, -1.0]), np.array([2.0, 1.0])


WALLS_SCENE = """<scene version="3.0.0"><integrator type="nerg"/>
<shape type="rectangle"><transform name="to_world"><scale value="5"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.3" y="0.4" z="0.25"/>
  <translate x="-1" y="0" z="0.25"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.5" y="0.2" z="1"/>
  <translate x="1" y="0.3" z="1"/></transform></shape></scene>"""


def test_boxes(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(WALLS_SCENE)
    scene = rgb.load_file(str(tmp_path / "scene.xml"))
    plan = cut_place(scene.integrator(), scene, LOW, HIGH, 1.2, 0.0)
    ny, nx = plan.height.shape
    side = (plan.high - plan.low) / (nx, ny)
    assert plan.level == 1.2 and np.allclose(side, side[0])
    x, y = plan.low[0] + (np.arange(nx) + 0.5) * side[0], plan.low[1] + (np.arange(ny) + 0.5) * side[0]
    x, y = np.meshgrid(x, y)
    low_box = (np.abs(x + 1) < 0.3) & (np.abs(y) < 0.4)
    tall_box = (np.abs(x - 1) < 0.5) & (np.abs(y - 0.3) < 0.2)
    np.testing.assert_allclose(plan.height[low_box], 0.5, atol=1e-4)
    np.testing.assert_allclose(plan.height[~low_box & ~tall_box], 0.0, atol=1e-4)
    # The cut goes along the walls of the tall box, a cell wide to each side, and nowhere else.
    edge = np.maximum(np.abs(x - 1) - 0.5, np.abs(y - 0.3) - 0.2)
    assert plan.cut[np.abs(edge) < 0.4 * side[0]].all() and not plan.cut[np.abs(edge) > 1.01 * side[0]].any()
