import numpy as np
import pytest

from nerg_mi.alignment.constraints import PlaceTraces, surface_of_points, surface_of_traces, thinned, trace_place
from nerg_mi.errors import NergError

from . import rooms


@pytest.fixture(scope="module")
def surface():
    return surface_of_traces(rooms.traces(), 1 << 17)


def exact(points):
    """Distance to the nearest wall or face of a block."""
    out = np.minimum(points, rooms.SIZE - points).min(axis=1)
    for low, high in rooms.BOXES:
        out = np.minimum(out, np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1))
    return out


def test_distances_are_those_to_walls_and_blocks(surface):
    p = np.random.default_rng(0).uniform(0, rooms.SIZE, (4000, 3))
    p = p[rooms.free(p)]
    off = np.abs(surface.distance.at(p) - exact(p))
    assert np.median(off) < 0.5 * surface.step and np.percentile(off, 95) < 1.5 * surface.step


def test_solids_are_blocked_and_the_room_is_free(surface):
    p = np.random.default_rng(1).uniform(0, rooms.SIZE, (4000, 3))
    blocked = surface.blocked.at(p)
    deep = ~rooms.free(p, -2 * surface.step)
    assert surface.bounded and (blocked[deep] > 0).mean() > 0.97
    assert (blocked[rooms.free(p, 1.5 * surface.step)] == 0).mean() > 0.99


def test_the_inside_of_a_hollow_thing_is_no_free_space():
    room, block = rooms.traces(80_000), rooms.BOXES[0]
    rng = np.random.default_rng(2)
    begin = rng.uniform(*block, (4000, 3))
    along = rooms.directions(4000, rng)
    to_wall = np.where(along > 0, (block[1] - begin) / along, (block[0] - begin) / along).min(axis=1)
    both = PlaceTraces(
        np.concatenate([room.begin, begin]),
        np.concatenate([room.end, begin + along * to_wall[:, None]]),
        np.ones(len(room.met) + 4000, bool),
    )
    found = surface_of_traces(both, 1 << 16)
    middle = block.mean(axis=0)[None]
    assert found.blocked.at(middle)[0] > 0.2


def test_the_floor_is_found(surface):
    assert surface.floor() == pytest.approx(0, abs=0.5 * surface.step)


def test_bare_points_know_no_free_space_and_must_be_some():
    points = rooms.traces().end
    found = surface_of_points(points, 1 << 15)
    assert not found.bounded and found.distance.at(points[:500]).max() < 2 * found.step
    with pytest.raises(NergError, match="99 points, and 100"):
        surface_of_points(np.zeros((99, 3)))
    with pytest.raises(NergError, match="single point"):
        surface_of_points(np.zeros((200, 3)))


def test_thinned_points_are_the_means_of_voxels():
    p = np.array([[0.0, 0, 0], [0.2, 0, 0], [1.1, 0, 0]])
    np.testing.assert_allclose(thinned(p, 1.0), [[0.1, 0, 0], [1.1, 0, 0]])


class _Nothing:
    pass


def test_a_place_without_surfaces_is_refused(monkeypatch):
    monkeypatch.setattr(
        "nerg_mi.alignment.constraints.trace_depth", lambda s, o, d: (np.zeros(len(o)), np.zeros(len(o)))
    )
    with pytest.raises(NergError, match="no surfaces that rays could meet"):
        trace_place(_Nothing(), np.zeros(3), np.ones(3), 1000)  # pyright: ignore[reportArgumentType] # traced by nothing
