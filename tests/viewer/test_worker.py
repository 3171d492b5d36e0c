"""The render thread: the most urgent first, and what is replaced is not gone on with."""

from __future__ import annotations

import threading

import pytest

from nerg_mi.viewer.session import Worker


@pytest.fixture
def worker():
    errors = []
    made = Worker(errors.append)
    made.errors = errors
    yield made
    made.stop()


def steps(name, count, log, gate=None):
    for k in range(count):
        if gate is not None:
            assert gate.wait(10)
        log.append((name, k, threading.get_ident()))
        yield


def test01_all_steps_are_made_on_one_thread(worker):
    log = []
    worker.submit("a", 1, steps("a", 3, log))
    worker.submit("b", 1, steps("b", 3, log))
    assert worker.wait_idle(10)
    assert sorted(entry[:2] for entry in log) == [(n, k) for n in "ab" for k in range(3)]
    assert len({entry[2] for entry in log}) == 1 and log[0][2] != threading.get_ident()


def test02_the_urgent_comes_between_the_steps_of_another(worker):
    log, gate = [], threading.Event()
    started = threading.Event()

    def slow():
        for k in range(4):
            started.set()
            assert gate.wait(10)
            log.append(("slow", k))
            yield

    worker.submit("slow", 5, slow())
    assert started.wait(10)
    worker.submit("urgent", 0, (log.append(("urgent", k)) for k in range(2)))
    gate.set()
    assert worker.wait_idle(10)
    assert log == [("slow", 0), ("urgent", 0), ("urgent", 1), ("slow", 1), ("slow", 2), ("slow", 3)]


def test03_a_new_task_of_a_name_replaces_the_old_one(worker):
    log, gate, started = [], threading.Event(), threading.Event()

    def old():
        for k in range(100):
            started.set()
            assert gate.wait(10)
            log.append(("old", k))
            yield

    worker.submit("picture", 3, old())
    assert started.wait(10)
    worker.submit("picture", 3, (log.append(("new", k)) for k in range(3)))
    gate.set()
    assert worker.wait_idle(10)
    assert log == [("old", 0), ("new", 0), ("new", 1), ("new", 2)]


def test04_cancelled_tasks_end(worker):
    log, gate, started = [], threading.Event(), threading.Event()

    def task():
        for k in range(100):
            started.set()
            assert gate.wait(10)
            log.append(k)
            yield

    worker.submit("picture", 3, task())
    assert started.wait(10)
    worker.cancel("picture")
    gate.set()
    assert worker.wait_idle(10) and worker.idle
    assert worker.call(lambda: 7).result(10) == 7
    assert log == [0]


def test05_tasks_of_one_urgency_take_turns(worker):
    log, gate = [], threading.Event()
    worker.submit("first", 2, steps("first", 3, log, gate))
    worker.submit("second", 2, steps("second", 3, log, gate))
    gate.set()
    assert worker.wait_idle(10)
    assert [name for name, *_ in log] == ["first", "second"] * 3


def test06_errors_are_told_and_end_one_task_alone(worker):
    def bad():
        yield
        raise ValueError("no such thing")

    worker.submit("bad", 0, bad())
    worker.submit("good", 1, (None for _ in range(2)))
    assert worker.wait_idle(10)
    (error,) = worker.errors
    assert isinstance(error, ValueError)
    with pytest.raises(KeyError):
        worker.call(lambda: {}["x"]).result(10)
    assert len(worker.errors) == 1


def test07_after_the_end_nothing_is_begun():
    worker = Worker(lambda error: None)
    worker.stop()
    worker.submit("late", 0, iter([1]))
    assert worker.idle
