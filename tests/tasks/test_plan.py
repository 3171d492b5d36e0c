"""Plans as stores remember them."""

import json

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import plan as module
from nerg_mi.tasks.plan import Plan, Remembered, read_plan, read_plans, remember
from nerg_mi.tasks.store import Store
from tests.tasks import works


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def test_a_plan_is_remembered_and_replaced_by_its_name(store, tmp_path):
    (tmp_path / "a").write_text("x")
    tasks = works.tasks(2, {"a": tmp_path / "a"})
    path = remember(store, Plan("render a", tasks))
    known = {str(tmp_path / "a"): tasks[0].inputs[0].sha256}
    assert read_plan(path) == Remembered("render a", {t.key: ".txt" for t in tasks}, known)
    assert remember(store, Plan("render a", tasks[:1])) == path
    remember(store, Plan("a film", works.tasks(3)))
    assert [(p.what, len(p.keys)) for p in read_plans(store)] == [("a film", 3), ("render a", 1)]


def test_what_lies_in_the_store_is_no_input_to_watch(store):
    store.folder.mkdir()
    (store.folder / "layers.npy").write_text("x")
    assert read_plan(remember(store, Plan("p", works.tasks(1, {"a": store.folder / "layers.npy"})))).inputs == {}


GOOD = {"format": 1, "what": "p", "inputs": {}, "keys": {"a" * 64: ".png"}}


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2},
        {"what": 3},
        {"keys": []},
        {"keys": {"a" * 64: 3}},
        {"inputs": {"a": None}},
        {"keys": {"../../etc": ".png"}},
        {"keys": {"a" * 64: "/../x"}},
    ],
)
def test_what_is_no_plan_is_refused(tmp_path, change):
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(GOOD))
    assert read_plan(path).what == "p"
    path.write_text(json.dumps({**GOOD, **change}))
    with pytest.raises(NergError, match="start its job again"):
        read_plan(path)


def test_a_plan_has_bounds(monkeypatch):
    monkeypatch.setattr(module, "MOST", 3)
    with pytest.raises(NergError, match="has 4 parts, and at most 3 are planned"):
        Plan("p", works.tasks(4))
