"""The demo as a job: its stages, and its result. `tests/cli/test_demo` looks at the pictures."""

import pytest

from nerg_mi.jobs.demo import STAGES, DemoOptions, make_demo
from tests.figures.standins import write_standins
from tests.jobs.recorder import Recorder


@pytest.mark.nightly
def test_every_stage_is_told_and_every_file_is_there(tmp_path):
    told = Recorder()
    options = DemoOptions(defaults=write_standins(tmp_path), width=24, spp=1, mode="llvm_ad_rgb")
    result = make_demo(tmp_path / "demo", options, told)
    assert [text for _, text in told.steps] == list(STAGES) == list(result.seconds)
    assert [share for share, _ in told.steps] == [k / len(STAGES) for k in range(len(STAGES))]
    assert set(result.files) == set((tmp_path / "demo").iterdir()) and result.report["variant"] == "llvm_ad_rgb"
    assert told.messages == [f"wrote {path}" for path in result.files]
