"""Several pictures of the same rays, and the one that an integrator makes of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol


class Layers(Protocol):
    """What is rendered in place of a scene's integrator: several pictures of the same rays, each with AOVs of its
    own."""

    names: list[list[str]]
    """Names of the AOVs' channels of each picture."""

    count: int
    """Channels of AOVs that a picture with all of them would have: they are added up as there."""

    def sample(self, scene, sampler, ray, medium, active) -> Iterable[tuple]:
        """Of each picture, one after the other, ``(radiance, valid, aovs)`` as the ``sample`` of an integrator gives
        them."""
        ...


class OwnLayer:
    """The picture of an integrator, as the one layer."""

    def __init__(self, integrator):
        self.names, self._integrator = [integrator.aov_names()], integrator
        self.count = len(self.names[0])

    def sample(self, scene, sampler, ray, medium, active) -> Iterable[tuple]:
        return [self._integrator.sample(scene, sampler, ray, medium, active)]
