"""Processes of this machine: each runs one task at a time, and may die."""

import time

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.processes import Processes
from nerg_mi.tasks.run import carry_out, run_plan
from nerg_mi.tasks.store import Store
from nerg_mi.tasks.task import Task
from tests.conftest import ROOT
from tests.tasks import works


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return Store(tmp_path / "store")


def contents(outputs):
    return [o.path.read_bytes() for o in outputs]


def test_outputs_are_those_of_one_process(store, tmp_path):
    (tmp_path / "a").write_text("light")
    files = {"a": tmp_path / "a"}
    tasks = works.tasks(6, files)
    assert contents(carry_out(Plan("p", tasks), store, Processes(2))) == [works.expected(k, files) for k in range(6)]


def test_two_work_at_once(store, tmp_path):
    (tmp_path / "runs").mkdir()
    carry_out(Plan("p", works.tasks(4, runs=str(tmp_path / "runs"), seconds=0.3)), store, Processes(2))
    assert len({p.name.split("-")[1] for p in (tmp_path / "runs").iterdir()}) == 2


def test_a_worker_that_dies_costs_time_and_nothing_else(store, tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "die").touch()
    tasks = works.tasks(5)
    tasks[1] = works.tasks(2, die=str(tmp_path / "die"), runs=str(tmp_path / "runs"))[1]
    told = []
    assert contents(carry_out(Plan("p", tasks), store, Processes(2), warn=told.append)) == [
        works.expected(k) for k in range(5)
    ]
    (line,) = told
    assert "part 1 (it was ended by SIGKILL" in line and works.runs_of(tmp_path / "runs") == {1: 2}
    assert not [p for p in store.folder.rglob("*.part*") if p.stat().st_size > 0]


def test_a_task_that_always_kills_its_worker_is_named(store):
    tasks = [*works.tasks(2), Task("tests.tasks.works:deadly", {}, (), ".txt", label="the third part")]
    with pytest.raises(NergError, match="the third part ended its worker 3 times, the last time because it was ended"):
        carry_out(Plan("p", tasks), store, Processes(1))
    assert store.find(tasks[2].key, ".txt") is None and store.find(tasks[0].key, ".txt") is not None


def test_errors_come_over_as_they_are(store):
    with pytest.raises(NergError, match=r"^the scene has no light; give it one$"):
        carry_out(Plan("p", [Task("tests.tasks.works:refused", {}, (), ".txt")]), store, Processes(1))
    with pytest.raises(RuntimeError, match=r"a mistake of the program\n(?s:.*)works.py"):
        carry_out(Plan("p", [Task("tests.tasks.works:mistaken", {}, (), ".txt")]), store, Processes(1))


def test_whoever_stops_ends_the_processes_at_once(store):
    start = time.monotonic()
    arriving = run_plan(Plan("p", [*works.tasks(1), *works.tasks(9, seconds=60)]), store, Processes(2))
    next(arriving)
    arriving.close()
    assert time.monotonic() - start < 30


@pytest.mark.parametrize("count", [0, -1, 100_000])
def test_how_many_there_may_be(count):
    with pytest.raises(NergError, match="choose 1 to 1024"):
        Processes(count)
