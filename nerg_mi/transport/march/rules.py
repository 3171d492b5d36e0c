"""Quadrature rules: how density samples become a step's optical depth and mean depth.

``constant``: one sample at the middle, density constant over the step (Mildenhall et
al. 2020). ``linear``: one sample at each end, shared between neighbours, density
linear in between (Uy et al. 2023, "NeRF Revisited: Fixing Quadrature Instability in
Volume Rendering"). ``cells``: steps end at the voxel boundaries of a grid, where its
interpolant is a cubic along the ray that two Gauss-Legendre samples integrate exactly.
Opacity is then exact, depth to a hundredth of a voxel: it takes the density between as
the line through both samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.maths.elementary import quotient

from .quadrature import linear_crossing, linear_share, mean_depth_share

KINDS = ("constant", "linear", "cells")

_GAUSS = 0.5 / 3**0.5


@dataclass
class Step:
    """One evaluated step of length δ.

    ``dtau``: its optical depth; ``share``: mean distance of absorption into it, as a share of δ;
    ``crossing(missing)``: distance into it at which the optical depth ``missing`` (at most ``dtau``) is
    reached; ``color(lit)``: its colour on the lanes ``lit``; ``carry``: what the next step reuses;
    ``evals``: density evaluations made, a lane.
    """

    dtau: object
    share: object
    crossing: Callable
    color: Callable
    carry: object
    evals: object


def color_share(first, last, share):
    """Where a step of linear density takes its colour, as a share of its length.

    At the mean absorption, ``share``, which is exact for a linear colour, where both ends are nearly as dense; at the
    denser end where one is nearly empty: in the air before a wall a trained field's colour means nothing. The square
    of the relative difference decides, so that colour stays of second order in the step.
    """
    r = (last - first) / dr.maximum(first + last, 1e-18)
    return dr.lerp(share, dr.select(r > 0, 1.0, 0.0), r * r)


class Constant:
    """Density constant over a step: its value at the middle."""

    planes = None

    def start(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, color) -> Step:
        p = ray.o + ray.d * (t + 0.5 * delta)
        if color is None:
            sigma, features = medium.density(p, active), []
        else:
            sigma, features = medium.density_features(p, active)
        dtau = dr.select(active, sigma * delta, 0)

        def paint(lit):
            return color(medium.color(features, p, ray.w, lit))

        return Step(
            dtau,
            mean_depth_share(dtau),
            lambda missing: delta * quotient(missing, dr.select(dtau > 0, dtau, 1)),
            paint,
            None,
            dr.select(active, 1.0, 0.0),
        )


class Linear:
    """Density linear over a step, between samples at its ends."""

    planes = None

    def start(self, Float):
        # Density at the end of the step before, and where that was (distances are not negative).
        return Float(0), Float(-1)

    def step(self, medium, ray, t, delta, t_next, carry, active, color) -> Step:
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
        share = linear_share(first * delta, last * delta)

        def paint(lit):
            p = ray.o + ray.d * dr.fma(delta, color_share(first, last, share), t)
            return color(medium.color(medium.density_features(p, lit)[1], p, ray.w, lit))

        return Step(
            dtau,
            share,
            lambda missing: linear_crossing(first, last, delta, missing),
            paint,
            (last, t_next),
            dr.select(active, 1.0, 0.0) + dr.select(fresh, 1.0, 0.0),
        )


class Cells:
    """Steps inside one voxel of a grid volume: two Gauss-Legendre samples, exact for its cubic."""

    def __init__(self, planes):
        self.planes = planes

    def start(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, color) -> Step:
        a = medium.density(ray.o + ray.d * (t + (0.5 - _GAUSS) * delta), active)
        b = medium.density(ray.o + ray.d * (t + (0.5 + _GAUSS) * delta), active)
        mean = 0.5 * (a + b)
        dtau = dr.select(active, mean * delta, 0)
        # The ends of the line through both samples, kept from leaving the density's range.
        tilt = dr.clip((b - a) * (0.5 / (2 * _GAUSS)), -mean, mean)
        first, last = mean - tilt, mean + tilt
        share = linear_share(first * delta, last * delta)

        def paint(lit):
            p = ray.o + ray.d * dr.fma(delta, color_share(first, last, share), t)
            return color(medium.color(medium.density_features(p, lit)[1], p, ray.w, lit))

        return Step(
            dtau,
            share,
            lambda missing: linear_crossing(first, last, delta, missing),
            paint,
            None,
            dr.select(active, 2.0, 0.0),
        )


def rule(kind: str, medium):
    """The rule ``kind`` for ``medium``; ``cells`` needs a medium that is a grid."""
    if kind == "constant":
        return Constant()
    if kind == "linear":
        return Linear()
    if kind != "cells":
        raise NergError(f'"quadrature" must be one of {", ".join(KINDS)}, got "{kind}"')
    if medium.cells is None:
        raise NergError(
            'the quadrature "cells" needs an axis-aligned "gridvolume" as density; use "constant" or "linear"'
        )
    return Cells(medium.cells)
