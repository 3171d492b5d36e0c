"""Names of output files that are valid and different on all operating systems."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

_RESERVED = re.compile(r'[<>:"/\\|?*\x00-\x1f\x7f]')
# Devices of Windows, with any suffix.
_DEVICES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³])(?=\.|$)", re.IGNORECASE)
_MAX_BYTES = 200  # of a name; file systems permit 255, with a suffix


def make_portable_name(name: str) -> str:
    """A file name from any text: reserved characters become underscores, as do dots and spaces at its end, and names of
    devices (CON, NUL, COM1) begin with one."""
    name = _RESERVED.sub("_", unicodedata.normalize("NFC", name))
    name = name.encode("utf-8", "replace")[:_MAX_BYTES].decode("utf-8", "ignore")
    name = re.sub(r"[. ]+$", lambda end: "_" * len(end[0]), name) or "_"
    return f"_{name}" if _DEVICES.match(name) else name


def make_portable_names(names: Iterable[str]) -> list[str]:
    """As `make_portable_name`, with numbers where names are equal but for their case."""
    taken: set[str] = set()
    out = []
    for name in map(make_portable_name, names):
        unique, number = name, 1
        while unique.casefold() in taken:
            number += 1
            unique = f"{name}-{number}"
        taken.add(unique.casefold())
        out.append(unique)
    return out
