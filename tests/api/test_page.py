"""The code of docs/python.md runs as it stands there, only smaller."""

import re

import numpy as np
import pytest

import nerg_mi as nerg
from tests.conftest import ROOT

PAGE = ROOT / "docs" / "python.md"
MOST = 30
"""Lines of code from loading to a plotted share of attention."""


def blocks() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)


def smaller(text: str) -> str:
    small = text.replace("width=480, height=320", "width=24, height=16").replace("4.6, 10)", "4.6, 8)")
    small = small.replace("spp=4", "spp=1")
    assert small.count("width=24") == text.count("width=480")
    return small


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Runs the blocks of the page up to a number, in one folder; gives the names that they define."""
    import matplotlib

    matplotlib.use("Agg")
    folder, done = tmp_path_factory.mktemp("page"), {}

    def up_to(number: int, monkeypatch) -> dict:
        monkeypatch.chdir(folder)
        done.setdefault("names", {})
        for i in range(done.get("ran", 0), number + 1):
            exec(compile(smaller(blocks()[i]), f"docs/python.md, block {i}", "exec"), done["names"])
            done["ran"] = i + 1
        return done["names"] | {"folder": folder}

    return up_to


def test01_thirty_lines_lead_to_a_share_of_attention(run, monkeypatch):
    lines = [line for line in blocks()[0].splitlines() if line.strip()]
    assert len(lines) <= MOST
    names = run(0, monkeypatch)
    assert (names["folder"] / "attention.png").stat().st_size > 10_000
    share = np.array(list(names["share"].values()))
    assert share.shape == (4, 8) and (share >= 0).all() and (share.sum(axis=0) < 1.1).all() and share.max() > 0.01
    # Those who come nearer to the coolers look at them more.
    assert share[3, -1] > share[3, 0]
    assert names["view"].gaze.shape == (2, 16, 24)


def test02_fields_are_saved(run, monkeypatch, capsys):
    names = run(1, monkeypatch)
    assert nerg.load_field(names["folder"] / "copy.safetensors").kind == "radiance"


def test03_a_display_by_its_name(run, monkeypatch):
    names = run(2, monkeypatch)
    assert names["on_display"].share.shape == (1,) and names["on_display"].share[0] > 0


def test04_points_and_rays(run, monkeypatch):
    names = run(3, monkeypatch)
    assert names["seen"].gaze.shape == (1, 2) and names["down"].color.shape == (2, 3)
    assert 1.5 < names["down"].depth[0] < 1.7


def test06_every_name_is_listed():
    table = PAGE.read_text(encoding="utf-8").partition("## All names")[2]
    assert set(re.findall(r"`(\w+)`", table)) - {"save"} == set(nerg.__all__)


def test05_every_name_that_is_called_exists():
    for name in re.findall(r"\bnerg\.(?!py\b)(\w+)", PAGE.read_text(encoding="utf-8")):
        assert name in nerg.__all__, name
