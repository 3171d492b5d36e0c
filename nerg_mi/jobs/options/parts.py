"""Options of jobs that are done in parts, each of which is kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import Checked

from . import option
from .pictures import PictureOptions


@dataclass(frozen=True, kw_only=True)
class PartOptions(Checked):
    """Where finished parts of a job are kept, and who makes them."""

    store: Path | None = option(
        None,
        "Keep finished parts in this folder, and go on from them.  [default: OUTPUT.tasks, with --scheduler]",
        changes_result=False,
    )
    scheduler: str | None = option(
        None,
        "Who makes the parts: local, local:N for N processes, or a cluster at tcp://HOST:PORT or tls://HOST:PORT.  "
        "[default: local, with --store]",
        changes_result=False,
    )

    @property
    def in_parts(self) -> bool:
        """Whether the job is to be done in parts at all."""
        return self.store is not None or self.scheduler is not None


@dataclass(frozen=True, kw_only=True)
class FilmOptions(PictureOptions, PartOptions):
    """How a scene file is rendered, in one go or in parts."""
