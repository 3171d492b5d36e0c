"""How an observer's rays are traced, and what they decide."""

from __future__ import annotations

from dataclasses import dataclass

from nerg_mi.transport.march.settings import MarchSettings

VISIBILITIES = ("depth", "transmittance", "map")

DIRECTIONS = 1 << 17
"""Of an integral over an observer's sphere at most: enough for a thousandth at depths that jump from surface to
surface."""


@dataclass(frozen=True, kw_only=True)
class ObserverSettings:
    """Settings of everything that is traced from an observer; lengths in scene units."""

    # Of the rays through a medium.
    march: MarchSettings
    # Kind of the depth at which a ray meets its surface (``march.depth.KINDS``).
    depth: str = "median"
    # Opacity from which on a ray meets a surface.
    surface_opacity: float = 0.5
    # One of ``VISIBILITIES``: what decides whether a point is hidden.
    visibility: str = "depth"
    # How far apart two ideas of one surface may be; 0 for two steps (without a medium, for a share of the scene).
    tolerance: float = 0.0
    # Rows of a map; it has twice as many columns.
    map_height: int = 512
    # Directions, at most, of the integral that a normalised gaze field is divided by.
    directions: int = DIRECTIONS
    # Error of that integral, as a share of it, below which fewer will do; 0: always as many.
    integral_tolerance: float = 5e-3

    @property
    def surfaces(self) -> tuple:
        """What decides where a ray meets a surface."""
        return self.march, self.depth, self.surface_opacity
