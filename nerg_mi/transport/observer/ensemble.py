"""An ensemble of gaze fields, and how much data there is around an observer, as the integrator sees them."""

from __future__ import annotations

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.field.gaze.ensemble import GazeEnsemble
from nerg_mi.field.gaze.support import RaySupport
from nerg_mi.maths.similarity import Similarity
from nerg_mi.transport.freezing import recording
from nerg_mi.transport.observer.gaze_medium import GazeMedium, at_nearest


class EnsembleMedium:
    """An ensemble placed in the scene: in place of a ``GazeMedium``, whose results it averages over its members."""

    def __init__(self, field: GazeEnsemble, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()
        self.members = [GazeMedium(member, self.to_world) for member in field.members]

    @property
    def networks(self) -> int:
        """Networks that one evaluation of gaze evaluates."""
        return sum(m.networks for m in self.members)

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return [v for m in self.members for v in m.parameters()]

    def face(self, observers: list, *place) -> None:
        """``GazeMedium.face`` of every member; depths around an observer are traced once for all of them."""
        first, *others = self.members
        first.face(observers, *place)
        for member in others if self.field.config.normalized else ():
            member.face(observers, *place, like=first)

    def known(self) -> list:
        """``GazeMedium.known`` of every member."""
        return [m.known() for m in self.members]

    def recall(self, known: list) -> None:
        """``GazeMedium.recall`` of every member."""
        for member, own in zip(self.members, known):
            member.recall(own)

    def evaluate(self, p_od, p_o, r_o, active, semantic=None, escaped=False):
        """Means of the members' ``(gaze, emit, capture)``; that of the product is not the product of the means."""
        return self.spread(p_od, p_o, r_o, active, semantic, escaped)[:3]

    def spread(self, p_od, p_o, r_o, active, semantic=None, escaped=False):
        """``evaluate``, and the standard deviation of the members' gaze (1/sr, of N - 1 degrees of freedom)."""
        found = [m.evaluate(p_od, p_o, r_o, active, semantic, escaped) for m in self.members]
        gaze, emit, capture = (sum(parts[1:], parts[0]) / len(found) for parts in zip(*found))
        variance = sum(dr.square(g - gaze) for g, _, _ in found) / (len(found) - 1)
        # Where members agree, the root's derivative would not be finite.
        apart = variance > 1e-30
        return gaze, emit, capture, dr.select(apart, dr.sqrt(dr.select(apart, variance, 1)), 0)


class SupportView:
    """``support`` around observers in the scene: one sum an observer, kept until the observer changes."""

    occluded = False

    def __init__(self, support: RaySupport, to_world: Similarity | None = None):
        self.support, self.to_world, self._known = support, to_world or Similarity(), []

    def face(self, observers: list) -> None:
        """Sum for each of ``observers`` (Point3f of one lane)."""
        self._known = keep_or_make(self._known, observers, lambda p_o: _Sum(self.support, self.to_world, p_o))

    def value(self, p_o, r_o):
        """Support of the observer that is faced nearest to ``p_o``, lane by lane; ``r_o`` makes no difference."""
        return at_nearest(self._known, p_o, lambda known: known.total)


class _Sum:
    def __init__(self, support, to_world, p_o):
        with dr.suspend_grad():
            self.center = type(p_o)(dr.detach(p_o))
            self.total = support.at(to_world.point_to_local(self.center))
            dr.eval(self.center, self.total)


def keep_or_make(known: list, observers: list, make) -> list:
    """For each of ``observers`` the one of ``known`` with that ``center``, or what ``make`` makes.

    Raises ``NergError`` in a function that is being frozen, where the observers' positions cannot be read."""
    if recording():
        raise NergError(
            '"support" and "kde" depend on where the observer is, which a frozen function does not know while it is recorded: '
            'leave them out of "aovs"'
        )
    same = lambda k, p_o: bool(dr.all(k.center == dr.detach(p_o), axis=None))
    return [next((k for k in known if same(k, p_o)), None) or make(p_o) for p_o in observers]
