"""Checkpoint files: round trips, atomic writes, and errors for all kinds of invalid files."""

import os
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import save

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import FORMAT, read_checkpoint, read_metadata, write_checkpoint

TENSORS = {
    "a": np.arange(6, dtype=np.float32).reshape(2, 3),
    "b": np.array([1, 255], np.uint8),
    "c.0": np.ones(3, np.float16),
    "t": np.arange(6, dtype=np.float32).reshape(2, 3).T,
}


def test01_round_trip(tmp_path):
    path = tmp_path / "new" / "f.safetensors"
    write_checkpoint(path, "radiance", TENSORS, {"provenance": {"σ": 1.5, "list": [1, None]}})
    tensors, meta = read_checkpoint(path, "radiance")
    assert sorted(tensors) == sorted(TENSORS)
    for k, v in TENSORS.items():
        assert tensors[k].dtype == v.dtype and np.array_equal(tensors[k], v)
    assert meta == {"format": FORMAT, "kind": "radiance", "provenance": {"σ": 1.5, "list": [1, None]}}
    assert read_metadata(path) == meta and os.listdir(path.parent) == ["f.safetensors"]


def test04_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match='"[^"]*gone.safetensors" does not exist'):
        read_checkpoint(tmp_path / "gone.safetensors", "radiance")
    with pytest.raises(NergError, match="is a folder"):
        read_checkpoint(tmp_path, "radiance")


VALID = save({"x": np.ones(2, np.float32)}, metadata={"nerg": '{"kind": "radiance", "format": 1}'})
ALIEN = "is not a readable safetensors file"


def header(length, text=b""):
    return length.to_bytes(8, "little") + text


@pytest.mark.parametrize(
    "raw, said",
    [
        (b"", ALIEN),
        (b"abc", ALIEN),
        (b"\x80\x02pickle" * 9, ALIEN),
        (b"\xff" * 64, ALIEN),
        (VALID[:-5], ALIEN),
        (header(10**12, b"{}"), ALIEN),
        (header(2, b"[]"), ALIEN),
        (header(1 << 63), ALIEN),
        (header(200, b'{"x":{"dtype":"F32","shape":[1152921504606846976],"data_offsets":[0,0]}}'.ljust(200)), ALIEN),
        (header(17 << 20, b" " * (17 << 20)), "the limit is 16,777,216"),
    ],
)
def test_invalid_safetensors_is_refused(tmp_path, raw, said):
    (tmp_path / "f.safetensors").write_bytes(raw)
    with pytest.raises(NergError, match=f"f.safetensors.*{said}"):
        read_checkpoint(tmp_path / "f.safetensors", "radiance")


@pytest.mark.parametrize(
    "metadata, said",
    [
        (None, "not a nerg_mi checkpoint"),
        *((text, "") for text in ("{", "[1]", "3", '"x"', "")),
        ('{"kind": "gaze", "format": 1}', "contains a gaze field"),
        (f'{{"kind": "radiance", "format": {FORMAT + 1}}}', f"format {FORMAT + 1}.*newer nerg_mi"),
        ('{"kind": "radiance", "format": 1, "deep": ' + "[" * 100_000 + "]" * 100_000 + "}", "nested"),
    ],
)
def test_invalid_metadata_is_refused(tmp_path, metadata, said):
    entries = None if metadata is None else {"nerg": metadata}
    (tmp_path / "f.safetensors").write_bytes(save({"x": np.ones(2)}, metadata=entries))
    with pytest.raises(NergError, match=f"f.safetensors.*{said}") as error:
        read_checkpoint(tmp_path / "f.safetensors", "radiance")
    assert "\n" not in str(error.value)


def test_invalid_metadata_keeps_old_file(tmp_path):
    path = tmp_path / "f.safetensors"
    write_checkpoint(path, "radiance", TENSORS, {"n": 1})
    with pytest.raises(ValueError):
        write_checkpoint(path, "radiance", TENSORS, {"n": float("nan")})
    assert read_metadata(path)["n"] == 1 and os.listdir(tmp_path) == ["f.safetensors"]


def test10_torch_is_not_imported(tmp_path):
    code = (
        "import sys, numpy as np\n"
        "from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint\n"
        f"write_checkpoint(r'{tmp_path}/x', 'gaze', {{'a': np.ones(2)}}, {{}})\n"
        f"read_checkpoint(r'{tmp_path}/x', 'gaze')\n"
        "print('torch' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"


@pytest.mark.parametrize("size", [3 << 30, 64 << 30])
def test_other_files_are_refused_before_mapping(tmp_path, monkeypatch, size):
    with (tmp_path / "f.safetensors").open("wb") as out:
        out.truncate(size)
    monkeypatch.setattr("safetensors.safe_open", lambda *_, **__: pytest.fail("it was mapped"))
    with pytest.raises(NergError, match="f.safetensors.* (not a JSON object|the limit is 17,179,869,184)"):
        read_checkpoint(tmp_path / "f.safetensors", "radiance")
