"""Dr.Jit's side of rendering: fingerprints of scenes and fields, and frozen functions."""

from __future__ import annotations

import gc
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Fingerprint ----
#
# Whether arrays are still those that something was made of: told by identity, without reading them.


class Fingerprint(list):
    """Of ``values`` (Dr.Jit arrays, or anything that holds some): equal as long as these are.

    Copies are held, so that no later variable can take the place of one: the objects that ``mi.traverse`` gives are
    assigned to, and hold other variables then."""

    def __init__(self, values: Iterable[Any]):
        held = [dr.copy(v) for v in values]
        super().__init__(i for v in held for i in dr.detail.collect_indices(v))
        self._held = held


class HasShapes(Protocol):
    """A ``geometry.Place``, of which only the shapes count here."""

    scene: mi.Scene | None


def of_shapes(place: HasShapes) -> Fingerprint:
    """Of all shapes of ``place``, those that instances repeat among them; of a place without any, that of nothing."""
    import mitsuba as mi

    if place.scene is None:
        return Fingerprint([])
    shapes = [*place.scene.shapes(), *_groups(mi, place.scene)]
    return Fingerprint(v for shape in shapes for v in dict(mi.traverse(shape)).values())


def _groups(mi: Any, scene: Any) -> list[Any]:
    """What instances repeat: no shapes of the scene itself."""
    found = []

    class GroupCollector(mi.TraversalCallback):
        def put(self, name, value, *rest):
            if isinstance(value, mi.Shape) and value.class_name().startswith("ShapeGroup"):
                found.append(value)

    if any(shape.class_name() == "Instance" for shape in scene.shapes()):
        scene.traverse(GroupCollector())
    return found


# ---- Freezing ----
#
# What to mind while ``dr.freeze`` records a function: it will be replayed with other values, and nothing is decided by
# them.


def recording() -> bool:
    """Whether a frozen function is being recorded: values cannot be read then."""
    return dr.flag(dr.JitFlag.FreezingScope)


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep Python's garbage while a function is recorded: Dr.Jit 1.5 ends the process where an array that lies in
    NumPy's memory is freed."""
    paused = recording() and gc.isenabled()
    if paused:
        gc.disable()
    try:
        yield
    finally:
        if paused:
            if gc.get_freeze_count() == 0:
                # Counts as if everything had just been looked at; otherwise the next object made would collect it all.
                gc.freeze()
                gc.unfreeze()
            gc.enable()
