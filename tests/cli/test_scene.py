"""`nerg scene`: from files on the line to a scene that `nerg render` renders."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi.cli
from tests.pictures import mitsuba_bitmap

MESH = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n"


def nerg(*arguments):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    return end.value.code or 0


def test01_a_mesh_becomes_a_picture(rgb, tmp_path, capsys):
    (tmp_path / "a.obj").write_text(MESH)
    scene = tmp_path / "new" / "scene.xml"
    line = ["--from=0,-3,2", "--to=0,0,0", "--width", 24, "-m", "llvm_ad_rgb"]
    assert nerg("scene", tmp_path / "a.obj", "-o", scene, *line) == 0
    assert f"wrote {scene}" in " ".join(capsys.readouterr().out.split())
    small = ["-m", "llvm_ad_rgb", "--spp", 4]
    assert nerg("render", scene, "-o", tmp_path / "a.png", *small) == 0
    picture = np.array(mitsuba_bitmap(tmp_path / "a.png"))
    assert picture.shape == (16, 24, 3) and picture[8, 12].min() > 60 and picture[0, 0].max() == 0
    assert nerg("render", scene, "-o", tmp_path / "depth.png", "--overlay", "depth", *small) == 0


@pytest.mark.parametrize(
    "line, said",
    [
        (["a.obj", "-o", "a.png"], "let its name end in .xml"),
        (["a.obj", "-o", "a.xml", "--observer", "1,2"], "--observer is three numbers"),
        (["a.obj", "-o", "a.xml", "--from", "here"], "--from is numbers with commas"),
        (["b.obj", "-o", "a.xml"], 'there is no file "b.obj"'),
    ],
)
def test02_one_sentence(rgb, tmp_path, monkeypatch, capsys, line, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.obj").write_text(MESH)
    assert nerg("scene", *line) == 1
    (last,) = capsys.readouterr().err.strip().splitlines()
    assert last.startswith("nerg: ") and said in last and not (tmp_path / "a.xml").exists()
