"""Gaze probes: what people looked at from around a position.

A probe gathers the rays whose origins lie within R of a position and turns
their directions into a density on the sphere (NeRG, Section 5.1).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths import vmf
from nerg_mi.rays.index import Neighbours, RayIndex
from nerg_mi.rays.rays import Rays

from .bandwidth import loo_kappas, silverman_kappas
from .kde.estimate import Backend, SphericalKde
from .placement import PLACEMENTS, place_queries

KAPPA_RULES = ("silverman", "loo", "fixed")
WEIGHTS = ("equal", "distance", "person")
CENTRES = ("mean", "query")


@dataclass(frozen=True, eq=False)
class Probes:
    """P probes and the n rays that they hold, probe after probe, in metres in the rays' frame."""

    positions: np.ndarray  # (P, 3) where the densities are said to hold
    queries: np.ndarray  # (P, 3) centres of the searched balls
    radius: float  # of the balls
    indices: np.ndarray  # (n,) into the rays they were made from; of a probe, nearest first
    offsets: np.ndarray  # (P + 1,): probe p holds indices[offsets[p]:offsets[p + 1]]
    directions: np.ndarray  # (n, 3) of these rays, unit
    kappa: np.ndarray  # (P,) concentrations of the kernels
    weights: np.ndarray | None = None  # (n,) of these rays, positive; None: equal ones

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def counts(self) -> np.ndarray:
        """Rays in each probe, (P,)."""
        return np.diff(self.offsets)

    def kde(self, backend: Backend = None) -> SphericalKde:
        """The densities as a Dr.Jit object, for evaluation inside kernels."""
        return SphericalKde(self.directions, self.offsets, self.kappa, self.weights, backend)

    def density(self, directions: np.ndarray, backend: Backend = None) -> np.ndarray:
        """Densities (P, D) float32 in 1/sr at ``directions`` (D, 3) or (P, D, 3),
        unit. Each integrates to one over the sphere."""
        return self.kde(backend).evaluate(directions)

    def widened(self, kappa: float) -> Probes:
        """The probes seen through a von Mises-Fisher law of ``kappa`` about each ray: where eyes look, of rays that say
        where heads point (κ about 37 was measured on people in a shop). See
        :func:`nerg_mi.maths.vmf.convolved_kappa`."""
        return replace(self, kappa=vmf.convolved_kappa(self.kappa, kappa))


def place_probes(
    rays: Rays,
    radius: float = 0.25,
    *,
    placement: str = "data",
    count: int = 4096,
    queries: np.ndarray | None = None,
    spacing: float | None = None,
    cap: int = 1024,
    min_rays: int = 64,
    kappa_rule: str = "silverman",
    kappa: float = 20.0,
    kappa_max: float = 1000.0,
    kappa_shared: bool = False,
    widen: float | None = None,
    weights: str = "equal",
    ray_weights: np.ndarray | None = None,
    centre: str = "mean",
    index: RayIndex | None = None,
    seed: int = 0,
) -> Probes:
    """Probes on a set of rays.

    ``radius``: R in metres (the paper: 0.1 m at 2.6 million rays; with some
    10^5 rays 0.25 m). ``placement``, ``count``, ``spacing``: see
    :func:`nerg_mi.density.placement.place_queries`; or explicit ``queries``
    (P, 3). A query with fewer than ``min_rays`` rays makes no probe; of more than
    ``cap`` the nearest are kept (the published code: 8 and 4,096). ``index``: that
    of these rays, where there is one already.

    ``kappa_rule``: ``silverman`` (the published code's), ``fixed`` (``kappa``)
    or ``loo`` (likelihood of each ray under those of *other people* where there
    are any, else under the other rays; unweighted). ``kappa_max`` bounds the first and last:
    a person who stares makes a spike that no few thousand directions resolve.
    ``kappa_shared``: one κ for all probes (:mod:`nerg_mi.density.bandwidth`).
    ``widen``: κ of the law of the eyes about the heads, see :meth:`Probes.widened`.

    ``weights``: of a probe's rays, ``equal``, ``distance`` (1 - d/R, as an option of the
    published code has it with the farthest ray's distance for R), or ``person``: each person
    counts as much in a probe, however long they stayed. ``ray_weights`` (N,):
    non-negative factors besides, such as those of :func:`person_weights`; rays of weight zero are left out.

    ``centre``: where the density is said to hold. ``mean``, the (weighted) mean of the
    rays' origins, as in the published code and by default: it is where people
    stood, also at the edge of where they walk. ``query``: the ball's centre, as
    in the paper's text. The two differ by less than R.

    Raises `NergError` for unknown words, or when no query holds enough rays.
    """
    _check_one_of("placement", placement, PLACEMENTS)
    _check_one_of("kappa_rule", kappa_rule, KAPPA_RULES)
    _check_one_of("centre", centre, CENTRES)
    _check_one_of("weights", weights, WEIGHTS)
    if not radius > 0 or min_rays < 1 or cap < min_rays:
        raise NergError(f"radius {radius}, min_rays {min_rays}, cap {cap}: need radius > 0 and 1 <= min_rays <= cap")
    rng = np.random.default_rng(seed)
    counted = None
    if ray_weights is not None:
        ray_weights = _check_ray_weights(ray_weights, len(rays))
        if not ray_weights.all():
            # A ray of weight zero is not there.
            counted = np.flatnonzero(ray_weights)
            rays, ray_weights, index = rays.select(counted), ray_weights[counted], None
    if queries is None:
        queries = place_queries(rays.origin, placement, count, spacing, radius, rng)
    queries = np.asarray(queries, dtype=np.float64).reshape(-1, 3)

    near = (index or RayIndex(rays)).nearest(queries, cap, radius)
    enough = np.diff(near.offsets) >= min_rays
    if not enough.any():
        raise NergError(
            f"none of {len(queries)} probes holds {min_rays} rays within {radius} m; "
            "enlarge the radius or lower min_rays"
        )
    queries, near = queries[enough], _only(near, enough)
    indices, offsets = near.indices, near.offsets
    directions, persons = rays.direction[indices], rays.person[indices]
    w = _weigh(near, persons, radius, weights, None if ray_weights is None else ray_weights[indices])
    if kappa_rule == "fixed":
        kappas = np.full(len(queries), float(kappa))
    elif kappa_rule == "silverman":
        kappas = silverman_kappas(directions, w, offsets, kappa_max, kappa_shared)
    else:
        kappas = loo_kappas(directions, persons, offsets, kappa_max, kappa_shared, rng)
    positions = _weighted_means(rays.origin[indices], w, offsets) if centre == "mean" else queries
    if counted is not None:
        indices = counted[indices]
    probes = Probes(positions, queries, float(radius), indices, offsets, directions, kappas, w)
    return probes if widen is None else probes.widened(widen)


def person_weights(rays: Rays) -> np.ndarray:
    """Weights (N,) under which every person counts as much, whatever the number of their rays; their mean is one."""
    counts = np.bincount(rays.person)
    return len(rays) / np.count_nonzero(counts) / counts[rays.person]


def _check_one_of(name: str, value: str, words: Iterable[str]) -> None:
    if value not in words:
        raise NergError(f'{name} is "{value}"; it is one of {", ".join(words)}')


def _check_ray_weights(weights: np.ndarray, count: int) -> np.ndarray:
    weights = np.asarray(weights, dtype=np.float64)
    if weights.shape != (count,) or not (weights >= 0).all():
        raise ValueError(f"ray_weights {weights.shape} must be {count} non-negative numbers, one a ray")
    return weights


def _only(near: Neighbours, places: np.ndarray) -> Neighbours:
    """The neighbours of some of the places, by a mask."""
    counts = np.diff(near.offsets)
    held = np.repeat(places, counts)
    return Neighbours(near.indices[held], near.distances[held], np.concatenate([[0], np.cumsum(counts[places])]))


def _weigh(
    near: Neighbours, persons: np.ndarray, radius: float, rule: str, own: np.ndarray | None
) -> np.ndarray | None:
    """Weights (n,) of the rays that are held, whose ``persons`` (n,) and ``own`` weights are given; None where all are
    equal."""
    if rule == "distance":
        # Never quite zero: a probe may hold nothing but rays at its rim.
        return np.maximum(1.0 - near.distances / radius, 1e-6) * (1.0 if own is None else own)
    if rule == "person":
        counts = np.diff(near.offsets)
        probe = np.repeat(np.arange(len(counts)), counts)
        _, whose, rays = np.unique(probe * (1 + persons.max()) + persons, return_inverse=True, return_counts=True)
        return (1.0 if own is None else own) / rays[whose]
    return own


def _weighted_means(values: np.ndarray, weights: np.ndarray | None, offsets: np.ndarray) -> np.ndarray:
    """Means (P, 3) of each probe's ``values`` (n, 3)."""
    if weights is None:
        share, weighted = 1.0 / np.diff(offsets), values
    else:
        share, weighted = 1.0 / np.add.reduceat(weights, offsets[:-1]), values * weights[:, None]
    return np.add.reduceat(weighted, offsets[:-1]) * share[:, None]
