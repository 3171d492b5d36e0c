"""Parts on a cluster of real processes: whatever is killed, late or elsewhere, outputs are those of one machine."""

from __future__ import annotations

import sys

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import engines
from nerg_mi.tasks.engines import (
    Cluster,
    FilesElsewhere,
    import_distributed,
    own_host,
    run_plan,
    security_for,
    serve_cluster,
    unprotected,
)
from nerg_mi.tasks.store import Store
from tests.tasks import works
from tests.tasks.clusters import ClusterOfProcesses, free_port, wait_until


@pytest.fixture
def cluster(tmp_path):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    with ClusterOfProcesses(tmp_path) as made:
        made.start_worker(), made.start_worker()
        wait_until(lambda: all("works for" in made.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        yield made


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


def contents(plan, store, engine, **more):
    return [output.path.read_bytes() for output in run_plan(plan, store, engine, **more)]


def test_a_worker_that_is_killed_and_one_that_comes_late(cluster, tmp_path, runs):
    store, outputs = Store(tmp_path / "store"), []
    for made in run_plan(works.plan(12, runs=runs, seconds=0.3), store, Cluster(cluster.address)):
        outputs.append(made.path.read_bytes())
        if len(outputs) == 2:
            cluster.workers[0].kill()
            cluster.start_worker()
    assert outputs == [works.expected(k) for k in range(12)] and set(works.runs_of(runs)) == set(range(12))
    # A process of a worker that ends, as where memory is short, is started again, and its part is run again.
    (tmp_path / "die").touch()
    plan = works.plan(3, die=tmp_path / "die", runs=runs, seconds=0.1)
    assert contents(plan, store, Cluster(cluster.address)) == [works.expected(k) for k in range(3)]
    assert not (tmp_path / "die").exists() and cluster.workers[1].poll() is None


def test_errors_of_parts_are_the_jobs_and_threads_those_it_asks_for(cluster, tmp_path, monkeypatch):
    store, engine = Store(tmp_path / "s"), Cluster(cluster.address, threads=1)
    with pytest.raises(NergError, match=r"^the part refused: the scene has no light; give it one$"):
        contents(works.some("refused"), store, engine)
    with pytest.raises(RuntimeError, match=r"the part fault: TypeError: a mistake(?s:.*)works\.py"):
        contents(works.some("fault"), store, engine)
    with pytest.raises(NergError, match="the part deadly was begun by several workers"):
        contents(works.some("deadly"), store, engine)
    (made,) = run_plan(works.some("threads"), store, engine)
    assert made.notes == {"threads": 1}
    folders = list(run_plan(works.folders(5), store, engine))
    assert (folders[0].path / "below" / "b.txt").is_file() and folders[0].notes == {}
    plan = works.some("b")
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
    plan = works.plan(4, files, runs=runs, seconds=1.0)
    expected = [works.expected(k, files) for k in range(4)]
    assert len(plan.tasks) == 4 and plan.shared.files
    for file in files:
        file.unlink()
    original = engines.read_bytes
    monkeypatch.setattr(engines, "read_bytes", lambda path, *more: original(path.replace("here", "away"), *more))
    assert contents(plan, Store(tmp_path / "store"), Cluster(cluster.address)) == expected
    # Few parts go to all workers too, and not to the one that has what they need first.
    assert len({path.name.split("-")[1] for path in runs.iterdir()}) == 2


def test_a_scheduler_that_ends_ends_the_job_which_goes_on_with_another(cluster, tmp_path, runs):
    plan, store, count = works.plan(8, runs=runs, seconds=0.3), Store(tmp_path / "store"), 0
    with pytest.raises(NergError, match=f"the scheduler at {cluster.address} is gone"):
        for _ in run_plan(plan, store, Cluster(cluster.address)):
            count += 1
            if count == 2:
                cluster.kill_scheduler()
    kept, before = {receipt.label for receipt in store.receipts()}, works.runs_of(runs)
    assert 2 <= len(kept) < 8
    assert cluster.workers[1].wait(60) == 0 and "is gone; start the worker again" in cluster.log("worker1")
    cluster.start_scheduler()
    cluster.start_worker()
    assert contents(plan, store, Cluster(cluster.address)) == [works.expected(k) for k in range(8)]
    assert all(works.runs_of(runs)[k] == before[k] for k in range(8) if f"part {k}" in kept)


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
        contents(works.plan(1), Store(tmp_path / "s"), Cluster(address, patience=0.5))
    with pytest.raises(NergError, match=f"no scheduler has answered at {address} for 1 s"):
        serve_cluster(address, 1.0, print)


def test_files_are_where_they_were_planned_or_laid_out_alike(tmp_path):
    """What a worker does with them, without the worker."""
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    plan = works.plan(1, (tmp_path / "a", tmp_path / "b"))
    inputs, common = plan.shared.files, plan.shared.common
    assert engines.placed(inputs, common, {}, tmp_path) == (inputs, common)
    (tmp_path / "b").write_text("of somebody else")
    with pytest.raises(FilesElsewhere):
        engines.placed(inputs, common, {inputs[0].sha256: b"a"}, tmp_path)
    files = {file.sha256: name for file, name in zip(inputs, (b"a", b"b"))}
    there, moved = engines.placed(inputs, common, files, tmp_path)
    assert [path.read_text() for path in moved.files] == ["a", "b"] and [f.name for f in there] == [
        f.name for f in inputs
    ]
    assert tmp_path / "b" not in moved.files and moved.files[0].name == "a"


# ---- Addresses ----


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "[::1]"])
def test_this_machine_is_silent(host):
    assert unprotected(f"tcp://{host}:8786") is None


def test_tls_is_silent_and_all_else_is_told_in_a_sentence():
    assert unprotected("tls://192.0.2.1:8786") is None
    for host in ("192.0.2.1", "cluster.example", "[2001:db8::1]", "0.0.0.0"):
        said = unprotected(f"tcp://{host}:8786")
        assert said is not None and said.startswith(f"nothing protects tcp://{host}:8786")


def test_workers_listen_where_their_scheduler_reaches_them():
    assert own_host("tcp://localhost:1") == own_host("tcp://127.0.0.1:1") == "127.0.0.1"
    assert own_host("tcp://[::1]:1") == "::1"


def test_tls_needs_certificates():
    distributed = pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    import dask

    assert security_for("tcp://a:1") is None
    with pytest.raises(NergError, match="tls:// needs certificates"):
        security_for("tls://a:1")
    with dask.config.set({"distributed.comm.tls.ca-file": "ca.pem"}):
        security = security_for("tls://a:1")
    assert isinstance(security, distributed.Security) and security.require_encryption


def test_without_dask_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"nerg-mi\[cluster\]"):
        import_distributed()
