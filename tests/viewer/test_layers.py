"""Layers: what a scene has, their ranges and colours."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, overlay, to_bytes
from nerg_mi.figures.style import LINE, lines
from nerg_mi.rendering.nested_scene import with_gaze
from nerg_mi.viewer import layers
from nerg_mi.viewer.layers import Scale, layer_of

OF_ALL = "visible to the observer", "observer depth", "evaluations of density", "evaluations of colour"


def test01_only_what_the_scene_has(store, room_scene):
    titles = [la.title for la in layers.available(room_scene)]
    assert titles == ["colour", "depth", "opacity", *(f"position {axis}" for axis in "XYZ"), *OF_ALL]
    found = [la.title for la in layers.available(nerg.Scene.load(store))]
    assert {"gaze", "colour", "depth", *OF_ALL, "features 0"} < set(found) and "uncertainty of gaze" not in found


def test01_a_factor_that_a_variant_lacks_is_no_layer(room, gaze_fields, tmp_path):
    factors = {"what surfaces attract", "what the observer gives"}
    for path, expected in zip(gaze_fields, (factors, {"what surfaces attract"})):
        scene = tmp_path / "with.xml"
        scene.write_text(with_gaze(room, path))
        titles = {la.title for la in layers.available(nerg.Scene.load(scene))}
        assert "gaze" in titles and titles & factors == expected


def test01_a_channel_is_a_layer():
    found = {
        "position": np.arange(12.0).reshape(2, 2, 3),
        "depth": np.ones((2, 2)),
        "features": np.ones((2, 5)) * range(5),
    }
    for name, expected in (("position.Y", [[1, 4], [7, 10]]), ("depth", np.ones((2, 2))), ("features.3", [3, 3])):
        assert np.array_equal(layer_of(name).values(found), expected), name
    assert layer_of("gaze").values(found) is None and layer_of("color").values(found) is None
    assert layer_of("position.Y").quantity == "position" and layer_of("position.Y").title == "position Y"


def test02_heat_is_that_of_pictures():
    rng = np.random.default_rng(2)
    color, gaze, mask = rng.random((8, 9, 3)), rng.random((8, 9)), np.ones((8, 9), bool)
    found = layers.colored(layer_of("gaze"), color, gaze, mask, Scale(0, 0.7, "magma"))
    assert np.array_equal(found, to_bytes(overlay(color, gaze, Heat(0.7, "magma"), mask)))
    # Points are coloured as pixels are.
    points = layers.colored(layer_of("gaze"), color.reshape(-1, 3), gaze.ravel(), mask.ravel(), Scale(0, 0.7, "magma"))
    assert np.array_equal(points, found.reshape(-1, 3))


def test03_no_data_is_hatched():
    mask = np.ones((24, 24), bool)
    mask[:12] = False
    given = layer_of("depth"), np.zeros((24, 24, 3)), np.full((24, 24), 0.5), mask, Scale(0, 1)
    shown, plain = layers.colored(*given), layers.colored(*given, hatched=False)
    assert np.array_equal(shown[12:], plain[12:]) and len(np.unique(shown[12:].reshape(-1, 3), axis=0)) == 1
    # As pictures are: lines over paled colours.
    drawn = lines(24, 24)[:12]
    assert (shown[:12][drawn] == round(255 * LINE)).all()
    assert (shown[:12][~drawn] > plain[:12][~drawn]).all()


def test04_ranges_are_those_of_the_values():
    values, mask = np.linspace(1, 3, 1000), np.ones(1000, bool)
    low, high = layers.automatic(layer_of("depth"), values, mask)
    assert low == pytest.approx(1.01) and high == pytest.approx(2.99)
    assert layers.automatic(layer_of("gaze"), values, mask) == (0.0, pytest.approx(2.99))
    assert layers.automatic(layer_of("gaze"), 0 * values, mask) is None
    assert layers.automatic(layer_of("depth"), values, ~mask) is None
    low, high = layers.automatic(layer_of("depth"), np.ones(5), np.ones(5, bool))
    assert low < high


@pytest.mark.parametrize("given", [(1.0, 1.0), (0.0, np.nan), (2.0, 1.0)])
def test05_wrong_ranges_are_told(given):
    with pytest.raises(NergError, match="a range goes from"):
        Scale(*given)
    with pytest.raises(NergError, match="perceptually uniform"):
        Scale(0, 1, "jet")


def test06_hidden_is_dark():
    color, mask = np.full((1, 2, 3), 0.5), np.ones((1, 2), bool)
    seen, hidden = layers.colored(layer_of("visibility"), color, np.array([[1.0, 0.0]]), mask, Scale())[0].astype(int)
    assert seen.sum() > 2 * hidden.sum() and hidden[2] > hidden[0]


def test07_the_legend_has_both_ends():
    text = layers.legend(layer_of("gaze"), Scale(0.0, 0.1234))
    assert ">0<" in text and ">0.123<" in text and ">1/sr<" in text
    assert "hidden" in layers.legend(layer_of("visibility"), Scale())
