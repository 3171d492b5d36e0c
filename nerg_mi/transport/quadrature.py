"""Quadrature of the optical depth along one step: protocol, registry and rules."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.maths.arrays import one_minus_exp, quotient
from nerg_mi.maths.types import Bool, Color, Float

from .medium import LocalRay, Medium, SampleShader, VoxelCells

# ---- Contribution of one step of constant or linear density to opacity and depth ----
#
# The NeRF rule (Mildenhall et al. 2020, eq. 3; Max 1995) takes density as constant over a step of length δ, which then
# absorbs 1 - exp(-σδ) of the arriving light. Under the same assumption, light is absorbed at a mean distance of 1/σ -
# δ/expm1(σδ) into the step. With this distance the expected depth is exact for piecewise constant density; the step's
# midpoint or end would be biased.
#
# Where density changes linearly from a to b (times δ), the mean follows by parts, with T = (a + b) / 2, from ∫
# exp(-τ(s)) ds over the step: the scaled complementary error function erfcx for rising density, Dawson's integral for
# falling density.


# Below this optical depth the closed form cancels and the series is exact to 1e-8.
_SERIES_BELOW = 0.5
# exp overflows fp32 beyond 88; its reciprocal is 0 in working precision there.
_EXP_LIMIT = 80.0


def absorbed_fraction(tau: Float) -> Float:
    """Fraction 1 - exp(-τ) of the light that a step of optical depth ``tau`` absorbs."""
    return one_minus_exp(tau)


def mean_depth_fraction(tau: Float) -> Float:
    """Mean absorption distance of a step of constant density, as a fraction of its length.

    h(τ) = 1/τ - 1/expm1(τ): 1/2 for thin steps, 1/τ for opaque ones. ``tau``: optical depth σδ >= 0 of the step, up to
    infinity. Finite, with a finite derivative, everywhere.
    """
    small = dr.minimum(tau, _SERIES_BELOW)
    square = small * small
    series = 0.5 + small * dr.fma(square, dr.fma(square, dr.fma(square, 1 / 1209600, -1 / 30240), 1 / 720), -1 / 12)
    large = dr.maximum(tau, _SERIES_BELOW)
    closed = 1 / large - 1 / (dr.exp(dr.minimum(large, _EXP_LIMIT)) - 1)
    return dr.select(tau < _SERIES_BELOW, series, closed)


# Up to this optical depth the closed form of the mean depth cancels. A polynomial in the optical depth T (rows) and r =
# (b - a) / (a + b) (columns) is used instead; its error is 2e-8.
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
# √π x erfcx(x) (1 + 2.5 / x) = 1 + t + t² Σ c_i t^i, t = 1 / (1 + 0.4 x), to 1e-8 for x >= 0. The first two terms are
# the limits for x -> ∞; without them, derivatives would be wrong where density is nearly constant.
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
# (1 + 2 y²) D(y) / y = N(w) / Q(w), w = 1 / (1 + y²), to 1e-7 for y >= 0, with Dawson's integral D; the leading terms
# are the limits for y -> ∞.
_FALLING_N = (1, -7.84594733, 113.145993, -51.5585158, 3020.43204, 13749.1012, 10526.1031, 530766.935, -269862.908)
_FALLING_Q = (1, -8.84594733, 120.000291, -160.558328, 3061.92745, 7555.4792, 42396.4933, 101615.002, 133673.878)
# Denser steps have their mean depth at their start in any precision, and squares of larger values would overflow.
_MAX_DENSITY_STEP = 1e18


def linear_mean_depth_fraction(first: Float, last: Float) -> Float:
    """Mean absorption distance of a step of linear density, as a fraction of its length.

    ``first``, ``last``: density at both ends times the step length, >= 0. Relative error 1e-6; equals
    `mean_depth_fraction` where both are equal. Finite, with a finite derivative, everywhere.
    """
    first, last = dr.minimum(first, _MAX_DENSITY_STEP), dr.minimum(last, _MAX_DENSITY_STEP)
    # Steps thinner than 1e-18 have no weight; the squares in the derivative must not underflow.
    total, slope = dr.maximum(first + last, 1e-18), last - first
    thin = total < 2 * _THIN_BELOW
    r = slope / total
    series = _horner([_horner(row, r) for row in _THIN], 0.5 * dr.minimum(total, 2 * _THIN_BELOW))

    # ∫ exp(-τ) from a point with density σ to infinity, along the line with the step's slope, is the tail of σ. For
    # nearly constant density both tails have the same series, and Dawson's is smooth in the slope there.
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


def find_linear_crossing(first: Float, last: Float, length: Float, remaining: Float) -> Float:
    """Distance into a step of linear density at which the optical depth ``remaining`` is reached.

    ``first``, ``last``: density at both ends; ``length``: length of the step. The numerically stable root s of first s
    + (last - first) s² / (2 length) = remaining, at most ``length``.
    """
    root = dr.sqrt(dr.maximum(first * first + 2 * (last - first) / length * remaining, 1e-30))
    total = first + root
    return dr.minimum(2 * remaining / dr.select(total > 0, total, 1), length)


def _horner(coefficients: Sequence[Float] | Sequence[float], x: Float) -> Float:
    """Σ c_i x^i by Horner's rule."""
    value: Any = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        value = dr.fma(value, x, c)
    return value


# ---- Registry ----
#
# Objects of one kind that are selected by name, so that an extension is one object and no other change.


class RegistryEntry(Protocol):
    """An object with a name and a one-sentence summary, which a `Registry` can hold."""

    @property
    def name(self) -> str:
        """Name by which the object is selected."""
        ...

    @property
    def summary(self) -> str:
        """One sentence for the manual, without its full stop."""
        ...


Kind = TypeVar("Kind", bound=RegistryEntry)


class Registry(Generic[Kind]):
    """Objects by name, in the order of their registration. ``parameter``: name of the parameter that selects one of
    them."""

    def __init__(self, parameter: str):
        self.parameter = parameter
        self._items: dict[str, Kind] = {}

    def register(self, item: Kind) -> Kind:
        """Register ``item``. Raises ``ValueError`` if its name is taken."""
        if item.name in self._items:
            raise ValueError(f'"{item.name}" is already registered for "{self.parameter}"')
        self._items[item.name] = item
        return item

    def unregister(self, name: str) -> None:
        """Remove the object called ``name``. Raises ``KeyError`` if there is none."""
        del self._items[name]

    def find(self, name: str) -> Kind:
        """The object called ``name``. Raises ``NergError``, with the list of names, if there is none."""
        if name not in self._items:
            raise NergError(f'"{self.parameter}" must be one of {", ".join(self._items)}, got "{name}"')
        return self._items[name]

    def names(self) -> tuple[str, ...]:
        """All registered names."""
        return tuple(self._items)

    def __iter__(self) -> Iterator[Kind]:
        return iter(self._items.values())

    def format_manual(self) -> str:
        """One sentence for each object, for the manual."""
        return " ".join(f"``{item.name}``: {item.summary}." for item in self)


# ---- Rules ----
#
# Quadrature rules: how density samples become the optical depth and the mean depth of a step.
#
# A rule is an object of the protocol `QuadratureRule`, registered in ``RULES``: the integrator's parameter
# ``quadrature``, its manual and ``nerg study`` list all registered rules. To add a rule, write a class like those below
# and call ``register_quadrature(...)``, here or in any imported module.


# Distance of both Gauss-Legendre samples from the middle of an interval, as a fraction of its length.
_GAUSS = 0.5 / 3**0.5


@dataclass
class MarchStep:
    """One evaluated step, ``delta`` long in scene units. Attached to whatever carries gradients."""

    # Optical depth; 0 on inactive lanes.
    dtau: Float
    # Mean absorption distance, as a fraction of `delta`.
    mean_fraction: Float
    # Distance into the step, in scene units, at which an optical depth (at most `dtau`) is reached.
    find_crossing: Callable[[Float], Float]
    # The step's contribution to the sum of colours, given a shader and a mask of lanes.
    shade: Callable[[SampleShader, Bool], Color]
    # What the next step reuses: a PyTree like that of `QuadratureRule.init_carry`.
    carry: Any
    # Number of density evaluations.
    evals: Float
    # Distance in scene units of the point whose colour `shade` takes.
    color_distance: Float


class QuadratureRule(Protocol):
    """A quadrature rule. It has no state: one object serves all marches."""

    @property
    def name(self) -> str:
        """Value of the parameter ``quadrature`` that selects the rule."""
        ...

    @property
    def summary(self) -> str:
        """One sentence for the manual, without its full stop."""
        ...

    @property
    def ends_at_cells(self) -> bool:
        """Whether steps end where the ray leaves a voxel, which requires a medium with ``cells``. Otherwise the
        settings determine the step length."""
        ...

    def init_carry(self, Float: type) -> Any:
        """The ``carry`` of the first step: a PyTree of one-lane arrays, or None. ``Float``: array type of distances."""
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
        needs_color: bool,
    ) -> MarchStep:
        """Evaluate the step that starts at the distance ``t`` and is ``delta`` long.

        Parameters
        ----------
        t_next : Float
            End of the step, detached; equal to the next step's ``t`` unless empty space is skipped in between.
        carry : PyTree or None
            The previous step's, or None if nothing can be reused; derivatives are computed without it, step by step.
        needs_color : bool
            Whether the step may be shaded.

        Notes
        -----
        Densities and colours must be attached to ``ray``, ``t``, ``delta`` and the medium.
        """
        ...


RULES: Registry[QuadratureRule] = Registry("quadrature")


def register_quadrature(rule: QuadratureRule) -> QuadratureRule:
    """Register ``rule`` for the integrator's parameter ``quadrature``. Raises ``ValueError`` if its name is taken.

    >>> import nerg_mi as nerg
    >>> from nerg_mi.transport.quadrature import RULES
    >>> class OurRule(type(RULES.find("constant"))):
    ...     name = "ours"
    >>> nerg.register_quadrature(OurRule()).name
    'ours'
    >>> RULES.unregister("ours")
    """
    return RULES.register(rule)


def cells_for_rule(rule: QuadratureRule, medium: Medium) -> VoxelCells | None:
    """The voxels at whose boundaries the steps of ``rule`` end in ``medium``; None for a rule with steps of a given
    length. Raises ``NergError`` if the rule needs voxels and the medium has none."""
    if not rule.ends_at_cells:
        return None
    if medium.cells is None:
        alternatives = " or ".join(f'"{alternative.name}"' for alternative in RULES if not alternative.ends_at_cells)
        raise NergError(
            f'the quadrature "{rule.name}" needs an axis-aligned "gridvolume" as density; use {alternatives}'
        )
    return medium.cells


def color_sample_fraction(first: Float, last: Float, share: Float) -> Float:
    """Where a step of linear density takes its colour, as a fraction of its length.

    ``first``, ``last``: density at both ends; ``share``: mean absorption distance, as a fraction of the length. Where
    both ends are about equally dense, the colour is taken at the mean absorption distance, which is exact for a linear
    colour. Where one end is nearly empty, it is taken at the denser end: the colour of a trained field is arbitrary in
    the air in front of a wall. The squared relative difference blends both, so that colour stays second order in the
    step.
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
    """A step of optical depth ``dtau`` whose density changes linearly from ``first`` to ``last``."""
    share = linear_mean_depth_fraction(first * delta, last * delta)
    color_distance = dr.fma(delta, color_sample_fraction(first, last, share), t)
    return MarchStep(
        dtau,
        share,
        lambda missing: find_linear_crossing(first, last, delta, missing),
        lambda painter, lit: shade_point(medium, ray, color_distance, painter, lit),
        carry,
        evaluations,
        color_distance,
    )


def shade_point(medium: Medium, ray: LocalRay, distance: Float, shader: SampleShader, active: Bool) -> Color:
    """Contribution of the point at ``distance`` on ``ray``, whose features are evaluated for it alone."""
    p = ray.o + ray.d * distance
    features = medium.density_features(p, active)[1] if shader.needs_features else []
    return shader.shade(medium, features, p, ray.w, active)


class Constant:
    """Constant density over a step, sampled at its middle (Mildenhall et al. 2020, eq. 3)."""

    name = "constant"
    summary = "density is constant over a step, sampled at its middle"
    ends_at_cells = False

    def init_carry(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, needs_color) -> MarchStep:
        middle = t + 0.5 * delta
        p = ray.o + ray.d * middle
        together = needs_color and not medium.is_density_separate
        sigma, features = medium.density_features(p, active) if together else (medium.density(p, active), None)
        dtau = dr.select(active, sigma * delta, 0)

        def paint(painter, lit):
            if features is None:
                return shade_point(medium, ray, middle, painter, lit)
            return painter.shade(medium, features, p, ray.w, lit)

        return MarchStep(
            dtau,
            mean_depth_fraction(dtau),
            lambda missing: delta * quotient(missing, dr.select(dtau > 0, dtau, 1)),
            paint,
            None,
            dr.select(active, type(dtau)(1), 0),
            middle,
        )


class Linear:
    """Linear density over a step, between samples at its ends, which adjacent steps share (Uy et al. 2023, "NeRF
    Revisited: Fixing Quadrature Instability in Volume Rendering")."""

    name = "linear"
    summary = "density is linear over a step, between samples at its ends"
    ends_at_cells = False

    def init_carry(self, Float):
        # Density at the end of the previous step, and the distance of that end (distances are not negative).
        return Float(0), Float(-1)

    def step(self, medium, ray, t, delta, t_next, carry, active, needs_color) -> MarchStep:
        fresh = active if carry is None else active & (carry[1] != t)
        if carry is None:
            first = medium.density(ray.o + ray.d * t, active)
        else:
            # After skipped cells the step does not start at the end of the previous one.
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
    integrate exactly. Opacity is exact; depth, which uses the line through both samples as the density, is accurate to
    a hundredth of a voxel."""

    name = "cells"
    summary = (
        "for an axis-aligned ``gridvolume`` as density: steps end at voxel boundaries, and two samples per step "
        "integrate the interpolant exactly (opacity to rounding, depth to a hundredth of a voxel); ``step`` limits "
        "their length, ``dt_gamma``, ``coarse`` and ``jitter`` are not used"
    )
    ends_at_cells = True

    def init_carry(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, needs_color) -> MarchStep:
        a = medium.density(ray.o + ray.d * (t + (0.5 - _GAUSS) * delta), active)
        b = medium.density(ray.o + ray.d * (t + (0.5 + _GAUSS) * delta), active)
        mean = 0.5 * (a + b)
        dtau = dr.select(active, mean * delta, 0)
        # The ends of the line through both samples, limited to non-negative densities.
        tilt = dr.clip((b - a) * (0.5 / (2 * _GAUSS)), -mean, mean)
        first, last = mean - tilt, mean + tilt
        return _step_along_line(medium, ray, t, delta, dtau, first, last, None, dr.select(active, type(dtau)(2), 0))


for _rule in (Constant(), Linear(), Cells()):
    register_quadrature(_rule)
