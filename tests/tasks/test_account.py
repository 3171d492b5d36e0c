"""What a store holds, and what of it is stale."""

import os
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.account import read_account, remove_stale
from nerg_mi.tasks.local import Local
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.run import carry_out, run_plan
from nerg_mi.tasks.store import Store
from nerg_mi.tasks.task import Task
from tests.tasks import works


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def test_a_job_that_was_interrupted(store):
    arriving = run_plan(Plan("a film", works.tasks(5)), store, Local())
    next(arriving), next(arriving)
    arriving.close()
    found = read_account(store)
    (job,) = found.jobs
    assert (job.what, job.total, job.done, job.left, job.bytes) == ("a film", 5, 2, 3, 130)
    assert found.stale == () and found.leftovers == () and found.bytes == 130 and job.seconds >= 0


def test_what_no_job_asks_for_is_stale(store):
    carry_out(Plan("a film", works.tasks(4)), store, Local())
    carry_out(Plan("another", works.tasks(2)), store, Local())
    carry_out(Plan("a film", works.tasks(1)), store, Local())
    found = read_account(store)
    assert [r.label for r in sorted(found.stale, key=lambda r: r.label)] == ["part 2", "part 3"]
    assert found.stale_bytes == 130 == remove_stale(store, found)
    left = read_account(store)
    assert left.stale == () and [job.done for job in left.jobs] == [1, 2] and left.bytes == 130


def test_what_was_made_of_a_file_that_has_changed_is_stale(store, tmp_path):
    for name in "ab":
        (tmp_path / name).write_text(f"{name} before")
    tasks = [*works.tasks(2, {"a": tmp_path / "a"}), *works.tasks(3, {"b": tmp_path / "b"})[2:]]
    carry_out(Plan("p", tasks), store, Local())
    (tmp_path / "a").write_text("after")
    (tmp_path / "b").unlink()
    found = read_account(store)
    (job,) = found.jobs
    assert job.changed == (str(tmp_path / "a"),) and job.gone == (str(tmp_path / "b"),) and job.outdated == 2
    assert {r.label for r in found.stale} == {"part 0", "part 1"}
    remove_stale(store, found)
    assert [r.label for r in store.receipts()] == ["part 2"]


def test_leftovers_are_removed_when_they_are_old(store):
    carry_out(Plan("p", works.tasks(1)), store, Local())
    hidden = next(store.folder.glob("??")) / ".abc.part.txt"
    hidden.write_text("half")
    folder = hidden.with_name(".abd.part")
    (folder / "below").mkdir(parents=True)
    (folder / "below" / "x").write_text("12345")
    assert read_account(store).leftovers == ()
    for path in (hidden, folder):
        os.utime(path, (1, 1))
    found = read_account(store)
    assert len(found.leftovers) == 2 and found.leftover_bytes == 9 == remove_stale(store, found)
    assert not hidden.exists() and not folder.exists() and read_account(store).jobs[0].done == 1


def test_a_folder_that_is_no_store(tmp_path):
    with pytest.raises(NergError, match="--store"):
        read_account(Store(tmp_path))


def test_what_is_held_for_parts_that_nobody_asks_for_is_left_over(store):
    asked, other = store.hold("a", b"12345"), store.hold("a", b"123")
    task = Task("tests.tasks.works:hashed", {"number": 0}, (asked,), ".txt")
    carry_out(Plan("p", [task]), store, Local())
    assert read_account(store).leftovers == ()
    for file in (asked, other):
        os.utime(file.path, (1, 1))
    found = read_account(store)
    assert found.jobs[0].done == 1 and found.leftovers == (Path(other.path),) and found.bytes == 65 + 8
    assert remove_stale(store, found) == 3 and Path(asked.path).exists()


def test_bytes_that_another_file_still_has_are_not_out_of_date(store, tmp_path):
    for name in "ab":
        (tmp_path / name).write_text("alike")
    tasks = [*works.tasks(1, {"a": tmp_path / "a"}), *works.tasks(2, {"b": tmp_path / "b"})[1:]]
    carry_out(Plan("p", tasks), store, Local())
    (tmp_path / "a").write_text("other")
    found = read_account(store)
    assert found.jobs[0].changed == (str(tmp_path / "a"),) and found.jobs[0].outdated == 0 and found.stale == ()
