"""Figures drawn and written, with where they come from."""

from __future__ import annotations

import hashlib
import json

import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.workflows.draw import draw
from tests.workflows.recorder import Recorder

from .test_files import write


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
