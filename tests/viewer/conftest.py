"""The demo store, and a scene of a few shapes whose answers are known, for tests of the viewer."""

from __future__ import annotations

import pytest

import nerg_mi as nerg
from nerg_mi.workflows import demo
from tests.viewer.room import ROOM, write_gaze_fields


@pytest.fixture
def room(rgb, tmp_path):
    """The file of a floor at z = 0 with a box from 1 to 2 along x, in plain light."""
    path = tmp_path / "room.xml"
    path.write_text(ROOM)
    return path


@pytest.fixture
def room_scene(room):
    return nerg.Scene.load(room)


@pytest.fixture
def gaze_fields(rgb, tmp_path):
    """Files of two untrained gaze fields in the room, one of both factors and one of emit alone."""
    return write_gaze_fields(tmp_path)


@pytest.fixture
def store(rgb):
    """The file of the demo store's scene, with its trained fields."""
    path = demo.store_scene()
    if not all((path.parent / name).is_file() for name in demo.CHECKPOINTS.values()):
        pytest.skip("the store's fields are not here: python -m nerg_mi.scenes.store.make")
    return path
