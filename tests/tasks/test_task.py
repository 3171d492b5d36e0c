"""Keys of tasks: what changes them, and what does not."""

import hashlib
import json

import pytest

from nerg_mi.tasks.inputs import read_input
from nerg_mi.tasks.task import Task, canonical, find_function, task_of

WORK = "tests.tasks.works:hashed"


@pytest.fixture
def file(tmp_path):
    (tmp_path / "a.txt").write_text("light")
    return tmp_path / "a.txt"


def test_a_key_is_the_checksum_of_what_the_output_depends_on(file):
    task = Task(WORK, {"b": 1.5, "a": [1, 2]}, (read_input("x", file),), ".txt", {"code": "1"}, label="one")
    about = {
        "format": 1,
        "function": WORK,
        "inputs": {"x": hashlib.sha256(b"light").hexdigest()},
        "parameters": {"a": [1, 2], "b": 1.5},
        "suffix": ".txt",
        "versions": {"code": "1"},
    }
    text = json.dumps(about, sort_keys=True, separators=(",", ":"))
    assert task.key == hashlib.sha256(text.encode()).hexdigest()


def test_what_changes_a_key(file, tmp_path):
    def key(function=WORK, parameters=None, name="x", path=file, suffix=".txt", versions=None, label=""):
        inputs = (read_input(name, path),)
        return Task(function, parameters or {"a": 1}, inputs, suffix, versions or {"v": "1"}, label).key

    (tmp_path / "other.txt").write_text("light")
    assert key() == key(path=tmp_path / "other.txt") == key(label="called otherwise")
    (tmp_path / "dark.txt").write_text("dark")
    others = [
        key("tests.tasks.works:folder"),
        key(parameters={"a": 2}),
        key(name="y"),
        key(path=tmp_path / "dark.txt"),
        key(suffix=".csv"),
        key(versions={"v": "2"}),
    ]
    assert len({key(), *others}) == 7


def test_floats_keep_every_bit_on_their_way():
    value = 0.1 + 0.2
    task = Task(WORK, {"x": value, "y": 5e-324})
    assert task_of(json.loads(json.dumps(task.document()))) == task
    assert json.loads(canonical({"x": value}))["x"] == value


@pytest.mark.parametrize("wrong", ["works", "a b:c", "os:system; rm", ":x", "a:_private"])
def test_functions_are_named_by_module_and_name(wrong):
    with pytest.raises(ValueError, match="names no function"):
        Task(wrong)


@pytest.mark.parametrize("wrong", ["png", "/..", ".a/b", "..", ".part/"])
def test_a_suffix_leads_nowhere(wrong):
    with pytest.raises(ValueError, match="is no suffix"):
        Task(WORK, suffix=wrong)


def test_what_json_does_not_have_is_no_parameter():
    with pytest.raises(ValueError):
        assert Task(WORK, {"x": float("nan")}).key


def test_two_inputs_have_two_names(file):
    with pytest.raises(ValueError, match="two files by one name"):
        Task(WORK, {}, (read_input("x", file), read_input("x", file)))


def test_functions_are_found():
    assert find_function("os.path:basename")("a/b") == "b"
    for name in ("os.path:nowhere", "no_such_module:f"):
        with pytest.raises(ValueError, match="there is no function"):
            find_function(name)
