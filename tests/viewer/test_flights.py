"""Flights of a camera: through the views that were kept, as frames that are read again."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering.files import read_frames
from nerg_mi.viewer.flights import flight, frames_csv
from nerg_mi.viewer.points import View


def view(x, ahead=(0, 1, 0)):
    return View.of((x, 0, 1), np.add((x, 0, 1), ahead), (0, 0, 1), 0.9, 1.5)


def test01_it_passes_the_views():
    kept = [view(0), view(1), view(3, (1, 0, 0))]
    found = flight(kept, 2.0, 10)
    assert len(found) == 21
    for at, one in zip((0, 10, 20), kept):
        assert np.allclose(found[at].origin, one.origin) and np.allclose(found[at].ahead, one.ahead, atol=1e-9)
    steps = np.diff([v.origin[0] for v in found])
    assert (steps > 0).all() and steps[0] < steps[5], "it starts from rest"


def test02_frames_are_read_again(tmp_path):
    (tmp_path / "f.csv").write_text(frames_csv(flight([view(0), view(1)], 1.0, 4)), newline="")
    frames = read_frames(tmp_path / "f.csv")
    assert len(frames) == 5 and list(frames[0]) == ["view_camera", "view_target"]
    origin, target = (np.array([float(v) for v in frames[-1][name].split(",")]) for name in frames[-1])
    assert np.allclose((target - origin) / np.linalg.norm(target - origin), view(1).ahead, atol=1e-8)


@pytest.mark.parametrize("views, seconds, fps", [([], 1, 25), ([view(0)], 1, 25), ([view(0), view(1)], 1e6, 120)])
def test03_what_is_no_flight(views, seconds, fps):
    with pytest.raises(NergError, match="a flight"):
        flight(views, seconds, fps)
