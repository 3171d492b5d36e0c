"""The commands of the quick start, one after the other as they stand there, on a small recording and with few steps."""

from __future__ import annotations

import re
import shlex
import shutil

import pytest

import nerg_mi.cli
from nerg_mi.workflows import demo
from tests.conftest import ROOT
from tests.figures.standins import write_standins

PAGE = ROOT / "docs" / "quickstart.md"
SMALLER = {
    "nerg render": "--spp 1 -D width=24 -D height=16",
    "nerg train": "--radius 0.6 --probes 8 --steps 2 --directions 64 --min-rays 8 --seed 1 --test-positions 4 --force",
    "nerg eval": "--min-rays 4",
    "nerg scene": "--width 36",
    "nerg report": "--width 36 --spp 1 --points 500",
    "nerg stats": "--eyes 8 --directions 256 --resamples 199",
}
"""What is added to a command, so that it takes a second."""


def lines() -> list[str]:
    """The commands of the page."""
    fences = "\n".join(re.findall(r"^```sh\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S))
    # The viewer serves until somebody ends it: tests/viewer tries it.
    return [line for line in fences.splitlines() if line.startswith("nerg ") and not line.startswith("nerg view")]


def test01_the_page_leads_from_a_recording_to_a_picture():
    done = [" ".join(line.split()[:2]) for line in lines()]
    order = ["nerg rays", "nerg train", "nerg eval", "nerg scene", "nerg render", "nerg report", "nerg stats"]
    assert [command for command in done[2:] if command in order][-len(order) :] == order
    assert set(SMALLER) <= set(done)


@pytest.mark.nightly
@pytest.mark.slow
def test02_its_commands_run(rgb, tmp_path, monkeypatch, capsys):
    from nerg_mi.scenes.store import layout, shoppers, twin

    rgb.set_variant("llvm_ad_rgb")
    store = tmp_path / "scenes" / "store"
    (store / "build").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    shutil.copy(demo.store_scene(), store)
    write_standins(store)
    shutil.copy(demo.store_scene().parent / "regions.json", store)
    recording = store / "build" / "shoppers.csv"
    shoppers.write_shoppers(layout.build(0), recording, say=str, shoppers=6, stops=(4, 5), scene=twin.load_twin())
    monkeypatch.chdir(tmp_path)
    for line in lines():
        words = shlex.split(line, comments=True)[1:]
        words += shlex.split(SMALLER.get(" ".join(line.split()[:2]), ""))
        with pytest.raises(SystemExit) as end:
            nerg_mi.cli.main(words)
        assert not end.value.code, (line, capsys.readouterr().err)
        for name in re.findall(r"-o (\S+)", line):
            assert (tmp_path / name).stat().st_size > 0, line
    # What the guess prints stands on the page.
    assert "preset skeleton" in PAGE.read_text(encoding="utf-8")
