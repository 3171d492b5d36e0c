"""Which code makes an output: a digest of this package's sources, and the versions of what computes for it."""

from __future__ import annotations

import hashlib
import importlib.util
import platform
from collections.abc import Iterable
from functools import cache
from importlib.metadata import version
from pathlib import Path

_ROOMS = ("nerg_mi", "nerg_mi.plugins", "nerg_mi.scenes")
_LEAVE_OUT = ("cli", "viewer", "tasks")
"""Rooms that have no part in what a task computes."""


@cache
def code_digest() -> str:
    """Hex digest (16 digits) of the sources that outputs are made by, so that nothing is kept that other code made.

    A version number alone stays what it is while a checkout changes.
    """
    folders = []
    for room in _ROOMS:
        spec = importlib.util.find_spec(room)
        folders += [(room, Path(place)) for place in (spec and spec.submodule_search_locations) or ()]
    return digest_of_sources(folders)


def digest_of_sources(folders: Iterable[tuple[str, Path]]) -> str:
    """Hex digest (16 digits) of all Python files in packages, each a name and its folder, but for `_LEAVE_OUT`."""
    digest = hashlib.sha256()
    for room, folder in folders:
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder).as_posix()
            if name.split("/")[0] not in _LEAVE_OUT:
                digest.update(f"{room}/{name}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


def versions(*distributions: str) -> dict[str, str]:
    """The ``code`` of this package and the versions of ``distributions``, by name: `Task.versions`."""
    return {"code": code_digest(), **{name: version(name) for name in distributions}}


RENDERS = ("mitsuba", "drjit", "numpy")
"""Distributions on whose versions pictures and trainings depend."""


@cache
def processor() -> str:
    """What this machine calls its processor, or its kind where it does not say."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())[:120]
