"""The kinds of figures. One more is one more module, and its name here."""

from __future__ import annotations

from nerg_mi.errors import NergError

from . import difference, floor, sheet, sphere, surface, triptych
from .kind import Kind

KINDS: dict[str, Kind] = {kind.KIND.name: kind.KIND for kind in (sphere, triptych, floor, sheet, difference, surface)}


def find_kind(name: str) -> Kind:
    """The kind ``name``. Raises `NergError` for one that is not known."""
    if name not in KINDS:
        raise NergError(f'there is no figure "{name}"; there are {", ".join(KINDS)}')
    return KINDS[name]
