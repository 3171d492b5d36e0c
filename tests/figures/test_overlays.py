"""The table of overlays: scales that are shared, and figures of each."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Layers, find_overlay, overlays_of, shared_limits
from nerg_mi.figures.style import save
from nerg_mi.transport.aovs import AOVS

X, Y = np.meshgrid(np.linspace(0, 1, 24), np.linspace(0, 1, 16))
LAYERS = Layers(np.repeat(X[..., None], 3, -1), 2 * Y, X > 0.1, (5.0, 4.0))


@pytest.mark.parametrize("name", [of.name for aov in AOVS.values() for of in overlays_of(aov)])
def test_each_is_drawn(name, tmp_path):
    overlay = find_overlay(name)
    limits = overlay.limits(LAYERS)
    assert overlay.name == name and (limits is None) == (not overlay.scaled)
    save(overlay.draw(LAYERS, limits), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 500


def test_a_scale_for_all():
    assert shared_limits([(0, 2.0), None, (0, 3.0)], None) == (0, 3.0)
    assert shared_limits([(1.0, 2.0), (0.5, 3.0)], 7.0) == (0.5, 7.0)
    assert shared_limits([(1.0, 2.0)], 0.5) == (0.0, 0.5)
    assert shared_limits([None, None], None) is None and shared_limits([None], 2.0) == (0.0, 2.0)


def test_nothing_to_take_a_scale_from():
    dark = Layers(LAYERS.color, 0 * Y, LAYERS.mask)
    assert find_overlay("gaze").limits(dark) is None
    hidden = Layers(LAYERS.color, 2 * Y, X > 2)
    assert find_overlay("gaze").limits(hidden) is None


def test_one_that_is_not_there():
    with pytest.raises(NergError, match='no overlay "gase"; there are depth, opacity, position.X'):
        find_overlay("gase")
    for name in ("position", "position.W", "depth.Y", "features"):
        with pytest.raises(NergError, match=f'"{name}" is no single channel'):
            find_overlay(name)
    assert find_overlay("depth.T") == find_overlay("depth") and find_overlay("features.12").name == "features.12"
