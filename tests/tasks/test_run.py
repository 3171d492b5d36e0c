"""Plans carried out: in their order, each part once, and nothing made anew that need not be."""

import struct

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.local import Local
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.protocol import Done
from nerg_mi.tasks.receipt import Receipt
from nerg_mi.tasks.run import Progress, carry_out, run_plan
from nerg_mi.tasks.store import Store
from nerg_mi.tasks.task import Task
from tests.tasks import works


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


class Backwards:
    """Does everything at once, the last first."""

    def run(self, tasks, store, warn):
        yield from reversed(list(Local().run(tasks, store, warn)))


def contents(outputs):
    return [o.path.read_bytes() for o in outputs]


@pytest.mark.parametrize("scheduler", [Local(), Backwards()])
def test_outputs_come_in_the_plans_order(store, scheduler):
    assert contents(run_plan(Plan("p", works.tasks(5)), store, scheduler)) == [works.expected(k) for k in range(5)]


def test_sums_in_the_plans_order_are_equal_to_the_bit(tmp_path):
    """Of terms whose sum depends on the order in which they are added."""
    tasks = [Task("tests.tasks.works:term", {"number": k}, (), ".txt") for k in range(40)]

    def total(scheduler, name):
        out = 0.0
        for made in run_plan(Plan("p", tasks), Store(tmp_path / name), scheduler):
            out += made.notes["term"]
        return struct.pack("<d", out)

    terms = [works.term({"number": k}, {}, tmp_path / "t")["term"] for k in range(40)]
    assert total(Local(), "a") == total(Backwards(), "b") == struct.pack("<d", sum_in_order(terms))
    assert sum_in_order(terms) != sum_in_order(terms[::-1])


def sum_in_order(terms):
    out = 0.0
    for term in terms:
        out += term
    return out


def test_what_is_done_is_kept(store, runs):
    plan = Plan("p", works.tasks(4, runs=str(runs)))
    first = contents(carry_out(plan, store, Local()))
    assert contents(carry_out(plan, store, Local())) == first and works.runs_of(runs) == dict.fromkeys(range(4), 1)


def test_a_damaged_output_is_made_anew_and_no_other(store, runs):
    tasks = works.tasks(4, runs=str(runs))
    first = contents(carry_out(Plan("p", tasks), store, Local()))
    store.output(tasks[2].key, ".txt").write_text("damaged")
    assert contents(carry_out(Plan("p", tasks), store, Local())) == first
    assert works.runs_of(runs) == {0: 1, 1: 1, 2: 2, 3: 1}


def test_a_changed_input_invalidates_what_depends_on_it_and_nothing_more(store, runs, tmp_path):
    for name in "ab":
        (tmp_path / name).write_text("before")

    def plan():
        depends = works.tasks(2, {"a": tmp_path / "a"}, runs=str(runs))
        other = [works.tasks(k + 1, {"b": tmp_path / "b"}, runs=str(runs))[k] for k in (2, 3)]
        return Plan("p", [*depends, *other, works.tasks(5, runs=str(runs))[4]])

    carry_out(plan(), store, Local())
    (tmp_path / "a").write_text("after")
    found = contents(carry_out(plan(), store, Local()))
    assert works.runs_of(runs) == {0: 2, 1: 2, 2: 1, 3: 1, 4: 1}
    assert found[0] == works.expected(0, {"a": tmp_path / "a"}) and found[4] == works.expected(4)
    # And back again: what was made of the former bytes is still there.
    (tmp_path / "a").write_text("before")
    carry_out(plan(), store, Local())
    assert works.runs_of(runs) == {0: 2, 1: 2, 2: 1, 3: 1, 4: 1}


def test_an_input_that_changes_in_the_middle_ends_the_job_and_leaves_nothing_mixed(store, runs, tmp_path):
    file = tmp_path / "a"
    file.write_text("before")
    plan = Plan("p", works.tasks(4, {"a": file}, runs=str(runs)))
    with pytest.raises(NergError, match="changed while the job"):
        for k, _ in enumerate(run_plan(plan, store, Local())):
            if k == 1:
                file.write_text("after it")
    assert works.runs_of(runs) == {0: 1, 1: 1} and len(list(store.receipts())) == 2


def test_an_input_that_changes_while_it_is_read_is_noticed(store, tmp_path):
    (tmp_path / "a").write_text("before")
    tasks = [Task("tests.tasks.works:changes", {}, works.tasks(1, {"a": tmp_path / "a"})[0].inputs, ".txt")]
    with pytest.raises(NergError, match="changed while the job"):
        carry_out(Plan("p", tasks), store, Local())
    assert not list(store.receipts())


def test_equal_tasks_are_run_once_and_given_as_often_as_they_are_planned(store, runs):
    task = works.tasks(1, runs=str(runs))[0]
    shares = []
    found = contents(carry_out(Plan("p", [task, task, task]), store, Local(), lambda p: shares.append(p.share)))
    assert found == [works.expected(0)] * 3 and works.runs_of(runs) == {0: 1} and shares == [0.0, 1.0]
    # And what is kept counts as often as well.
    counts = []
    carry_out(Plan("p", [task, task]), store, Local(), lambda p: counts.append((p.kept, p.done, p.total)))
    assert counts == [(2, 2, 2)]


def test_an_error_of_a_task_is_the_jobs(store):
    good = works.tasks(1)[0]
    bad = Task("tests.tasks.works:refused", {}, (), ".txt")
    with pytest.raises(NergError, match="scene has no light"):
        carry_out(Plan("p", [good, bad]), store, Local())
    assert [receipt.key for receipt in store.receipts()] == [good.key]


def test_another_versions_tasks_are_refused(store):
    task = Task("tests.tasks.works:hashed", {"number": 1}, (), ".txt", {"code": "0" * 16}, "part 1")
    with pytest.raises(NergError, match="1.*nerg_mi"):
        carry_out(Plan("p", [task]), store, Local())


def test_progress_has_rate_and_time_left():
    progress = Progress(10, kept=2, done=2)
    assert progress.line() == "2 of 10 parts" and progress.left is None and progress.share == 0.2
    progress.done, progress.seconds = 6, 8.0
    assert progress.left == pytest.approx(8.0) and progress.line() == "6 of 10 parts, 30 a minute, 8 s left"
    progress.seconds = 2.0
    assert progress.line() == "6 of 10 parts, 2 a second, 2 s left"
    assert Progress(0).share == 1.0


def test_other_processors_are_told_of_once(store):
    class Elsewhere:
        def run(self, tasks, store, warn):
            for k, done in enumerate(Local().run(tasks, store, warn)):
                receipt = Receipt(**{**vars(done.receipt), "processor": "another" if k else "one"})
                yield Done(done.task, receipt)

    told = []
    carry_out(Plan("p", works.tasks(4)), store, Elsewhere(), warn=told.append)
    (line,) = told
    assert '"another" and "one"' in line and "equal processors only" in line


def test_a_scheduler_that_forgets_is_a_fault(store):
    class Forgets:
        def run(self, tasks, store, warn):
            yield from ()

    with pytest.raises(RuntimeError, match="ended without part 0"):
        carry_out(Plan("p", works.tasks(1)), store, Forgets())


def test_whoever_stops_taking_stops_the_work(store, runs):
    taken = run_plan(Plan("p", works.tasks(9, runs=str(runs))), store, Local())
    next(taken), next(taken)
    taken.close()
    assert works.runs_of(runs) == {0: 1, 1: 1}
