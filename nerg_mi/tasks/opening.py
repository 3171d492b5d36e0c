"""Schedulers by what a user calls them."""

from __future__ import annotations

import re

from nerg_mi.errors import NergError

from .addresses import is_cluster
from .dask_cluster import Cluster
from .local import Local
from .processes import Processes
from .protocol import Scheduler

LOCAL = "local"

_PROCESSES = re.compile(r"local:(\d{1,6})")


def open_scheduler(name: str | None, threads: int = 0) -> Scheduler:
    """The scheduler ``name``: "local" or None is this process, "local:N" N processes of this machine, and
    "tcp://HOST:PORT" or "tls://HOST:PORT" the workers of dask there. ``threads`` of each process but this one; 0: what
    there is. Raises `NergError` for another name, and
    `ImportError` where dask is missing."""
    if name is None or name == LOCAL:
        return Local()
    if found := _PROCESSES.fullmatch(name):
        return Processes(int(found[1]), threads)
    if not is_cluster(name):
        raise NergError(
            f'there is no scheduler "{name}": give local, local:N for N processes, tcp://HOST:PORT or tls://HOST:PORT'
        )
    return Cluster(name, threads=threads)
