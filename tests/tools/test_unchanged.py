"""What counts as a change of what a command makes, and what does not."""

from __future__ import annotations

import json
import stat

import numpy as np
import pytest
from safetensors.numpy import save_file

from tools import unchanged


def test_times_and_names_in_documents_do_not_count(tmp_path):
    arrays = {"a": np.arange(6, dtype=np.float32), "b": np.ones((2, 2), np.float32)}
    for name, metadata in (("one", {"made": "today"}), ("two", {"made": "tomorrow"})):
        save_file(arrays, tmp_path / f"{name}.safetensors", metadata=metadata)
        np.savez(tmp_path / f"{name}.npz", **arrays, document=np.array(json.dumps(metadata)))
    for suffix in (".safetensors", ".npz"):
        one, two = (unchanged.digest(tmp_path / f"{name}{suffix}") for name in ("one", "two"))
        assert one == two, suffix


def test_a_single_bit_counts(tmp_path):
    arrays = {"a": np.arange(6, dtype=np.float32)}
    other = {"a": arrays["a"].copy()}
    other["a"][3] = np.nextafter(np.float32(3), np.float32(4))
    for name, made in (("one", arrays), ("two", other)):
        save_file(made, tmp_path / f"{name}.safetensors")
        np.savez(tmp_path / f"{name}.npz", **made)
        (tmp_path / f"{name}.png").write_bytes(made["a"].tobytes())
    for suffix in (".safetensors", ".npz", ".png"):
        one, two = (unchanged.digest(tmp_path / f"{name}{suffix}") for name in ("one", "two"))
        assert one != two, suffix


def test_of_a_study_errors_count_and_times_do_not(tmp_path):
    def study(milliseconds, error):
        (tmp_path / "study.csv").write_text(f"setting,ms,depth_error\nstep,{milliseconds},{error}\n")
        return unchanged.errors_of_study(tmp_path)

    assert study(3, 0.5) == study(4, 0.5) != study(3, 0.6)


@pytest.fixture
def writer(tmp_path, monkeypatch):
    """A command in place of `nerg` that writes its first argument; gives what sets that argument."""
    script = tmp_path / "nerg"
    script.write_text('#!/bin/sh\n[ "$1" = fail ] && { echo "no room" >&2; exit 1; }\nprintf "%s" "$1" > "$3"\n')
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(unchanged, "NERG", str(script))

    def writes(**texts):
        monkeypatch.setattr(unchanged, "commands", lambda folder: [(f"{n}.txt", [t]) for n, t in texts.items()])

    return writes


def test_what_differs_is_named(writer, tmp_path, capsys):
    writer(a="1", b="2")
    assert unchanged.main(["record", str(tmp_path / "kept")]) == 0
    assert unchanged.main(["compare", str(tmp_path / "kept")]) == 0
    writer(a="1", b="3")
    assert unchanged.main(["compare", str(tmp_path / "kept")]) == 1
    assert capsys.readouterr().out.endswith("2 outputs, 1 of them differ\n  b.txt\n")
    assert unchanged.main(["compare", str(tmp_path / "kept"), "--only", "a"]) == 0


def test_a_command_that_fails_is_told(writer, tmp_path):
    writer(a="fail")
    assert unchanged.main(["record", str(tmp_path / "kept")]) == 1
    assert "no room" in (tmp_path / "kept" / "digests.json").read_text()
