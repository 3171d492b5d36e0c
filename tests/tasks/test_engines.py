"""Parts that run locally and in processes: results, progress, failures and kills."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import threading
import time

import drjit as dr
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import execution
from nerg_mi.tasks.cluster import ClusterEngine
from nerg_mi.tasks.engines import LocalEngine, PlanProgress, ProcessEngine, open_engine, run_plan
from nerg_mi.tasks.execution import TaskResult, prepare_once
from nerg_mi.tasks.store import Store
from tests.conftest import ROOT
from tests.tasks import works

# ---- Local engine and process engine ----


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return Store(tmp_path / "store")


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


class Backwards:
    """Runs all tasks at once, in reverse order."""

    def run(self, shared, tasks, store, warn):
        yield from reversed(list(LocalEngine().run(shared, tasks, store, warn)))


def read_outputs(plan, store, engine=None, **options):
    return [output.path.read_bytes() for output in run_plan(plan, store, engine or LocalEngine(), **options)]


# ---- Plans ----


@pytest.mark.parametrize("engine", [LocalEngine(), Backwards()])
def test_outputs_come_in_the_order_of_the_plan(store, engine):
    assert read_outputs(works.make_plan(5), store, engine) == [works.expected(k) for k in range(5)]


def test_sums_are_reproducible_bit_by_bit(tmp_path):
    """The sum of the terms depends on their order."""
    plan = works.make_small_plan(*(f"term {k}" for k in range(40)))

    def total(engine, name):
        out = 0.0
        for made in run_plan(plan, Store(tmp_path / name), engine):
            out += made.notes["term"]
        return struct.pack("<d", out)

    terms = [works.write_mixture(None, f"term {k}", tmp_path / "t")["term"] for k in range(40)]
    assert total(LocalEngine(), "a") == total(Backwards(), "b") == struct.pack("<d", in_order(terms))
    assert in_order(terms) != in_order(terms[::-1])


def in_order(terms):
    out = 0.0
    for term in terms:
        out += term
    return out


def test_results_are_reused_and_damaged_outputs_recomputed(store, runs):
    plan = works.make_plan(4, runs=runs)
    first = read_outputs(plan, store)
    assert read_outputs(plan, store) == first and works.count_runs(runs) == dict.fromkeys(range(4), 1)
    store.output_path(plan.tasks[2].key, ".txt").write_text("damaged")
    assert read_outputs(plan, store) == first and works.count_runs(runs) == {0: 1, 1: 1, 2: 2, 3: 1}


def test_changed_input_invalidates_only_dependents(store, tmp_path):
    for name in "ab":
        (tmp_path / name).write_text("before")
    plan = lambda: works.read_one(tmp_path / "a", tmp_path / "b")
    steps = []
    counts = lambda progress: steps.append((progress.reused, progress.done))
    read_outputs(plan(), store)
    (tmp_path / "a").write_text("after")
    assert read_outputs(plan(), store, on_progress=counts) == [b"after", b"before"] and steps == [(1, 1), (1, 2)]
    # Changed back: the outputs for the original bytes still exist.
    (tmp_path / "a").write_text("before")
    steps.clear()
    read_outputs(plan(), store, on_progress=counts)
    assert steps == [(2, 2)]


def test_input_that_changes_during_job_stops_it(store, runs, tmp_path):
    file = tmp_path / "a"
    file.write_text("before")
    with pytest.raises(NergError, match="was changed while the job was running"):
        for k, _ in enumerate(run_plan(works.make_plan(4, (file,), runs=runs), store, LocalEngine())):
            if k == 1:
                file.write_text("after it")
    assert works.count_runs(runs) == {0: 1, 1: 1} and len(list(store.iter_manifests())) == 2


def test_input_that_changes_while_read_is_detected(store, tmp_path):
    (tmp_path / "a").write_text("before")
    with pytest.raises(NergError, match="was changed while the job was running"):
        read_outputs(works.change_one(tmp_path / "a"), store)
    assert not list(store.iter_manifests())


def test_equal_parts_are_run_once(store):
    shares, counts = [], []
    plan = works.make_small_plan("a", "a", "a")
    assert read_outputs(plan, store, on_progress=lambda p: shares.append(p.fraction)) == [b"a\n"] * 3
    read_outputs(plan, store, on_progress=lambda p: counts.append((p.reused, p.done, p.total)))
    assert shares == [0.0, 1.0] and counts == [(3, 3, 3)]


def test_errors_name_the_part(store):
    with pytest.raises(NergError, match=r"^the part refused: the scene has no light; give it one$"):
        read_outputs(works.make_small_plan("a", "refused"), store)
    assert [receipt.label for receipt in store.iter_manifests()] == ["the part a"]
    with pytest.raises(RuntimeError, match="the part fault: TypeError: a mistake"):
        read_outputs(works.make_small_plan("fault"), store)


def test_parts_of_another_version_are_refused(store, monkeypatch):
    plan = works.make_small_plan("a")
    assert plan.shared.code_digest
    monkeypatch.setattr(execution, "compute_code_digest", lambda: "0" * 16)
    with pytest.raises(NergError, match="the part a was planned by another version"):
        read_outputs(plan, store)


def test_progress_has_rate_and_time_left():
    progress = PlanProgress(10, reused=2, done=2)
    assert progress.format_line() == "2 of 10 parts" and progress.remaining_seconds is None
    assert progress.fraction == pytest.approx(0.2)
    progress.done, progress.seconds = 6, 8.0
    assert (
        progress.remaining_seconds == pytest.approx(8.0)
        and progress.format_line() == "6 of 10 parts, 30 per minute, 8 s left"
    )
    progress.seconds = 2.0
    assert progress.format_line(False) == "6 of 10 parts, 2 per second"
    assert PlanProgress(0).fraction == pytest.approx(1)


def test_other_processors_cause_one_warning(store):
    class Elsewhere:
        def run(self, shared, tasks, store, warn):
            for k, done in enumerate(LocalEngine().run(shared, tasks, store, warn)):
                receipt = type(done.manifest)(**{**vars(done.manifest), "processor": "another" if k else "one"})
                yield TaskResult(done.task, receipt)

    warnings = []
    read_outputs(works.make_plan(4), store, Elsewhere(), warn=warnings.append)
    (line,) = warnings
    assert '"another" and "one"' in line


def test_closing_stops_the_work(store, runs):
    taken = run_plan(works.make_plan(9, runs=runs), store, LocalEngine())
    next(taken), next(taken)
    taken.close()
    assert works.count_runs(runs) == {0: 1, 1: 1}


def test_common_data_is_prepared_once():
    made, one, other = [], object(), object()
    make = lambda: made.append(1) or len(made)
    assert [prepare_once(common, make) for common in (one, one, other, other, one)] == [1, 1, 2, 2, 3]


def test_engines_by_name():
    assert isinstance(open_engine(None), LocalEngine) and isinstance(open_engine("local"), LocalEngine)
    two = open_engine("local:2", 3)
    assert isinstance(two, ProcessEngine) and (two.count, two.threads) == (2, 3)
    with pytest.raises(NergError, match="unknown scheduler"):
        open_engine("nowhere")
    for name in ("local:0", "local:100000"):
        with pytest.raises(NergError, match="1 to 1024"):
            open_engine(name)
    for name in ("tcp://a", "tcp://a:0", "http://a:1", "tcp://a:b"):
        with pytest.raises(NergError, match="is not a scheduler address"):
            ClusterEngine(name)


# ---- Processes ----


def test_two_processes_work_at_once_with_their_threads(store, tmp_path, runs):
    (tmp_path / "a").write_text("light")
    plan = works.make_plan(4, (tmp_path / "a",), seconds=0.5, runs=runs)
    assert read_outputs(plan, store, ProcessEngine(2)) == [works.expected(k, (tmp_path / "a",)) for k in range(4)]
    assert len({path.name.split("-")[1] for path in runs.iterdir()}) == 2
    made, scene = run_plan(works.make_small_plan("threads", "plugin"), store, ProcessEngine(1, threads=1))
    assert made.notes == {"threads": 1} and dr.thread_count() >= 1
    # The part imports Mitsuba only.
    assert scene.notes == {"plugin": "NergIntegrator"}


def test_dead_process_is_replaced(store, tmp_path, runs):
    (tmp_path / "die").touch()
    warnings = []
    plan = works.make_plan(5, die=tmp_path / "die", runs=runs)
    assert read_outputs(plan, store, ProcessEngine(2), warn=warnings.append) == [works.expected(k) for k in range(5)]
    (line,) = warnings
    # All running parts end with the process; which of them terminated it is unknown.
    assert "a process was terminated at part" in line and works.count_runs(runs)[0] <= 2


def test_part_that_kills_its_process_is_named(store):
    warnings = []
    with pytest.raises(NergError, match="a process was terminated at the part deadly, 3 times"):
        read_outputs(works.make_small_plan("a", "deadly"), store, ProcessEngine(1), warn=warnings.append)
    assert len(warnings) == 2 and [receipt.label for receipt in store.iter_manifests()] == ["the part a"]


def test_errors_of_processes_equal_local_ones(store):
    with pytest.raises(NergError, match=r"^the part refused: the scene has no light; give it one$"):
        read_outputs(works.make_small_plan("refused"), store, ProcessEngine(1))
    with pytest.raises(RuntimeError, match="the part fault: TypeError: a mistake") as fault:
        read_outputs(works.make_small_plan("fault"), store, ProcessEngine(1))
    assert "works.py" in str(fault.value.__cause__)


def test_ctrl_c_ends_the_processes_at_once(store):
    # Renderings of other tests may have left Mitsuba's handler, which Python cannot restore.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(6.0, os.kill, (os.getpid(), signal.SIGINT))
    start = time.monotonic()
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        read_outputs(works.make_plan(4, seconds=600), store, ProcessEngine(2))
    assert time.monotonic() - start < 60


def test_killed_job_leaves_no_process_and_resumes(store, runs, tmp_path):
    code = (
        "from tests.tasks import works\nfrom nerg_mi.tasks.engines import *\nfrom nerg_mi.tasks.store import Store\n"
        "from pathlib import Path\nif __name__ == '__main__':\n"
        f" plan = works.make_plan(6, seconds=0.5, runs=Path({str(runs)!r}))\n"
        f" list(run_plan(plan, Store({str(store.folder)!r}), ProcessEngine(2)))\n"
    )
    (tmp_path / "job.py").write_text(code)
    job = subprocess.Popen([sys.executable, tmp_path / "job.py"], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
    until = time.monotonic() + 90
    while len(list(store.iter_manifests())) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    job.kill()
    job.wait()
    pids = {int(path.name.split("-")[1]) for path in runs.iterdir()}
    while any(os.path.exists(f"/proc/{pid}") for pid in pids) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in pids)
    done = {receipt.label for receipt in store.iter_manifests()}
    assert 2 <= len(done) < 6
    before = works.count_runs(runs)
    plan = works.make_plan(6, seconds=0.5, runs=runs)
    assert read_outputs(plan, store) == [works.expected(k) for k in range(6)]
    after = works.count_runs(runs)
    assert all(after[k] == before[k] for k in range(6) if f"part {k}" in done)
