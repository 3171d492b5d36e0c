"""Readers of what stores of tasks remember: plans, and receipts of outputs."""

from __future__ import annotations

from pathlib import Path

from tests.fuzz.describe import Reader


def _make_plan(folder: Path) -> None:
    from nerg_mi.tasks.store import Store
    from tests.tasks import works

    (folder / "light.txt").write_text("light")
    Store(folder).remember(works.plan(3, (folder / "light.txt",))).rename(folder / "plans" / "a.json")


def _read_plan(folder: Path) -> None:
    from nerg_mi.tasks.store import Store, read_account

    read_account(Store(folder))


def _make_receipt(folder: Path) -> None:
    from nerg_mi.tasks.store import Store, receipt_of
    from tests.tasks import works

    (folder / "out.txt").write_text("abc")
    (task,), store = works.plan(1).tasks, Store(folder)
    store.add(receipt_of(task, folder / "out.txt", 1.5, {"limits": [0, 1]}))
    store.receipt_file(task.key).rename(folder / "a.json")


def _read_receipt(folder: Path) -> None:
    from nerg_mi.tasks.store import read_receipt

    read_receipt(folder / "a.json")


TASKS = [
    Reader("plan of tasks", _make_plan, {"plans/a.json": ("json", "text")}, _read_plan),
    Reader("receipt of a task", _make_receipt, {"a.json": ("json", "text")}, _read_receipt),
]
