"""Tests of `nerg_mi.transport.jit`."""

from __future__ import annotations

import gc
from types import SimpleNamespace

import drjit as dr
import numpy as np

from nerg_mi.transport.geometry import Place
from nerg_mi.transport.jit import Fingerprint, no_collection, of_shapes, recording

# ---- Arrays are told apart by identity, also where an object is assigned to and the old variable is gone ----


def test01_equal_as_long_as_nothing_is_assigned(rgb):
    a, b = dr.opaque(rgb.Float, 1, 10), rgb.TensorXf(np.zeros((2, 3), np.float32))
    first = Fingerprint([a, b])
    assert Fingerprint([a, b]) == first and Fingerprint([b, a]) != first and Fingerprint([a]) != first


def test02_no_later_variable_takes_the_place_of_one(rgb):
    """Without copies Dr.Jit would give the number of a variable that is gone to the next one."""
    volume = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.ones((4, 4, 4), np.float32))})
    params = rgb.traverse(volume)
    first = Fingerprint([params["data"]])
    for k in range(20):
        params["data"] = rgb.TensorXf(np.full((4, 4, 4, 1), k + 2, np.float32))
        params.update()
        assert Fingerprint([params["data"]]) != first


def test03_shapes_that_move(rgb):
    scene = rgb.load_dict({"type": "scene", "s": {"type": "sphere"}})
    first, params = of_shapes(Place(None, scene)), rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("to_world"))
    for k in range(4):
        params[key] = rgb.Transform4f().translate([1 + k, 0, 0])
        params.update()
        assert of_shapes(Place(None, scene)) != first
    assert of_shapes(Place(None)) == []


# ---- What is minded while a function is recorded: that it is, and that garbage waits until it is over ----


def test01_it_is_known_while_a_function_is_recorded(rgb):
    seen = []
    # A list that it refers to would be an input, whose length differs from call to call.
    note = SimpleNamespace(of=seen.append)

    @dr.freeze
    def twice(x):
        note.of(recording())
        return 2 * x

    assert not recording()
    for value in (1, 2, 3, 4):
        assert twice(dr.opaque(rgb.Float, value, 16))[0] == 2 * value
    # Later calls replay.
    assert seen == [True] and not recording()


def test02_garbage_is_collected_as_usual_otherwise():
    assert gc.isenabled()
    with no_collection():
        assert gc.isenabled()
    assert gc.isenabled()


def test03_garbage_waits_while_a_function_is_recorded(rgb):
    seen = []

    @dr.freeze
    def add(x):
        with no_collection():
            seen.append(gc.isenabled())
        seen.append(gc.isenabled())
        return x + 1

    assert add(rgb.Float([1, 2]))[1] == 3
    assert seen == [False, True] and gc.isenabled()


def test04_who_had_switched_it_off_finds_it_off(rgb):
    seen = []

    @dr.freeze
    def add(x):
        with no_collection():
            pass
        seen.append(gc.isenabled())
        return x + 1

    gc.disable()
    try:
        add(rgb.Float([1, 2]))
        assert seen == [False] and not gc.isenabled()
    finally:
        gc.enable()
