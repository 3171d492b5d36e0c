"""Gaze probes: where they stand, the densities they hold, and measures and regions of these densities."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Neighbours, RayIndex, Rays

from .kde import Backend, SphericalKde, select_loo_kappas, compute_silverman_kappas

# ---- Where probes stand: on a lattice, at random, where people were, or there and evenly (blue noise) ----


def place_queries(
    origin: np.ndarray, placement: str, count: int, spacing: float | None, radius: float, rng: np.random.Generator
) -> np.ndarray:
    """Centres (Q, 3) of probes of ``radius`` R among ray origins (N, 3), metres, by one of `PLACEMENTS`.

    ``data``: ``count`` distinct ray origins at random. ``grid``: a lattice of ``spacing`` (2R) over the origins' box.
    ``random``: ``count`` places uniform in that box. ``blue``: at most ``count`` ray origins, none nearer to another
    than ``spacing``; without one, than the smallest distance from R on at which they are no more. Raises `NergError`
    for another word.
    """
    if placement == "data":
        return origin[rng.choice(len(origin), min(count, len(origin)), replace=False)]
    if placement == "grid":
        return _lattice(origin, spacing or 2.0 * radius)
    if placement == "random":
        return rng.uniform(origin.min(axis=0), origin.max(axis=0), (count, 3))
    _check_one_of("placement", placement, PLACEMENTS)
    if spacing is not None:
        found = _darts(origin, spacing, rng)
        return found[rng.permutation(len(found))[:count]]
    spacing = radius
    while len(found := _darts(origin, spacing, rng)) > count:
        spacing *= max(1.02, (len(found) / count) ** 0.4)
    return found


def _lattice(origin: np.ndarray, spacing: float) -> np.ndarray:
    # Centred in the box, so that it does not favour one wall.
    axes = []
    for a, b in zip(origin.min(axis=0), origin.max(axis=0)):
        n = max(1, int(np.floor((b - a) / spacing)) + 1)
        axes.append(0.5 * (a + b) + spacing * (np.arange(n) - 0.5 * (n - 1)))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


PLACEMENTS = ("data", "grid", "random", "blue")


def _darts(origin: np.ndarray, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Ray origins in random order, each taken if none taken before is within ``spacing`` (Poisson discs by darts)."""
    from scipy.spatial import KDTree

    # One candidate for each cell much smaller than the discs: of millions of origins some ten thousand.
    cell = np.floor((origin - origin.min(axis=0)) / (0.25 * spacing)).astype(np.int64)
    order = rng.permutation(len(origin))
    size = cell.max(axis=0) + 1
    key = (cell[order, 0] * size[1] + cell[order, 1]) * size[2] + cell[order, 2]
    candidates = origin[order[np.sort(np.unique(key, return_index=True)[1])]]
    tree = KDTree(candidates)
    free = np.ones(len(candidates), bool)
    taken = []
    for i, place in enumerate(candidates):
        if free[i]:
            taken.append(i)
            free[tree.query_ball_point(place, spacing)] = False
    return candidates[taken]


# ---- Probes ----
#
# Gaze probes: what people looked at from around a position.
#
# A probe gathers the rays whose origins lie within R of a position and turns
# their directions into a density on the sphere (NeRG, Section 5.1).

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

    def widen(self, kappa: float) -> Probes:
        """The probes seen through a von Mises-Fisher law of ``kappa`` about each ray: where eyes look, of rays that say
        where heads point (κ about 37 was measured on people in a shop). See
        :func:`nerg_mi.maths.vmf.convolve_kappa`."""
        return replace(self, kappa=vmf.convolve_kappa(self.kappa, kappa))


def place_probes(
    rays: Rays,
    radius: float = 0.25,
    *,
    placement: str = "data",
    count: int = 4096,
    queries: np.ndarray | None = None,
    spacing: float | None = None,
    max_rays: int = 1024,
    min_rays: int = 64,
    kappa_rule: str = "silverman",
    kappa: float = 20.0,
    kappa_max: float = 1000.0,
    kappa_shared: bool = False,
    eye_kappa: float | None = None,
    weights: str = "equal",
    ray_weights: np.ndarray | None = None,
    centre: str = "mean",
    index: RayIndex | None = None,
    seed: int = 0,
) -> Probes:
    """Probes on a set of rays.

    ``radius``: R in metres (the paper: 0.1 m at 2.6 million rays; with some 10^5 rays 0.25 m). ``placement``,
    ``count``, ``spacing``: see :func:`nerg_mi.probes.probes.place_queries`; or explicit ``queries`` (P, 3). A query
    with fewer than ``min_rays`` rays makes no probe; of more than ``cap`` the nearest are kept (the published code: 8
    and 4,096). ``index``: that of these rays, where there is one already.

    ``kappa_rule``: ``silverman`` (the published code's), ``fixed`` (``kappa``) or ``loo`` (likelihood of each ray under
    those of *other people* where there are any, else under the other rays; unweighted). ``kappa_max`` bounds the first
    and last: a person who stares makes a spike that no few thousand directions resolve. ``kappa_shared``: one κ for all
    probes (:mod:`nerg_mi.probes.kde`). ``widen``: κ of the law of the eyes about the heads, see :meth:`Probes.widened`.

    ``weights``: of a probe's rays, ``equal``, ``distance`` (1 - d/R, as an option of the published code has it with the
    farthest ray's distance for R), or ``person``: each person counts as much in a probe, however long they stayed.
    ``ray_weights`` (N,): non-negative factors besides, such as those of :func:`person_weights`; those of zero are left
    out.

    ``centre``: where the density is said to hold. ``mean``, the (weighted) mean of the rays' origins, as in the
    published code and by default: it is where people stood, also at the edge of where they walk. ``query``: the ball's
    centre, as in the paper's text. The two differ by less than R.

    Raises `NergError` for unknown words, or when no query holds enough rays.
    """
    _check_one_of("placement", placement, PLACEMENTS)
    _check_one_of("kappa_rule", kappa_rule, KAPPA_RULES)
    _check_one_of("centre", centre, CENTRES)
    _check_one_of("weights", weights, WEIGHTS)
    if not radius > 0 or min_rays < 1 or max_rays < min_rays:
        raise NergError(f"radius {radius}, min_rays {min_rays}, cap {max_rays}: need radius > 0 and 1 <= min_rays <= cap")
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

    near = (index or RayIndex(rays)).query(queries, max_rays, radius)
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
        kappas = compute_silverman_kappas(directions, w, offsets, kappa_max, kappa_shared)
    else:
        kappas = select_loo_kappas(directions, persons, offsets, kappa_max, kappa_shared, rng)
    positions = _weighted_means(rays.origin[indices], w, offsets) if centre == "mean" else queries
    if counted is not None:
        indices = counted[indices]
    probes = Probes(positions, queries, float(radius), indices, offsets, directions, kappas, w)
    return probes if eye_kappa is None else probes.widen(eye_kappa)


def compute_participant_weights(rays: Rays) -> np.ndarray:
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
    """Weights (n,) of the rays that are held, whose ``persons`` (n,) and ``own`` weights are given; None: all equal."""
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


# ---- Measures ----
#
# What a probe's density is like: its integral, its entropy, how many rays and people it rests on, and samples of it.

_LEAST, _MOST = 2048, 1 << 17


def count_resolving_directions(kappa: float) -> int:
    """Directions of equal area that resolve kernels of ``kappa``: four in a width 1/sqrt(κ), 2,048 to 131,072."""
    return int(np.clip(np.ceil(4.0 * np.pi * 16.0 * kappa), _LEAST, _MOST))


def compute_integral(probes: Probes, count: int | None = None, backend: Backend = None) -> np.ndarray:
    """∫ p over the sphere by quadrature with ``count`` directions, (P,): one, as far as they resolve the kernels.

    ``count``: None for as many as `resolving_count` of the sharpest kernel.
    """
    return _average(probes, count, backend, lambda p: p)


def compute_entropy(probes: Probes, count: int | None = None, backend: Backend = None) -> np.ndarray:
    """Differential entropy -∫ p log p, (P,), natural, by quadrature; at most log 4π = 2.53, of the uniform one."""
    return -_average(probes, count, backend, lambda p: p * np.log(np.where(p > 0, p, 1.0)))


def count_effective_participants(probes: Probes, rays: Rays) -> np.ndarray:
    """People who count, (P,): the same of the people's summed weights.

    Successive rays of one person say the same over and over, so this, and not the rays, is what a probe's certainty
    rests on. ``rays``: those the probes were placed on.
    """
    w = np.ones(len(probes.indices)) if probes.weights is None else probes.weights
    persons = rays.person[probes.indices]
    out = np.empty(len(probes))
    for p, (a, b) in enumerate(zip(probes.offsets[:-1], probes.offsets[1:])):
        share = np.bincount(persons[a:b], weights=w[a:b])
        out[p] = share.sum() ** 2 / (share**2).sum()
    return out


def sample_directions(probes: Probes, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` independent directions from each probe's density, (P, count, 3): a ray by weight, then its kernel."""
    w = np.ones(len(probes.indices)) if probes.weights is None else probes.weights
    up_to = np.concatenate([[0.0], np.cumsum(w)])
    low, high = up_to[probes.offsets[:-1]], up_to[probes.offsets[1:]]
    at = low[:, None] + rng.random((len(probes), count)) * (high - low)[:, None]
    ray = np.clip(np.searchsorted(up_to, at, side="right") - 1, probes.offsets[:-1, None], probes.offsets[1:, None] - 1)
    mu = probes.directions[ray.ravel()]
    return vmf.sample(mu, np.repeat(probes.kappa, count), rng).reshape(len(probes), count, 3)


def _average(probes: Probes, count: int | None, backend: Backend, of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """4π times the mean of a function of the density over directions of equal area, in blocks of probes."""
    x = fibonacci_directions(count or count_resolving_directions(float(probes.kappa.max())))
    kde = probes.kde(backend)
    out, step = np.empty(len(probes)), max(1, (1 << 24) // len(x))
    for start in range(0, len(probes), step):
        density = kde.select_range(start, min(start + step, len(probes))).evaluate(x)
        out[start : start + step] = 4.0 * np.pi * of(density.astype(np.float64)).mean(axis=1)
    return out


# ---- Regions ----
#
# The smallest regions that hold a share of a density, and what share is to be asked for so that they hold it.
#
# A density of people who were seen is wider or narrower than that of others: the region that it says holds 80 % of the
# gaze holds more or less of theirs. Looks that were held out tell by how much: the share that has to be asked for is
# the quantile of the shares in which they lie (split conformal prediction, Vovk et al. 2005, with highest-density
# regions, Izbicki et al. 2022).

REGION_LEVELS = (0.5, 0.8, 0.95)  # Shares of the gaze whose smallest regions are looked at


def format_level(level: float) -> str:
    """What a share of the gaze is called in tables and files."""
    return f"{level:.0%}"


def compute_region_levels(maps: np.ndarray, sample_densities: np.ndarray) -> np.ndarray:
    """Share of the gaze (P, K) in the smallest region that a ray lies in, of densities ``maps`` (P, D) in directions of
    equal area that are ``at`` (P, K) at the rays: what is denser, and half of what is equal (Hyndman 1996)."""
    out = []
    for row, values in zip(np.maximum(maps, 0).astype(np.float64), sample_densities):
        ordered = np.sort(row)
        mass = np.concatenate([[0.0], np.cumsum(ordered)])
        lower, upper = (mass[np.searchsorted(ordered, values, side)] for side in ("left", "right"))
        out.append(1 - 0.5 * (lower + upper) / mass[-1] if mass[-1] > 0 else np.full(len(values), 0.5))
    return np.array(out)


def calibrate_levels(levels: np.ndarray, weights: np.ndarray) -> dict[str, float]:
    """By `level_name`, the share to ask for so that the region holds each of `LEVELS` of the looks that were held out:
    weighted quantiles of the shares ``levels`` (n,) of `region_levels` in which they lie, ``weights`` (n,)."""
    order = np.argsort(levels)
    held = np.cumsum(weights[order]) / weights.sum()
    at = lambda level: order[min(np.searchsorted(held, level), len(order) - 1)]
    return {format_level(level): float(levels[at(level)]) for level in REGION_LEVELS}


def get_calibrated_level(level: float, calibrated: Mapping[str, float] | None) -> float:
    """The share to ask for so that a region holds ``level``, one of `LEVELS`: itself where nothing was calibrated."""
    return level if calibrated is None else calibrated[format_level(level)]
