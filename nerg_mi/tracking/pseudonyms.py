"""Pseudonyms of participants: HMAC-SHA256 of the name, with a salt as the key.

With the salt, the pseudonym of a known or guessed name can be computed; without it, pseudonyms do not reveal names.
Positions and gaze are not changed, and can still identify a person.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import secrets
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import read_bytes

from .rays import Rays

MIN_SALT_BYTES = 16  # Shorter salts can be found by trying all of them
_MAX_SALT_BYTES = 1 << 20
# Hexadecimal digits of a pseudonym: 64 bits, so that collisions are practically impossible.
_DIGITS = 16
# Shorter names occur within too many words to be searched for.
_MIN_NAME_LENGTH = 3


def read_salt(path: str | os.PathLike) -> bytes:
    """Read the file ``path`` as a salt. Raises `NergError` if it is missing or too short."""
    salt = read_bytes(path, "salt", _MAX_SALT_BYTES)
    if len(salt) < MIN_SALT_BYTES:
        raise NergError(
            f'the salt "{path}" has {len(salt)} bytes; fewer than {MIN_SALT_BYTES} bytes can be guessed; '
            f"make one with: head -c 32 /dev/urandom > {path}"
        )
    return salt


def make_pseudonyms(names: Iterable[str], salt: bytes | None = None) -> dict[str, str]:
    """Pseudonyms by name, the same as `pseudonymise` gives with this ``salt``."""
    key = _make_key(salt)
    return {name: "p" + _compute_digest(key, "person", name)[:_DIGITS] for name in names}


def make_file_aliases(files: Iterable[str], salt: bytes) -> dict[str, str]:
    """Names of files by the aliases that `pseudonymise` gives them with this ``salt``."""
    return {_make_alias(file, lambda kind, text: _compute_digest(salt, kind, text)): file for file in files}


def _make_key(salt: bytes | None) -> bytes:
    if salt is not None and len(salt) < MIN_SALT_BYTES:
        raise NergError(f"the salt has {len(salt)} bytes and can be guessed; use at least {MIN_SALT_BYTES}")
    return secrets.token_bytes(32) if salt is None else salt


def _compute_digest(key: bytes, kind: str, text: str) -> str:
    return hmac.new(key, f"{kind}:{text}".encode("utf-8", "surrogatepass"), hashlib.sha256).hexdigest()


def pseudonymise(rays: Rays, salt: bytes | None = None, *, is_salt_stored: bool = True) -> Rays:
    """Replace the name of each participant by a pseudonym (``p`` and 16 hexadecimal digits).

    Rays are sorted by pseudonym, since their former order would reveal that of the names. In the metadata, files get
    aliases (``f``, digits and the suffix) and HMACs instead of checksums, and names of participants are replaced
    wherever they occur, also within words. Cohorts, times, origins, directions and hit points are not changed.

    Parameters
    ----------
    salt
        At least `MIN_SALT_BYTES` bytes; equal salts give equal pseudonyms. Default: a random salt, which is discarded.
    is_salt_stored
        False for a random ``salt`` that the caller discards.
    """
    key = _make_key(salt)
    digest = lambda kind, text: _compute_digest(key, kind, text)
    person = lambda name: "p" + digest("person", name)[:_DIGITS]
    names = [person(name) for name in rays.persons]
    order = sorted(range(len(names)), key=lambda i: names[i])
    rank = np.empty(len(names), np.int32)
    rank[order] = np.arange(len(names))
    code = rank[rays.person]
    metadata = _replace_names(rays.metadata, rays.persons, person, digest)
    metadata["pseudonyms"] = "HMAC-SHA256, " + (
        "salt of a file" if salt is not None and is_salt_stored else "random salt, not kept"
    )
    rows = np.argsort(code, kind="stable")
    return replace(rays, person=code, persons=tuple(names[i] for i in order), metadata=metadata).select(rows)


def _replace_names(metadata: dict, persons: tuple[str, ...], person: Callable, digest: Callable) -> dict:
    files = {s["file"]: _make_alias(s["file"], digest) for s in metadata.get("sources", [])}
    files |= {d["file"]: _make_alias(d["file"], digest) for d in metadata.get("dropped", []) if d.get("file")}
    replacements = {name: person(name) for name in persons} | files
    # Longest first: "anna" is a part of "anna2".
    parts = sorted((name for name in (*files, *persons) if len(name) >= _MIN_NAME_LENGTH), key=len, reverse=True)
    pattern = re.compile("|".join(map(re.escape, parts)), re.IGNORECASE) if parts else None
    folded = {name.lower(): replacements[name] for name in parts}

    def clean(value: object) -> object:
        if isinstance(value, dict):
            return {replacements.get(k, k): clean(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [clean(v) for v in value]
        if not isinstance(value, str):
            return value
        if value in replacements:
            return replacements[value]
        # Some letters match case-insensitively, but differ in lower case.
        replace_match = lambda match: folded.get(match.group().lower()) or person(match.group())
        return pattern.sub(replace_match, value) if pattern else value

    unchanged = {k: metadata[k] for k in _PLAIN_KEYS if k in metadata}
    out = {k: clean(v) for k, v in metadata.items() if k not in (*_PLAIN_KEYS, "sources", "dropped", "steps")}
    if "tracking_by_person" in metadata:
        kinds = metadata["tracking_by_person"]
        out["tracking_by_person"] = {person(name): kinds[name] for name in persons if name in kinds}
    if "sources" in metadata:
        sources = [
            {"file": files[s["file"]], **({"hmac_sha256": digest("bytes", s["sha256"])} if "sha256" in s else {})}
            for s in metadata["sources"]
        ]
        out["sources"] = sorted(sources, key=lambda s: s["file"])
    if "dropped" in metadata:
        dropped = [{**d, "file": files.get(d.get("file", ""), "")} for d in metadata["dropped"]]
        out["dropped"] = sorted(dropped, key=lambda d: (d["reason"], d["file"]))
    if "steps" in metadata:
        # The names of a step and of its settings are defined by this package.
        out["steps"] = [{k: v if k == "step" else clean(v) for k, v in step.items()} for step in metadata["steps"]]
    return {**unchanged, **out}


# Keys whose values this package writes; they may contain a participant's name by chance.
_PLAIN_KEYS = ("frame", "tracking", "source_frame", "transform", "rows_read", "preset", "tick", "degrees", "forward")


def _make_alias(file: str, digest: Callable) -> str:
    suffixes = "".join(s for s in Path(file).suffixes[-2:] if s.lower() in _FILE_SUFFIXES)
    return "f" + digest("file", file)[:_DIGITS] + suffixes


_FILE_SUFFIXES = (".csv", ".gz", ".parquet", ".txt", ".tsv", ".npz")
