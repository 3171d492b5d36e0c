"""A cluster of real processes: whatever is killed, stopped, late or elsewhere, outputs are those of one machine."""

from __future__ import annotations

import shutil
import threading

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.addresses import import_distributed
from nerg_mi.tasks.local import Local
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.run import carry_out, run_plan
from nerg_mi.tasks.store import Store
from nerg_mi.tasks.task import FOLDER, Task
from tests.tasks import works
from tests.tasks.clusters import ELSEWHERE, ClusterOfProcesses, wait_until

pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")

from nerg_mi.tasks.dask_cluster import Cluster


@pytest.fixture
def cluster(tmp_path):
    with ClusterOfProcesses(tmp_path) as made:
        yield made


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


def contents(outputs):
    return [o.path.read_bytes() for o in outputs]


def on_one_machine(tasks, tmp_path):
    return contents(carry_out(Plan("p", tasks), Store(tmp_path / "alone"), Local()))


def test_a_worker_that_is_killed_and_one_that_comes_late(cluster, tmp_path, runs):
    """Two workers, one of which is killed with its task in hand; a third joins after that."""
    tasks = works.tasks(12, runs=str(runs), seconds=0.3)
    store = Store(tmp_path / "store")
    cluster.start_worker(), cluster.start_worker()
    with import_distributed().Client(cluster.address) as client:
        client.wait_for_workers(2, timeout=90)
    told, outputs = [], []
    for made in run_plan(Plan("p", tasks), store, Cluster(cluster.address), warn=told.append):
        outputs.append(made)
        if len(outputs) == 2:
            wait_until(lambda: len(list(runs.iterdir())) >= 4, "two tasks are under way")
            cluster.workers[0].kill()
            cluster.start_worker()
    assert contents(outputs) == on_one_machine(tasks, tmp_path)
    assert set(works.runs_of(runs)) == set(range(12)) and all(store.find(t.key, ".txt") for t in tasks)


def test_the_scheduler_is_killed_and_the_job_goes_on_when_it_is_back(cluster, tmp_path, runs):
    tasks = works.tasks(8, runs=str(runs), seconds=0.3)
    cluster.start_worker(), cluster.start_worker()
    told, outputs = [], []
    for made in run_plan(Plan("p", tasks), Store(tmp_path / "store"), Cluster(cluster.address), warn=told.append):
        outputs.append(made)
        if len(outputs) == 2:
            cluster.kill_scheduler()
            threading.Timer(1.0, cluster.start_scheduler).start()
    assert contents(outputs) == on_one_machine(tasks, tmp_path)
    assert [line for line in told if line.startswith(f"the scheduler at {cluster.address} is gone; waiting for it")]
    assert "is gone; waiting for it" in cluster.log("worker0")


def test_a_job_that_ended_with_its_scheduler_goes_on_where_it_ended(cluster, tmp_path, runs):
    """One worker of two is killed, and the scheduler, until the job gives up; then it is started again."""
    tasks, store = works.tasks(14, runs=str(runs), seconds=0.2), Store(tmp_path / "store")
    cluster.start_worker(), cluster.start_worker()
    count = 0
    with pytest.raises(NergError, match="no scheduler answers at .*: what is done is kept"):
        for _ in run_plan(Plan("p", tasks), store, Cluster(cluster.address, patience=1.0)):
            count += 1
            if count == 2:
                cluster.workers[0].kill()
                cluster.kill_scheduler()
    kept = {receipt.key for receipt in store.receipts()}
    before = works.runs_of(runs)
    assert 2 <= len(kept) < 14
    cluster.start_scheduler()
    outputs = contents(carry_out(Plan("p", tasks), store, Cluster(cluster.address)))
    after = works.runs_of(runs)
    assert outputs == on_one_machine(tasks, tmp_path / "x")
    done = [k for k, task in enumerate(tasks) if task.key in kept]
    assert {k: after[k] for k in done} == {k: before[k] for k in done}, "what was done is not made again"


def test_what_a_stopped_worker_keeps_is_run_by_another(cluster, tmp_path, runs):
    import signal

    tasks, told, outputs = works.tasks(6, runs=str(runs), seconds=0.2), [], []
    cluster.start_worker(), cluster.start_worker()
    wait_until(lambda: all("works for" in cluster.log(f"worker{k}") for k in (0, 1)), "both workers are there")
    for made in run_plan(
        Plan("p", tasks), Store(tmp_path / "store"), Cluster(cluster.address, slow=1.0), warn=told.append
    ):
        outputs.append(made)
        if len(outputs) == 1:
            wait_until(lambda: len(list(runs.iterdir())) >= 3, "both have something to do")
            cluster.workers[0].send_signal(signal.SIGSTOP)
    assert contents(outputs) == on_one_machine(tasks, tmp_path)


def test_workers_without_the_folder_are_sent_files_and_send_outputs(cluster, tmp_path):
    """As if on another machine: the input is not where it was planned, and the store is not to be seen."""
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "light.txt").write_text("light")
    (tmp_path / "here" / "large.txt").write_text("x" * 20_000_000)
    files = {"light.txt": tmp_path / "here" / "light.txt", "below/large.txt": tmp_path / "here" / "large.txt"}
    tasks = [*works.tasks(3, files), Task("tests.tasks.works:folder", {"number": 5}, (), FOLDER, label="a folder")]
    expected = carry_out(Plan("p", tasks), Store(tmp_path / "alone"), Local())
    cluster.start_worker(ELSEWHERE)
    outputs = carry_out(Plan("p", tasks), Store(tmp_path / "store"), Cluster(cluster.address))
    assert contents(outputs[:3]) == contents(expected[:3]) == [works.expected(k, files) for k in range(3)]
    assert (outputs[3].path / "a.txt").read_bytes() == b"5\n" and (outputs[3].path / "below" / "b.txt").is_file()
    assert outputs[3].notes == {}


def test_errors_of_tasks_are_the_jobs(cluster, tmp_path):
    cluster.start_worker()
    with pytest.raises(NergError, match=r"^the scene has no light; give it one$"):
        carry_out(
            Plan("p", [Task("tests.tasks.works:refused", {}, (), ".txt")]),
            Store(tmp_path / "s"),
            Cluster(cluster.address),
        )
    told = []
    with pytest.raises(NergError, match="the third was run 3 times and never done, the last time: it was ended by"):
        deadly = Task("tests.tasks.works:deadly", {}, (), ".txt", label="the third")
        carry_out(Plan("p", [deadly]), Store(tmp_path / "s"), Cluster(cluster.address), warn=told.append)
    assert len(told) == 2 and all("the third is run again: it was ended by SIGKILL" in line for line in told)
    other = Task("tests.tasks.works:hashed", {"number": 1}, (), ".txt", {"code": "0" * 16}, "part 1")
    with pytest.raises(NergError, match="1.*nerg_mi"):
        carry_out(Plan("p", [other]), Store(tmp_path / "s"), Cluster(cluster.address))


def test_nobody_there(tmp_path):
    from tests.tasks.clusters import free_port

    address = f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(NergError, match=f"no scheduler answers at {address}"):
        carry_out(Plan("p", works.tasks(1)), Store(tmp_path / "s"), Cluster(address, patience=0.5))
    shutil.rmtree(tmp_path / "s")
