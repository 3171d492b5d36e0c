"""What controls a march, and what it returns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr

from nerg_mi.maths.arrays import quotient
from nerg_mi.maths.types import Bool, Color, Float
from nerg_mi.transport.media.protocol import Medium

from .quadrature import absorbed_share

HITS_STOP = 1e-4
"""Transmittance at which the rasteriser of Gaussian splats stops (Kerbl et al. 2023)."""


@dataclass(frozen=True)
class MarchSettings:
    """Controls of a march; lengths in scene units. The defaults are those of the integrator ``nerg``."""

    # Length of a step.
    step: float
    # Steps are at least this share of the distance travelled (instant-ngp's cone stepping); 0: uniform steps.
    dt_gamma: float = 0.0
    # Transmittance below which what lies behind is left out.
    stop: float = 1e-7
    # Samples are gathered until they weigh this much, and share the last one's colour.
    color_cutoff: float = 1e-3
    # Name of the quadrature rule, one of `rules.RULES`.
    quadrature: str = "constant"
    # Steps in front of all matter are this many times longer; 1: one step length everywhere.
    coarse: float = 1.0
    # Whether the occupancy's finer form is made use of, where it has one.
    refined: bool = True
    # Longest step of a rule whose steps end at voxel boundaries, to which `step`, `dt_gamma`, `coarse` and the length
    # of the first step do not apply.
    cell_step: float = math.inf

    @property
    def opaque(self) -> float:
        """Optical depth at which marching stops."""
        return -math.log(self.stop) if self.stop > 0 else math.inf


def default_step(medium: Medium | None) -> float:
    """Step in scene units where none is asked for: the medium's own, or a 1024th of its diagonal. 1 without a
    medium, where nothing is marched."""
    if medium is None:
        return 1.0
    return medium.step or medium.length_scale / 1024


def default_growth(medium: Medium | None) -> float:
    """Growth of steps with distance (`MarchSettings.dt_gamma`) where none is asked for: what suits the medium."""
    return MarchSettings.dt_gamma if medium is None else medium.growth


def default_stop(medium: Medium | None) -> float:
    """`MarchSettings.stop` where none is asked for: of a medium of hits what its renderers and trainings stop at."""
    return MarchSettings.stop if medium is None or medium.hits is None else HITS_STOP


@dataclass
class MarchResult:
    """What a march gathered along each ray. Distances are in scene units, from the ray's start."""

    # Optical depth.
    tau: Float
    # Sum of the distances of absorption from `origin` on, weighted by what is absorbed: far from the ray's start, sums
    # of whole distances would lose their last digits.
    moment: Float
    # Distance at which transmittance crosses 1/2, or optical depth the one asked for; infinite where it does not.
    half: Float
    # Change of `half` with that optical depth. Carries no derivatives.
    half_slope: Float
    # Start of the step that crosses, and the optical depth there. They carry no derivatives.
    enter: Float
    enter_tau: Float
    # Sum of colours, weighted by what is absorbed; None when no colour was asked for.
    color: Color | None = None
    # Evaluations made; None unless counted.
    density_evals: Float | None = None
    color_evals: Float | None = None
    # Where the march ended early, because what was asked of it (``occlusion``) is known; None: nowhere.
    known: Bool | None = None
    # Distance at which the march began.
    origin: Float = 0

    def count_in(self, other: MarchResult) -> None:
        """Add the density evaluations of another march to this one's, if they are counted."""
        if self.density_evals is not None:
            self.density_evals = self.density_evals + other.density_evals

    @property
    def opacity(self) -> Float:
        """1 - transmittance."""
        return absorbed_share(self.tau)

    @property
    def expected_depth(self) -> Float:
        """Mean distance of absorption, 0 where nothing absorbs."""
        alpha = self.opacity
        some = alpha > 0
        return dr.select(some, self.origin + quotient(self.moment, dr.select(some, alpha, 1)), 0)
