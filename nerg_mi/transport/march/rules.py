"""Quadrature rules: how samples of the density become a step's optical depth and its mean depth.

A rule is one object of the protocol ``Rule``, registered in ``RULES``: the integrator's parameter ``quadrature``, its
manual and the study offer whatever stands there. Another rule is a class like those below and one line
``RULES.register(...)``, here or in any module that is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.maths.arrays import quotient
from nerg_mi.maths.types import Bool, Color, Float
from nerg_mi.transport.media.cells import VoxelCells
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.painting import Painter
from nerg_mi.transport.media.protocol import Medium

from .quadrature import linear_crossing, linear_share, mean_depth_share
from .registry import Registry

# Where the two Gauss-Legendre samples of an interval lie, from its middle and as a share of its length.
_GAUSS = 0.5 / 3**0.5


@dataclass
class Step:
    """One evaluated step, ``delta`` long in scene units. Attached to whatever carries derivatives."""

    # Its optical depth, 0 on lanes that are not active.
    dtau: Float
    # Mean distance of absorption into it, as a share of `delta`.
    share: Float
    # Distance into it, in scene units, at which an optical depth (at most `dtau`) is reached.
    crossing: Callable[[Float], Float]
    # What a painter makes it contribute to the sum of colours, on the lanes of a mask.
    paint: Callable[[Painter, Bool], Color]
    # What the next step reuses: a PyTree like the one of `Rule.start`.
    carry: Any
    # Density evaluations made.
    evals: Float


class Rule(Protocol):
    """A quadrature rule. It holds no state: one object serves every march."""

    @property
    def name(self) -> str:
        """Value of the parameter ``quadrature`` that chooses it."""
        ...

    @property
    def summary(self) -> str:
        """What it does, in a sentence without its full stop: for the manual."""
        ...

    @property
    def in_cells(self) -> bool:
        """Whether steps end where the ray leaves a voxel, which asks for a medium with ``cells``. Otherwise they are
        as long as the settings say."""
        ...

    def start(self, Float: type) -> Any:
        """What the first step finds as its ``carry``: a PyTree of arrays of one lane, or None. ``Float``: array type
        of distances."""
        ...

    def step(
        self,
        medium: Medium,
        ray: LocalRay,
        t: Float,
        delta: Float,
        t_next: Float,
        carry: Any,
        active: Bool,
        colored: bool,
    ) -> Step:
        """Evaluate the step from the distance ``t`` on, ``delta`` long.

        ``t_next``: where it ends, detached; equal to the next step's ``t`` unless something is leapt over in between.
        ``carry``: that of the step before, or None, from which nothing is known: derivatives are found so, step by
        step. Densities and colours are to be attached to ``ray``, ``t``, ``delta`` and the medium. ``colored``:
        whether the step may be asked to ``paint``.
        """
        ...


RULES: Registry[Rule] = Registry("quadrature")


def boundaries(rule: Rule, medium: Medium) -> VoxelCells | None:
    """Where steps of ``rule`` end in ``medium``; None where they are as long as the settings say. Raises ``NergError``
    for a medium that has no voxels where the rule needs them."""
    if not rule.in_cells:
        return None
    if medium.cells is None:
        others = " or ".join(f'"{other.name}"' for other in RULES if not other.in_cells)
        raise NergError(f'the quadrature "{rule.name}" needs an axis-aligned "gridvolume" as density; use {others}')
    return medium.cells


def color_share(first: Float, last: Float, share: Float) -> Float:
    """Where a step of linear density takes its colour, as a share of its length.

    ``first``, ``last``: density at its ends; ``share``: mean distance of absorption, as a share of the length. At the
    mean absorption, ``share``, which is exact for a linear colour, where both ends are nearly as dense; at the
    denser end where one is nearly empty: in the air before a wall a trained field's colour means nothing. The square
    of the relative difference decides, so that colour stays of second order in the step.
    """
    r = (last - first) / dr.maximum(first + last, 1e-18)
    return dr.lerp(share, dr.select(r > 0, 1.0, 0.0), r * r)


def _step_along_line(
    medium: Medium,
    ray: LocalRay,
    t: Float,
    delta: Float,
    dtau: Float,
    first: Float,
    last: Float,
    carry: tuple | None,
    evaluations: Float,
) -> Step:
    """The step from ``t`` on, ``delta`` long and of optical depth ``dtau``, whose density runs in a line from ``first``
    to ``last``."""
    share = linear_share(first * delta, last * delta)

    def paint(painter, lit):
        p = ray.o + ray.d * dr.fma(delta, color_share(first, last, share), t)
        return painter.paint(medium, medium.density_features(p, lit)[1], p, ray.w, lit)

    return Step(dtau, share, lambda missing: linear_crossing(first, last, delta, missing), paint, carry, evaluations)


class Constant:
    """Density constant over a step: its value at the middle (Mildenhall et al. 2020, eq. 3)."""

    name = "constant"
    summary = "density is constant over a step, sampled at its middle"
    in_cells = False

    def start(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, colored) -> Step:
        p = ray.o + ray.d * (t + 0.5 * delta)
        sigma, features = medium.density_features(p, active) if colored else (medium.density(p, active), [])
        dtau = dr.select(active, sigma * delta, 0)

        def paint(painter, lit):
            return painter.paint(medium, features, p, ray.w, lit)

        return Step(
            dtau,
            mean_depth_share(dtau),
            lambda missing: delta * quotient(missing, dr.select(dtau > 0, dtau, 1)),
            paint,
            None,
            dr.select(active, 1.0, 0.0),
        )


class Linear:
    """Density linear over a step, between samples at its ends, which neighbours share (Uy et al. 2023, "NeRF
    Revisited: Fixing Quadrature Instability in Volume Rendering")."""

    name = "linear"
    summary = "linear between samples at the steps' ends"
    in_cells = False

    def start(self, Float):
        # Density at the end of the step before, and where that was (distances are not negative).
        return Float(0), Float(-1)

    def step(self, medium, ray, t, delta, t_next, carry, active, colored) -> Step:
        fresh = active if carry is None else active & (carry[1] != t)
        if carry is None:
            first = medium.density(ray.o + ray.d * t, active)
        else:
            # After a leap the step's start is no end of a step before.
            first = dr.if_stmt(
                (t,),
                fresh,
                lambda t: medium.density(ray.o + ray.d * t, fresh),
                lambda t: dr.zeros(type(t)),
                label="first end",
            )
            first = dr.select(fresh, first, carry[0])
        last = medium.density(ray.o + ray.d * (t + delta), active)
        dtau = dr.select(active, 0.5 * (first + last) * delta, 0)
        evaluations = dr.select(active, 1.0, 0.0) + dr.select(fresh, 1.0, 0.0)
        return _step_along_line(medium, ray, t, delta, dtau, first, last, (last, t_next), evaluations)


class Cells:
    """Steps inside one voxel of a grid, whose interpolant is a cubic along the ray that two Gauss-Legendre samples
    integrate exactly. Opacity is then exact, depth to a hundredth of a voxel: it takes the density between as the line
    through both samples."""

    name = "cells"
    summary = (
        "for an axis-aligned ``gridvolume`` as density, steps end at voxel boundaries only, where two samples "
        "integrate its interpolant exactly (opacity to rounding, depth to a hundredth of a voxel); a ``step`` that is "
        "given bounds them, ``dt_gamma``, ``coarse`` and ``jitter`` do not apply"
    )
    in_cells = True

    def start(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, colored) -> Step:
        a = medium.density(ray.o + ray.d * (t + (0.5 - _GAUSS) * delta), active)
        b = medium.density(ray.o + ray.d * (t + (0.5 + _GAUSS) * delta), active)
        mean = 0.5 * (a + b)
        dtau = dr.select(active, mean * delta, 0)
        # The ends of the line through both samples, kept from leaving the density's range.
        tilt = dr.clip((b - a) * (0.5 / (2 * _GAUSS)), -mean, mean)
        first, last = mean - tilt, mean + tilt
        return _step_along_line(medium, ray, t, delta, dtau, first, last, None, dr.select(active, 2.0, 0.0))


for _rule in (Constant(), Linear(), Cells()):
    RULES.register(_rule)
