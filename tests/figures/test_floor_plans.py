"""Tests of `nerg_mi.figures.floor_plans`; `tests/figures/test_maps.py` tests what is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.environment.scene import Scene
from nerg_mi.errors import NergError
from nerg_mi.figures.floor_plans import cut_scene, draw_floor, plot_rays
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.splits import split_rays
from tests.cli.rays.running import write_walk
from tests.refusals import mentions


@pytest.fixture
def walk(tmp_path):
    return write_walk(tmp_path / "walk.npz")


def test_plots_are_written_and_reproducible(walk, tmp_path):
    train, test = split_rays(walk, test_zones=2, min_rays=8, test_positions=10)
    figure = plot_rays(train, tmp_path / "p.png", kind="layout", test=test)
    assert figure.axes and (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    for name in ("a.png", "b.png"):
        plot_rays(walk, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_axes_of_the_caller_are_used(walk):
    axes = pytest.importorskip("matplotlib.figure").Figure().subplots()
    figure = plot_rays(Rays.load(walk).with_tracking("head"), axes=axes)
    assert figure is axes.figure and "directions of heads" in axes.get_title(loc="left")


@pytest.mark.parametrize("kind", ["density", "layout"])
def test_no_rays_are_refused(walk, kind):
    rays = Rays.load(walk)
    with pytest.raises(NergError, match="no gaze samples to draw"):
        plot_rays(rays.select(rays.t < rays.t), kind=kind)


@pytest.mark.parametrize(
    "options, names",
    [({"kind": "map"}, ["kind"]), ({"test": "a.npz"}, ["test", "kind"]), ({"cell_size": 0}, ["cell_size"])],
)
def test_wrong_arguments_are_refused(walk, options, names):
    with pytest.raises(NergError, check=mentions(*names)):
        plot_rays(walk, **options)
    with pytest.raises(NergError, match=r"ends in \.png"):
        plot_rays(walk, "p.jpg")


# ---- A scene cut at a height: boxes with known walls and heights ----


LOW, HIGH = np.array([-2.0, -1.0]), np.array([2.0, 1.0])
WALLS_SCENE = """<scene version="3.0.0"><integrator type="nerg"/>
<shape type="rectangle"><transform name="to_world"><scale value="5"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.3" y="0.4" z="0.25"/>
  <translate x="-1" y="0" z="0.25"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.5" y="0.2" z="1"/>
  <translate x="1" y="0.3" z="1"/></transform></shape></scene>"""


def test_boxes_are_cut_at_a_height(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(WALLS_SCENE)
    plan = cut_scene(Scene.load(tmp_path / "scene.xml"), LOW, HIGH, 1.2, 0.0)
    ny, nx = plan.height.shape
    side = (plan.high - plan.low) / (nx, ny)
    assert plan.cut_height == 1.2 and np.allclose(side, side[0])  # noqa: RUF069 (stored)
    x, y = plan.low[0] + (np.arange(nx) + 0.5) * side[0], plan.low[1] + (np.arange(ny) + 0.5) * side[0]
    x, y = np.meshgrid(x, y)
    low_box = (np.abs(x + 1) < 0.3) & (np.abs(y) < 0.4)
    tall_box = (np.abs(x - 1) < 0.5) & (np.abs(y - 0.3) < 0.2)
    np.testing.assert_allclose(plan.height[low_box], 0.5, atol=1e-4)
    np.testing.assert_allclose(plan.height[~low_box & ~tall_box], 0.0, atol=1e-4)
    # The cut follows only the walls of the tall box, one cell wide on each side.
    edge = np.maximum(np.abs(x - 1) - 0.5, np.abs(y - 0.3) - 0.2)
    assert plan.is_cut[np.abs(edge) < 0.4 * side[0]].all() and not plan.is_cut[np.abs(edge) > 1.01 * side[0]].any()


# ---- Floor plans of rays: paths by participant and recording, lines of sight, fields of view ----


def make_walk(hits=True):
    """Ada walks along x, stops being recorded, and comes back; Bob stands."""
    t = np.r_[np.arange(20) * 0.1, 30 + np.arange(20) * 0.1, np.arange(5) * 0.1]
    x = np.r_[np.arange(20) * 0.05, 1 - np.arange(20) * 0.05, np.full(5, -0.5)]
    y = np.r_[np.zeros(20), np.full(20, 0.4), np.full(5, -0.5)]
    person = np.r_[np.zeros(40, np.int32), np.ones(5, np.int32)]
    direction = np.tile([0.0, 1.0, 0.0], (45, 1))
    origin = np.stack([x, y, np.full(45, 1.6)], axis=1)
    return Rays(t, person, ("Ada", "Bob"), origin, direction, np.ones(45), origin + direction * 0.7 if hits else None)


@pytest.fixture
def rays(tmp_path):
    make_walk().save(tmp_path / "rays.npz")
    return tmp_path / "rays.npz"


def paths(figure):
    return [line for line in figure.axes[0].lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 1]


def test_paths_break_at_recording_gaps(rays):
    figure = draw_floor(rays)
    assert figure.texts[0].get_text() == "45 rays of 2 participants"
    assert [t.get_text() for t in figure.axes[0].get_legend().get_texts()] == ["Ada", "Bob"]
    ada = paths(figure)[0]
    xy = np.stack([ada.get_xdata(), ada.get_ydata()], axis=1)
    gaps = np.flatnonzero(np.isnan(xy[:, 0]))
    assert len(gaps) == 2 and gaps[0] == 0
    first, second = xy[1 : gaps[1]], xy[gaps[1] + 1 :]
    assert np.all(first[:, 1] == 0) and np.allclose(second[:, 1], 0.4) and len(first) == len(second) == 20


def test_one_participant_and_their_hit_points_are_drawn(rays):
    figure = draw_floor(rays, persons=["Bob"], num_rays=3, num_views=2)
    lines, wedges = (c for c in figure.axes[0].collections if type(c).__name__ in ("LineCollection", "PatchCollection"))
    if type(lines).__name__ == "PatchCollection":
        lines, wedges = wedges, lines
    segments = np.stack(lines.get_segments())
    np.testing.assert_allclose(segments, np.tile([[-0.5, -0.5], [-0.5, 0.2]], (len(segments), 1, 1)))
    assert len(wedges.get_paths()) == 2


def test_a_floor_plan_is_drawn_over_geometry(rgb, rays, tmp_path):
    (tmp_path / "scene.xml").write_text(WALLS_SCENE)
    figure = draw_floor(rays, tmp_path / "a.svg", scene=str(tmp_path / "scene.xml"))
    assert len(figure.axes[0].images) == 1
    text = (tmp_path / "a.svg").read_text()
    assert "scene.xml" in text and "rays.npz" in text and str(tmp_path) not in text


@pytest.mark.parametrize(
    "options, said", [({"persons": ["Eve"]}, "Eve"), ({"cut_height": 0.0}, "cut_height must lie in")]
)
def test_wrong_options_of_a_floor_plan_are_refused(rays, options, said):
    with pytest.raises(NergError, match=said):
        draw_floor(rays, **options)
