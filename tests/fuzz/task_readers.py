"""Readers of what stores of tasks remember: plans, and receipts of outputs."""

from __future__ import annotations

from pathlib import Path

from tests.fuzz.describe import Reader


def _make_plan(folder: Path) -> None:
    from nerg_mi.tasks.plan import Plan, remember
    from nerg_mi.tasks.store import Store
    from tests.tasks import works

    (folder / "light.txt").write_text("light")
    remember(Store(folder), Plan("a film", works.tasks(3, {"light.txt": folder / "light.txt"}))).rename(
        folder / "plans" / "a.json"
    )


def _read_plan(folder: Path) -> None:
    from nerg_mi.tasks.account import read_account
    from nerg_mi.tasks.store import Store

    read_account(Store(folder))


def _make_receipt(folder: Path) -> None:
    from nerg_mi.tasks.receipt import receipt_for, write_receipt
    from tests.tasks import works

    (folder / "out.txt").write_text("abc")
    write_receipt(folder / "a.json", receipt_for(works.tasks(1)[0], folder / "out.txt", 1.5, "x", {"limits": [0, 1]}))


def _read_receipt(folder: Path) -> None:
    from nerg_mi.tasks.receipt import read_receipt

    read_receipt(folder / "a.json")


TASKS = [
    Reader("plan of tasks", _make_plan, {"plans/a.json": ("json", "text")}, _read_plan),
    Reader("receipt of a task", _make_receipt, {"a.json": ("json", "text")}, _read_receipt),
]
