"""Solid angles of pieces, however near the observer stands."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.surfaces.sources import pieces_of, solid_angles
from tests.surfaces.meshes import box, joined

ROOM = joined(box((0, 0, 0), (1.0, 1.0, 1.0)))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("eye", [(0.5, 0.5, 0.5), (0.999, 0.3, 0.2), (1 - 1e-9, 0.9999, 0.5)])
def test01_a_room_around_an_observer_is_the_whole_sphere(eye, scale):
    room = joined(box((0, 0, 0), (scale, scale, scale)))
    found = pieces_of(room, scale * np.array(eye), 0.2)
    assert np.isclose(found.solid_angle.sum(), 4 * np.pi, rtol=1e-9)
    center = np.einsum("pi,pik->pk", found.place, room.corners[found.face])
    assert np.allclose(center, found.center, atol=1e-9 * scale)
    # As many pieces as the sphere has room for, not as the nearness would ask.
    assert len(found.face) < 50_000
    away = np.linalg.norm(found.center - scale * np.array(eye), axis=1)
    assert np.all(np.sqrt(found.solid_angle) < 0.2) and away.min() > 0


def test02_an_octant_and_what_lies_far_away():
    assert np.isclose(solid_angles(np.eye(3)[None])[0], np.pi / 2, rtol=1e-14)
    # A square metre that faces the observer a kilometre away, and one edge on.
    near = np.array([(1e3, 0, 0), (1e3, 1, 0), (1e3, 0, 1)])
    assert np.isclose(solid_angles(near[None])[0], 0.5e-6, rtol=1e-5)
    assert solid_angles(np.array([[(1.0, 0, 0), (2, 0, 0), (1, 1, 0)]]))[0] == 0


def test03_an_observer_on_a_face_ends():
    sheet = joined((np.array([(-1.0, -1, 0), (2, -1, 0), (-1, 2, 0)]), np.array([(0, 1, 2)])))
    found = pieces_of(sheet, np.zeros(3), 0.5)
    assert found.solid_angle.sum() == 0 and len(found.face) < 20_000


@pytest.mark.parametrize("far", [1e155, 1e200, 1e308, np.inf, np.nan])
def test04_an_observer_beyond_what_can_be_squared_ends(far):
    with np.errstate(all="ignore"):
        assert len(pieces_of(ROOM, np.array([far, 0, 0]), 0.03).face) == len(ROOM.faces)


def test05_pieces_are_counted_before_they_are_cut(monkeypatch):
    monkeypatch.setattr("nerg_mi.surfaces.sources.MOST_PIECES", 1000)
    with pytest.raises(NergError, match="1,000.*--angle"):
        pieces_of(ROOM, np.full(3, 0.5), 0.02)
