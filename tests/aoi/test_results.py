"""Results as a folder of files."""

from __future__ import annotations

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.aoi.output import write_results
from nerg_mi.workflows.statistics import StatisticsResult
from tests.workflows.recorder import Recorder

THING = {
    "cell": "all",
    "value": "",
    "thing": "a",
    "source": "tracked",
    "people": 4,
    "share": 0.2,
    "reach": 0.5,
    "dwell": 3.0,
}


def test01_what_there_is_and_nothing_else(tmp_path):
    place = {"x": 0.0, "y": 0.0, "z": 1.6, "area": 2.0}
    recorder = Recorder()
    made = StatisticsResult(things=[THING], isovists=[place, place | {"x": 0.25}], blanked=2)
    files = write_results(tmp_path, made, [], StatisticsOptions(), recorder)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in files)
    names = {p.name for p in files}
    assert {"things.csv", "things.md", "things.png", "isovists.png", "blanked.txt", "about.json"} <= names
    assert not any(name.startswith(("moves", "what_if", "people")) for name in names)
    assert "2 numbers" in (tmp_path / "blanked.txt").read_text() and recorder.messages


def test02_equal_results_are_equal_files(tmp_path):
    made = StatisticsResult(things=[THING])
    for name in "ab":
        (tmp_path / name).mkdir()
        write_results(tmp_path / name, made, [], StatisticsOptions(), Recorder())
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name
