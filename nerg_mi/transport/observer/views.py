"""What else there is to know of an observer than what they see: protocol, and how much training data is near them."""

from __future__ import annotations

from typing import Protocol

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Float, Point3f, Vector3f
from nerg_mi.transport.freezing import recording

from .cache import ObserverCache
from .viewpoint import select_nearest


class ObservedView(Protocol):
    """A view of one observer."""

    def value(self, r_o: Vector3f) -> Float:
        """What it is along unit scene directions ``r_o``, without derivatives."""
        ...


class ObserverView(Protocol):
    """Something that is known of every observer, once their position is; it never changes itself."""

    @property
    def occluded(self) -> bool:
        """Whether what the observer cannot see has a value of 0."""
        ...

    def at(self, p_o: Point3f) -> ObservedView:
        """The view of the observer at ``p_o`` (in the scene, one lane)."""
        ...


def view_along(
    view: ObserverView, observers: list[Point3f], p_o: Point3f, r_o: Vector3f, cache: ObserverCache
) -> Float:
    """``view`` along ``r_o`` of that one of ``observers`` (one lane each) who is nearest to ``p_o``, lane by
    lane. Raises ``NergError`` in a function that is being frozen, where the observers' positions cannot be read."""
    if recording():
        raise NergError(
            '"support" and "kde" depend on where the observer is, which a frozen function does not know while it is '
            'recorded: leave them out of "aovs"'
        )
    known = cache.of_each(view, observers, (), view.at)
    return select_nearest(known, p_o, lambda value: value.value(r_o))


class SupportView:
    """How many training rays started around an observer (``fields.gaze_base``): one number each."""

    occluded = False

    def __init__(self, support: RaySupport, to_world: Similarity | None = None):
        self.support, self.to_world = support, to_world or Similarity()

    def at(self, p_o: Point3f) -> ObservedSupport:
        """The support of the observer at ``p_o``."""
        with dr.suspend_grad():
            total = self.support.at(self.to_world.point_to_local(p_o))
            dr.eval(total)
        return ObservedSupport(total)


class ObservedSupport:
    """The support of one observer: ``total`` (one lane)."""

    def __init__(self, total: Float):
        self.total = total

    def value(self, r_o: Vector3f) -> Float:
        """The number; ``r_o`` makes no difference."""
        return self.total
