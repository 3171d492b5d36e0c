"""The scheduler that is this process."""

import os

from nerg_mi.tasks.local import Local
from nerg_mi.tasks.store import Store
from tests.tasks import works


def test_tasks_are_run_when_it_is_their_turn(tmp_path):
    (tmp_path / "runs").mkdir()
    arriving = Local().run(iter(works.tasks(3, runs=str(tmp_path / "runs"))), Store(tmp_path / "store"), print)
    assert not os.listdir(tmp_path / "runs")
    done = next(arriving)
    assert done.task.label == "part 0" and done.where == "" and works.runs_of(tmp_path / "runs") == {0: 1}
    assert [d.task.label for d in arriving] == ["part 1", "part 2"]
