"""Places of hit points whose files are damaged: Mitsuba's reader believes their headers."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.volumes import write_volume
from nerg_mi.training.geometry.places import place_of_volume


@pytest.fixture
def volume(tmp_path):
    path = tmp_path / "place.vol"
    write_volume(path, np.eye(3, dtype=np.float32)[None] + np.zeros((4, 1, 1)), (0, 0, 0), (1, 2, 3))
    return path


def test_a_whole_one(rgb, volume):
    assert place_of_volume(volume).box.upper == (1, 2, 3)


@pytest.mark.parametrize(
    "at, value",
    [
        (0, b"XOL"),
        (3, b"\x02"),
        (4, struct.pack("<i", 2)),
        (8, struct.pack("<i", -3)),
        (8, struct.pack("<i", 0)),
        (12, struct.pack("<i", 2**31 - 1)),
        (20, struct.pack("<i", -1)),
        (20, struct.pack("<i", 10**9)),
        (24, struct.pack("<f", np.nan)),
        (36, struct.pack("<f", -1)),
    ],
)
def test_a_header_that_lies(rgb, volume, at, value):
    data = volume.read_bytes()
    volume.write_bytes(data[:at] + value + data[at + len(value) :])
    with pytest.raises(NergError, match="place.vol"):
        place_of_volume(volume)


@pytest.mark.parametrize("size", [0, 10, 30, 48, 100])
def test_one_that_is_cut_off(rgb, volume, size):
    volume.write_bytes(volume.read_bytes()[:size])
    with pytest.raises(NergError, match="place.vol"):
        place_of_volume(volume)
