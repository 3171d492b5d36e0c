"""What a picture of gaze rests on: how many rays, of how many people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_MOST = 1 << 60


@dataclass(frozen=True)
class Basis:
    """``rays`` of ``people`` (None: not known), and ``images`` of salience, that a gaze field learnt from, or of which
    a density is made."""

    rays: int
    people: int | None = None
    images: int = 0

    def words(self) -> str:
        """All of it in words, such as "81,751 rays of 80 people"; "" for nothing."""
        rays = _count(self.rays, "ray", "rays")
        if rays and self.people:
            rays += " of " + _count(self.people, "person", "people")
        return " and ".join(filter(None, [rays, _count(self.images, "salience image", "salience images")]))


def basis_of(provenance: Mapping[str, Any]) -> Basis | None:
    """That of a checkpoint's ``provenance``; None where it does not tell, as other programs' checkpoints do not."""
    rays, people, images = (_number(provenance.get(name)) for name in ("rays", "people", "salience_views"))
    return Basis(rays or 0, people or None, images or 0) if rays or images else None


def _number(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _MOST else None


def _count(number: int, one: str, several: str) -> str:
    return f"{number:,} {one if number == 1 else several}" if number else ""
