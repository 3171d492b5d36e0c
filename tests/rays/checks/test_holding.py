from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.rays import direction_checks
from nerg_mi.rays.direction_checks import head_frames
from tests.rays.checks.people import warnings_of, watch


def exchanged(rays, signs, rows=slice(None)):
    """Gaze with left and right, or up and down, of the eyes exchanged."""
    frames = head_frames(rays.head.astype(float))
    own = np.einsum("nij,nj->ni", frames, rays.direction)
    d = rays.direction.copy()
    d[rows] = np.einsum("nij,ni->nj", frames, own * signs)[rows]
    return replace(rays, direction=d, hit=None)


@pytest.mark.parametrize(
    "signs, word", [((1, -1, 1), "left and right of"), ((1, -1, -1), "left and right, and up and down,")]
)
def test_eyes_that_turn_with_the_head(signs, word):
    rays = watch()
    assert f"with {word}" in warnings_of(exchanged(rays, signs)) and warnings_of(exchanged(rays, (1, 1, 1))) == ""
    alone = warnings_of(exchanged(rays, signs, slice(3000, 6000)))
    assert f"the gaze of bo turns with the head where eyes turn against it; with {word}" in alone


def test_some_runs_speak_for_many(monkeypatch):
    monkeypatch.setattr(direction_checks, "_MOST", (4096, 512))
    rays = watch()
    mixed = rays.select(np.random.default_rng(0).permutation(len(rays)))
    for some in (rays, mixed):
        assert "left and right" in warnings_of(exchanged(some, (1, -1, 1)))
        assert warnings_of(exchanged(some, (1, 1, 1))) == ""
