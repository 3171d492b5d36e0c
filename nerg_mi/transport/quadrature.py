"""Quadrature of optical depth along a step: the protocol, the registry and the rules."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.maths.arrays import one_minus_exp, quotient
from nerg_mi.maths.types import Bool, Color, Float

from .medium import LocalRay, Medium, Painter, VoxelCells

# ---- What one step of constant or linear density contributes to opacity and to depth ----
#
# The NeRF rule (Mildenhall et al. 2020, eq. 3; Max 1995): density is constant over
# a step of length δ, so that the step absorbs 1 - exp(-σδ) of what reaches it.
# Under the same assumption the absorbed light comes from a mean distance into the
# step of 1/σ - δ/expm1(σδ); using it makes the expected depth exact for piecewise
# constant density, where the step's midpoint or end would be biased.
#
# Where density rises or falls linearly from a to b (times δ), the mean is, by parts and with
# T = (a + b) / 2, that of ∫ exp(-τ(s)) ds over the step: the scaled complementary error function
# erfcx where density rises, Dawson's integral where it falls.


# Below it the closed form cancels; the series is then exact to 1e-8.
_SERIES_BELOW = 0.5
# exp overflows fp32 beyond 88, where its reciprocal is 0 to working precision anyway.
_EXP_LIMIT = 80.0


def absorbed_fraction(tau: Float) -> Float:
    """Share 1 - exp(-τ) of the light that a step of optical depth ``tau`` absorbs."""
    return one_minus_exp(tau)


def mean_depth_fraction(tau: Float) -> Float:
    """Mean distance into a step at which light is absorbed, as a share of its length.

    h(τ) = 1/τ - 1/expm1(τ): 1/2 for thin steps, 1/τ for opaque ones. ``tau``: optical depth
    σδ >= 0 of the step, up to infinity. Finite, with a finite derivative, everywhere.
    """
    small = dr.minimum(tau, _SERIES_BELOW)
    square = small * small
    series = 0.5 + small * dr.fma(square, dr.fma(square, dr.fma(square, 1 / 1209600, -1 / 30240), 1 / 720), -1 / 12)
    large = dr.maximum(tau, _SERIES_BELOW)
    closed = 1 / large - 1 / (dr.exp(dr.minimum(large, _EXP_LIMIT)) - 1)
    return dr.select(tau < _SERIES_BELOW, series, closed)


# Up to this optical depth of a step the closed form of its mean depth cancels; then a polynomial is used,
# of the optical depth T (rows) and of r = (b - a) / (a + b) (columns), good to 2e-8.
_THIN_BELOW = 1.5
_THIN = (
    (
        0.49999999,
        0.16666664,
        6.7987697e-08,
        1.0918575e-07,
        -1.3042581e-07,
        -8.6174076e-08,
        6.8771346e-08,
        -5.0923863e-09,
        -3.0330697e-09,
    ),
    (
        -0.083333207,
        4.696041e-07,
        0.016665378,
        -2.3119287e-06,
        1.8851202e-06,
        2.0102928e-06,
        -6.0208229e-07,
        1.9761391e-08,
    ),
    (-4.7494924e-07, -0.0027788291, 4.8875239e-06, 0.0011977268, -5.8555807e-06, -7.0758754e-06, 7.0219043e-07),
    (0.001389431, -4.4768449e-07, -0.00040419055, -5.8747659e-06, 7.463209e-05, 8.0344691e-06),
    (5.5822326e-08, 6.8628814e-05, 4.4154791e-06, -3.4397043e-05, -6.4088865e-06),
    (-3.3514015e-05, -1.7748095e-06, 9.8955855e-06, 3.0114173e-06),
    (1.6542555e-07, -1.4230667e-06, -9.2453506e-07),
    (9.3366942e-07, 1.4200224e-07),
    (-9.0313165e-08,),
)
# √π x erfcx(x) (1 + 2.5 / x) = 1 + t + t² Σ c_i t^i, t = 1 / (1 + 0.4 x), good to 1e-8 for x >= 0; the first two
# terms are those of x -> ∞, without which derivatives would err where density is nearly constant.
_RISING = (
    0.919975234,
    0.760822631,
    0.528661344,
    0.366397487,
    -0.194325918,
    0.589119012,
    -1.02504195,
    0.612999031,
    -0.127472229,
)
# (1 + 2 y²) D(y) / y = N(w) / Q(w), w = 1 / (1 + y²), good to 1e-7 for y >= 0, D Dawson's integral;
# again 1 + w + ... as y -> ∞.
_FALLING_N = (1, -7.84594733, 113.145993, -51.5585158, 3020.43204, 13749.1012, 10526.1031, 530766.935, -269862.908)
_FALLING_Q = (1, -8.84594733, 120.000291, -160.558328, 3061.92745, 7555.4792, 42396.4933, 101615.002, 133673.878)
# Denser steps have their mean depth at their face to any precision, and squares of more would overflow.
_DENSEST = 1e18


def linear_share(first: Float, last: Float) -> Float:
    """Mean absorption distance, as a share of the step, of a density that is linear over it.

    ``first``, ``last``: density at the ends times the step's length, >= 0. Good to 1e-6 (relative); equals
    ``mean_depth_fraction`` where both are equal. Finite, with a finite derivative, everywhere.
    """
    first, last = dr.minimum(first, _DENSEST), dr.minimum(last, _DENSEST)
    # Steps that are thinner than 1e-18 weigh nothing: the derivative's squares must not underflow.
    total, slope = dr.maximum(first + last, 1e-18), last - first
    thin = total < 2 * _THIN_BELOW
    r = slope / total
    series = _horner([_horner(row, r) for row in _THIN], 0.5 * dr.minimum(total, 2 * _THIN_BELOW))

    # ∫ exp(-τ) from where density is σ to infinity, along the line with the step's slope, is the tail of σ.
    # Where density is nearly constant both have the same series, and Dawson's is smooth there in its slope.
    rises = ~thin & (slope > 1e-3 * first * first)
    falls = ~thin & ~rises
    tau = 0.5 * dr.select(thin, 1, total)
    passed = dr.exp(-tau)
    up = dr.select(rises, slope, 1)
    down = dr.select(falls, -slope, 1)

    def tail(sigma):
        sigma = dr.select(thin, 1, sigma)
        root = 2.5 * dr.sqrt(2 * up)
        t = root / (root + sigma)
        rising = dr.fma(t * t, _horner(_RISING, t), 1 + t) / (root + sigma)
        square = sigma * sigma
        w = 2 * down / dr.fma(2, down, square)
        falling = sigma / (down + square) * _horner(_FALLING_N, w) / _horner(_FALLING_Q, w)
        return dr.select(rises, rising, falling)

    closed = (tail(first) - passed * (tail(last) + 1)) / (1 - passed)
    return dr.select(thin, series, closed)


def linear_crossing(first: Float, last: Float, length: Float, missing: Float) -> Float:
    """Distance into a step of linear density at which the optical depth ``missing`` is reached.

    ``first``, ``last``: density at its ends; ``length``: of the step. The stable root s of
    first s + (last - first) s² / (2 length) = missing, at most ``length``.
    """
    root = dr.sqrt(dr.maximum(first * first + 2 * (last - first) / length * missing, 1e-30))
    total = first + root
    return dr.minimum(2 * missing / dr.select(total > 0, total, 1), length)


def _horner(coefficients: Sequence[Float] | Sequence[float], x: Float) -> Float:
    """Σ c_i x^i."""
    value: Any = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        value = dr.fma(value, x, c)
    return value


# ---- Registry ----
#
# Objects of one kind that are chosen by name, so that one more of them is one more object and nothing else.


class Named(Protocol):
    """What can be registered."""

    @property
    def name(self) -> str:
        """As which it is chosen."""
        ...

    @property
    def summary(self) -> str:
        """What it does, in a sentence without its full stop: for the manual."""
        ...


Kind = TypeVar("Kind", bound=Named)


class Registry(Generic[Kind]):
    """Objects by name, in the order in which they were registered. ``parameter``: what chooses among them."""

    def __init__(self, parameter: str):
        self.parameter = parameter
        self._known: dict[str, Kind] = {}

    def register(self, item: Kind) -> Kind:
        """Make ``item`` known. Raises ``ValueError`` for a name that is taken."""
        if item.name in self._known:
            raise ValueError(f'there is already a "{item.name}" for "{self.parameter}"')
        self._known[item.name] = item
        return item

    def unregister(self, name: str) -> None:
        """Forget what is called ``name``. Raises ``KeyError`` where nothing is."""
        del self._known[name]

    def find(self, name: str) -> Kind:
        """What is called ``name``. Raises ``NergError``, which names the others, where nothing is."""
        if name not in self._known:
            raise NergError(f'"{self.parameter}" must be one of {", ".join(self._known)}, got "{name}"')
        return self._known[name]

    def names(self) -> tuple[str, ...]:
        """All names."""
        return tuple(self._known)

    def __iter__(self) -> Iterator[Kind]:
        return iter(self._known.values())

    def format_manual(self) -> str:
        """One sentence about each, as the manual has it."""
        return " ".join(f"``{item.name}``: {item.summary}." for item in self)


# ---- Rules ----
#
# Quadrature rules: how samples of the density become a step's optical depth and its mean depth.
#
# A rule is one object of the protocol ``Rule``, registered in ``RULES``: the integrator's parameter ``quadrature``, its
# manual and the study offer whatever stands there. Another rule is a class like those below and one line
# ``register_quadrature(...)``, here or in any module that is imported.


# Where the two Gauss-Legendre samples of an interval lie, from its middle and as a share of its length.
_GAUSS = 0.5 / 3**0.5


@dataclass
class MarchStep:
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
    def ends_at_cells(self) -> bool:
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
    ) -> MarchStep:
        """Evaluate the step from the distance ``t`` on, ``delta`` long.

        ``t_next``: where it ends, detached; equal to the next step's ``t`` unless something is leapt over in between.
        ``carry``: that of the step before, or None, from which nothing is known: derivatives are found so, step by
        step. Densities and colours are to be attached to ``ray``, ``t``, ``delta`` and the medium. ``colored``:
        whether the step may be asked to ``paint``.
        """
        ...


RULES: Registry[Rule] = Registry("quadrature")


def register_quadrature(rule: Rule) -> Rule:
    """Make ``rule`` one that the integrator's parameter ``quadrature`` can name. Raises ``ValueError`` for a name that
    is taken.

    >>> import nerg_mi as nerg
    >>> from nerg_mi.transport.quadrature import RULES
    >>> class OurRule(type(RULES.find("constant"))):
    ...     name = "ours"
    >>> nerg.register_quadrature(OurRule()).name
    'ours'
    >>> RULES.unregister("ours")
    """
    return RULES.register(rule)


def boundaries(rule: Rule, medium: Medium) -> VoxelCells | None:
    """Where steps of ``rule`` end in ``medium``; None where they are as long as the settings say. Raises ``NergError``
    for a medium that has no voxels where the rule needs them."""
    if not rule.ends_at_cells:
        return None
    if medium.cells is None:
        others = " or ".join(f'"{other.name}"' for other in RULES if not other.ends_at_cells)
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
) -> MarchStep:
    """The step from ``t`` on, ``delta`` long and of optical depth ``dtau``, whose density runs in a line from ``first``
    to ``last``."""
    share = linear_share(first * delta, last * delta)

    def paint(painter, lit):
        p = ray.o + ray.d * dr.fma(delta, color_share(first, last, share), t)
        return painter.shade(medium, medium.density_features(p, lit)[1], p, ray.w, lit)

    return MarchStep(
        dtau, share, lambda missing: linear_crossing(first, last, delta, missing), paint, carry, evaluations
    )


class Constant:
    """Density constant over a step: its value at the middle (Mildenhall et al. 2020, eq. 3)."""

    name = "constant"
    summary = "density is constant over a step, sampled at its middle"
    ends_at_cells = False

    def start(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, colored) -> MarchStep:
        p = ray.o + ray.d * (t + 0.5 * delta)
        sigma, features = medium.density_features(p, active) if colored else (medium.density(p, active), [])
        dtau = dr.select(active, sigma * delta, 0)

        def paint(painter, lit):
            return painter.shade(medium, features, p, ray.w, lit)

        return MarchStep(
            dtau,
            mean_depth_fraction(dtau),
            lambda missing: delta * quotient(missing, dr.select(dtau > 0, dtau, 1)),
            paint,
            None,
            dr.select(active, type(dtau)(1), 0),
        )


class Linear:
    """Density linear over a step, between samples at its ends, which neighbours share (Uy et al. 2023, "NeRF
    Revisited: Fixing Quadrature Instability in Volume Rendering")."""

    name = "linear"
    summary = "linear between samples at the steps' ends"
    ends_at_cells = False

    def start(self, Float):
        # Density at the end of the step before, and where that was (distances are not negative).
        return Float(0), Float(-1)

    def step(self, medium, ray, t, delta, t_next, carry, active, colored) -> MarchStep:
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
        evaluations = dr.select(active, type(dtau)(1), 0) + dr.select(fresh, type(dtau)(1), 0)
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
    ends_at_cells = True

    def start(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, colored) -> MarchStep:
        a = medium.density(ray.o + ray.d * (t + (0.5 - _GAUSS) * delta), active)
        b = medium.density(ray.o + ray.d * (t + (0.5 + _GAUSS) * delta), active)
        mean = 0.5 * (a + b)
        dtau = dr.select(active, mean * delta, 0)
        # The ends of the line through both samples, kept from leaving the density's range.
        tilt = dr.clip((b - a) * (0.5 / (2 * _GAUSS)), -mean, mean)
        first, last = mean - tilt, mean + tilt
        return _step_along_line(medium, ray, t, delta, dtau, first, last, None, dr.select(active, type(dtau)(2), 0))


for _rule in (Constant(), Linear(), Cells()):
    register_quadrature(_rule)
