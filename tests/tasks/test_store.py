"""Stores: outputs whole or absent, verified before they are used."""

import hashlib
import os
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.inputs import Checksums
from nerg_mi.tasks.making import make_output
from nerg_mi.tasks.receipt import files_in
from nerg_mi.tasks.store import Store, shares
from nerg_mi.tasks.task import FOLDER, Task
from tests.tasks import works


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def made(store, task):
    return make_output(task, {}, store, Checksums())


def test_an_output_is_named_by_its_key_and_signed_for(store):
    (task,) = works.tasks(1)
    receipt = made(store, task)
    output = store.output(task.key, ".txt")
    assert output == store.folder / task.key[:2] / f"{task.key}.txt" and output.read_bytes() == works.expected(0)
    assert receipt.sha256 == hashlib.sha256(works.expected(0)).hexdigest() and receipt.size == 65
    assert store.find(task.key, ".txt") == store.receipt(task.key) == receipt
    assert receipt.parameters == {"number": 0} and receipt.label == "part 0" and list(store.receipts()) == [receipt]


def test_nothing_is_there_before(store):
    (task,) = works.tasks(1)
    assert store.find(task.key, ".txt") is None and not store.folder.exists()


@pytest.mark.parametrize("harm", ["flip", "shorten", "remove", "receipt", "empty receipt", "another's"])
def test_what_is_damaged_counts_as_not_made(store, harm):
    task, other = works.tasks(2)
    made(store, task), made(store, other)
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
    else:
        receipt.write_text(store.receipt_file(other.key).read_text())
    assert store.find(task.key, ".txt") is None and store.find(other.key, ".txt") is not None
    made(store, task)
    assert store.find(task.key, ".txt") is not None and output.read_bytes() == works.expected(0)


def test_a_folder_is_an_output_too(store):
    task = Task("tests.tasks.works:folder", {"number": 3}, (), FOLDER)
    made(store, task)
    output = store.output(task.key, FOLDER)
    assert [f.relative_to(output).as_posix() for f in files_in(output)] == ["a.txt", "below/b.txt"]
    assert store.find(task.key, FOLDER) is not None
    (output / "below" / "b.txt").write_text("c\n")
    assert store.find(task.key, FOLDER) is None
    made(store, task)
    assert (output / "below" / "b.txt").read_text() == "b\n" and store.find(task.key, FOLDER) is not None
    store.remove(task.key, FOLDER)
    assert not output.exists() and list(store.receipts()) == []


def test_what_arrives_is_compared_with_its_receipt(store, tmp_path):
    (task,) = works.tasks(1)
    receipt = made(Store(tmp_path / "elsewhere"), task)
    with pytest.raises(NergError, match="arrived with other bytes"):
        store.put(task, receipt, [("", b"something else")])
    assert store.find(task.key, ".txt") is None and not store.output(task.key, ".txt").exists()
    store.put(task, receipt, [("", works.expected(0))])
    assert store.find(task.key, ".txt") == receipt
    whole = Task("tests.tasks.works:folder", {"number": 3}, (), FOLDER)
    receipt = made(Store(tmp_path / "elsewhere"), whole)
    store.put(whole, receipt, [("a.txt", b"3\n"), ("below/b.txt", b"b\n")])
    assert store.find(whole.key, FOLDER) == receipt


def test_a_full_disk_leaves_no_half(store):
    """As if no file could grow beyond a few bytes."""
    (task,) = works.tasks(1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        with pytest.raises(NergError, match="raise the limit"):
            made(store, task)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not [p for p in store.folder.rglob("*") if p.is_file()] and store.find(task.key, ".txt") is None


def test_what_workers_left_is_found_when_it_is_old(store):
    task, other = works.tasks(2)
    made(store, task), made(store, other)
    hidden = store.output(task.key, ".txt").with_name(f".{task.key[:32]}.77-ab.part.txt")
    hidden.write_text("half")
    store.receipt_file(other.key).unlink()
    assert store.leftovers(3600) == []
    for path in (hidden, store.output(other.key, ".txt")):
        os.utime(path, (1, 1))
    assert set(store.leftovers(3600)) == {hidden, store.output(other.key, ".txt")}


def test_the_probe_tells_who_shares_the_folder(store, tmp_path):
    with store.probe() as probe:
        assert shares(store.folder, probe) and not shares(tmp_path, probe)
        copy = tmp_path / "copy"
        shutil.copytree(store.folder, copy)
        (copy / probe).write_text("stale")
        assert not shares(copy, probe)
    assert not shares(store.folder, probe)


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(NergError, match="parents is a file"):
        Store(tmp_path / "file" / "store")


def test_receipts_of_others_are_no_receipts(store):
    (task,) = works.tasks(1)
    receipt = made(store, task)
    store.add(replace(receipt, key="f" * 64))
    assert store.find("f" * 64, ".txt") is None
    assert Path(store.receipt_file("f" * 64)).exists()


def test_what_is_held_is_named_by_its_bytes(store):
    first = store.hold("a.npy", b"rays")
    path = Path(first.path)
    assert (first.name, first.size, path.name) == ("a.npy", 4, hashlib.sha256(b"rays").hexdigest() + ".npy")
    before = path.stat().st_ino
    assert store.hold("b.npy", b"rays").path == first.path and path.stat().st_ino == before
    path.write_bytes(b"ways")
    assert Path(store.hold("a.npy", b"rays").path).read_bytes() == b"rays"
    assert store.held(3600) == [] and store.held(-1) == [path]


def test_a_receipt_is_of_its_own_key(store):
    one, other = works.tasks(2)
    made(store, one), made(store, other)
    shutil.copy(store.receipt_file(other.key), store.receipt_file(one.key))
    assert store.receipt(one.key) is None and [r.key for r in store.receipts()] == [other.key]
