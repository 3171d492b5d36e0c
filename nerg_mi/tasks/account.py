"""What a store holds: which jobs are how far, what is stale, and what is taken by it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import writing

from .inputs import Checksums
from .plan import Remembered, read_plans
from .receipt import Receipt
from .store import Store

AGE = 3600.0
"""Seconds after which what is unfinished counts as left by a worker that died."""


@dataclass(frozen=True)
class JobAccount:
    """How far one job is: ``done`` of ``total`` parts, with ``bytes`` of output that took ``seconds`` to make;
    ``changed``: its inputs that have other bytes by now, ``gone``: those that are not there any more; ``outdated``:
    parts that are done and were made of what was changed."""

    what: str
    total: int
    done: int
    bytes: int
    seconds: float
    changed: tuple[str, ...]
    gone: tuple[str, ...]
    outdated: int

    @property
    def left(self) -> int:
        """Parts that are not there yet."""
        return self.total - self.done


@dataclass(frozen=True)
class Account:
    """``jobs`` of a store; ``stale``: outputs that no job asks for any more, as it was started last, and those that
    were made of files that were changed since; ``leftovers``: what workers that died have left, and what the store
    holds for parts that nobody asks for any more; ``bytes`` of all outputs and of what is held for them."""

    jobs: tuple[JobAccount, ...]
    stale: tuple[Receipt, ...]
    leftovers: tuple[Path, ...]
    bytes: int
    leftover_bytes: int

    @property
    def stale_bytes(self) -> int:
        """Bytes that removing what is stale gives back."""
        return sum(receipt.size for receipt in self.stale)


def read_account(store: Store, age: float = AGE) -> Account:
    """What ``store`` holds; unfinished files count as leftovers after ``age`` seconds. Outputs are not read: whether
    they are whole is verified before they are used. Raises `NergError` where there is no store, or its plans cannot be
    read."""
    plans = read_plans(store)
    if not plans and not any(store.folder.glob("[0-9a-f][0-9a-f]")):
        raise NergError(f'"{store.folder}" holds no parts of jobs; name the folder that was given as --store')
    receipts = {receipt.key: receipt for receipt in store.receipts()}
    checksums = Checksums()
    jobs, wanted = [], set[str]()
    for plan in plans:
        job, current = _job(plan, receipts, checksums)
        jobs.append(job)
        wanted |= current
    held = {name for plan in plans for name in plan.held}
    leftovers = (*store.leftovers(age), *(path for path in store.held(age) if path.name not in held))
    return Account(
        tuple(jobs),
        tuple(receipt for key, receipt in receipts.items() if key not in wanted),
        leftovers,
        sum(receipt.size for receipt in receipts.values()) + sum(map(_size, store.held(0.0))),
        sum(_size(path) for path in leftovers),
    )


def _job(plan: Remembered, receipts: dict[str, Receipt], checksums: Checksums) -> tuple[JobAccount, set[str]]:
    """How far a plan is, and the keys of what it asks for that is not out of date."""
    changed, gone, digests, asked = [], [], set[str](), set[str]()
    for path, sha256 in plan.inputs.items():
        if Path(path).is_file() and checksums.of(path) != sha256:
            changed.append(path)
            digests.add(sha256)
            continue
        asked.add(sha256)
        if not Path(path).is_file():
            # Of what is gone nobody can say that it was changed.
            gone.append(path)
    digests -= asked
    done = [receipts[key] for key in plan.keys if key in receipts]
    outdated = {receipt.key for receipt in done if digests & set(receipt.inputs.values())}
    account = JobAccount(
        plan.what,
        len(plan.keys),
        len(done),
        sum(receipt.size for receipt in done),
        sum(receipt.seconds for receipt in done),
        tuple(changed),
        tuple(gone),
        len(outdated),
    )
    return account, set(plan.keys) - outdated


def remove_stale(store: Store, account: Account) -> int:
    """Remove from ``store`` what ``account`` says is stale or left over; gives the bytes that became free."""
    for receipt in account.stale:
        store.remove(receipt.key, receipt.suffix)
    for path in account.leftovers:
        with writing(path):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return account.stale_bytes + account.leftover_bytes


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file())
