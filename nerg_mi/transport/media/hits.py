"""Media of things that are met one by one, each of which absorbs its share of light at one point of the ray.

Gaussian splats are such: what a step is to a density, a hit is to them. They are not sampled, so that nothing of a
march applies but where it ends; all else (opacity, every kind of depth, occlusion, colour) is the same sum over other
terms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from nerg_mi.maths.types import Bool, Float, UInt32

from .local_ray import LocalRay


@dataclass
class LastHit:
    """Up to where hits are known: the distance, in scene units, and the index of the last one there."""

    t: Float
    index: UInt32


@dataclass
class NextHits:
    """Hits in their order: by distance, and by index where that is the same. Distances are infinite where there are no
    more."""

    # Distance in scene units.
    t: list[Float]
    # Share of the light that is absorbed there, less than 1.
    absorbed: list[Float]
    # Which thing it is.
    index: list[UInt32]
    # Things that were looked at.
    evals: Float


class Hits(Protocol):
    """What rays meet of a medium, in groups of ``at_once``."""

    @property
    def at_once(self) -> int:
        """How many are returned at once."""
        ...

    def nearest(
        self, ray: LocalRay, after: LastHit, before: Float, transmittance: Float, stop: Float, active: Bool
    ) -> NextHits:
        """The next hits behind ``after`` and nearer than the distance ``before``; ``at_once`` of them, or all, or as
        many as let no more than ``stop`` of the light through, of which ``transmittance`` arrives. Without
        derivatives."""
        ...

    def again(self, ray: LocalRay, index: UInt32, active: Bool) -> tuple[Float, Float]:
        """``(t, absorbed)`` of the thing ``index``, attached to the ray and to the medium's parameters."""
        ...
