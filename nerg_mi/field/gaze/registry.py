"""The kinds of gaze fields by the names that checkpoints give them."""

from __future__ import annotations

from typing import TypeVar

from nerg_mi.errors import plain
from nerg_mi.maths.geometry import AnyBox

from .protocol import AnyGazeField, Arrays

Kind = TypeVar("Kind", bound=type[AnyGazeField])

_KINDS: dict[str, type[AnyGazeField]] = {}


def register(cls: Kind) -> Kind:
    """Have checkpoints of the kind ``cls.kind`` read by the class ``cls`` (a decorator)."""
    _KINDS[cls.kind] = cls
    return cls


def kinds() -> tuple[str, ...]:
    """The names that are registered."""
    return tuple(_KINDS)


def build(about: dict, box: AnyBox, arrays: Arrays) -> AnyGazeField:
    """The gaze field that a checkpoint describes by ``about``, of its ``arrays``. Raises ``ValueError`` for a kind that
    is not registered."""
    # Checkpoints of the first version name no kind: there was one.
    kind = about.get("kind", "product")
    if kind not in _KINDS:
        raise ValueError(f'it is a gaze field of the kind "{plain(kind, 40)}", which this version does not know')
    return _KINDS[kind].from_arrays(about, box, arrays)
