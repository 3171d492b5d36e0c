"""Places of hit points that reach far: an office with windows, in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.train.geometry import PAD, VOXEL, HitExtent, hit_extent, place_of_hits, voxelise_hits
from nerg_mi.transport.geometry import trace_depth
from tests.reference.office import ROOM, looks_out, office

# A box around everything would be a hundred times as large.
MOST = 1 << 19


@pytest.fixture(scope="module")
def rays():
    return office(100_000)


@pytest.fixture(scope="module")
def extent(rays):
    return hit_extent(rays, most=MOST)


def test_the_box_of_an_office_is_the_room(rays, extent):
    """At the voxels' usual edge, though the hits outside would make it 45 x 60 m."""
    spread = np.ptp(np.quantile(rays.hit, [0.005, 0.995], axis=0), axis=0)
    assert np.prod(spread / VOXEL) > 16 * MOST
    assert extent.cut and extent.voxel == VOXEL and np.prod(extent.shape) <= MOST
    low, high = extent.shell
    assert np.abs(low - ROOM[0]).max() < VOXEL and np.abs(high - ROOM[1]).max() < 1.5 * VOXEL
    assert extent.beyond == pytest.approx(looks_out(rays.origin, rays.direction).mean(), abs=2e-3)


def test_depths_in_an_office(rgb, rays, extent, tmp_path, monkeypatch):
    """What is in the room is where it is; what is outside is met where it is looked at through the box's shell."""
    monkeypatch.setattr("nerg_mi.train.geometry.hit_extent", lambda *_: extent)
    place = place_of_hits(rays, tmp_path / "office.vol")
    assert place.about["geometry_file"]["beyond"] == pytest.approx(extent.beyond, abs=1e-4)
    seen = office(4000, seed=1)  # other rays than the place was made of
    depth, opacity = trace_depth(place.medium, seen.origin, seen.direction)
    out = looks_out(seen.origin, seen.direction)
    true = np.linalg.norm(seen.hit - seen.origin, axis=1)
    off = np.abs(depth - true)[~out]
    assert (opacity[~out] > 0.99).mean() > 0.995
    assert np.median(off) < 1.5 * VOXEL and np.quantile(off, 0.99) < 4 * VOXEL
    # The shell stands in the plane of the window, which is where the box was cut.
    window = ((ROOM[1, 0] - seen.origin[:, 0]) / seen.direction[:, 0])[out]
    assert out.sum() > 100 and (opacity[out] > 0.99).mean() > 0.97
    assert np.quantile(np.abs(depth[out] - window), 0.95) < 4 * VOXEL


def test_a_place_that_is_not_too_large_is_left_as_it_was(rays):
    room = rays.select(~looks_out(rays.origin, rays.direction))
    extent = hit_extent(room)
    assert not extent.cut and extent.beyond == 0 and extent.voxel == VOXEL
    low = np.minimum(np.quantile(room.hit, 0.005, axis=0), room.origin.min(axis=0)) - PAD * VOXEL
    np.testing.assert_array_equal(extent.lower, low)
    assert not extent.beyond_shell(np.full((1, 3), 1e6)).any()


def test_what_stands_on_the_shell_is_more_than_half_a_voxel_beyond_it():
    extent = HitExtent(np.array([1.0, 2.0, 3.0]), (PAD * 2 + 4,) * 3, 0.5, cut=True)
    low, high = extent.shell
    np.testing.assert_allclose([low, high], [[4, 5, 6], [6, 7, 8]])
    for axis in np.eye(3):
        hits = [end + side * by * 0.5 * axis for end, side in ((low, -1), (high, 1)) for by in (0.45, 0.55)]
        assert extent.beyond_shell(np.array(hits)).tolist() == [False, True, False, True]


def test_a_place_is_a_file_of_64_mib_at_most():
    """A cube of 24 m, all of which people looked at, is nearly twice as many voxels."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * 24.0
    extent = hit_extent(replace(office(8), origin=corners, hit=corners))
    assert 4 * np.prod(extent.shape) <= 64 * 2**20 and (extent.cut or extent.voxel > VOXEL)


def test_voxels_grow_where_people_were_everywhere():
    """A hall that people fill has no far part to give up."""
    rng = np.random.default_rng(0)
    room = office(2000)
    hall = replace(room, origin=room.origin * 20, hit=room.origin * 20 + rng.normal(0, 2, (2000, 3)))
    extent = hit_extent(hall, most=1 << 18)
    assert extent.voxel > VOXEL and np.prod(extent.shape) <= 1 << 18
    low, high = extent.shell
    assert ((hall.hit >= low) & (hall.hit <= high)).all(axis=1).mean() >= 0.74


def test_one_lost_head_does_not_make_the_box(rays):
    origin = rays.origin.copy()
    origin[7] = [900.0, -900.0, 50.0]
    extent = hit_extent(replace(rays, origin=origin), most=MOST)
    assert extent.voxel == VOXEL and np.abs(extent.shell[1] - ROOM[1]).max() < 2 * VOXEL


def test_a_voxel_that_is_asked_for_is_kept(rays):
    assert hit_extent(rays, 0.2, MOST).voxel == 0.2
    fine = hit_extent(rays, 0.05, 1 << 21)
    assert fine.voxel == 0.05 and fine.cut
    with pytest.raises(NergError, match=r"enlarge the voxel \(--voxel\)"):
        hit_extent(rays, 0.005, MOST)
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(NergError, match="--voxel"):
            hit_extent(rays, bad)
    with pytest.raises(NergError, match="--field"):
        hit_extent(replace(rays, hit=None))


def test_hits_seen_from_outside_of_the_box_are_left_out(rays, extent):
    """Rays that start and end beyond the shell on one side never are in it."""
    away = replace(
        rays.select(np.arange(100)),
        origin=np.full((100, 3), 60.0),
        hit=np.full((100, 3), 70.0),
        direction=np.full((100, 3), 3**-0.5),
    )
    density, _ = voxelise_hits(away, extent=extent)
    assert not density.any()
