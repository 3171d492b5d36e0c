"""Scanpaths: fixations at known points of a scene."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.scanpath import draw_scanpath
from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.rays import Rays
from tests.figures.test_floor_plans import WALLS_SCENE
from tests.recorder import Recorder


def test_fixations_are_numbered_where_they_are(rgb, tmp_path):
    view = """<sensor type="perspective"><float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="0, -4, 1" target="0, 0, 1" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="60"/><integer name="height" value="40"/></film></sensor>"""
    (tmp_path / "scene.xml").write_text(WALLS_SCENE.replace("</scene>", f"{view}</scene>"))
    # At the front of the tall box, behind it, and at the floor in front of the camera; from another position.
    eye, targets = np.array([0.5, -2.0, 1.6]), np.array([[1.2, 0.1, 1.0], [1.0, 3.0, 0.0], [-0.8, -1.0, 0.0]])
    eyes = np.stack([eye, [1.0, 2.0, 1.6], eye])
    n = 20
    # Last along the floor at 20 degrees per second: a pursuit, and not fixations, which it would be by dispersion.
    x = np.linspace(0, 0.3, n)
    moving = np.stack([x - 0.3, 0 * x - 1.0, 0 * x], axis=1)
    origin = np.concatenate([np.repeat(eyes, n, axis=0), np.tile(eye, (n, 1))])
    direction = np.concatenate([np.repeat(targets, n, axis=0), moving]) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    t = np.arange(4 * n) / 60 + np.repeat([0, 0.5, 1.0, 1.5], n)
    Rays(t, np.zeros(4 * n), ("Ada", "Bob"), origin, direction, np.ones(4 * n)).save(tmp_path / "rays.npz")
    files, recorder = (tmp_path / "rays.npz", tmp_path / "scene.xml"), Recorder()
    axes = draw_scanpath(*files, spp=2, progress=recorder).axes[0]
    assert sum("heads" in line for line in recorder.warnings) == 1
    assert [text for text in (t.get_text() for t in axes.texts) if text.isdecimal()] == ["1", "3"]
    offset = targets[[0, 2]] - (0, -4, 1)
    scale = 30 / np.tan(np.radians(30)) / offset[:, 1]
    expected = np.stack([29.5 + offset[:, 0] * scale, 19.5 - offset[:, 2] * scale], axis=1)
    magnification = np.ptp(axes.get_xlim()) / 60
    assert magnification == 1 and np.allclose([t.xy for t in axes.texts[:2]], expected, atol=0.05)
    assert "1 outside of the image or hidden" in " ".join(axes.figure.texts[0].get_text().split())
    slow = draw_scanpath(*files, spp=2, rules=EventRules(pursuit_velocity=60.0)).axes[0]
    assert [text for text in (t.get_text() for t in slow.texts) if text.isdecimal()] == ["1", "3", "4"]
    for refused, said in (({"persons": ["Eve"]}, "Eve"), ({"start": 9.0}, "start"), ({"sensor": 1}, "1 sensor")):
        with pytest.raises(NergError, match=said):
            draw_scanpath(*files, **refused)
