"""Jobs in parts: from their options to a store and a scheduler, and outputs in their order with progress told."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from nerg_mi.rays.rays import Rays
from nerg_mi.tasks.inputs import InputFile
from nerg_mi.tasks.opening import open_scheduler
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.protocol import Scheduler
from nerg_mi.tasks.run import Output, Progress, run_plan
from nerg_mi.tasks.store import Store

from .options.parts import PartOptions
from .reporter import Reporter

SUFFIX = ".tasks"
"""Of the store beside an output, where none is named."""


class Parts:
    """The store and the scheduler of one job, which writes ``output``. Raises `NergError` for a folder that cannot be
    written to, and for a scheduler that there is none of. ``threads``: of each process that makes parts."""

    def __init__(self, options: PartOptions, output: Path, reporter: Reporter, threads: int | None = None):
        self.store = Store(output.with_suffix(SUFFIX) if options.store is None else options.store)
        self.scheduler: Scheduler = open_scheduler(options.scheduler, threads or 0)
        self._reporter = reporter

    def hold(self, name: str, values: np.ndarray) -> InputFile:
        """``values`` as an input of tasks (.npy), which call it ``name``."""
        content = io.BytesIO()
        np.lib.format.write_array(content, np.ascontiguousarray(values), allow_pickle=False)
        return self.store.hold(name, content.getvalue())

    def hold_rays(self, name: str, rays: Rays) -> InputFile:
        """``rays`` as an input of tasks (.npz), which call it ``name``."""
        with TemporaryDirectory(prefix="nerg-rays-") as folder:
            file = Path(folder) / "rays.npz"
            rays.save(file)
            return self.store.hold(name, file.read_bytes())

    def run(self, plan: Plan, since: float = 0.0, until: float = 1.0) -> Iterator[Output]:
        """The outputs of ``plan`` in its order; see `run_plan`. Of the whole job this is from the share ``since`` to
        the share ``until``. Ctrl-C says where it goes on from."""

        def tell(progress: Progress) -> None:
            line = progress.line() if until == 1.0 else progress.line().partition(" s left")[0].rpartition(",")[0]
            self._reporter.progress(since + (until - since) * progress.share, line or progress.line())

        with self._kept():
            yield from run_plan(plan, self.store, self.scheduler, tell, self._reporter.warn)

    @contextmanager
    def _kept(self) -> Iterator[None]:
        try:
            yield
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Interrupted; the parts that are done are kept in {self.store.folder}: the same command goes on."
            ) from None
