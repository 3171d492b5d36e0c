"""Arrays are told apart by identity, also where an object is assigned to and the old variable is gone."""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.transport.geometry import Place
from nerg_mi.transport.jit import Fingerprint, of_shapes


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
