"""A plan carried out: what is there is kept, what is missing is made, and outputs are taken in the plan's order."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError

from .plan import Plan, remember
from .protocol import Done, Scheduler, Warn
from .store import Store
from .task import Task


@dataclass
class Progress:
    """How far a plan is: ``done`` of ``total`` tasks, ``kept`` of them from earlier runs; ``seconds`` since the first
    that was missing was begun, ``workers`` that have made one so far, and the kinds of ``processors``."""

    total: int
    kept: int = 0
    done: int = 0
    seconds: float = 0.0
    workers: set[str] = field(default_factory=set)
    processors: set[str] = field(default_factory=set)

    @property
    def share(self) -> float:
        """How much is done, from 0 to 1."""
        return self.done / self.total if self.total else 1.0

    @property
    def left(self) -> float | None:
        """Seconds until the end if the rest goes as fast as what was made in this run; None while nothing was."""
        made = self.done - self.kept
        return self.seconds * (self.total - self.done) / made if made else None

    def line(self) -> str:
        """For a progress bar: parts done, how fast, how long it takes yet."""
        text = f"{self.done} of {self.total} parts"
        left = self.left
        if left is None:
            return text
        rate = (self.done - self.kept) / max(self.seconds, 1e-9)
        speed = f"{rate:.2g} a second" if rate >= 1 else f"{60 * rate:.2g} a minute"
        return f"{text}, {speed}, {left:.0f} s left"


@dataclass(frozen=True)
class Output:
    """What a task has made: the file or folder ``path`` in the store, to be read only, and its ``notes``."""

    path: Path
    notes: Mapping[str, Any]


OnProgress = Callable[[Progress], None]


def run_plan(
    plan: Plan,
    store: Store,
    scheduler: Scheduler,
    on_progress: OnProgress = lambda progress: None,
    warn: Warn = lambda text: None,
) -> Iterator[Output]:
    """Gives the output of each task of ``plan``, in its order, as soon as it and all before it are there.

    What ``store`` holds whole is kept; what is missing or damaged is made by ``scheduler``. Whoever combines outputs as
    they come does so in one order, whatever ran where: sums of floating-point numbers are equal to the bit. Nothing but
    the plan itself is held in memory. Raises `NergError` where a task cannot be done; what was done by then is kept,
    and the same plan goes on from there.
    """
    remember(store, plan)
    missing: dict[str, Task] = {}
    whole: set[str] = set()
    progress = Progress(len(plan.tasks))
    for task in plan.tasks:
        if task.key in whole or task.key in missing:
            continue
        receipt = store.find(task.key, task.suffix)
        if receipt is None:
            missing[task.key] = task
        else:
            whole.add(task.key)
            progress.processors.add(receipt.processor)
    counts = Counter(task.key for task in plan.tasks)
    progress.kept = progress.done = sum(counts[key] for key in whole)
    on_progress(progress)
    start = time.perf_counter()
    with closing(scheduler.run(iter(list(missing.values())), store, warn)) as arriving:
        for task in plan.tasks:
            while task.key not in whole:
                done = _next(arriving, task)
                whole.add(done.task.key)
                progress.done += counts[done.task.key]
                progress.seconds = time.perf_counter() - start
                progress.workers.add(done.where)
                _compare(progress, done, warn)
                on_progress(progress)
            receipt = store.receipt(task.key)
            if receipt is None:
                raise NergError(f'{task.label} was taken out of "{store.folder}" meanwhile; start the job again')
            yield Output(store.output(task.key, task.suffix), receipt.notes)


def _next(arriving: Iterator[Done], task: Task) -> Done:
    done = next(arriving, None)
    if done is None:
        raise RuntimeError(f"the scheduler ended without {task.label}")
    return done


def _compare(progress: Progress, done: Done, warn: Warn) -> None:
    """Tell when outputs come from several kinds of processors, on which floating-point sums may be rounded apart."""
    before = len(progress.processors)
    progress.processors.add(done.receipt.processor)
    if before == 1 and len(progress.processors) == 2:
        names = " and ".join(f'"{name}"' for name in sorted(progress.processors))
        warn(f"parts are made on {names}; equal seeds give equal bytes on equal processors only")


def carry_out(
    plan: Plan,
    store: Store,
    scheduler: Scheduler,
    on_progress: OnProgress = lambda progress: None,
    warn: Warn = lambda text: None,
) -> list[Output]:
    """The outputs of ``plan`` in its order, once all are there; see `run_plan`."""
    return list(run_plan(plan, store, scheduler, on_progress, warn))
