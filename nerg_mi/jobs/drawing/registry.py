"""The kinds of figures. One more is a `Kind` in the list of its file."""

from __future__ import annotations

from nerg_mi.errors import NergError

from .file_kinds import FILE_KINDS
from .kind import Kind
from .scene_kinds import SCENE_KINDS

KINDS: dict[str, Kind] = {kind.name: kind for kind in (*SCENE_KINDS, *FILE_KINDS)}


def find_kind(name: str) -> Kind:
    """The kind ``name``. Raises `NergError` for one that is not known."""
    if name not in KINDS:
        raise NergError(f'there is no figure "{name}"; there are {", ".join(KINDS)}')
    return KINDS[name]
