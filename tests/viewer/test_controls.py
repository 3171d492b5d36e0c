"""The panel's tables and files."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.viewer.controls import Inset, png_bytes, slider_end, table
from nerg_mi.viewer.layers import STALE, Shade, layer_of
from nerg_mi.viewer.points import View
from nerg_mi.viewer.scene import copied_view
from nerg_mi.viewer.session import Worker


def test01_the_largest_share_first():
    cells = lambda text: re.findall(r"<td[^>]*>(.*?)</td>", text)
    text = table({"a": 0.1, "b|<b>": 0.25, "c": 0.0})
    assert cells(text) == ["b|&lt;b&gt;", "25.0 %", "a", "10.0 %", "c", "0.0 %"]
    many = cells(table({f"n{k}": 0.01 for k in range(20)}))
    assert len(many) == 26 and many[-2:] == ["8 more", "8.0 %"]
    assert "Name areas" in table({}) and "Computing" in table({}, True)
    # Out of date, they are pale, and it is said.
    assert "Out of date" not in text and STALE not in text
    assert "Out of date" in (old := table({"a": 0.1}, True)) and STALE in old


def test01_a_small_picture_is_greyed_while_another_is_made():
    shown = []
    gui = SimpleNamespace(
        add_image=lambda image, label: shown.append(SimpleNamespace(image=image, label=label)) or shown[0]
    )
    inset = Inset(gui, "Own view", 8)
    assert "out of date" in shown[0].label
    red = np.full((8, 6, 3), (250, 10, 10), np.uint8)
    inset.show(red)
    assert np.array_equal(shown[0].image, red) and shown[0].label == "Own view"
    inset.set_stale()
    grey = shown[0].image.astype(int)
    assert np.ptp(grey, axis=-1).max() == 0 and "out of date" in shown[0].label
    inset.set_stale()
    assert np.array_equal(shown[0].image, grey), "not twice"
    inset.show(red)
    assert np.array_equal(shown[0].image, red) and shown[0].label == "Own view"


@pytest.mark.parametrize("value, end", [(0, 1), (0.05, 1), (0.4, 10), (40, 1000), (300, 1000), (2e-5, 1e-4)])
def test01_a_slider_holds_its_value_in_any_unit(value, end):
    assert slider_end(value) == pytest.approx(end)


def test02_a_scene_of_what_is_shown(store, tmp_path):
    place = SimpleNamespace(made=False)
    options = SimpleNamespace(width=48)
    view = View.of((7, 3, 2), (5, 4, 1), (0, 0, 1), 0.9, 1.5)
    shown = SimpleNamespace(
        place=place,
        scene_file=store,
        shade=Shade(layer_of("gaze")),
        observer=np.array([5, 3, 1.6]),
        options=options,
        spp=1,
        falloff=0.1,
        ceiling=None,
    )
    (tmp_path / "view.xml").write_text(copied_view(shown, view))
    scene = nerg.Scene.load(tmp_path / "view.xml")
    assert scene.integrator.aov_names() == ["depth.T", "opacity.Y", "gaze.Y"] and np.allclose(
        scene.observer, [5, 3, 1.6]
    )
    shown.place, shown.scene_file = SimpleNamespace(made=True), tmp_path / "scene.xml"
    (tmp_path / "scene.vol").touch()
    with pytest.raises(NergError, match="nerg scene"):
        copied_view(shown, view)


def test03_a_png(rgb):
    worker = Worker(lambda error: None)
    try:
        data = png_bytes(SimpleNamespace(worker=worker), np.zeros((4, 6, 3), np.uint8), {"Comment": "a shelf"})
    finally:
        worker.stop()
    assert data.startswith(b"\x89PNG") and int.from_bytes(data[16:20], "big") == 6
    assert b"tEXtComment\0a shelf" in data
