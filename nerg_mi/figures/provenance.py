"""Where a picture comes from, as every picture and video says it of itself: inputs, seed, settings and versions.

Nothing of the machine is in it: of files their names and the SHA-256 of their bytes, no folders, no users, no times, so
that equal inputs give equal files.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePath
from typing import Any

from nerg_mi import __version__
from nerg_mi.files.checksum import file_sha256

_PROGRAMS = ("mitsuba", "drjit")

_OF_THE_RUN = ("seed", "store", "scheduler")
"""Options that are said elsewhere, or on which nothing that is made depends."""


@dataclass(frozen=True)
class Provenance:
    """``what`` made a picture (a command, or a function); ``inputs``: SHA-256 (hex) of files by their names; ``seed``
    of the random numbers, or None where there are none; ``settings`` that were given; ``versions`` of programs."""

    what: str
    inputs: Mapping[str, str] = field(default_factory=dict)
    seed: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def json(self) -> str:
        """All of it as one line of ASCII."""
        return json.dumps({f.name: getattr(self, f.name) for f in fields(self)}, sort_keys=True, default=str)

    def text(self) -> dict[str, str]:
        """What the header of a picture says, by the names that PNG has for it: ``Software`` and ``Comment``."""
        programs = ", ".join(f"{name} {number}" for name, number in self.versions.items())
        return {"Software": programs, "Comment": self.json()}


def provenance(
    what: str,
    inputs: Iterable[str | Path] = (),
    seed: int | None = None,
    settings: Any = None,
    known: dict[Path, str] | None = None,
) -> Provenance:
    """That of what is made of the files, or datasets of rays, ``inputs`` by ``settings``.

    ``settings``: a mapping, or a dataclass of options, of which those are said that differ from their defaults.
    ``known``: checksums by path that need not be computed again; those that are computed are added. Raises `NergError`
    for a file that cannot be read.
    """
    known = {} if known is None else known
    sums: dict[str, str] = {}
    for path in dict.fromkeys(map(Path, inputs)):
        name, number = path.name, 2
        while name in sums:
            name, number = f"{path.name} ({number})", number + 1
        if path not in known:
            known[path] = _digest(path)
        sums[name] = known[path]
    given = {name: value for name, value in _given(settings).items() if name not in _OF_THE_RUN}
    return Provenance(what, sums, seed, {k: _plain(v) for k, v in given.items()}, versions())


def _digest(path: Path) -> str:
    if not path.is_dir():
        return file_sha256(path)
    from nerg_mi.rays.dataset.opening import rays_digest

    return rays_digest(path)


def files_among(*values: Any) -> list[Path]:
    """Those of ``values`` that name files or folders which are there; others, such as rays in memory, have no name."""
    return [Path(v) for v in values if isinstance(v, (str, os.PathLike)) and Path(v).exists()]


def versions() -> dict[str, str]:
    """Version of each program that has a part in a picture, by name."""
    return {"nerg_mi": __version__, **{name: _version(name) for name in _PROGRAMS}}


def _version(name: str) -> str:
    loaded = sys.modules.get(name)
    if loaded is not None:  # where a picture was rendered; it says the same as what is installed, at once
        return loaded.__version__
    from importlib.metadata import version

    return version(name)


def _given(settings: Any) -> dict[str, Any]:
    if settings is None:
        return {}
    if isinstance(settings, Mapping):
        return dict(settings)
    every = {f.name: (getattr(settings, f.name), f.default) for f in fields(settings)}
    return {name: value for name, (value, default) in every.items() if value != default and value is not None}


def _plain(value: Any) -> Any:
    """A setting as JSON has it, with the names of files in place of their paths."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, PurePath):
        return value.name
    if isinstance(value, str):
        return re.split(r"[/\\]", value)[-1] if re.search(r"[/\\]", value) else value
    return value if isinstance(value, (bool, int, float)) or value is None else type(value).__name__
