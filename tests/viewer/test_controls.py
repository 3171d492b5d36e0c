"""Boxes, tables and files of the panel; layers with their ranges and colours."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import nerg_mi as nerg
from nerg_mi.environment.nested_scene import SceneDocument
from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, overlay, to_bytes
from nerg_mi.figures.style import LINE, hatch_lines
from nerg_mi.formats.boxes import Region
from nerg_mi.viewer import layers
from nerg_mi.viewer.controls import Inset, box_edges, encode_picture, fit_box, format_shares, slider_max
from nerg_mi.viewer.layers import STALE_STYLE, DisplaySettings, Scale, get_layer
from nerg_mi.viewer.points import PinholeView
from nerg_mi.viewer.scene import copy_view
from nerg_mi.viewer.shares import AttentionShare
from nerg_mi.viewer.source import open_viewer_inputs
from nerg_mi.viewer.worker import Worker

# ---- Boxes fitted to a rectangle ----


def test01_box_fits_nearest_points():
    rng = np.random.default_rng(4)
    near_points = np.array([2.0, 0, 1]) + 0.2 * (rng.random((500, 3)) - 0.5)
    wall = np.stack([np.full(500, 9.0), *(4 * rng.random((2, 500)) - 2)], axis=1)
    view = PinholeView.look_at((0, 0, 1), (2, 0, 1), (0, 0, 1), 1.0, 1.5)
    lower, upper = fit_box(np.concatenate([near_points, wall]), 0.01, view, (0.4, 0.35), (0.6, 0.65))
    assert np.allclose(lower, [1.9, -0.1, 0.9], atol=0.03) and np.allclose(upper, [2.1, 0.1, 1.1], atol=0.03)
    with pytest.raises(NergError, match="contains no points"):
        fit_box(near_points, 0.01, view, (0.8, 0.8), (0.9, 0.9))


def test02_rectangle_right_and_above():
    view = PinholeView.look_at((0, 0, 0), (1, 0, 0), (0, 0, 1), 1.0, 1.0)
    right, left = np.array([2, -0.5, 0.5]), np.array([2, 0.5, -0.5])
    points = np.concatenate([np.tile(p, (20, 1)) for p in (right, left)])
    lower, upper = fit_box(points, 0.1, view, (0.55, 0.05), (0.95, 0.45))
    assert np.allclose((lower + upper) / 2, right)


def test03_box_has_twelve_edges():
    segments = box_edges(Region.create("a", [0, 0, 0], [1, 2, 3]))
    lengths = np.sort(np.abs(segments[:, 1] - segments[:, 0]).sum(axis=1))
    assert segments.shape == (12, 2, 3) and np.allclose(lengths, [1] * 4 + [2] * 4 + [3] * 4)
    assert (
        len(np.unique(segments.reshape(12, -1), axis=0)) == 12 and len(np.unique(segments.reshape(-1, 3), axis=0)) == 8
    )


# ---- Tables and files of the panel ----


def test04_shares_are_sorted():
    cells = lambda text: re.findall(r"<td[^>]*>(.*?)</td>", text)
    text = format_shares({n: AttentionShare(s, 1e-3) for n, s in {"a": 0.1, "b|<b>": 0.25, "c": 0.0}.items()})
    assert cells(text) == ["b|&lt;b&gt;", "25.0 % ± 0.1", "a", "10.0 % ± 0.1", "c", "0.0 % ± 0.1"]
    many = cells(format_shares({f"n{k}": AttentionShare(0.01, 1e-4) for k in range(20)}))
    assert len(many) == 26 and many[-2:] == ["8 more", "8.0 % ± 0.1"]
    assert "Add areas" in format_shares({}) and "Computing" in format_shares({}, True)
    # Outdated shares are pale and marked, and so are preliminary ones.
    final = format_shares({"a": AttentionShare(0.1, 1e-3)})
    assert "Outdated" not in final and STALE_STYLE not in final and "Preliminary" not in final
    assert "Outdated" in (old := format_shares({"a": AttentionShare(0.1, 1e-3)}, True)) and STALE_STYLE in old
    mixed = format_shares({"a": AttentionShare(0.1, 0.05), "b": AttentionShare(0.3, 1e-3)})
    assert "Preliminary" in mixed and mixed.count(STALE_STYLE) == 1
    many = {f"n{k}": AttentionShare(0.5, 1e-3) for k in range(12)} | {"last": AttentionShare(0.1, 0.09)}
    assert "Preliminary" in format_shares(many)


def test05_stale_inset_is_grey():
    shown = []
    gui = SimpleNamespace(
        add_image=lambda image, label: shown.append(SimpleNamespace(image=image, label=label)) or shown[0]
    )
    inset = Inset(gui, "Observer view", 8)
    assert "outdated" in shown[0].label
    red = np.full((8, 6, 3), (250, 10, 10), np.uint8)
    inset.show(red)
    assert np.array_equal(shown[0].image, red) and shown[0].label == "Observer view"
    inset.mark_stale()
    grey = shown[0].image.astype(int)
    assert np.ptp(grey, axis=-1).max() == 0 and "outdated" in shown[0].label
    inset.mark_stale()
    assert np.array_equal(shown[0].image, grey), "not twice"
    inset.show(red)
    assert np.array_equal(shown[0].image, red) and shown[0].label == "Observer view"


@pytest.mark.parametrize("value, end", [(0, 1), (0.05, 1), (0.4, 10), (40, 1000), (300, 1000), (2e-5, 1e-4)])
def test06_slider_range_contains_value(value, end):
    assert slider_max(value) == pytest.approx(end)


def test07_copied_view_is_a_scene(store, tmp_path):
    settings = SimpleNamespace(width=48)
    view = PinholeView.look_at((7, 3, 2), (5, 4, 1), (0, 0, 1), 0.9, 1.5)
    shown = SimpleNamespace(
        source=open_viewer_inputs(store),
        gaze_name="",
        display=DisplaySettings(get_layer("gaze")),
        observer=np.array([5, 3, 1.6]),
        settings=settings,
        spp=1,
        falloff=0.1,
        ceiling=None,
    )
    (tmp_path / "view.xml").write_text(copy_view(shown, view))
    scene = nerg.Scene.load(tmp_path / "view.xml")
    assert scene.integrator.aov_names() == ["depth.T", "opacity.Y", "gaze.Y"] and np.allclose(
        scene.observer, [5, 3, 1.6]
    )
    shown.source = open_viewer_inputs(trimesh.creation.box((4, 3, 2.5)), observer=(0, 0, 0))
    with pytest.raises(NergError, match="objects in memory"):
        copy_view(shown, view)


def test08_png_has_size_and_text(rgb):
    worker = Worker(lambda error: None)
    try:
        data = encode_picture(SimpleNamespace(worker=worker), np.zeros((4, 6, 3), np.uint8), {"Comment": "a shelf"})
    finally:
        worker.stop()
    assert data.startswith(b"\x89PNG") and int.from_bytes(data[16:20], "big") == 6
    assert b"tEXtComment\0a shelf" in data


# ---- Layers ----

OF_ALL = "visible to the observer", "observer depth", "density evaluations", "colour evaluations"


def test09_layers_of_a_scene(store, room_scene):
    titles = [la.title for la in layers.list_layers(room_scene)]
    assert titles == ["colour", "depth", "opacity", *(f"position {axis}" for axis in "XYZ"), *OF_ALL]
    titles_of_store = [la.title for la in layers.list_layers(nerg.Scene.load(store))]
    assert {"gaze", "colour", "depth", *OF_ALL, "features 0"} < set(
        titles_of_store
    ) and "uncertainty of gaze" not in titles_of_store


def test10_missing_factor_has_no_layer(room, gaze_fields, tmp_path):
    factors = {"attention that surfaces attract", "attention that the observer gives"}
    for path, expected in zip(gaze_fields, (factors, {"attention that surfaces attract"})):
        scene = tmp_path / "with.xml"
        scene.write_text(SceneDocument.read(room).with_gaze(path).to_xml())
        titles = {la.title for la in layers.list_layers(nerg.Scene.load(scene))}
        assert "gaze" in titles and titles & factors == expected


def test11_each_channel_has_a_layer():
    values = dict(position=np.arange(12.0).reshape(2, 2, 3), depth=np.ones((2, 2)), features=np.ones((2, 5)) * range(5))
    for name, expected in (("position.Y", [[1, 4], [7, 10]]), ("depth", np.ones((2, 2))), ("features.3", [3, 3])):
        assert np.array_equal(get_layer(name).select_values(values), expected), name
    assert get_layer("gaze").select_values(values) is None and get_layer("color").select_values(values) is None
    assert get_layer("position.Y").quantity == "position" and get_layer("position.Y").title == "position Y"


def test12_heat_equals_overlay():
    rng = np.random.default_rng(2)
    color, gaze, mask = rng.random((8, 9, 3)), rng.random((8, 9)), np.ones((8, 9), bool)
    image = layers.colorize(get_layer("gaze"), color, gaze, mask, Scale(0, 0.7, "magma"))
    assert np.array_equal(image, to_bytes(overlay(color, gaze, Heat(0.7, "magma"), mask)))
    # Points have the same colours as pixels.
    points = layers.colorize(
        get_layer("gaze"), color.reshape(-1, 3), gaze.ravel(), mask.ravel(), Scale(0, 0.7, "magma")
    )
    assert np.array_equal(points, image.reshape(-1, 3))


def test13_missing_data_is_hatched():
    mask = np.ones((24, 24), bool)
    mask[:12] = False
    inputs = get_layer("depth"), np.zeros((24, 24, 3)), np.full((24, 24), 0.5), mask, Scale(0, 1)
    shown, plain = layers.colorize(*inputs), layers.colorize(*inputs, hatched=False)
    assert np.array_equal(shown[12:], plain[12:]) and len(np.unique(shown[12:].reshape(-1, 3), axis=0)) == 1
    # As in pictures: lines over pale colours.
    drawn = hatch_lines(24, 24)[:12]
    assert (shown[:12][drawn] == round(255 * LINE)).all()
    assert (shown[:12][~drawn] > plain[:12][~drawn]).all()


def test14_automatic_range():
    values, mask = np.linspace(1, 3, 1000), np.ones(1000, bool)
    low, high = layers.choose_range(get_layer("depth"), values, mask)
    assert low == pytest.approx(1.01) and high == pytest.approx(2.99)
    assert layers.choose_range(get_layer("gaze"), values, mask) == (0.0, pytest.approx(2.99))
    assert layers.choose_range(get_layer("gaze"), 0 * values, mask) is None
    # Selected limits precede those of the layer.
    assert get_layer("visibility").overlay.display.limits == (0.0, 1.0)
    scale = layers.choose_scale(get_layer("visibility"), (0.2, 0.4), None)
    assert (scale.low, scale.high) == (0.2, 0.4)
    assert layers.choose_range(get_layer("depth"), values, ~mask) is None
    low, high = layers.choose_range(get_layer("depth"), np.ones(5), np.ones(5, bool))
    assert low < high


@pytest.mark.parametrize("limits", [(1.0, 1.0), (0.0, np.nan), (2.0, 1.0)])
def test15_invalid_range_is_refused(limits):
    with pytest.raises(NergError, match="the lower end of a range"):
        Scale(*limits)
    with pytest.raises(NergError, match="perceptually uniform"):
        Scale(0, 1, "jet")


def test16_occluded_points_are_dark():
    color, mask = np.full((1, 2, 3), 0.5), np.ones((1, 2), bool)
    seen, hidden = layers.colorize(get_layer("visibility"), color, np.array([[1.0, 0.0]]), mask, Scale())[0].astype(int)
    assert seen.sum() > 2 * hidden.sum() and hidden[2] > hidden[0]


def test17_legend_shows_both_ends():
    text = layers.format_legend(get_layer("gaze"), Scale(0.0, 0.1234))
    assert ">0<" in text and ">0.123<" in text and ">1/sr<" in text
    assert "hidden" in layers.format_legend(get_layer("visibility"), Scale())
