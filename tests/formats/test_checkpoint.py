"""Checkpoint files: round trips, atomic writes, and a sentence for every kind of wrong file."""

import json
import os
import stat
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import save_file

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


def test02_files_are_as_readable_as_others(tmp_path):
    path = tmp_path / "f.safetensors"
    write_checkpoint(path, "radiance", TENSORS, {})
    other = tmp_path / "plain"
    other.write_text("")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


@pytest.mark.parametrize("fail", ["replace", "metadata", "fsync"])
def test03_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, fail):
    path = tmp_path / "f.safetensors"
    write_checkpoint(path, "radiance", TENSORS, {"n": 1})
    old = path.read_bytes()

    def broken(*args, **kwargs):
        raise OSError("disk full")

    metadata = {"n": 2}
    if fail == "metadata":
        metadata = {"n": float("nan")}  # no JSON
    else:
        monkeypatch.setattr(os, fail, broken)
    with pytest.raises((OSError, ValueError)):
        write_checkpoint(path, "radiance", TENSORS, metadata)
    monkeypatch.undo()
    assert path.read_bytes() == old and os.listdir(tmp_path) == ["f.safetensors"]


def test04_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match='"[^"]*gone.safetensors" does not exist'):
        read_checkpoint(tmp_path / "gone.safetensors", "radiance")
    with pytest.raises(NergError, match="is a folder"):
        read_checkpoint(tmp_path, "radiance")


@pytest.mark.parametrize("content", [b"", b"abc", b"\x80\x02pickle" * 9, b"\xff" * 64])
def test05_not_a_safetensors_file(tmp_path, content):
    path = tmp_path / "f.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match='f.safetensors" is not a readable safetensors file'):
        read_checkpoint(path, "radiance")


def test06_a_truncated_file(tmp_path):
    path = tmp_path / "f.safetensors"
    write_checkpoint(path, "radiance", TENSORS, {})
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match="not a readable safetensors file"):
        read_checkpoint(path, "radiance")


def test07_somebody_elses_safetensors(tmp_path):
    path = tmp_path / "f.safetensors"
    save_file({"x": np.ones(2)}, path)
    with pytest.raises(ValueError, match="not a nerg_mi checkpoint"):
        read_checkpoint(path, "radiance")


@pytest.mark.parametrize("text", ["{", "[1]", "3", '"x"', ""])
def test08_damaged_metadata(tmp_path, text):
    path = tmp_path / "f.safetensors"
    save_file({"x": np.ones(2)}, path, metadata={"nerg": text})
    with pytest.raises(ValueError, match="f.safetensors"):
        read_checkpoint(path, "radiance")


def test09_another_kind_and_another_format(tmp_path):
    path = tmp_path / "f.safetensors"
    write_checkpoint(path, "gaze", TENSORS, {})
    with pytest.raises(ValueError, match="holds a gaze field"):
        read_checkpoint(path, "radiance")
    save_file(TENSORS, path, metadata={"nerg": json.dumps({"kind": "gaze", "format": 99})})
    with pytest.raises(ValueError, match="99.*1.*nerg_mi"):
        read_checkpoint(path, "gaze")


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


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"\1\2",
        (10**12).to_bytes(8, "little") + b"{}",
        (2).to_bytes(8, "little") + b"[]",
        (1 << 63).to_bytes(8, "little"),
        (200).to_bytes(8, "little")
        + b'{"x":{"dtype":"F32","shape":[1152921504606846976],"data_offsets":[0,0]}}'.ljust(200),
    ],
)
def test_headers_are_bounded(tmp_path, raw):
    (tmp_path / "f.safetensors").write_bytes(raw)
    with pytest.raises(NergError, match="f.safetensors"):
        read_checkpoint(tmp_path / "f.safetensors", "radiance")


def test_a_header_of_many_megabytes_is_not_read(tmp_path):
    (tmp_path / "f.safetensors").write_bytes((17 << 20).to_bytes(8, "little") + b" " * (17 << 20))
    with pytest.raises(NergError, match="more than the 16,777,216 that are read"):
        read_checkpoint(tmp_path / "f.safetensors", "radiance")


@pytest.mark.parametrize("size", [3 << 30, 64 << 30])
def test_what_is_no_checkpoint_is_refused_before_it_is_mapped(tmp_path, monkeypatch, size):
    with (tmp_path / "f.safetensors").open("wb") as out:
        out.truncate(size)
    monkeypatch.setattr("safetensors.safe_open", lambda *_, **__: pytest.fail("it was mapped"))
    with pytest.raises(NergError, match="f.safetensors.* (no JSON object|more than the 17,179,869,184 that are read)"):
        read_checkpoint(tmp_path / "f.safetensors", "radiance")


def test_metadata_nested_deep_are_refused(tmp_path):
    from safetensors.numpy import save_file

    deep = '{"kind": "radiance", "format": 1, "deep": ' + "[" * 100_000 + "]" * 100_000 + "}"
    save_file({"x": np.zeros(1, np.float32)}, tmp_path / "f.safetensors", metadata={"nerg": deep})
    with pytest.raises(NergError, match="f.safetensors.*nested"):
        read_checkpoint(tmp_path / "f.safetensors", "radiance")
