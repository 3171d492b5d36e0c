"""The time of a frame: of what there is to render, and without the first one, which compiles."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation import ablation
from nerg_mi.evaluation.ablation import frame_timer
from nerg_mi.maths.geometry import Box
from nerg_mi.train.geometry import GazePlace, place_of_field, place_of_hits, place_of_scene
from tests.formats.splats.writers import random_splats, write_inria
from tests.plugins import fields
from tests.train.gaze.looks import looking_at

from .gaze_fields import saved

BOX = Box((-1, -1, -1), (1, 1, 1))
CENTRES = np.array([[0.1, 0, 0.2], [-0.2, 0.1, 0]])
ROOM = '<scene version="3.0.0"><shape type="cube"><boolean name="flip_normals" value="true"/></shape></scene>'


@pytest.fixture
def clock(monkeypatch):
    """A clock by which the k-th frame takes k seconds."""
    ticks = iter([t for k in range(1, 20) for t in (100 * k, 101 * k)])
    monkeypatch.setattr(ablation.time, "perf_counter", lambda: next(ticks))


def made(kind, folder):
    if kind == "field":
        fields.radiance(folder / "place.safetensors", density_scale=30.0)
        return place_of_field(folder / "place.safetensors", ns)
    if kind == "splats":
        write_inria(folder / "place.ply", random_splats(50))
        return place_of_field(folder / "place.ply", ns)
    if kind == "hits":
        return place_of_hits(looking_at((1.5, 0.4, 1.2)), folder / "place.vol", 0.2)
    (folder / "room.xml").write_text(ROOM)
    return place_of_scene(folder / "room.xml")


@pytest.mark.parametrize("kind", ["field", "splats", "scene", "hits"])
def test_it_is_the_mean_of_all_frames_but_the_first(rgb, tmp_path, clock, kind):
    saved(tmp_path / "gaze.safetensors", "linear", BOX)
    render = frame_timer(made(kind, tmp_path), CENTRES, tmp_path, cameras=2, width=8, height=4)
    assert render(tmp_path / "gaze.safetensors") == pytest.approx((2 + 3) / 2)


def test_without_anything_to_render_there_is_no_time(tmp_path):
    assert frame_timer(GazePlace(None, BOX, "none"), CENTRES, tmp_path) is None
