"""Children, from the side of whoever asks them."""

import os
import signal

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.children import Child, ChildDied, TaskFailed, failure
from nerg_mi.tasks.store import Store
from nerg_mi.tasks.task import Task
from tests.conftest import ROOT
from tests.tasks import works


@pytest.fixture
def child(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    made = Child(threads=1)
    yield made
    made.close()


def test_one_process_serves_many_tasks_and_a_new_one_after_it_died(child, tmp_path):
    store = Store(tmp_path / "store")
    first, second, third = works.tasks(3)
    assert child.pid is None and child.make(first, {}, store.folder) == store.receipt(first.key)
    before = child.pid
    child.make(second, {}, store.folder)
    assert child.pid == before
    with pytest.raises(ChildDied, match="ended by SIGKILL"):
        child.make(Task("tests.tasks.works:deadly", {}, (), ".txt"), {}, store.folder)
    child.make(third, {}, store.folder)
    assert child.pid != before
    os.kill(child.pid, signal.SIGTERM)


def test_failures_say_what_they_are(child, tmp_path):
    with pytest.raises(TaskFailed) as refused:
        child.make(Task("tests.tasks.works:refused", {}, (), ".txt"), {}, tmp_path)
    assert refused.value.mendable and not refused.value.final
    task = works.tasks(1)[0]
    assert isinstance(failure(task, refused.value), NergError)
    assert isinstance(failure(task, TaskFailed("x", "trace", False, False)), RuntimeError)


def test_it_knows_its_share_of_the_cores(child, tmp_path):
    task = Task("tests.tasks.works:threads", {}, (), ".txt")
    child.make(task, {}, tmp_path)
    assert Store(tmp_path).output(task.key, ".txt").read_text() == "1"


def test_a_job_asks_for_fewer_threads_and_never_gets_more(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    task, own = Task("tests.tasks.works:threads", {}, (), ".txt"), Child(threads=3)
    try:
        for asked, given in ((2, "2"), (8, "3"), (0, "3")):
            own.make(task, {}, tmp_path, asked)
            assert Store(tmp_path).output(task.key, ".txt").read_text() == given
    finally:
        own.close()
