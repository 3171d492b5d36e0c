"""Dr.Jit utilities of rendering: fingerprints of arrays, and frozen functions."""

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
# Whether arrays are unchanged, compared by identity and without reading them.


class Fingerprint(list):
    """Fingerprint of ``values`` (Dr.Jit arrays, or objects that contain some): equal as long as these are the same.

    Holds copies, so that a later variable cannot reuse an index: objects from ``mi.traverse`` are assigned to, and then
    hold other variables.
    """

    def __init__(self, values: Iterable[Any]):
        held = [dr.copy(v) for v in values]
        super().__init__(i for v in held for i in dr.detail.collect_indices(v))
        self._held = held


class HasShapes(Protocol):
    """The part of a `geometry.SceneGeometry` that matters here: its shapes."""

    scene: mi.Scene | None


def fingerprint_shapes(geometry: HasShapes) -> Fingerprint:
    """Fingerprint of all shapes of ``geometry``, including instanced ones; empty without shapes."""
    import mitsuba as mi

    if geometry.scene is None:
        return Fingerprint([])
    shapes = [*geometry.scene.shapes(), *_groups(mi, geometry.scene)]
    return Fingerprint(v for shape in shapes for v in dict(mi.traverse(shape)).values())


def _groups(mi: Any, scene: Any) -> list[Any]:
    """Shape groups of instances, which are not among the scene's shapes."""
    groups = []

    class GroupCollector(mi.TraversalCallback):
        def put(self, name, value, *rest):
            if isinstance(value, mi.Shape) and value.class_name().startswith("ShapeGroup"):
                groups.append(value)

    if any(shape.class_name() == "Instance" for shape in scene.shapes()):
        scene.traverse(GroupCollector())
    return groups


# ---- Freezing ----
#
# While ``dr.freeze`` records a function, values cannot be read: the function is replayed with other values.


def is_recording() -> bool:
    """Whether ``dr.freeze`` is recording a function, so that values cannot be read."""
    return dr.flag(dr.JitFlag.FreezingScope)


@contextmanager
def gc_paused() -> Iterator[None]:
    """Pause garbage collection while a function is recorded: Dr.Jit 1.5 aborts the process if an array in NumPy memory
    is freed."""
    paused = is_recording() and gc.isenabled()
    if paused:
        gc.disable()
    try:
        yield
    finally:
        if paused:
            if gc.get_freeze_count() == 0:
                # Moves all objects to the oldest generation; otherwise the next allocation would start a full
                # collection.
                gc.freeze()
                gc.unfreeze()
            gc.enable()
