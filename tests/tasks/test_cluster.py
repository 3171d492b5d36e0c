"""Parts that run on a cluster of real processes: results, failures, kills, and unsuitable workers."""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import threading

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import cluster as cluster_module
from nerg_mi.tasks.cluster import (
    ClusterEngine,
    MissingInputFiles,
    describe_exposure,
    find_local_host,
    import_distributed,
    make_security,
    run_worker,
)
from nerg_mi.tasks.engines import run_plan
from nerg_mi.tasks.store import Store
from tests.recorder import Recorder
from tests.tasks import works
from tests.tasks.clusters import DEADLINE, ClusterOfProcesses, free_port, wait_until


@pytest.fixture(autouse=True)
def _deadline():
    """Fail a test that waits without end, as for a scheduler that is none."""

    def fail(*arguments):
        raise TimeoutError(f"the test takes more than {DEADLINE:g} s")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(int(DEADLINE))
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


def read_outputs(plan, store, engine, **options):
    return [output.path.read_bytes() for output in run_plan(plan, store, engine, **options)]


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
    with pytest.raises(NergError, match="no worker can run this job .*another version of nerg_mi"):
        read_outputs(plan, store, engine)


def describe_other_versions(**changes):
    """Return code of a process that reports other versions of packages to Dask."""
    return (
        "import distributed.versions as v; f = v.get_package_info; "
        f"v.get_package_info = lambda p: {{**f(p), **{changes!r}}}"
    )


def test_unsuitable_workers_are_named_and_not_used(tmp_path, monkeypatch):
    """A worker without nerg_mi, with other versions of Dask and Python, and with other code."""
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    monkeypatch.setattr(cluster_module, "MESSAGE_DELAY", 2.0)
    other_python = "import distributed.versions as v; f = v.get_system_info; "
    other_python += "v.get_system_info = lambda: {**f(), 'python': '3.9.1.final.0'}"
    preludes = {
        "nerg_mi": "import sys; sys.modules['nerg_mi'] = None",
        "2024.1.0": describe_other_versions(dask="2024.1.0"),
        "Python 3.9": other_python,
        "another version of nerg_mi": "import nerg_mi.tasks.task as t; t.compute_code_digest = str",
    }
    with ClusterOfProcesses(tmp_path) as cluster:
        for prelude in preludes.values():
            cluster.start_plain_worker(prelude)
        wait_until(
            lambda: all("Registered to" in cluster.log(f"worker{k}") for k in range(len(preludes))), "workers are there"
        )
        plan, warnings = works.make_plan(6), []
        with pytest.raises(NergError, match="no worker can run this job") as error:
            read_outputs(plan, Store(tmp_path / "a"), ClusterEngine(cluster.address), warn=warnings.append)
        assert all(fault in str(error.value) for fault in preludes)
        assert len(warnings) == 4 and all(sum(fault in w for w in warnings) for fault in preludes)
        good = cluster.start_worker()
        wait_until(lambda: "connected to" in cluster.log("worker4"), "the worker is there")
        engine = ClusterEngine(cluster.address, worker_wait=5.0)
        outputs = run_plan(plan, Store(tmp_path / "b"), engine, warn=warnings.append)
        assert next(outputs).path.read_bytes() == works.expected(0)
        assert [output.path.read_bytes() for output in outputs] == [works.expected(k) for k in range(1, 6)]
        # A worker that dies is waited for, but not without a limit.
        warnings.clear()
        outputs = run_plan(works.make_plan(9, seconds=0.5), Store(tmp_path / "c"), engine, warn=warnings.append)
        next(outputs)
        good.kill()
        with pytest.raises(NergError, match="for 5 s; start workers with"):
            list(outputs)
        assert any("for at most 5 s" in w for w in warnings)


def test_waiting_for_workers_is_limited(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    monkeypatch.setattr(cluster_module, "MESSAGE_DELAY", 0.5)
    warnings = []
    with ClusterOfProcesses(tmp_path) as cluster:
        engine = ClusterEngine(cluster.address, worker_wait=2.0)
        with pytest.raises(NergError, match="no worker is connected, for 2 s"):
            read_outputs(works.make_plan(1), Store(tmp_path / "a"), engine, warn=warnings.append)
        (line,) = warnings
        assert "for at most 2 s" in line and f"nerg worker {cluster.address}" in line
        # A scheduler that is stopped answers nothing.
        cluster.scheduler.send_signal(signal.SIGSTOP)
        with pytest.raises(NergError, match=f"no scheduler answers at {cluster.address}"):
            read_outputs(works.make_plan(1), Store(tmp_path / "a"), ClusterEngine(cluster.address, timeout=1.0))


@pytest.mark.parametrize("banner", [b"", b"HTTP/1.0 400 Bad request\r\n", b"\xff" * 64])
def test_another_program_is_no_scheduler(tmp_path, monkeypatch, banner):
    """A program that says nothing, and others."""
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    monkeypatch.setattr(cluster_module, "MESSAGE_DELAY", 0.1)
    connections, warnings = [], []
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connections.append(server.accept()[0])
                    connections[-1].sendall(banner)

        threading.Thread(target=serve, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(NergError, match=f"no scheduler answers at {address}"):
            read_outputs(
                works.make_plan(1), Store(tmp_path / "s"), ClusterEngine(address, timeout=1.0), warn=warnings.append
            )
        if not banner:
            assert any("for at most 1 s" in w for w in warnings)
        recorder = Recorder()
        with pytest.raises(NergError, match=f"no scheduler answered at {address}"):
            run_worker(address, wait=1.0, progress=recorder)
        assert any("for at most 1 s" in m for m in recorder.messages)
        for connection in connections:
            connection.close()


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
    original = cluster_module.read_bytes
    monkeypatch.setattr(cluster_module, "read_bytes", lambda path, *more: original(path.replace("here", "away"), *more))
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
        run_worker(address, wait=1.0)


def test_files_are_localized(tmp_path):
    """The function that a worker calls, without a worker."""
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    plan = works.make_plan(1, (tmp_path / "a", tmp_path / "b"))
    inputs, common = plan.shared.files, plan.shared.common
    assert cluster_module.localize_inputs(inputs, common, {}, tmp_path) == (inputs, common)
    (tmp_path / "b").write_text("of somebody else")
    with pytest.raises(MissingInputFiles):
        cluster_module.localize_inputs(inputs, common, {inputs[0].sha256: b"a"}, tmp_path)
    files = {file.sha256: name for file, name in zip(inputs, (b"a", b"b"))}
    localized, moved = cluster_module.localize_inputs(inputs, common, files, tmp_path)
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
