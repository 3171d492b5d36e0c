"""By what a source is known again: its path, its content, and how it was read, each as a mark that tells nothing else.

Where people have pseudonyms, marks are HMACs under their salt: without it nobody can find out by a mark whether some
file was among the sources.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import reading
from nerg_mi.files.checksum import file_sha256

_FRESH = 2.0  # seconds: a file that was written just now may change without showing it in its time
_MOST_FILES = 100_000  # of a folder that is a source


@dataclass(frozen=True)
class Marks:
    """Marks of texts: SHA-256, or HMAC-SHA256 under ``key``."""

    key: bytes | None = None

    def of(self, kind: str, *words: object) -> str:
        """The mark of ``words``: 32 hexadecimal digits."""
        text = json.dumps([f"dataset {kind}", *words]).encode()
        if self.key is not None:
            return hmac.new(self.key, text, hashlib.sha256).hexdigest()[:32]
        return hashlib.sha256(text).hexdigest()[:32]

    def where(self, source: Path) -> str:
        """That of a source's path."""
        return self.of("path", os.path.realpath(source))

    def stamp(self, source: Path) -> str | None:
        """That of a source's size and time of change; None where it was changed just now. Raises `NergError` for a
        source that is not there."""
        found = [(str(name), stat.st_size, stat.st_mtime_ns) for name, stat in _files(source)]
        if any(time.time() - ns / 1e9 < _FRESH for _, _, ns in found):
            return None
        return self.of("stamp", found)

    def source(self, source: Path, recipe: str) -> str:
        """That of a source's name and content and of how it is read: its id. All of it is read."""
        content = [(str(name), file_sha256(source / name)) for name, _ in _files(source)]
        return self.of("source", source.name, content, recipe)

    def recipe(self, reader: str, options: Any, **more: Any) -> str:
        """That of how sources are read: the reader, its options (files among them by their content), and what else
        changes the rays."""
        given = {}
        for option in fields(options):
            value = getattr(options, option.name)
            if isinstance(value, Path):
                value = [(str(name), file_sha256(value / name)) for name, _ in _files(value)]
            given[option.name] = repr(value)
        return self.of("recipe", reader, given, more)


def _files(source: Path) -> list[tuple[Path, os.stat_result]]:
    """The files that a source consists of, by their names within it (nothing for a file), and what is known of them."""
    with reading(source, "tracking file"):
        if not source.is_dir():
            return [(Path(), os.stat(source))]
        found = []
        for folder, folders, names in os.walk(source):
            folders.sort()
            found += [Path(folder, name) for name in sorted(names)]
            if len(found) > _MOST_FILES:
                raise NergError(
                    f'the folder "{source}" holds more than the {_MOST_FILES:,} files that are read; name those in it'
                )
        return [(path.relative_to(source), os.stat(path)) for path in found if path.is_file()]
