"""`nerg jobs`: what it hands on, and what it says."""

import pytest

from nerg_mi.cli import main
from nerg_mi.tasks.engines import Local, run_plan
from nerg_mi.tasks.store import Store
from tests.tasks import works


def nerg(*words) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return end.value.code or 0


def test_a_store_is_told_of_and_swept(tmp_path, capsys):
    store = Store(tmp_path / "store")
    for count in (3, 1):
        list(run_plan(works.plan(count, what="a film"), store, Local()))
    capsys.readouterr()
    assert nerg("jobs", store.folder) == 0
    said = capsys.readouterr().out
    assert "| a film | 1 | 1 | 0 |" in said and "stale: 2 outputs" in said and len(list(store.receipts())) == 3
    assert nerg("jobs", store.folder, "--remove-stale") == 0
    assert "Removed 130 bytes." in capsys.readouterr().out and len(list(store.receipts())) == 1


def test_what_is_no_store(tmp_path, capsys):
    assert nerg("jobs", tmp_path) == 1
    assert "holds no parts of jobs" in capsys.readouterr().err
