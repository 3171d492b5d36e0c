"""Which commands are run again, and what of their outputs counts."""

import json
import struct

import numpy as np
import pytest

from tools import unchanged


@pytest.mark.parametrize(
    "only, expected",
    [
        (["rays.npz"], ["rays.npz"]),
        (["gaze_emit"], ["rays.npz", "gaze_emit.safetensors", "gaze_emit.exr"]),
        (["place.vol"], [*(f"photos/{k}.png" for k in range(8)), "place.safetensors", "place.vol"]),
        (["map", "sensor"], ["map.exr", "sensor1.exr", "sensor2.exr"]),
    ],
)
def test_what_an_output_is_made_of_is_made_as_well(tmp_path, only, expected):
    assert [name for name, _ in unchanged.wanted(tmp_path, only)] == expected


def test_without_a_choice_all_is_run(tmp_path):
    assert [n for n, _ in unchanged.wanted(tmp_path, [])] == [n for n, _ in unchanged.commands(tmp_path)]


def test_times_and_names_of_files_do_not_count(tmp_path):
    def checkpoint(name, metadata, value):
        header = json.dumps({"__metadata__": metadata, "a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}})
        data = struct.pack("<Q", len(header)) + header.encode() + struct.pack("<f", value)
        (tmp_path / name).write_bytes(data)
        return unchanged.digest(tmp_path / name)

    first = checkpoint("a.safetensors", {"time": "now"}, 1.0)
    assert checkpoint("b.safetensors", {"time": "later"}, 1.0) == first
    assert checkpoint("c.safetensors", {"time": "now"}, 1.5) != first
    for name, value in (("d.npz", "x"), ("e.npz", "y")):
        np.savez(tmp_path / name, a=np.arange(3.0), made=np.array(value))
    assert unchanged.digest(tmp_path / "d.npz") == unchanged.digest(tmp_path / "e.npz")
