"""Checksums of files, by which a result says what it was made from."""

from __future__ import annotations

import hashlib
import os

from .bounded import open_file

_BLOCK = 1 << 20


def file_sha256(path: str | os.PathLike) -> str:
    """Hex digest of a file's bytes. Raises `NergError` for what is no ordinary file, or cannot be read."""
    digest = hashlib.sha256()
    with open_file(path) as source:
        while block := source.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()
