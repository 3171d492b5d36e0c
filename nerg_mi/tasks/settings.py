"""Settings of operations that run in parts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from nerg_mi.ranges import SECONDS, THREADS, ValidatedDataclass, range_field, setting


@dataclass(frozen=True, kw_only=True)
class Parallel(ValidatedDataclass):
    """Where finished parts of an operation are stored, and what computes them.

    Without a store and a scheduler, an operation runs as a whole and stores nothing. The result is the same.
    """

    GROUP: ClassVar = "Performance"
    """Heading of the options in the help."""

    store: Path | None = setting(
        None,
        "Folder that stores finished parts; running the command again resumes from them.  "
        "[default: OUTPUT.tasks if --scheduler is given, else nothing is stored]",
        changes_result=False,
    )
    scheduler: str | None = setting(
        None,
        "What computes the parts: local, local:N for N processes, or a dask cluster at tcp://HOST:PORT or "
        "tls://HOST:PORT.  [default: local if --store is given]",
        changes_result=False,
    )
    threads: int | None = setting(
        None,
        "Number of CPU threads, of each process that computes parts.  [default: all cores]",
        THREADS,
        changes_result=False,
    )
    worker_wait: float = range_field(600.0, SECONDS)
    """Seconds to wait for workers of a Dask cluster while none can run the parts."""

    @property
    def in_parts(self) -> bool:
        """Whether the operation runs in parts."""
        return self.store is not None or self.scheduler is not None
