"""`nerg poses`: errors in one sentence, Ctrl-C, and what stands in the way; the command on photos of a known place."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerg_mi.cli import main
from nerg_mi.workflows import poses as job
from tests.photos import rendered


def nerg(capsys, *arguments) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        main(["poses", *map(str, arguments)])
    said = capsys.readouterr()
    return end.value.code or 0, said.out, said.err


@pytest.fixture
def photos(tmp_path) -> Path:
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.fromarray(np.full((8, 9, 3), 50 * k, np.uint8)).save(tmp_path / "photos" / f"{k}.png")
    return tmp_path / "photos"


def test_without_the_extra(photos, capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    code, _, said = nerg(capsys, photos, "-o", tmp_path / "capture")
    assert code == 1 and said.count("\n") == 1 and 'pip install "nerg-mi[poses]"' in said
    assert os.listdir(tmp_path) == ["photos"]


@pytest.fixture
def installed(monkeypatch):
    monkeypatch.setattr(job, "check_installed", lambda: None)


def test_what_stands_in_the_way_is_told_before_work(installed, photos, capsys, tmp_path):
    (tmp_path / "file").write_text("old")
    for out, words in ((photos, "not empty: choose another name, or remove it"), (tmp_path / "file", "is a file")):
        code, _, said = nerg(capsys, photos, "-o", out)
        assert code == 1 and words in said and said.count("\n") == 1
    assert (tmp_path / "file").read_text() == "old" and len(os.listdir(photos)) == 3


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["{p}/0.png"], "is a single photo"),
        (["{p}/nowhere"], "there is no video"),
        (["{t}"], "holds no photos"),
        (["{p}", "--lens", "fish"], "lens must be auto, radial, opencv"),
        (["{p}", "--matching", "fish"], "matching must be auto, exhaustive, sequential"),
    ],
)
def test_errors_take_a_sentence(installed, arguments, words, photos, capsys, monkeypatch, tmp_path):
    from nerg_mi.photos import structure

    monkeypatch.setattr(structure, "check_installed", lambda: None)
    out = tmp_path / "capture"
    code, _, said = nerg(capsys, *[a.format(p=photos, t=tmp_path) for a in arguments], "-o", out)
    assert code == 1 and words in said and said.count("\n") == 1 and os.listdir(tmp_path) == ["photos"]


def test_links_are_followed_only_if_allowed(installed, photos, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(job, "reconstruct", lambda *given: None)
    (photos / "2.png").rename(tmp_path / "2.png")
    (photos / "2.png").symlink_to(tmp_path / "2.png")
    code, _, said = nerg(capsys, photos, "-o", tmp_path / "capture")
    assert code == 1 and "has 2 pictures" in said and "--allow-outside" in said and said.count("\n") == 1
    code, _, said = nerg(capsys, photos, "-o", tmp_path / "capture", "--allow-outside")
    assert code == 1 and "no 3 of the 3 pictures" in said


def test_ctrl_c_ends_with_130_and_leaves_nothing(installed, photos, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(job, "reconstruct", lambda *given: signal.raise_signal(signal.SIGINT))
    code, _, said = nerg(capsys, photos, "-o", tmp_path / "capture")
    assert code == 130 and "Interrupted" in said and os.listdir(tmp_path) == ["photos"]


def test_the_command(capsys, tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip('pycolmap is not installed (pip install "nerg-mi[poses]")')
    photos = rendered.write_photos(tmp_path / "photos", 6)
    code, said, wrong = nerg(capsys, photos, "-o", tmp_path / "capture", "--threads", "1")
    assert code == 0 and "6 of 6 pictures have a pose" in said and "warning" not in wrong
    assert sorted(os.listdir(tmp_path / "capture")) == ["images", "poses.json", "poses.png", "sparse"]
    with pytest.raises(SystemExit) as end:
        main(["train", "radiance", str(tmp_path / "capture"), "-o", str(tmp_path / "a.safetensors"), "--steps", "2"])
    assert not end.value.code and "points on surfaces" in capsys.readouterr().out
