"""`nerg draw`: a sub-command for each kind of figure."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi.cli
from nerg_mi.files.images import write_exr
from nerg_mi.workflows.scene_commands import KINDS
from tests.workflows.drawing.test_draw_scenes import WALLS_SCENE as SCENE


def nerg(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    said = capsys.readouterr()
    return end.value.code or 0, said.out + said.err


def test_help_names_every_kind_and_their_options(capsys):
    code, said = nerg(capsys, "draw", "--help")
    assert code == 0 and all(name in said and kind.summary in said for name, kind in KINDS.items())
    code, said = nerg(capsys, "draw", "sphere", "--help")
    assert code == 0 and all(flag in said for flag in ("--projection", "--top", "--cmap", "-D", "--output", "--width"))
    assert "-D" not in nerg(capsys, "draw", "sheet", "--help")[1]


def test_a_difference(capsys, tmp_path):
    for k in (1.0, 2.0):
        write_exr(tmp_path / f"{k:.0f}.exr", {"gaze.Y": np.full((20, 30), k, np.float32)})
    line = ("draw", "difference", tmp_path / "1.exr", tmp_path / "2.exr", "-o", tmp_path / "new" / "a.svg", "--top", 3)
    code, said = nerg(capsys, *line)
    assert code == 0 and f"Wrote {tmp_path}/new/a.svg" in said and b"<svg" in (tmp_path / "new" / "a.svg").read_bytes()


def test_values_for_the_scene(capsys, tmp_path):
    from tests.workflows.drawing.test_floor import walk

    walk().save(tmp_path / "rays.npz")
    text = SCENE.replace('<scene version="3.0.0">', '<scene version="3.0.0"><default name="tall" value="1"/>')
    (tmp_path / "scene.xml").write_text(text.replace('y="0.2" z="1"', 'y="0.2" z="$tall"'))
    line = ("draw", "floor", tmp_path / "rays.npz", "--scene", tmp_path / "scene.xml", "-m", "llvm_ad_rgb", "-o")
    for k, more in enumerate(((), ("-D", "tall=0.1"))):
        assert nerg(capsys, *line, tmp_path / f"{k}.png", *more)[0] == 0
    assert (tmp_path / "0.png").read_bytes() != (tmp_path / "1.png").read_bytes()
    code, said = nerg(capsys, *line, tmp_path / "a.png", "-D", "tal=0.1")
    assert code == 1 and 'asks for no "$tal"' in said


def test_what_is_refused_in_a_sentence(capsys, tmp_path):
    for line, wanted in (
        (("draw", "sheet", tmp_path / "gone.png", "-o", tmp_path / "a.png"), "there is no file"),
        (("draw", "sphere", tmp_path / "gone.xml", "-o", tmp_path / "a.gif"), "end in .png or .svg"),
    ):
        code, said = nerg(capsys, *line)
        assert code == 1 and wanted in said and "Traceback" not in said
