"""A scene with another gaze field: the same but for it, wherever the copy lies."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.rendering.nested_scene import gaze_of_scene, with_gaze
from nerg_mi.workflows import demo

PLAIN = """<scene version="3.0.0"><default name="n" value="a"/>{}<shape type="sphere"/></scene>"""
NERG = """<integrator type="nerg"><volume name="gaze" type="gazefield"><string name="filename" value="$n.bin"/></volume>
</integrator>"""


def test01_the_gaze_field_of_a_file(tmp_path):
    path = tmp_path / "a.xml"
    path.write_text(PLAIN.format(NERG))
    assert gaze_of_scene(path) == tmp_path / "a.bin"
    path.write_text(PLAIN.format('<integrator type="nerg"/>'))
    assert gaze_of_scene(path) is None
    store = demo.store_scene()
    assert gaze_of_scene(store) == store.parent.resolve() / "shoppers.safetensors"


@pytest.mark.parametrize("count", [0, 2])
def test02_there_is_one_integrator(tmp_path, count):
    path = tmp_path / "a.xml"
    path.write_text(PLAIN.format('<integrator type="nerg"/>' * count))
    with pytest.raises(NergError, match=f"has {count} integrators"):
        with_gaze(path, tmp_path / "b.bin")


@pytest.mark.slow
def test03_only_the_gaze_is_another(rgb, tmp_path):
    """The store with its own gaze field in a file of another name: the same picture."""
    store = demo.store_scene()
    other = tmp_path / "other.safetensors"
    other.write_bytes((store.parent / "shoppers.safetensors").read_bytes())
    (tmp_path / "copy.xml").write_text(with_gaze(store, other))
    assert gaze_of_scene(tmp_path / "copy.xml") == other.resolve()
    at, ahead = [(4.4, 2.8, 1.6)] * 16, np.random.default_rng(1).normal(size=(16, 3))
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    found = [nerg.trace(nerg.Scene.load(path), at, ahead, ["gaze", "depth"]) for path in (store, tmp_path / "copy.xml")]
    assert np.array_equal(found[0]["gaze"], found[1]["gaze"]) and np.array_equal(found[0].depth, found[1].depth)
