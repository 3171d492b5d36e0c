"""What a worker of a cluster answers, without the cluster."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import dask_worker
from nerg_mi.tasks.receipt import Receipt
from nerg_mi.tasks.store import Store
from nerg_mi.tasks.task import Task
from tests.conftest import ROOT
from tests.tasks import works
from tests.tasks.clusters import ClusterOfProcesses, free_port, wait_until

pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")


@pytest.fixture
def child(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    dask_worker._child.cache_clear()
    yield
    dask_worker._child().close()
    dask_worker._child.cache_clear()


def test_who_shares_the_store_writes_into_it_and_others_send_what_they_made(child, tmp_path, monkeypatch):
    store, (task, other) = Store(tmp_path / "store"), works.tasks(2)
    with store.probe() as probe:
        found = dask_worker.perform(task.document(), str(store.folder), probe)
        assert set(found) == {"receipt"} and store.find(task.key, ".txt") == Receipt(**found["receipt"])
        apart = dask_worker.perform(other.document(), str(tmp_path / "not there"), probe)
        assert apart["content"] == [("", works.expected(1))] and store.find(other.key, ".txt") is None
        count = Task("tests.tasks.works:threads", {}, (), ".txt")
        dask_worker.perform(count.document(), str(store.folder), probe, 1)
        assert store.output(count.key, ".txt").read_text() == "1"
        monkeypatch.setattr(dask_worker, "MOST_SENT", 10)
        large = dask_worker.perform(other.document(), str(tmp_path / "not there"), probe)
        assert "share the store's folder with the workers" in large["error"] and large["kind"] == "final"


def test_failures_are_answers(child, tmp_path):
    def said(name, **more):
        return dask_worker.perform(Task(f"tests.tasks.works:{name}", {}, (), ".txt", **more).document(), "/none", "x")

    assert said("refused")["kind"] == "mendable" and said("mistaken")["kind"] == "fault"
    assert said("deadly") == {"died": "it was ended by SIGKILL, as the system does where memory is short"}
    assert "install the same one everywhere" in said("hashed", versions={"code": "other"})["error"]


def test_a_scheduler_that_is_not_there():
    with pytest.raises(NergError, match=r"no scheduler has answered at tcp://127.0.0.1:\d+ for 1 s"):
        dask_worker.serve_cluster(f"tcp://127.0.0.1:{free_port()}", 1.0, print)


def test_a_batch_systems_end_leaves_nothing_behind(tmp_path):
    with ClusterOfProcesses(tmp_path) as cluster:
        worker = cluster.start_worker()
        wait_until(lambda: "works for" in cluster.log("worker0"), "the worker is there")
        worker.terminate()
        assert worker.wait(60) == 130
        assert cluster.log("worker0").splitlines() == [f"works for {cluster.address}", "Interrupted."]
    assert not list(tmp_path.glob("nerg-*"))
