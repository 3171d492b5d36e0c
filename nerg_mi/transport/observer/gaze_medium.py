"""A gaze field placed in the scene, and faced with the observers that it is evaluated for."""

from __future__ import annotations

import drjit as dr

from nerg_mi.maths.similarity import Similarity
from nerg_mi.transport.freezing import recording


class GazeMedium:
    """A gaze field placed in the scene. Densities over directions do not change with scale.

    A normalised field must ``face`` an observer before it is evaluated for one.
    """

    def __init__(self, field, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()
        self._integrals, self._recorded = [], False

    @property
    def networks(self) -> int:
        """Networks that one evaluation of gaze evaluates: emit's, capture's, or both."""
        return 2 if self.field.config.variant == "emit_capture" else 1

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return list(self.field.parameters().values())

    def face(
        self, observers: list, place, settings, kind: str, surface_opacity: float, like: GazeMedium | None = None
    ) -> None:
        """Integrate a normalised field over the spheres of ``observers`` (Point3f, one lane each) in ``place``; of
        another one nothing needs to be known.

        ``settings``, ``kind``, ``surface_opacity``: of the observers' rays. Kept for as long as neither of them
        changes.
        ``like``: a medium of the same box, place and kind of field that faces the same observers, whose depths will do.
        """
        from nerg_mi.transport.observer.integral import GazeIntegral

        if not self.field.config.normalized:
            return
        how = place, settings, kind, surface_opacity
        # What was made while a function was recorded is the recording's.
        known = [] if recording() or self._recorded else self._integrals
        self._recorded = recording()
        depths = [None] * len(observers) if like is None else like._integrals
        self._integrals = [
            next((k for k in known if k.serves(p_o, *how)), None)
            or GazeIntegral(self, place, p_o, *how[1:], depths=traced)
            for p_o, traced in zip(observers, depths)
        ]

    def known(self) -> list:
        """Of the observers that are faced, the integrals as numbers, for ``recall``: without the directions that they
        are over."""
        from nerg_mi.transport.observer.integral import KnownIntegral

        return [KnownIntegral(k.center, k.value()) for k in self._integrals]

    def recall(self, known: list) -> None:
        """Face the observers of ``known`` again. Only for as long as neither the field nor its place has changed."""
        self._integrals = list(known)

    def unnormalized(self, p_od, p_o, r_o, active, escaped=False):
        """``(emit, capture)`` of a normalised field, whose product is what is integrated."""
        local = self.to_world
        return self.field.unnormalized(
            local.point_to_local(p_od),
            local.point_to_local(p_o),
            local.direction_to_local(r_o),
            active,
            escaped=escaped,
        )

    def evaluate(self, p_od, p_o, r_o, active, semantic=None, escaped=False):
        """``(gaze, emit, capture)`` for scene points and the unit scene direction ``r_o``; ``semantic`` as the field
        wants it;
        ``escaped``: directions in which no surface is met."""
        local = self.to_world
        return self.field.evaluate(
            local.point_to_local(p_od),
            local.point_to_local(p_o),
            local.direction_to_local(r_o),
            active,
            semantic,
            self._integral(p_o),
            escaped,
        )

    def _integral(self, p_o):
        """Of the observer that is faced nearest to ``p_o``, lane by lane."""
        return at_nearest(self._integrals, p_o, lambda known: known.value()) if self._integrals else None


def at_nearest(known: list, p_o, of):
    """``of(k)`` of that one ``k`` of ``known``, each with a ``center``, which is nearest to ``p_o``, lane by lane."""
    best, apart = of(known[0]), None
    for k in known if len(known) > 1 else ():
        here = dr.detach(dr.squared_norm(p_o - k.center))
        best = best if apart is None else dr.select(here < apart, of(k), best)
        apart = here if apart is None else dr.minimum(here, apart)
    return best
