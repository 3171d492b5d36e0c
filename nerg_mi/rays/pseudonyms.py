"""Names of people replaced by pseudonyms: HMAC-SHA256 of the name under a salt.

Whoever has the salt can tell which pseudonym is that of a name that they know or guess; without it nobody can, by the
pseudonyms. Where people stood and what they looked at is as it was, and can tell who they are by itself.
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

SALT_BYTES = 16  # A salt has at least so many bytes: fewer can be tried out one after the other
_MOST_SALT = 1 << 20
# Hexadecimal digits of a pseudonym: 64 bits, of which no two people share one.
_DIGITS = 16
# Names of fewer characters are parts of too many words to be looked for in them.
_WORD = 3


def read_salt(path: str | os.PathLike) -> bytes:
    """The bytes of the file ``path`` as a salt. Raises `NergError` for one that is missing, or too short to be one."""
    salt = read_bytes(path, "salt", _MOST_SALT)
    if len(salt) < SALT_BYTES:
        raise NergError(
            f'the salt "{path}" has {len(salt)} bytes, and fewer than {SALT_BYTES} can be guessed; '
            f"make one with: head -c 32 /dev/urandom > {path}"
        )
    return salt


def make_pseudonyms(names: Iterable[str], salt: bytes | None = None) -> dict[str, str]:
    """A pseudonym for each of ``names`` of people: what `pseudonymise` gives them for the same salt."""
    key = _key(salt)
    return {name: "p" + _digest(key, "person", name)[:_DIGITS] for name in names}


def _key(salt: bytes | None) -> bytes:
    if salt is not None and len(salt) < SALT_BYTES:
        raise NergError(f"a salt of {len(salt)} bytes can be guessed; give at least {SALT_BYTES}")
    return secrets.token_bytes(32) if salt is None else salt


def _digest(key: bytes, kind: str, text: str) -> str:
    return hmac.new(key, f"{kind}:{text}".encode("utf-8", "surrogatepass"), hashlib.sha256).hexdigest()


def pseudonymise(rays: Rays, salt: bytes | None = None) -> Rays:
    """``rays`` with a pseudonym (``p`` and 16 hexadecimal digits) for each person.

    ``salt``: at least `SALT_BYTES` bytes; rays that were given the same have the same pseudonym for the same name.
    Default: a random one, which nobody keeps. Rays are put into the order of the pseudonyms, since that of the names
    can be guessed. In the metadata, files have names that are made alike (``f`` and digits, endings kept) and HMACs in
    place of their checksums, and names of people are replaced wherever they stand, also as parts of other words.
    Cohorts, times, origins, directions and hit points are left as they are.
    """
    key = _key(salt)
    digest = lambda kind, text: _digest(key, kind, text)
    person = lambda name: "p" + digest("person", name)[:_DIGITS]
    names = [person(name) for name in rays.persons]
    order = sorted(range(len(names)), key=lambda i: names[i])
    place = np.empty(len(names), np.int32)
    place[order] = np.arange(len(names))
    code = place[rays.person]
    metadata = _without_names(rays.metadata, rays.persons, person, digest)
    metadata["pseudonyms"] = "HMAC-SHA256, " + ("random salt, not kept" if salt is None else "salt of a file")
    rows = np.argsort(code, kind="stable")
    return replace(rays, person=code, persons=tuple(names[i] for i in order), metadata=metadata).select(rows)


def _without_names(metadata: dict, persons: tuple[str, ...], person: Callable, digest: Callable) -> dict:
    files = {s["file"]: _alias(s["file"], digest) for s in metadata.get("sources", [])}
    files |= {d["file"]: _alias(d["file"], digest) for d in metadata.get("dropped", []) if d.get("file")}
    whole = {name: person(name) for name in persons} | files
    # The longest first: "anna" is a part of "anna2".
    parts = sorted((name for name in (*files, *persons) if len(name) >= _WORD), key=len, reverse=True)
    pattern = re.compile("|".join(map(re.escape, parts)), re.IGNORECASE) if parts else None
    folded = {name.lower(): whole[name] for name in parts}

    def clean(value: object) -> object:
        if isinstance(value, dict):
            return {whole.get(k, k): clean(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [clean(v) for v in value]
        if not isinstance(value, str):
            return value
        if value in whole:
            return whole[value]
        # Some letters match without regard to case and are another letter in lower case.
        hidden = lambda found: folded.get(found.group().lower()) or person(found.group())
        return pattern.sub(hidden, value) if pattern else value

    kept = {k: metadata[k] for k in _PLAIN if k in metadata}
    out = {k: clean(v) for k, v in metadata.items() if k not in (*_PLAIN, "sources", "dropped", "steps")}
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
        # What a step is called, and which of its settings there are, are words of this package.
        out["steps"] = [{k: v if k == "step" else clean(v) for k, v in step.items()} for step in metadata["steps"]]
    return {**kept, **out}


# What this package writes itself, whose words may hold somebody's name by chance.
_PLAIN = ("frame", "source_frame", "transform", "rows_read", "preset", "tick", "degrees", "forward")


def _alias(file: str, digest: Callable) -> str:
    suffixes = "".join(s for s in Path(file).suffixes[-2:] if s.lower() in _ENDINGS)
    return "f" + digest("file", file)[:_DIGITS] + suffixes


_ENDINGS = (".csv", ".gz", ".parquet", ".txt", ".tsv", ".npz")
