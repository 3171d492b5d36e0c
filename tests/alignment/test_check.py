from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.alignment.check import Check, check_alignment
from nerg_mi.maths.geometry import Similarity
from nerg_mi.transport.geometry import Place
from nerg_mi.transport.volume_medium import VolumeMedium

from . import rooms

mi.set_variant("llvm_ad_rgb")
RAYS = rooms.people(600)


def moved(x, y, z):
    m = np.diag([2.0, 2, 2, 1])
    m[:3, 3] = np.array([x, y, z]) * 2
    return Similarity(m)


@pytest.fixture(scope="module")
def room():
    """The room at twice its size: shapes, and a floor that is the bottom of a box."""
    cube = lambda low, high: {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate(list(low + high)).scale(list(high - low)),
    }
    blocks = {f"b{k}": cube(low, high) for k, (low, high) in enumerate(rooms.BOXES)}
    scene = mi.load_dict({"type": "scene", "room": cube(np.zeros(3), rooms.SIZE), **blocks})
    return Place(None, scene)


def test_people_in_their_place_give_no_doubts(room):
    found = check_alignment(room, RAYS, moved(0, 0, 0))
    assert found == Check(0.0, 0.0, 0.0) and not found.doubts() and not found.impossible


def test_people_elsewhere_below_the_floor_and_in_walls_are_told(room):
    assert check_alignment(room, RAYS, moved(100, 0, 0)).impossible
    below = check_alignment(room, RAYS, moved(0, 0, -2.0))
    assert below.below > 0.9 and "below the floor" in " ".join(below.doubts())


def test_heads_within_matter_are_inside_of_something():
    solid = VolumeMedium(
        mi.load_dict({"type": "constvolume", "value": 500.0, "to_world": mi.ScalarTransform4f().scale([9, 9, 9])})
    )
    found = check_alignment(solid, RAYS, moved(0, 0, 0))
    assert found.inside > 0.9 and "inside of something solid" in " ".join(found.doubts())


def test_no_rays_are_no_doubt(room):
    assert check_alignment(room, RAYS.select(np.zeros(len(RAYS), bool)), moved(0, 0, 0)).doubts() == []
    assert len(replace(RAYS, hit=None)) == len(RAYS)


def test_gaze_that_would_meet_more_with_an_axis_negated_is_told():
    """A wall on one side: people who look at it, and the same in a mirror."""
    place = mi.ScalarTransform4f().translate([20, 0, 0]).scale([0.1, 60, 60])
    wall = Place(None, mi.load_dict({"type": "scene", "wall": {"type": "cube", "to_world": place}}))
    rays = replace(RAYS, direction=np.tile([0.8, 0.6, 0.0], (len(RAYS), 1)))
    assert check_alignment(wall, rays, moved(0, 0, 0)) == Check(0.0, 0.0, 0.0)
    mirrored = check_alignment(wall, replace(rays, direction=rays.direction * (-1, 1, 1)), moved(0, 0, 0))
    assert "with x of the directions negated" in mirrored.doubts()[-1] and mirrored.escaped > 0.9
