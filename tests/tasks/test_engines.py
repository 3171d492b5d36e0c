"""Parts that run locally, in processes, and on a cluster: results, progress, failures and kills."""

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
from nerg_mi.tasks import engines
from nerg_mi.tasks.engines import (
    ClusterEngine,
    LocalEngine,
    MissingInputFiles,
    PlanProgress,
    ProcessEngine,
    TaskResult,
    describe_exposure,
    find_local_host,
    import_distributed,
    make_security,
    open_engine,
    prepare_once,
    run_dask_worker,
    run_plan,
)
from nerg_mi.tasks.store import Store
from tests.conftest import ROOT
from tests.tasks import works
from tests.tasks.clusters import ClusterOfProcesses, free_port, wait_until

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
    monkeypatch.setattr(engines, "compute_code_digest", lambda: "0" * 16)
    with pytest.raises(NergError, match="the part a was planned by another version"):
        read_outputs(plan, store)


def test_progress_has_rate_and_time_left():
    progress = PlanProgress(10, reused=2, done=2)
    assert progress.format_line() == "2 of 10 parts" and progress.remaining_seconds is None and progress.fraction == 0.2
    progress.done, progress.seconds = 6, 8.0
    assert (
        progress.remaining_seconds == pytest.approx(8.0)
        and progress.format_line() == "6 of 10 parts, 30 per minute, 8 s left"
    )
    progress.seconds = 2.0
    assert progress.format_line(False) == "6 of 10 parts, 2 per second" and PlanProgress(0).fraction == 1.0


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


# ---- Parts on a cluster of real processes ----


@pytest.fixture
def cluster(tmp_path):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    with ClusterOfProcesses(tmp_path) as made:
        made.start_worker(), made.start_worker()
        wait_until(lambda: all("connected to" in made.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        yield made


def test_killed_worker_and_late_worker(cluster, tmp_path, runs):
    store, outputs = Store(tmp_path / "store"), []
    for made in run_plan(works.make_plan(12, runs=runs, seconds=0.3), store, ClusterEngine(cluster.address)):
        outputs.append(made.path.read_bytes())
        if len(outputs) == 2:
            cluster.workers[0].kill()
            cluster.start_worker()
    assert outputs == [works.expected(k) for k in range(12)] and set(works.count_runs(runs)) == set(range(12))
    # If the process of a worker is killed, as when memory is short, it is restarted and runs its part again.
    (tmp_path / "die").touch()
    plan = works.make_plan(3, die=tmp_path / "die", runs=runs, seconds=0.1)
    assert read_outputs(plan, store, ClusterEngine(cluster.address)) == [works.expected(k) for k in range(3)]
    assert not (tmp_path / "die").exists() and cluster.workers[1].poll() is None


def test_cluster_reports_errors_and_limits_threads(cluster, tmp_path, monkeypatch):
    store, engine = Store(tmp_path / "s"), ClusterEngine(cluster.address, threads=1)
    with pytest.raises(NergError, match=r"^the part refused: the scene has no light; give it one$"):
        read_outputs(works.make_small_plan("refused"), store, engine)
    with pytest.raises(RuntimeError, match=r"the part fault: TypeError: a mistake(?s:.*)works\.py"):
        read_outputs(works.make_small_plan("fault"), store, engine)
    with pytest.raises(NergError, match="the part deadly was started by several workers"):
        read_outputs(works.make_small_plan("deadly"), store, engine)
    made, scene = run_plan(works.make_small_plan("threads", "plugin"), store, engine)
    assert made.notes == {"threads": 1} and scene.notes == {"plugin": "NergIntegrator"}
    folders = list(run_plan(works.folders(5), store, engine))
    assert (folders[0].path / "below" / "b.txt").is_file() and folders[0].notes == {}
    plan = works.make_small_plan("b")
    monkeypatch.setitem(plan.__dict__, "shared", type(plan.shared)(plan.work, None, (), "0" * 16))
    with pytest.raises(NergError, match="the part b was planned by another version"):
        read_outputs(plan, store, engine)


def test_workers_without_files_receive_them(cluster, tmp_path, runs, monkeypatch):
    """Simulates another machine: the files do not exist at the planned paths."""
    for folder in ("here", "away"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "light.txt").write_text("light")
        (tmp_path / folder / "large.txt").write_text("x" * 20_000_000)
    files = (tmp_path / "here" / "light.txt", tmp_path / "here" / "large.txt")
    plan = works.make_plan(4, files, runs=runs, seconds=1.0)
    expected = [works.expected(k, files) for k in range(4)]
    assert len(plan.tasks) == 4 and plan.shared.files
    for file in files:
        file.unlink()
    original = engines.read_bytes
    monkeypatch.setattr(engines, "read_bytes", lambda path, *more: original(path.replace("here", "away"), *more))
    assert read_outputs(plan, Store(tmp_path / "store"), ClusterEngine(cluster.address)) == expected
    # A few parts are distributed over all workers, and not sent to the first one that has their inputs.
    assert len({path.name.split("-")[1] for path in runs.iterdir()}) == 2


def test_job_resumes_with_new_scheduler(cluster, tmp_path, runs):
    plan, store, count = works.make_plan(8, runs=runs, seconds=0.3), Store(tmp_path / "store"), 0
    with pytest.raises(NergError, match=f"the scheduler at {cluster.address} has stopped"):
        for _ in run_plan(plan, store, ClusterEngine(cluster.address)):
            count += 1
            if count == 2:
                cluster.kill_scheduler()
    completed, before = {receipt.label for receipt in store.iter_manifests()}, works.count_runs(runs)
    assert 2 <= len(completed) < 8
    assert cluster.workers[1].wait(60) == 0 and "has stopped; start the worker again" in cluster.log("worker1")
    cluster.start_scheduler()
    cluster.start_worker()
    assert read_outputs(plan, store, ClusterEngine(cluster.address)) == [works.expected(k) for k in range(8)]
    assert all(works.count_runs(runs)[k] == before[k] for k in range(8) if f"part {k}" in completed)


def test_sigterm_leaves_no_files(cluster, tmp_path):
    cluster.workers[0].terminate()
    assert cluster.workers[0].wait(60) == 130
    assert cluster.log("worker0").splitlines() == [f"connected to {cluster.address}", "Interrupted."]
    cluster.workers[1].terminate()
    assert cluster.workers[1].wait(60) == 130 and not list(tmp_path.glob("nerg-*"))


def test_missing_scheduler_is_reported(tmp_path):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    address = f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(NergError, match=f"no scheduler answers at {address}"):
        read_outputs(works.make_plan(1), Store(tmp_path / "s"), ClusterEngine(address, timeout=0.5))
    with pytest.raises(NergError, match=f"no scheduler answered at {address} within 1 s"):
        run_dask_worker(address, 1.0, print)


def test_files_are_localized(tmp_path):
    """The function that a worker calls, without a worker."""
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    plan = works.make_plan(1, (tmp_path / "a", tmp_path / "b"))
    inputs, common = plan.shared.files, plan.shared.common
    assert engines.localize_inputs(inputs, common, {}, tmp_path) == (inputs, common)
    (tmp_path / "b").write_text("of somebody else")
    with pytest.raises(MissingInputFiles):
        engines.localize_inputs(inputs, common, {inputs[0].sha256: b"a"}, tmp_path)
    files = {file.sha256: name for file, name in zip(inputs, (b"a", b"b"))}
    localized, moved = engines.localize_inputs(inputs, common, files, tmp_path)
    assert [path.read_text() for path in moved.files] == ["a", "b"] and [f.name for f in localized] == [
        f.name for f in inputs
    ]
    assert tmp_path / "b" not in moved.files and moved.files[0].name == "a"


# ---- Addresses ----


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "[::1]"])
def test_local_address_has_no_warning(host):
    assert describe_exposure(f"tcp://{host}:8786") is None


def test_only_unprotected_addresses_have_a_warning():
    assert describe_exposure("tls://192.0.2.1:8786") is None
    for host in ("192.0.2.1", "cluster.example", "[2001:db8::1]", "0.0.0.0"):
        said = describe_exposure(f"tcp://{host}:8786")
        assert said is not None and said.startswith(f"tcp://{host}:8786 is not protected")


def test_workers_listen_on_reachable_address():
    assert find_local_host("tcp://localhost:1") == find_local_host("tcp://127.0.0.1:1") == "127.0.0.1"
    assert find_local_host("tcp://[::1]:1") == "::1"


def test_tls_needs_certificates():
    distributed = pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    import dask

    assert make_security("tcp://a:1") is None
    with pytest.raises(NergError, match="tls:// needs certificates"):
        make_security("tls://a:1")
    with dask.config.set({"distributed.comm.tls.ca-file": "ca.pem"}):
        security = make_security("tls://a:1")
    assert isinstance(security, distributed.Security) and security.require_encryption


def test_missing_dask_names_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"nerg-mi\[cluster\]"):
        import_distributed()
