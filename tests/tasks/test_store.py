"""Stores: outputs whole or absent, verified before they are used; and what is done, left and stale."""

import hashlib
import json
import os
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.engines import Local, run_plan
from nerg_mi.tasks.store import Store, content_of, files_in, read_account, read_plan, remove_stale
from tests.tasks import works


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def made(store, plan):
    return list(run_plan(plan, store, Local()))


def test_an_output_is_named_by_its_key_and_signed_for(store):
    plan = works.plan(1)
    made(store, plan)
    (task,), (receipt,) = plan.tasks, store.receipts()
    output = store.output(task.key, ".txt")
    assert output == store.folder / task.key[:2] / f"{task.key}.txt" and output.read_bytes() == works.expected(0)
    assert receipt.sha256 == hashlib.sha256(works.expected(0)).hexdigest() and receipt.size == 65
    assert store.find(task.key, ".txt") == store.receipt(task.key) == receipt and receipt.label == "part 0"


def test_nothing_is_there_before(store):
    assert store.find(works.plan(1).tasks[0].key, ".txt") is None and not store.folder.exists()


@pytest.mark.parametrize("harm", ["flip", "shorten", "remove", "receipt", "empty receipt", "another's", "version 1"])
def test_what_is_damaged_or_of_another_version_counts_as_not_made(store, harm):
    plan = works.plan(2)
    task, other = plan.tasks
    made(store, plan)
    output, receipt = store.output(task.key, ".txt"), store.receipt_file(task.key)
    if harm == "flip":
        raw = bytearray(output.read_bytes())
        raw[3] ^= 1
        output.write_bytes(raw)
    elif harm == "shorten":
        output.write_bytes(output.read_bytes()[:-1])
    elif harm == "remove":
        output.unlink()
    elif harm == "receipt":
        receipt.write_text(receipt.read_text()[:-20])
    elif harm == "empty receipt":
        receipt.write_text("")
    elif harm == "version 1":
        receipt.write_text(json.dumps(json.loads(receipt.read_text()) | {"format": 1}))
    else:
        shutil.copy(store.receipt_file(other.key), receipt)
    assert store.find(task.key, ".txt") is None and store.find(other.key, ".txt") is not None
    made(store, plan)
    assert store.find(task.key, ".txt") is not None and output.read_bytes() == works.expected(0)


def test_a_folder_is_an_output_too(store):
    plan = works.folders(3)
    made(store, plan)
    (task,) = plan.tasks
    output = store.output(task.key, "/")
    assert [f.relative_to(output).as_posix() for f in files_in(output)] == ["a.txt", "below/b.txt"]
    (output / "below" / "b.txt").write_text("c\n")
    assert store.find(task.key, "/") is None
    made(store, plan)
    assert (output / "below" / "b.txt").read_text() == "b\n" and store.find(task.key, "/") is not None
    store.remove(task.key, "/")
    assert not output.exists() and list(store.receipts()) == []


def test_what_arrives_is_compared_with_its_receipt(store, tmp_path):
    there = Store(tmp_path / "elsewhere")
    for plan in (works.plan(1), works.folders(3)):
        (output,) = made(there, plan)
        (task,) = plan.tasks
        receipt = there.receipt(task.key)
        with pytest.raises(NergError, match="arrived with other bytes"):
            store.put(task, receipt, [("a" if task.suffix == "/" else "", b"something else")])
        assert store.find(task.key, task.suffix) is None and not store.output(task.key, task.suffix).exists()
        store.put(task, receipt, content_of(output.path))
        assert store.find(task.key, task.suffix) == receipt


def test_a_full_disk_leaves_no_half(store):
    """As if no file could grow beyond some hundred bytes, which a plan needs."""
    plan = works.plan(1)
    store.remember(plan)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        with pytest.raises(NergError, match="raise the limit"):
            next(Local().run(plan.shared, plan.tasks, store, print))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not [p for p in store.folder.glob("??/*") if p.is_file()]


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(NergError, match="parents is a file"):
        Store(tmp_path / "file" / "store")


def test_scratch_goes_with_the_block_and_is_left_over_otherwise(store):
    with store.scratch() as folder:
        (folder / "rays.npz").write_text("12345")
        assert store.leftovers(3600) == [] and store.leftovers(-1) == [folder]
    assert not folder.exists()


# ---- Plans ----


def test_a_plan_is_remembered_and_replaced_by_its_name(store, tmp_path):
    (tmp_path / "a").write_text("x")
    (store.folder / "b").parent.mkdir()
    (store.folder / "b").write_text("made by a part")
    plan = works.plan(2, (tmp_path / "a", store.folder / "b"))
    path = store.remember(plan)
    found = read_plan(path)
    sha256 = hashlib.sha256(b"x").hexdigest()
    assert (found.what, found.keys) == ("p", {t.key: ".txt" for t in plan.tasks})
    assert found.inputs == {str(tmp_path / "a"): sha256} and found.common == {sha256}
    assert store.remember(works.plan(1)) == path
    store.remember(works.plan(3, what="a film"))
    assert [(p.what, len(p.keys)) for p in store.plans()] == [("a film", 3), ("p", 1)]


GOOD = {"format": 2, "what": "p", "inputs": {}, "common": [], "keys": {"a" * 64: ".png"}}


@pytest.mark.parametrize(
    "change",
    [
        {"format": 1},
        {"what": 3},
        {"keys": []},
        {"keys": {"a" * 64: 3}},
        {"inputs": {"a": None}},
        {"common": [3]},
        {"common": None},
        {"keys": {"../../etc": ".png"}},
        {"keys": {"a" * 64: "/../x"}},
    ],
)
def test_what_is_no_plan_is_refused(tmp_path, change):
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(GOOD))
    assert read_plan(path).what == "p"
    path.write_text(json.dumps({**GOOD, **change}))
    with pytest.raises(NergError, match=r"plan\.json.*start (its|the) job again"):
        read_plan(path)


# ---- What is done, left and stale ----


def test_a_job_that_was_interrupted(store):
    arriving = run_plan(works.plan(5), store, Local())
    next(arriving), next(arriving)
    arriving.close()
    account = read_account(store)
    (job,) = account.jobs
    assert (job.what, job.total, job.done, job.left, job.bytes) == ("p", 5, 2, 3, 130)
    assert account.stale == () and account.leftovers == () and account.bytes == 130 and job.seconds >= 0


def test_what_no_job_asks_for_is_stale(store):
    made(store, works.plan(4)), made(store, works.plan(2, what="another")), made(store, works.plan(1))
    account = read_account(store)
    assert sorted(r.label for r in account.stale) == ["part 2", "part 3"]
    assert account.stale_bytes == 130 == remove_stale(store, account)
    left = read_account(store)
    assert left.stale == () and [job.done for job in left.jobs] == [2, 1] and left.bytes == 130


def test_what_was_made_of_a_file_that_has_changed_is_stale(store, tmp_path):
    """A file of all parts, one of a single part, and one that is gone."""
    for name in "abc":
        (tmp_path / name).write_text(f"{name} before")
    made(store, works.plan(2, (tmp_path / "a",), what="all"))
    made(store, works.read_one(tmp_path / "b", tmp_path / "c"))
    for name in "ab":
        (tmp_path / name).write_text("after")
    (tmp_path / "c").unlink()
    account = read_account(store)
    both, each = account.jobs
    assert both.changed == (str(tmp_path / "a"),) and both.outdated == 2
    assert each.changed == (str(tmp_path / "b"),) and each.gone == (str(tmp_path / "c"),) and each.outdated == 1
    assert {r.label for r in account.stale} == {"part 0", "part 1", "of b"}
    remove_stale(store, account)
    assert [r.label for r in store.receipts()] == ["of c"]


def test_bytes_that_another_file_still_has_are_not_out_of_date(store, tmp_path):
    for name in "ab":
        (tmp_path / name).write_text("alike")
    made(store, works.read_one(tmp_path / "a", tmp_path / "b"))
    (tmp_path / "a").write_text("other")
    account = read_account(store)
    assert account.jobs[0].changed == (str(tmp_path / "a"),) and account.jobs[0].outdated == 0 and account.stale == ()


def test_leftovers_are_removed_when_they_are_old(store):
    made(store, works.plan(2))
    hidden = next(store.folder.glob("??")) / ".abc.part.txt"
    hidden.write_text("half")
    folder = hidden.with_name(".abd.part")
    (folder / "below").mkdir(parents=True)
    (folder / "below" / "x").write_text("12345")
    unsigned = works.plan(2).tasks[1].key
    store.receipt_file(unsigned).unlink()
    assert read_account(store).leftovers == ()
    for path in (hidden, folder, store.output(unsigned, ".txt")):
        os.utime(path, (1, 1))
    account = read_account(store)
    assert len(account.leftovers) == 3 and account.leftover_bytes == 9 + 65 == remove_stale(store, account)
    assert not hidden.exists() and not folder.exists() and read_account(store).jobs[0].done == 1


def test_a_folder_that_is_no_store(tmp_path):
    with pytest.raises(NergError, match="holds no parts of jobs"):
        read_account(Store(tmp_path))


def test_receipts_of_others_are_no_receipts(store):
    made(store, works.plan(1))
    (receipt,) = store.receipts()
    store.add(replace(receipt, key="f" * 64))
    assert store.find("f" * 64, ".txt") is None and Path(store.receipt_file("f" * 64)).exists()
