"""The Python of docs/pictures.md runs as it stands there, only on a smaller scene."""

from __future__ import annotations

import os
import re

import pytest

from tests.conftest import ROOT
from tests.workflows.drawing.scenes import write_scene
from tests.workflows.drawing.test_floor import walk

PAGE = ROOT / "docs" / "pictures.md"


@pytest.fixture
def folder(tmp_path, rgb, monkeypatch):
    """Where the page's files are, as it names them."""
    import nerg_mi as nerg

    path = write_scene(tmp_path)
    walk().save(tmp_path / "rays.npz")
    (tmp_path / "shoppers.safetensors").write_bytes((tmp_path / "gaze.safetensors").read_bytes())
    monkeypatch.chdir(tmp_path)
    return {"nerg": nerg, "scene": nerg.Scene.load(str(path))}


def test_every_block_runs(folder):
    blocks = re.findall(r"^```py\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    assert len(blocks) == 3
    for block in blocks:
        if "from PIL" in block:
            pytest.importorskip("PIL.Image", reason="Pillow is not installed")
            folder["draw"]("floor", "rays.npz", "gaze.png")
        smaller = block.replace("scenes/store/scene.xml", "scene.xml").replace("width=480", "width=64, spp=1")
        exec(compile(smaller, "docs/pictures.md", "exec"), folder)
    assert {"floor.svg", "gaze.svg"} <= set(os.listdir("."))
    assert b"my notebook" in open("gaze.svg", "rb").read()
