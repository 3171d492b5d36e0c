"""The packed 3D scene, unpacked again."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.formats.areas import Region
from nerg_mi.report.data import pack
from tests.report.made import stage


def unpacked(text):
    about = json.loads(text)
    data = base64.b64decode(about["data"])
    kinds = {"place": "<u2", "paths": "<u2", "boxes": "<u2", "marks": "<u2"}
    arrays = {k: np.frombuffer(data[a : a + n], kinds.get(k, "u1")) for k, (a, n) in about["parts"].items()}
    return about, arrays


def positions(about, array):
    return np.array(about["lower"]) + array.reshape(-1, 3) / 65535 * np.array(about["size"])


def test_positions_normals_and_colours_come_back():
    given = stage()
    about, arrays = unpacked(pack(given))
    close = np.array(about["size"]).max() / 65535
    assert np.abs(positions(about, arrays["place"]) - given.proxy.vertices).max() <= close
    assert np.abs(arrays["normal"].reshape(-1, 3) / 255 * 2 - 1 - given.proxy.normals).max() <= 1 / 255 + 1e-6
    assert np.array_equal(arrays["color"].reshape(-1, 3), given.proxy.colors)
    assert np.abs(positions(about, arrays["marks"]) - given.observers).max() <= close
    paths = positions(about, arrays["paths"])
    assert [n for _, n in about["paths"]] == [9, 3]
    for (first, count), path in zip(about["paths"], given.paths):
        assert np.abs(paths[first : first + count] - path).max() <= close


def test_gaze_of_all_and_of_each():
    given = stage()
    about, arrays = unpacked(pack(given))
    heat = (arrays["gaze"].reshape(3, -1) / 255) ** 2
    for values, shown, who in zip([given.proxy.gaze.mean(axis=0), *given.proxy.gaze], heat, about["observers"]):
        assert who["top"] == pytest.approx(np.percentile(values, 99), rel=0.01)
        assert np.abs(np.minimum(values, who["top"]) / who["top"] - shown).max() < 0.015
    assert [who["marks"] for who in about["observers"]] == [[0, 1], [0], [1]]


def test_boxes_are_their_twelve_edges():
    about, arrays = unpacked(pack(stage((Region.of("b", np.array([0.0, 1, 2]), np.array([1.0, 3, 4])),))))
    edges = positions(about, arrays["boxes"]).reshape(12, 2, 3)
    lengths = np.sort(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1))
    assert np.allclose(lengths, [1] * 4 + [2] * 8, atol=1e-3)
    assert len(np.unique(edges.reshape(-1, 3).round(3), axis=0)) == 8


def test_nothing_but_points():
    given = stage(())
    empty = replace(given.proxy, gaze=np.zeros((0, len(given.proxy.vertices)), np.float32))
    text = pack(replace(given, proxy=empty, observers=np.zeros((0, 3)), paths=[]))
    about, arrays = unpacked(text)
    assert about["observers"] == [{"marks": [], "top": 0.0}] and not arrays["gaze"].any() and about["paths"] == []


def test_equal_scenes_are_equal_bytes_and_safe_in_a_page():
    assert pack(stage()) == pack(stage()) and "<" not in pack(stage())
