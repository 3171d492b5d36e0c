"""Checkpoints as torch.save writes them, written without torch."""

import numpy as np
import pytest

from nerg_mi.formats.torch_ngp.pickling import write_torch
from nerg_mi.formats.torch_ngp.unpickling import read_torch


def test_what_torch_reads(tmp_path, torch):
    values = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3),
        "b": {"c": np.arange(5, dtype=np.uint8), "n": -3, "big": 2**40},
        "s": ["x", None, True, 0.1, ()],
        "h": np.ones(3, np.float16),
        "i": np.zeros((4, 0), np.int32),
    }
    write_torch(tmp_path / "w.pth", values)
    got = torch.load(tmp_path / "w.pth", weights_only=True)
    assert got["b"]["n"] == -3 and got["b"]["big"] == 2**40 and got["s"] == values["s"]
    for a, b in (
        (got["a"], values["a"]),
        (got["b"]["c"], values["b"]["c"]),
        (got["h"], values["h"]),
        (got["i"], values["i"]),
    ):
        assert np.array_equal(a.numpy(), b) and a.numpy().dtype == b.dtype


def test_what_is_written_is_read_again(tmp_path):
    values = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "n": {"b": [1, 2.5, None, True, "é"]}}
    write_torch(tmp_path / "x.pth", values)
    got = read_torch(tmp_path / "x.pth")
    assert np.array_equal(got["a"].numpy(), values["a"]) and dict(got["n"]) == values["n"]


def test_other_objects_are_not_written(tmp_path):
    with pytest.raises((TypeError, ValueError)):
        write_torch(tmp_path / "x.pth", {"a": object()})
    assert not (tmp_path / "x.pth").exists()
