"""Frames of a moving view show what the queries of the scene compute."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.fields.splats import Splats
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.transport.splat_lists import SplatLists
from nerg_mi.viewer import layers
from nerg_mi.viewer.frames import render_frame
from nerg_mi.viewer.points import FramePace, PinholeView, override_attribute
from nerg_mi.viewer.source import open_viewer_inputs

WIDTH = 48


def trace_colors(scene, view, observer, layer, scale):
    """The displayed colours of a view as NumPy computes them, and the values of the layer."""
    height, names = view.picture_height(WIDTH), layers.required_quantities(layer)
    directions = view.ray_directions(WIDTH, height, np.full((height * WIDTH, 2), 0.5))
    traced = nerg.trace(scene, view.origin, directions, names, observers=observer[None])
    picture = {name: np.asarray(traced[name][0]).reshape(height, WIDTH, *traced[name].shape[2:]) for name in names}
    values, mask = layer.select_values(picture), picture["opacity"] > 0.5
    scale = scale or layers.choose_scale(layer, layers.choose_range(layer, values, mask), None)
    return layers.colorize(layer, picture["color"], values, mask, scale), scale


def draw(scene, view, eye, layer, scale, pixels_per_ray=1, **options):
    """The colours of a frame."""
    lattice = view.make_lattice(WIDTH, pixels_per_ray)
    return render_frame(scene, view, eye, layer, scale, lattice, FramePace(), **options)[1]


def is_close(one, other) -> bool:
    """Whether all but a few bytes of two pictures, at edges, differ by at most two."""
    return np.mean(np.abs(one.astype(int) - other.astype(int)) > 2) < 0.01


@pytest.fixture
def scene(room, gaze_fields):
    """The room with a gaze field."""
    source = open_viewer_inputs([room, gaze_fields[0]])
    return source.load(next(iter(source.gaze)))


@pytest.mark.parametrize("name", ["color", "gaze", "visibility", "depth", "position.Z"])
def test_layers_of_further_frames_equal_traces(scene, name):
    home, layer, scale = PinholeView.from_sensor(scene.resolve_sensor(0)), layers.get_layer(name), None
    for k in range(4):  # The third one is a replay.
        eye = np.array([0.1 * k, 0.2, 0.5])
        view = replace(home, origin=home.origin + np.array([0, 0.1 * k, 0]))
        expected, scale = trace_colors(scene, view, eye, layer, scale)
        assert is_close(draw(scene, view, eye, layer, scale, is_draft=False), expected), k


@pytest.mark.parametrize("name", ["gaze", "visibility", "observer_depth", "density_evals"])
def test_frames_of_a_moving_observer_equal_traces(scene, name):
    """Colours and surfaces are computed once for each view and ceiling."""
    layer, home, scale = layers.get_layer(name), PinholeView.from_sensor(scene.resolve_sensor(0)), None
    views = [replace(home, origin=home.origin + np.array([0, 0.1 * k, 0])) for k in range(3)]
    views.append(views[-1])
    for k in range(8):
        view, ceiling, eye = views[k // 2], Ceiling(0.6) if k > 5 else None, np.array([0.1 * k, 0.2, 0.5])
        with override_attribute(scene, "ceiling", ceiling):
            expected, scale = trace_colors(scene, view, eye, layer, scale)
        colors = draw(scene, view, eye, layer, scale, is_view_at_rest=True, ceiling=ceiling)
        assert is_close(colors, expected), k


@pytest.mark.parametrize("is_view_at_rest", [False, True])
@pytest.mark.parametrize("pixels_per_ray", [2, 4])
def test_pixels_without_rays_lie_between_their_neighbours(scene, pixels_per_ray, is_view_at_rest):
    # Its display does not depend on the light, which is random.
    layer, view = layers.get_layer("observer_depth"), PinholeView.from_sensor(scene.resolve_sensor(0))
    eye = np.array([0.1, 0.2, 0.5])
    expected, scale = trace_colors(scene, view, eye, layer, None)
    colors = draw(scene, view, eye, layer, scale, pixels_per_ray, is_view_at_rest=is_view_at_rest)
    y, x = np.indices(expected.shape[:2])
    is_traced = (x + y) % 2 == 0 if pixels_per_ray == 2 else (x % 2 == 0) & (y % 2 == 0)
    assert is_close(colors[is_traced], expected[is_traced])
    assert np.abs(colors.astype(float) - expected).mean() < 3


def test_classes_use_their_colours(room_scene):
    """No AOV is categorical, but overlays can be."""
    depth = layers.get_layer("depth")
    shown = replace(depth.overlay.quantity, display=replace(depth.overlay.display, kind="categorical", cmap=None))
    layer = layers.Layer(replace(depth.overlay, quantity=shown))
    view = PinholeView.look_at((-10, 0, 2), (0, 0, 0), (0, 0, 1), 0.5, 1.5)
    for colors in (None, None, None, "tab10"):  # The third one is a replay.
        expected, scale = trace_colors(room_scene, view, view.origin, layer, layers.choose_scale(layer, None, colors))
        assert is_close(draw(room_scene, view, view.origin, layer, scale), expected), colors


def test_a_ceiling_and_drafts(scene):
    layer, eye, up = layers.get_layer("visibility"), np.array([0, 0, 0.5]), np.array([0.0, 0, 1])
    view = PinholeView.look_at((1.5, -0.2, 4), (1.5, 0, 0), (0, 1, 0), 0.9, 1.5)
    pictures = []
    for height, is_draft in ((None, False), (None, True), (0.5, False)):
        ceiling = None if height is None else Ceiling(height, up)
        with override_attribute(scene, "ceiling", ceiling):
            expected, scale = trace_colors(scene, view, eye, layer, None)
        options = {"ceiling": ceiling, "is_draft": is_draft, "is_observer_at_rest": True}
        pictures.append(draw(scene, view, eye, layer, scale, **options))
        assert is_close(pictures[-1], expected) is not is_draft
    plain, draft, cut = (picture.astype(float) for picture in pictures)
    assert np.abs(plain - draft).mean() < 3 and np.abs(plain - cut).mean() > 2
    assert scene.integrator.observer_settings.visibility == "depth" and scene.integrator.ceiling is None


@pytest.fixture
def splats():
    """A scene of 6,000 opaque Gaussians on a sphere."""
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(6000, 3))
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    turns = np.tile([1.0, 0, 0, 0], (6000, 1))
    splats = Splats(centers, np.full((6000, 3), 0.03), turns, np.full(6000, 0.9), rng.normal(size=(6000, 1, 3)))
    return nerg.make_scene(splats)


def test_splats_are_listed_for_each_view(splats):
    layer, scale = layers.get_layer("color"), layers.Scale()
    for k in range(4):
        view = PinholeView.look_at((3, 0.2 * k, 0.3), (0, 0, 0), (0, 0, 1), 0.7, 1.5)
        expected, _ = trace_colors(splats, view, view.origin, layer, scale)
        for is_draft, tolerance in ((False, 2), (True, 5)):
            colors = draw(splats, view, view.origin, layer, scale, is_draft=is_draft)
            assert expected.std() > 20 and np.abs(colors.astype(float) - expected).mean() < tolerance, k
    assert isinstance(next(iter(splats.integrator.medium.lists.values()))[1], SplatLists)


def test_only_drafts_are_timed(room_scene):
    view, pace = PinholeView.from_sensor(room_scene.resolve_sensor(0)), FramePace()
    layer, scale = layers.get_layer("color"), layers.Scale()
    for is_draft in (False, False, True, True, True):
        assert pace.estimate(100) == np.inf
        render_frame(room_scene, view, view.origin, layer, scale, view.make_lattice(WIDTH), pace, is_draft=is_draft)
    assert 0 < pace.estimate(100) < pace.estimate(1000) < np.inf


@pytest.mark.parametrize("name", ["color", "depth", "density_evals", "gaze"])
def test_only_frames_that_keep_their_view_are_timed_as_such(scene, name):
    layer, view, pace = layers.get_layer(name), PinholeView.from_sensor(scene.resolve_sensor(0)), FramePace()
    for k in range(3):
        eye, scale = np.array([0.1 * k, 0.2, 0.5]), layers.choose_scale(layer, None, None)
        render_frame(scene, view, eye, layer, scale, view.make_lattice(WIDTH), pace, is_view_at_rest=True)
    # Other frames have no times yet.
    assert (pace.estimate(100) == np.inf) is (name == "gaze") and pace.estimate(100, True) < np.inf
