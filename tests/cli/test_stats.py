"""`nerg stats`: what it takes and says."""

from __future__ import annotations

import pytest

import nerg_mi.cli
from tests.aoi.place import people, write_place


def nerg(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    return end.value.code or 0, capsys.readouterr()


def test01_from_the_command_line(tmp_path, capsys):
    write_place(tmp_path, gaze=False)
    people().save(tmp_path / "rays.npz")
    given = [
        "stats",
        tmp_path / "rays.npz",
        tmp_path / "scene.xml",
        "--areas",
        tmp_path / "areas.json",
        "-o",
        tmp_path / "out",
    ]
    code, said = nerg(capsys, *given, "--window", "early=0,8", "--resamples", 199, "-m", "llvm_ad_rgb")
    assert code == 0 and "480 rays of 6 people" in said.out + said.err
    text = (tmp_path / "out" / "things.md").read_text()
    assert "| window early | the sign | tracked | 6 |" in text


def test02_what_is_missing_is_told(tmp_path, capsys):
    people().save(tmp_path / "rays.npz")
    code, said = nerg(capsys, "stats", tmp_path / "rays.npz", "-o", tmp_path / "out")
    assert code == 1 and "--areas FILE" in said.err and not (tmp_path / "out").exists()
