"""Pictures in steps: those of `nerg.render`, in bands that can be left off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.viewer.points import DIRECTIONS, SIZES, Pace, View, refine, rough_integrals

QUANTITIES = ["color", "depth", "opacity", "visibility"]


def test01_the_last_picture_is_that_of_the_integrator(room_scene):
    view = View.of_sensor(room_scene.sensor(0))
    steps = list(refine(room_scene, view, np.array([0, 0, 0.5]), QUANTITIES, 48, 64, Pace()))
    pictures = [p for p in steps if p is not None]
    assert [p.share for p in pictures[:2]] == [4, 2] and [p.samples for p in pictures[2:]] == [1, 2, 4, 8, 16, 32, 64]
    assert pictures[0].values["depth"].shape == (8, 12) and pictures[-1].values["color"].shape == (32, 48, 3)
    assert [p.whole for p in pictures] == [False] * (len(pictures) - 1) + [True]
    true = nerg.render(room_scene, quantities=QUANTITIES, camera=view.camera(48), spp=256)
    for name, most in (("color", 0.02), ("depth", 0.02), ("visibility", 0.02)):
        assert np.abs(pictures[-1].values[name] - true[name][0]).mean() < most, name
    # Each is nearer to the truth than the first one of its size.
    errors = [np.abs(p.values["color"] - true.color[0]).mean() for p in pictures[2:]]
    assert errors[-1] < 0.5 * errors[0]


def test02_equal_seeds_give_equal_pictures_whatever_the_bands(room_scene):
    view = View.of_sensor(room_scene.sensor(0))
    names = ["depth", "opacity"]
    one, other = Pace(), Pace()
    other._at = 2
    first, second = (list(refine(room_scene, view, None, names, 150, 2, pace))[-1] for pace in (one, other))
    assert first is not None and second is not None
    assert np.allclose(first.values["depth"], second.values["depth"], atol=1e-5)


def test03_a_picture_that_is_left_off_is_not_gone_on_with(room_scene, monkeypatch):
    import nerg_mi.viewer.points as module

    traced = []
    original = module.trace
    monkeypatch.setattr(module, "trace", lambda *a, **k: traced.append(len(a[2])) or original(*a, **k))
    view = View.of_sensor(room_scene.sensor(0))
    steps = refine(room_scene, view, None, ["depth", "opacity"], 400, 4, Pace())
    next(steps)
    steps.close()
    assert traced == [SIZES[0]]


def test04_the_pace_follows_the_time(monkeypatch):
    pace = Pace()
    for _ in range(10):
        pace.learn(0.01)
    assert pace.rays == SIZES[-1]
    pace.learn(20.0)  # a kernel was compiled
    assert pace.rays == SIZES[-1]
    for _ in range(20):
        pace.learn(20.0)
    assert pace.rays == SIZES[0]


def test05_from_above_the_ceiling_is_cut_off(room_scene):
    up = np.array([0.0, 0, 1])
    view = View.of((1.5, 0, 5), (1.5, 0.01, 0), up, 0.3, 1.0)
    whole = list(refine(room_scene, view, None, ["depth", "opacity"], 32, 1, Pace()))[-1]
    cut = list(refine(room_scene, view, None, ["depth", "opacity"], 32, 1, Pace(), ceiling=Ceiling(0.5, up)))[-1]
    assert whole is not None and cut is not None
    # The top of the box lies at z = 1, 4 below the camera; below the cut is the floor.
    assert whole.values["depth"][16, 16] == pytest.approx(4, abs=0.02)
    assert cut.values["depth"][16, 16] == pytest.approx(5, abs=0.02)
    assert room_scene.integrator.ceiling is None


def test_integrals_are_rough_until_the_last_picture(store):
    scene = nerg.Scene.load(store)
    own = scene.integrator.observer_settings
    with rough_integrals(scene):
        assert scene.integrator.observer_settings == replace(own, directions=DIRECTIONS)
    with rough_integrals(scene, False):
        assert scene.integrator.observer_settings is own
    with pytest.raises(ZeroDivisionError), rough_integrals(scene):
        raise ZeroDivisionError
    assert scene.integrator.observer_settings is own
