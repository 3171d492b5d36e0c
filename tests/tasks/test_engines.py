"""Parts run here, in processes, and on a cluster: results, progress, failures and kills."""

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
    TaskResult,
    MissingInputFiles,
    LocalEngine,
    PlanProgress,
    ProcessEngine,
    import_distributed,
    open_engine,
    find_local_host,
    prepare_once,
    run_plan,
    make_security,
    run_dask_worker,
    describe_exposure,
)
from nerg_mi.tasks.store import Store
from tests.conftest import ROOT
from tests.tasks import works
from tests.tasks.clusters import ClusterOfProcesses, free_port, wait_until

# ---- Plans carried out here and by processes of this machine ----


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return Store(tmp_path / "store")


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


class Backwards:
    """Runs everything at once, the last first."""

    def run(self, shared, tasks, store, warn):
        yield from reversed(list(LocalEngine().run(shared, tasks, store, warn)))


def contents(plan, store, engine=None, **more):
    return [output.path.read_bytes() for output in run_plan(plan, store, engine or LocalEngine(), **more)]


# ---- Plans carried out ----


@pytest.mark.parametrize("engine", [LocalEngine(), Backwards()])
def test_outputs_come_in_the_order_of_the_plan(store, engine):
    assert contents(works.make_plan(5), store, engine) == [works.expected(k) for k in range(5)]


def test_sums_in_the_order_of_the_plan_are_equal_to_the_bit(tmp_path):
    """Of terms whose sum depends on the order in which they are added."""
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


def test_what_is_done_is_kept_and_a_damaged_output_is_made_again(store, runs):
    plan = works.make_plan(4, runs=runs)
    first = contents(plan, store)
    assert contents(plan, store) == first and works.count_runs(runs) == dict.fromkeys(range(4), 1)
    store.output_path(plan.tasks[2].key, ".txt").write_text("damaged")
    assert contents(plan, store) == first and works.count_runs(runs) == {0: 1, 1: 1, 2: 2, 3: 1}


def test_a_changed_input_invalidates_what_depends_on_it_and_nothing_more(store, tmp_path):
    for name in "ab":
        (tmp_path / name).write_text("before")
    plan = lambda: works.read_one(tmp_path / "a", tmp_path / "b")
    steps = []
    counts = lambda progress: steps.append((progress.reused, progress.done))
    contents(plan(), store)
    (tmp_path / "a").write_text("after")
    assert contents(plan(), store, on_progress=counts) == [b"after", b"before"] and steps == [(1, 1), (1, 2)]
    # And back again: what was made of the former bytes is still there.
    (tmp_path / "a").write_text("before")
    steps.clear()
    contents(plan(), store, on_progress=counts)
    assert steps == [(2, 2)]


def test_an_input_that_changes_in_the_middle_ends_the_job_and_leaves_nothing_mixed(store, runs, tmp_path):
    file = tmp_path / "a"
    file.write_text("before")
    with pytest.raises(NergError, match="was changed while the job was running"):
        for k, _ in enumerate(run_plan(works.make_plan(4, (file,), runs=runs), store, LocalEngine())):
            if k == 1:
                file.write_text("after it")
    assert works.count_runs(runs) == {0: 1, 1: 1} and len(list(store.iter_manifests())) == 2


def test_an_input_that_changes_while_it_is_read_is_noticed(store, tmp_path):
    (tmp_path / "a").write_text("before")
    with pytest.raises(NergError, match="was changed while the job was running"):
        contents(works.change_one(tmp_path / "a"), store)
    assert not list(store.iter_manifests())


def test_equal_parts_are_run_once_and_given_as_often_as_they_are_planned(store):
    shares, counts = [], []
    plan = works.make_small_plan("a", "a", "a")
    assert contents(plan, store, on_progress=lambda p: shares.append(p.fraction)) == [b"a\n"] * 3
    contents(plan, store, on_progress=lambda p: counts.append((p.reused, p.done, p.total)))
    assert shares == [0.0, 1.0] and counts == [(3, 3, 3)]


def test_errors_name_the_part(store):
    with pytest.raises(NergError, match=r"^the part refused: the scene has no light; give it one$"):
        contents(works.make_small_plan("a", "refused"), store)
    assert [receipt.label for receipt in store.iter_manifests()] == ["the part a"]
    with pytest.raises(RuntimeError, match="the part fault: TypeError: a mistake"):
        contents(works.make_small_plan("fault"), store)


def test_parts_that_another_version_planned_are_refused(store, monkeypatch):
    plan = works.make_small_plan("a")
    assert plan.shared.code_digest
    monkeypatch.setattr(engines, "compute_code_digest", lambda: "0" * 16)
    with pytest.raises(NergError, match="the part a was planned by another version"):
        contents(plan, store)


def test_progress_has_rate_and_time_left():
    progress = PlanProgress(10, reused=2, done=2)
    assert progress.format_line() == "2 of 10 parts" and progress.remaining_seconds is None and progress.fraction == 0.2
    progress.done, progress.seconds = 6, 8.0
    assert progress.remaining_seconds == pytest.approx(8.0) and progress.format_line() == "6 of 10 parts, 30 a minute, 8 s left"
    progress.seconds = 2.0
    assert progress.format_line(False) == "6 of 10 parts, 2 a second" and PlanProgress(0).fraction == 1.0


def test_other_processors_are_told_of_once(store):
    class Elsewhere:
        def run(self, shared, tasks, store, warn):
            for k, done in enumerate(LocalEngine().run(shared, tasks, store, warn)):
                receipt = type(done.manifest)(**{**vars(done.manifest), "processor": "another" if k else "one"})
                yield TaskResult(done.task, receipt)

    told = []
    contents(works.make_plan(4), store, Elsewhere(), warn=told.append)
    (line,) = told
    assert '"another" and "one"' in line


def test_closing_stops_the_work(store, runs):
    taken = run_plan(works.make_plan(9, runs=runs), store, LocalEngine())
    next(taken), next(taken)
    taken.close()
    assert works.count_runs(runs) == {0: 1, 1: 1}


def test_what_parts_have_in_common_is_prepared_once():
    made, one, other = [], object(), object()
    make = lambda: made.append(1) or len(made)
    assert [prepare_once(common, make) for common in (one, one, other, other, one)] == [1, 1, 2, 2, 3]


def test_engines_by_their_names():
    assert isinstance(open_engine(None), LocalEngine) and isinstance(open_engine("local"), LocalEngine)
    two = open_engine("local:2", 3)
    assert isinstance(two, ProcessEngine) and (two.count, two.threads) == (2, 3)
    with pytest.raises(NergError, match="there is no scheduler"):
        open_engine("nowhere")
    for name in ("local:0", "local:100000"):
        with pytest.raises(NergError, match="1 to 1024"):
            open_engine(name)
    for name in ("tcp://a", "tcp://a:0", "http://a:1", "tcp://a:b"):
        with pytest.raises(NergError, match="is no address of a scheduler"):
            ClusterEngine(name)


# ---- Processes ----


def test_two_processes_work_at_once_with_their_threads(store, tmp_path, runs):
    (tmp_path / "a").write_text("light")
    plan = works.make_plan(4, (tmp_path / "a",), seconds=0.5, runs=runs)
    assert contents(plan, store, ProcessEngine(2)) == [works.expected(k, (tmp_path / "a",)) for k in range(4)]
    assert len({path.name.split("-")[1] for path in runs.iterdir()}) == 2
    (made,) = run_plan(works.make_small_plan("threads"), store, ProcessEngine(1, threads=1))
    assert made.notes == {"threads": 1} and dr.thread_count() >= 1


def test_a_process_that_dies_costs_time_and_nothing_else(store, tmp_path, runs):
    (tmp_path / "die").touch()
    told = []
    plan = works.make_plan(5, die=tmp_path / "die", runs=runs)
    assert contents(plan, store, ProcessEngine(2), warn=told.append) == [works.expected(k) for k in range(5)]
    (line,) = told
    # All parts that were being made end with the process: which of them has ended it cannot be told.
    assert "a process was ended at part" in line and works.count_runs(runs)[0] <= 2


def test_a_part_that_always_kills_its_process_is_named(store):
    told = []
    with pytest.raises(NergError, match="a process was ended at the part deadly, 3 times"):
        contents(works.make_small_plan("a", "deadly"), store, ProcessEngine(1), warn=told.append)
    assert len(told) == 2 and [receipt.label for receipt in store.iter_manifests()] == ["the part a"]


def test_errors_of_processes_are_those_of_this_one(store):
    with pytest.raises(NergError, match=r"^the part refused: the scene has no light; give it one$"):
        contents(works.make_small_plan("refused"), store, ProcessEngine(1))
    with pytest.raises(RuntimeError, match="the part fault: TypeError: a mistake") as fault:
        contents(works.make_small_plan("fault"), store, ProcessEngine(1))
    assert "works.py" in str(fault.value.__cause__)


def test_ctrl_c_ends_the_processes_at_once(store):
    # Pictures of other tests may have left Mitsuba's handler, which Python does not know of.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(6.0, os.kill, (os.getpid(), signal.SIGINT))
    start = time.monotonic()
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        contents(works.make_plan(4, seconds=600), store, ProcessEngine(2))
    assert time.monotonic() - start < 60


def test_a_job_that_is_killed_leaves_no_process_and_goes_on_where_it_ended(store, runs, tmp_path):
    code = (
        "from tests.tasks import works\nfrom nerg_mi.tasks.engines import *\nfrom nerg_mi.tasks.store import Store\n"
        "from pathlib import Path\nif __name__ == '__main__':\n"
        f" plan = works.plan(6, seconds=0.5, runs=Path({str(runs)!r}))\n"
        f" list(run_plan(plan, Store({str(store.folder)!r}), Processes(2)))\n"
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
    assert contents(plan, store) == [works.expected(k) for k in range(6)]
    after = works.count_runs(runs)
    assert all(after[k] == before[k] for k in range(6) if f"part {k}" in done)


# ---- Parts on a cluster of real processes ----


@pytest.fixture
def cluster(tmp_path):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    with ClusterOfProcesses(tmp_path) as made:
        made.start_worker(), made.start_worker()
        wait_until(lambda: all("works for" in made.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        yield made


def test_a_worker_that_is_killed_and_one_that_comes_late(cluster, tmp_path, runs):
    store, outputs = Store(tmp_path / "store"), []
    for made in run_plan(works.make_plan(12, runs=runs, seconds=0.3), store, ClusterEngine(cluster.address)):
        outputs.append(made.path.read_bytes())
        if len(outputs) == 2:
            cluster.workers[0].kill()
            cluster.start_worker()
    assert outputs == [works.expected(k) for k in range(12)] and set(works.count_runs(runs)) == set(range(12))
    # A process of a worker that ends, as where memory is short, is started again, and its part is run again.
    (tmp_path / "die").touch()
    plan = works.make_plan(3, die=tmp_path / "die", runs=runs, seconds=0.1)
    assert contents(plan, store, ClusterEngine(cluster.address)) == [works.expected(k) for k in range(3)]
    assert not (tmp_path / "die").exists() and cluster.workers[1].poll() is None


def test_errors_of_parts_are_the_jobs_and_threads_those_it_asks_for(cluster, tmp_path, monkeypatch):
    store, engine = Store(tmp_path / "s"), ClusterEngine(cluster.address, threads=1)
    with pytest.raises(NergError, match=r"^the part refused: the scene has no light; give it one$"):
        contents(works.make_small_plan("refused"), store, engine)
    with pytest.raises(RuntimeError, match=r"the part fault: TypeError: a mistake(?s:.*)works\.py"):
        contents(works.make_small_plan("fault"), store, engine)
    with pytest.raises(NergError, match="the part deadly was begun by several workers"):
        contents(works.make_small_plan("deadly"), store, engine)
    (made,) = run_plan(works.make_small_plan("threads"), store, engine)
    assert made.notes == {"threads": 1}
    folders = list(run_plan(works.folders(5), store, engine))
    assert (folders[0].path / "below" / "b.txt").is_file() and folders[0].notes == {}
    plan = works.make_small_plan("b")
    monkeypatch.setitem(plan.__dict__, "shared", type(plan.shared)(plan.work, None, (), "0" * 16))
    with pytest.raises(NergError, match="the part b was planned by another version"):
        contents(plan, store, engine)


def test_workers_that_have_no_files_are_sent_them(cluster, tmp_path, runs, monkeypatch):
    """As if on another machine: the files are not where they were planned."""
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
    assert contents(plan, Store(tmp_path / "store"), ClusterEngine(cluster.address)) == expected
    # Few parts go to all workers too, and not to the one that has what they need first.
    assert len({path.name.split("-")[1] for path in runs.iterdir()}) == 2


def test_a_scheduler_that_ends_ends_the_job_which_goes_on_with_another(cluster, tmp_path, runs):
    plan, store, count = works.make_plan(8, runs=runs, seconds=0.3), Store(tmp_path / "store"), 0
    with pytest.raises(NergError, match=f"the scheduler at {cluster.address} is gone"):
        for _ in run_plan(plan, store, ClusterEngine(cluster.address)):
            count += 1
            if count == 2:
                cluster.kill_scheduler()
    kept, before = {receipt.label for receipt in store.iter_manifests()}, works.count_runs(runs)
    assert 2 <= len(kept) < 8
    assert cluster.workers[1].wait(60) == 0 and "is gone; start the worker again" in cluster.log("worker1")
    cluster.start_scheduler()
    cluster.start_worker()
    assert contents(plan, store, ClusterEngine(cluster.address)) == [works.expected(k) for k in range(8)]
    assert all(works.count_runs(runs)[k] == before[k] for k in range(8) if f"part {k}" in kept)


def test_a_batch_systems_end_leaves_nothing_behind(cluster, tmp_path):
    cluster.workers[0].terminate()
    assert cluster.workers[0].wait(60) == 130
    assert cluster.log("worker0").splitlines() == [f"works for {cluster.address}", "Interrupted."]
    cluster.workers[1].terminate()
    assert cluster.workers[1].wait(60) == 130 and not list(tmp_path.glob("nerg-*"))


def test_nobody_there(tmp_path):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    address = f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(NergError, match=f"no scheduler answers at {address}"):
        contents(works.make_plan(1), Store(tmp_path / "s"), ClusterEngine(address, timeout=0.5))
    with pytest.raises(NergError, match=f"no scheduler has answered at {address} for 1 s"):
        run_dask_worker(address, 1.0, print)


def test_files_are_where_they_were_planned_or_laid_out_alike(tmp_path):
    """What a worker does with them, without the worker."""
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    plan = works.make_plan(1, (tmp_path / "a", tmp_path / "b"))
    inputs, common = plan.shared.files, plan.shared.common
    assert engines.localize_inputs(inputs, common, {}, tmp_path) == (inputs, common)
    (tmp_path / "b").write_text("of somebody else")
    with pytest.raises(MissingInputFiles):
        engines.localize_inputs(inputs, common, {inputs[0].sha256: b"a"}, tmp_path)
    files = {file.sha256: name for file, name in zip(inputs, (b"a", b"b"))}
    there, moved = engines.localize_inputs(inputs, common, files, tmp_path)
    assert [path.read_text() for path in moved.files] == ["a", "b"] and [f.name for f in there] == [
        f.name for f in inputs
    ]
    assert tmp_path / "b" not in moved.files and moved.files[0].name == "a"


# ---- Addresses ----


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "[::1]"])
def test_this_machine_is_silent(host):
    assert describe_exposure(f"tcp://{host}:8786") is None


def test_tls_is_silent_and_all_else_is_told_in_a_sentence():
    assert describe_exposure("tls://192.0.2.1:8786") is None
    for host in ("192.0.2.1", "cluster.example", "[2001:db8::1]", "0.0.0.0"):
        said = describe_exposure(f"tcp://{host}:8786")
        assert said is not None and said.startswith(f"nothing protects tcp://{host}:8786")


def test_workers_listen_where_their_scheduler_reaches_them():
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


def test_without_dask_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"nerg-mi\[cluster\]"):
        import_distributed()
