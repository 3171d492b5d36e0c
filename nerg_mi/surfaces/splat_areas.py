r"""The area that each Gaussian takes of the surface it is a part of, seen from either of its sides.

Parallel rays that fall on a surface of Gaussians, one to a unit of area, leave A_i = ∫ T_i α_i dA on each of them:
areas that add up to the surface's where it is opaque, however many overlap. With α_i = o_i exp(-r² / 2) that is

    A_i = 2π σ_1 σ_2 o_i (1 - exp(-e² / 2)) E[T_i]

for the two longest standard deviations, the cut-off at e of them, and the mean of the light that reaches the Gaussian
over its own profile, which a few rays around the shortest axis tell: not along it, for the order of Gaussians in one
plane would then be that of their numbers. They start as far before it as a point may lie
behind a surface and still be seen: a place that stands before it hides it, and takes nothing of its area.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.field.splats import Splats
from nerg_mi.transport.media.splats.arrays import MOST_ABSORBED, SplatArrays

from .splat_hits import groups_of_hits

RAYS = 8
"""To a side of a Gaussian."""

HIDDEN = 0.05
"""Of its whole area: a side of which less is seen counts as hidden."""

TILT = np.radians(25)
"""Of the rays."""

_BATCH = 1 << 17
# Multiples of both together fill a square evenly (the plastic number).
_SPREAD = 0.7548776662466927, 0.5698402909980532
_GOLDEN = np.pi * (3 - np.sqrt(5))


def shortest_axes(splats: Splats) -> np.ndarray:
    """The unit shortest axis (N, 3) of each Gaussian, float64."""
    return np.take_along_axis(splats.axes(), splats.scales.argmin(axis=1)[:, None, None], axis=2)[..., 0]


def sides_of(directions: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Which side (N,) of Gaussians with the shortest ``axes`` is seen along ``directions`` (N, 3 each): 0 along the
    axis, 1 against it."""
    return (np.einsum("ij,ij->i", directions, axes) <= 0).astype(np.int64)


def whole_areas(splats: Splats, extent: float) -> np.ndarray:
    """Areas (N,) of Gaussians that nothing hides, in square scene units."""
    scales = np.sort(splats.scales.astype(np.float64), axis=1)
    opacity = np.minimum(splats.opacities.astype(np.float64), MOST_ABSORBED)
    return 2 * np.pi * scales[:, 1] * scales[:, 2] * opacity * -np.expm1(-(extent**2) / 2)


def splat_areas(splats: Splats, arrays: SplatArrays, tolerance: float) -> np.ndarray:
    """Areas (2, N) in square scene units of the sides (`sides_of`) of ``splats``, which ``arrays`` hold. ``tolerance``:
    how far a point may lie behind a surface that is not hidden by it."""
    lights = np.zeros((2, len(splats)))
    axes, sigma = splats.axes(), splats.scales.astype(np.float64)
    order = np.argsort(sigma, axis=1, kind="stable")
    take = lambda k: (
        np.take_along_axis(axes, order[:, k, None, None], axis=2)[..., 0],
        np.take_along_axis(sigma, order[:, k, None], axis=1),
    )
    (normal, thin), (first, a), (second, b) = (take(k) for k in range(3))
    radius = np.sqrt(-2 * np.log1p(-(np.arange(RAYS) + 0.5) / RAYS))
    turn = _GOLDEN * np.arange(RAYS)
    away = np.minimum(radius, arrays.extent) * np.array([np.cos(turn), np.sin(turn)])
    step = _BATCH // RAYS
    for start in range(0, len(splats), step):
        part = slice(start, start + step)
        on = (a * first)[part, None] * away[0][:, None] + (b * second)[part, None] * away[1][:, None]
        # Which way each leans has nothing to do with where its point lies, or all of a plane would come too early.
        lean = 2 * np.pi * np.modf(np.arange(len(splats))[part, None] * _SPREAD[0] + np.arange(RAYS) * _SPREAD[1])[0]
        tilt = np.sin(TILT) * np.stack([np.cos(lean), np.sin(lean)])[..., None]
        aside = first[part, None] * tilt[0] + second[part, None] * tilt[1]
        # Where the peaks of rays lie that lean so: in the plane that the Gaussian's own measure calls upright to them.
        over = (thin**2 / a)[part] * tilt[0, ..., 0] * away[0] + (thin**2 / b)[part] * tilt[1, ..., 0] * away[1]
        before = (thin[part] + tolerance)[:, None] / np.cos(TILT)
        for side, sign in enumerate((1.0, -1.0)):
            d = sign * np.cos(TILT) * normal[part, None] + aside
            peak = splats.centers[part, None] + on - sign * (over / np.cos(TILT))[..., None] * normal[part, None]
            o = peak - before * d
            found = _light(arrays, o.reshape(-1, 3), d.reshape(-1, 3), np.repeat(before, RAYS), start)
            lights[side, part] = found.reshape(-1, RAYS).mean(axis=1)
    return whole_areas(splats, arrays.extent) * lights


def _light(arrays: SplatArrays, o: np.ndarray, d: np.ndarray, distance: np.ndarray, start: int) -> np.ndarray:
    """Light (R,) that reaches, along each ray, the Gaussian that it is aimed at: `RAYS` to each, from number ``start``
    on, whose peaks lie at ``distance`` (R,)."""
    own, found = start + np.arange(len(o)) // RAYS, np.zeros(len(o))
    # A little behind the peak, which is found once more.
    groups = groups_of_hits(arrays, o, d, distance * 1.01 + 1e-5 * (np.abs(o).max(axis=1) + distance))
    try:
        group = next(groups)
        while True:
            met = group.index == own[group.rows, None]
            here = met.any(axis=1)
            found[group.rows[here]] = group.arriving[here, met[here].argmax(axis=1)]
            group = groups.send(group.rows[~here])
    except StopIteration:
        return found
