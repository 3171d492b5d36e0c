"""Occlusion of any scene with an observer."""

from __future__ import annotations

import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import find_overlay
from nerg_mi.rendering.aovs import render_asked
from nerg_mi.workflows import draw_scenes as scenes
from nerg_mi.workflows.draw import draw
from nerg_mi.workflows.draw_scenes import SceneOptions
from tests.workflows.recorder import Recorder

from .scenes import MODE, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_three_pictures_with_one_scale(rgb, scene, monkeypatch):
    seen = []
    see = scenes.OpenScene.see
    monkeypatch.setattr(scenes.OpenScene, "see", lambda self, *of: seen.append(see(self, *of)) or seen[-1])
    told = Recorder()
    behind = {"eye": "0.2, 0.1, 2.5"}
    figure = draw("triptych", scene, reporter=told, mode=MODE, spp=2, defaults=behind)
    # Three pictures, the scale, and the swatch for what is not known.
    assert len(figure.axes) == 5 and [s for s, _ in told.steps] == sorted(s for s, _ in told.steps)
    own, without, with_ = seen
    # Occlusion takes away, and only that; what is seen itself stays.
    assert (without.values >= with_.values - 1e-6).all() and (without.values > with_.values + 1e-3).any()
    assert (without.color == with_.color).all() and own.values.shape == with_.values.shape
    # The first is what a camera at the observer's place sees, with its own gaze.
    with scenes.open_scene(scene, SceneOptions(mode=MODE, spp=2, defaults=behind), told) as opened:
        plain = opened.see(opened.camera(0), find_overlay("gaze"))
        again = render_asked(scene, opened.scene, opened.camera(0), ["gaze", "opacity"], spp=2)
    assert (plain.values == with_.values).all() and (again.aovs["gaze"] == with_.values).all()
    assert own.values.max() > 0


def test_a_scene_whose_camera_is_the_observer(rgb, scene, tmp_path):
    text = scene.read_text()
    a, b = text.index("        <sensor name"), text.index('        <string name="aovs"')
    alone = scene.with_name("alone.xml")
    alone.write_text(text[:a] + text[b:])
    with pytest.raises(NergError, match="has no observer beside its camera"):
        draw("triptych", alone, mode=MODE, defaults={})
