"""Tests of `nerg_mi.workflows.draw`."""

from __future__ import annotations

import dataclasses
import hashlib
import json

import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.workflows.draw import draw, find_kind
from nerg_mi.workflows.scene_commands import KINDS
from tests.workflows.drawing.test_draw_files import write
from tests.workflows.recorder import Recorder

# ---- Figures drawn and written, with where they come from ----


def test_a_file_says_where_it_comes_from(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    told = Recorder()
    a = write(tmp_path / "a.exr")
    figure = draw("sheet", str(a), str(tmp_path / "new" / "b.png"), told, overlay="gaze", decades=2.0)
    width, height = (round(v) for v in figure.bbox.size)
    assert told.messages == [f"Wrote {tmp_path / 'new' / 'b.png'} ({width} x {height})."]
    with image.open(tmp_path / "new" / "b.png") as found:
        assert found.size == (width, height)
        about = json.loads(found.text["Comment"])
    assert about["what"] == "nerg draw sheet" and about["settings"] == {"overlay": "gaze", "decades": 2.0}
    assert about["inputs"] == {"a.exr": hashlib.sha256(a.read_bytes()).hexdigest()} and about["seed"] is None


def test_what_is_refused(tmp_path):
    a = write(tmp_path / "a.exr")
    with pytest.raises(NergError, match="end in .png or .svg"):
        draw("sheet", a, tmp_path / "b.pdf")
    with pytest.raises(MissingFile, match="gone.exr"):
        draw("sheet", tmp_path / "gone.exr")
    with pytest.raises(NergError, match="1.*400.*0"):
        draw("sheet", [])
    with pytest.raises(NergError, match='no figure "pie"'):
        draw("pie", a)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


# ---- The table of kinds ----


@pytest.mark.parametrize("name", KINDS)
def test_each_tells_what_it_is(name):
    kind = find_kind(name)
    assert kind.name == name and kind.summary.endswith(".") and kind.most >= 1
    assert kind.options() is not None and all(f.metadata["help"] for f in dataclasses.fields(kind.options))


def test_one_that_is_not_there():
    with pytest.raises(NergError, match='no figure "pie"; there are sphere, triptych'):
        find_kind("pie")
