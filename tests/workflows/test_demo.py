"""The demo as a job: its stages, and its result. `tests/cli/test_demo` looks at the pictures."""

import csv

import numpy as np
import pytest

from nerg_mi.rays.rays import Rays
from nerg_mi.workflows import demo
from nerg_mi.workflows.demo import STAGES, make_demo
from nerg_mi.workflows.scene_commands import DemoOptions
from tests.figures.standins import write_standins
from tests.workflows.recorder import Recorder


@pytest.mark.nightly
def test_every_stage_is_told_and_every_file_is_there(tmp_path):
    told = Recorder()
    options = DemoOptions(defaults=write_standins(tmp_path), width=24, spp=1, mode="llvm_ad_rgb")
    result = make_demo(tmp_path / "demo", options, told)
    assert [text for _, text in told.steps] == list(STAGES) == list(result.seconds)
    assert [share for share, _ in told.steps] == [k / len(STAGES) for k in range(len(STAGES))]
    assert set(result.files) == set((tmp_path / "demo").iterdir()) and result.report["variant"] == "llvm_ad_rgb"
    assert told.messages == [f"wrote {path}" for path in result.files]


@pytest.mark.nightly
def test_its_report_has_the_tracked_gaze(tmp_path):
    """Of the store's own field; what is written of the observer is theirs alone, as without."""
    result = make_demo(tmp_path, DemoOptions(width=24, spp=1, mode="llvm_ad_rgb"))
    text = (tmp_path / "report.html").read_text("utf-8")
    rays = Rays.load(tmp_path / demo.TRACKED)
    assert tmp_path / demo.TRACKED in result.files and len(rays.persons) == 100 and len(rays) > 10_000
    assert "Where people were" in text and "not at hand" not in text and f"{len(rays):,} of 150,021 rows" in text
    assert "places where they stood" in text
    with (tmp_path / "aoi.csv").open() as file:
        shares = np.array([float(row["observer_share"]) for row in csv.DictReader(file)])
    # Of one observer, who sees some of the shelves: of three people together hardly any would have none.
    assert len(shares) == 30 and (shares == 0).sum() > 8 and 0 < shares.sum() < 1
