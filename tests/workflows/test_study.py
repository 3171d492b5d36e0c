"""The study as a job: which settings it takes, and what it tells meanwhile."""

import pytest

from nerg_mi.workflows.scene_commands import StudyOptions
from nerg_mi.workflows.study import run_study
from tests.workflows.recorder import Recorder


@pytest.mark.nightly
def test_only_some_settings(tmp_path):
    told = Recorder()
    options = StudyOptions(width=12, height=8, quick=True, only="jitter|paper, 1024 steps$", mode="llvm_ad_rgb")
    result = run_study("slab", tmp_path, options, told)
    report = result.report
    assert [r["setting"] for r in report["rows"]] == ["default", "jitter", "paper, 1024 steps"]
    # Of the share done the first renders have as much as the times, and the cost against size the rest.
    shares = [share for share, _ in told.steps]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] < 1
    assert 0.4 < told.share_at("time of default") < 0.5 and 0.8 < told.share_at("pixels 16") < 1
    assert told.messages[-len(result.files) :] == [f"wrote {path}" for path in result.files]
    assert all(path.is_file() for path in result.files) and told.messages[0].startswith("default: ")
