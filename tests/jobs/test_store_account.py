"""What is told of a store."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.jobs.store_account import account_for_store, size
from nerg_mi.tasks.local import Local
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.run import carry_out, run_plan
from nerg_mi.tasks.store import Store
from tests.jobs.recorder import Recorder
from tests.tasks import works


def test_lines_and_removal(tmp_path):
    (tmp_path / "a").write_text("before")
    store = Store(tmp_path / "store")
    arriving = run_plan(Plan("nerg render walk.mp4", works.tasks(5)), store, Local())
    next(arriving), next(arriving)
    arriving.close()
    carry_out(Plan("another", works.tasks(2, {"a": tmp_path / "a"})), store, Local())
    (tmp_path / "a").write_text("after")
    told = Recorder()
    account = account_for_store(store.folder, reporter=told)
    lines = told.messages[0].splitlines()
    assert lines[2].startswith("| another | 2 | 2 | 0 | 130 bytes | 0 s | 2 |")
    assert lines[3].startswith("| nerg render walk.mp4 | 5 | 2 | 3 | 130 bytes |")
    assert told.messages[1] == f"changed since another: {tmp_path / 'a'}"
    assert told.messages[2].startswith("260 bytes in all; stale: 2 outputs, 130 bytes;")
    assert "--remove-stale" in told.messages[3] and len(account.stale) == 2
    told = Recorder()
    account_for_store(store.folder, True, told)
    assert told.messages[-1] == "Removed 130 bytes." and len(list(store.receipts())) == 2


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(NergError, match="there is no folder"):
        account_for_store(tmp_path / "none")


def test_sizes():
    assert [size(n) for n in (0, 999, 1200, 34_000, 5_600_000, 7.8e9, 2e12)] == [
        "0 bytes",
        "999 bytes",
        "1.2 kB",
        "34 kB",
        "5.6 MB",
        "7.8 GB",
        "2.0 TB",
    ]
