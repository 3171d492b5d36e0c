"""Options of jobs, given one by one in a call."""

from __future__ import annotations

import difflib
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from nerg_mi.errors import NergError

from .arrays import listed
from .variant import active_mitsuba

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options", bound="DataclassInstance")


def options_of(kind: type[Options], job: str, given: Options | None, changes: dict[str, Any]) -> Options:
    """An object of the dataclass ``kind``: ``given`` (or the defaults) with ``changes``, for the variant in use. Files
    may be named by strings.

    Raises `NergError` for an option that the ``job`` has not, naming those that it has.
    """
    types = {f.name: str(f.type) for f in fields(kind)}
    known = [name for name in types if name != "mode"]
    for name in changes:
        if name == "mode":
            raise NergError(f"{job} works in the variant that is set; call mi.set_variant({changes[name]!r}) before it")
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            meant = f'did you mean "{near[0]}"?' if near else f"it has {listed(known)}"
            raise NergError(f'{job} has no option "{name}"; {meant}')
    changes = {k: Path(v) if isinstance(v, str) and "Path" in types[k] else v for k, v in changes.items()}
    if "mode" in types:
        changes["mode"] = active_mitsuba().variant()
    return replace(kind() if given is None else given, **changes)
