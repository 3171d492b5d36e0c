"""A task run: what it is given, and what it is refused for."""

import pytest

from nerg_mi.tasks.code import versions
from nerg_mi.tasks.inputs import Checksums
from nerg_mi.tasks.making import OtherCode, check_code, make_output
from nerg_mi.tasks.store import Store
from nerg_mi.tasks.task import Task
from tests.tasks import works


def test_files_are_read_where_they_are_here(tmp_path):
    """A worker has them elsewhere than whoever planned the task."""
    for folder in ("there", "here"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a").write_text("light")
    (task,) = works.tasks(1, {"a": tmp_path / "there" / "a"})
    (tmp_path / "there" / "a").unlink()
    store = Store(tmp_path / "store")
    receipt = make_output(task, {"a": tmp_path / "here" / "a"}, store, Checksums())
    assert store.output(task.key, ".txt").read_bytes() == works.expected(0, {"a": tmp_path / "here" / "a"})
    assert receipt.seconds >= 0 and list(receipt.inputs) == ["a"]


def test_the_same_code_is_needed():
    check_code(Task("a:b"))
    check_code(Task("a:b", versions=versions()))
    with pytest.raises(OtherCode, match="install the same one everywhere"):
        check_code(Task("a:b", versions={"code": "0123456789abcdef"}))
