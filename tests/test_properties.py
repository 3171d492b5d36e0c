"""Properties of plugins: what is taken, and that a wrong one is named with what it may be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nerg_mi import properties
from nerg_mi.errors import NergError
from nerg_mi.ranges import Range

ANY = Range(-1e9, 1e9)


@pytest.mark.parametrize(
    "read, given, found",
    [
        (lambda p: properties.number(p, "x", 1.5, ANY), {}, 1.5),
        (lambda p: properties.number(p, "x", 1.5, Range(0, 9)), {"x": 2}, 2.0),
        (lambda p: properties.integer(p, "x", 4, Range(1, 9)), {"x": 9.0}, 9),
        (lambda p: properties.boolean(p, "x", True), {"x": False}, False),
        (lambda p: properties.choice(p, "x", "a", ("a", "b")), {"x": "b"}, "b"),
        (lambda p: properties.text(p, "x"), {"x": "name"}, "name"),
        (lambda p: properties.text(p, "x", "other"), {}, "other"),
        (lambda p: properties.color(p, "x", 0.25), {}, [0.25, 0.25, 0.25]),
        (lambda p: properties.color(p, "x", 0.0), {"x": [0.1, 2.0, 0.0]}, [0.1, 2.0, 0.0]),
    ],
)
def test_values(read, given, found):
    assert read(given) == found and type(read(given)) is type(found)


def test_a_colour_of_a_texture(rgb):
    texture = rgb.load_dict({"type": "rgb", "value": [0.1, 0.2, 0.4]})
    assert properties.color({"x": texture}, "x", 0.0) == pytest.approx([0.1, 0.2, 0.4])


@pytest.mark.parametrize(
    "read, value, words",
    [
        (lambda p: properties.number(p, "x", 1, Range(0, 2)), 3, "0 .. 2, got 3"),
        (lambda p: properties.number(p, "x", 1, ANY), math.nan, "nan"),
        (lambda p: properties.number(p, "x", 1, ANY), True, "must be a number"),
        (lambda p: properties.number(p, "x", 1, ANY), "1", "must be a number, got '1'"),
        (lambda p: properties.integer(p, "x", 1, Range(0, 9)), 2.5, "whole number"),
        (lambda p: properties.boolean(p, "x", True), 1, "true or false"),
        (lambda p: properties.choice(p, "x", "a", ("a", "b")), "c", "one of a, b, got 'c'"),
        (lambda p: properties.text(p, "x"), None, "a string, got nothing"),
        (lambda p: properties.color(p, "x", 0), [1, 2], "one number or three"),
        (lambda p: properties.color(p, "x", 0), [1, -2, 0], "not negative"),
        (lambda p: properties.color(p, "x", 0), "red", "an rgb colour, got 'red'"),
    ],
)
def test_a_wrong_value_is_named(read, value, words):
    with pytest.raises(NergError) as said:
        read({"x": value})
    assert '"x"' in str(said.value) and words in str(said.value)


def test_a_field_of_a_file_or_in_memory(rgb):
    import drjit.llvm.ad as ns

    class Field:
        def __init__(self, array):
            self.array = array

        def parameters(self):
            return {"table": self.array}

    load = lambda path, ns: (path, {"about": ns})
    field, metadata, filename = properties.trained({"filename": "here.safetensors"}, None, load, ns)
    assert field == filename and filename.endswith("here.safetensors") and metadata == {"about": ns}
    mine = Field(ns.TensorXf([1.0]))
    assert properties.trained({}, mine, load, ns) == (mine, {}, "")
    with pytest.raises(NergError, match='"filename"'):
        properties.trained({}, None, load, ns)
    # Arrays that are not of the backend in use.
    with pytest.raises(NergError, match='"llvm_ad_rgb"'):
        properties.trained({}, Field([1.0]), load, ns)


def test_a_file_is_looked_for_in_the_folders_of_a_scene(rgb, tmp_path):
    (tmp_path / "here.ply").touch()
    known = rgb.file_resolver()
    rgb.set_file_resolver(type(known)(known))
    try:
        rgb.file_resolver().append(rgb.filesystem.path(str(tmp_path)))
        assert properties.resolved("here.ply") == str(tmp_path / "here.ply")
        assert properties.resolved("there.ply") == "there.ply"
    finally:
        rgb.set_file_resolver(known)


def test_a_transform_is_a_matrix_or_the_identity(rgb):
    place = rgb.ScalarTransform4f().translate([1, 2, 3]).scale(2)
    assert np.allclose(properties.transform({"to_world": place}, "to_world"), np.array(place.matrix))
    assert np.array_equal(properties.transform({}, "to_world"), np.eye(4))
    with pytest.raises(NergError, match='"to_world".*3'):
        properties.transform({"to_world": 3}, "to_world")
