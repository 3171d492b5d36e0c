"""The store and the engine of a job, and the report on a store."""

from __future__ import annotations

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.engines import LocalEngine, ProcessEngine, run_plan
from nerg_mi.tasks.jobs import format_bytes, report_jobs
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.store import Store
from tests.recorder import Recorder
from tests.tasks import works

# ---- From options to a store and an engine ----


def test_the_default_store_is_next_to_the_output(tmp_path):
    runner = PartRunner(Parallel(scheduler="local:2"), tmp_path / "walk.mp4", Recorder())
    assert runner.store.folder == tmp_path / "walk.tasks" and isinstance(runner.engine, ProcessEngine)
    named = PartRunner(Parallel(store=tmp_path / "s"), tmp_path / "walk.mp4", Recorder())
    assert named.store.folder == tmp_path / "s"


def test_progress_of_a_stage_is_scaled(tmp_path):
    recorder = Recorder()
    parts = PartRunner(Parallel(store=tmp_path / "s"), tmp_path / "a", recorder)
    assert len(list(parts.run(works.make_plan(2), 0.0, 0.8))) == 2
    assert len(list(parts.run(works.make_small_plan(*"abcd"), 0.8))) == 4
    assert [round(share, 2) for share, _ in recorder.steps] == [0.0, 0.4, 0.8, 0.8, 0.85, 0.9, 0.95, 1.0]
    texts = [text for _, text in recorder.steps]
    assert all(" left" not in text for text in texts[:3]) and texts[0] == "0 of 2 parts"
    assert texts[-1].startswith("4 of 4 parts") and texts[-1].endswith("0 s left")


def test_ctrl_c_reports_the_store(tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            raise KeyboardInterrupt

    parts = PartRunner(Parallel(store=tmp_path / "s"), tmp_path / "a", Impatient())
    with pytest.raises(KeyboardInterrupt, match=r"Interrupted; finished parts are stored in"):
        list(parts.run(works.make_plan(2)))


# ---- Messages about a store ----


def test_a_store_is_summarised_and_stale_outputs_removed(tmp_path):
    (tmp_path / "a").write_text("before")
    store = Store(tmp_path / "store")
    arriving = run_plan(works.make_plan(5, what="nerg render walk.mp4"), store, LocalEngine())
    next(arriving), next(arriving)
    arriving.close()
    list(run_plan(works.make_plan(2, (tmp_path / "a",), what="another"), store, LocalEngine()))
    (tmp_path / "a").write_text("after")
    recorder = Recorder()
    account = report_jobs(store.folder, progress=recorder)
    lines = recorder.messages[0].splitlines()
    assert lines[2].startswith("| another | 2 | 2 | 0 | 130 bytes | 0 s | 2 |")
    assert lines[3].startswith("| nerg render walk.mp4 | 5 | 2 | 3 | 130 bytes |")
    assert recorder.messages[1] == f"changed since another: {tmp_path / 'a'}"
    assert recorder.messages[2].startswith("260 bytes in total; stale: 2 outputs, 130 bytes;")
    assert "remove_stale=True" in recorder.messages[3] and len(account.stale) == 2
    recorder = Recorder()
    report_jobs(store.folder, remove_stale=True, progress=recorder)
    assert recorder.messages[-1] == "Removed 130 bytes." and len(list(store.iter_manifests())) == 2


def test_a_missing_store_is_refused(tmp_path):
    with pytest.raises(NergError, match="there is no folder"):
        report_jobs(tmp_path / "none")


def test_sizes_are_formatted():
    counts = (0, 999, 1200, 34_000, 5_600_000, 7.8e9, 2e12)
    assert [format_bytes(n) for n in counts] == [
        "0 bytes",
        "999 bytes",
        "1.2 kB",
        "34 kB",
        "5.6 MB",
        "7.8 GB",
        "2.0 TB",
    ]
