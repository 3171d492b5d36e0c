"""What one step of constant or linear density contributes to opacity and to depth.

The NeRF rule (Mildenhall et al. 2020, eq. 3; Max 1995): density is constant over
a step of length δ, so that the step absorbs 1 - exp(-σδ) of what reaches it.
Under the same assumption the absorbed light comes from a mean distance into the
step of 1/σ - δ/expm1(σδ); using it makes the expected depth exact for piecewise
constant density, where the step's midpoint or end would be biased.

Where density rises or falls linearly from a to b (times δ), the mean is, by parts and with
T = (a + b) / 2, that of ∫ exp(-τ(s)) ds over the step: the scaled complementary error function
erfcx where density rises, Dawson's integral where it falls.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr

from nerg_mi.maths.arrays import one_minus_exp
from nerg_mi.maths.types import Float

# Below it the closed form cancels; the series is then exact to 1e-8.
_SERIES_BELOW = 0.5
# exp overflows fp32 beyond 88, where its reciprocal is 0 to working precision anyway.
_EXP_LIMIT = 80.0


def absorbed_share(tau: Float) -> Float:
    """Share 1 - exp(-τ) of the light that a step of optical depth ``tau`` absorbs."""
    return one_minus_exp(tau)


def mean_depth_share(tau: Float) -> Float:
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
    ``mean_depth_share`` where both are equal. Finite, with a finite derivative, everywhere.
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


def _horner(coefficients: Sequence[Float], x: Float) -> Float:
    """Σ c_i x^i."""
    value = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        value = dr.fma(value, x, c)
    return value
