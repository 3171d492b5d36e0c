"""Places made of hit points: their surfaces are where rays ended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.rays.rays import Rays
from nerg_mi.train.geometry import HitExtent, volume_dict, voxelise_hits
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.train.gaze.looks import looking_at


@pytest.fixture
def rays():
    return looking_at((1.5, 0.4, 1.2))


def test_a_place_made_of_hits(rgb, rays, tmp_path):
    density, box = voxelise_hits(rays, 0.1)
    assert density.dtype == np.float32 and (density > 0).any()
    write_volume(tmp_path / "place.vol", density, box.lower, box.upper)
    medium = VolumeMedium(rgb.load_dict(volume_dict(tmp_path / "place.vol")))
    np.testing.assert_allclose(medium.bounds(), [box.lower, box.upper], atol=1e-5)
    central = np.abs(rays.hit - np.median(rays.hit, axis=0)).max(axis=1) < 0.1
    depth, opacity = trace_depth(medium, rays.origin[central], rays.direction[central])
    truth = np.linalg.norm(rays.hit - rays.origin, axis=1)[central]
    assert central.sum() > 5 and (opacity > 0.99).all() and np.abs(depth - truth).max() < 0.15


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("gap, closed", [(8, True), (9, False)])
def test_gaps_of_up_to_eight_voxels_are_closed(axis, gap, closed):
    along, across = np.eye(3)[[axis, axis - 1]]
    hit = np.array([20.5 + 0 * along, 20.5 + (gap + 1) * along])
    rays = Rays(np.zeros(2), np.zeros(2), ("a",), hit - 15 * across, np.tile(across, (2, 1)), np.ones(2), hit)
    density, _ = voxelise_hits(rays, extent=HitExtent(np.zeros(3), (50, 50, 50), 1.0))
    z, y, x = (20 + np.outer(np.arange(gap + 2), along)).astype(int).T[::-1]
    solid = density[z, y, x] > 0
    assert solid[[0, -1]].all() and (solid[1:-1] == closed).all()


def test_a_place_needs_hits(rays):
    with pytest.raises(NergError, match="--field"):
        voxelise_hits(replace(rays, hit=None))
    with pytest.raises(NergError, match="enlarge the voxel"):
        voxelise_hits(rays, 1e-3)
