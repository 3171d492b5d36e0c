"""People in a page: their paths, a moment, and whose eye the observer follows."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.viewer.page import Page
from nerg_mi.viewer.scene import People, color_of
from nerg_mi.viewer.serve import viewer
from nerg_mi.workflows.view import ViewOptions
from tests.viewer.browser import require


def test01_a_colour_for_each_person():
    colors = color_of(np.array([0, 1, 0, 11]))
    assert colors.shape == (4, 3) and colors.dtype == np.uint8
    assert np.array_equal(colors[0], colors[2]) and np.array_equal(colors[1], colors[3])
    assert not np.array_equal(colors[0], colors[1])


@pytest.fixture
def running(room, tmp_path):
    require("viser")
    t = np.arange(0, 4, 0.01)
    origin = np.stack([-2 + 0 * t, -1 + 0.5 * t, np.full(400, 1.6)], axis=1)
    rays = nerg.Rays(t, np.zeros(400, int), ("Ada",), origin, np.tile([0.0, 1, 0], (400, 1)), np.ones(400))
    rays.save(tmp_path / "rays.npz")
    with viewer([room, tmp_path / "rays.npz"], ViewOptions(port=0)) as found:
        yield found


def test02_the_observer_follows_somebody(running):
    page: Page = running.page
    people = People(page, page.session.tracks)
    # Paths of all are drawn where they are wanted: many people's hide the place.
    assert len(people._shown) == 2 and people._paths is None
    people._drawn.value = True
    people._changed()
    assert people._paths is not None
    people._time.value = 2.0
    people._eye.value = "Ada"
    people._moment()
    assert np.allclose(page.session.observer, [-2, 0, 1.6], atol=0.03)
    assert np.allclose(page.session.heading[:, 0], [0, 1, 0], atol=1e-6)
    people._rays.value = people._probes.value = True
    people._changed()
    page.session.worker.wait_idle(60)
    lines, probes = people._recorded["rays"].points, people._recorded["probes"].points
    # The room's end is ahead of her, which the integrator knows.
    assert lines.shape == (400, 2, 3) and np.allclose(lines[:, 0], page.session.tracks.at, atol=1e-5)
    seen = nerg.trace(page.session.scene, lines[:, 0], [0.0, 1, 0], ["depth"]).depth
    assert np.allclose(lines[:, 1, 1] - lines[:, 0, 1], np.where(np.isfinite(seen) & (seen > 0), seen, 1), atol=1e-4)
    assert len(probes) and (np.abs(probes[:, 0] + 2) < 1e-3).all() and page.problem == ""
    people._rays.value = people._probes.value = False
    people._changed()
    page.session.worker.wait_idle(60)
    assert not people._recorded
    people._drawn.value = False
    people._changed()
    assert people._paths is None
