"""What is known of observers: made once for each, and kept between frames.

An observer stays where they are for many pixels and often for many frames, and what they see all around (depths, a
map, the integral of a gaze field, the rays that started near them) costs more than a frame. All of it is kept here,
under one rule: it serves the same position to the bit, for as long as what it was made of is the same. That is told by
the identity of arrays (``fingerprint``), so that nothing has to be invalidated by whoever changes a parameter;
``forget`` is for changes that no array shows.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from nerg_mi.maths.types import Point3f
from nerg_mi.transport.fingerprint import Fingerprint, of_shapes
from nerg_mi.transport.freezing import recording
from nerg_mi.transport.place import Place


@dataclass(frozen=True)
class Known:
    """``value``: what was made for the observer at ``center`` (one lane, without derivatives)."""

    center: Point3f
    value: Any


# Observers whose numbers are kept.
_MANY = 256
_Position = tuple[float, float, float]


@dataclass(frozen=True)
class _Kept:
    """What is known of a thing, by observers' positions, the last asked for at the end."""

    made_of: Any
    known: dict[_Position, Known]


class ObserverCache:
    """The cache of one integrator, or of whoever evaluates gaze for several observers in turn.

    Of each thing the entries of those observers are kept who were asked for last; of numbers those of many more, in
    ``numbers`` where that is given: a cache that outlives this one.
    """

    def __init__(self, numbers: ObserverCache | None = None) -> None:
        self._kept: dict[Hashable, _Kept] = {}
        self._numbers = numbers or self

    def of_each(
        self, thing: Hashable, observers: list[Point3f], made_of: Any, make: Callable[[Point3f], Any]
    ) -> list[Known]:
        """For each of ``observers`` (one lane each) what ``make(center)`` makes, or made before.

        ``thing``: what it is and whose. ``made_of``: what it depends on besides the position, comparable with ``==``
        (settings, a ``Fingerprint``). While a function is being recorded by ``dr.freeze`` nothing is looked up, and
        nothing that is made is kept: it belongs to the recording.
        """
        known = [Known(_detached(p_o), None) for p_o in observers]
        return self.of_known(thing, known, made_of, lambda k: make(k.center))

    def of_known(self, thing: Hashable, known: list[Known], made_of: Any, make: Callable[[Known], Any]) -> list[Known]:
        """For each of ``known`` what ``make`` makes of it, or made before; otherwise as ``of_each``."""
        return self._of_known(thing, known, made_of, make, 0)

    def of_numbers(
        self, thing: Hashable, known: list[Known], made_of: Any, make: Callable[[Known], Any]
    ) -> list[Known]:
        """``of_known`` of what is a few numbers for each observer, so that those of 256 who are asked for no more are
        kept, too."""
        return self._numbers._of_known(thing, known, made_of, make, _MANY)

    def _of_known(
        self, thing: Hashable, known: list[Known], made_of: Any, make: Callable[[Known], Any], others: int
    ) -> list[Known]:
        if recording():
            return [Known(k.center, make(k)) for k in known]
        kept = self._kept.get(thing)
        before = kept.known if kept is not None and kept.made_of == made_of else {}
        asked: dict[_Position, Known] = {}
        out = []
        for k in known:
            # Read one by one: an array of the three would take a kernel of its own.
            position = k.center.x[0], k.center.y[0], k.center.z[0]
            if position not in asked:
                asked[position] = before[position] if position in before else Known(k.center, make(k))
            out.append(asked[position])
        rest = [(position, k) for position, k in before.items() if position not in asked]
        self._kept[thing] = _Kept(made_of, dict(rest[-others:] if others else []) | asked)
        return out

    def peek(self, thing: Hashable) -> list[Known]:
        """What is kept of ``thing``, without making any."""
        kept = self._kept.get(thing)
        return [] if kept is None else list(kept.known.values())

    def forget(self) -> None:
        """Drop everything: something has changed that no array shows."""
        self._kept.clear()


def fingerprint_of(place: Place) -> tuple[Fingerprint, Fingerprint]:
    """Of all that rays meet in ``place``: its shapes and its medium's arrays."""
    values = [] if place.medium is None else [v for v in place.medium.parameters() if dr.is_array_v(v)]
    return of_shapes(place), Fingerprint(values)


def _detached(p_o: Point3f) -> Point3f:
    center = type(p_o)(dr.detach(p_o))
    # A position that is a constant of the kernel would be compiled anew for every observer.
    dr.make_opaque(center)
    return center
