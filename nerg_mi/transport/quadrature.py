"""What one step of constant density contributes to opacity and to depth.

The NeRF rule (Mildenhall et al. 2020, eq. 3; Max 1995): density is constant over
a step of length δ, so that the step absorbs 1 - exp(-σδ) of what reaches it.
Under the same assumption the absorbed light comes from a mean distance into the
step of 1/σ - δ/expm1(σδ); using it makes the expected depth exact for piecewise
constant density, where the step's midpoint or end would be biased.
"""
from __future__ import annotations

import drjit as dr

from ..field.elementary import one_minus_exp

# Below it the closed form cancels; the series is then exact to 1e-8.
_SERIES_BELOW = 0.5
# exp overflows fp32 beyond 88, where its reciprocal is 0 to working precision anyway.
_EXP_LIMIT = 80.0


def absorbed_share(tau):
    """Share 1 - exp(-τ) of the light that a step of optical depth ``tau`` absorbs."""
    return one_minus_exp(tau)


def mean_depth_share(tau):
    """Mean distance into a step at which light is absorbed, as a share of its length.

    h(τ) = 1/τ - 1/expm1(τ): 1/2 for thin steps, 1/τ for opaque ones. ``tau``: optical depth
    σδ >= 0 of the step, up to infinity. Finite, with a finite derivative, everywhere.
    """
    small = dr.minimum(tau, _SERIES_BELOW)
    square = small * small
    series = 0.5 + small * dr.fma(
        square, dr.fma(square, dr.fma(square, 1 / 1209600, -1 / 30240), 1 / 720), -1 / 12
    )
    large = dr.maximum(tau, _SERIES_BELOW)
    closed = 1 / large - 1 / (dr.exp(dr.minimum(large, _EXP_LIMIT)) - 1)
    return dr.select(tau < _SERIES_BELOW, series, closed)
